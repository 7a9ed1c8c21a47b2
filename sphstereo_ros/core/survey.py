"""What every pixel says of the band about the vehicle, in one pass."""
from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .jit import fast_kernel, kernel
from .open_space import STEEPEST
from .sectors import FIRST_SECTOR, SECTOR_WIDTH
from .warp import Map, _arctan2

Counts = NDArray[np.int32]
Columns = NDArray[np.int16]

WEIGHT = 64  # of a pixel at the image's equator
# Where the columns begin, and once round, so that no angle is negative.
_EDGE = SECTOR_WIDTH / 2 - FIRST_SECTOR + 2 * math.pi
_CONFIDENT = 3.0  # standard deviations
_MARGIN = 1e-3  # rad, of rows that are left out
# What sigma adds to the ground's clearance, at most so many metres.
_GROUND_SIGMAS, _GROUND_SLACK = 2.0, 0.1
# Ground that rises higher above base_link is in the way: m, and m per m of distance.
_RISE, _RISE_RATE = 0.2, 0.05


@dataclass(frozen=True)
class Band:
    """Limits of what is looked at, metres; `plane`: a, b, c of the ground z = ax + by + c."""

    below: float
    above: float
    nearest: float
    farthest: float
    clearance: float
    range_min: float
    range_max: float
    plane: tuple[float, float, float]

    def array(self) -> Map:
        """For the kernel."""
        return np.array([-self.below, self.above, self.nearest, self.farthest, self.clearance,
                         self.range_min, self.range_max, *self.plane], np.float32)


@fast_kernel
def _directions(cos_lat: np.float32, sin_lat: np.float32, columns: Map, turn: Map,
                per_cell: np.float32, per_column: np.float32,
                out: Map) -> None:  # pragma: no cover - compiled
    """Of a row of pixels: ahead, left, up, across; cell of elevation, column of azimuth.

    Loops that run in vectors: short ones, with what `out` could overwrite read before.
    """
    t00, t01, t02 = turn[0, 0], turn[0, 1], turn[0, 2]
    t10, t11, t12 = turn[1, 0], turn[1, 1], turn[1, 2]
    t20, t21, t22 = turn[2, 0], turn[2, 1], turn[2, 2]
    for j in range(columns.shape[1]):
        x, y, z = cos_lat * columns[1, j], -sin_lat, cos_lat * columns[0, j]
        ahead, left = t00 * x + t01 * y + t02 * z, t10 * x + t11 * y + t12 * z
        out[0, j], out[1, j], out[2, j] = ahead, left, t20 * x + t21 * y + t22 * z
        out[3, j] = np.sqrt(ahead * ahead + left * left)
    steepest, edge = np.float32(STEEPEST), np.float32(_EDGE)
    for j in range(columns.shape[1]):
        out[4, j] = (_arctan2(out[2, j], out[3, j]) + steepest) * per_cell
    for j in range(columns.shape[1]):
        out[5, j] = (edge - _arctan2(out[1, j], out[0, j])) * per_column


def survey(r: Map, sigma: Map, rows: Map, columns: Map, turn: Map, camera: Map, band: Map,
           distances: Map, cell: float, seen: Counts, flat: Map, column: Columns) -> None:
    """What is free along every ray, and which pixels show what stands in the band.

    Parameters
    ----------
    r, sigma : (H, 2H) as published
    rows : (H, 2) cos and sin of the latitude; columns : (2H, 2) of the longitude
    turn : (3, 3) level frame ← camera_optical; camera : (3,) position in the level frame
    band : as `Band.array`
    distances : at which `seen` is asked, rising
    seen : zeros, filled; see `hiding_place`
    flat : (H, 2H) filled: horizontal distance of what stands in the band, metres; else 0
    column : (H, 2H) filled where `flat` is not 0: azimuth, of as many as `seen` has columns

    """
    tilt = math.acos(min(max(-float(turn[2, 1]), -1.0), 1.0))
    lowest, highest = -STEEPEST - tilt - _MARGIN, seen.shape[1] * cell - STEEPEST + tilt + _MARGIN
    lat = np.arctan2(rows[:, 1], rows[:, 0])
    looked_at = np.flatnonzero((lat > lowest) & (lat < highest))
    first, last = int(looked_at[0]), int(looked_at[-1]) + 1
    flat[:first], flat[last:] = 0, 0
    _survey(first, last, r, sigma, rows, np.ascontiguousarray(columns.T), turn, camera, band,
            distances, np.float32(1 / cell), seen, flat, column)


@kernel
def _survey(first: int, last: int, r: Map, sigma: Map, rows: Map, columns: Map, turn: Map,
            camera: Map, band: Map, distances: Map, per_cell: np.float32, seen: Counts,
            flat: Map, column: Columns) -> None:  # pragma: no cover - compiled
    width, count = seen.shape[2], r.shape[1]
    per_column = np.float32(width / (2 * math.pi))
    of_row, sure = np.empty((6, count), np.float32), np.empty(count, np.float32)
    place = np.empty(count, np.int32)
    counts = seen.reshape(-1)
    for i in range(first, last):
        _directions(rows[i, 0], rows[i, 1], columns, turn, per_cell, per_column, of_row)
        _places(r[i], sigma[i], of_row, distances, band[6], seen.shape[1], width, sure, place)
        weight = max(1, int(WEIGHT * rows[i, 0] + 0.5))
        for j in range(count):
            if place[j] >= 0:
                counts[place[j]] += weight
        _standing(r[i], sigma[i], of_row, place, camera, band, flat[i])
        if flat[i].max() > 0:
            _azimuths(r[i], of_row, flat[i], camera, band[5], per_column, width, column[i])


