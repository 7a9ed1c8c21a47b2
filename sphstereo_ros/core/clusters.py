"""Things: pixels side by side whose distances agree, large enough together to be believed."""
from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from .jit import kernel
from .warp import Map

Counts = NDArray[np.int32]

_ALIKE = 1.1  # ratio of the distances of neighbours that belong together
# The smallest thing that is believed: m² that face the camera, and pixels.
_AREA, _PIXELS = 0.015, 6
# and what of it a column must show.
_IN_COLUMN, _LEAST = 0.003, 3
_QUANTILE = 0.15  # of a thing's pixels in a column are nearer than what is told
_STEP = 0.005  # relative width of the bins of distance


def bins_between(nearest: float, farthest: float) -> int:
    """How many bins of distance there are."""
    return 2 + int(math.log(farthest / nearest) / _STEP)


def bin_middle(place: NDArray[np.intp], nearest: float) -> NDArray[np.float64]:
    """Metres; bin 0 is all that is nearer than `nearest`."""
    return np.asarray(nearest * np.exp(np.maximum(place - 0.5, 0) * _STEP))


@kernel
def nearest_things(flat: Map, column: NDArray[np.int16], rows: Map, nearest: float, farthest: float,
                   out: Counts, doubt: NDArray[np.float64],
                   believed: NDArray[np.bool_]) -> None:  # pragma: no cover - compiled
    """Bin of the nearest thing in each column; −1 where there is none.

    Parameters
    ----------
    flat, column : as `survey` fills them; `flat` is used up
    rows : (H, 2) cosine of the latitude first
    out : (C,) filled
    doubt : (C,) filled: m² of pixels that are too few to be believed, six at least for _AREA
    believed : (H, 2H) filled: pixels of things

    """
    height, width = flat.shape
    pixel = math.pi / height
    bins = 2 + int(math.log(farthest / nearest) / _STEP)
    counts = np.zeros((out.size, bins), np.int32)
    lowest, highest = np.full(out.size, bins, np.int32), np.full(out.size, -1, np.int32)
    total = np.zeros(out.size, np.int32)
    stack = np.empty(flat.size, np.int32)
    away = np.empty(flat.size, np.float32)
    out[:] = -1
    doubt[:] = 0
    believed[:] = False
    for start in range(flat.size):
        if flat[start // width, start % width] <= 0:
            continue
        # Flood from here: what is taken is set to 0 in `flat`, and kept in `stack` and `away`.
        size, next_one, area = 1, 0, 0.0
        stack[0], away[0] = start, flat[start // width, start % width]
        flat[start // width, start % width] = 0
        while next_one < size:
            i, j, d = stack[next_one] // width, stack[next_one] % width, away[next_one]
            next_one += 1
            area += rows[i, 0] * d * d
            for y in range(max(i - 1, 0), min(i + 2, height)):
                for k in range(j - 1, j + 2):
                    x = k if 0 <= k < width else (k + width) % width
                    other = flat[y, x]
                    if other > 0 and other < _ALIKE * d and d < _ALIKE * other:
                        stack[size], away[size] = y * width + x, other
                        flat[y, x] = 0
                        size += 1
        if size < _PIXELS or area * pixel * pixel < _AREA:
            for k in range(size):
                i, j = stack[k] // width, stack[k] % width
                doubt[column[i, j]] += min(rows[i, 0] * (away[k] * pixel)**2, _AREA / _PIXELS)
            continue
        first, last = out.size, -1
        for k in range(size):
            i, j = stack[k] // width, stack[k] % width
            believed[i, j] = True
            at, place = column[i, j], 0
            if away[k] >= nearest:
                place = min(1 + int(math.log(away[k] / nearest) / _STEP), bins - 1)
            counts[at, place] += 1
            total[at] += 1
            lowest[at], highest[at] = min(lowest[at], place), max(highest[at], place)
            first, last = min(first, at), max(last, at)
        for at in range(first, last + 1):
            run, needed, found = 0, _QUANTILE * total[at], -1
            for place in range(lowest[at], highest[at] + 1):
                run += counts[at, place]
                counts[at, place] = 0
                if found < 0 and run > needed:
                    found = place
            seen = total[at] * pixel * pixel * math.exp(2 * found * _STEP) * nearest * nearest
            if found >= 0 and total[at] >= _LEAST and seen > _IN_COLUMN and (out[at] < 0 or found < out[at]):
                out[at] = found
            lowest[at], highest[at], total[at] = bins, -1, 0
