"""What every pixel says of the band about the vehicle, in one pass."""
from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .jit import fast_kernel, kernel, rows_in_parallel
from .open_space import STEEPEST
from .sectors import FIRST_SECTOR, SECTOR_WIDTH
from .warp import Map, _arctan2

Counts = NDArray[np.int32]
Columns = NDArray[np.int16]

WEIGHT = 64  # of a pixel at the image's equator
_PIECES = 2  # of the image, each with counts of its own
# Where the columns begin, and once round, so that no angle is negative.
_EDGE = SECTOR_WIDTH / 2 - FIRST_SECTOR + 2 * math.pi
_CONFIDENT = 3.0  # standard deviations
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
    """Of a row of pixels: ahead, left, up, across; cell of elevation, column of azimuth."""
    steepest, edge = np.float32(STEEPEST), np.float32(_EDGE)
    for j in range(columns.shape[0]):
        x, y, z = cos_lat * columns[j, 1], -sin_lat, cos_lat * columns[j, 0]
        ahead = turn[0, 0] * x + turn[0, 1] * y + turn[0, 2] * z
        left = turn[1, 0] * x + turn[1, 1] * y + turn[1, 2] * z
        up = turn[2, 0] * x + turn[2, 1] * y + turn[2, 2] * z
        across = np.sqrt(ahead * ahead + left * left)
        out[0, j], out[1, j], out[2, j], out[3, j] = ahead, left, up, across
        out[4, j] = (_arctan2(up, across) + steepest) * per_cell
        out[5, j] = (edge - _arctan2(left, ahead)) * per_column


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
    seen : filled; see `hiding_place`
    flat : (H, 2H) filled: horizontal distance of what stands in the band, metres; else 0
    column : (H, 2H) filled where `flat` is not 0: azimuth, of as many as `seen` has columns

    """
    parts = np.zeros((_PIECES, *seen.shape), np.int32)
    rows_in_parallel(_survey, len(r), r, sigma, rows, columns, turn, camera, band, distances,
                     np.float32(1 / cell), parts, flat, column, pieces=_PIECES)
    np.sum(parts, axis=0, out=seen)


@kernel
def _survey(first: int, last: int, r: Map, sigma: Map, rows: Map, columns: Map, turn: Map,
            camera: Map, band: Map, distances: Map, per_cell: np.float32, parts: Counts,
            flat: Map, column: Columns) -> None:  # pragma: no cover - compiled
    seen = parts[first * _PIECES // r.shape[0]]
    range_min, range_max = band[5], band[6]
    cells, width = seen.shape[1], seen.shape[2]
    per_column = np.float32(width / (2 * math.pi))
    confident = np.float32(_CONFIDENT)
    of_row = np.empty((6, r.shape[1]), np.float32)
    for i in range(first, last):
        _directions(rows[i, 0], rows[i, 1], columns, turn, per_cell, per_column, of_row)
        weight = max(1, int(WEIGHT * rows[i, 0] + 0.5))
        for j in range(r.shape[1]):
            flat[i, j] = 0
            if of_row[4, j] < 0 or of_row[4, j] >= cells:
                continue
            distance, across = r[i, j], of_row[3, j]
            layer = distances.size + 1
            if not np.isnan(distance):
                sure = np.float32(0)  # the horizontal distance up to which this ray is free
                if distance == np.inf:
                    sure = range_max * across
                elif distance > 0 and sigma[i, j] >= 0:
                    sure = (distance - confident * sigma[i, j]) * across
                layer = 0
                while layer < distances.size and sure >= distances[layer]:
                    layer += 1
            seen[layer, int(of_row[4, j]), int(of_row[5, j]) % width] += weight
            if distance == -np.inf:
                distance = range_min
            if not (0 < distance < np.inf):
                continue
            away = _stands(distance, sigma[i, j], of_row[:3, j], camera, band)
            if away > 0:
                if r[i, j] < 0:  # nearer than `range.min`, wherever
                    away = min(away, np.float32(0.999) * band[2])
                flat[i, j] = away
                px = camera[0] + distance * of_row[0, j]
                py = camera[1] + distance * of_row[1, j]
                column[i, j] = int((np.float32(_EDGE) - _arctan2(py, px)) * per_column) % width


@kernel
def _stands(distance: np.float32, spread: np.float32, ray: Map, camera: Map,
            band: Map) -> np.float32:  # pragma: no cover - compiled
    """Horizontal distance of a point that stands in the band; 0 where it does not, or is ground.
    """
    low, high, farthest, clearance = band[0], band[1], band[3], band[4]
    nothing = np.float32(0)
    z = camera[2] + distance * ray[2]
    if z < low or z > high:
        return nothing
    x, y = camera[0] + distance * ray[0], camera[1] + distance * ray[1]
    away = np.sqrt(x * x + y * y)
    if away > farthest:
        return nothing
    ground = band[7] * x + band[8] * y + band[9]
    slack = np.float32(_GROUND_SIGMAS) * spread * abs(ray[2])
    slack = min(slack, np.float32(_GROUND_SLACK)) if slack > 0 else nothing
    if z < ground + clearance + slack and (
            ground < np.float32(_RISE) + np.float32(_RISE_RATE) * away):
        return nothing
    return max(away, np.float32(1e-3))
