"""Sphere sweep: inverse range from several references at once, by semi-global matching.

Every level of inverse range is a sphere round the current camera. Each pixel is compared with
where the references see it if it lies on that sphere (census transform, Zabih and Woodfill 1994),
and the cost is summed over references before paths through the image decide (semi-global matching,
Hirschmüller 2008). No reference is rectified to another: about its own direction of motion a
reference's epipolar curves are its meridians, so a pixel meets one of its rows and the level picks
the column. Done at half size: what it finds is a start or a second opinion, not a measurement.
"""
from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from .frames import Image8, RelativePose
from .jit import kernel, rows_in_parallel
from .sphere import polar_axes
from .warp import Map, PolarGrid, _arctan2, polar_map, resample, with_border

Floats = NDArray[np.float64]
Signature = NDArray[np.uint32]
Volume = NDArray[np.uint16]

_MARGIN = 8
# Of the nearest baseline over range: beyond, a reference sees other sides of things.
_CLOSEST, MOST_LEVELS = 14 / 15, 256
_LEVEL = 1.5  # px of parallax between levels, of the longest baseline in use
REACH = 0.6  # baseline over range up to which a reference takes part: it looks alike
_UNSEEN = 20  # cost of a level for a reference that takes no part
_CONTRAST, _CONTRAST_LIMIT = 4, 12  # eighths of cost a grey level, and the most of it
_BLUR = 15
_LARGE = 1200  # rows: a larger grid is shrunk by more than half
_BANDS = 16  # of columns, for paths across the rows: the same on every machine
# Penalties for a change by one level, and by more: less, from _JUMP to _EDGE, where grey changes.
_STEP, _JUMP, _EDGE, _EDGE_GREY = 10, 200, 40, 8
_FREE = 60000  # beyond the first and the last level


class _Seen(NamedTuple):
    """A reference on a polar grid of its own, about its own direction of motion.

    signature : of that grid's pixels
    row, column : where on it each pixel of the current grid is seen if it is far away
    table : (columns, levels) column that a column moves to at a level
    used : number of levels at which the reference takes part
    """

    signature: Signature
    row: Map
    column: Map
    table: Map
    used: int


def levels(baselines: Sequence[float], pixel: float, step: float = _LEVEL,
           nearest: float = math.inf) -> Floats:
    """Inverse ranges (N,), 1/m, at even steps of parallax of the longest baseline that sees well.

    The first two are beyond infinity: what lies at infinity has neighbours on both sides.
    step : px of parallax between levels
    nearest : 1/m, the last level at the latest
    """
    longest_first = sorted(baselines, reverse=True)
    found = [-2 * step * pixel / longest_first[0]]
    nearest = min(nearest, _CLOSEST / longest_first[-1])
    while found[-1] < nearest and len(found) < MOST_LEVELS:
        usable = [b for b in longest_first if found[-1] * b <= REACH] or longest_first[-1:]
        near = found[-1] * usable[0] > REACH
        found.append(found[-1] + (max(2.0, step) if near else step) * pixel / usable[0])
    return np.array(found)


@kernel
def _signature_rows(first: int, last: int, image: Image8, contrast: Image8,
                    out: Signature) -> None:  # pragma: no cover - compiled
    """Which of the 24 neighbours within two pixels are brighter, and in the last byte contrast."""
    rows, columns = image.shape
    for i in range(first, last):
        for j in range(columns):
            bits = np.uint32(0)
            for di in range(-2, 3):
                ii = min(max(i + di, 0), rows - 1)
                for dj in range(-2, 3):
                    if di == 0 and dj == 0:
                        continue
                    jj = min(max(j + dj, 0), columns - 1)
                    bits = (bits << np.uint32(1)) | np.uint32(image[ii, jj] > image[i, j])
            out[i, j] = (bits << np.uint32(8)) | np.uint32(contrast[i, j])


def signature(image: Image8) -> Signature:
    """Census of each pixel (24 bits) and its contrast with what is round about (the last byte)."""
    mean = cv2.blur(image, (_BLUR, _BLUR))
    contrast = np.asarray(cv2.addWeighted(image, 1.0, mean, -1.0, 128.0), np.uint8)
    out = np.empty(image.shape, np.uint32)
    rows_in_parallel(_signature_rows, len(image), image, contrast, out)
    return out


