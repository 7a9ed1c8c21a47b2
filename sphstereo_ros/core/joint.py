"""Joint matching: one measurement of inverse range from all references of a window.

    nearest pair matched → refined on all references → compared with a second opinion

The nearest pair decides what is near: its parallaxes are small, so nothing is missed by a search
that ends. The farther references then sharpen what it found. The second opinion, a sweep over the
sphere, errs in other places than a dense flow does; how both look decides what is believed.
"""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from .alternatives import alternatives
from .frames import UNSCALED, Frame, Image8, Reference, RelativePose
from .guided_sweep import guided_sweep
from .inverse_range import NOTHING, _grid_angles, _polar_row, pose_sigmas
from .jit import fast_kernel, kernel, rows_in_parallel
from .judgement import DEPENDENT, Evidence, Found, Judged, by_agreement, by_looks
from .matching import UNKNOWN, Matcher, Parallax, stereo_grid
from .moving import off_meridian
from .photometric import in_one_light
from .refinement import REACH, JointRefinement, Refined
from .rims import own_surface
from .sphere import polar_axes
from .sweep import sweep
from .warp import Map, PolarGrid, polar_map, resample, with_border

Floats = NDArray[np.float64]

# References of the sweep reach that many times as far as the nearest: beyond, its levels would
# change faster than one a pixel on a road.
_SWEPT = 5.0
_WINDOWS = {'joint': (9, 9), 'joint_fast': (9,)}
# px: of what was swept, and on a slope; of one reference alone, which tells less of a pixel, at
# _TALL rows: less where there are fewer, for it must not see across what is there.
_LAST, _LAST_LEVEL = 9, (9, 15)
_ALONE, _ALONE_LEVEL, _TALL = 21, (15, 25), 960
_LEAST_CONTRAST = 0.1  # of the current frame's: with less, a reference shows nothing
_CELL, _SPREADS = 8, (1.0, 6.0)  # px, cells: how what was not matched is filled for a start


@dataclass(frozen=True)
class Measurement:
    """Inverse range on the current frame's grid, float32 (H, 2H), 1/m (1/step if not metric).

    rho, sigma : where it is believed; sigma is what it would be elsewhere too
    other : the second opinion by itself
    frames : int8, for how many frames of evidence it counts, as `Judged.frames`
    told : standard deviation by what the grey tells alone, if nothing misleads it
    pose : the pose's share of sigma
    moving : uint8 (H // 2, 2 * (H // 2)), 255 = leaves its meridian; None if that was not measured
    wider : float32 (7, H, 2H), what is told by what is round about, as `Judged.wider`
    """

    rho: Map
    sigma: Map
    other: Map
    frames: Evidence
    told: Map
    pose: Map
    moving: Image8 | None = None
    wider: NDArray[np.float32] | None = None


def in_steps(pose: RelativePose) -> RelativePose:
    """The pose with positions in metres, or in steps between frames where metres are unknown."""
    return pose if pose.is_metric else _stretched(pose, 1 / UNSCALED)


def _stretched(pose: RelativePose, times: float) -> RelativePose:
    """The pose with a position that is so many times as far."""
    covariance = None
    if pose.covariance is not None:
        stretch = np.diag([1.0, 1.0, 1.0, *[times] * 3])
        covariance = stretch @ pose.covariance @ stretch
    return RelativePose(pose.rotation, times * pose.position, covariance)


def _showing(current: Frame, references: Sequence[Reference]) -> list[Reference]:
    """The nearest, and all others that show something: without contrast they would only mislead.
    """
    least = _LEAST_CONTRAST * float(current.image[::4, ::4].std())
    return [r for n, r in enumerate(references)
            if n == 0 or float(r.frame.image[::4, ::4].std()) > least]


def _by_nearest(references: Sequence[Reference],
                ) -> tuple[list[tuple[Image8, RelativePose]], float]:
    """Images and poses with positions in units of the nearest baseline, and that baseline, m (or
    steps): what is found does not hang on the scale, then.
    """
    poses = [in_steps(r.pose) for r in references]
    unit = poses[0].baseline
    return [(r.frame.image, _stretched(pose, 1 / unit))
            for r, pose in zip(references, poses, strict=True)], unit


