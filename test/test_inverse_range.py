from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from two_views import unit

from sphstereo_ros.core.camera import Equirectangular
from sphstereo_ros.core.config import RangeConfig
from sphstereo_ros.core.frames import UNSCALED, RelativePose
from sphstereo_ros.core.inverse_range import (
    NOTHING,
    InverseRange,
    fuse,
    inverse_range,
    pose_sigmas,
    published_range,
)
from sphstereo_ros.core.matching import UNKNOWN, Parallax
from sphstereo_ros.core.sphere import (
    parallax_from_range,
    polar_axes,
    polar_bearings,
    range_from_parallax,
)
from sphstereo_ros.core.warp import PolarGrid

HEIGHT = 96
GRID = PolarGrid(HEIGHT, 8, 8)
BEARINGS = Equirectangular(HEIGHT, 2 * HEIGHT).bearings()
LIMITS = RangeConfig(minimum=0.5, maximum=100.0, max_relative_sigma=0.3)


def surface(bearings: np.ndarray) -> np.ndarray:
    """Range (m) of a smooth surface around the camera."""
    x, y, z = np.moveaxis(bearings, -1, 0)
    return 4 + x * y + 1.5 * z + y * y


def half_size(value: float) -> np.ndarray:
    rows, columns = GRID.shape
    return np.full((rows // 2, columns // 2), value, np.float32)


def exact_parallax(axes: np.ndarray, baseline: float, sigma: float = 0.1) -> Parallax:
    """Of the surface; beyond a pole θ goes on, and the parallax changes its sign."""
    theta, azimuth = GRID.theta()[None], GRID.azimuth()[:, None]
    r = surface(polar_bearings(theta, azimuth, axes))
    pixels = parallax_from_range(theta, r, baseline) / GRID.pixel
    return Parallax(pixels.astype(np.float32), half_size(sigma), signed=True)


def pose_along(direction: np.ndarray, baseline: float,
               covariance: np.ndarray | None = None) -> RelativePose:
    return RelativePose(np.eye(3), -baseline * unit(direction), covariance)


def theta2(axes: np.ndarray) -> np.ndarray:
    return np.arccos(np.clip(BEARINGS @ axes[:, 2], -1, 1))


@given(st.integers(0, 2**32 - 1), st.floats(0.05, 0.8))
@settings(deadline=None, max_examples=30)
def test_range_comes_back_on_the_cameras_own_grid(seed, baseline):
    direction = unit(np.random.default_rng(seed).normal(size=3))
    axes = polar_axes(direction)
    got = inverse_range(exact_parallax(axes, baseline), GRID, axes,
                        pose_along(direction, baseline), HEIGHT)
    assert got.rho.shape == got.sigma.shape == (HEIGHT, 2 * HEIGHT)
    assert got.signed
    error = np.abs(surface(BEARINGS) * got.rho - 1)
    theta = theta2(axes)
    assert np.median(error) < 2e-4
    assert error[np.sin(theta) > 0.3].max() < 1.5e-3  # one bilinear look-up of a curved surface


@pytest.mark.parametrize('direction', [(0, 0, 1), (1, 0, 0), (0, -1, 0), (-0.5, 0.5, -0.7)])
def test_seam_and_poles_of_the_image_are_like_the_rest(direction):
    axes = polar_axes(direction)
    got = inverse_range(exact_parallax(axes, 0.3), GRID, axes, pose_along(direction, 0.3), HEIGHT)
    error = np.abs(surface(BEARINGS) * got.rho - 1)
    error[np.sin(theta2(axes)) < 0.3] = 0
    for edge in (error[:, :2], error[:, -2:], error[:2], error[-2:]):
        assert edge.max() < 1.5e-3


def test_what_is_unknown_has_no_weight():
    direction = (0, 0, 1)
    axes = polar_axes(direction)
    parallax = exact_parallax(axes, 0.3)
    parallax.pixels[HEIGHT // 2:HEIGHT] = UNKNOWN
    got = inverse_range(parallax, GRID, axes, pose_along(direction, 0.3), HEIGHT)
    area = np.hypot(BEARINGS[..., 0], BEARINGS[..., 2])
    share = np.average(got.sigma >= NOTHING, weights=area)
    assert share == pytest.approx(0.25, abs=0.02)
    np.testing.assert_array_equal(got.rho[got.sigma >= NOTHING], 0)
    # Nothing is mixed with the unknown beside it.
    known = (got.sigma < NOTHING) & (np.sin(theta2(axes)) > 0.2)
    assert np.abs(surface(BEARINGS) * got.rho - 1)[known].max() < 0.05
    r, _ = published_range(got, LIMITS, True)
    assert np.isnan(r[got.sigma >= NOTHING]).all()


def test_impossible_parallax_is_unknown():
    direction = (0, 0, 1)
    axes = polar_axes(direction)
    # 0.5 rad: no point ahead within 0.5 rad of the pole can move so much
    parallax = Parallax(np.full(GRID.shape, 0.5 / GRID.pixel, np.float32), half_size(0.1), True)
    got = inverse_range(parallax, GRID, axes, pose_along(direction, 0.3), HEIGHT)
    theta = theta2(axes)
    assert (got.sigma[theta < 0.45] >= NOTHING).all()
    inside = (theta > 0.6) & (theta < 3)
    np.testing.assert_allclose(got.rho[inside],
                               1 / range_from_parallax(theta[inside], 0.5, 0.3), rtol=1e-3)


def slope(function: object, at: np.ndarray, step: float = 1e-6) -> np.ndarray:
    return np.abs(function(at + step) - function(at - step)) / (2 * step)


@pytest.mark.parametrize('cause', ['match', 'rotation', 'direction', 'baseline', 'all'])
def test_sigma_is_the_slope_of_the_inverse_range(cause):
    """Each cause against numeric differentiation of the law of sines."""
    baseline, direction = 0.4, unit([0.2, 0.1, 1])
    axes, sigmas = polar_axes(direction), dict.fromkeys(
        ('match', 'rotation', 'direction', 'baseline'), 1e-9)
    sigmas.update({c: 0.002 for c in sigmas if cause in (c, 'all')})
    across = np.eye(3) - np.outer(direction, direction)
    covariance = np.zeros((6, 6))
    covariance[:3, :3] = sigmas['rotation']**2 * np.eye(3)
    covariance[3:, 3:] = baseline**2 * (sigmas['direction']**2 * across
                                        + sigmas['baseline']**2 * np.outer(direction, direction))
    got = inverse_range(exact_parallax(axes, baseline, sigmas['match'] / GRID.pixel), GRID, axes,
                        pose_along(direction, baseline, covariance), HEIGHT)
    theta, r = theta2(axes), surface(BEARINGS)
    delta = parallax_from_range(theta, r, baseline)

    def rho(theta: np.ndarray, delta: np.ndarray, baseline: float) -> np.ndarray:
        return 1 / range_from_parallax(theta, delta, baseline)

    by_delta = slope(lambda d: rho(theta, d, baseline), delta)
    variance = (by_delta**2 * (sigmas['match']**2 + sigmas['rotation']**2)
                + (slope(lambda t: rho(t, delta, baseline), theta) * sigmas['direction'])**2
                + (rho(theta, delta, baseline) * sigmas['baseline'])**2)
    inside = np.sin(theta) > 0.25
    if cause == 'direction':
        inside &= np.abs(np.cos(theta - delta)) > 0.05  # the slope is nearly nothing there
    np.testing.assert_allclose(got.sigma[inside], np.sqrt(variance)[inside], rtol=0.03)


def test_baseline_sigma_stands_in_where_the_pose_tells_none():
    direction = (0, 0, 1)
    axes = polar_axes(direction)
    parallax = exact_parallax(axes, 0.4, 1e-6)
    for covariance in (None, np.zeros((6, 6))):
        got = inverse_range(parallax, GRID, axes, pose_along(direction, 0.4, covariance), HEIGHT,
                            0.05)
        inside = np.sin(theta2(axes)) > 0.2
        np.testing.assert_allclose((got.sigma / got.rho)[inside], 0.05, rtol=1e-3)
    known = np.zeros((6, 6))
    known[5, 5] = (0.4 * 0.01)**2
    got = inverse_range(parallax, GRID, axes, pose_along(direction, 0.4, known), HEIGHT, 0.05)
    np.testing.assert_allclose((got.sigma / got.rho)[inside], 0.01, rtol=1e-2)


def test_without_metres_the_unit_is_the_baseline():
    direction = (0, 0, 1)
    axes = polar_axes(direction)
    parallax = exact_parallax(axes, 0.4)
    got = inverse_range(parallax, GRID, axes, pose_along(direction, UNSCALED), HEIGHT)
    metric = inverse_range(parallax, GRID, axes, pose_along(direction, 0.4), HEIGHT)
    np.testing.assert_allclose(got.rho, 0.4 * metric.rho, rtol=1e-5)
    np.testing.assert_allclose(got.sigma, 0.4 * metric.sigma, rtol=1e-5)


def test_sigmas_of_a_pose():
    direction = unit([1, 2, -2])
    across = np.eye(3) - np.outer(direction, direction)
    covariance = np.zeros((6, 6))
    covariance[:3, :3] = 0.001**2 * np.eye(3)
    covariance[3:, 3:] = 0.02**2 * across + 0.03**2 * np.outer(direction, direction)
    np.testing.assert_allclose(pose_sigmas(pose_along(direction, 0.5, covariance)),
                               (0.001, 0.04, 0.06), rtol=1e-9)
    assert pose_sigmas(pose_along(direction, 0.5)) == (0, 0, 0)
    np.testing.assert_allclose(pose_sigmas(pose_along(direction, 0.5, np.zeros((6, 6)))), 0,
                               atol=1e-12)


# --- fusion


def estimate(rho: list[float], sigma: list[float], signed: bool = True) -> InverseRange:
    return InverseRange(np.array([rho], np.float32), np.array([sigma], np.float32), signed)


def test_one_estimate_stays_what_it_is():
    one = estimate([0.1, 0.2], [0.01, NOTHING])
    out = fuse([one])
    np.testing.assert_array_equal(out.rho, one.rho)
    np.testing.assert_array_equal(out.sigma, one.sigma)


@given(st.floats(0.01, 1), st.floats(0.001, 0.1), st.floats(0.001, 0.1), st.floats(-2.9, 2.9),
       st.booleans(), st.booleans())
def test_what_agrees_is_averaged_by_inverse_variance(rho, s0, s1, apart, signed0, signed1):
    other = rho + apart * np.hypot(s0, s1)
    a, b = estimate([rho], [s0], signed0), estimate([other], [s1], signed1)
    before = a.rho.copy()
    out, swapped = fuse([a, b]), fuse([b, a])
    mean = (rho / s0**2 + other / s1**2) / (1 / s0**2 + 1 / s1**2)
    np.testing.assert_allclose(out.rho, mean, rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(out.sigma, 1 / np.sqrt(1 / s0**2 + 1 / s1**2), rtol=1e-4)
    np.testing.assert_allclose(swapped.rho, out.rho, rtol=1e-4, atol=1e-6)
    assert out.signed == (signed0 and signed1)
    np.testing.assert_array_equal(a.rho, before)  # what was given is not changed


@given(st.floats(0.01, 1), st.floats(0.001, 0.1), st.floats(0.001, 0.1), st.floats(3.1, 50),
       st.sampled_from([-1, 1]))
def test_what_disagrees_is_what_the_shorter_baseline_says(rho, s0, s1, apart, sign):
    """A near obstacle that the short pair sees is not made far by the long one."""
    long = rho + sign * apart * np.hypot(s0, s1)
    out = fuse([estimate([rho], [s0]), estimate([long], [s1])])
    np.testing.assert_allclose(out.rho, rho, rtol=1e-6)
    np.testing.assert_allclose(out.sigma, s0, rtol=1e-6)


def test_what_one_does_not_know_the_other_says():
    known, unknown = estimate([0.2], [0.01]), estimate([0.0], [NOTHING])
    for pair in ([known, unknown], [unknown, known], [unknown, known, unknown]):
        out = fuse(pair)
        np.testing.assert_allclose(out.rho, 0.2, rtol=1e-5)
        np.testing.assert_allclose(out.sigma, 0.01, rtol=1e-5)
    none = fuse([unknown, unknown])
    assert np.isnan(published_range(none, LIMITS, True)[0]).all()


def test_a_search_that_ends_does_not_speak_alone_unless_it_is_judged():
    """It would report what is nearer than its search as far."""
    unknown, far = estimate([0.0], [NOTHING], False), estimate([0.02], [0.001], False)
    assert fuse([unknown, far]).sigma == NOTHING
    judged = fuse([unknown, far], judged=True)
    np.testing.assert_allclose([judged.rho, judged.sigma], [[[0.02]], [[0.001]]], rtol=1e-5)
    near = estimate([0.2], [0.001], False)  # what the shorter one says stands
    np.testing.assert_allclose(fuse([near, far], judged=True).rho, 0.2, rtol=1e-6)


def test_three_that_agree_are_better_than_two():
    out = fuse([estimate([0.2], [0.01])] * 3)
    np.testing.assert_allclose(out.sigma, 0.01 / np.sqrt(3), rtol=1e-5)


# --- what is published


@pytest.mark.parametrize(('rho', 'sigma', 'expected'), [
    (0.1, 0.01, 10.0),
    (0.1, 0.029, 10.0), (0.1, 0.031, np.nan),  # relative sigma of 0.3
    (0.1, NOTHING, np.nan), (0.0, NOTHING, np.nan), (np.nan, np.nan, np.nan),
    (1 / 0.51, 0.01, 0.51), (1 / 0.49, 0.01, -np.inf), (1 / 0.49, 1.0, np.nan),
    (1 / 99.0, 1e-4, 99.0), (1 / 101.0, 1e-3, np.nan),  # farther, but not certainly
    (0.005, 0.0016, np.inf), (0.005, 0.0017, np.nan),  # 0.005 + 3σ against 1/100
    (0.0, 0.003, np.inf), (-0.002, 0.001, np.inf),
    (-0.004, 0.001, np.nan),  # the wrong way by four standard deviations: no match
])
def test_each_kind_of_range(rho, sigma, expected):
    r, spread = published_range(estimate([rho], [sigma]), LIMITS, True)
    np.testing.assert_allclose(r, [[expected]], rtol=1e-5)
    np.testing.assert_allclose(spread, sigma / rho**2 if np.isfinite(expected) else np.nan,
                               rtol=1e-5)


@given(st.integers(0, 2**32 - 1), st.booleans(), st.booleans())
@settings(deadline=None, max_examples=50)
def test_whatever_is_published_keeps_the_limits(seed, signed, metric):
    rng = np.random.default_rng(seed)
    rho = np.exp(rng.uniform(-9, 3, (70, 140))) * rng.choice([1, 1, 1, -1], (70, 140))
    sigma = np.abs(rho) * np.exp(rng.uniform(-6, 3, rho.shape))
    sigma[rng.random(rho.shape) < 0.1] = NOTHING
    given_ = InverseRange(rho.astype(np.float32), sigma.astype(np.float32), signed)
    r, spread = published_range(given_, LIMITS, metric)
    finite = np.isfinite(r)
    assert finite.any()
    np.testing.assert_array_equal(np.isnan(spread), ~finite)
    assert (spread[finite] <= 0.3001 * r[finite]).all()
    np.testing.assert_allclose(r[finite] * rho[finite], 1, rtol=1e-5)
    if metric:
        assert (r[finite] >= 0.499).all()
        assert (r[finite] <= 100.1).all()
        assert (1 / rho[np.isneginf(r)] < 0.501).all()
        beyond = np.isposinf(r)
        assert beyond.any() == signed
        assert (rho + 3 * sigma)[beyond].max(initial=0) < 0.01001
    else:
        assert not np.isinf(r).any()


def test_mask_is_unknown():
    mask = np.array([[0, 255, 1]], np.uint8)
    r, sigma = published_range(estimate([0.1, 0.1, 1 / 0.4], [0.01] * 3), LIMITS, True, mask)
    np.testing.assert_allclose(r, [[10, np.nan, np.nan]], rtol=1e-6)
    np.testing.assert_allclose(sigma, [[1, np.nan, np.nan]], rtol=1e-6)


def test_no_minimum_makes_nothing_too_near():
    r, _ = published_range(estimate([1000.0], [0.1]), RangeConfig(minimum=0.0), True)
    np.testing.assert_allclose(r, 0.001, rtol=1e-5)


def test_where_a_search_ends_the_long_baseline_does_not_speak_alone():
    """A near point beyond the search of the long pair reads far there."""
    unknown = InverseRange(np.zeros((1, 1), np.float32), np.full((1, 1), NOTHING, np.float32),
                           signed=False)
    far = InverseRange(np.full((1, 1), 0.02, np.float32), np.full((1, 1), 1e-3, np.float32),
                       signed=False)
    assert fuse([unknown, far]).sigma >= NOTHING
    flows = [InverseRange(e.rho, e.sigma, signed=True) for e in (unknown, far)]
    assert fuse(flows).rho == pytest.approx(0.02)
