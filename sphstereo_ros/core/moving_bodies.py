"""Parts of what moves that do not show it.

A car that keeps pace has no parallax, but its plain roof takes on that of the house behind, and
its panes mirror what is at rest. What is marked of it tells where it stands and how tall it is, at
least: what seems to be behind, in that place, may be a part of it and is unknown.
"""
from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from .camera import Equirectangular
from .frames import Image8
from .sphere import polar_axes
from .warp import Map

Floats = NDArray[np.float64]

_ROWS, _STEP = 160, 4  # of the small picture that is looked at: so many or, of more, every n-th
# m over the floor: what rises less is no body (less than half as high as the camera, if that is
# less), none is taller; and so tall may each be if the camera is lower: no mark reaches over that.
_LEAST, _TALLEST, _CAR = 0.5, 2.0, 1.5
_GAP = 0.6  # m: half of what a gap at its foot may be wide
_RIM, _PLAIN = 0.2, 0.5  # m over the marks: may be a part; if it was not measured sharply
_SHARP = 0.02  # relative standard deviation
# Tangent of how far below the horizon it stands: with less, nothing tells how far away; with more,
# it is what carries the camera, which is no body that anything could belong to.
_STANDS, _CARRIES = 0.03, 1.7
_BEHIND, _CERTAIN = 1.3, 3.0  # times as far; standard deviations


def unmarked_parts(moving: Image8, rho: Map, sigma: Map, plane: Floats) -> NDArray[np.bool_]:
    """Where something seems to be behind what moves, though it may be a part of that.

    Parameters
    ----------
    moving : (H, 2H), non-zero = marked as moving
    rho, sigma : (H, 2H) inverse range and its standard deviation, 1/m
    plane : (3,) the floor, m · bearing = 1 / range in the optical frame (`moving.floor_plane`)

    Returns bool (H, 2H).

    """
    rows = max(len(moving) // _STEP, min(len(moving), _ROWS))
    e0, e1, down = polar_axes(plane).T
    level = np.stack([e0, down, -e1])  # x right, y down, z ahead ← optical
    height = float(1 / np.linalg.norm(plane))
    near, tall = _bodies(moving, level, height, rows)
    if not near.any():
        return np.zeros(moving.shape, bool)
    rim, plain = (np.asarray(cv2.resize(m, moving.shape[::-1], interpolation=cv2.INTER_NEAREST))
                  for m in _nearness(near, tall, level, height))
    farthest = rho + np.float32(_CERTAIN) * sigma
    blurred = sigma >= np.float32(_SHARP) * rho
    return np.asarray((farthest < rim) | (blurred & (farthest < plain)))


@lru_cache(4)
def _sphere(rows: int) -> Floats:
    return np.asarray(Equirectangular(rows, 2 * rows).bearings(), np.float64)


def _bodies(moving: Image8, level: Floats, camera: float, rows: int) -> tuple[Floats, Floats]:
    """What stands in each of 2 · `rows` azimuths of the `level` frame: the inverse of how far
    away, along the floor, 1/m (0 = nothing), and how tall, m.

    camera : its height over the floor, m
    """
    at = Equirectangular(*moving.shape).project(_sphere(rows) @ level)
    marks = cv2.remap(moving, at.astype(np.float32), None, cv2.INTER_NEAREST,
                      borderMode=cv2.BORDER_REPLICATE)
    foot = np.tan(((np.arange(rows) + 0.5) / rows - 0.5) * np.pi) / camera
    nearness, tall = np.zeros((2, 2 * rows))
    for columns, near, high in _standing(np.asarray(marks, np.uint8), foot, camera):
        np.maximum.at(nearness, columns, near)  # over the seam, columns may come twice
        np.maximum.at(tall, columns, high)
    return nearness, tall


def _standing(marks: Image8, foot: Floats,
              camera: float) -> Iterator[tuple[NDArray[np.int64], Floats, Floats]]:
    """Columns, inverse distance and height of each body.

    marks : (R, 2R), level; foot : (R,) inverse distance at which the floor is seen, 1/m
    """
    around, least = marks.shape[1], _CAR if camera < _CAR else 0
    wide = np.concatenate([marks, marks[:, :around // 4]], axis=1)  # on over the seam
    count, labels, boxes, _ = cv2.connectedComponentsWithStats(wide, connectivity=8)
    for n in range(1, count):
        left, first, width, height, _ = boxes[n]
        body = labels[first:first + height, left:left + width] == n
        top = first + np.argmax(body, axis=0)
        bottom = first + height - 1 - np.argmax(body[::-1], axis=0)
        near = foot[bottom]
        high = camera * (1 - foot[top] / np.maximum(near, 1e-6))
        stands = (near * camera > _STANDS) & (near * camera < _CARRIES)
        stands &= high > min(_LEAST, 0.5 * camera)
        if stands.any():
            columns = np.arange(left, left + width) % around
            gap = _GAP * float(np.median(near[stands])) * around / (2 * np.pi)
            yield columns, *(_closed(np.where(stands, m, 0), gap)
                             for m in (near, np.clip(high, least, _TALLEST)))


def _closed(row: Floats, gap: float) -> Floats:
    """Gaps of at most 2 · `gap` columns have the least of what is at their sides."""
    reach = min(int(np.ceil(gap)), len(row))
    wide = np.pad(row, reach)[None]  # the picture's rim is no mark
    closed = cv2.morphologyEx(wide, cv2.MORPH_CLOSE, np.ones((1, 2 * reach + 1), np.uint8))
    return np.asarray(closed[0, reach:reach + len(row)], np.float64)


def _nearness(near: Floats, tall: Floats, level: Floats, camera: float) -> tuple[Map, Map]:
    """Least inverse range of what is no part of a body nor of its rim, and of what else may be
    one; 0 where neither is. On a small picture as the camera's.
    """
    x, y, z = np.moveaxis(_sphere(len(near) // 2) @ level.T, -1, 0)
    column = ((np.arctan2(x, z) / (2 * np.pi) + 0.5) * len(near)).astype(np.intp) % len(near)
    along, inverse = np.hypot(x, z), near[column]
    rises = camera - y / np.maximum(along * inverse, 1e-9)  # m over the floor, in that place
    rim, plain = (np.where((inverse > 0) & (rises < np.minimum(tall[column] + more, _TALLEST)),
                           along * inverse / _BEHIND, 0) for more in (_RIM, _PLAIN))
    return rim.astype(np.float32), plain.astype(np.float32)
