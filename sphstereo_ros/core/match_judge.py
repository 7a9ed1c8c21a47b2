"""How far the match of one pair errs, and what it misses, told from what is round about: for
small computers.

Block matching finds something wrong, or nothing, on blank walls, beside rims, in the sky between
leaves. What a match looks like by itself does not tell, the shape of what is round about does. A
convolutional network sees parallax, grey, and what the reference shows where the match lies, at a
quarter of the size; for each pixel at half size it tells percentiles of the parallax's error, and
completes: the parallax that what is round about suggests, with percentiles of its error, too.
It was fitted to rendered scenes with exact range (`sphstereo_ros.bench.match_judge`).
"""
from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray

from .convolutions import Convolutions
from .frames import Image8
from .jit import fast_kernel, rows_in_parallel
from .matching import MARGIN, UNKNOWN, Matcher, Parallax
from .reliability import LEAST, logarithms
from .warp import Map

CHANNELS = 20
_TOLD = 7  # outputs for each pixel at half size
BLOCK = 32  # px at a quarter of the size: what the network halves five times
_FINER = 4  # px at half size, each way, that the network tells of by one of its own
ROUND = 32  # px at a quarter of the size that it sees beyond the seam
_LOGARITHMS = (0, 1, 2, 3, 12, 13, 14, 15, 16, 17)  # of the inputs
# Of the unit: a likely error with which a match stands, and what may be nearer with which not.
_SURE, _NEARER = 0.25, 0.25
_NEAR = 1 / 40  # rad at right angles to the motion: nearer than that matters (40 baselines)
CONTRADICTS = 6.0  # grey levels by which the reference differs from what was completed
TAIL = 0.75  # logarithm of how many standard deviations the 95th percentile may be away


@fast_kernel
def _look_along(current: Image8, reference: Image8, pixels: Map, r: int,
                out: Map) -> None:  # pragma: no cover - compiled
    """Of every second pixel of row r: parallax, whether it is known, grey, and by how much the
    reference differs there; `out` (4, columns // 2).

    Of four pixels two across stand for all: what was matched varies slowly.
    """
    one, end = np.float32(1), np.float32(current.shape[1] - 1.001)
    for q in range(out.shape[1]):
        c = 2 * q + (r & 1)
        here, d = np.float32(current[r, c]), pixels[r, c]
        known = one if d != np.float32(UNKNOWN) else np.float32(0)
        at = min(max(np.float32(c) - known * d, np.float32(0)), end)
        left = np.int32(at)
        share = at - np.float32(left)
        there = (np.float32(reference[r, left]) * (one - share)
                 + np.float32(reference[r, left + 1]) * share)
        out[0, q], out[1, q], out[2, q] = known * d, known, here
        out[3, q] = known * abs(here - there)


@fast_kernel
def _inputs_of_row(seen: NDArray[np.float32], sigma: Map, sine: Map, h: int,
                   x: Map) -> None:  # pragma: no cover - compiled
    """Fill `x` (CHANNELS, columns) of row h at a quarter of the size from what was `seen` along
    its four pixel rows, before logarithms.
    """
    half, one = np.float32(0.5), np.float32(1)
    for n in range(4):
        a, b = seen[2 * (n >> 1)], seen[2 * (n >> 1) + 1]
        for p in range(x.shape[1]):
            q = 2 * p + (n & 1)
            known = a[1, q] + b[1, q]
            count = max(known, one)
            x[n, p] = half + (a[0, q] + b[0, q]) / count
            x[4 + n, p] = half * known
            x[8 + n, p] = (half * (a[2, q] + b[2, q]) - np.float32(128)) * np.float32(1 / 64)
            x[12 + n, p] = np.float32(2) + (a[3, q] + b[3, q]) / count
    for p in range(x.shape[1]):
        most, least, spread = np.float32(0), np.float32(1e6), np.float32(0)
        low, high = np.float32(255), np.float32(0)
        for k in range(8):
            row, q = seen[k >> 1], 2 * p + (k & 1)
            most = max(most, row[0, q])
            least = min(least, row[0, q] if row[1, q] > 0 else least)
            low, high = min(low, row[2, q]), max(high, row[2, q])
        for k in range(4):
            spread += np.float32(0.25) * sigma[2 * h + (k >> 1), 2 * p + (k & 1)]
        x[16, p] = (half + most) / (half + min(least, most))
        x[17, p] = np.float32(0.05) + spread
        x[18, p] = sine[4 * p + 2]
        x[19, p] = (high - low) * np.float32(1 / 64)


