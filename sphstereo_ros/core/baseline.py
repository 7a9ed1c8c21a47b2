"""Prior poses between frames: distance and rotation from what sensors and parameters tell.

A prior is where the reference camera was, seen from the current one. Its length comes from
`baseline.source`; its rotation from odometry, twist or an IMU, whichever is there.
"""
from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Callable, Hashable, Iterable, Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import Generic, Protocol, TypeVar

import numpy as np

from sphstereo_ros.core import rotations
from sphstereo_ros.core.config import Config
from sphstereo_ros.core.frames import UNSCALED, Drop, RelativePose
from sphstereo_ros.core.motion import ImuSample, OdometrySample, TwistSample
from sphstereo_ros.core.rotations import FloatArray, Mount

SECOND = 1_000_000_000
TRACK_SIZE = 4000
# An IMU is only a help, so no frame waits for it: its last rate holds this long instead.
GYRO_HOLD = SECOND // 20


class _Stamped(Protocol):
    @property
    def stamp(self) -> int: ...


S = TypeVar('S', bound=_Stamped)
K = TypeVar('K', bound=Hashable)
V = TypeVar('V')


class Track(Generic[S]):
    """The newest samples of one sensor, ordered by stamp.

    name : prefix of the causes of its drops
    max_gap : nanoseconds; nothing is interpolated over a longer gap, and a stamp that lies
        farther back than that starts the track anew (a recording that loops)
    """

    def __init__(self, name: str, max_gap: int) -> None:
        self.name = name
        self.max_gap = max_gap
        self._stamps: list[int] = []
        self._samples: list[S] = []

    def __len__(self) -> int:
        return len(self._samples)

    @property
    def newest(self) -> int | None:
        """Greatest stamp, nanoseconds."""
        return self._stamps[-1] if self._stamps else None

    def clear(self) -> None:
        """Forget all samples."""
        self._stamps.clear()
        self._samples.clear()

    def add(self, sample: S) -> Drop | None:
        """Insert a sample; the Drop tells what was thrown away for it: the sample or the past."""
        drop = None
        if self._stamps and sample.stamp < self._stamps[-1] - self.max_gap:
            drop = Drop(f'{self.name}_backward', 'earlier samples were forgotten')
            self.clear()
        place = bisect_left(self._stamps, sample.stamp)
        if place < len(self._stamps) and self._stamps[place] == sample.stamp:
            return Drop(f'{self.name}_duplicate', f'stamp {sample.stamp}')
        self._stamps.insert(place, sample.stamp)
        self._samples.insert(place, sample)
        if len(self._stamps) > TRACK_SIZE:
            del self._stamps[0], self._samples[0]
        return drop

    def around(self, stamp: int) -> tuple[S, S, float] | None:
        """Neighbours of `stamp` and the share of the later one; None where not enclosed."""
        place = bisect_left(self._stamps, stamp)
        if place == len(self._stamps):
            return None
        after = self._samples[place]
        if self._stamps[place] == stamp:
            return after, after, 0.0
        if place == 0 or self._stamps[place] - self._stamps[place - 1] > self.max_gap:
            return None
        before = self._samples[place - 1]
        return before, after, (stamp - before.stamp) / (after.stamp - before.stamp)

    def before(self, stamp: int) -> S | None:
        """The last sample before `stamp`; None where there is none."""
        place = bisect_left(self._stamps, stamp)
        return self._samples[place - 1] if place else None

    def between(self, first: int, last: int) -> list[S]:
        """Samples strictly between two stamps."""
        return self._samples[bisect_left(self._stamps, first + 1):bisect_left(self._stamps, last)]


@dataclass(frozen=True)
class BaseMotion:
    """Pose of the later `base_link` in the earlier one: rotation (3, 3), position (3,) metres."""

    rotation: FloatArray
    position: FloatArray


def camera_pose(motion: BaseMotion, mount: Mount) -> RelativePose:
    """Pose of the earlier camera in the later one's optical frame (lever arm included)."""
    back = motion.rotation.T
    position = back @ (mount.position - motion.position) - mount.position
    return RelativePose(mount.rotation.T @ back @ mount.rotation, mount.rotation.T @ position)


