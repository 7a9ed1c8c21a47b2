"""Things: pixels side by side whose distances agree, large enough together to be believed."""
from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from .jit import kernel
from .warp import Map

Counts = NDArray[np.int32]
Columns = NDArray[np.int16]

_ALIKE = 1.1  # ratio of the distances of neighbours that belong together
# The smallest thing that is believed: m² that face the camera, and pixels; and what of it a
# column must show: so many m², or pixels of its whole width up to such a height (m).
_AREA, _PIXELS = 0.015, 6
_AREA_IN_COLUMN, _HEIGHT_IN_COLUMN, _PIXELS_IN_COLUMN = 0.003, 0.03, 3
_QUANTILE = 0.1  # of a thing's pixels in a column are nearer than what is told
_STEP = 0.005  # relative width of the bins of distance


def bin_middle(place: NDArray[np.int32], nearest: float) -> NDArray[np.float64]:
    """Metres; bin 0 is all that is nearer than `nearest`."""
    return np.asarray(nearest * np.exp(np.maximum(place - 0.5, 0) * _STEP))


def nearest_things(flat: Map, column: Columns, cosines: Map, nearest: float, farthest: float,
                   columns: int) -> tuple[Counts, NDArray[np.float64], NDArray[np.bool_]]:
    """Where the nearest thing is in each column of azimuth.

    Parameters
    ----------
    flat, column : (H, 2H) as `survey` fills them; `flat` is used up
    cosines : (H,) of the latitudes
    nearest, farthest : metres
    columns : how many

    Returns
    -------
    (C,) bin of the nearest thing, −1 where there is none; (C,) m² of pixels that are too few to
    be believed; (H, 2H) the pixels of things.

    """
    bins = 2 + int(math.log(farthest / nearest) / _STEP)
    found, doubt = np.full(columns, -1, np.int32), np.zeros(columns)
    believed = np.zeros(flat.shape, np.bool_)
    _scan(flat, column, cosines, nearest, np.zeros((columns, bins), np.int32), found, doubt,
          believed)
    return found, doubt, believed


@kernel
def _scan(flat: Map, column: Columns, cosines: Map, nearest: float, counts: Counts, found: Counts,
          doubt: NDArray[np.float64],
          believed: NDArray[np.bool_]) -> None:  # pragma: no cover - compiled
    height, width = flat.shape
    pixel = math.pi / height
    places, away = np.empty(flat.size, np.int32), np.empty(flat.size, np.float32)
    for i in range(height):
        for j in range(width):
            if flat[i, j] <= 0:
                continue
            size = _flood(flat, i, j, places, away)
            area = 0.0
            for k in range(size):
                area += cosines[places[k] // width] * (away[k] * pixel)**2
            if size >= _PIXELS and area >= _AREA:
                _tell(places[:size], away[:size], column, pixel, nearest, counts, found, believed)
                continue
            for k in range(size):
                y, x = places[k] // width, places[k] % width
                doubt[column[y, x]] += min(cosines[y] * (away[k] * pixel)**2, _AREA / _PIXELS)


@kernel
def _flood(flat: Map, i: int, j: int, places: Counts,
           away: Map) -> int:  # pragma: no cover - compiled
    """Take the thing at (i, j) out of `flat`: its pixels and distances, and how many there are."""
    height, width = flat.shape
    places[0], away[0] = i * width + j, flat[i, j]
    flat[i, j] = 0
    size, done = 1, 0
    while done < size:
        i, j, d = places[done] // width, places[done] % width, away[done]
        done += 1
        for y in range(max(i - 1, 0), min(i + 2, height)):
            for k in range(j - 1, j + 2):
                x = k if 0 <= k < width else (k + width) % width
                other = flat[y, x]
                if other > 0 and other < _ALIKE * d and d < _ALIKE * other:
                    places[size], away[size] = y * width + x, other
                    flat[y, x] = 0
                    size += 1
    return size


@kernel
def _tell(places: Counts, away: Map, column: Columns, pixel: float, nearest: float,
          counts: Counts, found: Counts,
          believed: NDArray[np.bool_]) -> None:  # pragma: no cover - compiled
    """Enter a thing: in each of its columns, where its near pixels are. `counts` stays zero."""
    width, bins = column.shape[1], counts.shape[1]
    first, last, lowest, highest = counts.shape[0], -1, bins, 0
    for k in range(places.size):
        y, x = places[k] // width, places[k] % width
        believed[y, x] = True
        at, place = column[y, x], 0
        if away[k] >= nearest:
            place = min(1 + int(math.log(away[k] / nearest) / _STEP), bins - 1)
        counts[at, place] += 1
        first, last = min(first, at), max(last, at)
        lowest, highest = min(lowest, place), max(highest, place)
    for at in range(first, last + 1):
        total, run, place = 0, 0, lowest
        for k in range(lowest, highest + 1):
            total += counts[at, k]
        if total == 0:
            continue
        while run <= _QUANTILE * total:
            run += counts[at, place]
            place += 1
        counts[at, lowest:highest + 1] = 0
        distance = nearest * math.exp((place - 1) * _STEP)
        strip = distance * 2 * math.pi / counts.shape[0] * _HEIGHT_IN_COLUMN
        enough = (total >= _PIXELS_IN_COLUMN
                  and total * (pixel * distance)**2 >= min(_AREA_IN_COLUMN, strip))
        if enough and (found[at] < 0 or place - 1 < found[at]):
            found[at] = place - 1
