"""Two cameras, one above the other, that see a rendered scene at the same times."""
from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sphstereo_ros.core.frames import RelativePose
from sphstereo_ros.core.rotations import matrix_from_rpy, quaternion_from_matrix

from .sequence import RenderedSequence, TruthFrame, render_sequence, save_sequence
from .trajectory import BODY_FROM_OPTICAL, Trajectory

if TYPE_CHECKING:
    from .render import Camera

# Seeds of the top camera's noise are those of the bottom one and this.
_OTHER_CAMERA = 1_000_000


@dataclass(frozen=True)
class TopCamera:
    """The top camera, as the bottom one sees it.

    rpy : roll, pitch, yaw of its camera_link in the bottom one's axes, rad
    baseline : metres between the two
    direction : from the bottom to the top camera, bottom camera_link axes, of any length
    gain : its exposure over the bottom one's; white_balance : gains of red, green, blue
    """

    rpy: tuple[float, float, float] = (0.0, 0.0, 0.0)
    baseline: float = 0.35
    direction: tuple[float, float, float] = (0.0, 0.0, 1.0)
    gain: float = 1.0
    white_balance: tuple[float, float, float] = (1.0, 1.0, 1.0)

    @property
    def position(self) -> np.ndarray[Any, np.dtype[np.float64]]:
        """(3,) metres, bottom camera_link axes."""
        direction = np.asarray(self.direction, np.float64)
        return np.asarray(self.baseline * direction / np.linalg.norm(direction))


class BinocularSequence(Sequence[TruthFrame]):
    """Frames of both cameras in turn: bottom, top, bottom, top, …; a pair has one stamp."""

    def __init__(self, bottom: RenderedSequence, rig: TopCamera) -> None:
        self.bottom = bottom
        self.rig = rig
        way = bottom.trajectory
        link = BODY_FROM_OPTICAL
        turn = link.T @ matrix_from_rpy(*rig.rpy) @ link
        effects = replace(bottom.effects, gain=rig.gain * bottom.effects.gain,
                          white_balance=rig.white_balance)
        top = Trajectory(way.rotations @ turn,
                         way.positions + way.rotations @ (link.T @ rig.position))
        self.top = RenderedSequence(bottom.scene, top, bottom.height,
                                    bottom.seed + _OTHER_CAMERA, effects, bottom.movers)

    def __len__(self) -> int:
        return 2 * len(self.bottom)

    def __getitem__(self, index: int) -> TruthFrame:  # type: ignore[override]
        """Render frame `index`; slices are not supported."""
        if not -len(self) <= index < len(self):
            raise IndexError(f'frame {index} of {len(self)}')
        pair, side = divmod(index % len(self), 2)
        return (self.bottom, self.top)[side][pair]

    def pairs(self) -> Iterator[tuple[TruthFrame, TruthFrame]]:
        """(top, bottom) of each stamp."""
        return ((top, bottom) for top, bottom in zip(self.top, self.bottom, strict=True))

    def camera(self, index: int, height: int | None = None) -> Camera:
        """The camera of frame `index`, at this sequence's or another height."""
        pair, side = divmod(index, 2)
        return (self.bottom, self.top)[side].camera(pair, height)

    def true_pose(self) -> RelativePose:
        """The pose of the top camera in the bottom one, without covariance."""
        link = BODY_FROM_OPTICAL
        return RelativePose(link.T @ matrix_from_rpy(*self.rig.rpy) @ link,
                            link.T @ self.rig.position)


def render_binocular(name: str, seed: int, pairs: int, height: int = 960,
                     rig: TopCamera | None = None, *,
                     spacing: float | Sequence[float] | None = None,
                     **options: Any) -> BinocularSequence:
    """A sequence of pairs of the scene `name`, to be rendered on demand.

    Parameters
    ----------
    name, seed, height : as for `render_sequence`
    pairs : so many
    rig : where the top camera is; the bottom one follows the trajectory
    spacing : metres between consecutive pairs, one or pairs − 1 values; 0 hovers, None is the
        scene's own
    options : others of `render_sequence`, for both cameras

    """
    bottom = render_sequence(name, seed, pairs, height, spacing, **options)
    return BinocularSequence(bottom, rig or TopCamera())


def save_binocular(sequence: BinocularSequence, folder: str | Path, name: str = 'binocular',
                   small_height: int | None = None,
                   progress: Callable[[Iterator[int]], Iterator[int]] = lambda x: x) -> None:
    """Write frames as `save_sequence` does; `pairs` in meta.json tells which belong together, and
    how the top camera is mounted (REP-103 axes of the bottom one).
    """
    save_sequence(sequence, folder, name, small_height, progress)
    path = Path(folder) / 'meta.json'
    meta = json.loads(path.read_text())
    for entry in meta['frames']:
        entry.pop('motion_to_next', None)
        entry['role'] = ('bottom', 'top')[entry['index'] % 2]
    rig = sequence.rig
    mounted = {'baseline_m': rig.baseline, 'top_in_bottom_xyz': rig.position.tolist(),
               'top_in_bottom_rpy_deg': np.degrees(rig.rpy).tolist(),
               'top_in_bottom_quaternion_xyzw':
                   quaternion_from_matrix(matrix_from_rpy(*rig.rpy)).tolist(),
               'note': 'p_bottom = R(quaternion) p_top + xyz; '
                       'rpy: R = Rz(yaw) Ry(pitch) Rx(roll)'}
    meta['pairs'] = [{'bottom': k, 'top': k + 1, **mounted} for k in range(0, len(sequence), 2)]
    path.write_text(json.dumps(meta, indent=1) + '\n')

