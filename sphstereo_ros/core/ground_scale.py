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
_DIP, _STEEP = 0.05, 0.7  # sine of the angle below the horizon: of ground, and of a first look
_ENOUGH = 50
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
    r, sigma = image.range[thin], image.sigma[thin]
    with np.errstate(invalid='ignore'):
        known = np.isfinite(r) & (r > 0) & (sigma < _SIGMA * r) & (bearings[..., 2] < -_DIP)
    r, bearings = r[known].astype(np.float64), bearings[known]
    if scale is None:
        depth = -r * bearings[:, 2]
        steep = bearings[:, 2] < -_STEEP
        if steep.sum() < _ENOUGH:
            return None
        scale = height / float(np.median(depth[steep]))
    for _ in range(2):  # what is ground and what is not is told in metres
        points = (scale * r[:, None] * bearings).astype(np.float32)
        ground = find_ground(points, np.zeros(3))
        if ground is None:
            return None
        found = -ground.height / math.hypot(1.0, *ground.slope)
        scale *= height / found
    return scale
