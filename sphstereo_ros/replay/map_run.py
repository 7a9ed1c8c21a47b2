"""From recordings to one map, chunk by chunk.

A chunk is so many frames, and some before them to warm up. No chunk needs another: each can be
computed by itself, anywhere and in any order, and comes out the same. Finished ones are kept on
disk until the map is written, so an interrupted run goes on where it was.
"""
from __future__ import annotations

import dataclasses
import hashlib
import json
import shutil
from collections import Counter, deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from sphstereo_ros import __version__
from sphstereo_ros.core.baseline import Track as SensorTrack
from sphstereo_ros.core.baseline import interpolate_odometry
from sphstereo_ros.core.chain import Chain, StageResults
from sphstereo_ros.core.config import Config
from sphstereo_ros.core.frames import Drop, Frame, FrameKey, RelativePose
from sphstereo_ros.core.mapping import (
    Mapper,
    Submap,
    base_pose,
    confirmed,
    first_pose,
    map_cloud,
)
from sphstereo_ros.core.motion import OdometrySample
from sphstereo_ros.core.pose_graph import Floats
from sphstereo_ros.core.rotations import mount
from sphstereo_ros.core.submaps import MapBuilder
from sphstereo_ros.core.track import TrackedFrame
from sphstereo_ros.core.voxels import VoxelPoints
from sphstereo_ros.replay.map_files import save_cloud, track_lines, written_whole
from sphstereo_ros.replay.offline import SAMPLES
from sphstereo_ros.replay.records import BadInput, Record, Source
from sphstereo_ros.replay.sources import motion_topics
from sphstereo_ros.replay.submap_files import Chunk, Segment, load_chunk, save_chunk
from sphstereo_ros.ros.conversions import decode_frame
from sphstereo_ros.ros.images import read_mask
from sphstereo_ros.ros.messages import SECOND

CHUNK, LEAD = 120, 24  # frames
_SHORTEST = 5  # frames of a segment
_NEXT = SECOND // 30  # between two recordings whose stamps do not tell

Add = Callable[[Any], Sequence[StageResults | Drop]]


@dataclass(frozen=True)
class Recording:
    """One input: its name, what it holds, and the topic of its images."""

    path: Path
    source: Source
    topic: str

    def count(self) -> int:
        """How many images it has, as far as known."""
        return self.source.count([self.topic])


@dataclass
class MapSummary:
    """What became of the inputs."""

    frames: int = 0
    placed: int = 0
    points: int = 0
    length: float = 0.0
    resumed: int = 0
    drops: Counter[str] = field(default_factory=Counter)
    problems: list[str] = field(default_factory=list)

    def lines(self) -> list[str]:
        """One line a figure."""
        resumed = f' ({self.resumed} of them before)' if self.resumed else ''
        return [f'frames in: {self.frames}{resumed}', f'placed: {self.placed}',
                f'track: {self.length:.2f} m', f'points: {self.points}',
                *(f'dropped, {cause}: {count}' for cause, count in self.drops.most_common())]


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
        self._end_segment()
        return self.chunk

    def _drop(self, drop: Drop) -> None:
        if self._begins is not None or self._at_start:  # else it is counted in the chunk before
            self.chunk.drops[drop.cause] += 1

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

    def _end_segment(self) -> None:
        if self._mapper is None:
            return
        submap = self._mapper.finish()
        if len(submap.frames) >= _SHORTEST:
            first, last = self._ends[0], self._ends[-1]
            known = None if first is None or last is None else (first, last)
            self.chunk.segments.append(Segment(submap, known))
        elif submap.frames:
            self._drop(Drop('short_segment'))
        self._mapper = None
        self._at_start = False


