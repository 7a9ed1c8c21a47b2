"""Matching of two cameras that look at the same moment, and of earlier frames beside them.

Nothing moves between the two views, and no frame before is needed, so more is made of the pair
itself: what was matched forth and back stands where the sweep does not see something much nearer,
and the sweep confirms what the match does not know. What was matched is refined; where it is far
away both are averaged, for their errors have little in common.
"""
from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from .frames import Frame, Image8, Reference, RelativePose
from .inverse_range import NOTHING, InverseRange, _grid_angles, inverse_range
from .jit import kernel, rows_in_parallel
from .joint import Floats, JointMatcher, in_steps
from .judgement import Evidence, Found, Judged, by_agreement
from .matching import Matcher, Parallax, stereo_grid
from .refinement import JointRefinement, Refined
from .sphere import polar_axes
from .warp import Map

# px, of the pair alone and of several references: one tells less of a pixel.
_WINDOW, _WIDE, _NARROW = 15, 25, 9
_ALIKE = 1.0  # px by which a match and its refinement may differ
_FAR = 30.0  # baselines, from which on both are averaged
# Something near may hide there: so many times nearer, and nearer than so many baselines.
_NEARER, _NEAR = 1.4, 35.0
# It fits: squared grey levels, as a multiple of what the match has, and beside it.
_FITS, _GREY = 2.0, 8.0
_CONE = 0.94  # cosine of the angle from the pair's poles within which motion is asked
_CONTRADICTS = 3.0  # standard deviations


def with_cones(pair: InverseRange, motion: InverseRange, direction: Floats) -> InverseRange:
    """What motion tells near the poles of the pair, where the pair tells little.

    Where they contradict each other, nothing is known. Elsewhere the pair's word stands.

    direction : (3,) from one camera to the other, current optical frame
    """
    cos_lat, sin_lat, cos_lon, sin_lon = _grid_angles(len(pair.rho))
    x, y, z = (np.float32(v) for v in direction)
    cosine = cos_lat[:, None] * (sin_lon * x + cos_lon * z) - (sin_lat * y)[:, None]
    better = (np.abs(cosine) > _CONE) & (motion.sigma < pair.sigma)
    differ = better & (pair.sigma < NOTHING) & (
        np.abs(pair.rho - motion.rho) > _CONTRADICTS * np.hypot(pair.sigma, motion.sigma))
    sigma = np.where(better, motion.sigma, pair.sigma)
    return InverseRange(np.where(better, motion.rho, pair.rho),
                        np.where(differ, np.float32(NOTHING), sigma),
                        pair.signed and motion.signed)


@kernel
def _pair_rows(first: int, last: int, matched: Map, matched_sigma: Map, refined: Map,
               refined_sigma: Map, other: Map, frames: Evidence, limits: Map, alone: bool,
               swept: bool, rho: Map, sigma: Map) -> None:  # pragma: no cover - compiled
    """Of the match, its refinement and the second opinion: inverse range, and σ where believed.

    limits : 1/m of a pixel, of where both are averaged, of what is near
    """
    pixel, far, near = limits
    for i in range(first, last):
        for j in range(rho.shape[1]):
            value, spread, first_value = refined[i, j], refined_sigma[i, j], matched[i, j]
            known = matched_sigma[i, j] < np.float32(NOTHING)
            if known and abs(value - first_value) < np.float32(_ALIKE) * pixel:
                spread = matched_sigma[i, j] if alone else min(spread, matched_sigma[i, j])
                if first_value < far:
                    value = np.float32(0.5) * (value + first_value)
            elif known:
                value, spread = first_value, matched_sigma[i, j]
            hides = other[i, j]
            hidden = (hides > near and hides > np.float32(_NEARER) * value
                      and hides > value + pixel)
            sure = frames[i, j] > 0
            believed = (sure or (known and not hidden)) if swept else (sure and known)
            rho[i, j] = value
            sigma[i, j] = spread if believed else np.float32(NOTHING)


class PairMatcher(JointMatcher):
    """Measures the current frame with another camera.

    method : 'joint', or 'joint_fast' (no sweep; what refinement bears out is believed)
    first : matches the pair
    baseline_sigma : relative standard deviation of the baseline where its pose tells none
    """

    def __init__(self, method: str, first: Matcher, baseline_sigma: float = 0.0) -> None:
        super().__init__(method, first, baseline_sigma)
        self._found: Parallax | None = None

    def measured(self, current: Frame, references: Sequence[Reference]) -> InverseRange:
        """Inverse range on the current frame's grid, and its sigma.

        references : the other camera first, then earlier frames
        """
        alone = len(references) == 1
        new = self.measure(current, references)
        height, pose = current.image.shape[0], in_steps(references[0].pose)
        grid = stereo_grid(height)
        assert self._found is not None
        matched = inverse_range(self._found, grid, polar_axes(pose.direction), pose, height,
                                self._baseline_sigma)
        limits = np.array([grid.pixel, 1 / _FAR if alone else -np.inf, 1 / _NEAR],
                          np.float32) / np.float32(pose.baseline)
        rho, sigma = np.empty_like(new.rho), np.empty_like(new.rho)
        rows_in_parallel(_pair_rows, height, matched.rho, matched.sigma, new.rho, new.sigma,
                         new.other, new.frames, limits, alone, self._sweeps, rho, sigma)
        return InverseRange(rho, sigma, self.signed)

    def _refined(self, refinement: JointRefinement, start: Map) -> Refined:
        if len(refinement.baselines) > 1:
            found = refinement.refined(start, _NARROW)
            return refinement.levelled(found.rho, _NARROW) if self._sweeps else found
        found = refinement.levelled(start, _WINDOW)
        return refinement.levelled(found.rho, _WINDOW, _WIDE) if self._sweeps else found

    def _sharpened(self, refinement: JointRefinement,
                   pairs: Sequence[tuple[Image8, RelativePose]], known: Refined) -> Refined:
        del refinement, pairs
        return known

    def _swept(self, pairs: Sequence[tuple[Image8, RelativePose]],
               ) -> list[tuple[Image8, RelativePose]]:
        return list(pairs[:1])

    def _parallax(self, current: Image8, reference: Image8) -> Parallax:
        self._found = super()._parallax(current, reference)
        return self._found

    def _judged(self, found: Found, refinement: JointRefinement) -> Judged:
        """What the sweep sees nearer counts only where the pictures bear it out."""
        rho, other = found.refined.rho, found.other
        if self._sweeps:
            fits = refinement.misfit(other) < _FITS * found.refined.misfit + _GREY
            other = np.where(fits | (other < _NEARER * rho), other, np.float32(0))
        return by_agreement(found, other, refinement.grid, refinement.baselines[0], self._sweeps)
