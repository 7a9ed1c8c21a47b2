"""Prior poses: exact values for every source, with a mount that is anything but trivial."""
from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sphstereo_ros.core import rotations
from sphstereo_ros.core.baseline import (
    GYRO_HOLD,
    SECOND,
    TRACK_SIZE,
    MotionPriors,
    Track,
    interpolate_odometry,
)
from sphstereo_ros.core.config import resolve
from sphstereo_ros.core.frames import UNSCALED, Drop, RelativePose
from sphstereo_ros.core.motion import ImuSample, OdometrySample, TwistSample

MOUNT = {'camera.mount.x': 0.4, 'camera.mount.y': -0.2, 'camera.mount.z': 0.3,
         'camera.mount.roll': 0.3, 'camera.mount.pitch': -0.5, 'camera.mount.yaw': 1.1}
MOUNT_ROTATION = rotations.mount(resolve(MOUNT).camera).rotation
LEVER = np.array([0.4, -0.2, 0.3])
VELOCITY = np.array([3.0, -0.5, 0.7])
RATE = np.array([0.2, -0.3, 0.9])


def priors(**given: object) -> MotionPriors:
    return MotionPriors(resolve({**MOUNT, **{k.replace('__', '.'): v for k, v in given.items()}}))


def homogeneous(rotation: np.ndarray, position: np.ndarray) -> np.ndarray:
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = rotation, position
    return out


def se3(linear: np.ndarray, angular: np.ndarray, seconds: float) -> np.ndarray:
    """Pose after `seconds` of constant body velocity, by the matrix exponential's series."""
    generator = np.zeros((4, 4))
    generator[:3, :3], generator[:3, 3] = rotations.skew(angular), linear
    out, term = np.eye(4), np.eye(4)
    for k in range(1, 30):
        term = term @ generator * seconds / k
        out = out + term
    return out


def camera_in_camera(base1: np.ndarray, base2: np.ndarray) -> np.ndarray:
    """Pose of camera 1 in camera 2 from the poses of the base, all 4×4."""
    mount = homogeneous(MOUNT_ROTATION, LEVER)
    return np.linalg.inv(base2 @ mount) @ base1 @ mount


def sample(stamp: int, pose: np.ndarray, covariance: np.ndarray | None = None) -> OdometrySample:
    return OdometrySample(stamp, pose[:3, 3], pose[:3, :3], covariance)


def expect(pose: RelativePose | Drop, truth: np.ndarray) -> RelativePose:
    assert isinstance(pose, RelativePose), pose
    np.testing.assert_allclose(pose.rotation, truth[:3, :3], atol=1e-12)
    np.testing.assert_allclose(pose.position, truth[:3, 3], atol=1e-12)
    return pose


START = homogeneous(rotations.exp([0.5, 1.5, -2.0]), np.array([10.0, -20.0, 5.0]))


def test_fixed_length_counts_frames() -> None:
    pose = priors(baseline__length=0.28).between(0, 99, 5)
    expect(pose, homogeneous(np.eye(3), np.array([0, 0, -1.4])))


def test_fixed_without_length_is_a_direction_only() -> None:
    for frames in (1, 5, 100):
        pose = priors().between(0, 99, frames)
        assert isinstance(pose, RelativePose)
        assert not pose.is_metric
        np.testing.assert_allclose(pose.position, [0, 0, -frames * UNSCALED], rtol=1e-12)


def test_speed_counts_time() -> None:
    pose = priors(baseline__source='speed', baseline__speed=8.0).between(SECOND, 3 * SECOND // 2,
                                                                         7)
    expect(pose, homogeneous(np.eye(3), np.array([0, 0, -4.0])))
    unknown = priors(baseline__source='speed').between(0, SECOND, 1)
    assert isinstance(unknown, RelativePose)
    assert not unknown.is_metric


def test_odometry_at_equal_stamps() -> None:
    move = se3(VELOCITY, RATE, 0.4)
    p = priors(baseline__source='odometry')
    assert p.waits_for(0) == 'odometry'
    p.add_odometry(sample(0, START))
    assert p.waits_for(0) == ''
    assert p.waits_for(400_000_000) == 'odometry'
    p.add_odometry(sample(400_000_000, START @ move))
    assert p.waits_for(400_000_000) == ''
    pose = expect(p.between(0, 400_000_000, 1), camera_in_camera(START, START @ move))
    assert pose.covariance is None


