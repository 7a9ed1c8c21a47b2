"""How true the maps of `sphstereo map` are: a drive down a rendered street, mapped three ways.

`odometry`: metres come from odometry. `speed`: a constant speed is assumed, right on average,
while the true one varies. `unregistered`: the assumed lengths are believed, as the paper does.
"""
from __future__ import annotations

import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from sphstereo_ros.core.config import resolve
from sphstereo_ros.core.frames import FrameKey
from sphstereo_ros.core.track import TrackedFrame
from sphstereo_ros.core.voxels import VoxelPoints
from sphstereo_ros.replay.map_chunks import Recording
from sphstereo_ros.replay.map_run import MapRun
from sphstereo_ros.replay.output import McapOutput
from sphstereo_ros.replay.records import BadInput
from sphstereo_ros.replay.sources import open_source
from sphstereo_ros.scenes.sequence import (
    TruthFrame,
    load_sequence,
    render_sequence,
    save_sequence,
    stamp_of,
)
from sphstereo_ros.scenes.trajectory import FRAME_RATE

from .map_truth import Figures, Floats, errors, seen_surface, way_length
from .tables import markdown

SPACING, VARIED, PERIOD = 0.28, 0.3, 40.0  # m; share by which it varies, over so many frames
KINDS = ('odometry', 'speed', 'unregistered')
IMAGE = '/image/compressed'


@dataclass(frozen=True)
class Drive:
    """A drive down a street, its speed rising and falling by VARIED.

    cache : folder in which it is kept once it is rendered
    """

    seed: int
    frames: int
    height: int
    cache: Path

    def rendered(self) -> Any:
        """The sequence, to be rendered; its `scene` is what is mapped."""
        spacing = SPACING * (1 + VARIED * np.sin(2 * np.pi * np.arange(self.frames - 1) / PERIOD))
        try:
            return render_sequence('street', self.seed, self.frames, self.height,
                                   [float(s) for s in spacing])
        except ImportError as error:
            raise BadInput(f"rendering needs the extra 'scenes': {error}") from error
        except ValueError as error:
            raise BadInput(str(error)) from error

    def sequence(self) -> Sequence[TruthFrame]:
        """The frames, rendered once.

        Raises
        ------
        BadInput
            where nothing can be rendered

        """
        folder = self.cache / f'drive_{self.seed}_{self.frames}x{self.height}'
        if not (folder / 'meta.json').is_file():  # written last
            save_sequence(self.rendered(), folder, folder.name, progress=self._shown)
        return load_sequence(folder)

    def _shown(self, frames: Iterator[int]) -> Iterator[int]:
        return iter(tqdm(frames, total=self.frames, unit='frame', desc='render', disable=None))


def without_pixels(frame: TruthFrame) -> TruthFrame:
    """Its stamp and pose."""
    return replace(frame, image=np.zeros((0, 0, 3), np.uint8), range=np.zeros((0, 0)), jpeg=None)


def recorded(frames: Iterable[TruthFrame], poses: Iterable[TruthFrame], path: Path) -> None:
    """Write a bag of frames, and of poses as odometry."""
    from sphstereo_ros.replay.bag_messages import make
    from sphstereo_ros.ros.conversions import compressed_message
    from sphstereo_ros.scenes.bag import CAMERA, jpeg, odometry
    with McapOutput(path) as out:
        for k, (frame, pose) in enumerate(zip(frames, poses, strict=True)):
            out.write('/odometry', stamp_of(k), odometry(replace(pose, stamp=stamp_of(k))))
            out.write(IMAGE, stamp_of(k), compressed_message(
                make, FrameKey(stamp_of(k), CAMERA), 'bgr8; jpeg compressed bgr8', jpeg(frame)))


def at_constant_speed(frames: Sequence[TruthFrame]) -> list[TruthFrame]:
    """The frames as if the way between any two were as long: what the paper assumes."""
    positions = np.stack([f.position for f in frames])
    steps = np.diff(positions, axis=0)
    step = way_length(positions) / len(steps)
    steps *= step / np.linalg.norm(steps, axis=1)[:, None]
    there = positions[0] + np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
    return [replace(f, position=p) for f, p in zip(frames, there, strict=True)]


