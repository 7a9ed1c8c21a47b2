"""How far a measurement errs, told from what is round about.

What a pixel looks like by itself (`reliability`) does not tell that the sky behind a tree's crown
was given the range of its leaves, or that a whole panel of a car is a mirror: there, everything
fits. The shape of what is round about does. A convolutional network (a U-net, Ronneberger et al.
2015), at half size and run by OpenCV, sees range, grey and what the pixels tell by themselves; its
outputs are the same percentiles. It was fitted to rendered scenes with exact range
(`sphstereo_ros.bench.surroundings`).
"""
from __future__ import annotations

from collections.abc import Sequence
from functools import cache

import numpy as np
from numpy.typing import NDArray

from .alternatives import Alternatives
from .convolutions import Convolutions, of_each_pixel
from .frames import Image8
from .jit import fast_kernel, rows_in_parallel
from .matching import UNKNOWN
from .reliability import TAIL, Look, _geometry, logarithms
from .warp import Map, PolarGrid

CHANNELS = 94
_TOLD = 15  # outputs for each pixel
BLOCK = 32  # px at half size: what the network halves five times
_ROUND = 64  # px at half size that it sees beyond the seam
ADDED = np.float32(0.1)  # px of the shortest baseline, before a parallax's logarithm is taken
_LEAST = np.float32(1e-3)  # px that are told at least
# Inputs that tell how alternatives differ in grey, of four pixels each, and round about; and their
# inverse range.
GREY = (25, 29, 33, 38, 43, 47, 51, 55, 60, 64, 68, 72, 76, 80, 84)
AROUND, SHARES = (89, 90, 91, 92, 93), (37, 42, 59, 88)
ABOVE = np.float32(1.1)  # added to a share, before its logarithm is taken
_LOGARITHMS = (5, 6, 7, 8, 14, 15, 19, 20, 21, 24, *range(25, CHANNELS))  # of the inputs


@fast_kernel
def _input(view: Image8, full: NDArray[np.float32], half: NDArray[np.float32],
           others: tuple[Map, ...], told: NDArray[np.float32], units: Map, sine: Map,
           scale: Map, h: int, w: int, x: Map, p: int) -> None:  # pragma: no cover - compiled
    """Fill column p of `x` (CHANNELS, pixels) of the pixel (h, w) at half size, before logarithms.
    """
    one, quarter = np.float32(1), np.float32(0.25)
    sign = swept = differs = known = moved = np.float32(0)
    nearer = misfit = information = longest = sines = np.float32(0)
    low, high = np.float32(2), np.float32(-2)
    for n in range(4):
        r, c = 2 * h + (n >> 1), 2 * w + (n & 1)
        rho, other, matched = full[0, r, c], full[1, r, c], full[2, r, c]
        unit, s = units[r, c], sine[c]
        per = one / unit
        matches = one if matched != np.float32(UNKNOWN) else np.float32(0)
        pixels = unit * s / scale[0]
        x[n, p] = max(told[0, r, c], told[1, r, c] - np.float32(TAIL))
        nearer += told[2, r, c]
        x[5 + n, p] = np.float32(0.1) + pixels * scale[1]
        sign += min(max(rho * per, -one), one)
        grey = (np.float32(view[r, c]) - np.float32(128)) * np.float32(1 / 64)
        x[10 + n, p] = grey
        low, high = min(low, grey), max(high, grey)
        swept += max(other * s / scale[0] * scale[1], np.float32(0))
        differs += min(max((rho - other) * per, np.float32(-2)), np.float32(1.5))
        known += matches
        moved += matches * min(max((rho - matched) * per, np.float32(-2)), np.float32(1.5))
        misfit += full[3, r, c]
        information += full[4, r, c] * unit * unit
        longest += pixels * scale[2]
        sines += s
        for k in range(len(GREY)):
            x[GREY[k] + n, p] = np.float32(2) + others[k][r, c]
    x[4, p], x[9, p] = quarter * nearer, quarter * sign
    x[14, p] = np.float32(0.5) + half[12, h, w]
    x[15, p] = np.float32(0.1) + quarter * swept
    x[16, p], x[17, p], x[18, p] = quarter * differs, quarter * known, quarter * moved
    x[19, p] = np.float32(4) + quarter * misfit
    x[20, p] = np.float32(0.01) + quarter * information
    x[21, p] = np.float32(0.1) + quarter * longest
    x[22, p], x[23, p] = quarter * sines, high - low
    x[24, p] = np.float32(0.05) + half[13, h, w]
    for k in range(len(SHARES)):
        share = others[len(GREY) + k][2 * h, 2 * w] / units[2 * h, 2 * w]
        x[SHARES[k], p] = ABOVE + min(max(share, -one), np.float32(20))
    for k in range(len(AROUND)):
        x[AROUND[k], p] = np.float32(2) + others[len(GREY) + len(SHARES) + k][h, w]