def interpolate_odometry(track: Track[OdometrySample], stamp: int) -> OdometrySample | None:
    """Pose at `stamp`: positions linear, rotations along the shortest arc; None if not enclosed.
    """
    found = track.around(stamp)
    if found is None:
        return None
    a, b, share = found
    turn = rotations.log(a.rotation.T @ b.rotation)
    covariance = None
    if a.covariance is not None and b.covariance is not None:
        covariance = (1 - share) * a.covariance + share * b.covariance
    return OdometrySample(stamp, (1 - share) * a.position + share * b.position,
                          a.rotation @ rotations.exp(share * turn), covariance)


def mean_rates(track: Track[S], first: int, last: int, rate: Callable[[S], FloatArray],
               hold: int = 0) -> list[tuple[float, FloatArray]] | None:
    """Cut [first, last] at the samples: (seconds, mean rate) of each piece.

    hold : nanoseconds that the newest sample's rate may stand for what follows it
    None where the samples do not cover the time.
    """
    newest = track.newest
    if newest is None:
        return None
    held = min(last, newest) if last - newest <= hold else last
    knots: list[tuple[int, FloatArray]] = []
    for stamp in (first, held):
        found = track.around(stamp)
        if found is None:
            return None
        a, b, share = found
        knots.append((stamp, (1 - share) * rate(a) + share * rate(b)))
    knots[1:1] = [(s.stamp, rate(s)) for s in track.between(first, held)]
    if last > held:
        knots.append((last, knots[-1][1]))
    if any(b - a > track.max_gap for (a, _), (b, _) in pairwise(knots)):
        return None
    return [((b - a) / SECOND, (u + v) / 2) for (a, u), (b, v) in pairwise(knots)]


def integrate_twist(rates: list[tuple[float, FloatArray]]) -> BaseMotion:
    """Integrate (seconds, [linear, angular] (6,)) pieces; exact where a piece's rate is constant.
    """
    rotation, position = np.eye(3), np.zeros(3)
    for seconds, rate in rates:
        turn = rate[3:] * seconds
        position = position + rotation @ (_arc(turn) @ rate[:3]) * seconds
        rotation = rotation @ rotations.exp(turn)
    return BaseMotion(rotation, position)


def _arc(turn: FloatArray) -> FloatArray:
    """Mean of the rotations from none to `turn`: what a constant velocity is averaged by."""
    angle = float(np.linalg.norm(turn))
    k = rotations.skew(turn)
    if angle < 1e-4:
        return np.eye(3) + k / 2 + k @ k / 6
    return np.asarray(np.eye(3) + (1 - np.cos(angle)) / angle**2 * k
                      + (angle - np.sin(angle)) / angle**3 * (k @ k))


def _growth(earlier: FloatArray | None, later: FloatArray | None) -> FloatArray | None:
    """Covariance of the difference of two odometry poses, (6, 6), or None where it is not told.

    Two near poses share most of their error; what differs is what the covariance grew by.
    """
    if earlier is None or later is None:
        return None
    values, vectors = np.linalg.eigh(later - earlier)
    values = np.maximum(values, 0.0)
    return None if not values.any() else np.asarray((vectors * values) @ vectors.T)


def _twist_rate(sample: TwistSample) -> FloatArray:
    return np.concatenate([sample.linear, sample.angular])


def _remember(kept: dict[K, V], key: K, value: V) -> None:
    """Add to what was computed once; the oldest go."""
    kept[key] = value
    while len(kept) > TRACK_SIZE:
        del kept[next(iter(kept))]


