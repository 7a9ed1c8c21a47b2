"""Joint refinement: inverse range from all references at once, to a fraction of a pixel.

Each reference is resampled as the current view would see it by the range known so far; what still
differs in grey is put down to the range by Lucas and Kanade's linearisation (1981) along the
epipolar direction. A window's measurements of all references are averaged by what they tell, so a
long baseline decides far away and a short one near by. References that do not fit where others
do (occluded there, or moved) are left out.
"""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from .frames import Image8, RelativePose
from .jit import fast_kernel, rows_in_parallel
from .relief import reference_in_relief
from .warp import Map, PolarGrid

Floats = NDArray[np.float64]

_NOISE = 2.0  # grey levels, of the difference of two views beside what range explains
_MOST = 400.0  # squared grey levels: a worse difference tells no more than that it does not fit
_MOST_GREY = 60.0  # grey levels, of a single pixel where ranges are compared
_HALF = 8.0  # grey levels that count half as much as any difference may
_AROUND = 1.0  # px at half size: standard deviation of what is round about
_FIT_WINDOW, _MEAN_WINDOW = 7, 21
_LIGHT = 1 / 20  # of the grid's height: across it, the light of references may differ
_HOLD = 1e-3  # information of the start: where nothing is told, it stays
_SAME = 0.3  # px by which a wide window may differ from a narrow one, to be taken in its place
_MOST_GAIN = 3.0  # a reference of so much less contrast shows nothing that could be compared
_UNFIT = 4.0  # a reference is left out where it fits that much worse than the best
NEAR_BY = 30.0  # baselines of the nearest reference: there, slopes matter more than noise
REACH = 0.7  # baseline over range beyond which a reference looks too different


@dataclass(frozen=True)
class Refined:
    """rho : 1/m on the polar grid; information : (1/m)⁻², what the differences in grey tell of it
    if they are independent; misfit : mean squared grey difference of the best reference
    """

    rho: Map
    information: Map
    misfit: Map


@fast_kernel
def _differences(first: int, last: int, current: Image8, mean: Map, view: Image8, view_mean: Map,
                 gain: np.float32, rho: Map, cos_theta: Map, sin_theta: Map, cos_azimuth: Map,
                 sin_azimuth: Map, position: Map, per_pixel: np.float32, slope: Map, error: Map,
                 squared: Map) -> None:  # pragma: no cover - compiled
    """Difference in grey, and by how much it would change with ρ; `position` in polar axes."""
    rows, columns = current.shape
    quarter, one = np.float32(0.25) * per_pixel, np.float32(1)
    for i in range(first, last):
        above, below = max(i - 1, 0), min(i + 1, rows - 1)
        radial = position[0] * cos_azimuth[i] + position[1] * sin_azimuth[i]
        across = position[1] * cos_azimuth[i] - position[0] * sin_azimuth[i]
        for j in range(columns):
            left, right = max(j - 1, 0), min(j + 1, columns - 1)
            s, c = sin_theta[j], cos_theta[j]
            gx = quarter * (gain * (np.float32(view[i, right]) - np.float32(view[i, left])
                                    - view_mean[i, right] + view_mean[i, left])
                            + np.float32(current[i, right]) - np.float32(current[i, left])
                            - mean[i, right] + mean[i, left])
            gy = quarter * (gain * (np.float32(view[below, j]) - np.float32(view[above, j])
                                    - view_mean[below, j] + view_mean[above, j])
                            + np.float32(current[below, j]) - np.float32(current[above, j])
                            - mean[below, j] + mean[above, j])
            along = radial * c - position[2] * s
            depth = radial * s + position[2] * c
            slope[i, j] = -(gx * along + gy * across / max(abs(s), np.float32(0.02))) / max(
                one - rho[i, j] * depth, np.float32(0.05))
            e = (np.float32(current[i, j]) - mean[i, j]
                 - gain * (np.float32(view[i, j]) - view_mean[i, j]))
            error[i, j] = e
            squared[i, j] = min(e * e, np.float32(_MOST))


@fast_kernel
def _in_light(first: int, last: int, current: Image8, view: Image8, gain: np.float32,
              out: Map) -> None:  # pragma: no cover - compiled
    for i in range(first, last):
        for j in range(out.shape[1]):
            out[i, j] = np.float32(current[i, j]) - gain * np.float32(view[i, j])