@fast_kernel
def _input_rows(first: int, last: int, view: Image8, full: NDArray[np.float32],
                half: NDArray[np.float32], others: tuple[Map, ...],
                told: NDArray[np.float32], units: Map, sine: Map, scale: Map, wrap: int,
                out: NDArray[np.float32]) -> None:  # pragma: no cover - compiled
    """Rows of `out` (1, CHANNELS, …): half size, on round the sphere, at the end as the last.

    By blocks of pixels: rows of channels lie a power of two apart, and push each other out of
    the cache.
    """
    rows, columns = half.shape[1], half.shape[2]
    x = np.empty((CHANNELS, BLOCK), np.float32)
    for i in range(first, last):
        h = (i - _ROUND - wrap) % (rows - 2 * wrap) + wrap
        for start in range(0, out.shape[3], BLOCK):
            for p in range(BLOCK):
                _input(view, full, half, others, told, units, sine, scale, h,
                       min(start + p, columns - 1), x, p)
            logarithms(x, _LOGARITHMS)
            for p in range(BLOCK):
                x[14, p] -= np.float32(1)
                x[19, p] = np.float32(0.7) * (x[19, p] - np.float32(3))
                x[20, p] *= np.float32(0.2)
                x[21, p] *= np.float32(0.5)
                x[24, p] += np.float32(1)
                for k in range(len(GREY)):
                    for n in range(4):
                        x[GREY[k] + n, p] -= np.float32(2)
                for k in range(len(AROUND)):
                    x[AROUND[k], p] -= np.float32(2)
            for k in range(CHANNELS):
                for p in range(BLOCK):
                    out[0, k, i, start + p] = x[k, p]


def inputs(view: Image8, seen: Look, others: Alternatives, told: NDArray[np.float32], unit: Map,
           grid: PolarGrid, baselines: Sequence[float]) -> NDArray[np.float32]:
    """What the network sees: float32 (1, CHANNELS, rows, columns), half the grid's size and more,
    so that it can be halved again and goes on beyond the seam.

    Parameters
    ----------
    view : the current view on `grid`
    seen : of `reliability.look`
    others : of `alternatives.alternatives`
    told, unit : of `reliability.percentiles`
    grid, baselines : the polar grid; of the references, m

    """
    rows, columns = seen.half.shape[1:]
    size = [-(-n // BLOCK) * BLOCK for n in (rows + 2 * _ROUND, columns)]
    out = np.empty((1, CHANNELS, *size), np.float32)
    each = (others.measured, others.near, others.far, others.farther, others.swept)
    measured, near, far, farther, swept = (other.agreement for other in each)
    maps = (measured.least, measured.most, near.least, far.least, near.most, far.most,
            farther.least, farther.most, measured.typical, near.typical, far.typical,
            farther.typical, swept.least, swept.most, swept.typical,
            *(other.rho for other in each[1:]), *(other.agreement.around for other in each))
    rows_in_parallel(_input_rows, size[0], view, seen.full, seen.half, maps, told, unit,
                     *_geometry(grid, baselines), grid.wrap // 2, out)
    return out


def interior(maps: NDArray[np.float32], shape: tuple[int, ...]) -> NDArray[np.float32]:
    """Of maps as large as `inputs`, what lies on the polar grid of `shape`, at half its size."""
    rows, columns = (n // 2 for n in shape)
    return maps[:, :, _ROUND:_ROUND + rows, :columns]


@cache
def _network() -> Convolutions:
    return Convolutions('surroundings.onnx')


def judged(x: NDArray[np.float32], shape: tuple[int, ...]) -> NDArray[np.float32]:
    """The network's outputs: float32 (15, *shape); three as of `reliability.percentiles`, the
    logarithms by which two parallaxes of its own are larger than the measured one, the same three
    of what `likeliest` gives, and seven by which that is chosen.

    x : of `inputs`
    shape : of the polar grid
    """
    return of_each_pixel(interior(_network()(x), shape), _TOLD)


@fast_kernel
def _own(told: np.float32, unit: np.float32,
         pixel: np.float32) -> np.float32:  # pragma: no cover - compiled
    """Inverse range of a parallax of the network's own; pixel : inverse range of a px of it."""
    return np.float32(max((ADDED + unit / pixel) * np.exp(told) - ADDED, _LEAST) * pixel)


@fast_kernel
def _likeliest_rows(first: int, last: int, told: NDArray[np.float32], unit: Map, measured: Map,
                    near: Map, far: Map, farther: Map, swept: Map, pixel: Map, baselines: Map,
                    out: Map, its_unit: Map) -> None:  # pragma: no cover - compiled
    for i in range(first, last):
        for j in range(out.shape[1]):
            best = 0
            for k in range(1, 7):
                if told[8 + k, i, j] > told[8 + best, i, j]:
                    best = k
            if best == 0:
                rho = measured[i, j]
            elif best == 1:
                rho = near[i, j]
            elif best == 2:
                rho = far[i, j]
            elif best == 3:
                rho = farther[i, j]
            elif best == 5:
                rho = swept[i, j]
            else:
                own = told[3, i, j] if best == 4 else told[4, i, j]
                rho = _own(own, unit[i, j], pixel[j] / baselines[0])
            out[i, j] = rho
            its_unit[i, j] = max(rho, pixel[j] / baselines[1])


def likeliest(told: NDArray[np.float32], unit: Map, others: Alternatives, grid: PolarGrid,
              baselines: Sequence[float]) -> tuple[Map, Map]:
    """The inverse range that is likeliest by what is round about, and its unit, 1/m: what was
    measured or swept, what lies nearest or farthest round about, or one of the network's own.

    told : of `judged`; unit : of `reliability.percentiles`; others : to what was measured

    Raises ValueError where other than those outputs are told: a kernel would read beyond them.
    """
    if len(told) != _TOLD:
        raise ValueError(f'{len(told)} outputs, not {_TOLD}')
    sine, scale = _geometry(grid, baselines)
    rho, its_unit = np.empty_like(unit), np.empty_like(unit)
    rows_in_parallel(_likeliest_rows, len(unit), told, unit, others.measured.rho, others.near.rho,
                     others.far.rho, others.farther.rho, others.swept.rho, scale[0] / sine,
                     scale[1:], rho, its_unit)
    return rho, its_unit
