"""Submaps joined into one map.

Submaps that share frames are joined by the poses of these: visual odometry is sharper than any
registration of clouds. Over a gap the clouds are registered, from where odometry or the last
motion puts them.
"""
from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from .config import Config
from .frames import Drop, RelativePose
from .history import compose, inverse
from .mapping import Submap, has_free_scales
from .pose_graph import Floats
from .registration import registered
from .track import TrackedFrame
from .voxels import Map32, VoxelMap, VoxelPoints

_NEAR, _SHARP = 25.0, 0.1  # m from the gap, and of sigma: what is registered
_GAP = 10.0  # s: over a longer one the last motion tells nothing
_LEAST_SPREAD = 0.05  # m of shared track that tells a scale


@dataclass(frozen=True)
class _Placement:
    """X_map = scale · rotation · X_submap + position."""

    rotation: Floats
    position: Floats
    scale: float = 1.0

    def frame(self, frame: TrackedFrame) -> TrackedFrame:
        return TrackedFrame(frame.key, self.rotation @ frame.rotation,
                            self.scale * self.rotation @ frame.position + self.position,
                            self.scale * frame.scale)


class MapBuilder:
    """Joins submaps in the order of time."""

    def __init__(self, config: Config) -> None:
        self._same_scale = not has_free_scales(config) or config.mapping.camera_height > 0
        self._voxels = VoxelMap(config.mapping.voxel, config.mapping.max_points)
        self._frames: list[TrackedFrame] = []
        self._ways = [0.0, 0.0]
        self._odometry: tuple[RelativePose, RelativePose] | None = None

    def add(self, submap: Submap, odometry: tuple[RelativePose, RelativePose] | None = None,
            follows: bool = True) -> Drop | None:
        """Join a submap.

        Parameters
        ----------
        submap : in a frame of its own
        odometry : poses of its first and its last camera as odometry tells, where it does
        follows : whether its stamps go on from those of the submap before

        Returns
        -------
        `not_joined`, where nothing tells where it belongs; the map is as before then

        """
        if not submap.frames:
            return Drop('not_joined', 'no frame has a place')
        placed = self._placed(submap, odometry, follows)
        if isinstance(placed, Drop):
            return placed
        known = {f.key for f in self._frames} if follows else set()
        self._frames += [placed.frame(f) for f in submap.frames if f.key not in known]
        self._voxels.add_voxels(submap.points.moved(placed.rotation, placed.position,
                                                    placed.scale))
        self._ways[0] += submap.assumed
        self._ways[1] += placed.scale * submap.tracked
        self._odometry = odometry
        return None

    def finish(self) -> tuple[list[TrackedFrame], VoxelPoints]:
        """The track and all voxels: as long on the whole as was assumed, where that is all that
        is known.
        """
        factor = self._ways[0] / self._ways[1] if self._ways[1] else 1.0
        points = self._voxels.points()
        if not self._frames or factor == 1.0:
            return self._frames, points
        origin = self._frames[0].position
        whole = _Placement(np.eye(3), (1 - factor) * origin, factor)
        return ([whole.frame(f) for f in self._frames],
                points.moved(whole.rotation, whole.position, factor))

    def _placed(self, submap: Submap, odometry: tuple[RelativePose, RelativePose] | None,
                follows: bool) -> _Placement | Drop:
        if not self._frames:
            return _Placement(np.eye(3), np.zeros(3))
        here = {f.key: f for f in self._frames[-1000:]} if follows else {}
        shared = [(here[f.key], f) for f in submap.frames if f.key in here]
        if shared:
            return self._by_frames(shared)
        return self._over_gap(submap, odometry, follows)

    def _by_frames(self, shared: list[tuple[TrackedFrame, TrackedFrame]]) -> _Placement:
        u, _, vt = np.linalg.svd(sum(a.rotation @ b.rotation.T for a, b in shared))
        rotation = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
        there = np.stack([a.position for a, _ in shared])
        here = np.stack([b.position for _, b in shared])
        scale = 1.0
        if not self._same_scale:
            lengths = [float(np.linalg.norm(p - p.mean(axis=0))) for p in (there, here)]
            if min(lengths) > _LEAST_SPREAD:
                scale = lengths[0] / lengths[1]
            else:
                scale = shared[-1][0].scale / shared[-1][1].scale
        return _Placement(rotation, (there - scale * here @ rotation.T).mean(axis=0), scale)

    def _over_gap(self, submap: Submap, odometry: tuple[RelativePose, RelativePose] | None,
                  follows: bool) -> _Placement | Drop:
        """Registered; where that fails, odometry alone serves."""
        first, last = submap.frames[0], self._frames[-1]
        by_odometry = odometry is not None and self._odometry is not None
        if odometry is not None and self._odometry is not None:
            between = compose(inverse(self._odometry[1]), odometry[0])
            believed = compose(RelativePose(last.rotation, last.position), between)
        else:
            believed = self._by_last_motion(first.key.stamp, follows)
        start = compose(believed, inverse(RelativePose(first.rotation, first.position)))
        target = _near(self._voxels.points(), last.position)
        found = registered(target, _near(submap.points, first.position), start, by_odometry)
        if isinstance(found, Drop):
            if not by_odometry:
                return Drop('not_joined', f'{found.cause}: {found.detail}')
            found = start
        return _Placement(found.rotation, found.position)

    def _by_last_motion(self, stamp: int, follows: bool) -> RelativePose:
        """Where the camera would be if it had gone on as it did."""
        last = self._frames[-1]
        pose = RelativePose(last.rotation, last.position)
        if len(self._frames) < 2 or not follows:
            return pose
        before = self._frames[-2]
        gap = (stamp - last.key.stamp) * 1e-9
        seconds = (last.key.stamp - before.key.stamp) * 1e-9
        if not 0 < gap < _GAP or seconds <= 0:
            return pose
        way = (last.position - before.position) * (gap / seconds)
        return replace(pose, position=pose.position + way)


def _near(points: VoxelPoints, place: Floats) -> Map32:
    sharp = points.sigma <= _SHARP
    near = np.linalg.norm(points.xyz - place.astype(np.float32), axis=1) < _NEAR
    chosen: Map32 = points.xyz[sharp & near]
    return chosen