@fast_kernel
def _agree(first: int, last: int, wanted: Map, view: Image8, gain: np.float32, rho: Map,
           baseline: np.float32, least: Map, most: Map, total: Map,
           count: Map) -> None:  # pragma: no cover - compiled
    """Take one reference's difference in grey into the least and the most of them, and into the
    total of what they count.

    Where the reference looks too different, nothing is taken; baseline 0 = it always counts.
    """
    for i in range(first, last):
        for j in range(rho.shape[1]):
            if abs(rho[i, j]) * baseline >= np.float32(REACH):
                continue
            e = min(abs(wanted[i, j] - gain * np.float32(view[i, j])), np.float32(_MOST_GREY))
            least[i, j] = min(least[i, j], e)
            most[i, j] = max(most[i, j], e)
            total[i, j] += e / (e + np.float32(_HALF))
            count[i, j] += np.float32(1)


@fast_kernel
def _collect(first: int, last: int, rho: Map, slope: Map, error: Map, fit: Map, best: Map,
             baseline: np.float32, weighted: Map,
             weight: Map) -> None:  # pragma: no cover - compiled
    """Add one reference's measurements where it fits and is not too far away."""
    noise = np.float32(_NOISE * _NOISE)
    for i in range(first, last):
        for j in range(rho.shape[1]):
            good = (fit[i, j] < np.float32(_UNFIT) * best[i, j] + 2 * noise) & (
                abs(rho[i, j]) * baseline < np.float32(REACH))
            w = one_if(good) / (fit[i, j] + noise)
            gg = w * slope[i, j] * slope[i, j]
            weighted[i, j] += w * slope[i, j] * error[i, j] + gg * rho[i, j]
            weight[i, j] += gg


@fast_kernel
def one_if(condition: bool) -> np.float32:  # pragma: no cover - compiled
    """1 or 0."""
    return np.float32(1) if condition else np.float32(0)


def _mean(image: NDArray[np.uint8]) -> Map:
    return np.asarray(cv2.boxFilter(image, cv2.CV_32F, (_MEAN_WINDOW, _MEAN_WINDOW)))


def _gain(current: Image8, mean: Map, view: Image8, view_mean: Map) -> np.float32:
    """How much more contrast the current view has."""
    a = (current[::4, ::4] - mean[::4, ::4]).ravel()
    b = (view[::4, ::4] - view_mean[::4, ::4]).ravel()
    ratio = np.sqrt(float(a @ a) / max(float(b @ b), 1e-9))
    return np.float32(min(max(ratio, 1 / _MOST_GAIN), _MOST_GAIN))


def _averaged(rho: Map, weighted: Map, weight: Map, window: int) -> tuple[Map, Map]:
    """Inverse range averaged in windows, and the sum of weights in them."""
    sums, information = (cv2.boxFilter(m, -1, (window, window), normalize=False)
                         for m in (weighted, weight))
    hold = np.float32(_HOLD)
    return np.asarray((sums + hold * rho) / (information + hold)), information


def _levelled(rho: Map, weighted: Map, weight: Map, window: int) -> tuple[Map, Map]:
    """Inverse range averaged in windows, and the sum of weights in them."""
    size = (window, window)
    level, off = cv2.blur(rho, size), np.empty_like(rho)
    rows_in_parallel(_off_level, len(rho), weighted, weight, level, off)
    sums, information = (np.asarray(cv2.boxFilter(m, -1, size, normalize=False))
                         for m in (off, weight))
    rows_in_parallel(_from_level, len(rho), rho, level, sums, information, off)
    return off, information


@fast_kernel
def _off_level(first: int, last: int, weighted: Map, weight: Map, level: Map,
               out: Map) -> None:  # pragma: no cover - compiled
    for i in range(first, last):
        for j in range(out.shape[1]):
            out[i, j] = weighted[i, j] - weight[i, j] * level[i, j]


