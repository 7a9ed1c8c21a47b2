"""Guided sweep: what is known so far, sharpened by all references before smoothness decides.

A sweep (`sweep`) with levels as fine as the longest baseline tells apart fails on slanted
surfaces: their range changes by more than a level from pixel to pixel, and that is what a path is
charged for. What is known so far gives the slant: where it is locally a plane, levels count from
that plane (Scharstein et al. 2017), so that following it is free. It also decides what no grey
tells: a level far from it costs a little more. Per level only the two references that agree best
count, so that one from which a point is hidden does no harm.
"""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from .frames import Image8, RelativePose
from .jit import kernel, rows_in_parallel
from .sweep import (
    _BANDS,
    _FREE,
    MOST_LEVELS,
    Floats,
    Signature,
    Volume,
    _advance,
    _difference,
    _jump,
    _seen,
    _shrunk,
    _winner_rows,
    levels,
    reduction,
    signature,
)
from .warp import Map, PolarGrid

Levels = NDArray[np.int32]
Bytes = NDArray[np.uint8]

_LEVEL = 1.0  # px of parallax between levels, of the longest baseline in use
_COARSER = 1.2  # times, until there are few enough
# What is known costs nothing, a level that many away costs the most.
_HOLD, _HELD = 6, 10
_PLANE, _FLAT, _BEND = 12, 1.5, 0.15  # px round about; levels off a plane: and a share of its fall
_UNKNOWN = 10000  # level of what is no plane
_STEEP = 3  # levels a pixel that a plane falls at most
_WORST = np.uint16(255)
# Levels go as near as what is known to be nearest (px across), and beyond; and at least to so much
# of the nearest baseline over range.
_SPOT, _BEYOND, _AT_LEAST = 3, 1.25, 0.5
# Penalties for a change by more than a level: less, from _JUMP to _EDGE, where grey changes.
_JUMP, _EDGE = 300, 80


@dataclass(frozen=True)
class Swept:
    """Inverse range on the shrunk polar grid, 1/m, and the distance of its levels there, 1/m."""

    rho: Map
    step: Map


@kernel
def _cost_rows(first: int, last: int, here: Signature, there: Signature, row: Map, column: Map,
               table: Map, used: NDArray[np.int64], known: Map,
               cost: Bytes) -> None:  # pragma: no cover - compiled
    """Mean of the two least costs of a level, (rows, columns, levels), and what holds it.

    there … used : of all references, as in `sweep._Seen`, one after the other
    """
    count, rows, columns = there.shape
    half, end = np.float32(0.5), np.int32(columns - 1)
    least, second, found = (np.empty(cost.shape[2], np.uint16), np.empty(cost.shape[2], np.uint16),
                            np.empty(cost.shape[2], np.uint16))
    met = np.empty(cost.shape[2], np.uint32)
    for i in range(first, last):
        for j in range(here.shape[1]):
            own = here[i, j]
            least[:] = _WORST
            second[:] = _WORST
            for n in range(count):
                r = min(max(int(row[n, i, j] + half), 0), rows - 1)
                at = min(max(int(column[n, i, j] + half), 0), table.shape[1] - 1)
                offset = column[n, i, j] - np.float32(at) + half
                for k in range(used[n]):
                    c = min(max(np.int32(table[n, at, k] + offset), np.int32(0)), end)
                    met[k] = there[n, r, c]
                for k in range(used[n]):  # loops of their own run in vectors
                    found[k] = np.uint16(_difference(own, met[k]))
                for k in range(used[n]):
                    second[k] = min(second[k], max(least[k], found[k]))
                    least[k] = min(least[k], found[k])
            for k in range(cost.shape[2]):
                other = second[k] if second[k] != _WORST else least[k]
                away = min(abs(np.float32(k) - known[i, j]) * np.float32(1 / _HELD),
                           np.float32(1))
                held = np.int32(away * np.float32(_HOLD) + half)
                cost[i, j, k] = np.uint8(np.int32(least[k]) + np.int32(other) + held)


@kernel
def _fall(plane: Levels, i: int, j: int, ip: int, jp: int) -> int:  # pragma: no cover - compiled
    fall = plane[i, j] - plane[ip, jp]
    return fall if abs(fall) <= _STEEP else 0


@kernel
def _along_rows(first: int, last: int, cost: Bytes, image: Image8, plane: Levels,
                total: Volume) -> None:  # pragma: no cover - compiled
    columns, count = cost.shape[1], cost.shape[2]
    side = _STEEP + 1
    path = np.empty((2, count + 2 * side), np.uint16)
    for i in range(first, last):
        for way in range(2):
            path[:] = _FREE
            path[0, side:-side] = 0
            least = np.uint16(0)
            for n in range(columns):
                j = n if way == 0 else columns - 1 - n
                jp = max(j - 1, 0) if way == 0 else min(j + 1, columns - 1)
                at = _STEEP - _fall(plane, i, j, i, jp)
                jump = _jump(image, i, j, i, jp, _JUMP, _EDGE)
                least = _advance(cost[i, j], path[n % 2, at:], least, jump, total[i, j],
                                 path[1 - n % 2, side - 1:])


