"""Geometry of a pair against points placed in space: θ1 and θ2 come from dot and cross products,
never from the formulas under test.
"""
from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from sphstereo_ros.core import sphere

seeds = st.integers(0, 2**32 - 1)
baselines = st.floats(0.01, 5.0)
directions = arrays(np.float64, (3,), elements=st.floats(-1.0, 1.0)).filter(
    lambda v: np.linalg.norm(v) > 1e-3)


def angle_between(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.arctan2(np.linalg.norm(np.cross(a, b), axis=-1), np.sum(a * b, axis=-1))


def seen(points: np.ndarray, direction: np.ndarray, baseline: float) -> tuple:
    """θ1, θ2 and r2 of points given in the current camera's frame."""
    t = direction / np.linalg.norm(direction)
    from_reference = points + baseline * t  # C1 = C2 − b t
    return (angle_between(from_reference, t), angle_between(points, t),
            np.linalg.norm(points, axis=-1))


def at_latitude(latitude: float, azimuth: float, direction: np.ndarray) -> np.ndarray:
    """Unit bearing whose angle to the plane normal to `direction` is `latitude`."""
    t = direction / np.linalg.norm(direction)
    across = np.cross(t, [0.3, -0.5, 0.8] if abs(t @ [0.3, -0.5, 0.8]) < 0.9 else [1, 0, 0])
    across /= np.linalg.norm(across)
    return np.sin(latitude) * t + np.cos(latitude) * (
        np.cos(azimuth) * across + np.sin(azimuth) * np.cross(t, across))


@given(st.floats(-89.0, 89.0), st.floats(0, 2 * np.pi), directions, baselines,
       st.floats(0.2, 1000.0))
def test_range_is_exact_at_all_latitudes_to_89_degrees(latitude, azimuth, direction, baseline,
                                                       distance):
    r2_true = distance * baseline
    point = r2_true * at_latitude(np.radians(latitude), azimuth, direction)
    theta1, theta2, _ = seen(point, direction, baseline)
    r2 = sphere.range_from_parallax(theta2, theta2 - theta1, baseline)
    assert r2 == pytest.approx(r2_true, rel=1e-6)


def test_range_of_a_grid_of_points():
    latitude, distance = np.meshgrid(np.radians(np.arange(-89.0, 90.0)),
                                     [0.3, 0.5, 1, 2, 5, 10, 30, 100], indexing='ij')
    t = np.array([0.2, 0.1, 0.97])
    for azimuth in np.arange(0, 2 * np.pi, 0.7):
        bearing = np.stack([at_latitude(a, azimuth, t) for a in latitude[:, 0]])
        theta1, theta2, r = seen(bearing[:, None] * distance[..., None], t, 0.28)
        np.testing.assert_allclose(
            sphere.range_from_parallax(theta2, theta2 - theta1, 0.28), r, rtol=1e-6)


@given(st.floats(0.001, 3.14), st.floats(0.05, 1000.0), baselines)
def test_parallax_from_range_undoes_range_from_parallax(theta2, distance, baseline):
    delta = sphere.parallax_from_range(theta2, distance * baseline, baseline)
    assert delta > 0
    assert sphere.range_from_parallax(theta2, delta, baseline) == pytest.approx(
        distance * baseline, rel=1e-6)


@given(seeds, directions, baselines)
def test_parallax_of_points_in_space(seed, direction, baseline):
    points = np.random.default_rng(seed).normal(size=(50, 3)) * 10 * baseline
    theta1, theta2, r2 = seen(points, direction, baseline)
    np.testing.assert_allclose(sphere.parallax_from_range(theta2, r2, baseline),
                               theta2 - theta1, atol=1e-12)


@pytest.mark.parametrize(('theta2', 'parallax'), [
    (1.0, -0.01),  # behind: the ray turns the wrong way
    (1.0, 1.0), (1.0, 1.2),  # the rays do not meet in front of the reference
    (0.0, 0.1), (3.2, 0.1), (np.nan, 0.1), (1.0, np.nan)])
def test_impossible_geometry_is_nan(theta2, parallax):
    assert np.isnan(sphere.range_from_parallax(theta2, parallax, 1.0))


def test_no_parallax_is_infinitely_far():
    np.testing.assert_array_equal(sphere.range_from_parallax([0.5, 2.0], 0.0, 1.0), np.inf)


def test_range_broadcasts():
    assert sphere.range_from_parallax(np.ones((3, 1)), np.full(4, 0.1), 1.0).shape == (3, 4)
    assert sphere.parallax_from_range(np.ones((3, 1)), np.full(4, 2.0), 1.0).shape == (3, 4)


@given(st.floats(0.02, 3.1), st.floats(0.1, 200.0), baselines, st.floats(1e-5, 1e-3))
def test_sigma_of_the_parallax_is_the_slope_of_the_range(theta2, distance, baseline, noise):
    delta = float(sphere.parallax_from_range(theta2, distance * baseline, baseline))
    step = 1e-5 * min(delta, theta2 - delta, np.pi - theta2 + delta)
    ahead, behind = (sphere.range_from_parallax(theta2, delta + s, baseline)
                     for s in (step, -step))
    slope = float(ahead - behind) / (2 * step)
    sigma = sphere.range_sigma(theta2, delta, baseline, parallax_sigma=noise)
    assert sigma == pytest.approx(abs(slope) * noise, rel=1e-4)


@given(st.floats(0.02, 3.1), st.floats(0.1, 200.0), baselines, st.floats(1e-4, 0.1))
def test_sigma_of_the_baseline_is_its_share_of_the_range(theta2, distance, baseline, share):
    delta = sphere.parallax_from_range(theta2, distance * baseline, baseline)
    sigma = sphere.range_sigma(theta2, delta, baseline, parallax_sigma=0.0,
                               baseline_sigma=share * baseline)
    assert sigma == pytest.approx(share * distance * baseline, rel=1e-6)


def test_sigmas_of_independent_causes_add_in_squares():
    both = sphere.range_sigma(1.0, 0.1, 0.3, parallax_sigma=0.002, baseline_sigma=0.05)
    parts = [sphere.range_sigma(1.0, 0.1, 0.3, parallax_sigma=s, baseline_sigma=b)
             for s, b in ((0.002, 0.0), (0.0, 0.05))]
    assert both == pytest.approx(np.hypot(*parts), rel=1e-12)


def test_equation_2_of_the_paper_multiplies_by_the_cosine_of_the_latitude():
    """At φ = 60° a point at 10 m is 10 m away. Divided as printed it would be 40 m."""
    latitude, baseline, height = np.radians(60.0), 0.28, 960
    # The paper's parallax is taken from the view at the foot of the right angle (small baseline).
    t = np.array([0.0, 0, 1])
    points = 10.0 * np.array([np.cos(latitude), 0, np.sin(latitude)])
    theta1, theta2, _ = seen(points, t, baseline)
    pixels = (theta2 - theta1) * height / np.pi
    got = sphere.paper_range(latitude, pixels, height, baseline)
    assert got == pytest.approx(10.0, rel=0.03)


@given(st.floats(-80.0, 80.0), st.floats(50.0, 500.0))
def test_the_paper_agrees_with_the_exact_range_far_away(latitude, distance):
    """Its tangent and its one latitude are right to first order in b / r, everywhere."""
    phi, baseline, height = np.radians(latitude), 0.3, 960
    theta2 = np.pi / 2 - phi
    delta = sphere.parallax_from_range(theta2, distance * baseline, baseline)
    got = sphere.paper_range(phi, delta * height / np.pi, height, baseline)
    assert got == pytest.approx(distance * baseline, rel=1.5 / distance)


@given(directions)
def test_polar_axes_are_a_right_handed_frame_with_the_pole_along_t(direction):
    axes = sphere.polar_axes(direction)
    np.testing.assert_allclose(axes.T @ axes, np.eye(3), atol=1e-12)
    assert np.linalg.det(axes) == pytest.approx(1.0)
    np.testing.assert_allclose(axes[:, 2], direction / np.linalg.norm(direction), atol=1e-12)


@given(directions, st.floats(0.0, np.pi), st.floats(0, 2 * np.pi))
def test_polar_bearings_have_their_polar_angle_and_azimuth(direction, theta, azimuth):
    axes = sphere.polar_axes(direction)
    bearing = sphere.polar_bearings(theta, azimuth, axes)
    assert angle_between(bearing, axes[:, 2]) == pytest.approx(theta, abs=1e-9)
    expected = np.sin(theta) * np.array([np.cos(azimuth), np.sin(azimuth)])
    np.testing.assert_allclose([bearing @ axes[:, 0], bearing @ axes[:, 1]], expected, atol=1e-12)


def test_polar_bearings_broadcast():
    axes = sphere.polar_axes([0, 0, 1])
    assert sphere.polar_bearings(np.ones(5), np.zeros((4, 1)), axes).shape == (4, 5, 3)
