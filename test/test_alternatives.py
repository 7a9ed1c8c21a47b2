"""What else may be where something was measured."""
from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from analytic_world import World
from polar_views import polar_view
from test_refinement import BALL, seen

from sphstereo_ros.core.alternatives import alternatives, round_about
from sphstereo_ros.core.refinement import JointRefinement

SIZE, WIDE = 15 // 2, 31 // 2  # px that are round about, and more widely


def refinement_of(view):
    return JointRefinement(view.image, view.grid, view.axes, view.pairs)


def compared_of(view):
    return refinement_of(view).compared(view.rho())


def test_references_differ_least_where_things_are():
    view = seen()
    theta = view.theta()
    inside = (theta > 20) & (theta < 160)
    true, wrong = (compared_of(view).agreement((view.rho() * s).astype(np.float32))
                   for s in (1, 1.4))
    for name in ('least', 'typical', 'most'):
        right, off = getattr(true, name), getattr(wrong, name)
        assert np.median(right[inside]) < 3
        assert np.median(off[inside]) > 3 * np.median(right[inside])
    assert (true.least <= true.typical + 1e-4).all()
    assert (true.typical <= true.most + 1e-4).all()


def test_the_truth_looks_better_than_what_was_measured_wrong():
    """The light is that of what was measured, but takes no more than what changes slowly."""
    view = seen()
    theta = view.theta()
    inside = (theta > 20) & (theta < 160)
    wrong = (1.4 * view.rho()).astype(np.float32)
    compared = refinement_of(view).compared(wrong)
    there, measured = (compared.agreement(rho).least[inside] for rho in (view.rho(), wrong))
    assert np.median(there) < 0.75 * np.median(measured)


def test_of_the_references_the_one_that_fits_best_and_worst():
    view = seen()
    rho = (1.2 * view.rho()).astype(np.float32)
    each = [compared_of(replace(view, pairs=[pair])).agreement(rho).least for pair in view.pairs]
    found = compared_of(view).agreement(rho)
    np.testing.assert_allclose(found.least, np.minimum(*each), atol=1e-4)
    np.testing.assert_allclose(found.most, np.maximum(*each), atol=1e-4)
    assert np.mean(each[0] > each[1]) > 0.1
    assert np.mean(each[0] < each[1]) > 0.1


def test_references_in_another_light_show_the_same():
    """Of more contrast, and brighter to one side."""
    view = seen()
    image, pose = view.pairs[0]
    shade = np.linspace(0, 40, image.shape[1])
    other = np.clip(0.6 * image + shade, 0, 255).astype(np.uint8)
    lit = replace(view, pairs=[(other, pose), *view.pairs[1:]])
    theta = view.theta()
    inside = (theta > 20) & (theta < 160)
    plain, found = (compared_of(v).agreement(view.rho()).typical[inside] for v in (view, lit))
    assert np.median(found) < np.median(plain) + 1


@dataclass(frozen=True)
class BrightPosts(World):
    """A dim room with posts that are bright."""

    def brightness(self, points: np.ndarray) -> np.ndarray:
        dim = 60 + 0.2 * super().brightness(points)
        for x, z, radius in self.posts:
            near = np.hypot(points[..., 0] - x, points[..., 2] - z) < 1.01 * radius
            dim = np.where(near, 220.0, dim)
        return dim


def test_what_stands_beside_changes_no_light():
    """At the true range of what is seen beside bright posts, nothing differs, though the posts
    themselves are supposed to lie as far.
    """
    angles = np.radians(np.arange(30, 360, 40))
    world = BrightPosts(cell=2.0, low=(-20.0,) * 3, high=(20.0,) * 3, posts=tuple(
        (float(6 * np.sin(a)), float(6 * np.cos(a)), 0.2) for a in angles))
    view = polar_view(world, ((0.0, 0.0, -0.3), (0.0, 0.0, 0.3)))
    posts = (view.rho() > 1 / 8).astype(np.uint8)
    behind = cv2.erode(view.rho(), np.ones((25, 25), np.uint8))
    wide, narrow = (cv2.dilate(posts, np.ones((n, n), np.uint8)) > 0 for n in (9, 5))
    beside = wide & ~narrow
    assert beside.mean() > 0.02
    least = compared_of(view).agreement(behind).least
    assert np.median(least[beside]) < 3


def test_nearest_and_farthest_round_about_without_specks():
    view = seen()
    rho = np.full(view.grid.shape, 0.2, np.float32)
    rho[100:, :] = 0.5
    rho[60, 60] = 9  # a speck
    nearest, (far_by, farther_by) = round_about(rho, view.grid, 15, (15, 31))
    assert (nearest[50:70] == np.float32(0.2)).all()
    near, far, farther = 101 - SIZE, 99 + SIZE, 99 + WIDE  # a row at a rim is a speck as well
    part = np.s_[50:-50]  # away from the seam, where both meet again
    assert (nearest[part][near - 50:] == np.float32(0.5)).all()
    assert (nearest[part][:near - 50] == np.float32(0.2)).all()
    for rim, other in ((far, far_by), (farther, farther_by)):
        assert (other[part][:rim - 50] == np.float32(0.2)).all()
        assert (other[part][rim - 50:] == np.float32(0.5)).all()


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
    swept = np.full_like(rho, 1.2 / BALL.radius)
    found, compared = alternatives(rho, swept, refinement), refinement.compared(rho)
    near, farthest = round_about(rho, view.grid, 15, (15, 31))
    np.testing.assert_array_equal(found.measured.rho, rho)
    np.testing.assert_array_equal(found.near.rho, near)
    np.testing.assert_array_equal(found.swept.rho, swept)
    for other, start in zip((found.far, found.farther), farthest, strict=True):
        np.testing.assert_array_equal(other.rho, refinement.refined(start, 21).rho)
    for other in vars(found).values():
        for name, value in vars(compared.agreement(other.rho)).items():
            np.testing.assert_array_equal(getattr(other.agreement, name), value)


def test_the_farthest_is_refined():
    """Of ranges that err to both sides, the farthest err most: beside the truth they are off."""
    view = seen()
    theta = view.theta()
    inside = (theta > 40) & (theta < 140)
    noise = np.random.default_rng(0).uniform(0.9, 1.1, view.grid.shape)
    rho = cv2.GaussianBlur((view.rho() * noise).astype(np.float32), (0, 0), 1)
    found = alternatives(rho, rho, refinement_of(view))
    _, starts = round_about(rho, view.grid, 15, (15, 31))
    for other, start in zip((found.far, found.farther), starts, strict=True):
        before, now = (np.median(np.abs(m / view.rho() - 1)[inside]) for m in (start, other.rho))
        assert now < 0.5 * before


def test_a_difference_is_typical_of_all_references():
    """A harmonic mean of a kind: of 0 and 8 grey levels 2.67; a large one counts little more."""
    view = seen()
    rho = (1.2 * view.rho()).astype(np.float32)
    each = [compared_of(replace(view, pairs=[pair])).agreement(rho).least for pair in view.pairs]
    share = np.mean([e / (e + 8) for e in each], axis=0)
    found = compared_of(view).agreement(rho)
    np.testing.assert_allclose(found.typical, 8 * share / (1 - share), rtol=1e-3, atol=1e-3)
    rows, columns = (n // 2 for n in rho.shape)
    half = cv2.GaussianBlur(cv2.resize(share, (columns, rows), interpolation=cv2.INTER_AREA),
                            (0, 0), 1)
    np.testing.assert_allclose(found.around, 8 * half / (1 - half), rtol=1e-3, atol=1e-3)
