"""Obstacles: what the chain and the detection make of scenes whose truth is known."""
from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from sphstereo_ros.core.chain import Chain, StageResults
from sphstereo_ros.core.config import Config, resolve
from sphstereo_ros.core.frames import Drop
from sphstereo_ros.core.level import AttitudeHistory
from sphstereo_ros.core.obstacles import ObstacleDetection
from sphstereo_ros.core.rotations import OPTICAL_FROM_LINK
from sphstereo_ros.replay.records import BadInput, Record
from sphstereo_ros.replay.sources import open_source
from sphstereo_ros.ros.conversions import odometry_sample
from sphstereo_ros.ros.images import read_depth
from sphstereo_ros.ros.messages import nanoseconds
from sphstereo_ros.scenes.sequence import TruthFrame

from .accuracy import as_frame, true_odometry
from .methods import Method
from .obstacle_truth import EDGE, FINE_AREA, Score, true_sectors
from .tables import markdown

TRUTH_TOPIC = '/ground_truth/range'
_TOPICS = ('/image/compressed', '/odometry', TRUTH_TOPIC)


class _Run:
    """One method over one sequence: the chain, then the detection, as `sphstereo run` does."""

    def __init__(self, method: Method, score: Score) -> None:
        config = resolve({'baseline.source': 'odometry', **method.parameters})
        self._chain = Chain(config)
        self._detection = ObstacleDetection(config)
        self._attitudes = AttitudeHistory()
        self._score = score

    @property
    def config(self) -> Config:
        """Parameters of the method."""
        return self._chain.config

    def add(self, frame: TruthFrame, truth: Sequence[np.ndarray[Any, Any]]) -> None:
        """`truth` as `Score.add` takes it."""
        sample = true_odometry(frame)
        self._chain.add_odometry(sample)
        self._attitudes.add_odometry(sample)
        grey = as_frame(frame, self.config.stereo.working_height)
        for outcome in self._chain.add_frame(grey):
            self._take(outcome, truth)

    def _take(self, outcome: StageResults | Drop, truth: Sequence[np.ndarray[Any, Any]]) -> None:
        if isinstance(outcome, StageResults):
            image = outcome.range_image
            attitude = self._attitudes.at(image.key.stamp)
            found = attitude if isinstance(attitude, Drop) else self._detection.process(
                image, attitude)
            if not isinstance(found, Drop):
                self._score.add(found, *truth)
                return
            outcome = found
        self._score.drop(outcome.cause)


class ObstacleContest:
    """Runs every method on the same sequences; figures by scene and method."""

    def __init__(self, methods: Mapping[str, Method], ground: float = 0.0) -> None:
        """`ground` is the height of the ground in the sequences' world, metres."""
        self._methods = methods
        self._ground = ground
        self._scores: dict[tuple[str, str], Score] = {}

    def add(self, name: str, sequence: Iterable[TruthFrame],
            advance: Callable[[], object] = lambda: None) -> dict[str, Mapping[str, Any]]:
        """All methods over one sequence of the scene `name`; `advance` is called per frame.

        Returns the figures of this sequence by method.
        """
        scores = {label: Score() for label in self._methods}
        runs = [_Run(method, scores[label]) for label, method in self._methods.items()]
        for frame in sequence:
            truths: dict[Any, Sequence[np.ndarray[Any, Any]]] = {}
            for run in runs:
                limits = run.config.obstacles
                if limits not in truths:
                    truths[limits] = self._truth(frame, run.config)
                run.add(frame, truths[limits])
            advance()
        for label, score in scores.items():
            self._scores.setdefault((name, label), Score()).include(score)
        return {label: score.summary() for label, score in scores.items()}

    def _truth(self, frame: TruthFrame, config: Config) -> Sequence[np.ndarray[Any, Any]]:
        height = float(frame.position[2]) - self._ground
        distance = np.asarray(frame.range, np.float64)
        return [true_sectors(distance, frame.rotation, height, config.obstacles, *more)
                for more in ((), (EDGE,), (0.0, FINE_AREA))]

    def summaries(self) -> dict[str, dict[str, Any]]:
        """By scene, then by method; `all` is of all scenes together."""
        out: dict[str, dict[str, Any]] = {}
        total: dict[str, Score] = {}
        for (name, label), score in self._scores.items():
            out.setdefault(name, {})[label] = dict(score.summary())
            total.setdefault(label, Score()).include(score)
        if len(out) > 1:
            out['all'] = {label: dict(score.summary()) for label, score in total.items()}
        return out


def frames_of_bag(path: Path) -> Iterator[TruthFrame]:
    """Frames of a bag with `/image/compressed`, `/odometry` and `/ground_truth/range`.

    Raises
    ------
    BadInput
        where it has not all of them

    """
    source = open_source(path)
    missing = [topic for topic in _TOPICS if topic not in source.topics]
    if missing:
        raise BadInput(f'{path} has no {", ".join(missing)}')
    parts: dict[int, dict[str, Any]] = {}
    for record in source.records(_TOPICS):
        stamp, part = _part(record, path)
        parts.setdefault(stamp, {})[record.topic] = part
        if len(parts[stamp]) == len(_TOPICS):
            image, pose, distance = (parts[stamp].pop(topic) for topic in _TOPICS)
            yield TruthFrame(stamp, image, distance, pose.rotation @ OPTICAL_FROM_LINK.T,
                             pose.position)


def _part(record: Record, path: Path) -> tuple[int, Any]:
    message: Any = record.message()
    part = message
    if not isinstance(message, Drop):
        if record.topic == '/odometry':
            part = odometry_sample(message)
        elif record.topic == TRUTH_TOPIC:
            part = read_depth(message)
        else:
            part = cv2.imdecode(np.frombuffer(message.data, np.uint8), cv2.IMREAD_COLOR)
    if part is None or isinstance(part, Drop):
        raise BadInput(f'{path}: {record.topic} cannot be read')
    return nanoseconds(message.header.stamp), part


_COLUMNS = {'median_error': 'median error %', 'measured': 'measured %', 'free': 'free %',
            'unknown': 'unknown %', 'near': 'nearer than 10 m', 'near_free': 'of them free',
            'fine_free': 'with small ones', 'near_missed': 'over 1.5 times too far',
            'near_unknown': 'unknown', 'false': 'over 1.5 times too near'}


def table(summaries: Mapping[str, Mapping[str, Mapping[str, Any]]]) -> str:
    """As Markdown: shares and the error in percent, the rest counts of sectors."""
    rows = [[scene, label, _frames(s), *(_cell(s[name]) for name in _COLUMNS)]
            for scene, by_method in summaries.items() for label, s in by_method.items()]
    return markdown(['scene', 'method', 'frames (dropped)', *_COLUMNS.values()], rows)


def sequence_line(scene: str, label: str, summary: Mapping[str, Any]) -> str:
    """Of one sequence, as it is told while others are measured."""
    figures = ', '.join(f'{title} {_cell(summary[name])}' for name, title in _COLUMNS.items())
    return f'{scene}, {label}: {_frames(summary)} frames; {figures}'


def _cell(value: float | None) -> str:
    return '–' if value is None else f'{value:.3g}' if isinstance(value, float) else str(value)


def _frames(summary: Mapping[str, Any]) -> str:
    causes = ', '.join(f'{n} {cause}' for cause, n in summary['drops'].items())
    return f'{summary["frames"]} ({causes or 0})'
