"""What is measured and what is remembered, of which the likelier is told: by what is round about.

Evidence counts frames, pixel by pixel. Where a frame may be believed that contradicts what is
remembered, and where all of them err alike, shows only in how both differ round about: along a
rim, on a pane, between leaves. A convolutional network (a U-net, Ronneberger et al. 2015), at half
size and run by OpenCV, sees the newest measurement, what was passed over for it, what was
remembered, both as one, the floor and the likeliest wall behind it, and what is seen beside it
farther away and nearer; it chooses between them, and tells percentiles of the error of what it
chose, and how probably that is wrong, hides something near, or only sky is there. It only reads:
what is remembered goes on as it is (`range_memory`). It was fitted to rendered scenes with exact
range (`sphstereo_ros.bench.memory_judge`).
"""
from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from .convolutions import Convolutions, of_each_pixel
from .frames import Image8
from .inverse_range import NOTHING, _grid_angles, beyond
from .jit import fast_kernel, rows_in_parallel
from .judgement import Evidence
from .match_judge import likely_error
from .reliability import NEAR_BY, logarithms
from .warp import Map

_EACH = 31  # inputs of each pixel
CHANNELS = 4 * _EACH + 3  # and of each four
# Inputs: where those of four pixels begin. THERE: whether there is a floor, where, how much a wall
# carries, and where that is; how close what is farther beside it, where, and how much its grey
# differs; and these of what is nearer.
LEVEL, SIGMAS, VIEW, THERE, GREYS = 0, (4, 32, 48), 20, 84, (108, 120)
PRESENT = (24, 84, 92, 100, 112)  # over 0 where something was remembered, or is floor, wall, …
_TOLD = 13  # outputs for each pixel
BLOCK = 16  # px at half size: what the network halves four times
ROUND = 16  # px at half size that it sees beyond the seam
_LEAST, _MOST = np.float32(1e-3), np.float32(10)  # shares that sigma counts for
_APART = np.float32(2)  # logarithm by which inverse ranges differ at most, or share
_EVIDENCE = np.float32(1 / 6)
_LOGARITHMS = (*range(8), *range(16, 20), *range(28, 36), *range(44, 52), *range(56, 84),
               *range(88, 92), *range(96, 100), *range(104, 108), *range(116, 120), 125, 126)
_DIFFERENCES = (*range(28, 32), *range(44, 48), *range(68, 72), *range(88, 92), *range(96, 100),
                *range(104, 112), *range(116, 124))
# Logarithms of how many standard deviations the 95th percentile may be away: near, and _FAR times
# as far away as what is near by.
_TAIL, _TAIL_FAR = 0.95, 1.3
# Probabilities of being off by over a tenth with which it is told, told over _FAR times as far
# away as what is near by, and told to be free.
_OFF, _OFF_FAR, _OFF_FREE = 0.85, 0.7, 0.1
_FAR = 3.0
_SKY = 0.05  # probability that only sky is there with which nothing is told near by
# Outputs: where the choices begin, and after them the logits of being off, of sky, and of hiding
# something near.
_CHOICES, _AFTER = 2, 10
# Probabilities of hiding something near (counted ten times) with which it is told; and where it is
# only the floor, or the newest frame may miss something near, or sees it _BEFORE times nearer.
_DANGER, _DISPUTED = 0.4, 0.08
_BEFORE = 1.3
_NEAR_M = 10.0  # m: what is nearer is near by, however slowly the camera moves


@dataclass(frozen=True)
class Opinions:
    """What there is to choose from, float32 (H, 2H); inverse ranges and standard deviations, 1/m.

    measured : inverse range, sigma, second opinion, and sigma by what the grey tells alone, of the
    newest frame; frames : for how many frames of evidence it counts, −1 = something may be much
    nearer
    before : inverse range, sigma (NOTHING where unknown) and evidence of what was remembered, and
    how much its errors are like those of the newest frame
    fused : inverse range, sigma and evidence of both as one
    floor : inverse range of the floor if nothing hides it, as of `floor_seen`
    wall : inverse range of the likeliest wall, and how much it carries, as of `walls_seen`
    beside : (6, H, 2H), of `beside`, of both as one, or of what was measured where that is unknown
    pose : the pose's share of sigma
    wider : (7, H, 2H), as `Judged.wider`, of what was measured
    """

    measured: tuple[Map, Map, Map, Map]
    frames: Evidence
    before: tuple[Map, Map, Map, Map]
    fused: tuple[Map, Map, Map]
    floor: Map
    wall: tuple[Map, Map]
    beside: NDArray[np.float32]
    pose: Map
    wider: NDArray[np.float32]


