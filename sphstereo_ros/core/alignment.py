"""Stage 3, motion alignment: refine each pose on a reduced aligned copy of the pair.

In the aligned pair every still point moves along its own meridian. What is left of motion across
the meridians is the error of rotation and direction, and it is solved for over the whole sphere.
"""
from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from . import relative_pose
from .aligned_view import CurrentView, current_view, followed, length_by_ranges
from .camera import Equirectangular
from .config import AlignmentConfig, Config
from .frames import (
    AlignedWindow,
    Drop,
    Frame,
    FrameKey,
    Image8,
    Reference,
    RelativePose,
    StabilisedWindow,
)
from .history import PoseHistory, with_baseline
from .paper import window_ratio_direction
from .photometric import matched
from .relative_pose import (
    Correspondences,
    PoseEstimate,
    cells_of,
    epipolar_residuals,
    refine,
    weighted_by_neighbours,
)
from .stabilisation import reduced, with_length
from .warp import PolarGrid

Floats = NDArray[np.float64]

_MARGIN, _WRAP = 8, 8
_CELLS = 14  # of the grid's height: within one, neighbours judge each other
# By how much a length may differ from the one believed before the reference is followed anew, and
# how uncertain it may be, as a share of it.
_SURPRISE, _UNSURE = 0.03, 0.01
# A rig that moved by less, as a share of the distance of its cameras, learns nothing from it.
_SHORT = 0.3
_LIKELY = 0.3  # least length of a chain, as a share of what is believed


