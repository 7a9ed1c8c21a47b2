"""What was not measured, or is likelier otherwise, is completed."""
from __future__ import annotations

import numpy as np
import pytest
from test_reliability import BASELINES, GRID, found, others_of

from sphstereo_ros.core import judgement
from sphstereo_ros.core.frames import Image8
from sphstereo_ros.core.judgement import Found, Judged, by_looks
from sphstereo_ros.core.refinement import Refined
from sphstereo_ros.core.reliability import LEAST

RHO = 0.5  # 1/m, measured
GUESS = 0.4
PIXEL = GRID.pixel / np.maximum(np.abs(np.sin(GRID.theta())), 0.02)  # rad across the motion
THETA = GRID.theta()


def shift(baseline: float) -> np.ndarray:
    """px of parallax of what is completed, of a reference so far away."""
    return (THETA - np.arctan2(np.sin(THETA), np.cos(THETA) + GUESS * baseline)) / GRID.pixel


SHIFT = shift(BASELINES[0])
SEEN = SHIFT > 1.1
VIEW = np.full(GRID.shape, 100, np.uint8)


def judged_with(monkeypatch, likely: float, completed: float, nearer: float = 0.01,
                misfit: float = 1, pictures: tuple[Image8, Image8] = (VIEW, VIEW),
                amid: float = 0.01, guess: float = GUESS,
                baselines: tuple[float, float] = BASELINES, seen: np.ndarray = SEEN) -> Judged:
    """Likely errors of what is measured and of what is completed, and by how much that may be
    nearer, in units: what is judged of every second row, of the columns `seen`. Of those amid,
    nothing is likelier than what was measured, with a likely error of `amid`.
    """
    shape = GRID.shape
    rho = np.full(shape, RHO, np.float32)

    def told(*errors: float) -> np.ndarray:
        logarithms = np.log(np.array([*errors, *errors[-1:] * (3 - len(errors))]) + LEAST)
        found = np.broadcast_to(logarithms[:, None, None], (3, *shape)).astype(np.float32)
        found[:, ::2] = np.log(amid + LEAST)
        return found
    small, large = (np.log(0.1 + r * baselines[0] / PIXEL) for r in (RHO, guess))
    larger = np.broadcast_to(large - small, (2, *shape)).astype(np.float32)
    _, _, _, matched, parallax = found(np.random.default_rng(0))
    fits = np.where(np.arange(shape[0])[:, None] % 2, misfit, 1) + np.zeros(shape)
    refined = Refined(rho, np.full(shape, 1e9, np.float32), fits.astype(np.float32))
    monkeypatch.setattr(judgement, 'percentiles', lambda *_: (told(likely), rho))
    own = np.arange(7)[:, None, None] == 4  # of what may be chosen, the network's own range
    monkeypatch.setattr(judgement, 'judged', lambda *_: np.concatenate([
        told(likely), larger, told(completed, completed, nearer),
        np.broadcast_to(own, (7, *shape)).astype(np.float32)]))
    judged = by_looks(Found(VIEW, *pictures, refined, rho, matched, parallax),
                      others_of(refined), GRID, baselines)
    nowhere = (shift(baselines[0]) < 0.8) & ((nearer > 0.4) | (shift(baselines[1]) < 3))
    assert (judged.rho == RHO)[1::2, nowhere].all()
    return Judged(*(m[1::2, seen] for m in (judged.rho, judged.other, judged.error,
                                            judged.frames)), wider=judged.wider[:, 1::2, seen])


@pytest.mark.parametrize(('likely', 'completed', 'taken'), [
    (0.5, 0.02, True), (0.9, 0.02, True), (0.01, 0.02, False), (0.9, 0.9, False)])
def test_the_likelier_stands(monkeypatch, likely, completed, taken):
    judged = judged_with(monkeypatch, likely, completed)
    np.testing.assert_allclose(judged.rho, GUESS if taken else RHO, rtol=1e-3)
    if taken:
        assert (judged.frames == 1).all()
        error = completed * np.maximum(GUESS, PIXEL / BASELINES[1])[SEEN]
        np.testing.assert_allclose(judged.error, np.broadcast_to(error, judged.rho.shape),
                                   rtol=0.05)


