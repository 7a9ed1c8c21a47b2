"""Stage 3, motion alignment: refine each pose on a reduced aligned copy of the pair.

In the aligned pair every still point moves along its own meridian. What is left of motion across
the meridians is the error of rotation and direction, and it is solved for over the whole sphere.
"""
from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from . import relative_pose
from .camera import Equirectangular
from .config import AlignmentConfig, Config
from .frames import AlignedWindow, Drop, Frame, Image8, Reference, RelativePose, StabilisedWindow
from .paper import window_ratio_direction
from .relative_pose import Correspondences, PoseEstimate, epipolar_residuals, refine
from .sphere import polar_bearings
from .stabilisation import reduced, with_length
from .tracking import Points, features, follow, spacing_for
from .warp import PolarGrid, aligned_pair

Floats = NDArray[np.float64]

_MARGIN, _WRAP = 8, 8
_POLE = 0.1  # rad round both poles, where the grid is too stretched to track


def aligned_correspondences(reference: Image8, current: Image8, pose: RelativePose,
                            grid: PolarGrid, count: int) -> Correspondences:
    """Features followed between the views on the polar grid, back as bearings of each view.

    count : so many features at most, about
    """
    ref, cur, axes = aligned_pair(reference, current, pose, grid)
    inside = np.zeros(grid.shape, bool)
    inside[grid.wrap:-grid.wrap, np.sin(grid.theta()) > np.sin(_POLE)] = True
    points, sigma = features(cur, spacing_for(count, grid.height), inside)
    moved, found = follow(cur, ref, points)
    offset = np.array([grid.margin, grid.wrap]) - 0.5

    def bearings(pixels: Points) -> Floats:
        theta, azimuth = ((pixels[found] - offset) * grid.pixel).T
        return polar_bearings(theta, azimuth, axes)

    return Correspondences(bearings(moved) @ pose.rotation, bearings(points),
                           sigma[found] * grid.pixel)


class Aligner:
    """Refines rotation and direction of every reference."""

    def __init__(self, config: Config, mask: Image8 | None = None) -> None:
        self.config: AlignmentConfig = config.alignment
        self._mask = mask

    def warm_up(self) -> None:
        """Compile what `process` needs."""
        noise = np.random.default_rng(0).integers(0, 255, (64, 128), np.uint8)
        pose = RelativePose(np.eye(3), np.array([0.0, 0.0, -1.0]))
        aligned_correspondences(noise, noise, pose, PolarGrid(64, _MARGIN, _WRAP), 500)
        relative_pose.warm_up()

    def process(self, window: StabilisedWindow) -> AlignedWindow | Drop:
        """Refine every reference's pose; those that fail are left out.

        If none is left, the nearest one's failure is returned: `alignment_failed`.
        """
        done = [self._reference(window.current, r) for r in window.references]
        good = tuple(r for r in done if isinstance(r, Reference))
        if good:
            return AlignedWindow(window.current, good)
        return next(d for d in done if isinstance(d, Drop))

    def _reference(self, current: Frame, reference: Reference) -> Reference | Drop:
        height = min(self.config.working_height, current.image.shape[0])
        # Shrinking by a little only blurs: the grid samples the frame itself then.
        images = [f.image if f.image.shape[0] < 1.3 * height else reduced(f.image, height)
                  for f in (reference.frame, current)]
        if self.config.method == 'paper':
            pose = window_ratio_direction(images[0], images[1], reference.pose)
            return replace(reference, pose=pose) if isinstance(pose, RelativePose) else pose
        grid = PolarGrid(height, _MARGIN, _WRAP)
        pose = reference.pose
        for _ in range(self.config.iterations):
            points = self._beside_mask(aligned_correspondences(
                images[0], images[1], pose, grid, self.config.max_points))
            refined = self._refined(points, pose, grid.pixel)
            if isinstance(refined, Drop):
                return refined
            pose = with_length(refined, reference.pose)
        return replace(reference, pose=self._with_floor(pose))

    def _beside_mask(self, points: Correspondences) -> Correspondences:
        """Those that neither view sees on the vehicle."""
        if self._mask is None:
            return points
        height, width = self._mask.shape
        keep = np.ones(len(points), bool)
        for bearings in (points.reference, points.current):
            u, v = np.rint(Equirectangular(height, width).project(bearings)).astype(np.intp).T
            keep &= self._mask[v.clip(0, height - 1), u % width] == 0
        return points[keep]

    @staticmethod
    def _refined(points: Correspondences, pose: RelativePose,
                 threshold: float) -> PoseEstimate | Drop:
        if len(points) < 100:
            return Drop('alignment_failed', f'{len(points)} points with texture')
        refined = refine(pose.rotation, -pose.direction, points)
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