class MotionPriors:
    """Prior poses between any two stamps, from sensor tracks and parameters."""

    def __init__(self, config: Config) -> None:
        gap = round(config.pairing.max_gap * SECOND)
        self._odometry: Track[OdometrySample] = Track('odometry', gap)
        self._twist: Track[TwistSample] = Track('twist', gap)
        self._imu: Track[ImuSample] = Track('imu', gap)
        self._positions: dict[int, FloatArray] = {}
        self._steps: dict[tuple[int, int], BaseMotion] = {}
        self.configure(config)

    def configure(self, config: Config) -> None:
        """Take new parameters; the samples stay."""
        self._config = config.baseline
        self._mount = rotations.mount(config.camera)
        self._forget_places()
        for track in (self._odometry, self._twist, self._imu):
            track.max_gap = round(config.pairing.max_gap * SECOND)

    def add_odometry(self, sample: OdometrySample) -> Drop | None:
        """Insert a sample of odometry."""
        if not (np.isfinite(sample.position).all() and np.isfinite(sample.rotation).all()):
            return Drop('odometry_invalid', 'pose is not finite')
        return self._added(self._odometry, sample)

    def add_twist(self, sample: TwistSample) -> Drop | None:
        """Insert a sample of velocity."""
        if not (np.isfinite(sample.linear).all() and np.isfinite(sample.angular).all()):
            return Drop('twist_invalid', 'velocity is not finite')
        return self._added(self._twist, sample)

    def add_imu(self, sample: ImuSample) -> Drop | None:
        """Insert a sample of an IMU."""
        if sample.orientation is None and not np.isfinite(sample.angular).all():
            return Drop('imu_invalid', 'neither orientation nor angular velocity')
        return self._imu.add(sample)

    def share_samples(self, priors: MotionPriors) -> None:
        """Know the samples that `priors` knows, from now on and so far."""
        self._odometry, self._twist, self._imu = priors._odometry, priors._twist, priors._imu

    def samples_came(self) -> None:
        """Samples were added to what is shared."""
        self._forget_places()

    def _added(self, track: Track[S], sample: S) -> Drop | None:
        """Insert a sample; what it adds to the past changes places there."""
        if track.newest is not None and sample.stamp <= track.newest:
            self._forget_places()
        return track.add(sample)

    def _forget_places(self) -> None:
        self._positions.clear()
        self._steps.clear()

    def time_jumped(self, stamp: int) -> None:
        """Forget the samples of a sensor that lies far after `stamp`: they are from before a jump.
        """
        self._forget_places()
        for track in (self._odometry, self._twist, self._imu):
            if track.newest is not None and track.newest - stamp > track.max_gap:
                track.clear()

    def waits_for(self, stamp: int) -> str:
        """Name of the sensor that must first reach `stamp`, or '' where none must."""
        if self._config.source == 'odometry':
            newest = self._odometry.newest
        elif self._config.source == 'twist':
            newest = self._twist.newest
        else:
            return ''
        return self._config.source if newest is None or newest < stamp else ''

    def between(self, earlier: int, later: int, frames: int) -> RelativePose | Drop:
        """Where the camera of the earlier stamp was, in the later one's optical frame.

        earlier, later : nanoseconds; frames : how many frames lie between (1 = consecutive)
        """
        source = self._config.source
        if source == 'fixed':
            return self._assumed(earlier, later, (self._config.length or UNSCALED) * frames)
        if source == 'speed':
            length = self._config.speed * (later - earlier) / SECOND
            return self._assumed(earlier, later, length or UNSCALED * frames)
        pose = self._by_odometry(earlier, later)
        if source == 'twist':
            pose = self._by_twist(earlier, later, pose)
        if pose is None:
            return Drop(f'{source}_missing', f'no {source} encloses {earlier} to {later} ns')
        if pose.baseline < self._config.minimum:
            return Drop('baseline_too_short', f'{pose.baseline:.4f} m')
        return pose

    def moved(self, stamp: int, until: int) -> RelativePose | None:
        """Where the camera was (or will be) at `stamp`, in its own optical frame at `until`.

        None where neither odometry nor twist tells; then rotation alone, where an IMU does.
        """
        if stamp == until:
            return None
        first, last = min(stamp, until), max(stamp, until)
        pose = self._by_odometry(first, last) or self._by_twist(first, last, None)
        if pose is None:
            turn = self._imu_turn(first, last)
            if turn is None:
                return None
            pose = camera_pose(BaseMotion(turn, np.zeros(3)), self._mount)
        if stamp == first:
            return pose
        return RelativePose(pose.rotation.T, -pose.rotation.T @ pose.position)

    def distances(self, later: int, earlier: Iterable[int]) -> Iterator[float]:
        """Metres between the camera at `later` and at each of `earlier` (ns, newest first).

        NaN where the sensor does not tell, or tells of less than `baseline.minimum`.
        """
        config = self._config
        if config.source == 'fixed':
            yield from (config.length * back for back, _ in enumerate(earlier, start=1))
            return
        if config.source == 'speed':
            yield from (config.speed * (later - stamp) / SECOND for stamp in earlier)
            return
        places = self._twist_places if config.source == 'twist' else self._odometry_places
        for distance in places(later, earlier):
            yield distance if distance >= config.minimum else math.nan

    def _odometry_places(self, later: int, earlier: Iterable[int]) -> Iterator[float]:
        here = self._camera_position(later)
        for stamp in earlier:
            there = self._camera_position(stamp)
            yield math.nan if here is None or there is None \
                else float(np.linalg.norm(here - there))

    def _camera_position(self, stamp: int) -> FloatArray | None:
        """The camera in `odom` at `stamp`, (3,) metres."""
        if stamp not in self._positions:
            pose = interpolate_odometry(self._odometry, stamp)
            if pose is None:
                return None
            _remember(self._positions, stamp, pose.position + pose.rotation @ self._mount.position)
        return self._positions[stamp]

    def _twist_places(self, later: int, earlier: Iterable[int]) -> Iterator[float]:
        rotation, position, stamp = np.eye(3), np.zeros(3), later
        known = True
        for before in earlier:
            step = self._twist_step(before, stamp) if known else None
            if step is None:
                known = False
                yield math.nan
                continue
            # The later base in the base at `before`.
            position = step.position + step.rotation @ position
            rotation = step.rotation @ rotation
            stamp = before
            yield camera_pose(BaseMotion(rotation, position), self._mount).baseline

    def _twist_step(self, first: int, last: int) -> BaseMotion | None:
        if (first, last) not in self._steps:
            rates = mean_rates(self._twist, first, last, _twist_rate)
            if rates is None:
                return None
            _remember(self._steps, (first, last), integrate_twist(rates))
        return self._steps[first, last]

    def _assumed(self, earlier: int, later: int, length: float) -> RelativePose:
        """Forward by `length`."""
        pose = self._by_odometry(earlier, later)
        rotation = self._imu_rotation(earlier, later) if pose is None else pose.rotation
        return RelativePose(rotation, np.array([0.0, 0.0, -length]))

    def _by_odometry(self, earlier: int, later: int) -> RelativePose | None:
        a = interpolate_odometry(self._odometry, earlier)
        b = interpolate_odometry(self._odometry, later)
        if a is None or b is None:
            return None
        motion = BaseMotion(a.rotation.T @ b.rotation, a.rotation.T @ (b.position - a.position))
        pose = camera_pose(motion, self._mount)
        grown = _growth(a.covariance, b.covariance)
        if grown is None:
            return pose
        axes = (b.rotation @ self._mount.rotation).T
        covariance = np.zeros((6, 6))
        covariance[:3, :3] = axes @ grown[3:, 3:] @ axes.T
        covariance[3:, 3:] = axes @ grown[:3, :3] @ axes.T
        return RelativePose(pose.rotation, pose.position, covariance)

    def _by_twist(self, earlier: int, later: int,
                  odometry: RelativePose | None) -> RelativePose | None:
        rates = mean_rates(self._twist, earlier, later, _twist_rate)
        if rates is None:
            return None
        pose = camera_pose(integrate_twist(rates), self._mount)
        return pose if odometry is None else RelativePose(odometry.rotation, pose.position)

    def _imu_rotation(self, earlier: int, later: int) -> FloatArray:
        """Rotation of the earlier camera in the later one; identity, as any prior, if not told."""
        turn = self._imu_turn(earlier, later)
        if turn is None:
            return np.eye(3)
        return np.asarray(self._mount.rotation.T @ turn.T @ self._mount.rotation)

    def _imu_turn(self, earlier: int, later: int) -> FloatArray | None:
        ends = [self._imu_orientation(stamp) for stamp in (earlier, later)]
        if ends[0] is not None and ends[1] is not None:
            return np.asarray(ends[0].T @ ends[1])
        rates = mean_rates(self._imu, earlier, later, lambda s: s.angular, GYRO_HOLD)
        if rates is None or not all(np.isfinite(rate).all() for _, rate in rates):
            return None
        turn = np.eye(3)
        for seconds, rate in rates:
            turn = turn @ rotations.exp(rate * seconds)
        return turn

    def _imu_orientation(self, stamp: int) -> FloatArray | None:
        found = self._imu.around(stamp)
        if found is None or found[0].orientation is None or found[1].orientation is None:
            return None
        a, b, share = found[0].orientation, found[1].orientation, found[2]
        return a @ rotations.exp(share * rotations.log(a.T @ b))
