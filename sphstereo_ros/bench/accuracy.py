"""Accuracy: pose and range against exact truth, method by method."""
from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from sphstereo_ros.core import rotations
from sphstereo_ros.core.chain import Chain, StageResults
from sphstereo_ros.core.config import resolve
from sphstereo_ros.core.frames import Drop, Frame, FrameKey, PairedWindow, Reference, RelativePose
from sphstereo_ros.scenes.sequence import TruthFrame, true_pose

from .scoring import BANDS, average, compare


@dataclass
class MethodScore:
    """What one method made of a sequence: errors in degrees, scores as in `scoring.compare`."""

    rotation: list[float] = field(default_factory=list)
    direction: list[float] = field(default_factory=list)
    scores: list[dict[str, Any]] = field(default_factory=list)
    drops: Counter[str] = field(default_factory=Counter)

    def summary(self) -> dict[str, Any]:
        """Medians of the pose errors, means of the range scores, drops by cause."""
        return {'pairs': len(self.scores), 'drops': dict(self.drops),
                'rotation_deg': float(np.median(self.rotation)) if self.rotation else None,
                'direction_deg': float(np.median(self.direction)) if self.direction else None,
                **(average(self.scores) if self.scores else {})}


def pose_errors(estimate: RelativePose, truth: RelativePose) -> tuple[float, float]:
    """Angles (degrees) of the rotation's and of the direction's error."""
    turn = rotations.angle(estimate.rotation.T @ truth.rotation)
    cross = np.linalg.norm(np.cross(estimate.direction, truth.direction))
    return (float(np.degrees(turn)),
            float(np.degrees(np.arctan2(cross, estimate.direction @ truth.direction))))


def pairs(sequence: Sequence[TruthFrame], interval: int = 1,
          ) -> Iterator[tuple[TruthFrame, TruthFrame]]:
    """Reference and current frames `interval` apart; each frame is read once."""
    recent: list[TruthFrame] = []
    for index in range(len(sequence)):
        recent.append(sequence[index])
        if len(recent) > interval:
            yield recent.pop(0), recent[-1]


def as_frame(frame: TruthFrame, height: int) -> Frame:
    """The grey frame as the chain gets it, at working resolution (0 = as it is)."""
    grey = cv2.cvtColor(frame.image, cv2.COLOR_BGR2GRAY)
    if height and height != grey.shape[0]:
        grey = cv2.resize(grey, (2 * height, height), interpolation=cv2.INTER_AREA)
    return Frame(FrameKey(frame.stamp, 'camera_optical'), np.asarray(grey, np.uint8))


class Contest:
    """Runs every method on the same pairs, the true baseline's length given (as by odometry)."""

    def __init__(self, methods: Mapping[str, Mapping[str, object]]) -> None:
        self.chains = {name: Chain(resolve(parameters)) for name, parameters in methods.items()}
        self.results = {name: MethodScore() for name in methods}

    def add(self, reference: TruthFrame, current: TruthFrame) -> None:
        """One pair through all methods."""
        truth = true_pose(reference, current)
        prior = RelativePose(np.eye(3), np.array([0.0, 0.0, -truth.baseline]))
        for name, chain in self.chains.items():
            height = chain.config.stereo.working_height
            window = PairedWindow(as_frame(current, height),
                                  (Reference(as_frame(reference, height), prior),))
            self._score(name, chain.process(window), truth, current.range)

    def _score(self, name: str, outcome: StageResults | Drop, truth: RelativePose,
               true_range: NDArray[np.floating]) -> None:
        result = self.results[name]
        if isinstance(outcome, Drop):
            result.drops[outcome.cause] += 1
            return
        turn, direction = pose_errors(outcome.aligned.references[0].pose, truth)
        result.rotation.append(turn)
        result.direction.append(direction)
        image = outcome.range_image
        result.scores.append(compare(image.range, true_range, image.sigma))

    def summaries(self) -> dict[str, dict[str, Any]]:
        """By method."""
        return {name: result.summary() for name, result in self.results.items()}


def table(summaries: Mapping[str, Mapping[str, Any]]) -> str:
    """Lines for people: one method a row."""
    head = f'{"method":10}{"rotation°":>11}{"direction°":>11}'
    head += ''.join(f'{f"{low:g}–{high:g} m":>21}' for low, high in BANDS)
    head += f'{"danger %":>10}{"ghost %":>9}'
    rows = [head, f'{"":32}' + f'{"cov% / med% / >10%":>21}' * len(BANDS)]
    for name, s in summaries.items():
        if not s['pairs']:
            rows.append(f'{name:10} no depth: {s["drops"]}')
            continue
        row = f'{name:10}{s["rotation_deg"]:11.4f}{s["direction_deg"]:11.4f}'
        for low, high in BANDS:
            band = s[f'{low:g}-{high:g}']
            parts = (band['coverage'], band['median'], band['bad'])
            row += f'{" / ".join("–" if p is None else f"{p:.3g}" for p in parts):>21}'
        rows.append(row + f'{s["danger"]:10.2f}{s["ghost"]:9.2f}')
    return '\n'.join(rows)
