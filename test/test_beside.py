"""What is seen beside each pixel, farther and nearer."""
from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sphstereo_ros.core.beside import beside
from sphstereo_ros.core.inverse_range import NOTHING

ROWS, PIXEL = 60, 1e-3
REACH = 15  # px


def wall_and_post() -> np.ndarray:
    """A wall 20 m away, and before it a post 5 m away, 4 px wide."""
    rho = np.full((ROWS, 2 * ROWS), 0.05, np.float32)
    rho[:, 40:44] = 0.2
    return rho


def seen(rho: np.ndarray, sigma: np.ndarray | None = None,
         view: np.ndarray | None = None) -> np.ndarray:
    """Ranges and how close they are, without greys; without a view all is black."""
    black = np.zeros(rho.shape, np.uint8)
    found = beside(rho, 0.01 * rho if sigma is None else sigma,
                   black if view is None else view, PIXEL)
    return found[[0, 1, 3, 4]]


def test_beside_a_post_is_the_wall_and_beside_the_wall_the_post():
    farther, farther_close, nearer, nearer_close = seen(wall_and_post())
    np.testing.assert_allclose(farther[:, 40:44], 0.05)
    assert not farther_close[:, :40].any()
    assert not farther_close[:, 44:].any()
    np.testing.assert_allclose(nearer[:, 30:40], 0.2)
    assert not nearer_close[:, 40:44].any()
    even = 1 - np.arange(REACH + 1) / REACH  # 1 next to it
    np.testing.assert_allclose(nearer_close[9, 44:44 + REACH + 1], even, atol=1e-6)
    np.testing.assert_allclose(farther_close[9, 40:44], [1, 1 - 1 / REACH, 1 - 1 / REACH, 1],
                               atol=1e-6)


def test_the_closest_of_several_counts():
    rho = wall_and_post()
    rho[:, 50:] = 0.02
    assert (seen(rho)[0][:, 43] == np.float32(0.05)).all()
    rho[:, 44:50] = 0.2
    assert (seen(rho)[0][:, 48] == np.float32(0.02)).all()


def test_what_is_unsure_is_not_looked_at_but_looks():
    rho = wall_and_post()
    sigma = 0.01 * rho
    sigma[:, 40:44] = 0.2 * 0.2
    found = seen(rho, sigma)
    assert not found[2:].any()
    assert (found[0][:, 40:44] == np.float32(0.05)).all()


@pytest.mark.parametrize(('rho', 'other', 'sides'), [
    (0.05, 0.05 / 1.19, (0, 0)), (0.05, 0.05 / 1.27, (0, 1)), (0.05, 0.062, (1, 0)),
    (0.05, 0.064, (1, 1)), (1e-4, 5e-4, (1, 0)), (1e-4, 7e-4, (1, 1))])
def test_what_hardly_differs_is_no_other_surface(rho, other, sides):
    """Nor what differs by less than half a pixel of parallax."""
    whole = np.full((ROWS, 2 * ROWS), rho, np.float32)
    whole[:, 40:44] = other
    found = seen(whole, np.full(whole.shape, 1e-6, np.float32))
    here, there = found[[1, 3], 5, 38], found[[1, 3], 5, 42]
    if other < rho:
        assert (bool(here[0]), bool(there[1])) == (bool(sides[1]), rho > 1.25 * other)
    else:
        assert (bool(there[0]), bool(here[1])) == (rho < 0.83 * other, bool(sides[1]))


def test_sky_is_farther_and_nothing_is_farther_than_it():
    rho = wall_and_post()
    rho[:20] = 0
    sigma = np.full(rho.shape, 1e-4, np.float32)
    farther, close, nearer, _ = seen(rho, sigma)
    assert not farther[20:30, 60].any()
    assert (close[20:30, 60] > 0.3).all()
    assert not close[:20].any()
    np.testing.assert_allclose(nearer[10:20, 60], 0.05)


def test_it_looks_across_the_seam_and_not_across_the_poles():
    rho = np.full((ROWS, 2 * ROWS), 0.05, np.float32)
    rho[30:, 0] = 0.2
    close = seen(rho)[3]
    assert (close[30:, -1] == 1).all()
    assert (close[40, -REACH:] > 0).all()
    assert not close[:30 - REACH].any()


def test_its_grey_is_that_of_what_is_round_about():
    rho = wall_and_post()
    view = np.full(rho.shape, 200, np.uint8)
    view[:, 38:46] = 50
    view[::2, 41] = 255  # of five rows two or three
    farther, nearer = beside(rho, 0.01 * rho, view, PIXEL)[[2, 5]]
    bright = 205 / 10
    np.testing.assert_allclose(nearer[4:-4, 30:40], 50 + bright, atol=4.5)
    np.testing.assert_allclose(farther[4:-4, 40], (200 + 4 * 50) / 5 + bright, atol=4.5)
    assert not nearer[:, 40:44].any()
    assert not farther[:, 60:].any()


@pytest.mark.parametrize('times', [2, 4])
def test_larger_pictures_are_looked_at_smaller(times):
    rng = np.random.default_rng(0)
    small = rng.choice([0.02, 0.05, 0.2], (240, 480)).astype(np.float32)
    large = small.repeat(times, 0).repeat(times, 1)
    np.testing.assert_array_equal(seen(large), seen(small).repeat(times, 1).repeat(times, 2))


@settings(deadline=None, max_examples=25)
@given(rows=st.integers(2, 40), seed=st.integers(0, 2**32 - 1))
def test_it_is_the_closest_that_differs(rows, seed):
    rng = np.random.default_rng(seed)
    rho = rng.choice([0, 0.02, 0.021, 0.05, 0.2], (rows, 2 * rows), p=[.1, .4, .3, .1, .1])
    rho = rho.astype(np.float32)
    sigma = np.where(rng.random(rho.shape) < 0.3, NOTHING, 1e-6).astype(np.float32)
    found = seen(rho, sigma)
    i, j = rng.integers(rows), rng.integers(2 * rows)
    r, c = np.mgrid[:rows, :2 * rows]
    across = np.abs(c - j)
    away = np.hypot(r - i, np.minimum(across, 2 * rows - across))
    own = rho[i, j]
    for n, other in ((0, rho < 0.83 * own), (2, rho > max(1.25 * own, own + 5e-4))):
        away_of = np.where(other & (sigma < 1) & (away <= REACH), away, np.inf)
        closest = away_of.min()
        assert found[n + 1, i, j] == pytest.approx(
            max(1 - (closest - 1) / REACH, 0) if closest < np.inf else 0, abs=1e-5)
        if closest < np.inf:
            assert found[n, i, j] in rho[away_of == closest]


@pytest.mark.parametrize('shape', [(481, 962), (719, 1438), (7, 14)])
def test_any_size_is_told_whole(shape):
    found = beside(np.full(shape, 0.1, np.float32), np.full(shape, 1e-3, np.float32),
                   np.full(shape, 99, np.uint8), PIXEL)
    assert found.shape == (6, *shape)
    assert not found.any()