def test_odometry_measures_the_camera_not_the_base() -> None:
    """A turn on the spot moves a camera that is mounted off the axis."""
    p = priors(baseline__source='odometry')
    p.add_odometry(sample(0, np.eye(4)))
    p.add_odometry(sample(SECOND, homogeneous(rotations.exp([0, 0, 0.5]), np.zeros(3))))
    pose = p.between(0, SECOND, 1)
    assert isinstance(pose, RelativePose)
    assert pose.baseline == pytest.approx(2 * math.hypot(0.4, 0.2) * math.sin(0.25), abs=1e-12)


def test_odometry_forward_motion_puts_the_reference_behind() -> None:
    p = MotionPriors(resolve({'baseline.source': 'odometry'}))
    p.add_odometry(sample(0, np.eye(4)))
    p.add_odometry(sample(SECOND, homogeneous(np.eye(3), np.array([0.3, 0, 0]))))
    expect(p.between(0, SECOND, 1), homogeneous(np.eye(3), np.array([0, 0, -0.3])))


def test_odometry_between_stamps() -> None:
    """Positions linear, rotations by equal angles: both are exact for this straight screw."""
    axis = np.array([0.6, 0.0, 0.8])

    def at(seconds: float) -> np.ndarray:
        return homogeneous(rotations.exp(axis * 0.9 * seconds), axis * 2.0 * seconds)
    p = priors(baseline__source='odometry')
    for tenth in (0, 2, 5, 7):
        p.add_odometry(sample(tenth * SECOND // 10, at(tenth / 10)))
    expect(p.between(SECOND // 10, 6 * SECOND // 10, 1), camera_in_camera(at(0.1), at(0.6)))


def test_odometry_takes_the_shortest_arc() -> None:
    track: Track[OdometrySample] = Track('odometry', SECOND)
    track.add(sample(0, homogeneous(rotations.exp([0, 0, 3.0]), np.zeros(3))))
    track.add(sample(100, homogeneous(rotations.exp([0, 0, -3.0]), np.ones(3))))
    middle = interpolate_odometry(track, 50)
    assert middle is not None
    np.testing.assert_allclose(middle.rotation, rotations.exp([0, 0, math.pi]), atol=1e-12)
    np.testing.assert_allclose(middle.position, [0.5, 0.5, 0.5])


def test_odometry_covariance_is_what_it_grew_by_in_camera_axes() -> None:
    first = np.diag([1.0, 1.0, 1.0, 0.1, 0.1, 0.1])
    second = first + np.diag([4e-4, 1e-4, 9e-4, 1e-6, 4e-6, 9e-6])
    end = START @ se3(VELOCITY, RATE, 0.4)
    p = priors(baseline__source='odometry')
    p.add_odometry(sample(0, START, first))
    p.add_odometry(sample(SECOND, end, second))
    pose = expect(p.between(0, SECOND, 1), camera_in_camera(START, end))
    axes = (end[:3, :3] @ MOUNT_ROTATION).T
    assert pose.covariance is not None
    np.testing.assert_allclose(pose.covariance[:3, :3], axes @ np.diag([1e-6, 4e-6, 9e-6])
                               @ axes.T, atol=1e-15)
    np.testing.assert_allclose(pose.covariance[3:, 3:], axes @ np.diag([4e-4, 1e-4, 9e-4])
                               @ axes.T, atol=1e-15)
    np.testing.assert_array_equal(pose.covariance[:3, 3:], 0)


def test_constant_odometry_covariance_says_nothing_of_a_difference() -> None:
    p = priors(baseline__source='odometry')
    for second in range(2):
        p.add_odometry(sample(second * SECOND, START @ se3(VELOCITY, RATE, second), np.eye(6)))
    pose = p.between(0, SECOND, 1)
    assert isinstance(pose, RelativePose)
    assert pose.covariance is None


@pytest.mark.parametrize('stamps', [(0,), (SECOND,), (0, SECOND * 3 // 4),
                                    (SECOND // 4, SECOND)])
def test_odometry_that_does_not_enclose_the_frames(stamps: tuple[int, ...]) -> None:
    p = priors(baseline__source='odometry')
    for stamp in stamps:
        p.add_odometry(sample(stamp, START))
    pose = p.between(SECOND // 8, SECOND * 7 // 8, 1)
    assert isinstance(pose, Drop)
    assert pose.cause == 'odometry_missing'


def test_nothing_is_interpolated_over_a_gap() -> None:
    p = priors(baseline__source='odometry')
    p.add_odometry(sample(0, START))
    p.add_odometry(sample(2 * SECOND, START @ se3(VELOCITY, RATE, 2.0)))
    pose = p.between(SECOND // 2, SECOND, 1)
    assert isinstance(pose, Drop)
    assert pose.cause == 'odometry_missing'
    assert isinstance(p.between(0, 2 * SECOND, 1), RelativePose)


@pytest.mark.parametrize('source', ['odometry', 'twist'])
def test_hover_is_too_short(source: str) -> None:
    p = priors(baseline__source=source)
    for stamp in (0, SECOND):
        p.add_odometry(sample(stamp, START))
        p.add_twist(TwistSample(stamp, np.full(3, 0.01), np.zeros(3)))
    pose = p.between(0, SECOND, 1)
    assert isinstance(pose, Drop)
    assert pose.cause == 'baseline_too_short'


def test_twist_of_a_turning_vehicle() -> None:
    """Constant body velocity: a screw, exact from any samples, lever arm included."""
    p = priors(baseline__source='twist')
    assert p.waits_for(0) == 'twist'
    for stamp in (0, 130_000_000, 300_000_000, 500_000_000):
        p.add_twist(TwistSample(stamp, VELOCITY, RATE))
    assert p.waits_for(500_000_001) == 'twist'
    expect(p.between(100_000_000, 500_000_000, 1),
           camera_in_camera(np.eye(4), se3(VELOCITY, RATE, 0.4)))


def test_twist_that_accelerates() -> None:
    p = MotionPriors(resolve({'baseline.source': 'twist'}))
    for tenth in range(6):
        p.add_twist(TwistSample(tenth * SECOND // 10, np.array([tenth * 1.0, 0, 0]), np.zeros(3)))
    # v = 10 t: the way from 0.05 s to 0.45 s is 5 (0.45² − 0.05²).
    expect(p.between(SECOND // 20, 9 * SECOND // 20, 1),
           homogeneous(np.eye(3), np.array([0, 0, -1.0])))


def test_twist_missing() -> None:
    p = priors(baseline__source='twist')
    p.add_twist(TwistSample(0, VELOCITY, RATE))
    pose = p.between(0, SECOND, 1)
    assert isinstance(pose, Drop)
    assert pose.cause == 'twist_missing'


@pytest.mark.parametrize('source', ['fixed', 'speed'])
def test_odometry_turns_the_prior_of_other_sources(source: str) -> None:
    p = priors(baseline__source=source, baseline__length=0.5, baseline__speed=0.5)
    end = START @ se3(VELOCITY, RATE, 1.0)
    p.add_odometry(sample(0, START))
    p.add_odometry(sample(SECOND, end))
    truth = camera_in_camera(START, end)
    truth[:3, 3] = [0, 0, -0.5]
    expect(p.between(0, SECOND, 1), truth)


def test_odometry_turns_the_prior_of_twist() -> None:
    p = priors(baseline__source='twist')
    end = START @ se3(VELOCITY, RATE, 1.0)
    for stamp, pose in ((0, START), (SECOND, end)):
        p.add_odometry(sample(stamp, pose))
        p.add_twist(TwistSample(stamp, VELOCITY, np.zeros(3)))
    truth = camera_in_camera(np.eye(4), homogeneous(np.eye(3), VELOCITY))
    truth[:3, :3] = camera_in_camera(START, end)[:3, :3]
    expect(p.between(0, SECOND, 1), truth)


def imu_truth(turn: np.ndarray) -> np.ndarray:
    return homogeneous(MOUNT_ROTATION.T @ turn.T @ MOUNT_ROTATION, np.array([0, 0, -UNSCALED]))


def test_gyro_is_integrated_and_held_for_a_moment() -> None:
    p = priors()
    p.add_imu(ImuSample(0, RATE))
    p.add_imu(ImuSample(SECOND, RATE))
    expect(p.between(SECOND // 2, SECOND, 1), imu_truth(rotations.exp(RATE * 0.5)))
    expect(p.between(SECOND // 2, SECOND + GYRO_HOLD, 1), imu_truth(rotations.exp(RATE * 0.55)))
    expect(p.between(SECOND // 2, SECOND + GYRO_HOLD + 1, 1), imu_truth(np.eye(3)))


def test_orientation_wins_over_gyro() -> None:
    p = priors()
    start = rotations.exp([1.0, 2.0, 0.3])
    for second in range(2):
        p.add_imu(ImuSample(second * SECOND, np.full(3, math.nan),
                            start @ rotations.exp(RATE * second)))
    expect(p.between(SECOND // 4, 3 * SECOND // 4, 1), imu_truth(rotations.exp(RATE * 0.5)))


def test_unknown_gyro_gives_no_prior() -> None:
    p = priors()
    for second in range(2):
        p.add_imu(ImuSample(second * SECOND, np.full(3, math.nan), np.eye(3) if second else None))
    expect(p.between(0, SECOND, 1), imu_truth(np.eye(3)))


def test_invalid_samples_are_named() -> None:
    p = priors()
    nothing = np.full(3, math.nan)
    for drop, cause in (
            (p.add_odometry(OdometrySample(0, nothing, np.eye(3))), 'odometry_invalid'),
            (p.add_twist(TwistSample(0, np.zeros(3), nothing)), 'twist_invalid'),
            (p.add_imu(ImuSample(0, nothing)), 'imu_invalid')):
        assert drop is not None
        assert drop.cause == cause


def test_track_repeats_and_jumps() -> None:
    track: Track[ImuSample] = Track('imu', SECOND)
    for stamp in (5, 1, 3):
        assert track.add(ImuSample(stamp, np.zeros(3))) is None
    repeated = track.add(ImuSample(3, np.zeros(3)))
    assert repeated is not None
    assert repeated.cause == 'imu_duplicate'
    assert [s.stamp for s in track.between(0, 9)] == [1, 3, 5]
    assert [s.stamp for s in track.between(1, 5)] == [3]
    back = track.add(ImuSample(4 - SECOND, np.zeros(3)))
    assert back is not None
    assert back.cause == 'imu_backward'
    assert track.newest == 4 - SECOND
    assert len(track) == 1


def test_track_is_bounded() -> None:
    track: Track[ImuSample] = Track('imu', SECOND)
    for stamp in range(TRACK_SIZE + 10):
        track.add(ImuSample(stamp, np.zeros(3)))
    assert len(track) == TRACK_SIZE
    assert track.around(5) is None
    assert track.newest == TRACK_SIZE + 9


def test_time_jump_forgets_only_what_lies_far_ahead() -> None:
    p = priors(baseline__source='odometry')
    p.add_odometry(sample(10 * SECOND, START))
    p.time_jumped(9 * SECOND)
    assert p.waits_for(9 * SECOND) == ''
    p.time_jumped(8 * SECOND)
    assert p.waits_for(9 * SECOND) == 'odometry'


@given(st.permutations(range(8)))
def test_order_of_arrival_does_not_matter(order: list[int]) -> None:
    p = priors(baseline__source='odometry')
    for i in order:
        p.add_odometry(sample(i * SECOND // 10, START @ se3(VELOCITY, RATE, i / 10)))
    truth = camera_in_camera(START, START @ se3(VELOCITY, RATE, 0.7))
    expect(p.between(0, 7 * SECOND // 10, 1), truth)


@given(st.lists(st.floats(-2, 2), min_size=12, max_size=12), st.integers(1, 999))
def test_twist_and_odometry_agree(values: list[float], cut: int) -> None:
    """The screw of a twist, told as odometry, gives the same prior; so do two halves of it."""
    linear, angular = np.array(values[:3]), np.array(values[3:6])
    start = homogeneous(rotations.exp(values[6:9]), np.array(values[9:]))
    end = start @ se3(linear, angular, 0.999)
    p = priors(baseline__source='twist', baseline__minimum=0.0)
    q = priors(baseline__source='odometry', baseline__minimum=0.0)
    for millisecond in (0, cut, 1000):
        p.add_twist(TwistSample(millisecond * 1_000_000, linear, angular))
    q.add_odometry(sample(0, start))
    q.add_odometry(sample(999_000_000, end))
    a, b = p.between(0, 999_000_000, 1), q.between(0, 999_000_000, 1)
    assert isinstance(a, RelativePose)
    assert isinstance(b, RelativePose)
    np.testing.assert_allclose(a.rotation, b.rotation, atol=1e-9)
    np.testing.assert_allclose(a.position, b.position, atol=1e-9)
