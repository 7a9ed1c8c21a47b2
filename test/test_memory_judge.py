"""What is measured and what is remembered, of which the likelier is told."""
from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sphstereo_ros.core import memory_judge, range_memory
from sphstereo_ros.core.config import resolve
from sphstereo_ros.core.floor import floor_seen
from sphstereo_ros.core.frames import (
    UNSCALED,
    AlignedWindow,
    Frame,
    FrameKey,
    RangeImage,
    Reference,
    RelativePose,
)
from sphstereo_ros.core.inverse_range import NOTHING
from sphstereo_ros.core.joint import Measurement
from sphstereo_ros.core.memory_judge import (
    BLOCK,
    CHANNELS,
    ROUND,
    THERE,
    Opinions,
    inputs,
    interior,
    judged,
    pixel_of,
)
from sphstereo_ros.core.range_memory import RangeMemory, Remembered
from sphstereo_ros.core.reliability import LEAST, NEAR_BY
from sphstereo_ros.core.stereo import SphericalStereo

HEIGHT = 32
AHEAD = np.array([0.0, 0.0, 1.0])
BASELINES = (0.3, 3.0)
MEASURED, REMEMBERED, BOTH, PASSED_OVER, FLOOR, WALL, FARTHER, NEARER = (
    0.1, 0.08, 0.09, 0.085, 0.12, 0.078, 0.0775, 0.15)  # 1/m
CARRIES, CLOSE, GREY = 0.4, (0.7, 0.3), (224, 128)
WIDER = (0.012, 0.03, 0.02, PASSED_OVER, 0.014, 0.035, 0.025)  # 1/m
PIXEL = pixel_of(HEIGHT, BASELINES[1])


def whole(value: object, kind: type = np.float32, height: int = HEIGHT) -> np.ndarray:
    return np.ascontiguousarray(np.broadcast_to(value, (height, 2 * height)), kind)


def opinions(height: int = HEIGHT, *, remembered: bool = True, pose: float = 0.0) -> Opinions:
    known = 0.005 if remembered else NOTHING
    old, both = (REMEMBERED, BOTH) if remembered else (0, MEASURED)
    return Opinions(tuple(whole(v, height=height) for v in (MEASURED, 0.01, 0.12, 0.02)),
                    whole(2, np.int8, height),
                    tuple(whole(v, height=height) for v in (old, known, 3, 0.4)),
                    tuple(whole(v, height=height) for v in (both, 0.004, 5)),
                    whole(FLOOR, height=height),
                    (whole(WALL, height=height), whole(CARRIES, height=height)),
                    np.stack([whole(v, height=height) for v in (
                        FARTHER, CLOSE[0], GREY[0], NEARER, CLOSE[1], GREY[1])]),
                    whole(pose, height=height),
                    np.stack([whole(v, height=height) for v in WIDER]))


def view(height: int = HEIGHT) -> np.ndarray:
    return whole(192, np.uint8, height)


class Tells:
    """In place of the network: the same everywhere, share of the inverse range that the error is,
    choices, and probabilities of being off, of sky, and of hiding something near.
    """

    def __init__(self, likely: float, choices: tuple[float, ...], off: float = 0.01,
                 sky: float = 0.01, danger: float = 0.01) -> None:
        choices = (*choices, *[-9.0] * (8 - len(choices)))
        probable = np.array([off, sky, danger])
        self.outputs = [*np.log(np.array([likely, likely]) + LEAST), *choices,
                        *np.log(probable / (1 - probable))]

    def __call__(self, x: np.ndarray) -> np.ndarray:
        out = np.repeat(np.asarray(self.outputs, np.float32), 4)
        return np.ascontiguousarray(np.broadcast_to(
            out[None, :, None, None], (1, len(out), *x.shape[2:])))


