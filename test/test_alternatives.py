"""What else may be where something was measured."""
from __future__ import annotations

import cv2
import numpy as np
from test_refinement import BALL, seen

from sphstereo_ros.core.alternatives import alternatives, round_about
from sphstereo_ros.core.refinement import JointRefinement

SIZE, WIDE = 15 // 2, 31 // 2  # px that are round about, and more widely


def refinement_of(view):
    return JointRefinement(view.image, view.grid, view.axes, view.pairs)


def test_references_differ_least_where_things_are():
    view = seen()
    theta = view.theta()
    inside = (theta > 20) & (theta < 160)
    true, wrong = (refinement_of(view).agreement((view.rho() * s).astype(np.float32))
                   for s in (1, 1.4))
    for right, off in zip(true, wrong, strict=True):
        assert np.median(right[inside]) < 3
        assert np.median(off[inside]) > 3 * np.median(right[inside])
    assert (true[0] <= true[1]).all()


def test_of_the_references_the_one_that_fits_best_and_worst():
    view = seen()
    rho = (1.2 * view.rho()).astype(np.float32)
    each = [JointRefinement(view.image, view.grid, view.axes, [pair]).agreement(rho)[0]
            for pair in view.pairs]
    least, most = refinement_of(view).agreement(rho)
    np.testing.assert_allclose(least, np.minimum(*each), atol=1e-4)
    np.testing.assert_allclose(most, np.maximum(*each), atol=1e-4)
    assert np.mean(each[0] > each[1]) > 0.1
    assert np.mean(each[0] < each[1]) > 0.1


def test_nearest_and_farthest_round_about_without_specks():
    view = seen()
    rho = np.full(view.grid.shape, 0.2, np.float32)
    rho[100:, :] = 0.5
    rho[60, 60] = 9  # a speck
    found = alternatives(rho, refinement_of(view))
    assert (found.near.rho[50:70] == np.float32(0.2)).all()
    near, far, farther = 101 - SIZE, 99 + SIZE, 99 + WIDE  # a row at a rim is a speck as well
    part = np.s_[50:-50]  # away from the seam, where both meet again
    assert (found.near.rho[part][near - 50:] == np.float32(0.5)).all()
    assert (found.near.rho[part][:near - 50] == np.float32(0.2)).all()
    for rim, other in ((far, found.far), (farther, found.farther)):
        assert (other.rho[part][:rim - 50] == np.float32(0.2)).all()
        assert (other.rho[part][rim - 50:] == np.float32(0.5)).all()


def test_round_about_goes_on_beyond_the_seam():
    view = seen()
    grid, count = view.grid, 2 * view.grid.height
    rng = np.random.default_rng(0)
    inner = cv2.GaussianBlur(rng.uniform(0.1, 1, (count, grid.shape[1])).astype(np.float32),
                             (0, 0), 2)
    turn = count // 3

    def found(values: np.ndarray) -> list[np.ndarray]:
        rho = np.take(values, np.arange(-grid.wrap, count + grid.wrap), axis=0, mode='wrap')
        near, others = round_about(rho, grid, 15, (9, 31))
        return [m[grid.wrap:-grid.wrap] for m in (near, *others)]
    for straight, turned in zip(found(inner), found(np.roll(inner, turn, 0)), strict=True):
        np.testing.assert_array_equal(np.roll(straight, turn, 0), turned)


def test_each_is_compared_with_the_references():
    view, refinement = seen(), refinement_of(seen())
    rho = np.full(view.grid.shape, 1 / BALL.radius, np.float32)
    rho[:, view.grid.shape[1] // 2:] *= 1.5
    found = alternatives(rho, refinement)
    np.testing.assert_array_equal(found.measured.rho, rho)
    for other in (found.measured, found.near, found.far, found.farther):
        least, most = refinement.agreement(other.rho)
        np.testing.assert_array_equal(other.least, least)
        np.testing.assert_array_equal(other.most, most)
