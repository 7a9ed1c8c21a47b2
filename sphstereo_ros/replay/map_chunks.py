"""One chunk of a map: so many frames of a recording, and some before them to warm up.

No chunk needs another: each can be computed by itself, anywhere and in any order, and comes out
the same.
"""
from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sphstereo_ros.core.baseline import Track as SensorTrack
from sphstereo_ros.core.baseline import interpolate_odometry
from sphstereo_ros.core.chain import Chain, StageResults
from sphstereo_ros.core.config import Config
from sphstereo_ros.core.frames import Drop, Frame, RelativePose
from sphstereo_ros.core.mapping import Mapper, first_pose
from sphstereo_ros.core.motion import OdometrySample
from sphstereo_ros.core.track import TrackedFrame
from sphstereo_ros.replay.offline import SAMPLES
from sphstereo_ros.replay.records import Record, Source
from sphstereo_ros.replay.sources import motion_topics
from sphstereo_ros.replay.submap_files import Chunk, Segment
from sphstereo_ros.ros.conversions import decode_frame
from sphstereo_ros.ros.images import read_mask
from sphstereo_ros.ros.messages import SECOND

_SHORTEST = 5  # frames of a segment, where the track was lost

Add = Callable[[Any], Sequence[StageResults | Drop]]


@dataclass(frozen=True)
class Division:
    """How recordings are cut: frames of a chunk, and frames before it to warm up."""

    chunk: int
    lead: int


@dataclass(frozen=True)
class Recording:
    """One input: its name, what it holds, the topic of its images, and the frame rate it was
    opened with.
    """

    path: Path
    source: Source
    topic: str
    fps: float = 0.0

    def count(self) -> int:
        """How many images it has, as far as known."""
        return self.source.count([self.topic])


class ChunkMapper:
    """Makes one chunk of the frames and samples that it is given.

    at_start : whether it is the first chunk of a recording
    """

    def __init__(self, config: Config, at_start: bool) -> None:
        self._config = config
        self._chain = Chain(config, read_mask(config.camera.mask))
        self._at_start = at_start
        self._begins: int | None = None
        self._mapper: Mapper | None = None
        self._odometry: SensorTrack[OdometrySample] = SensorTrack(
            'odometry', round(config.pairing.max_gap * SECOND))
        self._ends: list[RelativePose | None] = []
        self._add: dict[str, Add] = {'/odometry': self._chain.add_odometry,
                                     '/twist': self._chain.add_twist,
                                     '/imu': self._chain.add_imu}
        self.chunk = Chunk()

    def add_frame(self, frame: Frame | Drop, warm_up: bool) -> None:
        """Take the next frame; `warm_up`: it is of the chunk before."""
        self.chunk.frames += not warm_up
        if isinstance(frame, Drop):
            self._drop(frame)
            return
        if not warm_up and self._begins is None:
            self._begins = frame.key.stamp
        self._take(self._chain.add_frame(frame))

    def add_sample(self, topic: str, sample: Any) -> None:
        """Take the next sample of a sensor."""
        if isinstance(sample, Drop):
            self._drop(Drop(f'{topic[1:]}_{sample.cause}', sample.detail))
            return
        if isinstance(sample, OdometrySample):
            self._odometry.add(sample)
        self._take(self._add[topic](sample))

    def finish(self) -> Chunk:
        """No more is to come."""
        self._take(self._chain.flush())
        self._end_segment(2 if self._at_start else _SHORTEST)  # two stills are a recording, too
        return self.chunk

    def _drop(self, drop: Drop) -> None:
        if self._begins is not None or self._at_start:  # else it is counted in the chunk before
            self.chunk.drops[drop.cause] += 1
            self.chunk.details[drop.cause] = drop.detail

    def _take(self, results: Sequence[StageResults | Drop]) -> None:
        for result in results:
            if isinstance(result, Drop):
                self._drop(result)
            else:
                self._map(result)

    def _map(self, result: StageResults) -> None:
        key = result.aligned.current.key
        sample = interpolate_odometry(self._odometry, key.stamp)
        fuse = self._begins is not None and key.stamp >= self._begins
        placed = self._mapped(result, sample, fuse)
        if isinstance(placed, Drop) and placed.cause == 'track_lost':
            self._drop(placed)
            self._end_segment()
            placed = self._mapped(result, sample, fuse)
        if isinstance(placed, Drop):
            self._drop(placed)
        else:
            self._ends.append(None if sample is None else first_pose(self._config, sample))

    def _mapped(self, result: StageResults, sample: OdometrySample | None,
                fuse: bool) -> TrackedFrame | Drop:
        if self._mapper is None:
            first = result.aligned.references[0].frame.key.stamp
            start = interpolate_odometry(self._odometry, first)
            pose = first_pose(self._config, start if self._at_start else None)
            self._mapper = Mapper(self._config, first=pose)
            self._ends = [None if start is None else first_pose(self._config, start)]
        return self._mapper.add(result.aligned, result.range_image, odometry=sample, fuse=fuse)

    def _end_segment(self, least: int = _SHORTEST) -> None:
        if self._mapper is None:
            return
        submap = self._mapper.finish()
        if len(submap.frames) >= least:
            first, last = self._ends[0], self._ends[-1]
            known = None if first is None or last is None else (first, last)
            self.chunk.segments.append(Segment(submap, known))
        elif submap.frames:
            self._drop(Drop('short_segment'))
        self._mapper = None
        self._at_start = False


def chunks_of(recording: Recording, config: Config, division: Division,
              wanted: Callable[[int], bool],
              advance: Callable[[], object] = lambda: None) -> Iterator[tuple[int, Chunk]]:
    """The wanted chunks of a recording and their numbers, in one pass.

    Frames that are not wanted are decoded only to warm up; `advance` is called after the others.
    """
    recent: deque[tuple[int, str, Any]] = deque()
    mapper: ChunkMapper | None = None
    index = 0
    for record in recording.source.records([recording.topic, *motion_topics(recording.source)]):
        if record.topic == recording.topic:
            number, place = divmod(index, division.chunk)
            if not place:
                if mapper is not None:
                    yield number - 1, mapper.finish()
                mapper = _begun(config, recent, number == 0) if wanted(number) else None
            index += 1
            if mapper is None and (place < division.chunk - division.lead
                                   or not wanted(number + 1)):
                continue
            item = _frame(record, config)
            if mapper is not None:
                mapper.add_frame(item, False)
                advance()
        else:
            item = _sample(record)
            if mapper is not None:
                mapper.add_sample(record.topic, item)
        recent.append((index, record.topic, item))
        while recent[0][0] < index - division.lead:
            recent.popleft()
    if mapper is not None:
        mapper.chunk.problem = recording.source.problem
        yield (index - 1) // division.chunk, mapper.finish()


def _begun(config: Config, recent: deque[tuple[int, str, Any]], at_start: bool) -> ChunkMapper:
    mapper = ChunkMapper(config, at_start)
    for _, topic, item in recent:
        if topic in SAMPLES:
            mapper.add_sample(topic, item)
        else:
            mapper.add_frame(item, True)
    return mapper


def _frame(record: Record, config: Config) -> Frame | Drop:
    message = record.message()
    return message if isinstance(message, Drop) else decode_frame(
        message, config.stereo.working_height, colour=True)


def _sample(record: Record) -> Any:
    message = record.message()
    return message if isinstance(message, Drop) else SAMPLES[record.topic](message)