@fast_kernel
def _input_rows(first: int, last: int, current: Image8, reference: Image8, pixels: Map,
                sigma: Map, sine: Map, wrap: int,
                out: NDArray[np.float32]) -> None:  # pragma: no cover - compiled
    """Rows of `out` (1, CHANNELS, …): on round the sphere, at the end as the last."""
    rows, columns = current.shape[0] // 4, current.shape[1] // 4
    seen = np.empty((4, 4, 2 * columns), np.float32)
    x = np.empty((CHANNELS, columns), np.float32)
    for i in range(first, last):
        h = (i - ROUND - wrap) % (rows - 2 * wrap) + wrap
        for k in range(4):
            _look_along(current, reference, pixels, 4 * h + k, seen[k])
        _inputs_of_row(seen, sigma, sine, h, x)
        logarithms(x, _LOGARITHMS)
        for k in range(CHANNELS):
            less = np.float32(2) if 12 <= k < 16 else np.float32(0)
            for p in range(out.shape[3]):
                out[0, k, i, p] = x[k, min(p, columns - 1)] - less


def _sine(columns: int) -> Map:
    """Of the polar angle of each column of a grid with MARGIN."""
    theta = (np.arange(columns) - MARGIN + 0.5) * np.pi / (columns - 2 * MARGIN)
    return np.abs(np.sin(theta)).astype(np.float32)