def told(monkeypatch: pytest.MonkeyPatch, net: object, given: Opinions) -> tuple[np.ndarray, ...]:
    monkeypatch.setattr(memory_judge, '_network', lambda: net)
    return judged(view(len(given.pose)), given, AHEAD, BASELINES)


@pytest.mark.parametrize(('choices', 'rho'), [
    ((1, 0, 0), MEASURED), ((0, 1, 0), REMEMBERED), ((0, 0, 1), BOTH),
    ((0, 0, 1, 2), PASSED_OVER), ((0, 0, 0, 1, 2), FLOOR), ((0, 0, 0, 0, 1, 2), WALL),
    ((0, 0, 0, 0, 0, 1, 2), FARTHER), ((0, 0, 0, 0, 0, 0, 1, 2), NEARER)])
def test_the_likeliest_is_told_with_its_error(monkeypatch, choices, rho):
    found, sigma = told(monkeypatch, Tells(0.1, choices), opinions(pose=0.003))
    np.testing.assert_allclose(found, rho, rtol=1e-6)
    np.testing.assert_allclose(sigma, np.hypot(0.1 * rho, 0.003), rtol=1e-3)


@pytest.mark.parametrize(('baselines', 'deviations'), [(10, 2.586), (119, 2.586), (121, 3.669)])
def test_where_errors_are_seldom_large_sigma_is_a_share_of_the_large_ones(monkeypatch, baselines,
                                                                          deviations):
    """Of ten times the 68th percentile: so many standard deviations the 95th is away."""
    net, given = Tells(0.01, (1, 0, 0)), opinions(pose=0.0)
    net.outputs[1] = np.log(0.1 + LEAST)
    given.measured[0][:] = 1 / (baselines * BASELINES[0])
    found, sigma = told(monkeypatch, net, given)
    unit = np.maximum(found, pixel_of(len(found), BASELINES[1]))
    np.testing.assert_allclose(sigma, 0.1 / deviations * unit, rtol=1e-3)


def test_what_was_not_remembered_is_not_chosen(monkeypatch):
    found, sigma = told(monkeypatch, Tells(0.1, (0, 9, 1)), opinions(remembered=False))
    np.testing.assert_allclose(found, MEASURED, rtol=1e-6)
    assert (sigma < NOTHING).all()


@pytest.mark.parametrize(('choices', 'surface'), [((0, 0, 0, 1, 2), FLOOR),
                                                  ((0, 0, 0, 1, 0, 2), WALL)])