@kernel
def _place_rows(first: int, last: int, cos_theta: Map, sin_theta: Map, cos_azimuth: Map,
                sin_azimuth: Map, turn: Map, per_pixel: np.float32, margin: np.float32,
                row: Map, column: Map) -> None:  # pragma: no cover - compiled
    """Row and column on a reference's polar grid of every pixel of the current one, if far."""
    round_ = np.float32(2 * np.pi)
    for i in range(first, last):
        for j in range(cos_theta.size):
            x = sin_theta[j] * cos_azimuth[i]
            y = sin_theta[j] * sin_azimuth[i]
            z = cos_theta[j]
            a = turn[0, 0] * x + turn[0, 1] * y + turn[0, 2] * z
            b = turn[1, 0] * x + turn[1, 1] * y + turn[1, 2] * z
            c = turn[2, 0] * x + turn[2, 1] * y + turn[2, 2] * z
            azimuth = _arctan2(b, a)
            azimuth = azimuth + round_ if azimuth < 0 else azimuth
            row[i, j] = azimuth * per_pixel + margin
            column[i, j] = _arctan2(np.sqrt(a * a + b * b), c) * per_pixel + margin


@kernel
def _difference(a: np.uint32, b: np.uint32) -> np.int32:  # pragma: no cover - compiled
    """Cost of two signatures: bits that differ, and grey levels of contrast up to a limit."""
    v = np.uint32(np.uint32(a ^ b) >> np.uint32(8))
    v = np.uint32(v - np.uint32(np.uint32(v >> np.uint32(1)) & np.uint32(0x55555555)))
    v = np.uint32((v & np.uint32(0x33333333))
                  + np.uint32(np.uint32(v >> np.uint32(2)) & np.uint32(0x33333333)))
    v = np.uint32(np.uint32(v + np.uint32(v >> np.uint32(4))) & np.uint32(0x0F0F0F0F))
    bits = np.int32(np.uint32(v * np.uint32(0x01010101)) >> np.uint32(24))
    off = abs(np.int32(a & np.uint32(255)) - np.int32(b & np.uint32(255)))
    off = np.int32(np.int32(off * np.int32(_CONTRAST)) >> np.int32(3))
    return np.int32(bits + bits + min(off, np.int32(_CONTRAST_LIMIT)))


@kernel
def _cost_rows(first: int, last: int, here: Signature, there: Signature, row: Map, column: Map,
               table: Map, used: int, cost: Volume) -> None:  # pragma: no cover - compiled
    """Add one reference's cost at every level to `cost` (rows, columns, levels)."""
    rows, columns = there.shape
    half, end = np.float32(0.5), np.int32(columns - 1)
    met = np.empty(used, np.uint32)
    for i in range(first, last):
        for j in range(here.shape[1]):
            r = min(max(int(row[i, j] + half), 0), rows - 1)
            at = min(max(int(column[i, j] + half), 0), table.shape[0] - 1)
            offset = column[i, j] - np.float32(at) + half
            own = here[i, j]
            for k in range(used):
                c = min(max(np.int32(table[at, k] + offset), np.int32(0)), end)
                met[k] = there[r, c]
            for k in range(used):  # a loop of its own runs in vectors
                cost[i, j, k] += np.uint16(_difference(own, met[k]))
            for k in range(used, cost.shape[2]):
                cost[i, j, k] += np.uint16(_UNSEEN)


@kernel
def _scale_rows(first: int, last: int, volume: Volume, weight: float,
                cost: NDArray[np.uint8]) -> None:  # pragma: no cover - compiled
    for i in range(first, last):
        for j in range(volume.shape[1]):
            for k in range(volume.shape[2]):
                cost[i, j, k] = np.uint8(min(volume[i, j, k] * weight, 255.0))
                volume[i, j, k] = 0


