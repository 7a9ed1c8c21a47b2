"""Metres from the known height of the camera above the ground."""
from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from .camera import Equirectangular
from .config import CameraConfig
from .frames import RangeImage
from .ground import find_ground
from .rotations import mount

Floats = NDArray[np.float64]

_STEP = 4  # every so many pixels and rows
_DIP = 0.05  # sine of the angle below the horizon of ground
# The same of a first look: straight down nothing but ground is seen, where anything is.
_STEEP = (0.7, 0.5, 0.35, 0.2)
_ENOUGH = 50
_ROUNDS, _SETTLED = 5, 0.02  # of the logarithm: a plane that each look tells anew is no ground
_SIGMA = 0.1  # of a range, as a share of it, at most
# Standard deviation of the logarithm of a height: roads are arched, vehicles rock.
HEIGHT_SIGMA = 0.03


@lru_cache(maxsize=2)
def _below(height: int, camera: CameraConfig) -> Floats:
    """Bearings (H / step, 2H / step, 3) in base_link."""
    v, u = np.mgrid[0:height:_STEP, 0:2 * height:_STEP]
    optical = Equirectangular(height, 2 * height).unproject(np.stack([u, v], -1).astype(float))
    return np.asarray(optical @ mount(camera).rotation.T)


def ground_scale(image: RangeImage, camera: CameraConfig, height: float,
                 scale: float | None = None) -> float | None:
    """Metres in a unit of the range image, so that the camera is `height` metres above ground.

    camera : its mount; base_link is nearly level
    scale : believed so far; None where nothing is
    None where no ground is found
    """
    bearings = _below(len(image.range), camera)
    thin = (slice(None, None, _STEP), slice(None, None, _STEP))
    r, sigma = image.range[thin].astype(np.float64), image.sigma[thin]
    with np.errstate(invalid='ignore'):
        known = np.isfinite(r) & (r > 0) & (sigma < _SIGMA * r) & (bearings[..., 2] < -_DIP)
    r, bearings = r[known], bearings[known]
    if scale is None:
        scale = _first_look(-bearings[:, 2], r, height)
        if scale is None:
            return None
    for _ in range(_ROUNDS):  # what is ground and what is not is told in metres
        points = (scale * r[:, None] * bearings).astype(np.float32)
        ground = find_ground(points, np.zeros(3))
        if ground is None:
            return None
        change = height * math.hypot(1.0, *ground.slope) / -ground.height
        scale *= change
        if abs(math.log(change)) < _SETTLED:
            return scale
    return None


def _first_look(dip: Floats, r: Floats, height: float) -> float | None:
    """Of the steepest points, if there are enough."""
    for least in _STEEP:
        steep = dip > least
        if steep.sum() >= _ENOUGH:
            return height / float(np.median((dip * r)[steep]))
    return None
