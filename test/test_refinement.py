"""Joint refinement against exact ranges: inside a sphere, everything is equally far."""
from __future__ import annotations

from functools import cache

import cv2
import numpy as np
import pytest
from analytic_world import Ball, World
from polar_views import HEIGHT, PolarView, Vector, polar_view

from sphstereo_ros.core.camera import Equirectangular
from sphstereo_ros.core.refinement import NEAR_BY, JointRefinement, Refined
from sphstereo_ros.core.sphere import polar_bearings

RADIUS = 3.0
BALL = Ball(cell=0.27 * RADIUS, radius=RADIUS)
TWO: tuple[Vector, ...] = ((0, 0, -0.3), (0, 0, -1.2))
WINDOW = 9


@cache
def seen(positions: tuple[Vector, ...] = TWO, world: World = BALL,
         reference_turn: Vector = (0, 0, 0)) -> PolarView:
    return polar_view(world, positions, reference_turn=reference_turn)


def refined(view: PolarView, start: np.ndarray, steps: int = 1,
            pairs: list | None = None) -> Refined:
    refinement = JointRefinement(view.image, view.grid, view.axes, pairs or view.pairs)
    found = refinement.refined(start, WINDOW)
    for _ in range(steps - 1):
        found = refinement.refined(found.rho, WINDOW)
    return found


def errors(found: Refined, view: PolarView) -> np.ndarray:
    """Relative errors outside the cones round both poles, with their sign."""
    theta = view.theta()
    return (found.rho / view.rho() - 1)[(theta > 15) & (theta < 165)]


def off_by(view: PolarView, share: float) -> np.ndarray:
    return (view.rho() * (1 + share)).astype(np.float32)


