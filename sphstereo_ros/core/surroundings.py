"""How far a measurement errs, told from what is round about.

What a pixel looks like by itself (`reliability`) does not tell that the sky behind a tree's crown
was given the range of its leaves, or that a whole panel of a car is a mirror: there, everything
fits. The shape of what is round about does. A convolutional network (a U-net, Ronneberger et al.
2015), at half size and run by OpenCV, sees range, grey and what the pixels tell by themselves; its
outputs are the same percentiles. It was fitted to rendered scenes with exact range
(`sphstereo_ros.bench.surroundings`).
"""
from __future__ import annotations

import threading
from collections.abc import Sequence
from functools import cache
from importlib.resources import files

import cv2
import numpy as np
from numpy.typing import NDArray

from .frames import Image8
from .jit import fast_kernel, rows_in_parallel
from .matching import UNKNOWN
from .reliability import TAIL, Look, _geometry
from .warp import Map, PolarGrid

CHANNELS = 25
BLOCK = 32  # px at half size: what the network halves five times
_ROUND = 32  # px at half size that it sees beyond the seam
_LOCK = threading.Lock()


@fast_kernel
def _input_rows(first: int, last: int, view: Image8, full: NDArray[np.float32],
                half: NDArray[np.float32], told: NDArray[np.float32], units: Map, sine: Map,
                scale: Map, wrap: int, out: NDArray[np.float32]) -> None:  # pragma: no cover
    """Rows of `out` (1, CHANNELS, …): half size, on round the sphere, at the end as the last."""
    rows, columns = half.shape[1], half.shape[2]
    one, quarter = np.float32(1), np.float32(0.25)
    for i in range(first, last):
        h = (i - _ROUND - wrap) % (rows - 2 * wrap) + wrap
        for j in range(out.shape[3]):
            w = min(j, columns - 1)
            x = out[0, :, i, j]
            for k in range(9, CHANNELS):
                x[k] = np.float32(0)
            x[4] = np.float32(0)
            low, high = np.float32(255), np.float32(0)
            for n in range(4):
                r, c = 2 * h + (n >> 1), 2 * w + (n & 1)
                rho, other, matched = full[0, r, c], full[1, r, c], full[2, r, c]
                unit, s = units[r, c], sine[c]
                known = one if matched != np.float32(UNKNOWN) else np.float32(0)
                x[n] = max(told[0, r, c], told[1, r, c] - np.float32(TAIL))
                x[4] += quarter * told[2, r, c]
                pixels = unit * s / scale[0]
                x[5 + n] = np.log(np.float32(0.1) + pixels * scale[1])
                x[9] += quarter * min(max(rho / unit, -one), one)
                grey = (np.float32(view[r, c]) - np.float32(128)) / np.float32(64)
                x[10 + n] = grey
                low, high = min(low, grey), max(high, grey)
                x[15] += quarter * max(other * s / scale[0] * scale[1], np.float32(0))
                x[16] += quarter * min(max((rho - other) / unit, np.float32(-2)),
                                       np.float32(1.5))
                x[17] += quarter * known
                x[18] += quarter * known * min(max((rho - matched) / unit, np.float32(-2)),
                                               np.float32(1.5))
                x[19] += quarter * full[3, r, c]
                x[20] += quarter * full[4, r, c] * unit * unit
                x[21] += quarter * pixels * scale[2]
                x[22] += quarter * s
            x[14] = np.log(np.float32(0.5) + half[12, h, w]) - one
            x[15] = np.log(np.float32(0.1) + x[15])
            x[19] = np.float32(0.7) * (np.log(np.float32(4) + x[19]) - np.float32(3))
            x[20] = np.float32(0.2) * np.log(np.float32(0.01) + x[20])
            x[21] = np.float32(0.5) * np.log(np.float32(0.1) + x[21])
            x[23] = high - low
            x[24] = np.log(np.float32(0.05) + half[13, h, w]) + one


def inputs(view: Image8, seen: Look, told: NDArray[np.float32], unit: Map, grid: PolarGrid,
           baselines: Sequence[float]) -> NDArray[np.float32]:
    """What the network sees: float32 (1, CHANNELS, rows, columns), half the grid's size and more,
    so that it can be halved again and goes on beyond the seam.

    Parameters
    ----------
    view : the current view on `grid`
    seen : of `reliability.look`
    told, unit : of `reliability.percentiles`
    grid, baselines : the polar grid; of the references, m

    """
    rows, columns = seen.half.shape[1:]
    size = [-(-n // BLOCK) * BLOCK for n in (rows + 2 * _ROUND, columns)]
    out = np.empty((1, CHANNELS, *size), np.float32)
    rows_in_parallel(_input_rows, size[0], view, seen.full, seen.half, told, unit,
                     *_geometry(grid, baselines), grid.wrap // 2, out)
    return out


def interior(maps: NDArray[np.float32], shape: tuple[int, ...]) -> NDArray[np.float32]:
    """Of maps as large as `inputs`, what lies on the polar grid of `shape`, at half its size."""
    rows, columns = (n // 2 for n in shape)
    return maps[:, :, _ROUND:_ROUND + rows, :columns]


@cache
def _network() -> cv2.dnn.Net:
    data = (files('sphstereo_ros.core') / 'surroundings.onnx').read_bytes()
    return cv2.dnn.readNetFromONNX(np.frombuffer(data, np.uint8))


def judged(x: NDArray[np.float32], shape: tuple[int, ...]) -> NDArray[np.float32]:
    """The network's outputs: float32 (3, *shape), as of `reliability.percentiles`.

    x : of `inputs`
    shape : of the polar grid
    """
    with _LOCK:  # a network of OpenCV holds what it computes
        net = _network()
        net.setInput(x)
        out = net.forward()
    found = interior(out, shape)
    parts = found.reshape(3, 2, 2, *found.shape[2:])
    return np.ascontiguousarray(parts.transpose(0, 3, 1, 4, 2)).reshape(3, *shape)
