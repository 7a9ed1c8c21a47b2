"""Hollows: one bent surface all round, without rims, in closed form.

A network that saw only streets and rooms takes the smooth inside of a tank for something with rims
and gaps. An ellipsoid round the camera, near or far, under a texture of random waves, has none.
"""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from sphstereo_ros.core.camera import Equirectangular
from sphstereo_ros.core.rotations import exp
from sphstereo_ros.scenes.sequence import TruthFrame, stamp_of

Floats = NDArray[np.float64]

_HEIGHTS = (96, 128, 160, 240, 320)
_RADII = (12.0, 150.0)  # of the ellipsoid, in steps from frame to frame
_STRETCH = 0.5  # logarithm of how much longer one axis may be
_OFF = 0.3  # of the smallest half axis: how far from the middle the camera is at most
_WAVES = 48
_FINEST, _COARSEST = 4.0, 80.0  # px: their lengths, as they are seen from the middle
_CONTRAST, _NOISE = (15.0, 60.0), (0.5, 3.0)  # grey levels
_SHAKE = 0.02  # rad


def hollow(seed: int, frames: Sequence[int], step: float) -> list[TruthFrame]:
    """Those frames, in rising order, of a camera that moves straight on by `step` metres a frame
    inside an ellipsoid, and shakes.
    """
    rng = np.random.default_rng([seed, 7])
    height = int(rng.choice(_HEIGHTS))
    radius = step * float(np.exp(rng.uniform(*np.log(_RADII))))
    axes = radius * np.exp(rng.uniform(0, _STRETCH, 3))
    turn, way = exp(rng.normal(0, 1, 3)), exp(rng.normal(0, 1, 3))[:, 2]
    room = radius - step * (frames[-1] - frames[0])
    middle = min(_OFF * radius, 0.9 * room) * exp(rng.normal(0, 1, 3))[:, 0]
    around, texture = _Ellipsoid(axes, turn, middle), _Waves(rng, radius, height)
    noise = float(rng.uniform(*_NOISE))
    found = []
    for index in frames:
        position = step * (index - frames[-1]) * way
        rotation = exp(rng.normal(0, _SHAKE, 3))
        fine, rays = (Equirectangular(n, 2 * n).bearings() @ rotation.T for n in (
            2 * height, height))
        points = position + around.range(position, fine)[..., None] * fine
        grey = cv2.resize(texture(points).astype(np.float32), (2 * height, height),
                          interpolation=cv2.INTER_AREA)
        image = np.clip(np.rint(grey + rng.normal(0, noise, grey.shape)), 0, 255).astype(np.uint8)
        found.append(TruthFrame(stamp_of(index), np.repeat(image[..., None], 3, 2),
                                around.range(position, rays), rotation, position))
    return found


@dataclass(frozen=True)
class _Ellipsoid:
    """Its half axes (3,), m; their directions, the columns of (3, 3); and its middle (3,), m."""

    axes: Floats
    turn: Floats
    middle: Floats

    def range(self, position: Floats, rays: Floats) -> Floats:
        """Distance, m, from `position` inside along each unit ray (…, 3)."""
        origin = (position - self.middle) @ self.turn / self.axes
        rays = rays @ self.turn / self.axes
        square, along = (rays**2).sum(-1), rays @ origin
        return np.asarray((np.sqrt(along**2 + square * (1 - origin @ origin)) - along) / square)


class _Waves:
    """Grey levels of points (…, 3): waves of random lengths and directions."""

    def __init__(self, rng: np.random.Generator, radius: float, height: int) -> None:
        finest, coarsest = np.log(np.array([_FINEST, _COARSEST]) * np.pi / height)
        lengths = radius * np.exp(rng.uniform(finest, coarsest, _WAVES))
        ways = rng.normal(size=(3, _WAVES))
        self._waves = 2 * np.pi * ways / np.linalg.norm(ways, axis=0) / lengths
        self._phases = rng.uniform(0, 2 * np.pi, _WAVES)
        self._height = float(rng.uniform(*_CONTRAST)) * np.sqrt(2 / _WAVES)
        self._middle = float(rng.uniform(80, 170))

    def __call__(self, points: Floats) -> Floats:
        waves = np.cos(points @ self._waves + self._phases)
        return np.asarray(self._middle + self._height * waves.sum(-1))