@fast_kernel
def _share(sigma: np.float32, unit: np.float32) -> np.float32:  # pragma: no cover - compiled
    return _LEAST + min(sigma / unit, _MOST)


@fast_kernel
def _differs(rho: np.float32, level: np.float32,
             pixel: np.float32) -> np.float32:  # pragma: no cover - compiled
    """Ratio of inverse ranges, a pixel added to each."""
    return (max(rho, np.float32(0)) + pixel) / (pixel * level)


@fast_kernel
def _input(view: Image8, measured: tuple[Map, ...], frames: Evidence, before: tuple[Map, ...],
           fused: tuple[Map, ...], floor: Map, wall: tuple[Map, ...],
           beside: NDArray[np.float32], wider: NDArray[np.float32], pixel: np.float32, r: int,
           c: int, n: int, x: Map, p: int) -> None:  # pragma: no cover - compiled
    """Column p of `x`, of pixel (r, c), the n-th of its four, before logarithms."""
    one, nothing = np.float32(1), np.float32(NOTHING)
    rho, old, both = measured[0][r, c], before[0][r, c], fused[0][r, c]
    unit = max(rho, pixel)
    level = one + max(rho, np.float32(0)) / pixel
    x[n, p] = level
    x[4 + n, p] = _share(measured[1][r, c], unit)
    x[8 + n, p] = np.float32(frames[r, c])
    x[12 + n, p] = min(max((measured[2][r, c] - rho) / unit, -_APART), _APART)
    x[16 + n, p] = _share(measured[3][r, c], unit)
    x[20 + n, p] = (np.float32(view[r, c]) - np.float32(128)) * np.float32(1 / 64)
    was = before[1][r, c] < nothing
    x[24 + n, p] = one if was else np.float32(0)
    x[28 + n, p] = _differs(old, level, pixel) if was else one
    x[32 + n, p] = _share(before[1][r, c], max(old, pixel))
    x[36 + n, p] = _EVIDENCE * before[2][r, c] if was else np.float32(0)
    x[40 + n, p] = before[3][r, c]
    known = fused[1][r, c] < nothing
    x[44 + n, p] = _differs(both, level, pixel) if known else one
    x[48 + n, p] = _share(fused[1][r, c], max(both, pixel))
    x[52 + n, p] = _EVIDENCE * max(fused[2][r, c], np.float32(0))
    other = wider[3, r, c]
    x[68 + n, p] = _differs(other, level, pixel)
    for k in range(3):
        x[56 + 4 * k + n, p] = _share(wider[k, r, c], unit)
        x[72 + 4 * k + n, p] = _share(wider[4 + k, r, c], max(other, pixel))
    seen = floor[r, c] > 0
    x[84 + n, p] = one if seen else np.float32(0)
    x[88 + n, p] = _differs(floor[r, c], level, pixel) if seen else one
    x[92 + n, p] = wall[1][r, c]
    x[96 + n, p] = _differs(wall[0][r, c], level, pixel) if wall[0][r, c] > 0 else one
    for k in range(2):
        place, close, grey = beside[3 * k, r, c], beside[3 * k + 1, r, c], beside[3 * k + 2, r, c]
        x[100 + 12 * k + n, p] = close
        x[104 + 12 * k + n, p] = _differs(place, level, pixel) if close > 0 else one
        alike = (grey - np.float32(view[r, c])) * np.float32(1 / 64)
        x[108 + 12 * k + n, p] = alike if close > 0 else np.float32(0)