def parameters(kind: str, positions: Floats, given: Mapping[str, object]) -> dict[str, object]:
    """Of a map: the speed that is assumed is the true one on average."""
    if kind != 'speed':
        return {'baseline.source': 'odometry', **given}
    speed = FRAME_RATE * way_length(positions) / (len(positions) - 1)
    return {'baseline.source': 'speed', 'baseline.speed': speed, **given}


def mapped(bag: Path, values: Mapping[str, object], folder: Path,
           advance: Callable[[], object]) -> tuple[list[TrackedFrame], VoxelPoints, Figures]:
    """What `sphstereo map` makes of a bag; seconds a frame by the clock and of the processor."""
    run = MapRun(resolve(values), [Recording(bag, open_source(bag), IMAGE)], folder)
    wall, cpu = time.perf_counter(), time.process_time()
    run.prepare()
    run.process(advance)
    track, points = run.join()
    run.remove_chunks()
    count = max(run.summary.frames, 1)
    if not track:
        raise BadInput(f'no frame could be placed: {run.summary.why_not()}')
    return track, points, {'frame_s': (time.perf_counter() - wall) / count,
                           'frame_cpu_s': (time.process_time() - cpu) / count}


def measure(drive: Drive, kinds: Sequence[str], given: Mapping[str, object],
            advance: Callable[[], object] = lambda: None) -> dict[str, Figures]:
    """The figures of each kind of map."""
    sequence = drive.sequence()
    truth = [without_pixels(frame) for frame in sequence]
    positions = np.stack([f.position for f in truth])
    scene, surface = drive.rendered().scene, seen_surface(sequence)
    out = {}
    for kind in kinds:
        poses = at_constant_speed(truth) if kind == 'unregistered' else truth
        with tempfile.TemporaryDirectory() as name:
            bag = Path(name) / 'drive.mcap'
            recorded(sequence, poses, bag)
            track, points, cost = mapped(bag, parameters(kind, positions, given),
                                         Path(name) / 'parts', advance)
        out[kind] = {**errors(track, points, truth, scene, surface), **cost}
    return out


def table(figures: Mapping[str, Figures]) -> str:
    """Two tables, of the tracks and of the points."""
    track = [('ate_percent', 'ATE, % of the distance'), ('largest_percent', 'largest'),
             ('end_percent', 'at the end'), ('rpe_percent', 'RPE, %'),
             ('scale_percent', 'scale, %'), ('turn_deg', 'turn, °'), ('placed', 'placed')]
    cloud = [('right_percent', 'within 5 cm + 1 %'), ('loose_percent', 'within 5 cm + 3 %'),
             ('median_m', 'median, m'), ('p95_m', '95 %, m'), ('covered_percent', 'covered, %'),
             ('points_near', 'points'), ('frame_s', 's a frame'), ('frame_cpu_s', 'of CPU')]

    def rows(columns: list[tuple[str, str]]) -> str:
        return markdown(['map', *(title for _, title in columns)], [
            [kind, *(f'{f.get(name, float("nan")):.3g}' if name not in ('points_near', 'placed')
                     else f'{f[name]:.0f}' for name, _ in columns)]
            for kind, f in figures.items()])
    return f'{rows(track)}\n\n{rows(cloud)}'


def peak_memory(drive: Drive, count: int, words: Sequence[str]) -> Figures:
    """Of `sphstereo map` on so many frames, there and back again, in a process of its own."""
    import resource
    import subprocess
    frames = drive.sequence()
    truth = [without_pixels(frame) for frame in frames]
    last = len(frames) - 1
    order = [last - abs(last - k % (2 * last)) for k in range(count)]
    with tempfile.TemporaryDirectory() as name:
        bag = Path(name) / 'looped.mcap'
        recorded((frames[k] for k in order), (truth[k] for k in order), bag)
        done = subprocess.run([sys.executable, '-m', 'sphstereo_ros.cli', 'map', str(bag), '--out',
                               str(Path(name) / 'map.ply'), *words], stdout=sys.stderr)
        if done.returncode:
            raise BadInput(f'sphstereo map ended with {done.returncode}')
    peak = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss
    return {'memory_frames': count, 'memory_height': drive.height, 'peak_mb': peak / 1024}
