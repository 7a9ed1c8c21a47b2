"""Obstacles round the vehicle, from a range image and the vehicle's attitude.

Everything is asked in the level frame, about the origin of `base_link`. What lies between
`obstacles.height_below` and `obstacles.height_above`, and is not ground, is an obstacle where
enough pixels side by side say so. A sector is free only where no thing worth mentioning could
stand unseen (`open_space`).
"""
from __future__ import annotations

import math
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from .config import Config
from .contact import time_to_contact
from .frames import Drop, FrameKey, Image8, RangeImage
from .ground import Ground, find_ground, surfaces_below
from .level import Attitude
from .open_space import STEEPEST, distances_asked, free_sectors
from .rotations import mount
from .sectors import SECTORS, ObstacleSectors, SectorState
from .survey import WEIGHT, Band, nearest_supported, survey
from .warp import Map

Floats = NDArray[np.float64]

_STEP = 0.005  # relative width of the bins of distance
# The least obstacle: metres wide and high, how much of it must be measured, at least how many
# pixels.
_WIDTH, _HEIGHT, _SHARE, _PIXELS = 0.08, 0.2, 0.5, 6
_COLUMNS, _PIXELS_PER_COLUMN = 10, 1.3  # of a sector, at most, and where the image has as many
_CELL = math.radians(1.0)  # height of the cells of `open_space`, at least
_SAMPLED_ROWS = 120  # of the image, to find the ground; twice as many for points
_LEAST_ROWS = 64