@fast_kernel
def _input_rows(first: int, last: int, view: Image8, measured: tuple[Map, ...], frames: Evidence,
                before: tuple[Map, ...], fused: tuple[Map, ...], floor: Map,
                wall: tuple[Map, ...], beside: NDArray[np.float32],
                wider: NDArray[np.float32], sine: Map, scale: Map,
                out: NDArray[np.float32]) -> None:  # pragma: no cover - compiled
    """Rows of `out` (1, CHANNELS, …): on round the sphere, at the end as the last."""
    height, width = view.shape
    x = np.empty((CHANNELS, BLOCK), np.float32)
    for i in range(first, last):
        for start in range(0, out.shape[3], BLOCK):
            for p in range(BLOCK):
                for n in range(4):
                    r = min(2 * i + (n >> 1), height - 1)
                    c = (2 * (start + p - ROUND) + (n & 1)) % width
                    _input(view, measured, frames, before, fused, floor, wall, beside, wider,
                           scale[0], r, c, n, x, p)
                    x[124, p], x[125, p], x[126, p] = sine[r, c], scale[1], scale[2]
            logarithms(x, _LOGARITHMS)
            for k in _DIFFERENCES:
                for p in range(BLOCK):
                    x[k, p] = min(max(x[k, p], -_APART), _APART)
            for k in range(CHANNELS):
                for p in range(BLOCK):
                    out[0, k, i, start + p] = x[k, p]


def _sine(height: int, direction: NDArray[np.float64]) -> Map:
    """Of the angle from the direction of motion, of every pixel."""
    cos_lat, sin_lat, cos_lon, sin_lon = _grid_angles(height)
    x, y, z = direction.astype(np.float32)
    along = cos_lat[:, None] * (x * sin_lon + z * cos_lon) - (y * sin_lat)[:, None]
    return np.asarray(np.sqrt(np.maximum(1 - along * along, 0)), np.float32)


def pixel_of(height: int, longest: float) -> np.float32:
    """Inverse range, 1/m, of one pixel of parallax at right angles to the longest baseline, m."""
    return np.float32(np.pi / (height * longest))


