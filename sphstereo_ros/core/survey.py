"""What every pixel says of the band about the vehicle, in one pass."""
from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .jit import kernel
from .open_space import STEEPEST
from .sectors import FIRST_SECTOR, SECTOR_WIDTH
from .warp import Map, _arctan2

Counts = NDArray[np.int32]
Floats = NDArray[np.float64]

WEIGHT = 64  # of a pixel at the image's equator
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


@kernel
def survey(r: Map, sigma: Map, rows: Map, columns: Map, turn: Map, camera: Map, band: Map,
           distances: Map, cell: float, seen: Counts, flat: Map,
           column: NDArray[np.int16]) -> None:  # pragma: no cover - compiled
    """What is free along every ray, and which pixels show what stands in the band.

    Parameters
    ----------
    r, sigma : (H, 2H) as published
    rows : (H, 2) cos and sin of the latitude; columns : (2H, 2) of the longitude
    turn : (3, 3) level frame ← camera_optical; camera : (3,) position in the level frame
    band : as `Band.array`
    distances : at which `seen` is asked, rising
    seen : filled; see `free_sectors`
    flat : (H, 2H) filled: horizontal distance of what stands in the band, metres; else 0
    column : (H, 2H) filled where `flat` is not 0: azimuth, of as many as `seen` has columns

    """
    low, high, nearest, farthest, clearance = band[0], band[1], band[2], band[3], band[4]
    range_min, range_max, slope_x, slope_y, floor = band[5], band[6], band[7], band[8], band[9]
    width = seen.shape[2]
    per_radian = np.float32(width / (2 * math.pi))
    shift = np.float32(SECTOR_WIDTH / 2 - FIRST_SECTOR + 2 * math.pi)
    steepest, per_cell = np.float32(STEEPEST), np.float32(1 / cell)
    confident = np.float32(_CONFIDENT)
    for i in range(r.shape[0]):
        cos_lat, sin_lat = rows[i, 0], rows[i, 1]
        weight = max(1, int(WEIGHT * cos_lat + 0.5))
        for j in range(r.shape[1]):
            flat[i, j] = 0
            x, y, z = cos_lat * columns[j, 1], -sin_lat, cos_lat * columns[j, 0]
            up = turn[2, 0] * x + turn[2, 1] * y + turn[2, 2] * z
            ahead = turn[0, 0] * x + turn[0, 1] * y + turn[0, 2] * z
            left = turn[1, 0] * x + turn[1, 1] * y + turn[1, 2] * z
            across = np.sqrt(ahead * ahead + left * left)
            elevation = _arctan2(up, across) + steepest
            row = int(elevation * per_cell)
            if elevation < 0 or row >= seen.shape[1]:
                continue
            distance, spread = r[i, j], sigma[i, j]
            sure = np.float32(0)  # the horizontal distance up to which this ray is free
            if distance == np.inf:
                sure = range_max * across
            elif distance > 0 and spread >= 0:
                sure = (distance - confident * spread) * across
            layer = 0
            while layer < distances.size and sure >= distances[layer]:
                layer += 1
            if np.isnan(distance):
                layer = distances.size + 1
            at = int((shift - _arctan2(left, ahead)) * per_radian) % width
            seen[layer, row, at] += weight
            if distance == -np.inf:
                distance = range_min
            elif not (distance > 0 and distance < np.inf):
                continue
            px, py = camera[0] + distance * ahead, camera[1] + distance * left
            pz = camera[2] + distance * up
            away = np.sqrt(px * px + py * py)
            if pz < low or pz > high or away > farthest:
                continue
            ground = slope_x * px + slope_y * py + floor
            slack = np.float32(_GROUND_SIGMAS) * spread * abs(up)
            slack = min(slack, np.float32(_GROUND_SLACK)) if slack > 0 else np.float32(0)
            if pz < ground + clearance + slack and (
                    ground < np.float32(_RISE) + np.float32(_RISE_RATE) * away):
                continue
            if r[i, j] < 0:  # nearer than `range.min`, wherever
                away = min(away, np.float32(0.999) * nearest)
            flat[i, j] = max(away, np.float32(1e-3))
            column[i, j] = int((shift - _arctan2(py, px)) * per_radian) % width