@fast_kernel
def _nearness_rows(first: int, last: int, pixels: Map, cos_theta: Map, sin_theta: Map,
                   pixel: np.float32, per_baseline: np.float32,
                   rho: Map) -> None:  # pragma: no cover - compiled
    """ρ = sin δ / (b sin θ1), or UNKNOWN."""
    one = np.float32(1)
    for i in range(first, last):
        for j in range(cos_theta.size):
            delta = pixels[i, j] * pixel
            d2 = min(delta * delta, one)
            # sin δ to 2e-6 up to 1 rad
            sin_d = delta * (one - d2 * np.float32(1 / 6) * (one - d2 * np.float32(1 / 20) * (
                one - d2 * np.float32(1 / 42))))
            cos_d = np.sqrt(max(one - sin_d * sin_d, np.float32(0)))
            before = sin_theta[j] * cos_d - cos_theta[j] * sin_d  # sin θ1
            known = (pixels[i, j] != UNKNOWN) & (before > np.float32(1e-3)) & (d2 < one)
            found = sin_d * per_baseline / max(before, np.float32(1e-3))
            rho[i, j] = found if known else np.float32(UNKNOWN)


def _nearness(parallax: Parallax, grid: PolarGrid, baseline: float) -> Map:
    rho, theta = np.empty(grid.shape, np.float32), grid.theta()
    rows_in_parallel(_nearness_rows, len(rho), parallax.pixels, np.cos(theta).astype(np.float32),
                     np.sin(theta).astype(np.float32), np.float32(grid.pixel),
                     np.float32(1 / baseline), rho)
    return rho