def inputs(view: Image8, opinions: Opinions, direction: NDArray[np.float64],
           baselines: tuple[float, float]) -> NDArray[np.float32]:
    """What the network sees: float32 (1, CHANNELS, rows, columns), half the image's size and more,
    so that it can be halved again and goes on beyond the seam.

    Parameters
    ----------
    view : the current frame, grey (H, 2H)
    direction : of motion, in its frame
    baselines : the shortest and the longest, m

    """
    height = len(view)
    rows, columns = -(-height // 2), height
    size = [-(-n // BLOCK) * BLOCK for n in (rows, columns + 2 * ROUND)]
    out = np.empty((1, CHANNELS, *size), np.float32)
    shortest, longest = baselines
    pixel = pixel_of(height, longest)
    scale = np.array([pixel, shortest / longest, 1 / (near_by(shortest) * pixel)], np.float32)
    rows_in_parallel(_input_rows, size[0], view, opinions.measured, opinions.frames,
                     opinions.before, opinions.fused, opinions.floor, opinions.wall,
                     opinions.beside, opinions.wider, _sine(height, direction), scale, out)
    return out


def interior(maps: NDArray[np.float32], height: int) -> NDArray[np.float32]:
    """Of maps as large as `inputs`, what lies on the image of `height` rows, at half its size."""
    return maps[:, :, :-(-height // 2), ROUND:ROUND + height]


def near_by(shortest: float) -> float:
    """Range, m, up to which what is told too far is dangerous, of the shortest baseline, m."""
    return max(shortest * NEAR_BY, _NEAR_M)


@cache
def _network() -> Convolutions:
    return Convolutions('memory_judge.onnx')


@fast_kernel
def _chosen(told: NDArray[np.float32], measured: Map, before: tuple[Map, ...],
            fused: tuple[Map, ...], others: tuple[Map, ...], beside: NDArray[np.float32], i: int,
            j: int) -> np.float32:  # pragma: no cover - compiled
    best, most, nothing = measured[i, j], told[_CHOICES, i, j], np.float32(NOTHING)
    for n, (kept, spread) in enumerate(((before[0], before[1]), (fused[0], fused[1]))):
        if told[_CHOICES + 1 + n, i, j] > most and spread[i, j] < nothing:
            best, most = kept[i, j], told[_CHOICES + 1 + n, i, j]
    for n in range(len(others)):  # a floor or wall where there is one
        if told[_CHOICES + 3 + n, i, j] > most and (n == 0 or others[n][i, j] > 0):
            best, most = others[n][i, j], told[_CHOICES + 3 + n, i, j]
    for n in range(2):
        if told[_CHOICES + 6 + n, i, j] > most and beside[3 * n + 1, i, j] > 0:
            best, most = beside[3 * n, i, j], told[_CHOICES + 6 + n, i, j]
    return np.float32(best)


@fast_kernel
def _disputed(best: np.float32, measured: np.float32, frames: np.int8, floor: np.float32,
              near: np.float32) -> bool:  # pragma: no cover - compiled
    """Whether it is only the floor, or the newest frame may miss something near, or sees it."""
    seen = frames > 0 and measured > near
    on_floor = best > 0 and best == floor
    return bool(on_floor or frames < 0 or (seen and measured > np.float32(_BEFORE) * best))


@fast_kernel
def _judge_rows(first: int, last: int, told: NDArray[np.float32], measured: Map,
                frames: Evidence, before: tuple[Map, ...], fused: tuple[Map, ...],
                others: tuple[Map, ...], beside: NDArray[np.float32], pose: Map, scale: Map,
                bounds: Map, rho: Map, sigma: Map) -> None:  # pragma: no cover - compiled
    """others : what was passed over, floor, wall; scale : inverse range of a pixel and of what is
    near by, shares of the 95th percentile, inverse range of what is told to be free; bounds :
    logits of _OFF, _OFF_FAR, _OFF_FREE, _SKY, _DANGER and _DISPUTED
    """
    nothing, pixel, near = np.float32(NOTHING), scale[0], scale[1]
    for i in range(first, last):
        for j in range(rho.shape[1]):
            best = _chosen(told, measured, before, fused, others, beside, i, j)
            far = best * np.float32(_FAR) <= near
            own = likely_error(told, 0, i, j, scale[3 if far else 2]) * max(best, pixel)
            spread = np.sqrt(own * own + pose[i, j] * pose[i, j])
            off, sky, danger = told[_AFTER, i, j], told[_AFTER + 1, i, j], told[_AFTER + 2, i, j]
            sure = off <= bounds[1 if far else 0]
            sure &= off <= bounds[2] or not beyond(best, spread, scale[4])
            sure &= sky <= bounds[3] or best < near
            disputed = _disputed(best, measured[i, j], frames[i, j], others[1][i, j], near)
            sure &= danger <= bounds[5 if disputed else 4]
            rho[i, j], sigma[i, j] = best, nothing
            if sure:
                sigma[i, j] = spread


def _logits(*probabilities: float) -> Map:
    given = np.array(probabilities)
    return np.asarray(np.log(given / (1 - given)), np.float32)


def told(x: NDArray[np.float32], height: int) -> NDArray[np.float32]:
    """The network's outputs, float32 (13, H, 2H): logarithms of the 68th and 95th percentile of
    the error of what is chosen, as shares of the inverse range (at least of `pixel_of`), with
    LEAST added; eight by which what was measured, remembered, both as one, what was passed over,
    the floor, the wall, or what is beside it, farther or nearer, is chosen; and the logits of the
    probabilities that it is off by over a tenth of its inverse range, that only sky is there, and
    (counted ten times) that it hides something near by, over 1.5 times too far.
    """
    whole = of_each_pixel(interior(_network()(x), height), _TOLD)
    return np.ascontiguousarray(whole[:, :height])


def judged(view: Image8, opinions: Opinions, direction: NDArray[np.float64],
           baselines: tuple[float, float], farthest: float = 0.0) -> tuple[Map, Map]:
    """Inverse range and its standard deviation, NOTHING where none is told, float32 (H, 2H), 1/m.

    As of `inputs`; farthest : inverse range, 1/m, confidently beyond which all is told to be free
    """
    outputs = told(inputs(view, opinions, direction, baselines), len(view))
    rho, sigma = np.empty((2, *view.shape), np.float32)
    scale = np.array([pixel_of(len(view), baselines[1]), 1 / near_by(baselines[0]),
                      np.exp(-_TAIL), np.exp(-_TAIL_FAR), farthest], np.float32)
    rows_in_parallel(_judge_rows, len(rho), outputs, opinions.measured[0],
                     opinions.frames, opinions.before, opinions.fused,
                     (opinions.wider[3], opinions.floor, opinions.wall[0]), opinions.beside,
                     opinions.pose, scale,
                     _logits(_OFF, _OFF_FAR, _OFF_FREE, _SKY, _DANGER, _DISPUTED), rho, sigma)
    return rho, sigma
