"""From recordings to one map, chunk by chunk.

Finished chunks are kept on disk until the map is written, so an interrupted run goes on where it
was.
"""
from __future__ import annotations

import dataclasses
import hashlib
import json
import shutil
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from sphstereo_ros import __version__
from sphstereo_ros.core.config import Config
from sphstereo_ros.core.frames import FrameKey
from sphstereo_ros.core.mapping import Submap, base_pose, confirmed, map_cloud
from sphstereo_ros.core.pose_graph import Floats
from sphstereo_ros.core.rotations import mount
from sphstereo_ros.core.submaps import MapBuilder
from sphstereo_ros.core.track import TrackedFrame
from sphstereo_ros.core.voxels import VoxelPoints
from sphstereo_ros.replay.map_chunks import Division, Recording, chunks_of
from sphstereo_ros.replay.map_files import save_cloud, track_lines, written_whole
from sphstereo_ros.replay.records import BadInput, Source
from sphstereo_ros.replay.sources import motion_topics
from sphstereo_ros.replay.submap_files import Chunk, Segment, load_chunk, save_chunk
from sphstereo_ros.ros.messages import SECOND

CHUNK, LEAD = 120, 24  # frames
_NEXT = SECOND // 30  # between two recordings whose stamps do not tell
_EXPECTED = ('first_frame', 'rate_limit')


@dataclass
class MapSummary:
    """What became of the inputs."""

    frames: int = 0
    placed: int = 0
    points: int = 0
    length: float = 0.0
    resumed: int = 0
    drops: Counter[str] = field(default_factory=Counter)
    details: dict[str, str] = field(default_factory=dict)
    problems: list[str] = field(default_factory=list)

    def why_not(self) -> str:
        """Why frames were dropped, in words; what is expected only where there is nothing else."""
        causes = [c for c, _ in self.drops.most_common() if c not in _EXPECTED]
        return '; '.join(f'{c}: {self.details[c]}' if self.details.get(c) else c
                         for c in causes) or 'too few frames'

    def lines(self) -> list[str]:
        """One line a figure."""
        resumed = f' ({self.resumed} of them before)' if self.resumed else ''
        return [f'frames in: {self.frames}{resumed}', f'placed: {self.placed}',
                f'track: {self.length:.2f} m', f'points: {self.points}',
                *(f'dropped, {cause}: {count}' for cause, count in self.drops.most_common())]


class MapRun:
    """Maps recordings into one cloud.

    folder : where finished chunks are kept
    chunk : frames of each
    """

    def __init__(self, config: Config, recordings: Sequence[Recording], folder: Path,
                 chunk: int = CHUNK) -> None:
        self.config = dataclasses.replace(config, points=dataclasses.replace(
            config.points, colour=True, stride=256))
        self.recordings, self.folder = recordings, folder
        self.division = Division(chunk, LEAD)
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
            frames for n, chunk, frames in self.counted() if self.path(n, chunk).exists())

    def counted(self) -> Iterator[tuple[int, int, int]]:
        """Recording, number and frames of each chunk, as far as recordings tell how long they are.
        """
        size = self.division.chunk
        for n, recording in enumerate(self.recordings):
            count = recording.count()
            for chunk in range(-(-count // size)):
                yield n, chunk, min(size, count - chunk * size)

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
        return {'version': __version__, 'parameters': parameters, 'chunk': self.division.chunk,
                'inputs': files}

    def process(self, advance: Callable[[], object] = lambda: None) -> None:
        """Make the chunks that are not there yet; `advance` is called after each of their frames.

        Raises
        ------
        BadInput
            where a chunk cannot be written

        """
        for n, recording in enumerate(self.recordings):
            def missing(chunk: int, n: int = n) -> bool:
                return not self.path(n, chunk).exists()
            for chunk, done in chunks_of(recording, self.config, self.division, missing, advance):
                self.keep(n, chunk, done)

    def keep(self, recording: int, chunk: int, done: Chunk) -> None:
        """Write a finished chunk; BadInput where it cannot be written."""
        save_chunk(self.path(recording, chunk), done)

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
                self.summary.details.update(done.details)
                if done.problem:
                    self.summary.problems.append(f'{recording.path}: {done.problem}')
                for segment in done.segments:
                    first = segment.submap.frames[0].key.stamp
                    if not chunk and segment is done.segments[0] and first <= last:
                        shift = last + _NEXT - first
                    last = max(last, self._join(builder, recording, segment, shift))
                chunk += 1
        frames, points = builder.finish()
        kept = confirmed(points, self.config.mapping)
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
