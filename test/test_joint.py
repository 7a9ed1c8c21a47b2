"""Joint matching of whole windows, against exact ranges."""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from analytic_world import Ball, View, World, look, true_pose, window

from sphstereo_ros.core import joint, rotations
from sphstereo_ros.core.config import StereoConfig, resolve
from sphstereo_ros.core.frames import (
    UNSCALED,
    AlignedWindow,
    FrameKey,
    PairedWindow,
    RangeImage,
    Reference,
    RelativePose,
)
from sphstereo_ros.core.joint import JointMatcher, Measurement, filled, in_steps
from sphstereo_ros.core.matching import UNKNOWN, matcher, stereo_grid
from sphstereo_ros.core.photometric import in_one_light
from sphstereo_ros.core.stereo import SphericalStereo

ROOM = World()
TWO = ((0.0, 0.0, -0.3), (0.0, 0.0, -1.2))
METHODS = ('joint', 'joint_fast')
Positions = tuple[tuple[float, float, float], ...]


@cache
def seen(world: World = ROOM, positions: Positions = TWO, turn: tuple = (0, 0, 0),
         height: int = 160) -> tuple[View, PairedWindow]:
    current = look(world, rotation=rotations.exp(turn), height=height)
    references = [look(world, at, height=height) for at in positions]
    return current, window(current, *(
        (view, replace(true_pose(view, current), covariance=1e-12 * np.eye(6)))
        for view in references))


def measured(method: str, view: PairedWindow) -> Measurement:
    config = StereoConfig(matcher=method, num_disparities=48)
    return JointMatcher(method, matcher(config)).measure(view.current, view.references)


def test_what_is_judged_is_what_is_measured(monkeypatch):
    """Range, too, where something else is likelier than what was measured; judged in nearest
    baselines.
    """
    _, view = seen()
    before = measured('joint', view)
    decide = joint.by_looks
    wider = np.arange(1, 8, dtype=np.float32)[:, None, None]
    monkeypatch.setattr(joint, 'by_looks', lambda *given: replace(
        decide(*given), rho=np.full_like(given[0].view, 0.25 * 0.3, np.float32),
        wider=np.broadcast_to(0.3 * wider, (7, *given[0].view.shape)).astype(np.float32)))
    found = measured('joint', view)
    assert np.ptp(before.rho) > 0.1
    np.testing.assert_allclose(found.rho, 0.25, rtol=1e-6)
    np.testing.assert_allclose(found.wider, np.broadcast_to(wider, found.wider.shape), rtol=1e-6)
    assert measured('joint_fast', view).wider is None


def altered(view: PairedWindow, reference: Callable[[np.ndarray], np.ndarray],
            current: Callable[[np.ndarray], np.ndarray] = np.copy) -> PairedWindow:
    """The window with other images."""
    return PairedWindow(
        replace(view.current, image=current(view.current.image)),
        tuple(Reference(replace(r.frame, image=reference(r.frame.image)), r.pose)
              for r in view.references))


def errors(found: Measurement, current: View) -> np.ndarray:
    """Relative errors of what is believed."""
    return np.abs(found.rho * current.range - 1)[found.frames > 0]


# --- what is measured


@pytest.mark.parametrize('method', METHODS)
@pytest.mark.parametrize('radius', [1.0, 3.0, 12.0])
def test_a_hollow_sphere_has_one_range_everywhere(method, radius):
    current, view = seen(Ball(cell=0.27 * radius, radius=radius),
                         ((0, 0, -0.1 * radius), (0, 0, -0.4 * radius)), (0.2, 1.0, 0.3))
    found = measured(method, view)
    assert (found.frames > 0).mean() > 0.95
    off = errors(found, current)
    assert np.median(off) < 0.003
    assert (off > 0.05).mean() < 0.01


@pytest.mark.parametrize('method', METHODS)
@pytest.mark.parametrize('height', [96, 97, 98, 99, 160, 161])
def test_no_height_is_misplaced(method, height):
    """Coarser grids cannot halve an odd number of rows: the frame's grid is not theirs."""
    current, view = seen(height=height)
    found = measured(method, view)
    for part in (found.rho, found.sigma, found.other, found.frames):
        assert part.shape == (height, 2 * height)
    assert (found.frames > 0).mean() > (0.75 if height < 100 else 0.88)
    assert np.median(errors(found, current)) < 0.02
    second = np.abs(found.other * current.range - 1)
    assert np.median(second) < (0.09 if height < 100 else 0.06)


@pytest.mark.parametrize('method', METHODS)
@pytest.mark.parametrize('turn', [(0, 0, 0), (0.4, 1.3, -0.8)], ids=str)
@pytest.mark.parametrize('height', [160, 161])
def test_ranges_lie_on_their_pixels(method, turn, height):
    """Not a fraction of a pixel aside: what differs has nothing to do with the slope."""
    current, view = seen(World(posts=()), TWO, turn, height)
    found = measured(method, view)
    true = 1 / current.range
    for axis in (0, 1):
        slope = np.gradient(true, axis=axis)
        use = (found.frames > 0) & (np.abs(np.gradient(slope, axis=axis)) < 2e-4)
        error = np.clip(found.rho - true, -0.02, 0.02)
        shift = (slope * error)[use].sum() / (slope**2)[use].sum()
        assert abs(shift) < 0.2


