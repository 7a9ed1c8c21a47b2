"""Stage 4, spherical stereo: an aligned window becomes a range image."""
from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import cv2
import numpy as np

from .beside import beside
from .config import Config
from .floor import floor_plane, floor_seen, under_floor
from .frames import (
    AlignedWindow,
    Drop,
    Frame,
    FrameKey,
    Image8,
    RangeImage,
    Reference,
    RelativePose,
)
from .inverse_range import NOTHING, InverseRange, fuse, inverse_range, published_range
from .islands import far_islands
from .joint import JointMatcher
from .match_judge import judged_matcher
from .matching import matcher, stereo_grid
from .moving import moving_parts
from .pair_matching import PairMatcher, with_cones
from .range_memory import RangeMemory
from .rig import Rig
from .rotations import mount
from .smoothing import smoothed
from .walls import walls_seen
from .warp import aligned_pair

# Sigma over range, at most, of what no network chose by what is round about and remembered.
_UNJUDGED = 0.5


class SphericalStereo:
    """Range of the current frame from all references of a window, and from the windows before.

    The joint matchers measure with all references together and remember; the others match pair
    by pair.
    """

    def __init__(self, config: Config, mask: Image8 | None = None) -> None:
        self.config = config
        self._match = matcher(config.stereo)
        self._judged = config.stereo.matcher == 'bm_judged'
        if self._judged:
            self._match = judged_matcher(self._match)
        self._joint: JointMatcher | None = None
        if config.stereo.matcher in ('joint', 'joint_fast'):
            self._joint = JointMatcher(config.stereo.matcher, self._match,
                                       config.baseline.relative_sigma)
        self._pair: PairMatcher | None = None
        if config.pairing.mode == 'binocular' and self._joint:
            self._pair = PairMatcher(config.stereo.matcher, self._match,
                                     config.baseline.relative_sigma)
        self._unjudged_limits = replace(config.range, max_relative_sigma=min(
            config.range.max_relative_sigma, _UNJUDGED))
        self._rig = Rig(config.pairing.mode == 'binocular')
        self._down = -mount(config.camera).rotation[2]  # the vehicle's, optical frame
        self._memory = self._new_memory()
        self._mask = mask

    def _new_memory(self) -> RangeMemory:
        return RangeMemory(self.config.stereo.memory, self.config.range.maximum, self._down)

    def remember_in(self, memory: RangeMemory) -> None:
        """Use another memory, which begins anew."""
        self._memory = memory

    def warm_up(self) -> None:
        """Compile what `process` needs."""
        noise = np.random.default_rng(0).integers(0, 255, (128, 256), np.uint8)
        frames = [Frame(FrameKey(stamp, ''), noise) for stamp in range(4)]
        pose = RelativePose(np.eye(3), np.array([0.0, 0.0, -1.0]), 1e-9 * np.eye(6))
        far = RelativePose(np.eye(3), 2 * pose.position, pose.covariance)
        for reference, current in pairwise(frames[:3]):  # the second time, there is a memory
            self.process(AlignedWindow(current, (Reference(reference, pose),)))
        self.process(AlignedWindow(frames[3], (Reference(frames[2], pose),
                                               Reference(frames[1], far))))
        if self._pair is not None:
            top = Reference(Frame(FrameKey(0, 'top'), noise), pose)
            self.process(AlignedWindow(frames[1], (top, Reference(frames[0], pose))))
            self._rig = Rig(binocular=True)
        self._memory = self._new_memory()
        nothing = np.zeros(noise.shape, np.float32)
        under_floor(nothing, nothing, np.zeros(3))  # noise has no floor, and no walls
        beside(nothing, nothing, noise, 1.0)
        floor = floor_seen(self._down, len(noise))
        walls_seen(nothing + 1, nothing, floor, self._down, 0.0)

    def process(self, window: AlignedWindow) -> RangeImage | Drop:
        """Range and sigma on the current frame's grid.

        Drops: `size_changed`, where a reference has another size than the current frame;
        `mixed_scale`, where only some baselines are metric.
        """
        height = window.current.image.shape[0]
        if any(r.frame.image.shape != window.current.image.shape for r in window.references):
            return Drop('size_changed', 'the frames of a window differ in size')
        if len({r.pose.is_metric for r in window.references}) != 1:
            return Drop('mixed_scale', 'some baselines of a window are metric, others are not')
        mask, moving, limits = self._mask_of(height), None, self._unjudged_limits
        camera = self._rig.camera(window)
        first = window.references[0]
        if self._pair is not None and first.is_beside(window.current):
            estimate = self._pair.measured(window.current, window.references)
            if len(window.references) > 1:
                motion = self._measure(window.current, window.references[1])
                estimate = with_cones(estimate, motion, first.pose.direction)
            estimate = self._above_floor(estimate)
        elif self._joint is not None:
            estimate, moving, chosen = self._remembered(self._joint, window, mask)
            limits = self.config.range if chosen else limits
        else:
            estimate = fuse([self._measure(window.current, r) for r in window.references],
                            self._judged)
            estimate = self._above_floor(estimate) if self._judged else estimate
        r, sigma = published_range(estimate, limits, window.is_metric, mask)
        if (self._joint is not None or self._judged) and window.is_metric:
            hidden = far_islands(r)
            r[hidden] = sigma[hidden] = np.nan
        return RangeImage(window.current.key, r, sigma, window.is_metric, moving=moving,
                          camera=camera)

    def _above_floor(self, estimate: InverseRange) -> InverseRange:
        """Nothing at rest lies under the floor: what seems to is a reflection in it."""
        plane = floor_plane(estimate.rho, estimate.sigma, self._down)
        if plane is not None:
            estimate.sigma[under_floor(estimate.rho, estimate.sigma, plane) != 0] = NOTHING
        return estimate

    def _remembered(self, joint: JointMatcher, window: AlignedWindow,
                    mask: Image8 | None) -> tuple[InverseRange, Image8, bool]:
        """What is known without what moves, that, and whether the former was chosen."""
        view = window.current.image
        measured = joint.measure(window.current, window.references)
        fused = self._memory.fused(window.current.key, window.references, measured,
                                   None if mask is None else mask != 0, view)
        wrong, moving = moving_parts(fused, measured, self._down, metric=window.is_metric)
        if mask is not None:
            moving[mask != 0] = 0
        self._memory.forget(wrong)
        fused.sigma[wrong] = NOTHING
        rho = fused.rho
        if fused.chosen:
            # What was not surely beyond range.max is not made so: it would be told to be free.
            farthest = np.float32(1 / self.config.range.maximum if window.is_metric else 0)
            smooth = smoothed(rho, fused.sigma, measured.pose, view)
            rho = np.where(rho > farthest, np.maximum(smooth, farthest), rho)
        return InverseRange(rho, fused.sigma, joint.signed), moving, fused.chosen

    def _measure(self, current: Frame, reference: Reference) -> InverseRange:
        height = current.image.shape[0]
        grid = stereo_grid(height)
        ref, cur, axes = aligned_pair(reference.frame.image, current.image, reference.pose, grid)
        parallax = self._match(cur, ref)
        return inverse_range(parallax, grid, axes, reference.pose, height,
                             self.config.baseline.relative_sigma)

    def _mask_of(self, height: int) -> Image8 | None:
        if self._mask is not None and self._mask.shape != (height, 2 * height):
            return np.asarray(cv2.resize(self._mask, (2 * height, height),
                                         interpolation=cv2.INTER_NEAREST))
        return self._mask