@kernel
def _places(r: Map, sigma: Map, of_row: Map, distances: Map, range_max: np.float32, cells: int,
            width: int, sure: Map, place: Counts) -> None:  # pragma: no cover - compiled
    """Where each pixel of a row counts in `seen`, −1: nowhere. Loops that run in vectors.

    sure : the horizontal distance up to which the ray is free; −1 where that is unknown
    """
    confident, none = np.float32(_CONFIDENT), np.float32(0)
    for j in range(r.size):
        free = (r[j] - confident * sigma[j]) * of_row[3, j]
        free = free if r[j] > 0 and sigma[j] >= 0 else none
        free = range_max * of_row[3, j] if r[j] == np.inf else free
        sure[j] = np.float32(-1) if np.isnan(r[j]) else free
        place[j] = 0
    for k in range(distances.size):
        for j in range(r.size):
            place[j] += np.int32(1) if sure[j] >= distances[k] else np.int32(0)
    unknown, rows, across = np.int32(distances.size + 1), np.int32(cells), np.int32(width)
    limit = np.float32(cells)
    for j in range(r.size):
        layer = unknown if np.isnan(r[j]) else place[j]
        at = np.int32(of_row[5, j])
        at = at - across if at >= across else at
        inside = of_row[4, j] >= 0 and of_row[4, j] < limit
        where = (layer * rows + np.int32(of_row[4, j])) * across + at
        place[j] = where if inside else np.int32(-1)


@kernel
def _standing(r: Map, sigma: Map, of_row: Map, place: Counts, camera: Map, band: Map,
              flat: Map) -> None:  # pragma: no cover - compiled
    """Horizontal distances of a row's points that stand in the band; 0 where none does.

    Where `place` is negative, nothing is looked at.
    """
    low, high, nearest, farthest, clearance = band[0], band[1], band[2], band[3], band[4]
    range_min, nothing = band[5], np.float32(0)
    touching = np.float32(0.999) * nearest
    for j in range(r.size):
        distance = range_min if r[j] == -np.inf else r[j]
        x, y = camera[0] + distance * of_row[0, j], camera[1] + distance * of_row[1, j]
        z = camera[2] + distance * of_row[2, j]
        away = np.sqrt(x * x + y * y)
        ground = band[7] * x + band[8] * y + band[9]
        slack = np.float32(_GROUND_SIGMAS) * sigma[j] * abs(of_row[2, j])
        slack = min(slack, np.float32(_GROUND_SLACK)) if slack > 0 else nothing
        is_ground = z < ground + clearance + slack and (
            ground < np.float32(_RISE) + np.float32(_RISE_RATE) * away)
        stands = (distance > 0 and distance < np.inf and z >= low and z <= high
                  and away <= farthest and not is_ground)
        away = max(away, np.float32(1e-3))
        # Nearer than `range.min`, wherever.
        away = min(away, touching) if r[j] < 0 else away
        flat[j] = away if stands else nothing
    for j in range(r.size):
        flat[j] = flat[j] if place[j] >= 0 else nothing


@fast_kernel
def _azimuths(r: Map, of_row: Map, flat: Map, camera: Map, range_min: np.float32,
              per_column: np.float32, width: int,
              column: Columns) -> None:  # pragma: no cover - compiled
    """Columns of a row's points that stand; `of_row` is used up. A loop that runs in vectors."""
    edge, across = np.float32(_EDGE), np.int32(width)
    for j in range(r.size):
        distance = r[j] if flat[j] > 0 and r[j] > 0 else range_min
        of_row[0, j] = camera[0] + distance * of_row[0, j]
        of_row[1, j] = camera[1] + distance * of_row[1, j]
    for j in range(r.size):
        of_row[2, j] = (edge - _arctan2(of_row[1, j], of_row[0, j])) * per_column
    for j in range(r.size):
        at = np.int32(of_row[2, j])
        column[j] = at - across if at >= across else at


@kernel
def points_of(believed: NDArray[np.bool_], r: Map, rows: Map, columns: Map, turn: Map,
              camera: Map, step: int, range_min: float,
              out: Map) -> int:  # pragma: no cover - compiled
    """Points of every `step`-th pixel that is believed, metres, level frame; returns how many.

    What is nearer than `range_min` is put there; out : (N, 3); else as `survey` takes it
    """
    count = 0
    for i in range(0, r.shape[0], step):
        for j in range(0, r.shape[1], step):
            if not believed[i, j]:
                continue
            distance = np.float32(r[i, j] if r[i, j] > 0 else range_min)
            x, y, z = rows[i, 0] * columns[j, 1], -rows[i, 1], rows[i, 0] * columns[j, 0]
            for axis in range(3):
                out[count, axis] = camera[axis] + distance * (
                    turn[axis, 0] * x + turn[axis, 1] * y + turn[axis, 2] * z)
            count += 1
    return count
