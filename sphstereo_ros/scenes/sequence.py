"""Sequences of frames with exact range and pose: rendered on demand, saved, read back."""
from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import NDArray

from sphstereo_ros.core.frames import RelativePose
from sphstereo_ros.core.rotations import matrix_from_quaternion, quaternion_from_matrix

from .imaging import (
    NO_NOISE,
    NOISE,
    Image8,
    Noise,
    develop,
    encode_jpeg,
    to_bytes,
    with_noise,
)
from .nuisances import NUISANCES, STREETS, WALL_SPACING, ImageEffects, check, with_nuisance
from .trajectory import (
    BODY_FROM_OPTICAL,
    FRAME_RATE,
    Trajectory,
    climb,
    drive,
    mounted,
    shaken,
)

if TYPE_CHECKING:  # reading a folder needs no ray caster
    from .render import Camera
    from .scene import Scene
    from .traffic import Mover

Array = NDArray[Any]

# Fixed before anything was tuned. Figures that are reported come from REPORTED_SEEDS alone, and
# nobody looks at those scenes while tuning; TUNING_SEEDS are free for all use.
TUNING_SEEDS = (1, 2, 3, 4, 5)
REPORTED_SEEDS = (1001, 1002, 1003, 1004, 1005)

FIRST_STAMP = 1_700_000_000_000_000_000
SCENES = ('street', 'takeoff', 'corridor')


@dataclass(frozen=True)
class TruthFrame:
    """One frame and the truth about it.

    stamp : ns; image : (H, 2H, 3) uint8 BGR; range : (H, 2H) metres through pixel centres, +inf
    is sky; rotation : (3, 3) world ← camera_optical; position : (3,) metres, world;
    exposure : relative; jpeg : the image's file, where it went through JPEG; moving : (H, 2H)
    bool, whether the pixel's range is of something that moves; None if nothing in the scene does
    """

    stamp: int
    image: Image8
    range: Array
    rotation: NDArray[np.float64]
    position: NDArray[np.float64]
    exposure: float = 1.0
    jpeg: bytes | None = None
    moving: NDArray[np.bool_] | None = None


def stamp_of(index: int) -> int:
    """Stamp of frame `index` at 30 Hz, ns."""
    return FIRST_STAMP + round(index / FRAME_RATE * 1e9)


def true_pose(reference: TruthFrame, current: TruthFrame) -> RelativePose:
    """The pose of `reference` in `current`, without covariance."""
    back = current.rotation.T
    return RelativePose(back @ reference.rotation,
                        back @ (reference.position - current.position))


class RenderedSequence(Sequence[TruthFrame]):
    """Frames of a scene along a trajectory, each rendered when it is asked for."""

    def __init__(self, scene: Scene, trajectory: Trajectory, height: int, seed: int,
                 effects: ImageEffects, movers: Sequence[Mover] = ()) -> None:
        """`scene` is without the `movers`, which are put into it frame by frame."""
        self.scene = scene
        self.trajectory = trajectory
        self.height = height
        self.seed = seed
        self.effects = effects
        self.movers = tuple(movers)
        self.exposures = effects.exposures(seed, len(trajectory))
        self._latest: tuple[int, Scene] | None = None

    def __len__(self) -> int:
        return len(self.trajectory)

    def __getitem__(self, index: int) -> TruthFrame:  # type: ignore[override]
        """Render frame `index`; slices are not supported."""
        if not -len(self) <= index < len(self):
            raise IndexError(f'frame {index} of {len(self)}')
        index %= len(self)
        camera = self.camera(index)
        picture, data = self._picture(index, camera.picture())
        distance, part = camera.range_and_parts()
        moving = np.isin(part, self._moving_parts(camera.scene)) if self.movers else None
        return TruthFrame(stamp_of(index), picture, distance, camera.rotation, camera.position,
                          float(self.exposures[index]), data, moving)

    def _picture(self, index: int, light: Array) -> tuple[Image8, bytes | None]:
        """The picture of frame `index` from its radiance, and its JPEG, if it went through one."""
        effects = self.effects
        if effects.flicker:
            light = light * effects.row_exposures(self.seed, index, len(light))[:, None, None]
        if effects.white_balance != (1.0, 1.0, 1.0):
            light = light * np.asarray(effects.white_balance, np.float32)
        rng = np.random.default_rng([self.seed, 3, index])
        image = develop(light, effects.gain * float(self.exposures[index]))
        picture = to_bytes(with_noise(image, effects.noise, rng))
        if effects.jpeg is None:
            return picture, None
        encoded = encode_jpeg(picture, effects.jpeg)
        return np.asarray(cv2.imdecode(encoded, cv2.IMREAD_COLOR), np.uint8), encoded.tobytes()

    def _moving_parts(self, scene: Scene) -> list[int]:
        names = {part.name for mover in self.movers for part in mover.parts}
        return [k for k, part in enumerate(scene.parts) if part.name in names]

    def scene_at(self, index: int) -> Scene:
        """The scene at the stamp of frame `index`: what moves is where it is then."""
        if not self.movers:
            return self.scene
        if self._latest is None or self._latest[0] != index:
            seconds = (stamp_of(index) - FIRST_STAMP) / 1e9
            parts = [part for mover in self.movers for part in mover.at(seconds)]
            self._latest = index, self.scene.replaced(*parts)
        return self._latest[1]

    def camera(self, index: int, height: int | None = None) -> Camera:
        """The camera of frame `index`, at this sequence's or another height."""
        from .render import Camera
        return Camera(self.scene_at(index), self.trajectory.rotations[index],
                      self.trajectory.positions[index], height or self.height)


