"""Relative poses found so far: what lies between two frames is predicted by chaining them."""
from __future__ import annotations

from collections import deque

import numpy as np

from . import rotations
from .frames import FrameKey, RelativePose

# Frames whose poses are remembered; a window reaches no farther back than 100.
_REMEMBERED = 110
# Prediction errors grow with every pose of a chain.
_LONGEST_CHAIN = 24


def compose(second: RelativePose, first: RelativePose) -> RelativePose:
    """The pose of A in C from `second`, B in C, and `first`, A in B.

    The errors of the two are taken as independent; unknown as soon as either is.
    """
    turned = second.rotation @ first.position
    covariance = None
    if second.covariance is not None and first.covariance is not None:
        lever = np.eye(6)
        lever[3:, :3] = -rotations.skew(turned)
        turn = np.kron(np.eye(2), second.rotation)
        covariance = lever @ second.covariance @ lever.T + turn @ first.covariance @ turn.T
    return RelativePose(second.rotation @ first.rotation, turned + second.position, covariance)


def inverse(pose: RelativePose) -> RelativePose:
    """The pose of the current camera in the reference camera's frame."""
    back = pose.rotation.T
    covariance = None
    if pose.covariance is not None:
        jacobian = np.block([[-back, np.zeros((3, 3))],
                             [-back @ rotations.skew(pose.position), -back]])
        covariance = jacobian @ pose.covariance @ jacobian.T
    return RelativePose(back, -back @ pose.position, covariance)


def with_baseline(pose: RelativePose, length: float) -> RelativePose:
    """The same pose with another baseline, metres; its relative uncertainty stays."""
    scale = length / max(pose.baseline, 1e-300)
    covariance = None
    if pose.covariance is not None:
        stretch = np.diag([1.0, 1.0, 1.0, scale, scale, scale])
        covariance = stretch @ pose.covariance @ stretch
    return RelativePose(pose.rotation, scale * pose.position, covariance)


class PoseHistory:
    """Relative poses of the newest frames, as a graph of frames.

    A stage adds what it found for each window; of what it predicts it adds nothing, so an error
    cannot feed itself.
    """

    def __init__(self) -> None:
        self._poses: dict[FrameKey, dict[FrameKey, RelativePose]] = {}
        self._windows: deque[FrameKey] = deque()

    def begin(self, current: FrameKey) -> None:
        """Say which frame comes now; where time runs backward, all before it is forgotten."""
        if self._windows and current == self._windows[-1]:
            return
        if self._windows and current < self._windows[-1]:
            self._poses.clear()
            self._windows.clear()
        self._windows.append(current)
        if len(self._windows) > _REMEMBERED:
            self._forget(self._windows.popleft())

    def add(self, current: FrameKey, reference: FrameKey, pose: RelativePose) -> None:
        """Remember the pose of `reference` in `current`."""
        self._poses.setdefault(current, {})[reference] = pose
        self._poses.setdefault(reference, {})[current] = inverse(pose)

    def between(self, reference: FrameKey, current: FrameKey) -> RelativePose | None:
        """The pose of `reference` in `current` by the fewest known poses; None where none lead
        there.
        """
        came_from: dict[FrameKey, FrameKey] = {current: current}
        border = [current]
        for _ in range(_LONGEST_CHAIN):
            following = []
            for frame in border:
                for other in self._poses.get(frame, {}):
                    if other not in came_from:
                        came_from[other] = frame
                        following.append(other)
            if reference in came_from:
                return self._chained(reference, came_from)
            border = following
        return None

    def _chained(self, frame: FrameKey, came_from: dict[FrameKey, FrameKey]) -> RelativePose:
        """The pose of `frame` along the links of `came_from`, to the frame that links to itself.
        """
        pose: RelativePose | None = None
        while came_from[frame] != frame:
            step = self._poses[came_from[frame]][frame]
            pose = step if pose is None else compose(step, pose)
            frame = came_from[frame]
        return RelativePose() if pose is None else pose

    def _forget(self, frame: FrameKey) -> None:
        """Drop all poses of frames up to `frame`."""
        for old in [key for key in self._poses if key <= frame]:
            for other in self._poses.pop(old):
                if other in self._poses:
                    self._poses[other].pop(old, None)
