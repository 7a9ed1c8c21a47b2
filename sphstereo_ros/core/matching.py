"""Matching along the meridians of an aligned pair.

A matcher takes both views on one polar grid (rows are meridians) and gives the parallax of the
current view in pixels along θ, δ = θ_current − θ_reference, with its standard deviation. What it
does not know is UNKNOWN: no NaN, so that compiled code may re-order arithmetic.
"""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from .block_matching import MAX_BLOCK, UNIQUE, block_match
from .config import StereoConfig
from .frames import Image8
from .jit import kernel, rows_in_parallel
from .warp import PolarGrid

Pixels = NDArray[np.float32]

Bounds = tuple[float, float]

# Pixels round an aligned pair that need not be matched: they are there for windows to see.
MARGIN = 8

_HALVINGS = 8  # how much coarser a grid gets at most: its height can be divided by that

UNKNOWN = -1e5  # more than a turn at any size


def stereo_grid(height: int) -> PolarGrid:
    """The grid on which frames of `height` rows are matched: the next height that halves evenly.

    Where halving loses a row, everything coarse would be misplaced.
    """
    return PolarGrid(-(-height // _HALVINGS) * _HALVINGS, MARGIN, MARGIN)


@dataclass(frozen=True)
class Parallax:
    """Parallax on a polar grid: `pixels` (or UNKNOWN), float32 of the grid's shape, and `sigma`,
    float32 at half the grid's size: pixel (i, j) has sigma[i // 2, j // 2].

    A matcher whose search ends at zero cannot say that a point is beyond all range: `signed` tells
    that parallaxes about zero were searched on both sides. `across`, of sigma's size, is how far
    the match lies off the meridian, px along the rows (0 where unknown); None where none was
    searched for.
    """

    pixels: Pixels
    sigma: Pixels
    signed: bool
    across: Pixels | None = None


Matcher = Callable[[Image8, Image8], Parallax]

# The error model, fitted to the tuning scenes. A match of structure s (grey levels per pixel) errs
# by _GREY / sqrt(s² − noise²) px beside the matcher's own floor, and by a share of the loop from
# forth and back. The noise is taken from the least structured part of the picture, within bounds.
_GREY = 0.1
# Each matcher has its least and its most: smooth flow carries a blank patch along with its rim,
# which a window by itself cannot.
_BOUNDS = {'bm': (0.1, 50.0), 'sgbm': (0.18, 5.0), 'flow': (0.1, 2.0), 'flow_fast': (0.25, 2.0)}
_LEAST_NOISE, _MOST_NOISE = 0.15, 0.5
_FORTH_AND_BACK = 0.5

_LOOP, _ACROSS = 1.5, 1.0  # px, in which a flow is consistent


def structure(image: Image8, window: int = 9) -> Pixels:
    """Root mean square of the gradient along θ in a window, grey levels per pixel, at half size.

    It varies slowly, so half of the rows and columns are enough.
    """
    half = cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    gradient = cv2.Sobel(half, cv2.CV_16S, 1, 0, ksize=3)
    squared = cv2.sqrBoxFilter(gradient, cv2.CV_32F, (window, window))
    return np.asarray(cv2.sqrt(squared)) * np.float32(1 / 16)


def structure_sigma(image: Image8, bounds: Bounds) -> Pixels:
    """Standard deviation of a match in px from the image's structure, at half size.

    bounds : least and most; structure that is not above the noise tells nothing: the most
    """
    found = structure(image)
    noise = 1.6 * float(np.percentile(found[::8, ::8], 5))
    noise = min(max(noise, _LEAST_NOISE), _MOST_NOISE)
    least, most = bounds
    signal = np.maximum(found * found - np.float32(noise**2), np.float32((_GREY / most)**2))
    return np.asarray(np.sqrt(np.float32(least**2) + np.float32(_GREY**2) / signal))


def inverse_search(preset: str, finest_scale: int) -> Any:
    """Dense inverse search flow (Kroeger et al. 2016): 'ultrafast', 'fast' or 'medium'.

    finest_scale : halvings of the image at the finest level that is searched
    """
    presets = {'ultrafast': cv2.DISOPTICAL_FLOW_PRESET_ULTRAFAST,
               'fast': cv2.DISOPTICAL_FLOW_PRESET_FAST,
               'medium': cv2.DISOPTICAL_FLOW_PRESET_MEDIUM}
    search = cv2.DISOpticalFlow_create(presets[preset])
    search.setFinestScale(finest_scale)
    return search


def flow_matcher(preset: str, finest_scale: int, smoothness: float, bounds: Bounds) -> Matcher:
    """Dense inverse search flow, kept where it is consistent.

    A match stands if the flow back from the reference returns to within 1.5 pixels, and if it
    stays within one pixel of its meridian.

    smoothness : weight of smoothness in the variational refinement
    bounds : least and most standard deviation of a match by structure, px
    """
    search = inverse_search(preset, finest_scale)
    search.setVariationalRefinementAlpha(smoothness)

    def match(current: Image8, reference: Image8) -> Parallax:
        there = search.calc(current, reference, None)
        back = search.calc(reference, current, None)
        loop = _forth_and_back(there, back)
        along, across = there[..., 0], there[..., 1]
        half = cv2.resize(loop, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
        sigma = _length(structure_sigma(current, bounds), _FORTH_AND_BACK * half)
        pixels = -along
        pixels[(loop > _LOOP) | (np.abs(across) > _ACROSS)] = UNKNOWN
        off = np.where(loop > _LOOP, np.float32(0), across)
        return Parallax(pixels, sigma, signed=True, across=np.asarray(cv2.resize(
            off, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)))

    return match


def hybrid_matcher(flow: Matcher, block: Matcher) -> Matcher:
    """Dense flow, averaged with block matching where both agree to a pixel.

    Their errors have little in common (smoothness here, windows there), so the mean is better than
    either. What the flow does not know stays unknown.
    """
    def match(current: Image8, reference: Image8) -> Parallax:
        matched, checked = flow(current, reference), block(current, reference)
        rows_in_parallel(_average, len(current), matched.pixels, checked.pixels)
        return matched

    return match


@kernel
def _average(first: int, last: int, pixels: Pixels,
             others: Pixels) -> None:  # pragma: no cover - compiled
    for i in range(first, last):
        for j in range(pixels.shape[1]):
            if abs(pixels[i, j] - others[i, j]) < 1 and pixels[i, j] != UNKNOWN:
                pixels[i, j] = np.float32(0.5) * (pixels[i, j] + others[i, j])


def _forth_and_back(there: Pixels, back: Pixels) -> Pixels:
    """Length of the loop from the current view to the reference and back, px."""
    rows, columns = there.shape[:2]
    u = there[..., 0] + np.arange(columns, dtype=np.float32)[None]
    v = there[..., 1] + np.arange(rows, dtype=np.float32)[:, None]
    returned = cv2.remap(back, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    loop = there + returned
    return _length(loop[..., 0], loop[..., 1])


def _length(a: Pixels, b: Pixels) -> Pixels:
    """√(a² + b²). (The last bit of `cv2.magnitude` differs from call to call.)"""
    squared = a * a
    squared += b * b
    return np.asarray(np.sqrt(squared, out=squared))


@kernel
def _from_fixed_point(first: int, last: int, disparity: NDArray[np.int16],
                      pixels: Pixels) -> None:  # pragma: no cover - compiled
    """Sixteenths to pixels; what is not positive was not found."""
    for i in range(first, last):
        for j in range(pixels.shape[1]):
            d = disparity[i, j]
            pixels[i, j] = d * np.float32(0.0625) if d > 0 else np.float32(UNKNOWN)


def _opencv_matcher(stereo: Any, disparities: int, block: int, bounds: Bounds) -> Matcher:
    """A StereoBM or StereoSGBM, padded: it leaves the first columns and the rim empty.

    Only what the margin of the pair does not cover already is added.
    """
    rim = max(block // 2 - MARGIN, 0)
    left = disparities + block // 2 - MARGIN

    def match(current: Image8, reference: Image8) -> Parallax:
        padded = [cv2.copyMakeBorder(im, rim, rim, left, rim, cv2.BORDER_REPLICATE)
                  for im in (current, reference)]
        rows, columns = current.shape
        disparity = stereo.compute(*padded)[rim:rim + rows, left:left + columns]
        pixels = np.empty(current.shape, np.float32)
        rows_in_parallel(_from_fixed_point, len(pixels), disparity, pixels)
        return Parallax(pixels, structure_sigma(current, bounds), signed=False)

    return match


def block_matcher(disparities: int, block: int) -> Matcher:
    """StereoBM, as in the paper: compiled here, or OpenCV's where the window is too large."""
    if block > MAX_BLOCK:
        stereo = cv2.StereoBM_create(disparities, block)
        stereo.setUniquenessRatio(UNIQUE)
        return _opencv_matcher(stereo, disparities, block, _BOUNDS['bm'])

    def match(current: Image8, reference: Image8) -> Parallax:
        pixels = block_match(current, reference, disparities, block, UNKNOWN)
        return Parallax(pixels, structure_sigma(current, _BOUNDS['bm']), signed=False)

    return match


def semi_global_matcher(disparities: int, block: int) -> Matcher:
    """OpenCV's StereoSGBM, three-way."""
    stereo = cv2.StereoSGBM_create(
        0, disparities, block, P1=2 * block * block, P2=16 * block * block, uniquenessRatio=5,
        disp12MaxDiff=1, mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY)
    return _opencv_matcher(stereo, disparities, block, _BOUNDS['sgbm'])


def matcher(config: StereoConfig) -> Matcher:
    """The matcher that `config` names, unjudged; of a joint one, that of the nearest pair."""
    block = block_matcher(config.num_disparities, config.block_size)
    if config.matcher in ('bm', 'bm_judged', 'joint_fast'):
        return block
    if config.matcher == 'sgbm':
        return semi_global_matcher(config.num_disparities, min(config.block_size, 7))
    if config.matcher == 'flow_fast':
        return flow_matcher('ultrafast', 2, 20.0, _BOUNDS['flow_fast'])
    flow = flow_matcher('fast', 1, 40.0, _BOUNDS['flow'])
    return flow if config.matcher == 'flow' else hybrid_matcher(flow, block)
