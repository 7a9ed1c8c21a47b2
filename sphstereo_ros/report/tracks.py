"""Trajectories: of odometry, and chained from the steps between frames."""
from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sphstereo_ros.core import rotations
from sphstereo_ros.core.frames import Drop, RelativePose
from sphstereo_ros.core.motion import OdometrySample
from sphstereo_ros.ros.conversions import nanoseconds, odometry_sample, read_window

FloatArray = NDArray[np.float64]
# Stamps of one moment that were rounded apart, and by how much the duration of a step that is
# computed from its length and its speed may be wrong, nanoseconds.
_SAME = 2_000_000


@dataclass(frozen=True)
class Track:
    """Poses of base_link by time.

    stamps : (N,) int64, nanoseconds, rising; positions : (N, 3) m; orientations : (N, 3, 3)
    """

    name: str
    stamps: NDArray[np.int64]
    positions: FloatArray
    orientations: FloatArray

    @property
    def length(self) -> float:
        """Metres along the track."""
        return float(np.linalg.norm(np.diff(self.positions, axis=0), axis=1).sum())

    def at(self, stamp: int) -> tuple[FloatArray, FloatArray] | None:
        """Position and rotation, interpolated; None outside of the track's times."""
        after = int(np.searchsorted(self.stamps, stamp))
        if after < len(self.stamps) and self.stamps[after] - stamp <= _SAME:
            return self.positions[after], self.orientations[after]
        if after == 0 or after == len(self.stamps):
            near = after > 0 and stamp - self.stamps[-1] <= _SAME
            return (self.positions[-1], self.orientations[-1]) if near else None
        begin, end = self.stamps[after - 1], self.stamps[after]
        part = (stamp - begin) / (end - begin)
        first, second = self.orientations[after - 1], self.orientations[after]
        turn = rotations.exp(part * rotations.log(second @ first.T))
        return (self.positions[after - 1] * (1 - part) + self.positions[after] * part,
                turn @ first)


def _track(name: str, poses: Mapping[int, tuple[FloatArray, FloatArray]]) -> Track | None:
    if len(poses) < 2:
        return None
    stamps = sorted(poses)
    return Track(name, np.array(stamps, np.int64), np.array([poses[s][0] for s in stamps]),
                 np.array([poses[s][1] for s in stamps]))


def odometry_track(name: str, messages: Iterable[Any]) -> Track | None:
    """Of nav_msgs/Odometry with poses of base_link; None for less than two."""
    samples = (odometry_sample(message) for message in messages)
    return _track(name, {s.stamp: (s.position, s.rotation) for s in samples
                         if isinstance(s, OdometrySample)})


def path_track(name: str, message: Any) -> Track | None:
    """Of a nav_msgs/Path with poses of base_link; None for less than two."""
    poses = {}
    for stamped in message.poses:
        p, q = stamped.pose.position, stamped.pose.orientation
        quaternion = np.array([q.x, q.y, q.z, q.w])
        if np.isfinite([p.x, p.y, p.z]).all() and abs(np.linalg.norm(quaternion) - 1) < 1e-3:
            poses[nanoseconds(stamped.header.stamp)] = (
                np.array([p.x, p.y, p.z]), rotations.matrix_from_quaternion(quaternion))
    return _track(name, poses)


def visual_track(name: str, paths: Sequence[Any], steps: Sequence[Any]) -> Track | None:
    """Chain the longest unbroken run of steps between frames; None without metres.

    paths : nav_msgs/Path of pairs/aligned; else `steps`, nav_msgs/Odometry of odometry/visual,
        which do not name their reference: its time is told by length and speed
    Poses are the camera's, in forward-left-up axes of where it began; its mount is not known here.
    """
    links = [link for link in map(_of_window, paths) if link is not None] or [
        link for link in map(_of_step, steps) if link is not None]
    best: dict[int, tuple[FloatArray, FloatArray]] = {}
    run: dict[int, tuple[FloatArray, FloatArray]] = {}
    for before, current, pose in links:
        known = min(run, key=lambda stamp: abs(stamp - before), default=None)
        if known is None or abs(known - before) > _SAME:
            run, known = {before: (np.zeros(3), np.eye(3))}, before
        position, rotation = run[known]
        # X_current = R · X_reference + p
        run[current] = (position - rotation @ pose.rotation.T @ pose.position,
                        rotation @ pose.rotation.T)
        if len(run) > len(best):
            best = run
    link = rotations.OPTICAL_FROM_LINK
    return _track(name, {stamp: (link.T @ position, link.T @ rotation @ link)
                         for stamp, (position, rotation) in best.items()})


def _of_window(path: Any) -> tuple[int, int, RelativePose] | None:
    window = read_window(path)
    if isinstance(window, Drop):
        return None
    # A camera beside this one takes no step.
    steps = [(key, pose) for key, pose in window.references
             if key.frame_id == window.current.frame_id and pose.is_metric]
    if not steps:
        return None
    key, pose = max(steps, key=lambda step: step[0].stamp)
    return key.stamp, window.current.stamp, pose


def _of_step(message: Any) -> tuple[int, int, RelativePose] | None:
    sample = odometry_sample(message)
    if isinstance(sample, Drop) or message.header.frame_id != message.child_frame_id:
        return None
    v = message.twist.twist.linear
    speed, length = np.linalg.norm([v.x, v.y, v.z]), np.linalg.norm(sample.position)
    if not (speed > 0 and length > 0 and np.isfinite([speed, length]).all()):
        return None
    pose = RelativePose(sample.rotation.T, -sample.rotation.T @ sample.position)
    return sample.stamp - round(1e9 * length / speed), sample.stamp, pose


@dataclass(frozen=True)
class TrackError:
    """How far a track lies from another, laid over it without a change of scale.

    distance : m along the reference; rmse : m; greatest : m
    """

    distance: float
    rmse: float
    greatest: float


def laid_over(track: Track, reference: Track) -> Track | None:
    """`track` turned and shifted so that it begins as `reference` does where both are there."""
    for stamp, position, rotation in zip(track.stamps, track.positions, track.orientations,
                                         strict=True):
        pose = reference.at(int(stamp))
        if pose is not None:
            turn = pose[1] @ rotation.T
            return Track(track.name, track.stamps,
                         (track.positions - position) @ turn.T + pose[0],
                         turn @ track.orientations)
    return None


def track_error(track: Track, reference: Track) -> TrackError | None:
    """Compare positions at the track's times; rotation and shift by least squares (Horn, Arun)."""
    pairs = [(position, pose[0]) for stamp, position in zip(track.stamps, track.positions,
                                                            strict=True)
             if (pose := reference.at(int(stamp))) is not None]
    if len(pairs) < 3:
        return None
    ours, theirs = (np.array(side) for side in zip(*pairs, strict=True))
    u, _, vt = np.linalg.svd((theirs - theirs.mean(0)).T @ (ours - ours.mean(0)))
    turn = u @ np.diag([1, 1, np.sign(np.linalg.det(u @ vt))]) @ vt
    errors = np.linalg.norm((ours - ours.mean(0)) @ turn.T + theirs.mean(0) - theirs, axis=1)
    length = float(np.linalg.norm(np.diff(theirs, axis=0), axis=1).sum())
    return TrackError(length, float(np.sqrt((errors**2).mean())), float(errors.max()))
