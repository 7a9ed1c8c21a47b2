"""The sweep over the sphere, against exact ranges."""
from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from analytic_world import Ball, World
from hypothesis import given
from hypothesis import strategies as st
from polar_views import PolarView, Vector, polar_view

from sphstereo_ros.core.sweep import _census_rows, _different_bits, levels, sweep
from sphstereo_ros.core.warp import PolarGrid

BASELINES = st.lists(st.floats(0.02, 30.0), min_size=1, max_size=10)
HEIGHTS = st.integers(16, 2048)
ROOM = World()
FORWARD: tuple[Vector, ...] = ((0, 0, -0.3), (0, 0, -1.2))


@cache
def seen(world: World = ROOM, positions: tuple[Vector, ...] = FORWARD,
         turn: Vector = (0, 0, 0), reference_turn: Vector = (0, 0, 0)) -> PolarView:
    return polar_view(world, positions, turn, reference_turn)


def coarse(view: PolarView) -> PolarGrid:
    return PolarGrid(view.grid.height // 2, view.grid.margin // 2, view.grid.wrap // 2)


def swept(view: PolarView) -> np.ndarray:
    return sweep(view.image, view.grid, view.axes, view.pairs)[0]


def pixels_off(view: PolarView) -> np.ndarray:
    """Error of the sweep in pixels of its own grid, of the longest reference's parallax."""
    grid = coarse(view)
    found = swept(view)
    assert found.shape == grid.shape
    return np.abs(found - view.rho(grid)) * view.pairs[-1][1].baseline / grid.pixel


# --- levels


@given(BASELINES, HEIGHTS)
def test_levels_rise_from_beyond_infinity_and_are_never_too_many(baselines, height):
    found = levels(baselines, np.pi / height)
    assert 3 <= len(found) <= 256
    assert (np.diff(found) > 0).all()
    assert (found[:2] < 0).all()
    assert found[2] == pytest.approx(0, abs=1e-9 / max(baselines))
    assert np.array_equal(found, levels(baselines[::-1], np.pi / height))


@given(BASELINES, HEIGHTS)
def test_steps_of_parallax_are_even_and_fine_for_every_baseline_that_takes_part(baselines, height):
    pixel = np.pi / height
    found = levels(baselines, pixel)
    for near, step in zip(found[:-1], np.diff(found), strict=True):
        taking_part = [b for b in baselines if near * b <= 0.6] or [min(baselines)]
        allowed = 2.0 if near * min(baselines) > 0.6 else 1.5
        assert max(taking_part) * step == pytest.approx(allowed * pixel, rel=1e-6)


@given(st.floats(0.02, 30.0), st.integers(16, 960))
def test_levels_of_one_baseline_reach_to_the_nearest_that_matters(baseline, height):
    """To 0.3 m, or to half of the baseline, unless there would be too many."""
    found = levels([baseline], np.pi / height)
    assert found[-1] >= min(1 / 0.3, 2 / baseline) or len(found) == 256


# --- census


def test_census_has_a_bit_for_every_brighter_neighbour():
    rng = np.random.default_rng(1)
    image = rng.integers(0, 6, (20, 31), np.uint8)  # with ties
    got = np.empty(image.shape, np.uint32)
    _census_rows(0, 20, image, got)
    padded = np.pad(image, 2, mode='edge')
    wanted = np.zeros(image.shape, np.uint32)
    for di in range(5):
        for dj in range(5):
            if (di, dj) != (2, 2):
                wanted = wanted << 1 | (padded[di:di + 20, dj:dj + 31] > image)
    np.testing.assert_array_equal(got, wanted)


@given(st.integers(0, 2**24 - 1), st.integers(0, 2**24 - 1))
def test_different_bits_are_counted(a, b):
    assert _different_bits(np.uint32(a), np.uint32(b)) == (a ^ b).bit_count()


# --- the sweep


@pytest.mark.parametrize('radius', [1.0, 3.0, 12.0, 60.0])
def test_a_hollow_sphere_has_one_range_everywhere(radius):
    """Also at the seam of the grid, and beside both poles, where parallax still tells."""
    ball = Ball(cell=0.27 * radius, radius=radius)
    view = seen(ball, ((0, 0, -0.1 * radius), (0, 0, -0.4 * radius)))
    off, theta = pixels_off(view), view.theta(coarse(view))
    assert np.median(off[(theta > 15) & (theta < 165)]) < 0.2
    assert (off[(theta > 15) & (theta < 165)] < 1.0).mean() > 0.95
    assert (off[(theta > 5) & (theta < 175)] < 1.5).mean() > 0.9
    for seam in (off[:6], off[-6:]):
        assert (seam[:, 20:-20] < 1.0).mean() > 0.9


@pytest.mark.parametrize('radius', [1e4, 0.25])
def test_beyond_all_levels_and_nearer_than_all(radius):
    ball = Ball(cell=0.27 * radius, radius=radius)
    view = seen(ball, ((0, 0, -0.1), (0, 0, -0.1 * min(radius, 4))))
    middle = np.abs(view.theta(coarse(view)) - 90) < 60
    found = np.median(swept(view)[middle])
    assert found == pytest.approx(1 / radius, abs=0.02) if radius > 1 else found > 3


@pytest.mark.parametrize(('positions', 'turn', 'reference_turn'), [
    (((0, 0, -0.3),), (0, 0, 0), (0, 0, 0)),
    (((0, 0, 0.3),), (0, 0, 0), (0, 0, 0)),
    (((0.3, 0, 0),), (0, 0, 0), (0, 0, 0)),
    (((0, -0.3, 0),), (0, 0, 0), (0, 0, 0)),
    (((0.17, 0.1, -0.22),), (0, 0, 0), (0, 0, 0)),
    (FORWARD, (0, 0, 0), (0, 0, 0)),
    (FORWARD, (0.3, 2.9, 0.2), (0.1, 0.2, -0.1)),
    (((0, 0, -0.3), (0.21, 0, -1.18)), (0, 0, 0), (0, 0, 0)),  # the farther 10° aside
    (((0, 0, -0.3), (0, 0.6, -0.9)), (0, 1.0, 0), (0, 0.9, 0)),
], ids=str)
def test_the_room_is_found_in_every_direction_of_motion(positions, turn, reference_turn):
    view = seen(ROOM, positions, turn, reference_turn)
    off, theta = pixels_off(view), view.theta(coarse(view))
    clear = (theta > 15) & (theta < 165)
    assert np.median(off[clear]) < 0.35
    assert (off[clear] < 1.5).mean() > 0.85


def test_a_longer_reference_makes_it_finer():
    """Of a wall 10 m away, 0.3 m tell little."""
    alone, both = (seen(ROOM, FORWARD[:n]) for n in (1, 2))
    errors = [np.abs(swept(view) / view.rho(coarse(view)) - 1) for view in (alone, both)]
    theta = alone.theta(coarse(alone))
    clear = (theta > 15) & (theta < 165)
    assert np.median(errors[1][clear]) < 0.5 * np.median(errors[0][clear])


def test_what_is_too_near_for_the_long_reference_the_short_one_decides():
    ball = Ball(cell=0.3, radius=1.0)
    view = seen(ball, ((0, 0, -0.2), (0, 0, -0.8)))
    blind = [*view.pairs[:1], (np.full_like(view.pairs[1][0], 90), view.pairs[1][1])]
    found, _ = sweep(view.image, view.grid, view.axes, blind)
    middle = np.abs(view.theta(coarse(view)) - 90) < 60
    assert np.median(found[middle]) == pytest.approx(1.0, abs=0.1)


def test_brightness_and_contrast_of_a_reference_matter_little():
    view = seen()
    dimmed = [(np.clip(0.8 * image + 15, 0, 255).astype(np.uint8), pose)
              for image, pose in view.pairs]
    found, _ = sweep(view.image, view.grid, view.axes, dimmed)
    theta = view.theta(coarse(view))
    clear = (theta > 15) & (theta < 165)
    off = np.abs(found - view.rho(coarse(view))) * 1.2 / coarse(view).pixel
    assert np.median(off[clear]) < 0.4


@pytest.mark.parametrize('images', ['blank', 'noise'])
def test_where_nothing_can_be_told_there_is_still_a_value(images):
    rng, view = np.random.default_rng(0), seen()
    def image(shape: tuple[int, ...]) -> np.ndarray:
        return (np.full(shape, 90, np.uint8) if images == 'blank'
                else rng.integers(0, 256, shape, np.uint8))
    pairs = [(image(i.shape), pose) for i, pose in view.pairs]
    found, step = sweep(image(view.image.shape), view.grid, view.axes, pairs)
    assert np.isfinite(found).all()
    level = levels([pose.baseline for _, pose in pairs], coarse(view).pixel)
    assert step == pytest.approx(level[1] - level[0])
    assert found.min() >= level[0] - 1e-6
    assert found.max() <= level[-1] + 1e-6
