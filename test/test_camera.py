from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from sphstereo_ros.core.camera import CameraModel, Equirectangular

sizes = st.one_of(st.just((1080, 1920)), st.just((960, 1920)),
                  st.tuples(st.integers(1, 3000), st.integers(1, 6000)))
directions = arrays(np.float64, (3,), elements=st.floats(-1.0, 1.0)).filter(
    lambda v: np.linalg.norm(v) > 1e-3)


def on_sphere(seed: int, count: int) -> np.ndarray:
    v = np.random.default_rng(seed).normal(size=(count, 3))
    return v / np.linalg.norm(v, axis=1, keepdims=True)


@given(sizes, directions, st.floats(1e-3, 1e3))
def test_a_bearing_of_any_length_comes_back_as_a_unit_bearing(size, direction, length):
    camera = Equirectangular(*size)
    back = camera.unproject(camera.project(length * direction))
    np.testing.assert_allclose(back, direction / np.linalg.norm(direction), atol=1e-9)


@given(sizes, st.floats(0.0, 1.0, exclude_max=True), st.floats(1e-6, 1 - 1e-6))
def test_a_pixel_position_comes_back(size, across, down):
    camera = Equirectangular(*size)
    pixel = np.array([across * camera.width - 0.5, down * camera.height - 0.5])
    back = camera.project(camera.unproject(pixel))
    turn = (back[0] - pixel[0]) / camera.width
    assert abs(turn - round(turn)) < 1e-9  # just beside the seam either side is right
    assert back[1] == pytest.approx(pixel[1], abs=1e-9 * camera.height)


@given(sizes, st.integers(0, 2**32 - 1))
def test_projections_lie_in_the_image(size, seed):
    camera = Equirectangular(*size)
    seam = np.array([[0.0, 0, -1], [-0.0, 0, -1], [-1e-320, 0, -1], [1e-320, 0, -1],
                     [-1e-17, 0.5, -1], [0, 1, 0], [0, -1, 0], [0, 1, -0.0]])
    u, v = np.moveaxis(camera.project(np.concatenate([on_sphere(seed, 200), seam])), -1, 0)
    assert (u >= -0.5).all()
    assert (u < camera.width - 0.5).all()
    assert (v >= -0.5).all()
    assert (v <= camera.height - 0.5).all()


@pytest.mark.parametrize(('bearing', 'pixel'), [
    ([0, 0, 1], (959.5, 539.5)), ([1, 0, 0], (1439.5, 539.5)), ([-1, 0, 0], (479.5, 539.5)),
    ([0, 0, -1], (-0.5, 539.5)),
    ([0, math.sin(math.pi / 4), math.cos(math.pi / 4)], (959.5, 809.5)),
    ([0, -math.sin(math.pi / 4), math.cos(math.pi / 4)], (959.5, 269.5)),
])
def test_known_directions_in_a_1920_by_1080_sphere(bearing, pixel):
    np.testing.assert_allclose(Equirectangular(1080, 1920).project(np.array(bearing, float)),
                               pixel, atol=1e-9)


def test_poles_are_the_edges_of_the_image():
    camera = Equirectangular(1080, 1920)
    assert camera.project(np.array([0.0, -1, 0]))[1] == -0.5
    assert camera.project(np.array([0.0, 1, 0]))[1] == 1079.5
    np.testing.assert_allclose(camera.unproject(np.array([[17.0, -0.5], [900.0, 1079.5]])),
                               [[0, -1, 0], [0, 1, 0]], atol=1e-12)


def test_first_pixel_looks_backward_and_up():
    camera = Equirectangular(2, 4)  # pixel centres at ±45° latitude, ±45° and ±135° longitude
    half = math.sqrt(0.5)
    np.testing.assert_allclose(camera.unproject(np.array([0.0, 0.0])), [-0.5, -half, -0.5])
    np.testing.assert_allclose(camera.unproject(np.array([3.0, 1.0])), [0.5, half, -0.5])


def test_columns_wrap_round_and_rows_outside_are_nowhere():
    camera = Equirectangular(10, 20)
    np.testing.assert_allclose(camera.unproject(np.array([25.0, 3.0])),
                               camera.unproject(np.array([5.0, 3.0])), atol=1e-12)
    np.testing.assert_allclose(camera.unproject(np.array([-1.0, 3.0])),
                               camera.unproject(np.array([19.0, 3.0])), atol=1e-12)
    assert np.isnan(camera.unproject(np.array([[5.0, -0.6], [5.0, 9.6]]))).all()


def test_nowhere_is_not_a_pixel():
    out = Equirectangular(10, 20).project(np.array([[0.0, 0, 0], [0, 0, 1], [np.nan, 0, 1]]))
    assert np.isnan(out[0]).all()
    assert np.isfinite(out[1]).all()
    assert np.isnan(out[2]).any()


def test_bearings_of_all_pixels_cover_the_sphere_evenly():
    camera = Equirectangular(90, 200)
    bearings = camera.bearings()
    assert bearings.shape == (90, 200, 3)
    np.testing.assert_allclose(np.linalg.norm(bearings, axis=-1), 1, atol=1e-12)
    np.testing.assert_allclose(bearings[7, 33], camera.unproject(np.array([33.0, 7.0])))
    weight = np.cos(np.pi * (0.5 - (np.arange(90) + 0.5) / 90))
    np.testing.assert_allclose((bearings * weight[:, None, None]).sum(axis=(0, 1)), 0, atol=1e-9)


@pytest.mark.parametrize('size', [(0, 10), (10, 0), (-1, 2)])
def test_an_image_without_pixels_is_refused(size):
    with pytest.raises(ValueError, match='pixels'):
        Equirectangular(*size)


def test_equirectangular_is_a_camera_model():
    model: CameraModel = Equirectangular(480, 960)
    assert (model.height, model.width) == (480, 960)
