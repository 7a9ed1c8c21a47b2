from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sphstereo_ros.core import rotations
from sphstereo_ros.core.frames import (
    UNSCALED,
    AlignedWindow,
    Drop,
    Frame,
    FrameKey,
    Reference,
    RelativePose,
)
from sphstereo_ros.core.pose_graph import Edges, Poses, Priors, optimised, whitening
from sphstereo_ros.core.track import Track

PERIOD = 33_333_333
IMAGE = np.zeros((2, 4), np.uint8)


def course(count: int, seed: int = 0, vary: float = 0.0) -> list[RelativePose]:
    """Poses map ← camera of a bending way with shake; steps differ by ± `vary`."""
    rng = np.random.default_rng(seed)
    position, poses = np.zeros(3), []
    for k in range(count):
        turn = rotations.exp([0.0, 0.02 * k, 0.0])
        poses.append(RelativePose(turn @ rotations.exp(rng.uniform(-0.05, 0.05, 3)), position))
        step = 0.28 * (1 + vary * np.sin(2 * np.pi * k / 30))
        position = position + turn @ [0.02 * np.sin(k), 0.0, step]
    return poses


def key(k: int) -> FrameKey:
    return FrameKey((k + 1) * PERIOD, 'camera_optical')


def between(reference: RelativePose, current: RelativePose) -> RelativePose:
    back = current.rotation.T
    return RelativePose(back @ reference.rotation,
                        back @ (reference.position - current.position))


def window(poses: list[RelativePose], k: int, back: tuple[int, ...] = (1, 4, 10),
           unit: float = 1.0, noise: np.random.Generator | None = None) -> AlignedWindow:
    """References of frame k; lengths in a unit of so many metres."""
    references = []
    for n in (k - b for b in back if b <= k):
        true = between(poses[n], poses[k])
        if noise is not None:
            true = RelativePose(rotations.exp(noise.normal(0, 1e-4, 3)) @ true.rotation,
                                true.position * (1 + noise.normal(0, 0.003)))
        references.append(Reference(Frame(key(n), IMAGE), RelativePose(
            true.rotation, true.position / unit, 1e-10 * np.eye(6))))
    return AlignedWindow(Frame(key(k), IMAGE), tuple(references))


def errors(track: Track, poses: list[RelativePose]) -> tuple[float, float]:
    """Largest errors of position (m) and rotation (rad)."""
    pairs = [(track[key(k)], pose) for k, pose in enumerate(poses)]
    return (max(float(np.linalg.norm(f.position - p.position)) for f, p in pairs),
            max(rotations.angle(f.rotation.T @ p.rotation) for f, p in pairs))


def test_exact_windows_give_the_exact_track():
    poses = course(40)
    track = Track(poses[0])
    for k in range(1, 40):
        placed = track.add(window(poses, k))
        assert not isinstance(placed, Drop)
        assert placed.scale == 1.0
    place, turn = errors(track, poses)
    assert place < 1e-6
    assert turn < 1e-6


def test_far_references_keep_noise_from_adding_up():
    poses, ends = course(80), []
    for back in ((1,), (1, 4, 10)):
        rng = np.random.default_rng(5)
        track = Track(poses[0])
        for k in range(1, 80):
            track.add(window(poses, k, back, noise=rng))
        track.adjust_all()
        ends.append(errors(track, poses))
    assert ends[1][0] < 0.03 < 80 * 0.28
    assert ends[1][1] < 0.6 * ends[0][1]


def test_windows_of_different_units_get_one_scale():
    """As with an assumed constant step while the true one varies by 30 %."""
    poses = course(90, vary=0.3)
    track = Track(poses[0], free_scales=True)
    units = []
    for k in range(1, 90):
        step = between(poses[k - 1], poses[k]).baseline
        units.append(step / 0.28)
        track.add(window(poses, k, unit=units[-1]))
    assert max(units) / min(units) > 1.7
    track.adjust_all()
    ratios = np.array([track[key(k)].scale for k in range(1, 90)]) / units
    assert ratios.std() < 1e-3 * ratios.mean()
    assert 0.8 < ratios.mean() < 1.2  # as long on the whole as was assumed, about