@fast_kernel
def _from_level(first: int, last: int, rho: Map, level: Map, sums: Map, information: Map,
                out: Map) -> None:  # pragma: no cover - compiled
    hold = np.float32(_HOLD)
    for i in range(first, last):
        for j in range(out.shape[1]):
            start = level[i, j]
            out[i, j] = start + (sums[i, j] + hold * (rho[i, j] - start)) / (
                information[i, j] + hold)


class JointRefinement:
    """The current view on a polar grid, to which references are fitted.

    Parameters
    ----------
    current : the current view on `grid`, uint8
    grid, axes : the grid and its axes (3, 3) in the current optical frame
    references : equirectangular images (H, 2H) and poses, nearest first

    Attributes
    ----------
    view, grid, axes : as given
    baselines : of the references, m

    """

    def __init__(self, current: Image8, grid: PolarGrid, axes: Floats,
                 references: Sequence[tuple[Image8, RelativePose]]) -> None:
        self.view, self._mean = current, _mean(current)
        self.grid, self.axes, self._references = grid, axes, references
        self.baselines = [pose.baseline for _, pose in references]
        theta, azimuth = grid.theta(), grid.azimuth()
        self._angles = [np.ascontiguousarray(a, np.float32) for a in (
            np.cos(theta), np.sin(theta), np.cos(azimuth), np.sin(azimuth))]

    def refined(self, rho: Map, window: int) -> Refined:
        """One step from `rho` (1/m, of the grid's shape), averaged in windows of `window` px."""
        weighted, weight, best = self._collected(rho)
        return Refined(*_averaged(rho, weighted, weight, window), best)

    def levelled(self, rho: Map, window: int, wide: int = 0) -> Refined:
        """One step from `rho`, as `refined`, but what is averaged is how far each pixel lies off
        the mean of its surroundings: where a surface slants, its slope is no noise.

        wide : px of a second window, which counts where both say the same (after the intersection
            of confidence intervals, Katkovnik 1999); 0 = none
        """
        weighted, weight, best = self._collected(rho)
        return Refined(*self._on_level(rho, weighted, weight, window, wide), best)

    def adapted(self, rho: Map, window: int, level: tuple[int, int]) -> Refined:
        """One step from `rho`: as `refined` where little parallax has to be averaged widely, and
        `levelled` by (window, wide) where, near by, slopes are what disturbs.
        """
        weighted, weight, best = self._collected(rho)
        far, information = _averaged(rho, weighted, weight, window)
        near, _ = self._on_level(rho, weighted, weight, *level)
        slanted = far > np.float32(1 / (NEAR_BY * self.baselines[0]))
        return Refined(np.where(slanted, near, far), information, best)

    def _on_level(self, rho: Map, weighted: Map, weight: Map, window: int,
                  wide: int) -> tuple[Map, Map]:
        narrow, information = _levelled(rho, weighted, weight, window)
        if wide:
            alike = np.float32(_SAME * self.grid.pixel / self.baselines[0])
            broad, _ = _levelled(rho, weighted, weight, wide)
            narrow = np.where(np.abs(broad - narrow) < alike, broad, narrow)
        return narrow, information

    def _collected(self, rho: Map) -> tuple[Map, Map, Map]:
        """Sums over the references of weighted measurements and of weights, and the misfit."""
        found = [self._difference(image, pose, rho) for image, pose in self._references]
        best = found[0][2].copy()
        for _, _, fit in found[1:]:
            np.minimum(best, fit, out=best)
        weighted, weight = np.zeros_like(rho), np.zeros_like(rho)
        for (slope, error, fit), (_, pose) in zip(found, self._references, strict=True):
            rows_in_parallel(_collect, len(rho), rho, slope, error, fit, best,
                             np.float32(pose.baseline), weighted, weight)
        return weighted, weight, best

    def looked_at(self, rho: Map, window: int) -> Refined:
        """`rho` as it is, and what is told of it in windows of `window` px."""
        _, weight, best = self._collected(rho)
        return Refined(rho, np.asarray(cv2.boxFilter(weight, -1, (window, window),
                                                     normalize=False)), best)

    def misfit(self, rho: Map) -> Map:
        """Mean squared grey difference round each pixel, if it lies at `rho`, of the nearest
        reference.
        """
        return self._difference(*self._references[0], rho)[2]

    def compared(self, rho: Map) -> Comparison:
        """How the references look at other ranges, in the light of `rho` (1/m), what was measured.

        A reference without contrast shows nothing that could be compared; the nearest always
        counts.
        """
        seen, wide = [], round(_LIGHT * self.grid.height / 2) * 2 + 1
        for n, (image, pose) in enumerate(self._references):
            view = reference_in_relief(image, pose, self.grid, self.axes, rho)
            gain = _gain(self.view, self._mean, view, _mean(view))
            if n == 0 or gain < _MOST_GAIN:
                light = np.empty_like(rho)
                rows_in_parallel(_in_light, len(rho), self.view, view, gain, light)
                light = np.asarray(cv2.blur(light, (wide, wide)))
                seen.append(_InLight(image, pose, self.view - light, gain,
                                     np.float32(pose.baseline if n else 0)))
        return Comparison(self.grid, self.axes, seen)

    def _difference(self, image: Image8, pose: RelativePose, rho: Map) -> tuple[Map, Map, Map]:
        view = reference_in_relief(image, pose, self.grid, self.axes, rho)
        view_mean = _mean(view)
        slope, error, squared = (np.empty_like(rho) for _ in range(3))
        position = np.asarray(self.axes.T @ pose.position, np.float32)
        gain = _gain(self.view, self._mean, view, view_mean)
        rows_in_parallel(_differences, len(rho), self.view, self._mean, view, view_mean, gain,
                         rho, *self._angles, position, np.float32(1 / self.grid.pixel), slope,
                         error, squared)
        fit = cv2.boxFilter(squared, -1, (_FIT_WINDOW, _FIT_WINDOW))
        return slope, error, fit