class MapRun:
    """Maps recordings into one cloud.

    folder : where finished chunks are kept
    chunk : frames of each
    """

    def __init__(self, config: Config, recordings: Sequence[Recording], folder: Path,
                 chunk: int = CHUNK) -> None:
        self.config = dataclasses.replace(config, points=dataclasses.replace(
            config.points, colour=True, stride=256))
        self.recordings, self.folder, self._chunk = recordings, folder, chunk
        self.summary = MapSummary()

    def path(self, recording: int, chunk: int) -> Path:
        """The file of a chunk."""
        return self.folder / f'input_{recording:03d}_chunk_{chunk:05d}.npz'

    def prepare(self) -> None:
        """Make the folder of finished chunks; those of another job are thrown away.

        Raises
        ------
        BadInput
            where it cannot be made

        """
        job = self.folder / 'job.json'
        told = json.dumps(self._job(), indent=1)
        try:
            if self.folder.exists() and not (job.exists() and job.read_text() == told):
                if any(p.suffix not in ('.npz', '.json') for p in self.folder.iterdir()):
                    raise BadInput(f'{self.folder} is in the way: it holds other files')
                shutil.rmtree(self.folder)
            self.folder.mkdir(exist_ok=True)
            for left in self.folder.glob('.*'):
                left.unlink()
        except OSError as error:
            raise BadInput(f'cannot use {self.folder}: {error.strerror or error}') from error
        if not job.exists():
            written_whole(job, lambda beside: beside.write_text(told))
        self.summary.resumed = sum(
            max(0, min(self._chunk, recording.count() - chunk * self._chunk))
            for n, recording in enumerate(self.recordings)
            for chunk in range(-(-recording.count() // self._chunk))
            if self.path(n, chunk).exists())

    def _job(self) -> dict[str, Any]:
        """What chunks depend on."""
        parameters = hashlib.sha256(repr(self.config).encode()).hexdigest()
        files = []
        for recording in self.recordings:
            path = recording.path
            parts = sorted(path.iterdir()) if path.is_dir() else [path]
            sizes = [(p.name, p.stat().st_size, p.stat().st_mtime_ns) for p in parts]
            files.append([str(path.resolve()), recording.topic, hashlib.sha256(
                repr(sizes).encode()).hexdigest()])
        return {'version': __version__, 'parameters': parameters, 'chunk': self._chunk,
                'inputs': files}

    def process(self, advance: Callable[[], object] = lambda: None) -> None:
        """Make the chunks that are not there yet; `advance` is called after each of their frames.

        Raises
        ------
        BadInput
            where a chunk cannot be written

        """
        for n in range(len(self.recordings)):
            self._process(n, advance)

    def _process(self, number: int, advance: Callable[[], object]) -> None:
        """One recording in one pass; frames of finished chunks are decoded only to warm up."""
        recording = self.recordings[number]
        recent: deque[tuple[int, str, Any]] = deque()
        mapper: ChunkMapper | None = None
        index = 0
        for record in recording.source.records([recording.topic, *motion_topics(
                recording.source)]):
            if record.topic == recording.topic:
                chunk, place = divmod(index, self._chunk)
                done = self.path(number, chunk).exists()
                if not place:
                    self._save(number, chunk - 1, mapper)
                    mapper = None if done else self._begun(recent, chunk == 0)
                if done and place < self._chunk - LEAD:
                    index += 1
                    continue
                item = _frame(record, self.config)
                if mapper is not None:
                    mapper.add_frame(item, False)
                    advance()
                index += 1
            else:
                item = _sample(record)
                if mapper is not None:
                    mapper.add_sample(record.topic, item)
            recent.append((index, record.topic, item))
            while recent[0][0] < index - LEAD:
                recent.popleft()
        if mapper is not None:
            mapper.chunk.problem = recording.source.problem
            self._save(number, (index - 1) // self._chunk, mapper)

    def _begun(self, recent: deque[tuple[int, str, Any]], at_start: bool) -> ChunkMapper:
        mapper = ChunkMapper(self.config, at_start)
        for _, topic, item in recent:
            if topic in SAMPLES:
                mapper.add_sample(topic, item)
            else:
                mapper.add_frame(item, True)
        return mapper

    def _save(self, recording: int, chunk: int, mapper: ChunkMapper | None) -> None:
        if mapper is not None:
            save_chunk(self.path(recording, chunk), mapper.finish())

    def join(self) -> tuple[list[TrackedFrame], VoxelPoints]:
        """Join all chunks: the track, and the points worth keeping."""
        builder = MapBuilder(self.config)
        last = 0
        for number, recording in enumerate(self.recordings):
            chunk, shift = 0, 0
            while (path := self.path(number, chunk)).exists():
                done = load_chunk(path)
                self.summary.frames += done.frames
                self.summary.drops.update(done.drops)
                if done.problem:
                    self.summary.problems.append(f'{recording.path}: {done.problem}')
                for segment in done.segments:
                    first = segment.submap.frames[0].key.stamp
                    if not chunk and segment is done.segments[0] and first <= last:
                        shift = last + _NEXT - first
                    last = max(last, self._join(builder, recording, segment, shift))
                chunk += 1
        frames, points = builder.finish()
        kept = confirmed(points, _positions(frames), self.config.mapping)
        self.summary.placed, self.summary.points = len(frames), len(kept)
        self.summary.length = _length(frames)
        return frames, kept

    def _join(self, builder: MapBuilder, recording: Recording, segment: Segment,
              shift: int) -> int:
        """Add a segment with its stamps shifted; returns its last stamp."""
        submap = segment.submap
        frames = [dataclasses.replace(f, key=FrameKey(f.key.stamp + shift, f.key.frame_id))
                  for f in submap.frames]
        moved = Submap(frames, submap.points, submap.assumed, submap.tracked)
        drop = builder.add(moved, segment.odometry)
        if drop is not None:
            self.summary.drops[drop.cause] += len(frames)
            self.summary.problems.append(f'{recording.path}: {len(frames)} frames are not in the '
                                         f'map: {drop.detail}')
        return frames[-1].key.stamp

    def remove_chunks(self) -> None:
        """The map is written: chunks are not needed any more."""
        shutil.rmtree(self.folder, ignore_errors=True)


def _frame(record: Record, config: Config) -> Frame | Drop:
    message = record.message()
    return message if isinstance(message, Drop) else decode_frame(
        message, config.stereo.working_height, colour=True)


def _sample(record: Record) -> Any:
    message = record.message()
    return message if isinstance(message, Drop) else SAMPLES[record.topic](message)


def _positions(frames: Sequence[TrackedFrame]) -> Floats:
    return np.array([f.position for f in frames]).reshape(-1, 3)


def _length(frames: Sequence[TrackedFrame]) -> float:
    return float(np.linalg.norm(np.diff(_positions(frames), axis=0), axis=1).sum())


def write_map(path: Path, track_path: Path, frames: Sequence[TrackedFrame], points: VoxelPoints,
              config: Config) -> None:
    """Write the cloud, and the track of base_link in TUM's format.

    Raises
    ------
    BadInput
        where they cannot be written

    """
    save_cloud(path, map_cloud(points, frames[-1].key.stamp if frames else 0))
    camera = mount(config.camera)
    poses = [base_pose(frame, camera) for frame in frames]
    text = track_lines([f.key.stamp for f in frames], [r for r, _ in poses],
                       [p for _, p in poses])
    written_whole(track_path, lambda beside: beside.write_text(text))


def with_scale(given: Mapping[str, object], source: Source) -> dict[str, object]:
    """Parameters, with `baseline.source` as the recording can serve it where it is not given."""
    values = dict(given)
    if 'baseline.source' in values or values.get('pairing.mode') == 'binocular':
        return values
    if values.get('baseline.length') or values.get('mapping.camera_height'):
        return values
    if values.get('baseline.speed'):
        values['baseline.source'] = 'speed'
    elif '/odometry' in motion_topics(source):
        values['baseline.source'] = 'odometry'
    elif '/twist' in motion_topics(source):
        values['baseline.source'] = 'twist'
    return values