def test_a_floor_or_wall_is_chosen_only_where_there_is_one(monkeypatch, choices, surface):
    given = opinions()
    (given.floor if surface == FLOOR else given.wall[0])[:HEIGHT // 2] = 0
    found, _ = told(monkeypatch, Tells(0.1, choices), given)
    np.testing.assert_allclose(found[:HEIGHT // 2], PASSED_OVER, rtol=1e-6)
    np.testing.assert_allclose(found[HEIGHT // 2:], surface, rtol=1e-6)


@pytest.mark.parametrize('side', [0, 1])
def test_what_is_beside_is_chosen_only_where_there_is_something(monkeypatch, side):
    given = opinions()
    given.beside[3 * side + 1, :HEIGHT // 2] = 0
    given.beside[3 * side] = 0  # the sky
    found, _ = told(monkeypatch, Tells(0.1, (0, 0, 0, 1, 0, 0, *[0] * side, 2)), given)
    np.testing.assert_allclose(found[:HEIGHT // 2], PASSED_OVER, rtol=1e-6)
    assert not found[HEIGHT // 2:].any()


def test_the_error_is_a_share_of_a_pixel_at_least(monkeypatch):
    given = opinions(remembered=False)
    given.measured[0][:] = given.fused[0][:] = 0
    found, sigma = told(monkeypatch, Tells(0.1, (1, 0, 0)), given)
    assert not found.any()
    np.testing.assert_allclose(sigma, 0.1 * PIXEL, rtol=1e-3)


def test_what_is_likely_wrong_is_unknown(monkeypatch):
    _, sigma = told(monkeypatch, Tells(0.1, (1, 0, 0), off=0.9), opinions())
    assert (sigma == NOTHING).all()


@pytest.mark.parametrize(('baselines', 'sky', 'known'), [
    (39, 0.04, True), (39, 0.06, False), (41, 0.9, True)])
def test_what_may_be_only_sky_is_not_told_near_by(monkeypatch, baselines, sky, known):
    given = opinions()
    given.measured[0][:] = 1 / (baselines * BASELINES[0])
    _, sigma = told(monkeypatch, Tells(0.1, (1, 0, 0), sky=sky), given)
    assert ((sigma < NOTHING) == known).all()


@pytest.mark.parametrize('distance', [3.0, 30.0, np.inf])
@pytest.mark.parametrize('choices', [(1,), (0, 0, 1)])
@pytest.mark.parametrize(('danger', 'known'), [(0.38, True), (0.42, False)])
def test_what_may_hide_something_near_is_unknown(monkeypatch, distance, choices, danger, known):
    given = opinions()
    given.measured[0][:] = given.fused[0][:] = 1 / distance
    _, sigma = told(monkeypatch, Tells(0.1, choices, danger=danger), given)
    assert ((sigma < NOTHING) == known).all()


@pytest.mark.parametrize('farthest', [20, 50, 120, 500])
@pytest.mark.parametrize(('times', 'off', 'known'), [
    (9.0, 0.11, False), (9.0, 0.09, True), (1.5, 0.11, False), (1.3, 0.46, True)])
def test_what_would_be_told_to_be_free_has_to_be_sure(monkeypatch, farthest, times, off, known):
    """Three standard deviations of a tenth beyond `farthest` begin at 1.43 times."""
    given = opinions()
    given.measured[0][:] = 1 / (times * farthest)
    monkeypatch.setattr(memory_judge, '_network', lambda: Tells(0.1, (1, 0, 0), off=off))
    _, sigma = judged(view(), given, AHEAD, (0.3, 1000.0), 1 / farthest)
    assert ((sigma < NOTHING) == known).all()


def test_where_nothing_is_told_to_be_free_it_need_not_be_surer(monkeypatch):
    given = opinions()
    given.measured[0][:] = 1e-3
    _, sigma = told(monkeypatch, Tells(0.1, (1, 0, 0), off=0.65), given)
    assert (sigma < NOTHING).all()


@pytest.mark.parametrize(('ratio', 'frames', 'distance', 'disputed'), [
    (1.4, 1, 9.0, True), (1.2, 1, 9.0, False), (1.4, 0, 9.0, False), (1.4, 1, 13.0, False),
    (0.8, -1, 9.0, True), (0.8, -1, 50.0, True)])
@pytest.mark.parametrize('danger', [0.07, 0.09, 0.38])
def test_what_the_newest_frame_disputes_has_to_be_surer(monkeypatch, ratio, frames, distance,
                                                        disputed, danger):
    """Whether it may miss something near, or sees it before what is told."""
    given = opinions()
    given.measured[0][:] = 1 / distance
    given.before[0][:] = given.measured[0] / ratio
    given.frames[:] = frames
    _, sigma = told(monkeypatch, Tells(0.1, (0, 1, 0), danger=danger), given)
    assert ((sigma < NOTHING) == (not disputed or danger < 0.08)).all()


@pytest.mark.parametrize('distance', [8.0, 50.0])
@pytest.mark.parametrize(('danger', 'known'), [(0.07, True), (0.09, False)])
def test_the_floor_has_to_be_surer(monkeypatch, distance, danger, known):
    """What is thin before it, or moves, is easily taken for it."""
    given = opinions()
    given.measured[0][:] = given.wider[3] = 0.99 / distance
    given.floor[:] = 1 / distance
    _, sigma = told(monkeypatch, Tells(0.1, (0, 0, 0, 0, 1), danger=danger), given)
    assert ((sigma < NOTHING) == known).all()
    _, sigma = told(monkeypatch, Tells(0.1, (1, 0, 0), danger=danger), given)
    assert (sigma < NOTHING).all()


@pytest.mark.parametrize(('baselines', 'most'), [
    (10, 0.85), (119, 0.85), (121, 0.7), (300, 0.7)])
@pytest.mark.parametrize('over', [True, False])
def test_what_is_probably_off_is_unknown(monkeypatch, baselines, most, over):
    given = opinions()
    given.measured[0][:] = 1 / (baselines * BASELINES[0])
    off = most + (0.01 if over else -0.01)
    _, sigma = told(monkeypatch, Tells(0.1, (1, 0, 0), off=off), given)
    assert ((sigma == NOTHING) == over).all()


@pytest.mark.parametrize(('distance', 'known'), [(9.9, False), (10.1, True)])
def test_ten_metres_are_near_however_slowly_the_camera_moves(monkeypatch, distance, known):
    given = opinions()
    given.measured[0][:] = 1 / distance
    monkeypatch.setattr(memory_judge, '_network', lambda: Tells(0.1, (1, 0, 0), sky=0.06))
    _, sigma = judged(view(), given, AHEAD, (0.03, 30.0))
    assert ((sigma < NOTHING) == known).all()


@pytest.mark.parametrize(('shortest', 'wanted'), [(0.03, 10.0), (1.0, NEAR_BY)])
def test_the_network_sees_how_far_is_near_by(shortest, wanted):
    """As the logarithm of its parallax, px of the longest baseline."""
    x = interior(inputs(view(), opinions(), AHEAD, (shortest, 2.0)), HEIGHT)[0]
    parallax = HEIGHT * 2.0 / (np.pi * wanted)
    np.testing.assert_allclose(x[-1], np.log(parallax), atol=1e-3)


def test_what_the_network_sees():
    given = opinions()
    given.measured[0][6, 9] = 0.2
    x = inputs(view(), given, AHEAD, BASELINES)
    assert x.shape[1] == CHANNELS
    assert x.shape[2] % BLOCK == x.shape[3] % BLOCK == 0
    inside = interior(x, HEIGHT)[0]
    assert inside.shape[1:] == (HEIGHT // 2, HEIGHT)
    n, at = 1, (3, 4)  # the upper right of its four
    wanted = [np.log(1 + 0.2 / PIXEL), np.log(0.001 + 0.01 / 0.2), 2, (0.12 - 0.2) / 0.2,
              np.log(0.001 + 0.02 / 0.2), 1, 1, np.log((0.08 + PIXEL) / (0.2 + PIXEL)),
              np.log(0.001 + 0.005 / 0.08), 0.5, 0.4, np.log((0.09 + PIXEL) / (0.2 + PIXEL)),
              np.log(0.001 + 0.004 / 0.09), 5 / 6,
              *np.log(0.001 + np.array(WIDER[:3]) / 0.2),
              np.log((PASSED_OVER + PIXEL) / (0.2 + PIXEL)),
              *np.log(0.001 + np.array(WIDER[4:]) / PASSED_OVER),
              1, np.log((FLOOR + PIXEL) / (0.2 + PIXEL)),
              CARRIES, np.log((WALL + PIXEL) / (0.2 + PIXEL)),
              CLOSE[0], np.log((FARTHER + PIXEL) / (0.2 + PIXEL)), (224 - 192) / 64,
              CLOSE[1], np.log((NEARER + PIXEL) / (0.2 + PIXEL)), (128 - 192) / 64]
    np.testing.assert_allclose(inside[(slice(n, -3, 4), *at)], wanted, atol=1e-3)
    elsewhere = inside[0, 3, 4]
    assert elsewhere == pytest.approx(np.log(1 + 0.1 / PIXEL), abs=1e-3)
    assert inside[-2].mean() == pytest.approx(np.log(0.1), abs=1e-3)
    longitude = (np.arange(HEIGHT) + 0.75) / HEIGHT * 2 * np.pi - np.pi
    along = np.cos(longitude) * np.cos(1.5 / HEIGHT * np.pi)
    np.testing.assert_allclose(inside[-3, HEIGHT // 4], np.sqrt(1 - along**2), atol=1e-3)


def test_nothing_remembered_looks_like_nothing():
    x = interior(inputs(view(), opinions(remembered=False), AHEAD, BASELINES), HEIGHT)[0]
    np.testing.assert_allclose(x[24:32], 0, atol=1e-3)
    np.testing.assert_allclose(x[32:36], np.log(10.001), atol=1e-3)
    assert not x[36:40].any()
    np.testing.assert_allclose(x[44:48], 0, atol=1e-3)


def test_no_floor_no_wall_and_nothing_beside_look_like_none():
    given = opinions()
    given.floor[:], given.wall[0][:], given.wall[1][:], given.beside[:] = 0, 0, 0, 0
    x = interior(inputs(view(), given, AHEAD, BASELINES), HEIGHT)[0]
    np.testing.assert_allclose(x[THERE:-3], 0, atol=1e-3)


def test_it_goes_on_round_the_sphere():
    given = opinions()
    given.measured[0][:, :2] = 0.3
    x = inputs(view(), given, AHEAD, BASELINES)
    np.testing.assert_array_equal(x[0, :-3, :, ROUND], x[0, :-3, :, ROUND + HEIGHT])
    turned = opinions()
    turned.measured[0][:, 20:22] = 0.3
    turned = inputs(view(), turned, AHEAD, BASELINES)
    np.testing.assert_array_equal(interior(turned, HEIGHT)[0, :-3, :, 10],
                                  interior(x, HEIGHT)[0, :-3, :, 0])


@settings(deadline=None, max_examples=25)
@given(height=st.integers(16, 70), seed=st.integers(0, 2**32 - 1))
def test_whatever_it_sees_what_it_tells_is_one_of_them(height, seed):
    rng = np.random.default_rng(seed)
    shape = (height, 2 * height)

    def some(low: float, high: float) -> np.ndarray:
        return rng.uniform(low, high, shape).astype(np.float32)
    unknown = rng.random((2, *shape)) < 0.3
    given = Opinions((some(-0.01, 1), some(1e-6, 2), some(-0.1, 2), some(1e-6, 1e6)),
                     rng.integers(-1, 3, shape).astype(np.int8),
                     (some(0, 1), np.where(unknown[0], NOTHING, some(1e-6, 2)).astype(np.float32),
                      some(-2, 6), some(0, 1)),
                     (some(0, 1), np.where(unknown[1], NOTHING, some(1e-6, 2)).astype(np.float32),
                      some(-2, 6)), np.maximum(some(-1, 1), 0),
                     (np.maximum(some(-1, 1), 0), some(0, 1)),
                     np.maximum([some(-1, 1) for _ in range(6)], 0), some(0, 0.1),
                     np.stack([some(0, 2) if n != 3 else some(-0.1, 1) for n in range(7)]))
    grey = rng.integers(0, 256, shape).astype(np.uint8)
    x = inputs(grey, given, AHEAD, BASELINES)
    assert np.isfinite(x).all()
    rho, sigma = judged(grey, given, AHEAD, BASELINES)
    assert rho.shape == sigma.shape == shape
    old, both = ((rho == m[0]) & (m[1] < NOTHING) for m in (given.before, given.fused))
    surface = np.logical_or(*((rho == m) & (m > 0) for m in (given.floor, given.wall[0])))
    near = np.logical_or(*((rho == given.beside[n]) & (given.beside[n + 1] > 0) for n in (0, 3)))
    assert ((rho == given.measured[0]) | old | both | (rho == given.wider[3]) | surface
            | near).all()
    assert ((sigma == NOTHING) | (sigma >= given.pose)).all()
    assert (sigma > 0).all()


class Drives:
    """A camera that hardly moves, and what it measures."""

    BASELINE = 0.01  # m

    def __init__(self, farthest: float = np.inf, *, metric: bool = True) -> None:
        self.memory, self.stamp = RangeMemory(0.45, farthest), 0
        self.position = np.array([0.0, 0.0, -self.BASELINE if metric else -UNSCALED])

    def sees(self, grey: np.ndarray | None, rho: float = MEASURED) -> Remembered:
        """Tell the memory; grey : the view, or None where evidence alone decides."""
        measured = Measurement(*(whole(v) for v in (rho, 0.01, rho)), whole(1, np.int8),
                               whole(0.01), whole(0.003),
                               wider=np.stack([whole(v) for v in WIDER]))
        self.stamp += 33_333_333
        before = FrameKey(self.stamp - 33_333_333, 'camera')
        pose = RelativePose(np.eye(3), self.position)
        return self.memory.fused(FrameKey(self.stamp, 'camera'),
                                 (Reference(Frame(before, view()), pose),), measured, None, grey)


def test_from_the_second_window_on_the_network_decides_what_is_told(monkeypatch):
    monkeypatch.setattr(memory_judge, '_network', lambda: Tells(0.2, (1, 0, 0)))
    camera = Drives()
    np.testing.assert_allclose(camera.sees(view()).sigma, 0.01, rtol=1e-6)
    found = camera.sees(view(), 0.105)
    np.testing.assert_allclose(found.rho, 0.105, rtol=1e-6)
    np.testing.assert_allclose(found.sigma, 0.2 * pixel_of(HEIGHT, Drives.BASELINE), rtol=1e-3)


@pytest.mark.parametrize(('farthest', 'metric', 'known'), [
    (5.0, True, False), (15.0, True, True), (np.inf, True, True), (5.0, False, True)])
def test_what_is_free_hangs_on_the_farthest_range_in_metres(monkeypatch, farthest, metric, known):
    """Ten metres away: of a camera without scale, ten steps, and nothing is told to be free."""
    monkeypatch.setattr(memory_judge, '_network', lambda: Tells(1e-3, (1, 0, 0), off=0.3))
    camera = Drives(farthest, metric=metric)
    camera.sees(view())
    found = camera.sees(view(), 0.1)
    assert ((found.sigma < NOTHING) == known).all()


@pytest.mark.parametrize('down', [np.array([0.0, 1, 0]), np.array([0.0, -1, 0])])
def test_the_floor_is_that_of_what_is_known(monkeypatch, down):
    """The vehicle's down decides whether it is a floor or a ceiling."""
    monkeypatch.setattr(memory_judge, '_network', lambda: Tells(0.2, (0, 0, 0, 0, 9)))
    height, plane = 96, np.array([0.05, 0.6, 0.02])
    carried = floor_seen(plane, height)
    memory, pose = RangeMemory(0.45, down=down), np.array([0.0, 0.0, -0.01])
    for k in range(1, 3):
        measured = Measurement(carried + np.float32(0.05), *(whole(v, height=height) for v in (
            1e-3, MEASURED)), whole(1, np.int8, height), whole(0.01, height=height),
            whole(0.003, height=height), wider=np.stack([whole(v, height=height) for v in WIDER]))
        below = carried > 0.1
        measured.rho[below] = carried[below]
        keys = [FrameKey(33_333_333 * n, 'camera') for n in (k - 1, k)]
        found = memory.fused(keys[1], (Reference(Frame(keys[0], view(height)), RelativePose(
            np.eye(3), pose)),), measured, None, view(height))
    wanted = carried if down[1] > 0 else np.where(measured.rho < 0, 0, measured.rho)
    np.testing.assert_allclose(found.rho[carried > 0.05], wanted[carried > 0.05], rtol=0.02)


def test_what_is_beside_is_looked_for_from_what_is_known_or_else_was_measured(monkeypatch):
    looked: list[np.ndarray] = []

    def beside(rho: np.ndarray, sigma: np.ndarray, grey: np.ndarray,
               pixel: float) -> np.ndarray:
        looked.append(np.where(sigma < NOTHING, rho, -rho))
        assert pixel == pytest.approx(pixel_of(HEIGHT, Drives.BASELINE))
        np.testing.assert_array_equal(grey, view())
        return np.zeros((6, *rho.shape), np.float32)
    monkeypatch.setattr(range_memory, 'beside', beside)
    monkeypatch.setattr(memory_judge, '_network', lambda: Tells(0.2, (0, 0, 9)))
    memory = RangeMemory(0.45)
    for k, (rho, left) in enumerate(((0.1, 1), (0.1, 1), (0.1, 1), (0.2, 0)), 1):
        frames = whole(0, np.int8)  # what is on the right is never believed
        frames[:, :HEIGHT] = left
        measured = Measurement(whole(rho), whole(0.01), whole(rho), frames, whole(0.01),
                               whole(0.003), wider=np.stack([whole(v) for v in WIDER]))
        keys = [FrameKey(33_333_333 * n, 'camera') for n in (k - 1, k)]
        memory.fused(keys[1], (Reference(Frame(keys[0], view()), RelativePose(
            np.eye(3), np.array([0, 0, -Drives.BASELINE]))),), measured, None, view())
    found = looked[-1]
    np.testing.assert_allclose(found[:, 4:HEIGHT - 4], 0.1, rtol=0.01)
    np.testing.assert_allclose(found[:, HEIGHT + 4:-4], -0.2, rtol=1e-6)


def test_it_only_reads(monkeypatch):
    """What was told has no part in what is remembered."""
    monkeypatch.setattr(memory_judge, '_network', lambda: Tells(0.2, (0, 9, 0)))
    read, other = Drives(), Drives()
    for rho in (0.1, 0.11, 0.1):
        read.sees(view(), rho)
        other.sees(None, rho)
    found, wanted = read.sees(None), other.sees(None)
    for name in ('rho', 'sigma', 'evidence'):
        np.testing.assert_array_equal(getattr(found, name), getattr(wanted, name))


def drive(stereo: SphericalStereo) -> RangeImage:
    """Nothing moves while the camera goes 0.3 m a frame."""
    noise = np.random.default_rng(3).integers(0, 255, (128, 256), np.uint8)
    frames = [Frame(FrameKey(33_333_333 * k, 'camera'), noise) for k in range(3)]
    pose = RelativePose(np.eye(3), np.array([0.0, 0.0, -0.3]), 1e-12 * np.eye(6))
    for before, current in pairwise(frames):
        found = stereo.process(AlignedWindow(current, (Reference(before, pose),)))
    assert isinstance(found, RangeImage)
    return found


@pytest.mark.parametrize('off', [0.05, 0.3])
def test_free_is_what_lies_beyond_the_parameter(monkeypatch, off):
    monkeypatch.setattr(memory_judge, '_network', lambda: Tells(1e-3, (1, 0, 0), off=off))
    free = np.isposinf(drive(SphericalStereo(resolve({'range.max': 5.0}))).range).mean()
    assert free > 0.2 if off < 0.1 else free == 0


def test_down_is_as_the_camera_is_mounted(monkeypatch):
    """A camera that looks 0.3 rad down sees the vehicle's down turned forward."""
    asked = []
    monkeypatch.setattr(range_memory, 'floor_plane', lambda *given: asked.append(given[2]))
    stereo = SphericalStereo(resolve({'camera.mount.pitch': 0.3}))
    drive(stereo)
    assert asked
    for down in asked:
        np.testing.assert_allclose(down, [0, np.cos(0.3), np.sin(0.3)], atol=1e-9)
