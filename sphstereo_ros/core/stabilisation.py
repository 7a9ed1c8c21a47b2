"""Stage 2, pose stabilisation: the rotation and the direction of motion of each reference."""
from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from . import relative_pose
from .config import Config, PoseConfig
from .frames import (
    Drop,
    FrameKey,
    Image8,
    PairedWindow,
    Reference,
    RelativePose,
    StabilisedWindow,
)
from .history import PoseHistory, with_baseline
from .relative_pose import (
    Correspondences,
    PoseEstimate,
    epipolar_residuals,
    in_front,
    parallax,
    ransac,
    refine,
    rotation_between,
)
from .tracking import match, track

_BEHIND = 1 / 3  # largest share of points that moved, but behind the cameras
_LIKELY = 0.5  # least length of a chain, as a share of what is believed
_COARSE = 2.0  # parallax that matched descriptors must show, as a multiple of the threshold


def reduced(image: Image8, height: int) -> Image8:
    """The image (H, 2H) shrunk to `height` rows, or itself if it is not larger."""
    if image.shape[0] <= height:
        return image
    return np.asarray(cv2.resize(image, (2 * height, height), interpolation=cv2.INTER_AREA))


def estimate(points: Correspondences, config: PoseConfig) -> PoseEstimate | Drop:
    """Pose from correspondences, or the reason why there is none.

    Drops: `too_few_points`, `too_few_inliers`, `no_parallax` (hover or pure rotation).
    """
    if len(points) < config.min_inliers:
        return Drop('too_few_points', f'{len(points)} points with texture')
    pose = _fitted(points, config)
    return _judged(pose, points, config) if pose else _unfitted(points, config)


def _fitted(points: Correspondences, config: PoseConfig) -> PoseEstimate | None:
    found = ransac(points, config.inlier_threshold, np.random.default_rng(config.seed))
    return refine(*found, points) if found else None


def _unfitted(points: Correspondences, config: PoseConfig) -> Drop:
    if np.median(parallax(rotation_between(points), points)) < config.min_parallax:
        return Drop('no_parallax', 'a rotation explains all correspondences')
    return Drop('too_few_inliers', 'no pose fits the correspondences')


def _judged(pose: PoseEstimate, points: Correspondences,
            config: PoseConfig) -> PoseEstimate | Drop:
    """The pose, if enough points that moved bear it out."""
    # The robust loss adapts its width to the residuals, so inliers are counted by the threshold.
    residual = np.abs(epipolar_residuals(pose.rotation, pose.direction, points))
    inliers = pose.inliers & (residual < config.inlier_threshold)
    angle = parallax(pose.rotation, points)
    enough = max(config.min_inliers, config.min_inlier_ratio * len(points))
    if inliers.sum() >= enough:
        middle = float(np.median(angle[pose.inliers]))
        if middle < config.min_parallax:
            return Drop('no_parallax', f'median parallax {np.degrees(middle):.3f}°')
    # By chance a point fits any epipolar plane, but then as often behind the cameras as ahead.
    moved = inliers & (angle > config.inlier_threshold)
    behind = moved & ~in_front(pose.rotation, pose.direction, points)
    count = int((inliers & ~behind).sum())
    if count < enough:
        return Drop('too_few_inliers', f'{count} of {len(points)}')
    if behind.sum() > _BEHIND * moved.sum():
        return Drop('too_few_inliers', f'{behind.sum()} of {moved.sum()} lie behind the cameras')
    return pose