def bearing_pixels(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Row and column of an equirectangular image where points (..., 3) are seen."""
    x, y, z = np.moveaxis(points, -1, 0)
    return ((np.arctan2(y, np.hypot(x, z)) / np.pi + 0.5) * HEIGHT,
            (np.arctan2(x, z) / np.pi + 1) * HEIGHT)


def changed(view: PolarView, **images: np.ndarray) -> list:
    """The pairs with some images replaced: n0 is that of the nearest reference."""
    return [(images.get(f'n{n}', image), pose) for n, (image, pose) in enumerate(view.pairs)]


@pytest.mark.parametrize('share', [-0.2, -0.05, 0.05, 0.2])
def test_it_converges_from_a_start_that_is_off(share):
    view = seen()
    once, thrice = (errors(refined(view, off_by(view, share), n), view) for n in (1, 3))
    assert np.median(np.abs(once)) < 0.25 * abs(share)
    assert np.median(np.abs(thrice)) < 0.003
    assert abs(np.median(thrice)) < 0.001
    assert (np.abs(thrice) < 0.02).mean() > 0.95


@pytest.mark.parametrize('positions', [
    ((0.3, 0, 0),), ((0, -0.3, 0),), ((0, 0, 0.3),), ((0.17, 0.1, -0.22),),
    ((0, 0, -0.3), (0.21, 0, -1.18)), ((0, 0, -0.3), (0, 0.9, -0.8), (-0.9, 0, -0.8))], ids=str)
def test_every_direction_of_motion_and_references_aside_of_it(positions):
    view = seen(positions, BALL, (0.1, 0.2, -0.1))
    found = errors(refined(view, off_by(view, 0.05), 2), view)
    # 0.3 m alone: a pixel is a fifth of the range
    assert np.median(np.abs(found)) < (0.015 if len(positions) == 1 else 0.004)
    assert abs(np.median(found)) < 0.002


def test_a_reference_far_aside_converges_as_fast():
    view = seen(((0, 0, -0.1), (0.9, 0.7, 0)))
    found = np.abs(errors(refined(view, off_by(view, 0.05)), view))
    assert np.median(found) < 0.013
    assert (found < 0.03).mean() > 0.8


def test_what_is_right_stays():
    view = seen()
    found = errors(refined(view, view.rho()), view)
    assert np.median(np.abs(found)) < 0.003
    assert abs(np.median(found)) < 0.0005


def test_the_long_reference_sharpens_what_the_short_one_finds():
    view = seen()
    alone, both = (np.median(np.abs(errors(refined(view, view.rho(), pairs=pairs), view)))
                   for pairs in (view.pairs[:1], view.pairs))
    assert both < 0.4 * alone


def test_a_reference_that_is_too_far_away_for_the_range_takes_no_part():
    view = seen(((0, 0, -0.3), (0, 0, -2.4)))  # 0.8 of the range
    noise = np.random.default_rng(0).integers(0, 256, view.pairs[0][0].shape, np.uint8)
    without = refined(view, view.rho(), pairs=view.pairs[:1])
    for pairs in (view.pairs, changed(view, n1=noise)):
        got = refined(view, view.rho(), pairs=pairs)
        same = np.isclose(got.rho, without.rho, rtol=1e-5)
        assert same.mean() > 0.999


@pytest.mark.parametrize('which', [0, 1, 3])
def test_a_reference_that_shows_something_else_is_left_out(which):
    """Something stands before a part of its view."""
    view = seen(tuple((0.0, 0.0, -0.3 * n) for n in (1, 2, 3, 4)))
    other = polar_view(Ball(cell=0.5, radius=1.1), ((0, 0, 0.3),)).current.image
    image, pose = view.pairs[which]
    hidden = image.copy()
    hidden[40:120, 20:100] = other[40:120, 20:100]
    points = RADIUS * polar_bearings(view.grid.theta()[None], view.grid.azimuth()[:, None],
                                     view.axes) - pose.position
    v, u = bearing_pixels(points)
    behind = (v > 45) & (v < 115) & (u > 25) & (u < 95)
    assert behind.mean() > 0.05
    clean, got = (np.abs(refined(view, off_by(view, 0.03), 2, pairs).rho * RADIUS - 1)[behind]
                  for pairs in (view.pairs, changed(view, **{f'n{which}': hidden})))
    assert np.median(got) < 2 * np.median(clean)
    assert (got > 0.03).mean() < (clean > 0.03).mean() + 0.02


def test_what_does_not_fit_has_no_say_at_all():
    view = seen()
    noise = np.random.default_rng(0).integers(0, 256, view.pairs[1][0].shape, np.uint8)
    start = off_by(view, 0.01)
    alone = refined(view, start, pairs=view.pairs[:1]).rho
    got = refined(view, start, pairs=changed(view, n1=noise)).rho
    clear = np.abs(view.theta() - 90) < 60
    assert np.isclose(got, alone, rtol=1e-6)[clear].mean() > 0.9


@pytest.mark.parametrize(('gain', 'offset'), [(0.6, 40), (1.3, -20), (1.0, 40)])
def test_exposure_of_the_references_changes_nothing(gain, offset):
    view = seen()
    narrow = PolarView(cv2.convertScaleAbs(view.image, alpha=0.5, beta=64), view.grid, view.axes,
                       [(cv2.convertScaleAbs(image, alpha=0.5 * gain, beta=54 + offset), pose)
                        for image, pose in view.pairs], view.current, view.world)
    found = errors(refined(narrow, off_by(view, 0.1), 3), view)
    assert np.median(np.abs(found)) < 0.005
    assert abs(np.median(found)) < 0.002


def test_a_blank_view_tells_nothing():
    view = seen()
    blank = PolarView(np.full_like(view.image, 90), view.grid, view.axes, [
        (np.full_like(i, 100), p) for i, p in view.pairs], view.current, view.world)
    found = refined(blank, off_by(view, 0.1))
    np.testing.assert_array_equal(found.information, 0)
    np.testing.assert_allclose(found.rho, off_by(view, 0.1), rtol=1e-6)


def test_information_adds_up_and_falls_with_contrast():
    view = seen()
    both, *each = (refined(view, view.rho(), pairs=pairs).information
                   for pairs in (view.pairs, view.pairs[:1], view.pairs[1:]))
    clear = np.abs(view.theta() - 90) < 60
    assert np.median((each[0] + each[1])[clear] / both[clear]) == pytest.approx(1, abs=0.01)
    faint = PolarView(cv2.convertScaleAbs(view.image, alpha=0.2, beta=90), view.grid, view.axes, [
        (cv2.convertScaleAbs(i, alpha=0.2, beta=90), p) for i, p in view.pairs],
        view.current, view.world)
    less = refined(faint, view.rho()).information
    assert np.median(less[clear]) < 0.2 * np.median(both[clear])


def test_light_that_changes_slowly_tells_nothing():
    """Vignetting, or the glare of the sun on a road: it goes with the camera."""
    view = seen()

    def lit(image: np.ndarray, bearings: np.ndarray) -> np.ndarray:
        return np.asarray(np.clip(0.06 * image + 120 + 110 * bearings[..., 2], 0, 255), np.uint8)
    image = view.pairs[0][0]
    sphere = Equirectangular(*image.shape).bearings()
    ahead = polar_bearings(view.grid.theta()[None], view.grid.azimuth()[:, None], view.axes)
    glare = PolarView(lit(view.image, ahead), view.grid, view.axes,
                      [(lit(i, sphere), p) for i, p in view.pairs], view.current, view.world)
    off = errors(refined(glare, off_by(view, 0.05)), view)
    assert np.median(np.abs(off)) < 0.02


def test_misfit_tells_what_does_not_fit():
    view = seen()
    right, wrong = (refined(view, off_by(view, share)).misfit for share in (0.0, 1.5))
    clear = np.abs(view.theta() - 90) < 60
    assert np.median(right[clear]) < 10  # noise of one level each, and resampling
    assert np.median(wrong[clear]) > 10 * np.median(right[clear])


UP: tuple[Vector, ...] = ((0, -0.35, 0),)
ROOM = World(posts=())  # floor and walls slant away


def slanted(window: int, wide: int = 0, averaged: bool = False, world: World = ROOM,
            noise: float = 0.0) -> np.ndarray:
    """Errors in px of one step from what is exact; noise in grey levels is added to both views."""
    view = seen(UP, world)
    rng = np.random.default_rng(3)
    image, reference = (np.clip(i + rng.normal(0, noise, i.shape), 0, 255).astype(np.uint8)
                        for i in (view.image, view.pairs[0][0]))
    refinement = JointRefinement(image, view.grid, view.axes, changed(view, n0=reference))
    found = refinement.refined(view.rho(), window) if averaged \
        else refinement.levelled(view.rho(), window, wide)
    inside = (view.theta() > 15) & (view.theta() < 165)
    pixel = view.grid.pixel / 0.35
    return np.abs(found.rho - view.rho())[inside] / pixel


def test_looking_changes_no_range_and_tells_what_a_step_from_there_would():
    view = seen()
    refinement = JointRefinement(view.image, view.grid, view.axes, view.pairs)
    rho = off_by(view, 0.1)
    looked, step = refinement.looked_at(rho, WINDOW), refinement.refined(rho, WINDOW)
    np.testing.assert_array_equal(looked.rho, rho)
    np.testing.assert_array_equal(looked.information, step.information)
    np.testing.assert_array_equal(looked.misfit, step.misfit)


def test_the_slope_of_a_surface_is_no_noise():
    assert np.median(slanted(15)) < 0.6 * np.median(slanted(15, averaged=True))


def test_a_wide_window_helps_in_noise():
    assert np.median(slanted(15, 25, noise=20)) < 0.95 * np.median(slanted(15, noise=20))


def test_a_wide_window_does_not_reach_over_rims():
    posts = World()
    narrow, both, wide = (np.mean(e > 0.5) for e in (
        slanted(15, world=posts), slanted(15, 41, world=posts), slanted(41, world=posts)))
    assert wide > 1.3 * narrow
    assert both < 1.1 * narrow


def test_levelled_converges_and_stays_where_nothing_is_told():
    view = seen(UP, World(low=(-2.5, -3, -3), high=(3, 1.6, 4), posts=()))
    refinement = JointRefinement(view.image, view.grid, view.axes, view.pairs)
    start = off_by(view, 0.05)
    once = refinement.levelled(start, 15)
    twice = refinement.levelled(once.rho, 15, 25)
    off = [np.median(np.abs(errors(found, view))) for found in (once, twice)]
    assert max(off) < 0.015
    blank = JointRefinement(np.full_like(view.image, 90), view.grid, view.axes,
                            [(np.full_like(view.pairs[0][0], 90), view.pairs[0][1])])
    np.testing.assert_allclose(blank.levelled(start, 15, 25).rho, start, rtol=1e-4)


def test_adapted_is_levelled_near_by_and_averaged_far_away():
    baseline = 0.1
    view = seen(((0, 0, -baseline),), ROOM)
    refinement = JointRefinement(view.image, view.grid, view.axes, view.pairs)
    start = off_by(view, 0.02)
    far, near = refinement.refined(start, 21).rho, refinement.levelled(start, 15, 25).rho
    slanted = far > 1 / (NEAR_BY * baseline)
    assert 0.1 < slanted.mean() < 0.9
    np.testing.assert_array_equal(refinement.adapted(start, 21, (15, 25)).rho,
                                  np.where(slanted, near, far))