class Aligner:
    """Refines rotation and direction of every reference."""

    def __init__(self, config: Config, mask: Image8 | None = None) -> None:
        self.config: AlignmentConfig = config.alignment
        self._mask = mask
        self._history = PoseHistory()
        # Where no sensor measures them, all steps between frames are taken as equally long.
        self._assumes_steps = config.baseline.source in ('fixed', 'speed')
        self._believes_rig = not config.calibration.each_pair

    def warm_up(self) -> None:
        """Compile what `process` needs."""
        noise = np.random.default_rng(0).integers(0, 255, (64, 128), np.uint8)
        pose = RelativePose(np.eye(3), np.array([0.0, 0.0, -1.0]))
        view = current_view(noise, pose.direction, PolarGrid(64, _MARGIN, _WRAP), 500)
        followed(view, noise, pose)
        relative_pose.warm_up()

    def process(self, window: StabilisedWindow) -> AlignedWindow | Drop:
        """Refine every reference's pose; those that fail are left out.

        The nearest starts from where stage 2 put it. Farther ones start at the end of the poses
        found for earlier windows, where these lead there.

        Another camera on the same rig is where it was calibrated to be, unless
        `calibration.each_pair`; then farther ones are those of the moving rig.

        If none is left, the nearest one's failure is returned: `alignment_failed`.
        """
        if self.config.method == 'paper':
            done = self._window_by_ratio(window)
        else:
            done = self._refined_window(window)
        good = tuple(r for r in done if isinstance(r, Reference))
        if good:
            return AlignedWindow(window.current, good)
        return next(d for d in done if isinstance(d, Drop))

    def _reduced(self, image: Image8) -> Image8:
        """The image at working height; the grid samples the frame itself where it is little more.
        """
        height = self.config.working_height
        return image if image.shape[0] < 1.3 * height else reduced(image, height)

    def _window_by_ratio(self, window: StabilisedWindow) -> list[Reference | Drop]:
        rig: list[Reference | Drop] = [r for r in window.references
                                       if self._is_believed(window.current, r)]
        return rig or [self._by_window_ratio(window.current, r) for r in window.references]

    def _by_window_ratio(self, current: Frame, reference: Reference) -> Reference | Drop:
        pose = window_ratio_direction(self._reduced(reference.frame.image),
                                      self._reduced(current.image), reference.pose)
        return pose if isinstance(pose, Drop) else replace(reference, pose=pose)

    def _is_believed(self, current: Frame, reference: Reference) -> bool:
        return self._believes_rig and reference.is_beside(current)

    def _refined_window(self, window: StabilisedWindow) -> list[Reference | Drop]:
        rig = [r for r in window.references if self._is_believed(window.current, r)]
        if len(rig) == len(window.references):
            return list(rig)
        key = window.current.key
        self._history.begin(key)
        image = self._reduced(window.current.image)
        grid = PolarGrid(min(self.config.working_height, image.shape[0]), _MARGIN, _WRAP)
        view: CurrentView | None = None
        done: list[Reference | Drop] = []
        beside = window.references[0].is_beside(window.current)
        for reference in rig:
            done.append(reference)
            view = self._told_by_rig(image, reference, grid)
        for reference in window.references[len(rig):]:
            found = self._nearest(image, reference, grid) if view is None \
                else self._farther(view, key, reference, beside)
            if isinstance(found, Drop):
                done.append(found)
                continue
            view, pose = found
            pose = self._with_floor(pose)
            self._history.add(key, reference.frame.key, pose)
            done.append(replace(reference, pose=pose))
        return done

    def _nearest(self, current: Image8, reference: Reference,
                 grid: PolarGrid) -> tuple[CurrentView, RelativePose] | Drop:
        """Refine on the grid about the reference's own direction; again by the ranges found."""
        pose = reference.pose
        view = current_view(current, pose.direction, grid, self.config.max_points)
        for _ in range(self.config.iterations):
            found = self._fitted(view, reference, pose)
            if isinstance(found, Drop):
                return found
            points, index, estimate = found
            pose = with_length(estimate, reference.pose)
            view = view.taught(points, index, pose)
        return view, pose

    def _told_by_rig(self, current: Image8, reference: Reference, grid: PolarGrid) -> CurrentView:
        """The view with the ranges that another camera tells."""
        pose = reference.pose
        view = current_view(current, pose.direction, grid, self.config.max_points)
        points, index = followed(view, matched(self._reduced(reference.frame.image), current),
                                 pose)
        residual = np.abs(epipolar_residuals(pose.rotation, -pose.direction, points))
        good = self._beside_mask(points) & (residual < view.grid.pixel)
        return view.taught(points[good], index[good], pose)

    def _farther(self, view: CurrentView, current: FrameKey, reference: Reference,
                 rig: bool = False) -> tuple[CurrentView, RelativePose] | Drop:
        """Refine from the end of a chain, with the features of the nearest reference's view.

        An assumed length gives way to the one that ranges by nearer references tell.

        rig : the nearest reference is another camera: an assumed length has to give way
        """
        pose = self._predicted(current, reference)
        for _ in range(2 if self.config.iterations else 0):
            found = self._fitted(view, reference, pose)
            if isinstance(found, Drop):
                return found
            points, index, estimate = found
            refined = with_length(estimate, reference.pose)
            told = length_by_ranges(view, points, index, refined) if self._assumes_steps else None
            if told is None and rig and self._assumes_steps:
                break
            if told is None:
                return view.taught(points, index, refined), refined
            length, sigma = told
            refined = with_baseline(refined, length)
            if abs(length - pose.baseline) < _SURPRISE * length and sigma < _UNSURE * length:
                if rig and length < _SHORT * view.baseline:
                    return Drop('baseline_too_short', f'{length:.4f} m')
                return view.taught(points, index, refined), refined
            pose = refined
        return Drop('alignment_failed', 'ranges tell no length') \
            if self.config.iterations or (rig and self._assumes_steps) else (view, pose)

    def _predicted(self, current: FrameKey, reference: Reference) -> RelativePose:
        """Where the poses of earlier windows put the reference, or else stage 2."""
        chained = self._history.between(reference.frame.key, current)
        believed = reference.pose.baseline
        if chained is None \
                or not _LIKELY * believed < chained.baseline < believed / _LIKELY:
            return reference.pose
        return chained if self._assumes_steps else with_baseline(chained, believed)

    def _fitted(self, view: CurrentView, reference: Reference, pose: RelativePose,
                ) -> tuple[Correspondences, NDArray[np.intp], PoseEstimate] | Drop:
        """One refinement: its inliers, which features these are, and the estimate."""
        points, index = followed(view, self._reduced(reference.frame.image), pose)
        keep = self._beside_mask(points)
        points, index = points[keep], index[keep]
        cells = cells_of(view.points[index], view.grid.height // _CELLS)
        estimate = self._refined(points, cells, pose, view.grid.pixel)
        if isinstance(estimate, Drop):
            return estimate
        return points[estimate.inliers], index[estimate.inliers], estimate

    def _beside_mask(self, points: Correspondences) -> NDArray[np.bool_]:
        """Which neither view sees on the vehicle, (N,)."""
        keep = np.ones(len(points), bool)
        if self._mask is None:
            return keep
        height, width = self._mask.shape
        for bearings in (points.reference, points.current):
            u, v = np.rint(Equirectangular(height, width).project(bearings)).astype(np.intp).T
            keep &= self._mask[v.clip(0, height - 1), u % width] == 0
        return keep

    @staticmethod
    def _refined(points: Correspondences, cells: NDArray[np.intp], pose: RelativePose,
                 threshold: float) -> PoseEstimate | Drop:
        if len(points) < 100:
            return Drop('alignment_failed', f'{len(points)} points with texture')
        refined = refine(pose.rotation, -pose.direction, points)
        if refined is not None:
            refined = refine(refined.rotation, refined.direction,
                             weighted_by_neighbours(points, cells, refined))
        if refined is None:
            return Drop('alignment_failed', 'the aligned pair fixes no motion')
        # The robust loss adapts to any residuals, so inliers are counted by the threshold.
        residual = np.abs(epipolar_residuals(refined.rotation, refined.direction, points))
        if (refined.inliers & (residual < threshold)).sum() < 0.3 * len(points):
            return Drop('alignment_failed', 'the aligned pair does not fit one motion')
        return refined

    def _with_floor(self, pose: RelativePose) -> RelativePose:
        """Add to the covariance the systematic part, which residuals do not show."""
        if pose.covariance is None:
            return pose
        across = np.eye(3) - np.outer(pose.direction, pose.direction)
        floor = np.zeros((6, 6))
        floor[:3, :3] = self.config.rotation_sigma**2 * np.eye(3)
        floor[3:, 3:] = (pose.baseline * self.config.direction_sigma)**2 * across
        return replace(pose, covariance=pose.covariance + floor)