class Stabiliser:
    """Estimates the relative pose of every reference from the images."""

    def __init__(self, config: Config, mask: Image8 | None = None) -> None:
        self.config = config.pose
        self._mask = mask
        self._history = PoseHistory()
        # Where no sensor measures them, all steps between frames are taken as equally long.
        self._assumes_steps = config.baseline.source in ('fixed', 'speed')
        self._believes_rig = not config.calibration.each_pair
        self._stood_still: FrameKey | None = None

    def warm_up(self) -> None:
        """Compile what `process` needs."""
        noise = np.random.default_rng(0).integers(0, 255, (64, 128), np.uint8)
        track(noise, noise, np.diag([-1.0, 1, -1]), 200)
        relative_pose.warm_up()

    def process(self, window: PairedWindow) -> StabilisedWindow | Drop:
        """Give every reference its rotation and direction; the baselines' lengths stay.

        Another camera on the same rig is where it was calibrated to be, unless
        `calibration.each_pair`. The nearest other is estimated from the images. Where the poses
        found for earlier windows lead to a farther one, it is predicted from them: stage 3 refines
        it.

        Where lengths are assumed, nothing older than a hover is a reference: the way from there is
        shorter than assumed.

        References that fail are left out; if none is left, the nearest one's failure is returned.
        """
        self._begin(window.current.key)
        done: list[Reference | Drop] = []
        for reference in window.references:
            key = reference.frame.key
            if self._believes_rig and reference.is_beside(window.current):
                done.append(reference)
                continue
            if self._stood_still is not None and key < self._stood_still:
                done.append(Drop('no_parallax', 'a hover since then'))
                continue
            predicted = self._predicted(window, reference) if done else None
            outcome = predicted or self._reference(window, reference)
            done.append(outcome)
            if isinstance(outcome, Drop):
                if outcome.cause == 'no_parallax' and self._assumes_steps:
                    self._stood_still = window.current.key
            elif predicted is None:
                self._history.add(window.current.key, key, outcome.pose)
        good = tuple(r for r in done if isinstance(r, Reference))
        if good:
            return StabilisedWindow(window.current, good)
        return next(d for d in done if isinstance(d, Drop))

    def _begin(self, current: FrameKey) -> None:
        self._history.begin(current)
        if self._stood_still is not None and current < self._stood_still:
            self._stood_still = None

    def _predicted(self, window: PairedWindow, reference: Reference) -> Reference | None:
        """The reference at the end of a chain of poses, if there is one as long as is believed."""
        pose = self._history.between(reference.frame.key, window.current.key)
        if pose is None or pose.baseline < _LIKELY * reference.pose.baseline:
            return None
        return replace(reference, pose=with_baseline(pose, reference.pose.baseline))

    def _reference(self, window: PairedWindow, reference: Reference) -> Reference | Drop:
        config = self.config
        images = [reduced(frame.image, config.working_height)
                  for frame in (reference.frame, window.current)]
        if images[0].shape != images[1].shape:
            return Drop('size_changed', f'{images[0].shape} and {images[1].shape}')
        mask = self._mask_like(images[1])
        points = track(images[0], images[1], reference.pose.rotation, config.max_points, mask)
        pose = estimate(points, config)
        if isinstance(pose, Drop) and pose.cause == 'too_few_inliers':
            pose = self._second_attempt(images[0], images[1], mask, pose)
        if isinstance(pose, Drop):
            return pose
        return replace(reference, pose=with_length(pose, reference.pose))

    def _second_attempt(self, reference: Image8, current: Image8, mask: Image8 | None,
                        first: Drop) -> PoseEstimate | Drop:
        """Match descriptors, then track once more from the rotation that they tell.

        For large motion, and for rotation that the prior does not know.
        """
        config = self.config
        points = match(reference, current, config.max_points, mask)
        if len(points) < config.min_inliers:
            return first
        coarse = _fitted(points, config)
        turn = coarse.rotation if coarse else rotation_between(points)
        again = estimate(track(reference, current, turn, config.max_points, mask), config)
        if coarse is None or isinstance(again, PoseEstimate) or again.cause == 'no_parallax':
            return again
        moved = np.median(parallax(coarse.rotation, points[coarse.inliers]))
        if moved < _COARSE * config.inlier_threshold:
            return again
        return _judged(coarse, points, config)

    def _mask_like(self, image: NDArray[np.uint8]) -> Image8 | None:
        if self._mask is None:
            return None
        return np.asarray(cv2.resize(self._mask, image.shape[::-1],
                                     interpolation=cv2.INTER_NEAREST))


def with_length(pose: PoseEstimate, prior: RelativePose) -> RelativePose:
    """The estimate with its direction made as long as the prior's baseline.

    What the prior knows of the uncertainty of its length is kept.
    """
    length, along = prior.baseline, pose.direction
    covariance = pose.covariance6
    covariance[3:] *= length
    covariance[:, 3:] *= length
    if prior.covariance is not None:
        unit = prior.position / max(length, 1e-300)
        covariance[3:, 3:] += (unit @ prior.covariance[3:, 3:] @ unit) * np.outer(along, along)
    return RelativePose(pose.rotation, length * along, covariance)
