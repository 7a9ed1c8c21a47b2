"""What is free: where nothing worth mentioning could stand unseen.

At some distances, a thin thing is put at every place in turn: before so many pixels must be
measured as farther, or it could hide there.
"""
from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .config import ObstaclesConfig
from .ground import Ground
from .jit import kernel
from .sectors import FIRST_SECTOR, SECTOR_WIDTH, SECTORS

Counts = NDArray[np.int32]
Floats = NDArray[np.float64]

STEEPEST = math.radians(60)  # elevations beyond are not looked at
_STEPS, _RATIO, _NEAREST = 8, 1.5, 0.5  # distances at which that is asked
# Sky: from that elevation on; columns beside that are looked at; share of stray pixels.
_SKY, _BESIDE, _STRAY = math.radians(11), 2, 0.02
_ROUNDING = 1e-6  # of a column: what lies between two goes to one side, wherever it is
_LEAST_ROOM = 0.05  # m between ground and the top of the band


def distances_asked(maximum: float) -> Floats:
    """Metres at which things could hide, rising, the last `maximum`."""
    steps = maximum / _RATIO ** np.arange(_STEPS)[::-1]
    return np.asarray(steps[steps >= min(_NEAREST, maximum)])


@dataclass(frozen=True)
class Hidden:
    """What is asked to be hidden: metres wide and high (beyond `far`, of the size it has there in
    the picture), the share of its pixels that must be farther to say no, whether what may be sky
    counts as farther, and the nearest distance at which it is looked for.
    """

    width: float
    height: float
    far: float
    clear: float
    trust_sky: bool
    nearest: float = 0.0


def hiding_place(seen: Counts, distances: Floats, thing: Hidden, limits: ObstaclesConfig,
                 ground: Ground | None, camera: Floats, cell: float) -> Floats:
    """The least of `distances` at which `thing` could hide in each sector (72,); inf: at none.

    Parameters
    ----------
    seen : (len(distances) + 2, E, C) weight of the pixels by how many of the distances they are
        certainly farther than (the last: unknown), by elevation from −60° up in steps of `cell`
        rad, and by azimuth clockwise from the edge of the first sector
    camera : (3,) its position in the level frame

    """
    plane = (0.0, 0.0, -math.inf) if ground is None else (*ground.slope, ground.height)
    bounds = np.array([-limits.height_below, limits.height_above, limits.ground_clearance])
    asked = np.array([thing.width, thing.height, thing.far, thing.clear, thing.nearest])
    return np.append(distances, np.inf)[_hiding(seen, distances, asked, bounds, np.array(plane),
                                                camera, cell, thing.trust_sky)]


@kernel
def _sums(layer: Counts, first: int, last: int,
          out: NDArray[np.int64]) -> None:  # pragma: no cover - compiled
    """Summed area table (E + 1, C + 1) of the rows first … last of (E, C)."""
    out[first] = 0
    for e in range(first, last):
        run = 0
        for c in range(layer.shape[1]):
            run += layer[e, c]
            out[e + 1, c + 1] = out[e, c + 1] + run


@kernel
def _within(sums: NDArray[np.int64], e0: int, e1: int, c0: int,
            c1: int) -> int:  # pragma: no cover - compiled
    """Of columns c0 … c1, which may go once round."""
    columns = sums.shape[1] - 1
    if c1 <= columns:
        return int(sums[e1, c1] - sums[e0, c1] - sums[e1, c0] + sums[e0, c0])
    beyond = sums[e1, c1 - columns] - sums[e0, c1 - columns]
    return int(sums[e1, columns] - sums[e0, columns] - sums[e1, c0] + sums[e0, c0] + beyond)


@kernel
def _rows_asked(low: float, high: float, near: float, far: float, cell: float,
                rows: int) -> tuple[int, int]:  # pragma: no cover - compiled
    """The cells of elevation that things between two heights, near … far from the camera, have.

    low, high : metres above the camera
    """
    first = min(math.atan2(low, near), math.atan2(low, far))
    last = max(math.atan2(high, near), math.atan2(high, far))
    return (min(max(math.floor((first + STEEPEST) / cell), 0), rows),
            min(max(math.ceil((last + STEEPEST) / cell), 0), rows))