@pytest.mark.parametrize('height', [1, 2, 3, 97, 480, 960, 961])
def test_the_grid_can_be_halved_and_is_hardly_larger_than_the_frame(height):
    grid = stereo_grid(height)
    assert grid.height % 8 == 0
    assert height <= grid.height < height + 8
    assert all(n % 8 == 0 for n in grid.shape)


@pytest.mark.parametrize('method', METHODS)
@pytest.mark.parametrize('height', [16, 17, 32, 33])
def test_tiny_frames_do_no_harm(method, height):
    found = measured(method, seen(height=height)[1])
    for part in (found.rho, found.sigma, found.other):
        assert part.shape == (height, 2 * height)
        assert np.isfinite(part).all()


@pytest.mark.parametrize('method', METHODS)
@pytest.mark.parametrize(('baseline', 'radius'), [(0.02, 0.5), (0.28, 4.0), (30.0, 120.0)])
def test_short_and_long_baselines(method, baseline, radius):
    current, view = seen(Ball(cell=0.27 * radius, radius=radius), ((baseline, 0, 0),))
    found = measured(method, view)
    assert (found.frames > 0).mean() > 0.94
    assert np.median(errors(found, current)) < 0.01


@pytest.mark.parametrize('method', METHODS)
def test_ten_references_are_better_than_one(method):
    ball = Ball(cell=0.8)
    (current, ten), (_, one) = (seen(ball, tuple((0, 0, -0.12 * n) for n in range(1, last)))
                                for last in (11, 2))
    many, alone = (errors(measured(method, view), current) for view in (ten, one))
    assert len(many) > 0.97 * len(alone)
    assert np.median(many) < 0.4 * np.median(alone)


@pytest.mark.parametrize('method', METHODS)
def test_sigma_says_how_large_errors_are(method):
    current, view = seen()
    found = measured(method, view)
    z = (np.abs(found.rho - 1 / current.range) / found.sigma)[found.frames > 0]
    assert 0.55 < (z < 1).mean() < 0.995
    assert (z < 2).mean() > 0.85
    # And what errs more is said to err more.
    error, sigma = (values[found.frames > 0] for values in (
        np.abs(found.rho - 1 / current.range), found.sigma))
    worse = sigma > np.quantile(sigma, 0.7)
    assert np.median(error[worse]) > 1.5 * np.median(error[~worse])


def test_without_metres_the_same_up_to_scale():
    _, view = seen()
    unscaled = PairedWindow(view.current, tuple(
        Reference(r.frame, replace(r.pose, position=UNSCALED / 0.3 * r.pose.position,
                                   covariance=None)) for r in view.references))
    for method in METHODS:
        metres, steps = (measured(method, v) for v in (view, unscaled))
        assert ((metres.frames > 0) != (steps.frames > 0)).mean() < 0.01
        assert (metres.frames != steps.frames).mean() < 0.02
        both = (metres.frames > 0) & (steps.frames > 0)
        np.testing.assert_allclose(np.quantile((steps.rho / metres.rho)[both], [0.02, 0.98]),
                                   0.3, rtol=0.01)
        assert np.median((steps.sigma / metres.sigma)[both]) == pytest.approx(0.3, rel=0.01)


# --- what is not


def of_another_place(image: np.ndarray) -> np.ndarray:
    return look(World((-9, -7, -5), cell=0.5), (3, 1, 2), height=len(image)).image


NOISE = np.random.default_rng(0).integers(0, 256, (2, 160, 320), np.uint8)
FAINT = np.clip(90 + 2 * np.random.default_rng(1).normal(size=(2, 160, 320)), 0, 255
                ).astype(np.uint8)
NOTHING_TO_SEE = {
    'noise': (lambda _: NOISE[0], np.copy),
    'both noise': (lambda _: NOISE[0], lambda _: NOISE[1]),
    'blank references': (lambda i: np.full_like(i, 90), np.copy),
    'blank': (lambda i: np.full_like(i, 90), lambda i: np.full_like(i, 90)),
    'blank but for the sensor': (lambda _: FAINT[0], lambda _: FAINT[1]),
    'another place': (of_another_place, np.copy),
    'upside down': (lambda i: np.ascontiguousarray(i[::-1]), np.copy),
}


@pytest.mark.parametrize('case', NOTHING_TO_SEE)
def test_views_that_have_nothing_in_common_are_not_agreed_upon(case):
    found = measured('joint', altered(seen()[1], *NOTHING_TO_SEE[case]))
    for part in (found.rho, found.sigma, found.other):
        assert np.isfinite(part).all()
    assert (found.frames > 0).mean() < 0.12


@pytest.mark.parametrize('case', ['blank references', 'blank', 'blank but for the sensor'])
def test_the_fast_method_does_not_believe_what_is_blank(case):
    found = measured('joint_fast', altered(seen()[1], *NOTHING_TO_SEE[case]))
    assert (found.frames > 0).mean() < 0.05


