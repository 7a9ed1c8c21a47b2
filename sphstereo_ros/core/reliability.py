"""How far a measurement errs, told from what it looks like.

Windows see across rims, weak texture is carried along, mirrors show what is elsewhere: such errors
no noise model knows. But they look alike everywhere: opinions differ nearby, something nearer is
within the window, the match does not return. A small network, fitted to rendered scenes with exact
range (`sphstereo_ros.bench.reliability`), tells the error that such a look comes with. All it sees
is relative (to the inverse range, to a pixel), so it does not depend on the scene's scale.
"""
from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from .frames import Image8
from .jit import fast_kernel, rows_in_parallel
from .matching import UNKNOWN, Parallax
from .refinement import Refined
from .warp import Map, PolarGrid

LOOKS = 30  # what the network sees of a pixel
_NEAR, _AROUND = 7, (7, 15)  # windows: px of the grid, px at half size
_TEXTURE = 9
LEAK = 0.1
_AT_ONCE = 64  # pixels that the network judges
_LOGARITHMS = (0, 2, 4, 6, 8, 10, 12, 14, 16, 19, 21, 23, 24, 25, 26, 27, 29)  # of the inputs
LEAST = 0.003  # of the unit: added to an error before its logarithm is taken
TAIL = 1.3  # logarithm of how many standard deviations the 95th percentile may be away
NEAR_BY = 40.0  # shortest baselines: nearer than that, what may be nearer than measured matters
_LEAST_SINE = 0.02
# No look makes up for grey that tells nothing: at least so much of what noise alone would do.
_TOLD = 1.0


@dataclass(frozen=True)
class Network:
    """Weights of the network: (LOOKS, 24), (24, 16), (16, 3) and biases, float32.

    Its outputs are the logarithms of the error's 68th and 95th percentile, and of the 98th
    percentile of how much nearer than measured something is; all in units (see `expected_error`),
    with LEAST added.
    """

    weights: tuple[Map, Map, Map]
    biases: tuple[Map, Map, Map]


@cache
def network() -> Network:
    """The network that was fitted to the matcher `joint`."""
    with (files('sphstereo_ros.core') / 'reliability.npz').open('rb') as file:
        data: dict[str, Any] = dict(np.load(file))
    w, b = ([np.ascontiguousarray(data[f'{name}{k}'], np.float32) for k in range(3)]
            for name in ('weight', 'bias'))
    return Network((w[0], w[1], w[2]), (b[0], b[1], b[2]))


@dataclass(frozen=True)
class Look:
    """Maps from which the network's inputs are made, float32; `full` (11, rows, columns) of the
    polar grid, `half` (14, …) at half its size.
    """

    full: NDArray[np.float32]
    half: NDArray[np.float32]


