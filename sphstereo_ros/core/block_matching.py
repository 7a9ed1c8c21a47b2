"""Block matching along the rows, compiled: the same parallaxes as OpenCV's StereoBM.

Konolige's block matcher (1998): the sum of absolute differences of the gradient along the row, cut
to ±CAP, over a square window; the best whole pixel where it is unique, and a parabola's fraction.
OpenCV's own takes twice the time, and searches what it must be padded with.
"""
from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .frames import Image8
from .jit import kernel, rows_in_parallel

Pixels = NDArray[np.float32]

CAP = 31  # grey levels, of the gradient
TEXTURE = 10  # least sum of a window's gradients that is matched
UNIQUE = 10  # per cent by which the second best must be worse
MAX_BLOCK = 31  # the largest window whose sums fit 16 bits

_LANES = 16  # parallaxes are searched in multiples of it
_MOST = 65535


@kernel
def _filter_rows(first: int, last: int, image: Image8, before: int,
                 out: Image8) -> None:  # pragma: no cover - compiled
    """Sobel's gradient along the row, cut to ±CAP, plus CAP; CAP where there is no image."""
    height, width = image.shape
    for i in range(first, last):
        above = image[i - 1] if i > 0 else image[min(1, height - 1)]
        below = image[i + 1] if i < height - 1 else image[max(height - 2, 0)]
        here = image[i]
        row = out[i, before + 1:]
        out[i, :] = CAP
        for j in range(width - 2):
            right = np.int16(above[j + 2]) + 2 * np.int16(here[j + 2]) + np.int16(below[j + 2])
            left = np.int16(above[j]) + 2 * np.int16(here[j]) + np.int16(below[j])
            row[j] = min(max(np.int16(right - left), np.int16(-CAP)), np.int16(CAP)) + CAP


def _filtered(image: Image8, before: int, after: int) -> Image8:
    """The image's gradient with so many columns of none before and after it."""
    rows, columns = image.shape
    out = np.empty((rows, before + columns + after), np.uint8)
    rows_in_parallel(_filter_rows, rows, image, before, out)
    return out


@kernel
def _begin(first: int, last: int, current: Image8, reference: Image8, sums: NDArray[np.uint16],
           texture: NDArray[np.int32]) -> None:  # pragma: no cover - compiled
    """Sums over rows first … last − 1, those beyond the image repeated: of the differences by
    column and parallax, and of the gradient by column.
    """
    for i in range(first, last):
        row = min(max(i, 0), len(current) - 1)
        for j in range(len(sums)):
            a = current[row, j]
            texture[j] += abs(np.int32(a) - CAP)
            for k in range(sums.shape[1]):
                b = reference[row, j + k]
                sums[j, k] += np.uint16(max(a, b) - min(a, b))


@kernel
def _search_row(current: tuple[Image8, Image8], reference: tuple[Image8, Image8],
                lanes: tuple[int, ...], block: int, sums: NDArray[np.uint16],
                texture: NDArray[np.int32], window: NDArray[np.uint16],
                found: NDArray[np.int32]) -> None:  # pragma: no cover - compiled
    """Move the sums by a row; for the window that ends at each column: its least sum, where it is,
    how many sums are within UNIQUE of it, its neighbours, and the window's gradient.

    current, reference : the row that comes into the window, and the one that leaves it
    """
    count = _LANES * len(lanes)  # known when this is compiled: the inner loops are vectors then
    most = np.uint16(_MOST)
    total = 0
    for c in range(current[0].size):
        j = c + block
        new, old = current[0][c], current[1][c]
        texture[j] += abs(np.int32(new) - CAP) - abs(np.int32(old) - CAP)
        total += texture[j] - texture[c]
        for k in range(count):
            p, q = reference[0][c + k], reference[1][c + k]
            sums[j, k] = np.uint16(sums[j, k] + np.uint16(max(new, p) - min(new, p))
                                   - np.uint16(max(old, q) - min(old, q)))
        least = most
        for k in range(count):
            w = np.uint16(window[k] + sums[j, k] - sums[c, k])
            window[k] = w
            least = min(least, w)
        limit = np.uint16(_limit(int(least)))
        best, good = most, np.uint16(0)
        for k in range(count):
            w = window[k]
            best = min(best, np.uint16(k) if w == least else most)
            good = np.uint16(good + np.uint16(1 if w <= limit else 0))
        found[0, c], found[1, c], found[2, c] = least, best, good
        found[3, c], found[4, c] = window[np.int64(best) - 1], window[np.int64(best) + 1]
        found[5, c] = total


@kernel
def _limit(least: int) -> int:  # pragma: no cover - compiled
    """The sum up to which another is a rival of the least one."""
    return min(least + least * UNIQUE // 100, _MOST - 1)


@kernel
def _finish_row(found: NDArray[np.int32], count: int, unknown: np.float32,
                pixels: Pixels) -> None:  # pragma: no cover - compiled
    """Parallaxes from what `_search_row` found."""
    for j in range(pixels.size):
        least, best, good = found[0, j], found[1, j], found[2, j]
        before, after, texture = found[3, j], found[4, j], found[5, j]
        limit = _limit(least)
        unique = good == 1 + (before <= limit) + (after <= limit)
        before, after = after if best == 0 else before, before if best == count - 1 else after
        curvature = max(before + after - 2 * least + abs(before - after), 1)
        # Below 2²⁴ and 2¹⁸: floats are divided exactly enough to be cut to the right integer.
        fraction = np.int32(np.float32(256 * (after - before)) / np.float32(curvature))
        at = ((count - 1 - best) * 256 + fraction + 15) >> 4
        known = unique & (texture >= TEXTURE) & (at > 0)
        pixels[j] = np.float32(at) * np.float32(0.0625) if known else unknown


@kernel
def _match_rows(first: int, last: int, current: Image8, reference: Image8, lanes: tuple[int, ...],
                block: int, unknown: np.float32,
                pixels: Pixels) -> None:  # pragma: no cover - compiled
    count, columns, half = _LANES * len(lanes), current.shape[1], block // 2
    # The sums of column c are in row c + block: there is a row for `block` columns before it.
    sums = np.zeros((columns + block, count), np.uint16)
    texture = np.zeros(columns + block, np.int32)
    found = np.empty((6, columns), np.int32)
    window = np.full(count + 1, np.uint16(_MOST))  # the last is beside the first one, too
    _begin(first - half - 1, first + half, current, reference, sums[block:], texture[block:])
    for i in range(first, last):
        new, old = min(i + half, len(current) - 1), max(i - half - 1, 0)
        window[:count] = 0
        _search_row((current[new], current[old]), (reference[new], reference[old]), lanes, block,
                    sums, texture, window, found)
        _finish_row(found[:, block - 1:], count, unknown, pixels[i])


def block_match(current: Image8, reference: Image8, disparities: int, block: int,
                unknown: float) -> Pixels:
    """Parallax of every pixel in sixteenths of a pixel, as from StereoBM.

    Parameters
    ----------
    current, reference : what is at column c of the current view is at c − parallax in the other
    disparities : parallaxes from 0 to so many pixels − 1 are searched, a multiple of 16
    block : odd size of the window, at most MAX_BLOCK
    unknown : what stands where no match is unique, above zero and on enough texture

    """
    half = block // 2
    pixels = np.empty(current.shape, np.float32)
    rows_in_parallel(_match_rows, len(pixels), _filtered(current, half, half),
                     _filtered(reference, half + disparities - 1, half),
                     (0,) * (disparities // _LANES), block, np.float32(unknown), pixels)
    return pixels
