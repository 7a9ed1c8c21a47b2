"""The guided sweep: what is known so far made sharper, against exact ranges."""
from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import pytest
from analytic_world import Ball, World
from hypothesis import given, settings
from hypothesis import strategies as st
from polar_views import PolarView, polar_view

from sphstereo_ros.core.frames import RelativePose
from sphstereo_ros.core.guided_sweep import _fine_levels, _nearest, guided_sweep, planes
from sphstereo_ros.core.joint import JointMatcher
from sphstereo_ros.core.refinement import JointRefinement
from sphstereo_ros.core.sweep import MOST_LEVELS
from sphstereo_ros.core.warp import PolarGrid

ROOM = World()
NEAR_AND_FAR = ((0, 0, -0.3), (0, 0, -0.8), (0, 0, -1.2))


@dataclass(frozen=True)
class Posts(World):
    """Posts before walls twice as far away."""

    posts: tuple[tuple[float, float, float], ...] = (
        (2.0, 1.0, 0.15), (2.2, -1.0, 0.15), (-2.0, 1.2, 0.15), (-2.1, -1.2, 0.15))


def half(view: PolarView) -> PolarGrid:
    return PolarGrid(view.grid.height // 2, view.grid.margin // 2, view.grid.wrap // 2)


def clear(view: PolarView, grid: PolarGrid) -> np.ndarray:
    theta = view.theta(grid)
    return (theta > 25) & (theta < 155)


def swept(view: PolarView, known: np.ndarray) -> np.ndarray:
    return guided_sweep(view.image, view.grid, view.axes, view.pairs, known).rho


def wrong(found: np.ndarray, truth: np.ndarray) -> np.ndarray:
    return np.abs(found / truth - 1) > 0.1


def fattened(rho: np.ndarray, size: int = 13) -> np.ndarray:
    """What is near reaches over its rim, as windows see it."""
    return cv2.dilate(rho, np.ones((size, size), np.uint8))


@pytest.fixture(scope='module')
def posts() -> PolarView:
    return polar_view(Posts(cell=0.5), NEAR_AND_FAR)


def test_what_reaches_over_a_rim_is_put_right(posts):
    truth = posts.rho()
    known = fattened(truth)
    changed = (np.abs(known / truth - 1) > 0.3) & clear(posts, posts.grid)
    assert changed.sum() > 2000
    found = cv2.resize(swept(posts, known), truth.shape[::-1])
    assert wrong(found, truth)[changed].mean() < 0.5
    fine = clear(posts, posts.grid)
    assert wrong(found, truth)[fine].mean() < 0.5 * wrong(known, truth)[fine].mean()


def test_a_matcher_has_sharper_rims_than_its_windows(posts):
    truth, grid = posts.rho(), posts.grid
    rim = (fattened(truth) > 1.3 * truth) & clear(posts, grid)
    refinement = JointRefinement(posts.image, grid, posts.axes, posts.pairs)
    known = refinement.refined(refinement.refined(fattened(truth), 9).rho, 9)
    matcher = JointMatcher('joint', lambda *_: pytest.fail('nothing to be matched'))
    found = matcher._sharpened(refinement, posts.pairs, known)
    assert wrong(found.rho, truth)[rim].mean() < 0.7 * wrong(known.rho, truth)[rim].mean()


@pytest.mark.parametrize('part', [0.85, 1.15])
def test_it_is_sharper_than_what_is_known(part):
    """Slanted walls and floor; what is known is off by 15 in a hundred."""
    view = polar_view(ROOM, NEAR_AND_FAR)
    truth = view.rho(half(view))
    found = swept(view, np.float32(part) * view.rho())
    error = np.abs(found / truth - 1)[clear(view, half(view))]
    assert np.median(error) < 0.03


def test_a_reference_that_shows_something_else_does_no_harm(posts):
    rng = np.random.default_rng(0)
    truth, fine = posts.rho(half(posts)), clear(posts, half(posts))
    (near, a), (middle, b), (far, c) = posts.pairs
    other = rng.integers(0, 255, middle.shape, np.uint8)
    right, disturbed = (
        (~wrong(guided_sweep(posts.image, posts.grid, posts.axes, pairs, posts.rho()).rho,
                truth))[fine].mean()
        for pairs in ([(near, a), (far, c)], [(near, a), (other, b), (far, c)]))
    assert right > 0.8
    assert disturbed > right - 0.05


def test_blank_pictures_keep_what_is_known():
    view = polar_view(Ball(), NEAR_AND_FAR)
    grey = np.full_like(view.image, 90)
    pairs = [(np.full_like(image, 90), pose) for image, pose in view.pairs]
    found = guided_sweep(grey, view.grid, view.axes, pairs, view.rho())
    inside = clear(view, half(view))
    assert (np.abs(found.rho - 1 / 3) < 2 * found.step)[inside].all()


def test_planes_are_found_and_what_bends_is_not():
    row, column = np.mgrid[:80, :100].astype(np.float32)
    plane = 20 + 0.5 * column - 0.25 * row
    inner = np.s_[12:-12, 12:-12]
    assert np.array_equal(planes(plane)[inner], np.rint(plane).astype(np.int32)[inner])
    step = np.where(column < 50, 20, 60).astype(np.float32)
    assert (planes(step)[20:60, 42:58] == 10000).all()
    assert (planes(step)[20:60, 13:37] == 20).all()


@settings(deadline=None)
@given(st.lists(st.floats(0.02, 30.0), min_size=1, max_size=10), st.integers(16, 2048),
       st.floats(0.01, 10.0))
def test_levels_get_coarser_before_the_nearest_are_left_out(baselines, height, nearest):
    found = _fine_levels(baselines, np.pi / height, nearest)
    assert 3 <= len(found) < MOST_LEVELS
    assert found[-1] >= min(nearest, 0.93 / min(baselines))


def test_what_is_near_is_found_where_it_is_known_to_be_far():
    world = Posts(cell=0.25, posts=((0.8, 0.0, 0.2), (-0.8, 0.1, 0.2)))
    view = polar_view(world, ((0, 0, -0.3), (0, 0, -0.6)))
    truth = view.rho(half(view))
    near = clear(view, half(view)) & (truth > 0.8)
    found = swept(view, np.full_like(view.rho(), 0.2))
    assert near.mean() > 0.02
    assert wrong(found, truth)[near].mean() < 0.25


def test_what_is_nearer_than_all_levels_stays_where_it_is_known_to_be(posts):
    view, known = posts, posts.rho().copy()
    known[40:44] = 2.0  # two pixels wide at half size: too narrow to ask for levels
    found = guided_sweep(view.image, view.grid, view.axes, view.pairs, known).rho
    assert _nearest(known[::2, ::2], view.pairs[0][1].baseline) < 1.9
    np.testing.assert_allclose(found[20:22], 2.0)


def test_the_number_of_threads_does_not_matter(monkeypatch):
    rng = np.random.default_rng(5)
    image = rng.integers(0, 255, (256, 512), np.uint8)
    grid = PolarGrid(256, 8, 8)
    view = rng.integers(0, 255, grid.shape, np.uint8)
    pairs = [(image, RelativePose(np.eye(3), np.array([0.0, 0.0, -b]))) for b in (0.28, 1.1)]
    results = []
    for threads in (1, 2, 5):
        monkeypatch.setattr('sphstereo_ros.core.jit._threads', lambda threads=threads: threads)
        results.append(guided_sweep(view, grid, np.eye(3), pairs,
                                    np.full(grid.shape, 0.1, np.float32)).rho)
    np.testing.assert_array_equal(results[0], results[1])
    np.testing.assert_array_equal(results[0], results[2])
