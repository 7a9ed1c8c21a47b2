"""A reference as the current camera would see it, by the ranges that are known so far.

Over a long baseline near things move far and change their shape. Resampled by range, they lie
nearly where the current view has them and look as they do there, so that what is left to follow
is small.
"""
from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from .frames import Image8, RelativePose
from .jit import fast_kernel, rows_in_parallel
from .warp import BORDER, Map, PolarGrid, _arctan2, resample, with_border

Floats = NDArray[np.float64]

_CELL = 16  # px of the coarse grid on which nearness is averaged
_SPREADS = (1.0, 4.0)  # cells; where features are scarce, those farther away count


def nearness_map(grid: PolarGrid, points: NDArray[np.floating], nearness: Floats) -> Map:
    """Inverse range everywhere on `grid`, smooth, from that of points.

    Parameters
    ----------
    grid : the polar grid
    points : (N, 2) pixels of it
    nearness : (N,) 1/m, NaN where unknown

    Returns
    -------
    float32 of grid.shape, 1/m, not negative

    """
    rows, columns = (-(-n // _CELL) for n in grid.shape)
    known = np.isfinite(nearness)
    column, row = (points[known] / _CELL).astype(np.intp).T
    sums = np.zeros((2, rows, columns), np.float32)
    np.add.at(sums[0], (row, column), np.maximum(nearness[known], 0).astype(np.float32))
    np.add.at(sums[1], (row, column), 1)
    total, count = np.zeros((2, rows, columns), np.float32)
    for spread, weight in zip(_SPREADS, (1.0, 0.01), strict=True):
        total += weight * cv2.GaussianBlur(sums[0], (0, 0), spread)
        count += weight * cv2.GaussianBlur(sums[1], (0, 0), spread)
    coarse = total / np.maximum(count, 1e-9)
    full = cv2.resize(coarse, (columns * _CELL, rows * _CELL), interpolation=cv2.INTER_LINEAR)
    return np.ascontiguousarray(full[:grid.shape[0], :grid.shape[1]])


@fast_kernel
def _relief_rows(first: int, last: int, cos_theta: Map, sin_theta: Map, cos_azimuth: Map,
                 sin_azimuth: Map, axes: Map, position: Map, nearness: Map, scale_u: np.float32,
                 scale_v: np.float32, map_u: Map,
                 map_v: Map) -> None:  # pragma: no cover - compiled
    centre_u = scale_u * np.float32(np.pi) - np.float32(0.5) + np.float32(BORDER)
    centre_v = scale_v * np.float32(np.pi / 2) - np.float32(0.5) + np.float32(BORDER)
    tx, ty, tz = axes[0, 2], axes[1, 2], axes[2, 2]
    px, py, pz = position[0], position[1], position[2]
    for i in range(first, last):
        c, s = cos_azimuth[i], sin_azimuth[i]
        ex = c * axes[0, 0] + s * axes[0, 1]
        ey = c * axes[1, 0] + s * axes[1, 1]
        ez = c * axes[2, 0] + s * axes[2, 1]
        for j in range(cos_theta.size):
            st, ct, w = sin_theta[j], cos_theta[j], nearness[i, j]
            x = st * ex + ct * tx - w * px
            y = st * ey + ct * ty - w * py
            z = st * ez + ct * tz - w * pz
            map_u[i, j] = _arctan2(x, z) * scale_u + centre_u
            map_v[i, j] = _arctan2(y, np.sqrt(x * x + z * z)) * scale_v + centre_v


def reference_in_relief(reference: Image8, pose: RelativePose, grid: PolarGrid, axes: Floats,
                        nearness: Map) -> Image8:
    """The reference image on the current view's polar grid, every pixel moved by its range.

    Parameters
    ----------
    reference : (H, 2H) uint8
    pose : of the reference camera in the current one
    grid, axes : the current view's grid and its axes (3, 3) in the current optical frame
    nearness : of grid.shape, 1/m

    """
    height, width = reference.shape
    theta, azimuth = grid.theta(), grid.azimuth()
    maps = np.empty(grid.shape, np.float32), np.empty(grid.shape, np.float32)
    back = pose.rotation.T
    parts = [np.ascontiguousarray(a, np.float32) for a in (
        np.cos(theta), np.sin(theta), np.cos(azimuth), np.sin(azimuth), back @ axes,
        back @ pose.position, nearness)]
    rows_in_parallel(_relief_rows, grid.shape[0], *parts, np.float32(width / (2 * np.pi)),
                     np.float32(height / np.pi), *maps)
    return np.asarray(resample(with_border(reference), maps), np.uint8)


def sampled(nearness: Map, points: NDArray[np.floating]) -> Floats:
    """Values (N,) of the map at `points` (N, 2), linear between pixels."""
    u, v = np.ascontiguousarray(points, np.float32).T
    found = cv2.remap(nearness, u[None], v[None], cv2.INTER_LINEAR,
                      borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(found[0], np.float64)