@kernel
def _hides(sums: NDArray[np.int64], clear: NDArray[np.int64], angle: float, distance: float,
           size: Floats, share: float, low: float, high: float, up: float,
           cell: float) -> bool:  # pragma: no cover - compiled
    """Whether a thing of `size` could hide in front, between two heights.

    angle : of its middle, in columns; distance : from the camera; up : height of the camera
    """
    rows, columns = sums.shape[0] - 1, sums.shape[1] - 1
    wide = min(max(1, round(size[0] / distance * columns / (2 * np.pi))), columns)
    c0 = math.floor(angle - 0.5 * wide + 0.5 + _ROUNDING) % columns
    tall = min(size[1], high - low)
    steps = max(1, math.ceil(2 * (high - low - tall) / tall - 1e-9) + 1)
    for k in range(steps):
        bottom = low + (high - low - tall) * (k / (steps - 1) if steps > 1 else 0.0)
        e0 = math.floor((math.atan2(bottom - up, distance) + STEEPEST) / cell + 0.25)
        e1 = math.ceil((math.atan2(bottom + tall - up, distance) + STEEPEST) / cell - 0.25)
        e0, e1 = max(int(e0), 0), min(int(e1), rows)
        if e1 <= e0:
            continue
        total = _within(sums, e0, e1, c0, c0 + wide)
        if total <= 0 or _within(clear, e0, e1, c0, c0 + wide) < share * total:
            return True
    return False


@kernel
def _with_sky(farther: Counts, known: Counts, unknown: Counts,
              horizon: int) -> Counts:  # pragma: no cover - compiled
    """What is farther, and what is unknown above `horizon` where all that is known is farther.

    A plain sky has no range. What could stand before it would have to hang in the air, and show
    no edge.
    """
    rows, columns = farther.shape
    out = farther.copy()
    nearer = np.zeros(columns)
    whole = np.zeros(columns)
    for e in range(horizon, rows):
        for c in range(columns):
            nearer[c] += known[e, c] - farther[e, c]
            whole[c] += known[e, c] + unknown[e, c]
    for c in range(columns):
        near, total = 0.0, 0.0
        for k in range(c - _BESIDE, c + _BESIDE + 1):
            near += nearer[(k + columns) % columns]
            total += whole[(k + columns) % columns]
        if near <= _STRAY * total:
            out[horizon:, c] += unknown[horizon:, c]
    return out


@kernel
def _hiding(seen: Counts, distances: Floats, asked: Floats, bounds: Floats, plane: Floats,
            camera: Floats, cell: float,
            trust_sky: bool) -> NDArray[np.intp]:  # pragma: no cover - compiled
    layers, rows, columns = seen.shape
    horizon = int((STEEPEST + _SKY) / cell) + 1
    sums, clear = np.zeros((2, rows + 1, columns + 1), np.int64)
    known, unknown = np.zeros((rows, columns), np.int32), seen[layers - 1]
    for layer in range(layers - 1):
        known += seen[layer]
    farther = known.copy()
    _sums(known + unknown, 0, rows, sums)
    aside = math.hypot(camera[0], camera[1])
    out = np.full(SECTORS, layers - 2)
    for k in range(layers - 2):
        farther -= seen[k]  # what is left is farther than distances[k]
        if distances[k] < asked[4]:
            continue
        first, last = _rows_asked(bounds[0] - camera[2], bounds[1] - camera[2],
                                  max(distances[k] - aside, 0.05), distances[k] + aside, cell,
                                  rows)
        _sums(_with_sky(farther, known, unknown, horizon) if trust_sky and last > horizon
              else farther, first, last, clear)
        size = asked[:2] * max(1.0, distances[k] / asked[2])
        for column in range(columns):
            sector = column * SECTORS // columns
            if out[sector] < layers - 2:
                continue
            azimuth = FIRST_SECTOR - 0.5 * SECTOR_WIDTH + (column + 0.5) * 2 * np.pi / columns
            x, y = distances[k] * math.cos(azimuth), -distances[k] * math.sin(azimuth)
            low = max(bounds[0], plane[0] * x + plane[1] * y + plane[2] + bounds[2])
            if bounds[1] - low < _LEAST_ROOM:
                continue
            x, y = x - camera[0], y - camera[1]
            turned = math.atan2(-y, x) - FIRST_SECTOR + 0.5 * SECTOR_WIDTH
            if _hides(sums, clear, turned * columns / (2 * np.pi), max(math.hypot(x, y), 0.05),
                      size, asked[3], low, bounds[1], camera[2], cell):
                out[sector] = k
    return out
