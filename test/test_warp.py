from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from sphstereo_ros.core import rotations
from sphstereo_ros.core.camera import Equirectangular
from sphstereo_ros.core.frames import RelativePose
from sphstereo_ros.core.sphere import polar_axes, polar_bearings
from sphstereo_ros.core.warp import (
    BORDER,
    PolarGrid,
    aligned_pair,
    polar_map,
    resample,
    rotation_map,
    with_border,
)

directions = arrays(np.float64, (3,), elements=st.floats(-1.0, 1.0)).filter(
    lambda v: np.linalg.norm(v) > 1e-3)
vectors = arrays(np.float64, (3,), elements=st.floats(-3.0, 3.0))
compiled = settings(deadline=None, max_examples=25)


def smooth(bearings: np.ndarray) -> np.ndarray:
    """A band-limited function of the bearing with values in 0 … 255, a low polynomial."""
    x, y, z = np.moveaxis(np.asarray(bearings, np.float64), -1, 0)
    return 127.5 + 30 * x * y + 25 * y * z + 20 * x * z * z + 30 * z + 25 * y**3 + 20 * x * x


def pixel_error(maps: tuple, bearings: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Distance in pixels between a map and the projection of `bearings`, shorter way round."""
    wanted = Equirectangular(*shape).project(bearings)
    du = maps[0] - BORDER - wanted[..., 0]
    du -= shape[1] * np.round(du / shape[1])
    # Near a pole a column is next to nothing: count columns as wide as they are there.
    du *= np.hypot(bearings[..., 0], bearings[..., 2])
    return np.hypot(du, maps[1] - BORDER - wanted[..., 1])


@given(directions, st.sampled_from([(64, 128), (240, 480), (135, 240)]), st.integers(0, 20),
       st.integers(0, 20))
@compiled
def test_polar_map_agrees_with_the_camera_model(direction, shape, margin, wrap):
    grid = PolarGrid(72, margin, wrap)
    axes = polar_axes(direction)
    bearings = polar_bearings(grid.theta()[None], grid.azimuth()[:, None], axes)
    maps = polar_map(grid, axes, shape)
    assert maps[0].shape == maps[1].shape == grid.shape == (144 + 2 * wrap, 72 + 2 * margin)
    assert pixel_error(maps, bearings, shape).max() < 1e-3


def test_polar_map_is_accurate_at_full_size():
    grid = PolarGrid(960, 16, 16)
    axes = polar_axes([0.3, -0.2, 0.9])
    bearings = polar_bearings(grid.theta()[None], grid.azimuth()[:, None], axes)
    assert pixel_error(polar_map(grid, axes, (960, 1920)), bearings, (960, 1920)).max() < 1e-3


@given(vectors, st.sampled_from([(64, 128), (90, 240)]))
@compiled
def test_rotation_map_shows_what_the_turned_camera_sees(vector, shape):
    rotation = rotations.exp(vector)
    maps = rotation_map(rotation, shape)
    assert maps[0].shape == shape
    wanted = Equirectangular(*shape).bearings() @ rotation.T
    assert pixel_error(maps, wanted, shape).max() < 1e-3


def test_maps_never_leave_the_bordered_image():
    for vector in ([0.0, 0, 0], [0, 1.5, 0], [np.pi / 2, 0, 0], [0, np.pi, 0], [np.pi, 0, 0]):
        rotation = rotations.exp(vector)
        for u, v in (rotation_map(rotation, (60, 120)),
                     polar_map(PolarGrid(60, 16, 16), rotation, (60, 120))):
            assert u.min() >= 1  # a bilinear kernel, and a bicubic one, stay inside
            assert v.min() >= 1
            assert u.max() <= 120 + 2 * BORDER - 3
            assert v.max() <= 60 + 2 * BORDER - 3


def test_grid_angles_continue_over_the_margins():
    grid = PolarGrid(10, margin=3, wrap=2)
    assert grid.shape == (24, 16)
    np.testing.assert_allclose(np.degrees(grid.theta()), np.arange(-45, 226, 18.0))
    np.testing.assert_allclose(np.degrees(grid.azimuth()), np.arange(-27, 388, 18.0))
    assert np.degrees(grid.pixel) == pytest.approx(18)


@pytest.mark.parametrize('shape', [(60, 120), (60, 90), (54, 96)])
def test_border_continues_the_sphere_over_seam_and_poles(shape):
    """Every border pixel is a copy of the pixel whose direction it continues to."""
    height, width = shape
    v, u = np.mgrid[-BORDER:height + BORDER, -BORDER:width + BORDER]
    lon = 2 * np.pi * ((u + 0.5) / width - 0.5)
    lat = np.pi * (0.5 - (v + 0.5) / height)  # beyond ±90° the formula goes on over the pole
    wanted = smooth(np.stack([np.cos(lat) * np.sin(lon), -np.sin(lat),
                              np.cos(lat) * np.cos(lon)], -1))
    image = smooth(Equirectangular(*shape).bearings())
    np.testing.assert_allclose(with_border(image), wanted, atol=1e-9)


def test_border_of_a_colour_image_is_that_of_its_channels():
    image = np.random.default_rng(0).integers(0, 255, (20, 40, 3), np.uint8)
    out = with_border(image)
    assert out.dtype == np.uint8
    for c in range(3):
        np.testing.assert_array_equal(out[..., c], with_border(image[..., c].copy()))


@given(vectors)
@compiled
def test_resampling_has_no_join(vector):
    """Interpolation error beside the seam and the poles is as small as anywhere."""
    shape = (120, 240)
    rotation = rotations.exp(vector)
    image = smooth(Equirectangular(*shape).bearings()).astype(np.float32)
    turned = resample(with_border(image), rotation_map(rotation, shape))
    seen = Equirectangular(*shape).bearings() @ rotation.T
    error = np.abs(turned - smooth(seen))
    u, v = np.moveaxis(Equirectangular(*shape).project(seen), -1, 0)
    at_seam = (u < 1) | (u > shape[1] - 2)
    at_pole = (v < 1) | (v > shape[0] - 2)
    assert error[~at_seam & ~at_pole].max() < 0.15  # bilinear, in grey levels
    assert error[at_seam].max(initial=0.0) < 0.15
    assert error[at_pole].max(initial=0.0) < 0.15


def test_margins_of_the_polar_grid_have_no_join():
    shape, grid = (120, 240), PolarGrid(120, 16, 16)
    image = smooth(Equirectangular(*shape).bearings()).astype(np.float32)
    for direction in ([0, 0, 1], [1, 0, 0], [0, -1, 0], [0.4, 0.7, -0.6]):
        axes = polar_axes(direction)
        out = resample(with_border(image), polar_map(grid, axes, shape))
        bearings = polar_bearings(grid.theta()[None], grid.azimuth()[:, None], axes)
        np.testing.assert_allclose(out, smooth(bearings), atol=0.15)


@given(vectors, directions)
@compiled
def test_aligned_views_of_a_far_world_are_equal(vector, direction):
    """Infinitely far content, seen from two rotated cameras, is the same on the aligned grid."""
    shape, rotation = (96, 192), rotations.exp(vector)
    bearings = Equirectangular(*shape).bearings()
    reference = np.round(smooth(bearings)).astype(np.uint8)
    current = np.round(smooth(bearings @ rotation)).astype(np.uint8)  # X_ref = Rᵀ X_cur
    pose = RelativePose(rotation, -0.3 * direction / np.linalg.norm(direction))
    grid = PolarGrid(64, 8, 8)
    ref, cur, axes = aligned_pair(reference, current, pose, grid)
    np.testing.assert_allclose(axes[:, 2], pose.direction, atol=1e-12)
    assert ref.shape == cur.shape == grid.shape
    assert np.abs(ref.astype(int) - cur).max() <= 2  # both are rounded to whole grey levels
    wanted = smooth(polar_bearings(grid.theta()[None], grid.azimuth()[:, None], axes) @ rotation)
    assert np.abs(cur - wanted).max() < 1.6