@dataclass(frozen=True)
class _InLight:
    """A reference; what `gain` times its view should be, float32 on the grid; and its baseline
    (0: the nearest, which counts everywhere).
    """

    image: Image8
    pose: RelativePose
    wanted: Map
    gain: np.float32
    baseline: np.float32


@dataclass(frozen=True)
class Agreement:
    """Differences in grey of the references: grey levels, float32 of the grid's shape.

    least, most : of the references
    typical : of all, where a large one counts little more than a fair one: a reference from which
        something is hidden does little harm, and one that fits by chance little good
    around : the same round about, at half the size
    """

    least: Map
    most: Map
    typical: Map
    around: Map


def _levels_of(share: NDArray[Any]) -> Map:
    """Grey levels of a difference that counts so much of what any may."""
    return np.asarray(np.float32(_HALF) * share / (1 - share), np.float32)


class Comparison:
    """How references look if what was measured lies elsewhere.

    Their light (gain, and what differs over a wide window) is that of what was measured: means at
    a supposed range would be of other things wherever only a part of them lies there.
    """

    def __init__(self, grid: PolarGrid, axes: Floats, references: Sequence[_InLight]) -> None:
        self._grid, self._axes, self._references = grid, axes, references

    def difference(self, rho: Map, spread: float) -> Map:
        """How far the references differ round each pixel (Gaussian, of so many px), if it lies at
        `rho`: a share of what they may, of the grid's shape, as `Agreement.typical`.
        """
        return np.asarray(cv2.GaussianBlur(self._compared(rho)[2], (0, 0), spread))

    def agreement(self, rho: Map) -> Agreement:
        """How far the references differ from each pixel by itself, if it lies at `rho`."""
        least, most, share = self._compared(rho)
        rows, columns = (n // 2 for n in rho.shape)
        half = cv2.resize(share, (columns, rows), interpolation=cv2.INTER_AREA)
        around = cv2.GaussianBlur(half, (0, 0), _AROUND)
        return Agreement(least, most, _levels_of(share), _levels_of(around))

    def _compared(self, rho: Map) -> tuple[Map, Map, Map]:
        """Least and most difference, grey levels, and the mean share of what it may be."""
        least, most = np.full_like(rho, _MOST_GREY), np.zeros_like(rho)
        total, count = np.zeros_like(rho), np.zeros_like(rho)
        for r in self._references:
            view = reference_in_relief(r.image, r.pose, self._grid, self._axes, rho)
            rows_in_parallel(_agree, len(rho), r.wanted, view, r.gain, rho, r.baseline, least,
                             most, total, count)
        return least, most, total / count  # the nearest reference always counts