@pytest.mark.parametrize('method', METHODS)
def test_a_blank_reference_among_others_does_no_harm(method):
    current, view = seen(ROOM, (*TWO, (0, 0, -0.6)))
    images = iter([None, None, np.full_like(current.image, 90)])
    found = measured(method, altered(view, lambda i: (
        i if (other := next(images)) is None else other)))
    whole = measured(method, seen()[1])
    assert np.median(errors(found, current)) < 1.3 * np.median(errors(whole, current)) + 1e-4


# --- the same input, the same output


def process(stereo: SphericalStereo, view: PairedWindow, stamp: int) -> RangeImage:
    current = replace(view.current, key=FrameKey(stamp, 'camera_optical'))
    references = tuple(
        Reference(replace(r.frame, key=FrameKey(stamp - 33_000_000 * (n + 1), 'camera_optical')),
                  r.pose) for n, r in enumerate(view.references))
    out = stereo.process(AlignedWindow(current, references))
    assert isinstance(out, RangeImage)
    return out


@pytest.mark.parametrize('method', METHODS)
def test_two_runs_are_the_same_to_the_last_bit(method):
    _, view = seen()
    runs = []
    for _ in range(2):
        stereo = SphericalStereo(resolve({'stereo.matcher': method}))
        stereo.warm_up()  # leaves nothing behind
        runs.append([process(stereo, view, 10**18 + 33_000_000 * n) for n in range(3)])
    for one, other in zip(*runs, strict=True):
        np.testing.assert_array_equal(one.range, other.range)
        np.testing.assert_array_equal(one.sigma, other.sigma)


def test_without_memory_a_window_does_not_depend_on_those_before():
    _, view = seen()
    stereo = SphericalStereo(resolve({'stereo.memory': 0.0}))
    first, second = (process(stereo, view, 10**18 + 33_000_000 * n) for n in range(2))
    np.testing.assert_array_equal(first.range, second.range)
    np.testing.assert_array_equal(first.sigma, second.sigma)


def test_the_images_are_left_as_they_are():
    _, view = seen()
    copies = [f.image.copy() for f in (view.current, *(r.frame for r in view.references))]
    measured('joint', view)
    for copy, frame in zip(copies, (view.current, *(r.frame for r in view.references)),
                           strict=True):
        np.testing.assert_array_equal(copy, frame.image)


@pytest.mark.parametrize('method', METHODS)
@pytest.mark.parametrize('scale', [0.07, 3.0, 40.0])
def test_scale_decides_nothing(method, scale):
    """Poses so many times as far apart: ranges so many times as far, pixel by pixel."""
    _, view = seen()
    larger = PairedWindow(view.current, tuple(
        replace(r, pose=RelativePose(r.pose.rotation, scale * r.pose.position,
                                     r.pose.covariance * np.diag([1, 1, 1, *[scale**2] * 3])))
        for r in view.references))
    one, other = measured(method, view), measured(method, larger)
    np.testing.assert_array_equal(one.frames, other.frames)
    for a, b in ((one.rho, other.rho), (one.sigma, other.sigma), (one.told, other.told),
                 (one.other, other.other)):
        np.testing.assert_allclose(scale * b, a, rtol=1e-4, atol=1e-5)


# --- parts


def test_poses_without_metres_count_in_steps():
    pose = RelativePose(np.eye(3), np.array([0, 0, -3 * UNSCALED]),
                        np.diag([1.0, 1, 1, *[UNSCALED**2] * 3]))
    stepped = in_steps(pose)
    assert stepped.baseline == pytest.approx(3)
    np.testing.assert_allclose(stepped.covariance, np.eye(6))
    metric = RelativePose(np.eye(3), np.array([0, 0, -3.0]))
    assert in_steps(metric) is metric


def test_gaps_are_filled_smoothly_from_round_about():
    rho = np.tile(np.linspace(0.1, 0.2, 160, dtype=np.float32), (120, 1))
    holed = rho.copy()
    holed[40:60, 50:80] = UNKNOWN
    full = filled(holed)
    np.testing.assert_array_equal(full[holed != UNKNOWN], rho[holed != UNKNOWN])
    np.testing.assert_allclose(full[40:60, 50:80], rho[40:60, 50:80], rtol=0.1)
    np.testing.assert_array_equal(filled(np.full((40, 50), UNKNOWN, np.float32)), 0)


@pytest.mark.parametrize(('gain', 'offset'), [(0.5, 20), (1.6, -30), (1.0, 30)])
def test_another_exposure_is_made_alike(gain, offset):
    image = np.clip(110 + 20 * np.random.default_rng(0).normal(size=(200, 300)), 0, 255)
    other = np.clip(gain * image + offset, 0, 255).astype(np.uint8)
    image = image.astype(np.uint8)
    reference, model = in_one_light(other, image)
    assert model is image
    assert np.abs(reference.astype(int) - image).mean() < 3
    assert all(same is image for same in in_one_light(image, image))