@lru_cache(maxsize=1)
def _build(name: str, seed: int, nuisance: str | None = None) -> Scene:
    from . import hard_streets
    from .corridor import corridor
    from .street import street
    from .takeoff import takeoff
    builders: dict[str, Callable[[int], Scene]] = {
        'street': street, 'takeoff': takeoff, 'corridor': corridor,
        'occlusion': hard_streets.occlusion_street,
        'repetition': hard_streets.repetition_street,
        'traffic': hard_streets.traffic_street, 'wall': hard_streets.wall_street}
    return builders[nuisance or name](seed)


def _path(name: str, rng: np.random.Generator, frames: int,
          spacing: float | Sequence[float] | None, turn: float) -> tuple[Array, Array]:
    if name == 'takeoff':
        start = (float(rng.uniform(-1, 1)), float(rng.uniform(-1, 1)), 0.95)
        return climb(rng, frames, start, spacing, float(rng.uniform(-3, 3)))
    if name == 'corridor':
        start = (0.0, float(rng.uniform(-0.25, 0.25)), float(rng.uniform(1.2, 1.5)))
        return drive(rng, frames, start, 0.14 if spacing is None else spacing, turn=turn)
    if name == 'wall':
        start = (0.0, 0.0, float(rng.uniform(1.7, 2.1)))
        return drive(rng, frames, start, WALL_SPACING if spacing is None else spacing, turn=turn,
                     drift=0.0)
    start = (0.0, float(rng.uniform(-0.9, 0.7)), float(rng.uniform(1.7, 2.1)))
    return drive(rng, frames, start, 0.28 if spacing is None else spacing, turn=turn,
                 heading=float(rng.normal(0, 0.01)))


def _movers(nuisance: str | None, seed: int, positions: Array) -> Sequence[Mover]:
    if nuisance != 'traffic':
        return ()
    from .traffic import traffic
    steps = np.diff(positions[:, 0])
    return traffic(seed, FRAME_RATE * float(steps.mean()) if len(steps) else 0.0)


_GAIN = {'street': 1.0, 'takeoff': 0.8, 'corridor': 1.6}