@kernel
def _advance(cost: NDArray[np.uint8], before: NDArray[np.uint16], least: np.uint16, jump: int,
             total: NDArray[np.uint16],
             now: NDArray[np.uint16]) -> np.uint16:  # pragma: no cover - compiled
    """One pixel further along a path: its costs `now`, added to `total`; returns the least."""
    limit = np.uint16(least + jump)
    lowest = np.uint16(65535)
    for k in range(cost.size):
        a = before[k + 1]
        b = min(before[k], before[k + 2]) + _STEP
        a = min(min(a, b), limit)
        v = np.uint16(cost[k] + a - least)
        now[k + 1] = v
        total[k] += v
        lowest = min(lowest, v)
    return lowest


@kernel
def _jump(image: Image8, i: int, j: int, ip: int, jp: int, jump: int,
          edge: int) -> int:  # pragma: no cover - compiled
    step = int(abs(np.int32(image[i, j]) - np.int32(image[ip, jp])))
    return max(edge, jump * _EDGE_GREY // (_EDGE_GREY + step))


@kernel
def _along_rows(first: int, last: int, cost: NDArray[np.uint8], image: Image8,
                total: Volume) -> None:  # pragma: no cover - compiled
    columns, count = cost.shape[1], cost.shape[2]
    a, b = np.empty(count + 2, np.uint16), np.empty(count + 2, np.uint16)
    for i in range(first, last):
        for way in range(2):
            a[:] = 0
            a[0] = a[-1] = b[0] = b[-1] = _FREE
            least = np.uint16(0)
            for n in range(columns):
                j = n if way == 0 else columns - 1 - n
                jp = max(j - 1, 0) if way == 0 else min(j + 1, columns - 1)
                jump = _jump(image, i, j, i, jp, _JUMP, _EDGE)
                least = _advance(cost[i, j], a, least, jump, total[i, j], b)
                a, b = b, a


@kernel
def _across_rows(first: int, last: int, cost: NDArray[np.uint8], image: Image8, slant: int,
                 total: Volume) -> None:  # pragma: no cover - compiled
    """Down and up the rows, each path shifting `slant` columns a row, within some columns."""
    rows, count = cost.shape[0], cost.shape[2]
    a = np.empty((last - first, count + 2), np.uint16)
    b = np.empty((last - first, count + 2), np.uint16)
    least, lowest = np.empty(last - first, np.uint16), np.empty(last - first, np.uint16)
    for way in range(2):
        a[:] = 0
        least[:] = 0
        a[:, 0] = a[:, -1] = b[:, 0] = b[:, -1] = _FREE
        for n in range(rows):
            i = n if way == 0 else rows - 1 - n
            ip = max(i - 1, 0) if way == 0 else min(i + 1, rows - 1)
            for j in range(first, last):
                jp = j - slant if way == 0 else j + slant
                jp = min(max(jp, first), last - 1)
                jump = _jump(image, i, j, ip, jp, _JUMP, _EDGE)
                lowest[j - first] = _advance(cost[i, j], a[jp - first], least[jp - first], jump,
                                             total[i, j], b[j - first])
            a, b = b, a
            least, lowest = lowest, least


@kernel
def _winner_rows(first: int, last: int, total: Volume, level: Map,
                 out: Map) -> None:  # pragma: no cover - compiled
    """The cheapest level of each pixel, between its neighbours by a parabola."""
    count = level.size
    for i in range(first, last):
        for j in range(total.shape[1]):
            lowest = total[i, j, 0]
            for k in range(1, count):
                lowest = min(lowest, total[i, j, k])
            best = 0
            while total[i, j, best] != lowest:
                best += 1
            value = level[best]
            if 0 < best < count - 1:
                left, right = np.float32(total[i, j, best - 1]), np.float32(total[i, j, best + 1])
                bend = left + right - 2 * np.float32(total[i, j, best])
                if bend > 0:
                    shift = np.float32(0.5) * (left - right) / bend
                    side = best + 1 if shift > 0 else best - 1
                    value += abs(shift) * (level[side] - value)
            out[i, j] = value


def reduction(height: int) -> int:
    """By how much a grid of `height` rows is shrunk: to half, or to what fits into memory."""
    return 2 if height <= _LARGE else 4 if height <= 2 * _LARGE else 8


def _shrunk(image: Image8, by: int) -> Image8:
    rows, columns = image.shape  # what is left over is spread evenly
    return np.asarray(cv2.resize(image, (columns // by, rows // by), interpolation=cv2.INTER_AREA))


def _polar_table(grid: PolarGrid, level: Floats, baseline: float) -> Map:
    """Column of the reference's grid for each of its columns (as seen if far) and each level."""
    theta = grid.theta()[:, None]
    moved = np.arctan2(np.sin(theta), np.cos(theta) + level[None] * baseline)
    return np.ascontiguousarray(moved / grid.pixel + grid.margin - 0.5, np.float32)


def _placed(grid: PolarGrid, own_grid: PolarGrid, turn: Floats) -> tuple[Map, Map]:
    """Row and column on a reference's own grid of every pixel of the current one, if far.

    turn : (3, 3) from the current grid's axes to the reference's
    """
    row, column = np.empty(grid.shape, np.float32), np.empty(grid.shape, np.float32)
    theta, azimuth = grid.theta(), grid.azimuth()
    parts = [np.ascontiguousarray(a, np.float32) for a in (
        np.cos(theta), np.sin(theta), np.cos(azimuth), np.sin(azimuth), turn)]
    rows_in_parallel(_place_rows, len(row), *parts, np.float32(1 / own_grid.pixel),
                     np.float32(own_grid.margin - 0.5), row, column)
    return row, column


def _seen(image: Image8, pose: RelativePose, grid: PolarGrid, axes: Floats, level: Floats,
          nearest: bool) -> _Seen:
    """What a reference (its image shrunk like `grid`, the current one) adds to a sweep.

    nearest : it takes part at every level
    """
    own_grid, own_axes = PolarGrid(grid.height, _MARGIN, _MARGIN), polar_axes(pose.direction)
    view = np.asarray(resample(with_border(image), polar_map(
        own_grid, pose.rotation.T @ own_axes, image.shape)), np.uint8)
    used = level.size if nearest else int(np.searchsorted(level, REACH / pose.baseline))
    return _Seen(signature(view), *_placed(grid, own_grid, own_axes.T @ axes),
                 _polar_table(own_grid, level, pose.baseline), used)


def sweep(current: Image8, grid: PolarGrid, axes: Floats,
          references: Sequence[tuple[Image8, RelativePose]]) -> tuple[Map, float]:
    """Inverse range on the current view's polar grid, shrunk by `reduction` (to half as a rule).

    Parameters
    ----------
    current : the current view on `grid` at full size
    grid, axes : that grid (height and margins multiples of the reduction) and its axes (3, 3),
        current optical frame
    references : equirectangular images (H, 2H) and their poses, nearest first

    Returns
    -------
    float32 of the shrunk grid.shape, 1/m, and the step between its far levels, 1/m. Every pixel
    has a value: how far it can be trusted, the caller has to find out.

    """
    by = reduction(grid.height)
    half = PolarGrid(grid.height // by, grid.margin // by, grid.wrap // by)
    view = _shrunk(current, by)
    own = signature(view)
    baselines = [pose.baseline for _, pose in references]
    level = levels(baselines, half.pixel)
    total = np.zeros((*view.shape, level.size), np.uint16)
    for image, pose in references:
        seen = _seen(_shrunk(image, by), pose, half, axes, level, pose is references[0][1])
        rows_in_parallel(_cost_rows, len(total), own, *seen, total)
    cost = np.empty(total.shape, np.uint8)
    rows_in_parallel(_scale_rows, len(total), total, 2.0 / len(references), cost)
    rows_in_parallel(_along_rows, len(total), cost, view, total)
    for slant in (0, 1, -1):
        rows_in_parallel(_across_rows, total.shape[1], cost, view, slant, total,
                         pieces=_BANDS)
    out = np.empty(view.shape, np.float32)
    rows_in_parallel(_winner_rows, len(total), total, level.astype(np.float32), out)
    return cv2.medianBlur(out, 3), float(level[1] - level[0])