@pytest.mark.parametrize('taken', [True, False])
def test_what_is_passed_over_is_told_with_both_errors(monkeypatch, taken):
    likely, completed, nearer = 0.5 if taken else 0.01, 0.02, 0.03
    wider = judged_with(monkeypatch, likely, completed, nearer).wider
    unit = np.maximum(GUESS, PIXEL / BASELINES[1])[SEEN]
    of = ((RHO, RHO * np.full(3, likely)[:, None]),
          (GUESS, unit * np.array([completed, completed, nearer])[:, None]))
    (_, its), (other, others) = of[::-1] if taken else of
    np.testing.assert_allclose(wider[3], other, rtol=1e-3)
    np.testing.assert_allclose(wider[:3, 0], its + 0 * unit, rtol=1e-3)
    np.testing.assert_allclose(wider[4:, 0], others + 0 * unit, rtol=1e-3)


@pytest.mark.parametrize(('guess', 'taken'), [(0.98, False), (1.02, False), (0.94, True)])
def test_what_is_nearly_the_same_stays_as_it_was_measured(monkeypatch, guess, taken):
    judged = judged_with(monkeypatch, 0.5, 0.02, guess=guess * RHO)
    np.testing.assert_allclose(judged.rho, guess * RHO if taken else RHO, rtol=1e-3)


def test_where_nothing_shows_the_same_it_is_not_measured_but_completed(monkeypatch):
    assert (judged_with(monkeypatch, 0.01, 0.02, misfit=300).frames == 1).all()
    assert (judged_with(monkeypatch, 0.01, 0.9, misfit=300).frames == 0).all()


def test_what_may_be_much_nearer_is_not_completed(monkeypatch):
    judged = judged_with(monkeypatch, 0.9, 0.02, nearer=2)
    np.testing.assert_array_equal(judged.rho, np.float32(RHO))
    assert (judged.frames <= 0).all()


@pytest.mark.parametrize(('differs', 'nearer', 'taken'), [
    (3, 0.01, True), (-3, 0.5, True), (12, 0.3, True), (-12, 0.5, False), (20, 0.01, False),
    (-20, 0.01, False)])
def test_what_the_reference_contradicts_is_not_completed(monkeypatch, differs, nearer, taken):
    """Less of a contradiction is enough where something may be nearer."""
    there = np.full_like(VIEW, 100 + differs)
    judged = judged_with(monkeypatch, 0.9, 0.02, nearer, pictures=(VIEW, there),
                         seen=SEEN & (shift(BASELINES[1]) > 4.5))
    assert (judged.frames == (1 if taken else 0)).all()


def test_the_reference_is_asked_where_it_would_be_seen(monkeypatch):
    """A ramp of grey, that in the reference lies where the parallax takes it."""
    column = np.arange(GRID.shape[1])
    at = column - SHIFT
    sphere = slice(GRID.margin, -GRID.margin)  # beyond it, angles run back
    ramp, moved = (np.broadcast_to(np.rint(r), GRID.shape).astype(np.uint8)
                   for r in (3 * column, np.interp(column, at[sphere], 3 * column[sphere])))
    inside = np.sin(THETA)[SEEN] > 0.95
    for there, taken in ((moved, 1), (ramp, 0)):
        judged = judged_with(monkeypatch, 0.9, 0.02, nearer=0.5, pictures=(ramp, there))
        assert (judged.frames[:, inside] == taken).all()


def test_what_the_nearest_reference_could_not_show_is_not_completed(monkeypatch):
    """With less than a pixel of parallax it shows the same whatever is there (see judged_with)."""
    assert 0 < SEEN.mean() < (SHIFT > 0.8).mean() < 1
    assert (judged_with(monkeypatch, 0.9, 0.02).frames == 1).all()


@pytest.mark.parametrize(('nearer', 'taken'), [(0.01, True), (0.3, True), (0.5, False)])
def test_it_is_enough_if_the_farthest_reference_shows_it_unless_it_may_be_near(
        monkeypatch, nearer, taken):
    baselines = (0.08, BASELINES[1])
    shown = (shift(baselines[1]) > 4.5) & (np.sin(THETA) > 0.1)
    assert shown.any()
    assert (shift(baselines[0])[shown] < 0.8).all()
    judged = judged_with(monkeypatch, 0.9, 0.02, nearer, baselines=baselines, seen=shown)
    assert (judged.frames == (1 if taken else 0)).all()


def test_where_nothing_is_known_round_about_nothing_is_completed(monkeypatch):
    assert (judged_with(monkeypatch, 0.9, 0.02).frames == 1).all()
    assert (judged_with(monkeypatch, 0.9, 0.02, amid=0.9).frames == 0).all()
