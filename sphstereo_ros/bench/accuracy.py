"""Accuracy: pose and range against exact truth, method by method.

Every method is the chain itself, fed frame by frame as live, with the true odometry as the scale.
"""
from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import cv2
import numpy as np

from sphstereo_ros.core import rotations
from sphstereo_ros.core.alignment import Aligner
from sphstereo_ros.core.chain import Chain, StageResults
from sphstereo_ros.core.config import Config, resolve
from sphstereo_ros.core.frames import (
    AlignedWindow,
    Drop,
    Frame,
    FrameKey,
    PairedWindow,
    RelativePose,
    StabilisedWindow,
)
from sphstereo_ros.core.motion import OdometrySample
from sphstereo_ros.core.rotations import OPTICAL_FROM_LINK
from sphstereo_ros.core.stabilisation import Stabiliser
from sphstereo_ros.scenes.sequence import TruthFrame, true_pose

from .methods import Method
from .scoring import average, compare

Frames = Mapping[int, TruthFrame]  # by stamp
# Frames before the first that is scored: the default window is whole then.
SKIPPED = 10


@dataclass
class _PoseErrors:
    """Of the references so many frames back, degrees; `lost`: paired, but without a pose."""

    rotation: list[float] = field(default_factory=list)
    direction: list[float] = field(default_factory=list)
    lost: int = 0

    def summary(self) -> dict[str, float | None]:
        known = bool(self.rotation)
        return {'rotation_deg': float(np.median(self.rotation)) if known else None,
                'direction_deg': float(np.median(self.direction)) if known else None,
                'lost': 100 * self.lost / (self.lost + len(self.rotation))}


@dataclass
class MethodScore:
    """What one method made of the frames that count: scores as in `scoring.compare`."""

    poses: dict[int, _PoseErrors] = field(default_factory=lambda: defaultdict(_PoseErrors))
    scores: list[dict[str, Any]] = field(default_factory=list)
    drops: Counter[str] = field(default_factory=Counter)

    def summary(self) -> dict[str, Any]:
        """Medians of the pose errors by frames back, means of the range scores, drops by cause."""
        return {'frames': len(self.scores), 'drops': dict(self.drops),
                'references': {str(back): self.poses[back].summary()
                               for back in sorted(self.poses)},
                **(average(self.scores) if self.scores else {})}


def pose_errors(estimate: RelativePose, truth: RelativePose) -> tuple[float, float]:
    """Angles (degrees) of the rotation's and of the direction's error."""
    turn = rotations.angle(estimate.rotation.T @ truth.rotation)
    cross = np.linalg.norm(np.cross(estimate.direction, truth.direction))
    return (float(np.degrees(turn)),
            float(np.degrees(np.arctan2(cross, estimate.direction @ truth.direction))))


def as_frame(frame: TruthFrame, height: int) -> Frame:
    """The grey frame as the chain gets it, at working resolution (0 = as it is)."""
    grey = cv2.cvtColor(frame.image, cv2.COLOR_BGR2GRAY)
    if height and height != grey.shape[0]:
        grey = cv2.resize(grey, (2 * height, height), interpolation=cv2.INTER_AREA)
    return Frame(FrameKey(frame.stamp, 'camera_optical'), np.asarray(grey, np.uint8))


def true_odometry(frame: TruthFrame) -> OdometrySample:
    """The true pose of the camera, which is `base_link` where no mount is given."""
    return OdometrySample(frame.stamp, frame.position, frame.rotation @ OPTICAL_FROM_LINK)


class _TruePoses(Stabiliser):
    """Stages 2 and 3, as if they made no error."""

    def __init__(self, config: Config, frames: Frames) -> None:
        super().__init__(config)
        self._frames = frames

    def process(self, window: PairedWindow) -> StabilisedWindow | Drop:
        current = self._frames[window.current.key.stamp]
        return StabilisedWindow(window.current, tuple(
            replace(r, pose=true_pose(self._frames[r.frame.key.stamp], current))
            for r in window.references))


class _AsTheyAre(Aligner):
    def process(self, window: StabilisedWindow) -> AlignedWindow | Drop:
        return AlignedWindow(window.current, window.references)


class _Run:
    """One method over one sequence."""

    def __init__(self, method: Method, frames: Frames, score: MethodScore) -> None:
        self._remembers = method.remembers
        self._frames = frames
        self._score = score
        self._chain = Chain(resolve({'baseline.source': 'odometry', **method.parameters}))
        if method.true_pose:
            self._chain.stabiliser = _TruePoses(self._chain.config, frames)
            self._chain.aligner = _AsTheyAre(self._chain.config)

    def add(self, truth: TruthFrame, counts: bool) -> None:
        chain = self._chain
        frame = as_frame(truth, chain.config.stereo.working_height)
        chain.add_odometry(true_odometry(truth))
        if counts:
            self._take(chain.add_frame(frame)[-1], truth)
        elif self._remembers:
            chain.add_frame(frame)
        else:
            chain.pairer.add_frame(frame)

    def _take(self, outcome: StageResults | Drop, truth: TruthFrame) -> None:
        stamps = list(self._frames)
        before = self._frames[stamps[stamps.index(truth.stamp) - 1]]
        score = partial(compare, truth=truth.range, direction=true_pose(before, truth).direction,
                        moving=truth.moving)
        if isinstance(outcome, Drop):  # nothing is known of the whole sphere
            self._score.drops[outcome.cause] += 1
            if outcome.cause == 'rate_limit':  # by the parameters, not a failure
                return
            height = self._chain.config.stereo.working_height or len(truth.image)
            unknown = np.full((height, 2 * height), np.nan, np.float32)
            self._score.scores.append(score(unknown))
            return
        image = outcome.range_image
        self._score.scores.append(score(image.range, sigma=image.sigma,
                                        marked=getattr(image, 'moving', None)))
        self._take_poses(outcome, truth, stamps)

    def _take_poses(self, outcome: StageResults, truth: TruthFrame, stamps: list[int]) -> None:
        estimated = {r.frame.key.stamp: r.pose for r in outcome.aligned.references}
        for reference in outcome.paired.references:
            stamp = reference.frame.key.stamp
            errors = self._score.poses[stamps.index(truth.stamp) - stamps.index(stamp)]
            if stamp not in estimated:
                errors.lost += 1
                continue
            turn, direction = pose_errors(estimated[stamp],
                                          true_pose(self._frames[stamp], truth))
            errors.rotation.append(turn)
            errors.direction.append(direction)


class Contest:
    """Runs every method on the same sequences."""

    def __init__(self, methods: Mapping[str, Method]) -> None:
        self._methods = methods
        self._results = {name: MethodScore() for name in methods}

    def add(self, sequence: Sequence[TruthFrame], skip: int,
            advance: Callable[[], object] = lambda: None) -> None:
        """All methods over one sequence; the first `skip` frames (at least 1) are not scored.

        advance : called after each frame
        """
        frames: dict[int, TruthFrame] = {}
        runs = [_Run(method, frames, self._results[name])
                for name, method in self._methods.items()]
        for index in range(len(sequence)):
            truth = sequence[index]
            frames[truth.stamp] = truth
            for run in runs:
                run.add(truth, counts=index >= max(skip, 1))
            advance()

    def summaries(self) -> dict[str, dict[str, Any]]:
        """By method."""
        return {name: result.summary() for name, result in self._results.items()}


def frames_to_skip(length: int, wanted: int | None) -> int:
    """How many frames of a sequence are not scored: as wanted, else 10, or half of a short one."""
    if wanted is not None:
        return wanted
    return SKIPPED if length > SKIPPED else length // 2