def render_sequence(name: str, seed: int, frames: int, height: int = 960,
                    spacing: float | Sequence[float] | None = None,
                    shake_deg: tuple[float, float] = (1.0, 3.0), exposure: float = 0.05,
                    noise: Noise = NOISE, jpeg: int | None = 92,
                    mount: tuple[float, float, float] = (0.0, 0.0, 0.0),
                    turn_deg: float = 0.0, nuisance: str | None = None) -> RenderedSequence:
    """A sequence of the scene `name`, to be rendered frame by frame on demand.

    Parameters
    ----------
    name : one of SCENES
    seed : of layout, textures, trajectory, shake and noise
    frames, height : number of frames; image rows (columns are twice that)
    spacing : metres between consecutive frames, one or frames − 1 values; None: the scene's own
        (street 0.28, with the wall 0.267; corridor 0.14; take-off rising from 0.20 to 0.35)
    shake_deg : least and largest rotation between consecutive frames, without `turn_deg`
    exposure : largest relative change of the exposure
    noise : at 8 bits; NO_NOISE for none
    jpeg : quality the image went through; None for none
    mount : roll, pitch, yaw of the camera on the vehicle, rad
    turn_deg : the vehicle turns left by that much a frame (street and corridor)
    nuisance : one of NUISANCES, or None; where it is about exposure or noise, it overrules
        `exposure` and `noise`

    Raises
    ------
    ValueError
        for an unknown scene or nuisance, a nuisance that the scene does not have, or less than
        one frame
    ImportError
        without trimesh and embreex

    """
    if name not in SCENES:
        raise ValueError(f'{name!r} is none of {", ".join(SCENES)}')
    check(name, nuisance)
    if frames < 1 or height < 2:
        raise ValueError(f'{frames} frames of {height} rows')
    rng = np.random.default_rng([seed, 4])
    course = 'wall' if nuisance == 'wall' else name
    attitudes, positions = _path(course, rng, frames, spacing, np.radians(turn_deg))
    low, high = np.radians(shake_deg)
    trajectory = mounted(attitudes, positions, shaken(rng, frames, low, high), mount)
    effects = with_nuisance(ImageEffects(_GAIN[name], exposure, noise, jpeg), nuisance)
    scene = _build(name, seed, nuisance if nuisance in STREETS else None)
    return RenderedSequence(scene, trajectory, height, seed, effects,
                            _movers(nuisance, seed, trajectory.positions))


def rounded_range(values: Array, bits: int = 15) -> NDArray[np.float32]:
    """float32 with `bits` bits of mantissa (15: relative error ≤ 1.5e-5): compresses well."""
    drop = np.uint32(23 - bits)
    raw = np.ascontiguousarray(values, np.float32).view(np.uint32)
    half = np.uint32(1) << (drop - np.uint32(1))
    return ((raw + half) >> drop << drop).view(np.float32)


_CONVENTIONS = {
    'world_frame': 'REP-103: x forward, y left, z up, right-handed, metres',
    'camera_frame': 'body-like REP-103: x forward (image centre), y left, z up',
    'pose': 'camera to world: X_world = R(quaternion_xyzw) X_cam + position_m',
    'projection': 'equirectangular; pixel centre (u + 0.5, v + 0.5): lon = (0.5 - (u + 0.5)/W) '
                  '2 pi, positive to the left; lat = (0.5 - (v + 0.5)/H) pi, positive up',
    'range': "npz key 'range': Euclidean distance from the camera centre to the first surface "
             'along the ray through the pixel centre, metres, +inf = sky',
    'moving': 'png, only where something in the scene moves: 255 where the pixel shows it, else 0',
    'motion_to_next': 'direction_cam: unit vector of (p[i+1] - p[i]) in the frame of camera i; '
                      'rotation_next_in_this_xyzw: orientation of camera i+1 in camera i',
}


def _entry(index: int, frame: TruthFrame, image: str, depth: str) -> dict[str, Any]:
    finite = frame.range[np.isfinite(frame.range)]
    return {'index': index, 'image': image, 'depth': depth,
            'position_m': frame.position.tolist(),
            'quaternion_xyzw': quaternion_from_matrix(
                frame.rotation @ BODY_FROM_OPTICAL.T).tolist(),
            'relative_exposure': frame.exposure,
            'sky_fraction': float(np.mean(np.isposinf(frame.range))),
            'min_range_m': float(finite.min()) if finite.size else None,
            'stamp': (frame.stamp - FIRST_STAMP) / 1e9}


def _add_motions(entries: list[dict[str, Any]]) -> None:
    for this, following in pairwise(entries):
        turned = [matrix_from_quaternion(e['quaternion_xyzw']) for e in (this, following)]
        step = np.subtract(following['position_m'], this['position_m'])
        length = float(np.linalg.norm(step))
        relative = turned[0].T @ turned[1]
        q = quaternion_from_matrix(relative).tolist()
        this['motion_to_next'] = {
            'distance_m': length,
            'direction_cam': (turned[0].T @ step / max(length, 1e-12)).tolist(),
            'rotation_next_in_this_xyzw': q,
            'rotation_angle_deg': float(np.degrees(2 * np.arccos(min(1.0, q[3]))))}