def inputs(current: Image8, reference: Image8, found: Parallax) -> NDArray[np.float32]:
    """What the network sees: float32 (1, CHANNELS, rows, columns), a quarter of the grid's size
    and more, so that it can be halved again and goes on beyond the seam.

    Parameters
    ----------
    current, reference : views on one polar grid with MARGIN on all sides
    found : what was matched

    """
    rows, columns = (n // 4 for n in current.shape)
    size = [-(-n // BLOCK) * BLOCK for n in (rows + 2 * ROUND, columns)]
    out = np.empty((1, CHANNELS, *size), np.float32)
    rows_in_parallel(_input_rows, size[0], current, reference, found.pixels, found.sigma,
                     _sine(current.shape[1]), MARGIN // 4, out)
    return out


@cache
def _network() -> Convolutions:
    return Convolutions('match_judge.onnx')


@fast_kernel
def _spread_rows(first: int, last: int, out: NDArray[np.float32],
                 whole: NDArray[np.float32]) -> None:  # pragma: no cover - compiled
    """Rows of `whole` from the network's outputs: of a kind sixteen, of four by four pixels."""
    for k in range(_TOLD):
        for i in range(first, last):
            kind, row = _FINER * (_FINER * k + i % _FINER), (i + 2 * ROUND) // _FINER
            for j in range(whole.shape[2]):
                whole[k, i, j] = out[kind + j % _FINER, row, j // _FINER]


def told(x: NDArray[np.float32], shape: tuple[int, ...]) -> NDArray[np.float32]:
    """The network's outputs, float32 (7, rows // 2, columns // 2) of the grid's `shape`:
    logarithms of the 68th and 95th percentile of the parallax's error, and of the 98th of how much
    larger it may be, as a share of the parallax (at least of a pixel), with LEAST added; the
    logarithm of the completed parallax and half a pixel; and the same three of its error.
    """
    whole = np.empty((_TOLD, shape[0] // 2, shape[1] // 2), np.float32)
    rows_in_parallel(_spread_rows, whole.shape[1], _network()(x)[0], whole)
    return whole


@fast_kernel
def likely_error(told: NDArray[np.float32], k: int, i: int, j: int,
            tail: np.float32) -> np.float32:  # pragma: no cover - compiled
    """Standard deviation as a share, from percentiles k and k + 1."""
    least = np.float32(LEAST)
    return max(max(np.exp(told[k, i, j]) - least, (np.exp(told[k + 1, i, j]) - least) * tail),
               np.float32(0))


@fast_kernel
def _stands(pixels: np.float32, likely: np.float32, nearer: np.float32,
            near: np.float32) -> bool:  # pragma: no cover - compiled
    """Whether so many are right as a rule, and nothing near is missed."""
    hides = nearer > np.float32(_NEARER) and (
        pixels + nearer * max(pixels, np.float32(1)) > near)
    return bool(pixels != np.float32(UNKNOWN) and likely <= np.float32(_SURE) and not hides)


@fast_kernel
def shows_the_same(current: Image8, reference: Image8, r: int, c: int, pixels: np.float32,
                   most: float = CONTRADICTS) -> bool:  # pragma: no cover - compiled
    """Whether the reference differs by so many grey levels at most, if that is the parallax."""
    end = np.float32(current.shape[1] - 1.001)
    at = min(max(np.float32(c) - pixels, np.float32(0)), end)
    left = np.int32(at)
    share = at - np.float32(left)
    there = (np.float32(reference[r, left]) * (np.float32(1) - share)
             + np.float32(reference[r, left + 1]) * share)
    return bool(abs(np.float32(current[r, c]) - there) <= np.float32(most))


@fast_kernel
def _judge_rows(first: int, last: int, current: Image8, reference: Image8,
                told: NDArray[np.float32], sine: Map, near: np.float32, tail: np.float32,
                sigma: Map, pixels: Map) -> None:  # pragma: no cover - compiled
    """`pixels` become what was found, or completed where that is likelier, or UNKNOWN where both
    are too uncertain; `sigma` (at half size) is what is told of them.
    """
    unknown, least, one = np.float32(UNKNOWN), np.float32(LEAST), np.float32(1)
    for i in range(first, last):
        for j in range(sigma.shape[1]):
            likely = likely_error(told, 0, i, j, tail)
            likely_completed = likely_error(told, 4, i, j, tail)
            nearer, nearer_completed = np.exp(told[2, i, j]) - least, np.exp(told[6, i, j]) - least
            completed = max(np.exp(told[3, i, j]) - np.float32(0.5), np.float32(0.01))
            widest = np.float32(0.02)
            for k in range(4):
                r, c = 2 * i + (k >> 1), 2 * j + (k & 1)
                d, bound = pixels[r, c], near * sine[c]
                found = _stands(d, likely, nearer, bound)
                other = _stands(completed, likely_completed, nearer_completed, bound) and (
                    shows_the_same(current, reference, r, c, completed))
                if other and (not found or likely_completed * max(completed, one)
                              < likely * max(d, one)):
                    pixels[r, c] = completed
                    widest = max(widest, likely_completed * max(completed, one))
                elif found:
                    widest = max(widest, likely * max(d, one))
                else:
                    pixels[r, c] = unknown
            sigma[i, j] = widest


def judged_matcher(match: Matcher) -> Matcher:
    """`match`, completed, of which only stands what is right as a rule, with its error.

    The views' sizes are multiples of four, with MARGIN round about.
    """
    def judged(current: Image8, reference: Image8) -> Parallax:
        found = match(current, reference)
        shape, pixel = current.shape, np.pi / (current.shape[1] - 2 * MARGIN)
        errors = told(inputs(current, reference, found), shape)
        rows_in_parallel(_judge_rows, len(found.sigma), current, reference, errors,
                         _sine(shape[1]), np.float32(_NEAR / pixel), np.float32(np.exp(-TAIL)),
                         found.sigma, found.pixels)
        return found

    return judged
