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
    bins_per_e: float  # bins of distance over a ratio of e

    def array(self) -> Map:
        """For the kernel."""
        return np.array([-self.below, self.above, self.nearest, self.farthest, self.clearance,
                         self.range_min, self.range_max, *self.plane, self.bins_per_e],
                        np.float32)


@kernel
def survey(r: Map, sigma: Map, rows: Map, columns: Map, turn: Map, camera: Map, band: Map,
           distances: Map, cell: float, stride: int, near: Counts, seen: Counts, points: Map,
           places: Counts) -> int:  # pragma: no cover - compiled
    """Fill `near` and `seen`; returns how many obstacle points there are.

    Parameters
    ----------
    r, sigma : (H, 2H) as published
    rows : (H, 2) cos and sin of the latitude; columns : (2H, 2) of the longitude
    turn : (3, 3) level frame ← camera_optical; camera : (3,) position in the level frame
    band : as `Band.array`
    distances : at which `seen` is asked, rising
    stride : every so many-th row and column gives a point
    near : (C, bins) weight of obstacle pixels by azimuth and distance; bin 0 is nearer than
        `nearest`
    seen : see `free_sectors`
    points : (N, 3) metres, level frame; places : (N, 2) column and bin of each

    """
    low, high, nearest, farthest, clearance = band[0], band[1], band[2], band[3], band[4]
    range_min, range_max, slope_x, slope_y, floor = band[5], band[6], band[7], band[8], band[9]
    bins_per_e, inverse_nearest = band[10], np.float32(1) / band[2]
    count, width = 0, near.shape[0]
    per_radian = np.float32(width / (2 * math.pi))
    shift = np.float32(SECTOR_WIDTH / 2 - FIRST_SECTOR + 2 * math.pi)
    steepest, per_cell = np.float32(STEEPEST), np.float32(1 / cell)
    confident = np.float32(_CONFIDENT)
    for i in range(r.shape[0]):
        cos_lat, sin_lat = rows[i, 0], rows[i, 1]
        weight = max(1, int(WEIGHT * cos_lat + 0.5))
        for j in range(r.shape[1]):
            x, y, z = cos_lat * columns[j, 1], -sin_lat, cos_lat * columns[j, 0]
            up = turn[2, 0] * x + turn[2, 1] * y + turn[2, 2] * z
            ahead = turn[0, 0] * x + turn[0, 1] * y + turn[0, 2] * z
            left = turn[1, 0] * x + turn[1, 1] * y + turn[1, 2] * z
            flat = np.sqrt(ahead * ahead + left * left)
            elevation = _arctan2(up, flat) + steepest
            row = int(elevation * per_cell)
            if elevation < 0 or row >= seen.shape[1]:
                continue
            distance, spread = r[i, j], sigma[i, j]
            sure = np.float32(0)  # the horizontal distance up to which this ray is free
            if distance == np.inf:
                sure = range_max * flat
            elif distance > 0 and spread >= 0:
                sure = (distance - confident * spread) * flat
            layer = 0
            while layer < distances.size and sure >= distances[layer]:
                layer += 1
            column = int((shift - _arctan2(left, ahead)) * per_radian) % width
            seen[layer, row, column] += weight
            if distance == -np.inf:
                distance = range_min
            elif not (distance > 0 and distance < np.inf):
                continue
            px, py = camera[0] + distance * ahead, camera[1] + distance * left
            pz = camera[2] + distance * up
            if pz < low or pz > high:
                continue
            flat = np.sqrt(px * px + py * py)
            if flat > farthest:
                continue
            ground = slope_x * px + slope_y * py + floor
            slack = np.float32(_GROUND_SIGMAS) * spread * abs(up)
            slack = min(slack, np.float32(_GROUND_SLACK)) if slack > 0 else np.float32(0)
            if pz < ground + clearance + slack and (
                    ground < np.float32(_RISE) + np.float32(_RISE_RATE) * flat):
                continue
            column = int((shift - _arctan2(py, px)) * per_radian) % width
            place = 0
            if flat >= nearest:
                place = 1 + int(np.log(flat * inverse_nearest) * bins_per_e)
                place = min(place, near.shape[1] - 1)
            near[column, place] += weight
            if i % stride == 0 and j % stride == 0:
                points[count, 0], points[count, 1], points[count, 2] = px, py, pz
                places[count, 0], places[count, 1] = column, place
                count += 1
    return count


@kernel
def nearest_supported(near: Counts, needed: Floats, sectors: int,
                      out: Counts) -> None:  # pragma: no cover - compiled
    """The nearest bin of each sector up to which enough weight lies side by side; −1: none.

    near : (C, bins), azimuths of the sectors one after the other; needed : (bins,) weight up to
    that bin, in two columns side by side; those across the sector's edge count, too
    """
    columns, bins = near.shape
    each = columns // sectors
    for sector in range(sectors):
        best = bins
        for k in range(-1, each):
            a, b = (sector * each + k) % columns, (sector * each + k + 1) % columns
            total = 0
            for place in range(best):
                total += near[a, place] + near[b, place]
                if total >= needed[place]:
                    best = place
                    break
        out[sector] = best if best < bins else -1
