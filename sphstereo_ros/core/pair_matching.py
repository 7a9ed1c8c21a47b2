"""Matching of one pair of cameras that look at the same moment.

Nothing moves between the two views, and no earlier frame helps, so more is made of the pair
itself: what was matched forth and back and what refinement makes of it are averaged, for their
errors have little in common. What the match does not know, the sweep may confirm; where the sweep
sees something much nearer, nothing is believed.
"""
from __future__ import annotations

import numpy as np

from .frames import Frame, Image8, Reference, RelativePose
from .inverse_range import NOTHING, InverseRange, inverse_range
from .joint import Floats, JointMatcher, in_steps
from .matching import Matcher, Parallax, stereo_grid
from .sphere import polar_axes
from .warp import PolarGrid

_WINDOW = 15  # px: one reference tells less of a pixel than several
_ALIKE = 1.0  # px by which a match and its refinement may differ
# Something near may hide there: so many times nearer, and nearer than so many baselines.
_NEARER, _NEAR = 1.4, 35.0


class PairMatcher(JointMatcher):
    """Measures the current frame with one other camera.

    first : matches the pair
    baseline_sigma : relative standard deviation of the baseline where its pose tells none
    """

    def __init__(self, first: Matcher, baseline_sigma: float = 0.0) -> None:
        super().__init__('joint', first, baseline_sigma)
        self._windows = (_WINDOW,)
        self._found: Parallax | None = None

    def measured(self, current: Frame, reference: Reference) -> InverseRange:
        """Inverse range on the current frame's grid, and its sigma."""
        new = self.measure(current, (reference,))
        height, pose = current.image.shape[0], in_steps(reference.pose)
        grid = stereo_grid(height)
        assert self._found is not None
        matched = inverse_range(self._found, grid, polar_axes(pose.direction), pose, height,
                                self._baseline_sigma)
        known = matched.sigma < NOTHING
        alike = np.abs(new.rho - matched.rho) < np.float32(_ALIKE * grid.pixel / pose.baseline)
        rho = np.where(known, np.where(alike, (new.rho + matched.rho) / 2, matched.rho), new.rho)
        near = np.float32(1 / (_NEAR * pose.baseline))
        hidden = (new.other > near) & (new.other > np.float32(_NEARER) * rho) \
            & (new.other > rho + np.float32(grid.pixel / pose.baseline))
        believed = (known & ~hidden) | (new.agreed > 0)
        sigma = np.where(known, matched.sigma, new.sigma)
        return InverseRange(rho, np.where(believed, sigma, np.float32(NOTHING)), self.signed)

    def _parallax(self, view: Image8, nearest: tuple[Image8, RelativePose], grid: PolarGrid,
                  axes: Floats) -> Parallax:
        self._found = super()._parallax(view, nearest, grid, axes)
        return self._found