class ObstacleDetection:
    """Makes obstacle sectors of range images, each by itself.

    config : all parameters
    mask : (H, W) uint8 of any size, non-zero = vehicle: nothing is known there
    """

    def __init__(self, config: Config, mask: Image8 | None = None) -> None:
        self.config = config
        self._mask = mask

    def warm_up(self) -> None:
        """Compile what `process` needs."""
        r = np.full((_LEAST_ROWS, 2 * _LEAST_ROWS), 3.0, np.float32)
        r[_LEAST_ROWS // 2:] = np.linspace(20, 1, _LEAST_ROWS // 2)[:, None]
        self.process(RangeImage(FrameKey(0, ''), r, np.full_like(r, 0.01), True), Attitude())

    def process(self, image: RangeImage, attitude: Attitude | None) -> ObstacleSectors | Drop:
        """Obstacles at the image's time.

        attitude : of the vehicle then; None where it is not known

        Drops: `no_attitude`, unless `obstacles.require_attitude` is false; `not_metric`;
        `wrong_size`, where range and sigma are not of one size, twice as wide as high.
        """
        if not image.is_metric:
            return Drop('not_metric', 'range without metric scale')
        shape = image.range.shape
        if (len(shape) != 2 or shape != image.sigma.shape or shape[1] != 2 * shape[0]
                or shape[0] < _LEAST_ROWS):
            return Drop('wrong_size', f'range {shape}, sigma {image.sigma.shape}')
        if attitude is None:
            if self.config.obstacles.require_attitude:
                return Drop('no_attitude', "nothing tells the vehicle's roll and pitch")
            attitude = Attitude()
        return _Picture(self.config, self._masked(image), attitude).sectors()

    def _masked(self, image: RangeImage) -> RangeImage:
        r, sigma = (np.ascontiguousarray(m, np.float32) for m in (image.range, image.sigma))
        if self._mask is not None:
            mask = cv2.resize(self._mask, r.shape[::-1], interpolation=cv2.INTER_NEAREST)
            r = np.where(mask != 0, np.float32(np.nan), r)
        return RangeImage(image.key, r, sigma, image.is_metric)


class _Picture:
    """One range image in the level frame."""

    def __init__(self, config: Config, image: RangeImage, attitude: Attitude) -> None:
        self._config, self._image, self._attitude = config, image, attitude
        placed = mount(config.camera)
        self._turn = (attitude.rotation @ placed.rotation).astype(np.float32)
        self._camera = attitude.rotation @ placed.position
        self._angles = _angles(len(image.range))

    def sectors(self) -> ObstacleSectors:
        limits, height = self._config.obstacles, len(self._image.range)
        ground = self._ground()
        distances = distances_asked(limits.maximum)
        cell = max(_CELL, _PIXELS_PER_COLUMN * math.pi / height)
        columns = SECTORS * min(_COLUMNS, max(1, int(
            2 * height / SECTORS / _PIXELS_PER_COLUMN)))
        band = self._band(ground)
        bins = 2 + int(math.log(limits.maximum / limits.minimum) * band.bins_per_e)
        near = np.zeros((columns, bins), np.int32)
        seen = np.zeros((len(distances) + 1, math.ceil(2 * STEEPEST / cell), columns), np.int32)
        stride = max(1, height // (2 * _SAMPLED_ROWS))
        room = -(-height // stride) * -(-2 * height // stride)
        points, places = np.empty((room, 3), np.float32), np.empty((room, 2), np.int32)
        count = survey(self._image.range, self._image.sigma, *self._angles, self._turn,
                       self._camera.astype(np.float32), band.array(),
                       distances.astype(np.float32), cell, stride, near, seen, points, places)
        found = np.empty(SECTORS, np.int32)
        edges = limits.minimum * np.exp(np.arange(-1, bins - 1) / band.bins_per_e)
        nearest_supported(near, _needed(np.maximum(edges, limits.minimum), height), SECTORS,
                          found)
        free = free_sectors(seen, distances, limits, ground, self._camera, cell)
        own = places[:count, 0] * SECTORS // columns
        kept = (found[own] >= 0) & (places[:count, 1] >= found[own])
        return self._result(found, free, points[:count][kept])

    def _result(self, found: NDArray[np.int32], free: NDArray[np.bool_],
                points: Map) -> ObstacleSectors:
        limits = self._config.obstacles
        measured = found >= 0
        middle = limits.minimum * np.exp(np.maximum(found - 0.5, 0) * _STEP)
        distance = np.where(measured, np.clip(middle, limits.minimum, limits.maximum),
                            np.nan).astype(np.float32)
        state = np.where(measured, SectorState.MEASURED,
                         np.where(free, SectorState.FREE, SectorState.UNKNOWN)).astype(np.uint8)
        nearest = float(distance[measured].min()) if measured.any() else None
        contact = time_to_contact(state, distance, self._attitude.velocity, limits.vehicle_width)
        return ObstacleSectors(self._image.key, state, distance, found == 0, limits.minimum,
                               limits.maximum, points, nearest, contact)

    def _ground(self) -> Ground | None:
        step = max(1, len(self._image.range) // _SAMPLED_ROWS)
        points = np.empty((self._image.range[::step, ::step].size, 3), np.float32)
        count = surfaces_below(self._image.range, self._image.sigma, *self._angles, self._turn,
                               self._camera.astype(np.float32), step, points)
        return find_ground(points[:count], self._camera)

    def _band(self, ground: Ground | None) -> Band:
        limits, measured = self._config.obstacles, self._config.range
        plane = (0.0, 0.0, -math.inf) if ground is None else (*ground.slope, ground.height)
        return Band(limits.height_below, limits.height_above, limits.minimum, limits.maximum,
                    limits.ground_clearance, measured.minimum, measured.maximum, plane,
                    1 / _STEP)


@lru_cache(maxsize=4)
def _angles(height: int) -> tuple[Map, Map]:
    """cos and sin of the latitudes of the rows (H, 2), and of the longitudes (2H, 2)."""
    lat = np.pi * (0.5 - (np.arange(height) + 0.5) / height)
    lon = 2 * np.pi * ((np.arange(2 * height) + 0.5) / (2 * height) - 0.5)
    return tuple(np.stack([np.cos(a), np.sin(a)], axis=1).astype(np.float32)  # type: ignore
                 for a in (lat, lon))


def _needed(distance: Floats, height: int) -> Floats:
    """Weight of the pixels that the least obstacle has at `distance`, within two columns."""
    two_columns = 2 * 2 * np.pi / (SECTORS * _COLUMNS)
    area = np.minimum(_WIDTH / distance, two_columns) * _HEIGHT / distance
    return np.asarray(WEIGHT * np.maximum(_SHARE * area / (np.pi / height)**2, _PIXELS))
