from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sphstereo_ros.core.camera import Equirectangular
from sphstereo_ros.core.inverse_range import NOTHING
from sphstereo_ros.core.planes import on_planes

HEIGHT = 192
BEARINGS = Equirectangular(HEIGHT, 2 * HEIGHT).bearings()


def ground(height: float) -> tuple[np.ndarray, np.ndarray]:
    """Inverse range of level ground, and where it is seen well inside."""
    down = BEARINGS[..., 1]
    return np.maximum(down / height, 0).astype(np.float32), (down > 0.25) & (down < 0.85)


def gappy(rho: np.ndarray, share: float) -> np.ndarray:
    """Sigma: known at a share of all pixels."""
    known = np.random.default_rng(3).random(rho.shape) < share
    return np.where(known & (rho > 0), 0.01 * rho, NOTHING).astype(np.float32)


@settings(max_examples=15, deadline=None)
@given(st.floats(0.5, 4), st.floats(0.4, 0.9))
def test_the_ground_is_completed_by_what_was_measured(height, share):
    rho, inside = ground(height)
    sigma = gappy(rho, share)
    open_ = inside & (sigma >= NOTHING)
    found = on_planes(rho, sigma, rho, rho)
    assert not found[sigma < NOTHING].any()
    assert found[open_].mean() > 0.9


@pytest.mark.parametrize('factor', [0.5, 0.85, 1.15, 2.0])
def test_a_measurement_off_the_plane_is_not_believed(factor):
    rho, inside = ground(2.0)
    sigma = gappy(rho, 0.6)
    assert on_planes(rho, sigma, np.float32(factor) * rho, rho)[inside].mean() < 0.005


def test_across_the_seam_as_anywhere():
    rho, inside = ground(2.0)
    sigma = gappy(rho, 0.6)
    found = on_planes(rho, sigma, rho, rho)
    seam = np.zeros(rho.shape, bool)
    seam[:, :6] = seam[:, -6:] = True
    assert found[seam & inside & (sigma >= NOTHING)].mean() > 0.9


def test_nothing_is_continued_beyond_the_rim_of_what_is_known():
    """A plane tells nothing of what lies beside it."""
    rho, _ = ground(2.0)
    sigma = gappy(rho, 0.8)
    sigma[:, :HEIGHT] = NOTHING
    found = on_planes(rho, sigma, rho, rho)
    assert not found[:, 12:HEIGHT - 12].any()


def test_a_step_is_no_plane():
    rho = np.full((HEIGHT, 2 * HEIGHT), 0.2, np.float32)
    rho[:, HEIGHT:] = 0.5
    sigma = gappy(rho, 0.6)
    found = on_planes(rho, sigma, rho, rho)
    assert not found[20:-20, HEIGHT - 1:HEIGHT + 1].any()
    assert found[20:-20, 40:HEIGHT - 40][sigma[20:-20, 40:HEIGHT - 40] >= NOTHING].mean() > 0.9


def test_what_may_stand_before_the_plane_is_not_given_its_range():
    rho, inside = ground(2.0)
    sigma = gappy(rho, 0.6)
    nearer = rho.copy()
    nearer[:, HEIGHT:] *= 2
    found = on_planes(rho, sigma, rho, nearer)
    assert not found[:, HEIGHT:].any()
    assert found[:, :HEIGHT][inside[:, :HEIGHT] & (sigma[:, :HEIGHT] >= NOTHING)].mean() > 0.9