def look(view: Image8, refined: Refined, other: Map, matched: Map, parallax: Parallax) -> Look:
    """What there is to see of a measurement on a polar grid.

    Parameters
    ----------
    view : the current view
    refined : the measurement
    other : second opinion of the inverse range, 1/m
    matched, parallax : what the nearest pair's matcher found: as inverse range, and in pixels

    """
    rho = refined.rho
    known = (matched != UNKNOWN).astype(np.float32)
    difference = np.abs(rho - other)
    near = np.ones((_NEAR, _NEAR), np.uint8)
    size = (_NEAR, _NEAR)
    full = [rho, other, matched, refined.misfit, refined.information,
            *(morph(m, near) for m in (rho, other) for morph in (cv2.dilate, cv2.erode)),
            cv2.blur(difference, size), cv2.blur(known, size)]
    rows, columns = (n // 2 for n in rho.shape)
    small = [cv2.resize(m, (columns, rows), interpolation=cv2.INTER_AREA)
             for m in (rho, other, difference, known)]
    half = []
    for window in _AROUND:
        box = np.ones((window, window), np.uint8)
        half += [morph(m, box) for m in small[:2] for morph in (cv2.dilate, cv2.erode)]
        half += [cv2.blur(m, (window, window)) for m in small[2:]]
    half += [_texture(view, (columns, rows)), parallax.sigma]
    return Look(np.stack(full).astype(np.float32), np.stack(half).astype(np.float32))


def _texture(view: Image8, size: tuple[int, int]) -> Map:
    """Standard deviation of grey in a window, at half size."""
    window = (_TEXTURE, _TEXTURE)
    mean = cv2.boxFilter(view, cv2.CV_32F, window)
    squared = cv2.sqrBoxFilter(view, cv2.CV_32F, window)
    return np.asarray(cv2.resize(np.sqrt(np.maximum(squared - mean * mean, 0)), size,
                                 interpolation=cv2.INTER_AREA), np.float32)


@fast_kernel
def _between(value: Any, low: float,
             high: float) -> Any:  # pragma: no cover - compiled
    return min(max(value, np.float32(low)), np.float32(high))


@fast_kernel
def _inputs(full: NDArray[np.float32], half: NDArray[np.float32], i: int, j: int,
            sine: np.float32, scale: Map, p: int, x: Map,
            units: Map) -> None:  # pragma: no cover - compiled
    """Fill column p of `x` (LOOKS, pixels), before `logarithms`, and p of `units`, 1/m.

    scale : rad of a pixel, shortest and longest baseline
    """
    h, w = i >> 1, j >> 1
    rho, other, matched = full[0, i, j], full[1, i, j], full[2, i, j]
    unit = max(rho, scale[0] / (scale[2] * sine))
    per = np.float32(1) / unit
    for n in range(3):
        at = 6 * n
        for k in range(2):
            most = full[5 + 2 * k, i, j] if n == 0 else half[6 * (n - 1) + 2 * k, h, w]
            least = full[6 + 2 * k, i, j] if n == 0 else half[6 * (n - 1) + 2 * k + 1, h, w]
            x[at + 2 * k, p] = np.float32(0.05) + _between(most * per, 0, 20)
            x[at + 2 * k + 1, p] = _between(least * per, -1, 1.5)
        gap = full[9, i, j] if n == 0 else half[6 * (n - 1) + 4, h, w]
        x[at + 4, p] = np.float32(0.003) + _between(gap * per, 0, 4)
        x[at + 5, p] = full[10, i, j] if n == 0 else half[6 * (n - 1) + 5, h, w]
    known = matched != np.float32(UNKNOWN)
    moved = (rho - matched) * per if known else np.float32(0)
    differs = (rho - other) * per
    x[18, p] = _between(differs, -2, 1.5)
    x[19, p] = np.float32(0.003) + _between(abs(differs), 0, 4)
    x[20, p] = _between(moved, -2, 1.5)
    x[21, p] = np.float32(0.003) + _between(abs(moved), 0, 4)
    x[22, p] = np.float32(1) if known else np.float32(0)
    x[23, p] = np.float32(4) + full[3, i, j]
    x[24, p] = np.float32(0.01) + full[4, i, j] * unit * unit
    x[25, p] = np.float32(0.5) + half[12, h, w]
    x[26, p] = np.float32(0.1) + unit * scale[1] * sine / scale[0]
    x[27, p] = np.float32(0.1) + unit * scale[2] * sine / scale[0]
    x[28, p] = sine
    x[29, p] = np.float32(0.05) + half[13, h, w]
    units[p] = unit


@fast_kernel
def logarithms(x: Map, which: tuple[int, ...]) -> None:  # pragma: no cover - compiled
    """Replace the rows `which` of `x`, all positive, by their logarithms: to 2e-5, by bits."""
    bits = x.view(np.int32)
    for k in which:
        for p in range(x.shape[1]):
            exponent = np.float32((bits[k, p] >> 23) - 127)
            bits[k, p] = (bits[k, p] & 0x7FFFFF) | 0x3F800000
            m = x[k, p]  # 1 … 2
            z = (m - np.float32(math.sqrt(2))) / (m + np.float32(math.sqrt(2)))
            q = z * z
            series = z * (np.float32(2) + q * (np.float32(2 / 3) + q * np.float32(2 / 5)))
            x[k, p] = (exponent + np.float32(0.5)) * np.float32(math.log(2)) + series


@fast_kernel
def _layer(x: Map, weight: Map, bias: Map, bend: bool,
           out: Map) -> None:  # pragma: no cover - compiled
    """One layer for all columns: (inputs, pixels) → (outputs, pixels).

    Written so that it runs on vectors: six times as fast as pixel by pixel.
    """
    pixels = x.shape[1]
    for k in range(bias.size):
        for p in range(pixels):
            out[k, p] = bias[k]
    for n in range(weight.shape[0]):
        for k in range(bias.size):
            w = weight[n, k]
            for p in range(pixels):
                out[k, p] += w * x[n, p]
    if bend:
        for k in range(bias.size):
            for p in range(pixels):
                out[k, p] = max(out[k, p], np.float32(LEAK) * out[k, p])


@fast_kernel
def _percentile_rows(first: int, last: int, full: NDArray[np.float32], half: NDArray[np.float32],
                     sine: Map, scale: Map, w0: Map, b0: Map, w1: Map, b1: Map, w2: Map, b2: Map,
                     out: NDArray[np.float32], units: Map) -> None:  # pragma: no cover - compiled
    pixels = min(_AT_ONCE, sine.size)
    x, unit = np.empty((LOOKS, pixels), np.float32), np.empty(pixels, np.float32)
    y = np.empty((b0.size, pixels), np.float32)
    z = np.empty((b1.size, pixels), np.float32)
    end = np.empty((b2.size, pixels), np.float32)
    for i in range(first, last):
        for block in range(0, sine.size, pixels):
            start = min(block, sine.size - pixels)
            for p in range(pixels):
                _inputs(full, half, i, start + p, sine[start + p], scale, p, x, unit)
            logarithms(x, _LOGARITHMS)
            _layer(x, w0, b0, True, y)
            _layer(y, w1, b1, True, z)
            _layer(z, w2, b2, False, end)
            for k in range(end.shape[0]):
                for p in range(pixels):
                    out[k, i, start + p] = end[k, p]
            for p in range(pixels):
                units[i, start + p] = unit[p]


@fast_kernel
def _error_rows(first: int, last: int, told: NDArray[np.float32], information: Map, units: Map,
                share: np.float32, out: Map) -> None:  # pragma: no cover - compiled
    least = np.float32(LEAST)
    for i in range(first, last):
        for j in range(units.shape[1]):
            unit = units[i, j]
            likely = unit * max(max(np.exp(told[0, i, j]) - least,
                                    (np.exp(told[1, i, j]) - least) * share), np.float32(0))
            noise = np.float32(_TOLD * _TOLD) / max(information[i, j], np.float32(1e-9))
            out[i, j] = np.sqrt(likely * likely + noise)


@fast_kernel
def _looks_at(full: NDArray[np.float32], half: NDArray[np.float32], rows: NDArray[np.int64],
              columns: NDArray[np.int64], sine: Map, scale: Map, out: Map,
              unit: Map) -> None:  # pragma: no cover - compiled
    x, one = np.ones((LOOKS, 1), np.float32), np.empty(1, np.float32)
    for n in range(rows.size):
        _inputs(full, half, rows[n], columns[n], sine[columns[n]], scale, 0, x, one)
        logarithms(x, _LOGARITHMS)
        out[n], unit[n] = x[:, 0], one[0]


def _geometry(grid: PolarGrid, baselines: Sequence[float]) -> tuple[Map, Map]:
    sine = np.maximum(np.abs(np.sin(grid.theta())), _LEAST_SINE).astype(np.float32)
    return sine, np.array([grid.pixel, min(baselines), max(baselines)], np.float32)


def percentiles(seen: Look, grid: PolarGrid, baselines: Sequence[float],
                fitted: Network) -> tuple[NDArray[np.float32], Map]:
    """What the network tells of each pixel by itself.

    Returns
    -------
    float32 (3, *grid.shape): its outputs, logarithms in units; and the unit: the inverse range or,
    far away, a pixel of the longest baseline; 1/m, of grid.shape.

    """
    out = np.empty((fitted.biases[-1].size, *grid.shape), np.float32)
    unit = np.empty(grid.shape, np.float32)
    layers = [m for pair in zip(fitted.weights, fitted.biases, strict=True) for m in pair]
    rows_in_parallel(_percentile_rows, len(unit), seen.full, seen.half,
                     *_geometry(grid, baselines), *layers, out, unit)
    return out, unit


def expected_error(told: NDArray[np.float32], unit: Map, refined: Refined,
                   tail: float = TAIL) -> Map:
    """Standard deviation of the inverse range, 1/m, that goes with such percentiles.

    told, unit : of `percentiles`
    refined : the measurement
    tail : logarithm of how many standard deviations the 95th percentile may be away
    """
    out = np.empty(unit.shape, np.float32)
    rows_in_parallel(_error_rows, len(out), told, refined.information, unit,
                     np.float32(math.exp(-tail)), out)
    return out


def may_be_near(told: NDArray[np.float32], unit: Map, rho: Map, shortest: float) -> Map:
    """How much nearer than measured something may be, in units; 0 where that is far away still.

    told, unit : of `percentiles`
    rho : measured, 1/m
    shortest : of the baselines, m
    """
    nearer = np.exp(told[2])
    near = (rho + nearer * unit) * np.float32(NEAR_BY * shortest) > 1
    return np.asarray(nearer * near, np.float32)


def looks_at(seen: Look, grid: PolarGrid, baselines: Sequence[float], rows: NDArray[np.int64],
             columns: NDArray[np.int64]) -> tuple[Map, Map]:
    """What the network sees of pixels (N,): its inputs (N, LOOKS), and their unit (N,), 1/m."""
    out, unit = np.empty((rows.size, LOOKS), np.float32), np.empty(rows.size, np.float32)
    _looks_at(seen.full, seen.half, rows, columns, *_geometry(grid, baselines), out, unit)
    return out, unit
