"""Finished chunks of a map on disk: what an interrupted run need not do again."""
from __future__ import annotations

import json
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from sphstereo_ros.core.frames import FrameKey, RelativePose
from sphstereo_ros.core.mapping import Submap
from sphstereo_ros.core.track import TrackedFrame
from sphstereo_ros.core.voxels import VoxelPoints
from sphstereo_ros.replay.map_files import written_whole
from sphstereo_ros.replay.records import BadInput

_VERSION = 3
_POINTS = ('xyz', 'bgr', 'frames', 'points', 'weight', 'level')


@dataclass
class Segment:
    """A submap, and its first and last camera as odometry tells."""

    submap: Submap
    odometry: tuple[RelativePose, RelativePose] | None = None


@dataclass
class Chunk:
    """What became of some consecutive frames: one segment if the track was never lost.

    drops : how many of each cause; details : what the last of each cause told
    """

    segments: list[Segment] = field(default_factory=list)
    drops: Counter[str] = field(default_factory=Counter)
    details: dict[str, str] = field(default_factory=dict)
    frames: int = 0
    problem: str = ''


def save_chunk(path: Path, chunk: Chunk) -> None:
    """Write a chunk, whole or not at all; BadInput where it cannot be written."""
    arrays: dict[str, Any] = {}
    told: dict[str, Any] = {'version': _VERSION, 'drops': chunk.drops, 'details': chunk.details,
                            'frames': chunk.frames, 'problem': chunk.problem, 'segments': []}
    for n, segment in enumerate(chunk.segments):
        submap = segment.submap
        frames = submap.frames
        told['segments'].append({'keys': [(f.key.stamp, f.key.frame_id) for f in frames],
                                 'ways': (submap.assumed, submap.tracked),
                                 'edge': submap.points.edge})
        arrays[f'{n}_rotations'] = np.array([f.rotation for f in frames]).reshape(-1, 3, 3)
        arrays[f'{n}_positions'] = np.array([f.position for f in frames]).reshape(-1, 3)
        arrays[f'{n}_scales'] = np.array([f.scale for f in frames])
        if segment.odometry is not None:
            arrays[f'{n}_odometry'] = np.stack(
                [np.column_stack([p.rotation, p.position]) for p in segment.odometry])
        for name in _POINTS:
            arrays[f'{n}_points_{name}'] = getattr(submap.points, name)
    arrays['told'] = np.frombuffer(json.dumps(told).encode(), np.uint8)

    def write(beside: Path) -> None:
        with beside.open('wb') as file:
            np.savez(file, **arrays)
    written_whole(path, write)


def load_chunk(path: Path) -> Chunk:
    """Read a chunk.

    Raises
    ------
    BadInput
        where it cannot be read

    """
    try:
        with np.load(path) as data:
            told = json.loads(bytes(data['told']))
            if told['version'] != _VERSION:
                raise BadInput(f'{path} is of another version')
            segments = [_segment(data, n, more) for n, more in enumerate(told['segments'])]
    except (OSError, ValueError, KeyError, EOFError) as error:
        raise BadInput(f'{path} is no finished chunk: {error}') from error
    return Chunk(segments, Counter(told['drops']), told['details'], told['frames'],
                 told['problem'])


def _segment(data: Any, n: int, told: dict[str, Any]) -> Segment:
    frames = [TrackedFrame(FrameKey(*key), rotation, position, float(scale))
              for key, rotation, position, scale in zip(
                  told['keys'], data[f'{n}_rotations'], data[f'{n}_positions'],
                  data[f'{n}_scales'], strict=True)]
    arrays = {name: data[f'{n}_points_{name}'] for name in _POINTS}
    points = VoxelPoints(**arrays, edge=told['edge'])
    odometry = None
    if f'{n}_odometry' in data:
        first, last = (RelativePose(p[:, :3], p[:, 3]) for p in data[f'{n}_odometry'])
        odometry = first, last
    return Segment(Submap(frames, points, *told['ways']), odometry)