def test_a_known_scale_fixes_the_metres():
    poses = course(30)
    track = Track(poses[0], free_scales=True, believed=False)
    for k in range(1, 30):
        unscaled = window(poses, k, unit=0.28 / UNSCALED)
        assert not unscaled.is_metric
        track.add(unscaled, scale=(0.28, 0.02))
    assert errors(track, poses)[0] < 1e-3


def test_what_cannot_be_placed_is_said():
    poses = course(60)
    track = Track(poses[0])
    assert track.add(AlignedWindow(Frame(key(0), IMAGE), ())).cause == 'track_lost'
    for k in range(1, 12):
        track.add(window(poses, k))
    assert track.add(window(poses, 5)).cause == 'stamp_backward'
    assert track.add(window(poses, 40)).cause == 'track_lost'
    assert key(40) not in track
    assert len(track) == 12


def test_odometry_leads_over_a_gap():
    poses = course(60)
    track = Track(poses[0])
    for k in [*range(1, 12), *range(40, 60)]:
        assert not isinstance(track.add(window(poses, k), between(poses[11], poses[k])), Drop)
    for k in (11, 40, 59):
        np.testing.assert_allclose(track[key(k)].position, poses[k].position, atol=1e-6)


def test_a_track_that_keeps_few_frames_goes_on_the_same():
    poses = course(130)
    whole, short = Track(poses[0]), Track(poses[0], keep=40)
    for k in range(1, 130):
        rng = np.random.default_rng(k)
        a = whole.add(window(poses, k, noise=rng))
        b = short.add(window(poses, k, noise=np.random.default_rng(k)))
        np.testing.assert_allclose(a.position, b.position, atol=1e-9)
        assert len(short) <= 80
    assert key(0) not in short


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 10_000))
def test_the_graph_finds_the_poses_from_a_disturbed_start(seed):
    rng = np.random.default_rng(seed)
    poses = course(8, seed)
    links = [(i, k) for i in range(1, 8) for k in range(max(0, i - 3), i)]
    measured = [between(poses[k], poses[i]) for i, k in links]
    edges = Edges(*np.array(links).T, np.stack([m.rotation for m in measured]),
                  np.stack([m.position for m in measured]),
                  np.repeat(whitening(1e-6 * np.eye(6))[None], len(links), axis=0))
    start = Poses(
        np.stack([p.rotation @ rotations.exp(0.01 * rng.normal(size=3) * (n > 0))
                  for n, p in enumerate(poses)]),
        np.stack([p.position + 0.01 * rng.normal(size=3) * (n > 0)
                  for n, p in enumerate(poses)]), np.zeros(8))
    nothing = Priors(np.full(8, np.nan), np.full(8, np.nan))
    found = optimised(start, edges, nothing, iterations=25)
    np.testing.assert_allclose(found.positions, [p.position for p in poses], atol=1e-6)
    np.testing.assert_allclose(found.rotations, [p.rotation for p in poses], atol=1e-6)


def test_a_wrong_link_is_let_go():
    poses = course(20)
    track = Track(poses[0])
    for k in range(1, 20):
        given_window = window(poses, k)
        if k == 15:
            far = given_window.references[2]
            wrong = RelativePose(rotations.exp([0, 0.05, 0]) @ far.pose.rotation,
                                 far.pose.position + np.array([0.3, 0, 0]), far.pose.covariance)
            given_window = AlignedWindow(given_window.current, (
                *given_window.references[:2], Reference(far.frame, wrong)))
        track.add(given_window)
    track.adjust_all(20)
    assert errors(track, poses)[0] == pytest.approx(0, abs=0.01)
