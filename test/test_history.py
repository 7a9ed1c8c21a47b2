"""Poses chained from poses: exact composition, the fewest links, nothing where one is missing."""
from __future__ import annotations

import numpy as np
import pytest
from two_views import random_rotation

from sphstereo_ros.core import rotations
from sphstereo_ros.core.frames import FrameKey, RelativePose
from sphstereo_ros.core.history import PoseHistory, compose, inverse, with_baseline


def key(i: int) -> FrameKey:
    return FrameKey(1000 + i, 'camera_optical')


class Track:
    """Cameras at random places: the exact pose of any in any other."""

    def __init__(self, count: int, seed: int = 0) -> None:
        rng = np.random.default_rng(seed)
        self.rotations = [random_rotation(rng, rng.uniform(0, 0.5)) for _ in range(count)]
        self.positions = np.cumsum(rng.normal(size=(count, 3)), axis=0)

    def pose(self, reference: int, current: int) -> RelativePose:
        back = self.rotations[current].T
        return RelativePose(back @ self.rotations[reference],
                            back @ (self.positions[reference] - self.positions[current]),
                            1e-6 * np.eye(6))


def assert_same(found: RelativePose | None, expected: RelativePose) -> None:
    assert found is not None
    np.testing.assert_allclose(found.rotation, expected.rotation, atol=1e-12)
    np.testing.assert_allclose(found.position, expected.position, atol=1e-12)


def filled(track: Track, count: int, intervals: tuple[int, ...] = (1,)) -> PoseHistory:
    history = PoseHistory()
    for i in range(count):
        history.begin(key(i))
        for back in intervals:
            if back <= i:
                history.add(key(i), key(i - back), track.pose(i - back, i))
    return history


def test_composition_and_inverse_are_exact() -> None:
    track = Track(3)
    assert_same(compose(track.pose(1, 2), track.pose(0, 1)), track.pose(0, 2))
    assert_same(inverse(track.pose(0, 2)), track.pose(2, 0))


@pytest.mark.parametrize('operation', ['compose', 'inverse'])
def test_covariances_are_those_of_disturbed_poses(operation: str) -> None:
    """First-order propagation against differences of each of the disturbed parameters."""
    track, rng = Track(3, 4), np.random.default_rng(1)
    root = 1e-3 * rng.normal(size=(2, 6, 6))
    first, second = (RelativePose(p.rotation, p.position, r @ r.T) for p, r in zip(
        (track.pose(0, 1), track.pose(1, 2)), root, strict=True))

    def disturbed(pose: RelativePose, by: np.ndarray) -> RelativePose:
        return RelativePose(rotations.exp(by[:3]) @ pose.rotation, pose.position + by[3:])

    def result(a: np.ndarray, b: np.ndarray) -> RelativePose:
        if operation == 'inverse':
            return inverse(disturbed(first, a))
        return compose(disturbed(second, b), disturbed(first, a))

    exact = result(np.zeros(6), np.zeros(6))
    jacobian = np.zeros((6, 12))
    for i in range(12):
        step = np.zeros(12)
        step[i] = 1e-6
        moved = result(step[:6], step[6:])
        jacobian[:3, i] = rotations.log(moved.rotation @ exact.rotation.T) / 1e-6
        jacobian[3:, i] = (moved.position - exact.position) / 1e-6
    both = np.zeros((12, 12))
    both[:6, :6], both[6:, 6:] = first.covariance, second.covariance
    told = inverse(first) if operation == 'inverse' else compose(second, first)
    np.testing.assert_allclose(told.covariance, jacobian @ both @ jacobian.T, rtol=1e-3,
                               atol=1e-9)


def test_unknown_stays_unknown() -> None:
    known, unknown = RelativePose(covariance=np.eye(6)), RelativePose()
    assert compose(known, unknown).covariance is None
    assert compose(unknown, known).covariance is None
    assert inverse(unknown).covariance is None


def test_another_length_keeps_the_relative_uncertainty() -> None:
    pose = with_baseline(RelativePose(np.eye(3), np.array([0.0, 0.0, -2.0]), np.eye(6)), 6.0)
    assert pose.baseline == pytest.approx(6.0)
    np.testing.assert_allclose(np.diag(pose.covariance), [1, 1, 1, 9, 9, 9])


def test_ten_frames_back_by_consecutive_poses() -> None:
    track = Track(12)
    assert_same(filled(track, 12).between(key(1), key(11)), track.pose(1, 11))


def test_the_fewest_poses_are_chained() -> None:
    track = Track(12)
    found = filled(track, 12, (1, 4)).between(key(2), key(11))
    assert_same(found, track.pose(2, 11))
    assert found.covariance[0, 0] == pytest.approx(3e-6)  # 11 → 7 → 3 → 2


def test_poses_are_followed_both_ways() -> None:
    """Frames between windows were dropped: only through a later window is there a way."""
    track = Track(12)
    history = PoseHistory()
    for current, reference in ((8, 4), (10, 4), (10, 6)):
        history.begin(key(current))
        history.add(key(current), key(reference), track.pose(reference, current))
    assert_same(history.between(key(6), key(8)), track.pose(6, 8))


def test_no_way_is_none() -> None:
    history = filled(Track(12), 12)
    assert history.between(key(5), key(99)) is None
    history = PoseHistory()
    history.begin(key(1))
    assert history.between(key(0), key(1)) is None


def test_time_that_runs_backward_forgets() -> None:
    history = filled(Track(12), 12)
    history.begin(key(3))
    assert history.between(key(0), key(2)) is None


def test_what_is_remembered_is_bounded() -> None:
    pose = RelativePose(covariance=1e-9 * np.eye(6))
    history = PoseHistory()
    for i in range(500):
        history.begin(key(i))
        for back in (1, 4, 10):
            history.add(key(i), key(i - back), pose)
    assert len(history._poses) < 130
    assert all(other in history._poses for links in history._poses.values() for other in links)
    assert history.between(key(480), key(499)) is not None
    assert history.between(key(300), key(310)) is None
