"""Obstacles round the vehicle, from a range image and the vehicle's attitude.

Everything is asked in the level frame, about the origin of `base_link`. What lies between
`obstacles.height_below` and `obstacles.height_above`, and is not ground, is an obstacle where
enough pixels side by side say so. A sector is free only where no thing worth mentioning could
stand unseen (`open_space`).
"""
from __future__ import annotations

import math
from dataclasses import replace
from functools import lru_cache, partial

import cv2
import numpy as np
from numpy.typing import NDArray

from .clusters import bin_middle, nearest_things
from .config import Config
from .contact import time_to_contact
from .frames import Drop, FrameKey, Image8, RangeImage
from .ground import Ground, find_ground, surfaces_below
from .level import Attitude
from .open_space import STEEPEST, Hidden, distances_asked, hiding_place
from .rotations import mount
from .sectors import SECTORS, ObstacleSectors, SectorState
from .survey import Band, points_of, survey
from .warp import Map

Floats = NDArray[np.float64]

# A sector is free where no pole could stand unseen. It is measured where nothing could that is as
# wide as `obstacles.hidden_width`, nor a post, at less than _BEFORE of the distance that is
# measured.
_POLE = Hidden(0.15, 0.5, 10.0, 0.75, False)
_BODY = Hidden(1.0, 0.4, 10.0, 0.15, True, nearest=2.0)
_POST = Hidden(0.15, 1.2, 10.0, 0.15, True, nearest=2.0)
_BEFORE = 0.6
# m above the band that must be free, too: a crown that begins there has leaves below it.
_OVER = 0.5
# By such a share of its height over and under the camera, the band is larger than it is asked to
# be: range that is a little too large must not carry what stands near, and low in it, out of it.
_LEEWAY = 0.03
_DOUBT = 0.01  # m²: a sector with so much that is too small to be believed is not free
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
        limits, image, height = self._config.obstacles, self._image, len(self._image.range)
        ground = self._ground()
        distances = distances_asked(limits.maximum)
        cell = max(_CELL, _PIXELS_PER_COLUMN * math.pi / height)
        columns = SECTORS * min(_COLUMNS, max(1, int(
            2 * height / SECTORS / _PIXELS_PER_COLUMN)))
        seen = np.zeros((len(distances) + 2, math.ceil(2 * STEEPEST / cell), columns), np.int32)
        flat = np.empty(image.range.shape, np.float32)
        column = np.empty(image.range.shape, np.int16)
        survey(image.range, image.sigma, *self._angles, self._turn,
               self._camera.astype(np.float32), self._band(ground).array(),
               distances.astype(np.float32), cell, seen, flat, column)
        place = partial(hiding_place, seen, distances, ground=ground, camera=self._camera,
                        cell=cell)
        free = np.isinf(place(replace(_POLE, trust_sky=limits.trust_sky), replace(
            limits, height_above=limits.height_above + _OVER)))
        hidden = np.full(SECTORS, np.inf)
        if limits.hidden_width > 0:
            hidden = np.minimum(place(replace(_BODY, width=limits.hidden_width), limits),
                                place(_POST, limits))
        nearest, doubt, believed = nearest_things(
            flat, column, np.ascontiguousarray(self._angles[0][:, 0]), limits.minimum,
            limits.maximum, columns)
        free &= doubt.reshape(SECTORS, -1).sum(axis=1) < _DOUBT
        return self._result(_of_sectors(nearest), free, hidden, self._points(believed))

    def _points(self, believed: NDArray[np.bool_]) -> Map:
        step = max(1, len(believed) // (2 * _SAMPLED_ROWS))
        points = np.empty((believed[::step, ::step].size, 3), np.float32)
        count = points_of(believed, self._image.range, *self._angles, self._turn,
                          self._camera.astype(np.float32), step, self._config.range.minimum,
                          points)
        return points[:count].copy()

    def _result(self, found: NDArray[np.int32], free: NDArray[np.bool_],
                hidden: Floats, points: Map) -> ObstacleSectors:
        limits = self._config.obstacles
        middle = bin_middle(found, limits.minimum)
        measured = (found >= 0) & (hidden > _BEFORE * middle)
        distance = np.where(measured, np.clip(middle, limits.minimum, limits.maximum),
                            np.nan).astype(np.float32)
        state = np.where(measured, SectorState.MEASURED,
                         np.where(free, SectorState.FREE, SectorState.UNKNOWN)).astype(np.uint8)
        nearest = float(distance[measured].min()) if measured.any() else None
        contact = time_to_contact(state, distance, self._attitude.velocity, limits.vehicle_width)
        return ObstacleSectors(self._image.key, state, distance, measured & (found == 0),
                               limits.minimum, limits.maximum, points, nearest, contact)

    def _ground(self) -> Ground | None:
        step = max(1, len(self._image.range) // _SAMPLED_ROWS)
        points = np.empty((self._image.range[::step, ::step].size, 3), np.float32)
        count = surfaces_below(self._image.range, self._image.sigma, *self._angles, self._turn,
                               self._camera.astype(np.float32), step, points)
        return find_ground(points[:count], self._camera)

    def _band(self, ground: Ground | None) -> Band:
        limits, measured = self._config.obstacles, self._config.range
        plane = (0.0, 0.0, -math.inf) if ground is None else (*ground.slope, ground.height)
        up = float(self._camera[2])
        below = limits.height_below + _LEEWAY * max(limits.height_below + up, 0.0)
        above = limits.height_above + _LEEWAY * max(limits.height_above - up, 0.0)
        return Band(below, above, limits.minimum, limits.maximum, limits.ground_clearance,
                    measured.minimum, measured.maximum, plane)


@lru_cache(maxsize=4)
def _angles(height: int) -> tuple[Map, Map]:
    """cos and sin of the latitudes of the rows (H, 2), and of the longitudes (2H, 2)."""
    lat = np.pi * (0.5 - (np.arange(height) + 0.5) / height)
    lon = 2 * np.pi * ((np.arange(2 * height) + 0.5) / (2 * height) - 0.5)
    return tuple(np.stack([np.cos(a), np.sin(a)], axis=1).astype(np.float32)  # type: ignore
                 for a in (lat, lon))


def _of_sectors(nearest: NDArray[np.int32]) -> NDArray[np.int32]:
    """The nearest of each sector's columns, and of those just beyond its edges; −1: none."""
    far = np.iinfo(np.int32).max
    columns = np.where(nearest < 0, far, nearest).reshape(SECTORS, -1)
    out = np.minimum(columns.min(axis=1), np.minimum(np.roll(columns[:, -1], 1),
                                                     np.roll(columns[:, 0], -1)))
    return np.asarray(np.where(out == far, -1, out), np.int32)
