"""What is seen beside each pixel: the closest place in the picture that is clearly farther away,
and the closest that is clearly nearer.

Between leaves, beside a post and along a rim a window of the matcher covers two surfaces and
measures one of them. The other one is most often seen beside it, and looks alike there.
"""
from __future__ import annotations

from functools import cache

import cv2
import numpy as np
from numpy.typing import NDArray

from .frames import Image8
from .jit import fast_kernel, rows_in_parallel
from .warp import Map

_ROWS = 240  # of the picture that is looked at
_REACH = 15  # of its pixels that are looked away at most
_FARTHER, _NEARER = 0.83, 1.25  # times the inverse range
_LEAST = 0.5  # px of parallax by which what is nearer differs at least
_SURE = 0.15  # sigma over inverse range, at least a pixel
_LOOKS = 5  # px in which its grey is averaged


@cache
def _around() -> tuple[NDArray[np.int32], Map]:
    """Rows and columns away, closest first, and how close: 1 to 0."""
    size = 2 * _REACH + 1
    at = np.indices((size, size)).reshape(2, -1).T - _REACH
    away = np.hypot(at[:, 0], at[:, 1])
    order = np.argsort(away, kind='stable')
    order = order[(away[order] > 0) & (away[order] <= _REACH)]
    return (np.ascontiguousarray(at[order], np.int32),
            ((_REACH + 1 - away[order]) / _REACH).astype(np.float32))


@fast_kernel
def _look_rows(first: int, last: int, rho: Map, sure: NDArray[np.bool_], grey: Image8,
               around: NDArray[np.int32], close: Map, least: np.float32,
               out: NDArray[np.float32]) -> None:  # pragma: no cover - compiled
    """out : as of `beside`"""
    rows, columns = rho.shape
    for i in range(first, last):
        for j in range(columns):
            below = np.float32(_FARTHER) * rho[i, j]
            above = max(np.float32(_NEARER) * rho[i, j], rho[i, j] + least)
            for k in range(len(around)):
                r, c = i + around[k, 0], (j + around[k, 1]) % columns
                if r < 0 or r >= rows or not sure[r, c]:
                    continue
                n = 0 if rho[r, c] < below else 3 if rho[r, c] > above else -1
                if n >= 0 and out[n + 1, i, j] == 0:
                    out[n, i, j], out[n + 1, i, j] = rho[r, c], close[k]
                    out[n + 2, i, j] = grey[r, c]
                    if out[4 - n, i, j] > 0:
                        break


def beside(rho: Map, sigma: Map, view: Image8, pixel: float) -> NDArray[np.float32]:
    """What is seen beside each pixel.

    Parameters
    ----------
    rho, sigma : (H, 2H) inverse range, and its standard deviation, 1/m
    view : (H, 2H) the same frame, grey
    pixel : inverse range that is a pixel of parallax, 1/m

    Returns
    -------
    float32 (6, H, 2H): inverse range of the closest place that is farther, 1/m, how close it is (1
    = next to it, 0 = there is none), and its grey; and these of the closest that is nearer

    """
    step = max(len(rho) // _ROWS, 1)
    looks = cv2.blur(view, (_LOOKS, _LOOKS))
    seen, spread, grey = (m[step // 2::step, step // 2::step] for m in (rho, sigma, looks))
    seen = np.maximum(seen, np.float32(0))
    sure = spread < np.float32(_SURE) * np.maximum(seen, np.float32(pixel))
    found = np.zeros((6, *seen.shape), np.float32)
    rows_in_parallel(_look_rows, len(seen), seen, sure, grey, *_around(),
                     np.float32(_LEAST * pixel), found)
    return _as_large(found.repeat(step, 1).repeat(step, 2), rho.shape)


def _as_large(maps: NDArray[np.float32], shape: tuple[int, ...]) -> NDArray[np.float32]:
    """Cut to `shape`, the last rows and columns once more where they are too few."""
    short = [max(n - m, 0) for n, m in zip(shape, maps.shape[1:], strict=True)]
    whole = np.pad(maps, ((0, 0), (0, short[0]), (0, short[1])), 'edge')
    return np.ascontiguousarray(whole[:, :shape[0], :shape[1]])
