"""Near rims, each pixel chooses the surface that it shows."""
from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from analytic_world import World
from polar_views import PolarView, polar_view

from sphstereo_ros.core import joint
from sphstereo_ros.core.joint import JointMatcher
from sphstereo_ros.core.refinement import JointRefinement
from sphstereo_ros.core.rims import own_surface

POSITIONS = ((0.0, 0.0, -0.2), (0.0, 0.0, -3.0))
FAR, NEAR, BETWEEN, NEAR_BY = 40.0, 17.0, 10.0, 6.0  # m


def posts(distance: float, radius: float = 0.15) -> World:
    """Posts round the camera, in a room that is wider; radius : a share of the distance."""
    angles = np.radians(np.arange(30, 360, 40))
    return World(cell=2.0, low=(-FAR, -FAR, -FAR), high=(FAR, FAR, FAR), posts=tuple(
        (float(distance * np.sin(a)), float(distance * np.cos(a)), radius * distance)
        for a in angles))


def chosen(view: PolarView, rho: np.ndarray, pairs: list | None = None) -> np.ndarray:
    pairs = pairs or view.pairs
    return own_surface(rho, JointRefinement(view.image, view.grid, view.axes, pairs))


def seen_from_the_side(view: PolarView) -> np.ndarray:
    return np.abs(view.theta() - 90) < 60


@pytest.fixture(scope='module')
def fattened() -> tuple[PolarView, np.ndarray, np.ndarray]:
    """A view, its exact inverse range, and that with what is nearer two pixels wider."""
    view = polar_view(posts(NEAR), POSITIONS)
    exact = view.rho()
    return view, exact, cv2.dilate(exact, np.ones((5, 5), np.uint8))


def test_what_lies_behind_a_rim_gets_its_own_range_back(fattened):
    view, exact, wide = fattened
    rim = seen_from_the_side(view) & (wide > 1.3 * exact)
    assert rim.mean() > 0.02
    found = chosen(view, wide)
    right = np.abs(found / exact - 1) < 0.1
    assert right[rim].mean() > 0.55
    assert right[seen_from_the_side(view) & (wide < 1.05 * exact)].mean() > 0.97


def test_what_is_right_stays(fattened):
    view, exact, _ = fattened
    found = chosen(view, exact)
    assert (np.abs(found / exact - 1) < 0.1)[seen_from_the_side(view)].mean() > 0.97


def blank(view: PolarView) -> PolarView:
    grey = np.full_like(view.pairs[0][0], 128)
    return replace(view, image=np.full_like(view.image, 128),
                   pairs=[(grey, pose) for _, pose in view.pairs])


def test_where_nothing_is_seen_no_neighbour_makes_farther():
    view = polar_view(posts(BETWEEN), POSITIONS)
    exact = view.rho()
    found = chosen(blank(view), exact)
    assert (found >= exact).all()


@pytest.mark.parametrize('distance', [BETWEEN, NEAR_BY])
@pytest.mark.parametrize('contrast', [0.15, 0.4])
def test_thin_things_of_little_contrast_stay(contrast, distance):
    view = polar_view(posts(distance, 0.06), POSITIONS)
    rng = np.random.default_rng(0)

    def dull(image: np.ndarray) -> np.ndarray:
        grey = 128 + contrast * (image - 128.0) + rng.normal(0, 1, image.shape)
        return np.clip(grey, 0, 255).astype(np.uint8)
    view = replace(view, image=dull(view.image), pairs=[(dull(i), p) for i, p in view.pairs])
    exact = view.rho()
    post = seen_from_the_side(view) & (exact * 15.9 > 1)
    assert 0.02 < post.mean() < 0.3
    assert (chosen(view, exact) < exact / 1.25)[post].mean() < 0.03


def test_a_reference_that_shows_nothing_does_no_harm(fattened):
    """A reference without contrast shows nothing that could be compared."""
    view, exact, wide = fattened
    pairs = [*view.pairs, (np.full_like(view.pairs[0][0], 128), view.pairs[1][1])]
    rim = seen_from_the_side(view) & (wide > 1.3 * exact)
    right = np.abs(chosen(view, wide, pairs) / exact - 1) < 0.1
    assert right[rim].mean() > 0.55


def test_the_difference_is_the_mean_share_of_what_references_may_differ(fattened):
    """One that shows something else does no more than that; one that shows nothing, nothing."""
    view, _, wide = fattened

    def difference(pairs: list) -> np.ndarray:
        compared = JointRefinement(view.image, view.grid, view.axes, pairs).compared(wide)
        return compared.difference(wide, 2.0)
    one, two = (difference([pair]) for pair in view.pairs)
    noise = np.random.default_rng(0).integers(0, 255, view.pairs[0][0].shape, np.uint8)
    other = (noise, view.pairs[1][1])
    three = difference([other])
    np.testing.assert_allclose(difference([*view.pairs, other]), (one + two + three) / 3,
                               atol=1e-3)
    assert np.median(one) < np.median(three) < 60 / 68
    nothing = (np.full_like(noise, 128), view.pairs[1][1])
    np.testing.assert_allclose(difference([*view.pairs, nothing]), (one + two) / 2, atol=1e-3)


def test_the_matcher_puts_pixels_to_their_own_surface(fattened, monkeypatch):
    view, exact, wide = fattened
    refinement = JointRefinement(view.image, view.grid, view.axes, view.pairs)
    known = refinement.refined(wide, 9)
    matcher = JointMatcher('joint', lambda *_: pytest.fail('nothing to be matched'))
    rim = seen_from_the_side(view) & (wide > 1.3 * exact)
    sharp = matcher._sharpened(refinement, view.pairs, known)
    found = sharp.rho
    np.testing.assert_array_equal(sharp.misfit, refinement.looked_at(found, 9).misfit)
    monkeypatch.setattr(joint, 'own_surface', lambda rho, _: rho)
    before = matcher._sharpened(refinement, view.pairs, known).rho
    right, without = ((np.abs(rho / exact - 1) < 0.1)[rim].mean() for rho in (found, before))
    assert right > without + 0.05
    np.testing.assert_array_equal(found, own_surface(before, refinement))