def save_sequence(sequence: Sequence[TruthFrame], folder: str | Path, name: str = 'sequence',
                  small_height: int | None = None,
                  progress: Callable[[Iterator[int]], Iterator[int]] = lambda x: x) -> None:
    """Write frames as `meta.json`, `frame_%04d.jpg` or `.png`, `depth_%04d.npz`, and
    `moving_%04d.png` where the scene has something that moves.

    small_height : also write `range_small_%04d.npz`, the range at that height (rendered sequences
    only); progress : wraps the iterator over frames, as tqdm does
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    entries = []
    for index in progress(iter(range(len(sequence)))):
        frame = sequence[index]
        image = f'frame_{index:04d}.' + ('png' if frame.jpeg is None else 'jpg')
        data = cv2.imencode('.png', frame.image)[1].tobytes() if frame.jpeg is None else frame.jpeg
        (folder / image).write_bytes(data)
        depth = f'depth_{index:04d}.npz'
        np.savez_compressed(folder / depth, range=rounded_range(frame.range))
        entry = _entry(index, frame, image, depth)
        if frame.moving is not None:
            entry['moving'] = f'moving_{index:04d}.png'
            cv2.imwrite(str(folder / entry['moving']), np.uint8(255) * frame.moving)
        camera = getattr(sequence, 'camera', None)
        if small_height is not None and camera is not None:
            entry['range_small'] = f'range_small_{index:04d}.npz'
            small = camera(index, small_height).range()
            np.savez_compressed(folder / entry['range_small'], range=rounded_range(small, 12))
        entries.append(entry)
    _add_motions(entries)
    height, width = frame.range.shape
    meta = {'sequence': name, 'renderer': 'sphstereo_ros.scenes', 'width': width,
            'height': height, 'fps': FRAME_RATE, 'conventions': _CONVENTIONS,
            'depth_dtype': 'float32, 15 mantissa bits kept (relative error <= 1.5e-5)',
            'frames': entries}
    (folder / 'meta.json').write_text(json.dumps(meta, indent=1) + '\n')


class SavedSequence(Sequence[TruthFrame]):
    """Frames of a folder, each read when it is asked for."""

    def __init__(self, folder: str | Path) -> None:
        """Raise FileNotFoundError without a meta.json, ValueError if it is none of this kind."""
        self.folder = Path(folder)
        meta = json.loads((self.folder / 'meta.json').read_text())
        if not isinstance(meta, dict) or not isinstance(meta.get('frames'), list):
            raise ValueError(f'{self.folder / "meta.json"}: has no list of frames')
        self.meta: dict[str, Any] = meta

    def __len__(self) -> int:
        return len(self.meta['frames'])

    def __getitem__(self, index: int) -> TruthFrame:  # type: ignore[override]
        """Read frame `index`; slices are not supported."""
        entry = self.meta['frames'][index]
        path = self.folder / entry['image']
        image = cv2.imread(str(path), cv2.IMREAD_COLOR)
        if image is None:
            raise ValueError(f'{path}: not readable as an image')
        with np.load(self.folder / entry['depth']) as data:
            distance = data['range'].astype(np.float32)
        seconds = entry.get('stamp', index % len(self) / FRAME_RATE)
        return TruthFrame(
            FIRST_STAMP + round(seconds * 1e9), np.asarray(image, np.uint8), distance,
            matrix_from_quaternion(entry['quaternion_xyzw']) @ BODY_FROM_OPTICAL,
            np.array(entry['position_m'], np.float64), entry.get('relative_exposure', 1.0),
            path.read_bytes() if path.suffix == '.jpg' else None, self._moving(entry))

    def _moving(self, entry: dict[str, Any]) -> NDArray[np.bool_] | None:
        if 'moving' not in entry:
            return None
        path = self.folder / entry['moving']
        image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        if image is None:
            raise ValueError(f'{path}: not readable as an image')
        return np.asarray(image) > 127


def load_sequence(folder: str | Path) -> SavedSequence:
    """The sequence that `save_sequence`, or another renderer of the same format, wrote."""
    return SavedSequence(folder)


__all__ = ['NOISE', 'NO_NOISE', 'NUISANCES', 'REPORTED_SEEDS', 'SCENES', 'TUNING_SEEDS',
           'ImageEffects', 'Noise', 'RenderedSequence', 'SavedSequence', 'TruthFrame',
           'load_sequence', 'render_sequence', 'save_sequence', 'true_pose']
