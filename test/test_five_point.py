from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from two_views import MOTIONS, random_rotation, two_views, unit

from sphstereo_ros.core import rotations
from sphstereo_ros.core.five_point import decompose, essential_matrices


def essential(rotation: np.ndarray, position: np.ndarray) -> np.ndarray:
    e = rotations.skew(position) @ rotation
    return e / np.linalg.norm(e)


def distance(solutions: np.ndarray, true: np.ndarray) -> float:
    """Of the nearest of the solutions; the sign of E means nothing."""
    return min((float(min(np.abs(s - true).max(), np.abs(s + true).max())) for s in solutions),
               default=np.inf)


@pytest.mark.parametrize('motion', MOTIONS)
@pytest.mark.parametrize('angle', [0.0, 0.03, 1.0, 3.0])
def test_the_true_motion_is_among_the_solutions(motion, angle):
    """Also of motions along an axis without rotation, where much of E is zero."""
    rng = np.random.default_rng(3)
    position = unit(MOTIONS[motion])
    rotation = random_rotation(rng, angle)
    for _ in range(40):
        found = essential_matrices(*two_views(rng, (1, 5), rotation, position))
        assert 1 <= len(found) <= 10
        assert distance(found, essential(rotation, position)) < 1e-6


@given(st.integers(0, 2**32 - 1))
@settings(deadline=None, max_examples=50)
def test_solutions_fit_the_sample_and_are_essential_matrices(seed):
    """E has the singular values s, s, 0, so 2EEᵀE = tr(EEᵀ)E and det E = 0."""
    rng = np.random.default_rng(seed)
    reference, current = unit(rng.normal(size=(2, 1, 5, 3)))  # any five pairs, of no motion at all
    for e in essential_matrices(reference, current):
        assert np.linalg.norm(e) == pytest.approx(1.0)
        np.testing.assert_allclose(np.einsum('ka,ab,kb->k', current[0], e, reference[0]), 0,
                                   atol=1e-9)
        assert abs(np.linalg.det(e)) < 1e-5
        np.testing.assert_allclose(2 * e @ e.T @ e - np.trace(e @ e.T) * e, 0, atol=1e-5)


def test_many_samples_at_once_give_what_each_gives():
    rng = np.random.default_rng(1)
    reference, current = two_views(rng, (20, 5), random_rotation(rng, 0.5), unit([1, 2, 3]))
    together = essential_matrices(reference, current)
    apart = [essential_matrices(reference[i:i + 1], current[i:i + 1]) for i in range(20)]
    assert len(together) == sum(map(len, apart))
    for e in np.concatenate(apart):
        assert distance(together, e) < 1e-6


def test_degenerate_samples_spoil_no_other():
    rng = np.random.default_rng(2)
    rotation, position = random_rotation(rng, 0.2), unit([1, -1, 2])
    reference, current = two_views(rng, (4, 5), rotation, position)
    reference[1], current[1] = reference[1, :1], current[1, :1]  # five times the same point
    reference[2, 3], current[2, 3] = reference[2, 1], current[2, 1]  # one point twice
    found = essential_matrices(reference, current)
    for i in (0, 3):
        for e in essential_matrices(reference[i:i + 1], current[i:i + 1]):
            assert distance(found, e) < 1e-9
    assert np.isfinite(found).all()
    assert essential_matrices(reference[:0], current[:0]).shape == (0, 3, 3)


@given(st.integers(0, 2**32 - 1), st.floats(0, np.pi))
@settings(deadline=None)
def test_one_of_the_four_decompositions_is_the_motion(seed, angle):
    rng = np.random.default_rng(seed)
    rotation, position = random_rotation(rng, angle), unit(rng.normal(size=3))
    e = essential(rotation, position)
    four = decompose(e)
    assert len(four) == 4
    for r, p in four:
        np.testing.assert_allclose(r @ r.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(r) == pytest.approx(1.0)
        assert np.linalg.norm(p) == pytest.approx(1.0)
        assert distance(np.array([essential(r, p)]), e) < 1e-12
    assert min(np.abs(r - rotation).max() + np.abs(p - position).max() for r, p in four) < 1e-9
    assert len({tuple(np.round(np.concatenate([r.ravel(), p]), 6)) for r, p in four}) == 4