@kernel
def _across_rows(first: int, last: int, cost: Bytes, image: Image8, plane: Levels, slant: int,
                 total: Volume) -> None:  # pragma: no cover - compiled
    """Down and up the rows, each path shifting `slant` columns a row, within some columns."""
    rows, count = cost.shape[0], cost.shape[2]
    side = _STEEP + 1
    a = np.empty((last - first, count + 2 * side), np.uint16)
    b = np.empty((last - first, count + 2 * side), np.uint16)
    b[:] = _FREE
    least, lowest = np.empty(last - first, np.uint16), np.empty(last - first, np.uint16)
    for way in range(2):
        a[:] = _FREE
        a[:, side:-side] = 0
        least[:] = 0
        for n in range(rows):
            i = n if way == 0 else rows - 1 - n
            ip = max(i - 1, 0) if way == 0 else min(i + 1, rows - 1)
            for j in range(first, last):
                jp = j - slant if way == 0 else j + slant
                jp = min(max(jp, first), last - 1)
                at = _STEEP - _fall(plane, i, j, ip, jp)
                lowest[j - first] = _advance(
                    cost[i, j], a[jp - first, at:], least[jp - first],
                    _jump(image, i, j, ip, jp, _JUMP, _EDGE), total[i, j], b[j - first, side - 1:])
            a, b = b, a
            least, lowest = lowest, least


def planes(known: Map) -> Levels:
    """Level (int32) of the plane round each pixel, or _UNKNOWN where it is none.

    known : levels, not whole
    """
    size = 2 * _PLANE + 1
    offset = np.arange(-_PLANE, _PLANE + 1, dtype=np.float32)
    square = float((offset * offset).mean())
    flat, rise = np.full(size, 1 / size, np.float32), offset / np.float32(size * square)
    mean: Map = np.asarray(cv2.blur(known, (size, size)))
    along, across = cv2.sepFilter2D(known, -1, rise, flat), cv2.sepFilter2D(known, -1, flat, rise)
    falls = along * along + across * across
    rest = cv2.blur(known * known, (size, size)) - mean * mean - falls * np.float32(square)
    allowed = np.float32(_FLAT) + np.float32(_BEND * _PLANE) * np.sqrt(falls)
    level: Levels = np.rint(mean).astype(np.int32)
    level[rest >= allowed * allowed] = _UNKNOWN
    return level


def _fine_levels(baselines: Sequence[float], pixel: float, nearest: float) -> Floats:
    """Levels up to the inverse range `nearest`, as fine as their number allows."""
    step = _LEVEL
    found = levels(baselines, pixel, step, nearest)
    while len(found) == MOST_LEVELS:
        step *= _COARSER
        found = levels(baselines, pixel, step, nearest)
    return found


def _nearest(known: Map, baseline: float) -> float:
    """Inverse range to which there must be levels: beyond it, they would only mislead."""
    spot = np.ones((_SPOT, _SPOT), np.uint8)
    return max(_BEYOND * float(cv2.erode(known, spot).max()), _AT_LEAST / baseline)


def _all_seen(references: Sequence[tuple[Image8, RelativePose]], half: PolarGrid, axes: Floats,
              by: int, level: Floats) -> list[NDArray[Any]]:
    """What `sweep._Seen` has of each reference, stacked: (references, …)."""
    nearest = references[0][1].baseline
    seen = [_seen(_shrunk(image, by), pose, half, axes, level, pose.baseline == nearest)
            for image, pose in references]
    return [np.stack(parts) for parts in zip(*seen, strict=True)]


def guided_sweep(current: Image8, grid: PolarGrid, axes: Floats,
                 references: Sequence[tuple[Image8, RelativePose]], known: Map) -> Swept:
    """Inverse range on the current view's polar grid, shrunk by `reduction` (to half as a rule).

    Parameters
    ----------
    current, grid, axes, references : as for `sweep`
    known : 1/m, of grid.shape, what is known so far

    """
    by = reduction(grid.height)
    half = PolarGrid(grid.height // by, grid.margin // by, grid.wrap // by)
    view = _shrunk(current, by)
    small = cv2.resize(known, half.shape[::-1], interpolation=cv2.INTER_AREA)
    baselines = [p.baseline for _, p in references]
    level = _fine_levels(baselines, half.pixel, _nearest(small, baselines[0]))
    seen = _all_seen(references, half, axes, by, level)
    number = np.arange(level.size)
    cost = np.empty((*half.shape, level.size), np.uint8)
    rows_in_parallel(_cost_rows, len(cost), signature(view), *seen,
                     np.interp(small, level, number).astype(np.float32), cost)
    smooth = np.interp(cv2.medianBlur(small, 5), level, number).astype(np.float32)
    plane, total = planes(smooth), np.zeros(cost.shape, np.uint16)
    rows_in_parallel(_along_rows, len(cost), cost, view, plane, total)
    for slant in (0, 1, -1):
        rows_in_parallel(_across_rows, cost.shape[1], cost, view, plane, slant, total,
                         pieces=_BANDS)
    out = np.empty(half.shape, np.float32)
    rows_in_parallel(_winner_rows, len(total), total, level.astype(np.float32), out)
    out = np.asarray(cv2.medianBlur(out, 3))
    out = np.where(small > level[-1], small, out)
    step = np.interp(out, level[:-1], np.diff(level)).astype(np.float32)
    return Swept(out, step)