def filled(rho: Map) -> Map:
    """`rho` with what is UNKNOWN taken smoothly from round about (0 where nothing is known)."""
    known = (rho != UNKNOWN).astype(np.float32)
    rows, columns = (-(-n // _CELL) for n in rho.shape)
    sums = [cv2.resize(m, (columns, rows), interpolation=cv2.INTER_AREA)
            for m in (np.where(known > 0, rho, np.float32(0)), known)]
    total, count = np.zeros((2, rows, columns), np.float32)
    for spread, weight in zip(_SPREADS, (1.0, 0.01), strict=True):
        total += weight * cv2.GaussianBlur(sums[0], (0, 0), spread)
        count += weight * cv2.GaussianBlur(sums[1], (0, 0), spread)
    smooth = cv2.resize(total / np.maximum(count, 1e-6), rho.shape[::-1])
    return np.where(known > 0, rho, smooth).astype(np.float32)


@kernel
def _measure_rows(first: int, last: int, cos_lat: Map, sin_lat: Map, cos_lon: Map, sin_lon: Map,
                  axes: Map, at_pole: Map, rho: Map, error: Map, frames: Evidence, other: Map,
                  baselines: Map, ways: Map, pose: Map, told: Map, wider: NDArray[np.float32],
                  per_unit: np.float32, out: Map, sigma_out: Map, other_out: Map,
                  frames_out: Evidence, told_out: Map, pose_out: Map,
                  wider_out: NDArray[np.float32]) -> None:  # pragma: no cover - compiled
    """Sample the polar grid; σ of every pixel, with the pose's share.

    at_pole : column of the pole, row of the azimuth 0, rad of a pixel, px that no match beats;
    ways : (references, 3) directions of motion; pose : (references, 3) standard deviations of
    rotation, direction, baseline; per_unit : 1/m of what inverse range and baselines are given in
    """
    at = np.empty((4, cos_lon.size), np.float32)
    half, nothing = np.float32(0.5), np.float32(NOTHING)
    for i in range(first, last):
        _polar_row(cos_lat[i], sin_lat[i], cos_lon, sin_lon, axes, at_pole[0], at_pole[1],
                   np.float32(1) / at_pole[2], at)
        for j in range(cos_lon.size):
            c, r = np.int32(at[2, j]), np.int32(at[3, j])
            fc, fr = at[2, j] - np.float32(c), at[3, j] - np.float32(r)
            a, b, d, e = rho[r, c], rho[r, c + 1], rho[r + 1, c], rho[r + 1, c + 1]
            cn, rn = np.int32(at[2, j] + half), np.int32(at[3, j] + half)
            value = rho[rn, cn]
            spread = max(max(a, b), max(d, e)) - min(min(a, b), min(d, e))
            if spread < np.float32(0.05) * abs(value):
                value = (a * (1 - fc) + b * fc) * (1 - fr) + (d * (1 - fc) + e * fc) * fr
            # The reference that sees it from the side, as far away as looks alike.
            k, sine, cosine = 0, max(at[0, j], np.float32(0.01)), at[1, j]
            for n in range(1, baselines.size):
                c = (cos_lat[i] * (sin_lon[j] * ways[n, 0] + cos_lon[j] * ways[n, 2])
                     - sin_lat[i] * ways[n, 1])
                s = np.sqrt(max(np.float32(1) - c * c, np.float32(1e-4)))
                if abs(value) * baselines[n] < np.float32(REACH) and (
                        baselines[n] * s > baselines[k] * sine):
                    k, sine, cosine = n, s, c
            match = at_pole[3] * at_pole[2]
            by_angle = np.sqrt(match * match + pose[k, 0] * pose[k, 0]) / (baselines[k] * sine)
            by_pose = value * (cosine / sine * pose[k, 1] + pose[k, 2])
            likely = error[rn, cn]
            out[i, j] = value * per_unit
            sigma_out[i, j] = min(per_unit * np.sqrt(likely * likely + by_angle * by_angle
                                                     + by_pose * by_pose), nothing)
            other_out[i, j] = other[rn, cn] * per_unit
            frames_out[i, j] = frames[rn, cn]
            told_out[i, j] = told[rn, cn] * per_unit
            pose_out[i, j] = min(per_unit * np.sqrt(by_angle * by_angle + by_pose * by_pose),
                                 nothing)
            for n in range(wider.shape[0]):
                wider_out[n, i, j] = wider[n, rn, cn] * per_unit


def _scaled(most: int, least: int, height: int) -> int:
    """An odd window of `most` px at _TALL rows."""
    return max(least, min(most, round(most * height / _TALL)) // 2 * 2 + 1)


class JointMatcher:
    """Measures a window.

    method : 'joint', or 'joint_fast' (one refinement, and what was matched is the second opinion)
    first : matches the nearest pair
    baseline_sigma : relative standard deviation of a baseline where its pose tells none
    """

    def __init__(self, method: str, first: Matcher, baseline_sigma: float = 0.0) -> None:
        self._first = first
        self._baseline_sigma = baseline_sigma
        self._sweeps = method == 'joint'
        self.signed = self._sweeps  # block matching cannot say that a point is beyond all range
        self._windows = _WINDOWS[method]

    def measure(self, current: Frame, references: Sequence[Reference]) -> Measurement:
        """Inverse range of every pixel; `references` nearest first, all metric or none.

        What is found counts in nearest baselines until it is put back on the sphere.
        """
        pairs, unit = _by_nearest(_showing(current, references))
        height = current.image.shape[0]
        grid = stereo_grid(height)
        axes = polar_axes(pairs[0][1].direction)
        view = np.asarray(resample(with_border(current.image),
                                   polar_map(grid, axes, current.image.shape)), np.uint8)
        before, now = self._alike(view, pairs[0], grid, axes)
        parallax = self._parallax(now, before)
        matched = _nearness(parallax, grid, pairs[0][1].baseline)
        refinement = JointRefinement(view, grid, axes, pairs)
        refined = self._refined(refinement, filled(matched))
        moving = off_meridian(parallax, refined.misfit, grid, axes, pairs[0][1], height)
        if self._sweeps:
            coarse, _ = sweep(view, grid, axes, self._swept(pairs))
            other = cv2.resize(coarse, grid.shape[::-1], interpolation=cv2.INTER_LINEAR)
            refined = self._sharpened(refinement, pairs, refined)
        else:
            other = matched
        found = Found(view, now, before, refined, other, matched, parallax)
        judged = self._judged(found, refinement)
        measured = self._on_sphere(refined, judged, grid, axes, pairs, unit, height)
        return replace(measured, moving=moving)

    def _judged(self, found: Found, refinement: JointRefinement) -> Judged:
        grid, baselines = refinement.grid, refinement.baselines
        if self._sweeps:
            others = alternatives(found.refined.rho, found.other, refinement)
            return by_looks(found, others, grid, baselines)
        return by_agreement(found, found.other, grid, baselines[0], swept=False)

    def _swept(self, pairs: Sequence[tuple[Image8, RelativePose]],
               ) -> list[tuple[Image8, RelativePose]]:
        return [p for p in pairs if p[1].baseline <= _SWEPT * pairs[0][1].baseline]

    def _alike(self, view: Image8, nearest: tuple[Image8, RelativePose], grid: PolarGrid,
               axes: Floats) -> tuple[Image8, Image8]:
        """The nearest reference's view on the grid and the current one, in one light."""
        image, pose = nearest
        return in_one_light(np.asarray(resample(with_border(image), polar_map(
            grid, pose.rotation.T @ axes, image.shape)), np.uint8), view)

    def _parallax(self, current: Image8, reference: Image8) -> Parallax:
        return self._first(current, reference)

    def _refined(self, refinement: JointRefinement, start: Map) -> Refined:
        if self._sweeps and len(refinement.baselines) == 1:
            wide, *level = (_scaled(most, least, refinement.grid.height) for most, least in zip(
                (_ALONE, *_ALONE_LEVEL), (_LAST, *_LAST_LEVEL), strict=True))
            return refinement.adapted(refinement.refined(start, wide).rho, wide,
                                      (level[0], level[1]))
        found = refinement.refined(start, self._windows[0])
        for window in self._windows[1:]:
            found = refinement.refined(found.rho, window)
        return found

    def _sharpened(self, refinement: JointRefinement,
                   pairs: Sequence[tuple[Image8, RelativePose]], known: Refined) -> Refined:
        """Swept near what is known, refined within half a level (a window alone would carry
        ranges across rims), and each pixel put to its own surface. One reference alone has too
        little parallax for that.
        """
        if len(pairs) == 1:
            return known
        size = refinement.grid.shape[::-1]
        swept = guided_sweep(refinement.view, refinement.grid, refinement.axes, pairs, known.rho)
        rho, step = (np.asarray(cv2.resize(m, size, interpolation=cv2.INTER_LINEAR))
                     for m in (swept.rho, np.float32(0.5) * swept.step))
        found = refinement.adapted(rho, _LAST, _LAST_LEVEL)
        sharp = np.clip(found.rho, rho - step, rho + step)
        return refinement.looked_at(own_surface(sharp, refinement), _LAST)

    def _on_sphere(self, refined: Refined, judged: Judged, grid: PolarGrid, axes: Floats,
                   pairs: Sequence[tuple[Image8, RelativePose]], unit: float,
                   height: int) -> Measurement:
        rho, sigma, second, told, pose = np.empty((5, height, 2 * height), np.float32)
        noise = np.float32(DEPENDENT) / np.sqrt(np.maximum(refined.information, 1e-9))
        frames = np.empty(rho.shape, np.int8)
        at_pole = np.array([grid.margin - 0.5, grid.wrap - 0.5, grid.pixel, judged.floor],
                           np.float32)
        poses = np.array([pose_sigmas(p) for _, p in pairs], np.float32)
        poses[poses[:, 2] == 0, 2] = self._baseline_sigma
        baselines = np.array([p.baseline for _, p in pairs], np.float32)
        ways = np.array([p.direction for _, p in pairs], np.float32)
        wider = judged.wider
        around = np.empty((0 if wider is None else len(wider), *rho.shape), np.float32)
        rows_in_parallel(_measure_rows, height, *_grid_angles(height),
                         np.ascontiguousarray(axes, np.float32), at_pole, judged.rho,
                         judged.error, judged.frames, judged.other, baselines, ways, poses, noise,
                         np.empty((0, 0, 0), np.float32) if wider is None else wider,
                         np.float32(1 / unit), rho, sigma, second, frames, told, pose, around)
        return Measurement(rho, sigma, second, frames, told, pose,
                           wider=None if wider is None else around)
