"""How far a measurement errs, by its looks."""
from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from sphstereo_ros.bench.reliability import HIDDEN, Fit, Samples, fit
from sphstereo_ros.core import judgement
from sphstereo_ros.core.alternatives import Alternative, Alternatives
from sphstereo_ros.core.judgement import Found, by_looks
from sphstereo_ros.core.matching import UNKNOWN, Parallax, stereo_grid
from sphstereo_ros.core.refinement import Agreement, Refined
from sphstereo_ros.core.reliability import (
    LEAST,
    LOOKS,
    Network,
    expected_error,
    look,
    looks_at,
    may_be_near,
    network,
    percentiles,
)

GRID = stereo_grid(64)
BASELINES = (0.3, 1.2)


def found(rng: np.random.Generator, scale: float = 1.0):
    """A measurement of a world `scale` times as large: view, refined, other, matched, parallax."""
    shape = GRID.shape
    rho = rng.uniform(0.02, 1, shape).astype(np.float32)
    other = (rho * rng.uniform(0.8, 1.2, shape)).astype(np.float32)
    matched = np.where(rng.random(shape) < 0.2, UNKNOWN, rho * 1.02 / scale).astype(np.float32)
    information = rng.uniform(1e2, 1e6, shape).astype(np.float32) * scale**2
    misfit = rng.uniform(1, 200, shape).astype(np.float32)
    half = rng.uniform(0.1, 2, (shape[0] // 2, shape[1] // 2)).astype(np.float32)
    view = rng.integers(0, 255, shape).astype(np.uint8)
    refined = Refined((rho / scale).astype(np.float32), information.astype(np.float32), misfit)
    return (view, refined, (other / scale).astype(np.float32), matched,
            Parallax(np.zeros(shape, np.float32), half, signed=True))


def others_of(refined: Refined) -> Alternatives:
    """To what was measured, as differ from place to place as that."""
    rho, misfit = refined.rho, refined.misfit / 5
    half = cv2.resize(misfit, tuple(n // 2 for n in misfit.shape[::-1]))

    def alternative(share: float, least: float, most: float) -> Alternative:
        typical = (0.7 * least + 0.3 * most) * misfit
        return Alternative(share * rho, Agreement(least * misfit, most * misfit, typical,
                                                  least * half))
    return Alternatives(*(alternative(*shares) for shares in (
        (1, 0.3, 1.1), (1.6, 0.9, 1.2), (0.4, 1, 1.3), (0.2, 0.8, 1.4), (1.1, 0.4, 1.3))))


def everywhere() -> tuple[np.ndarray, np.ndarray]:
    rows, columns = np.indices(GRID.shape)
    return rows.ravel(), columns.ravel()


def errors_of(parts, baselines=BASELINES) -> tuple[np.ndarray, np.ndarray]:
    """The likely error of every pixel, and its unit."""
    told, unit = percentiles(look(*parts), GRID, baselines, network())
    return expected_error(told, unit, parts[1]), unit


def outputs(looks: np.ndarray, net: Network) -> np.ndarray:
    x = looks.astype(np.float64)
    for n, (weight, bias) in enumerate(zip(net.weights, net.biases, strict=True)):
        x = x @ weight + bias
        x = np.maximum(x, 0.1 * x) if n < 2 else x
    return x


def test_the_network_that_is_shipped_has_the_stated_shape():
    net = network()
    assert [w.shape for w in net.weights] == [(LOOKS, 24), (24, 16), (16, 3)]
    assert all(np.isfinite(m).all() for m in (*net.weights, *net.biases))


def test_the_compiled_network_is_the_network():
    parts = found(np.random.default_rng(1))
    seen = look(*parts)
    looks, unit = looks_at(seen, GRID, BASELINES, *everywhere())
    error, units = errors_of(parts)
    np.testing.assert_array_equal(unit, units.ravel())
    out = outputs(looks, network())
    by_tail = (np.exp(out[:, 1]) - LEAST) / np.exp(1.3)
    likely = unit * np.maximum(np.maximum(np.exp(out[:, 0]) - LEAST, by_tail), 0)
    exact = np.hypot(likely, 1 / np.sqrt(parts[1].information.ravel()))
    np.testing.assert_allclose(error.ravel(), exact, rtol=2e-3)


def test_the_error_is_gaussian_where_its_percentiles_are():
    """The 68th is the standard deviation, whatever was added for the logarithm."""
    unit = np.full((3, 4), 0.1, np.float32)
    sigma = np.geomspace(0.001, 0.5, 12).reshape(3, 4).astype(np.float32)
    told = np.log(np.stack([sigma, 2 * sigma, 2.05 * sigma]) + np.float32(LEAST))
    refined = Refined(unit, np.full_like(unit, 1e12), np.zeros_like(unit))
    np.testing.assert_allclose(expected_error(told, unit, refined), 0.1 * sigma, rtol=1e-2)


@settings(max_examples=30, deadline=None)
@given(st.floats(0.001, 1.0), st.floats(0.01, 2.0), st.floats(0.1, 3.0), st.floats(0.01, 100))
def test_what_may_be_near_matters_within_forty_baselines(rho, nearer, baseline, scale):
    def found_at(s: float) -> float:
        told = np.log(np.array([0.01, 0.02, nearer], np.float32))[:, None, None]
        measured = np.full((1, 1), rho / s, np.float32)
        return float(may_be_near(told, measured, measured, baseline * s)[0, 0])
    reached = rho * (1 + nearer) * baseline * 40
    assume(abs(reached - 1) > 1e-3)
    assert found_at(1.0) == pytest.approx(nearer if reached > 1 else 0, rel=1e-4)
    assert found_at(scale) == pytest.approx(found_at(1.0), rel=1e-4)


@settings(max_examples=10, deadline=None)
@given(st.floats(0.01, 100), st.integers(0, 100))
def test_only_what_is_relative_counts(scale, seed):
    """A world ten times as large, seen over baselines ten times as long, looks the same."""
    (a, unit_a), (b, unit_b) = (
        errors_of(found(np.random.default_rng(seed), s), [s * x for x in BASELINES])
        for s in (1.0, scale))
    np.testing.assert_allclose(unit_b * scale, unit_a, rtol=1e-4)
    np.testing.assert_allclose(b * scale, a, rtol=0.02)


def test_grey_that_tells_nothing_is_never_sure():
    view, refined, other, matched, parallax = found(np.random.default_rng(2))
    blank = Refined(refined.rho, np.zeros_like(refined.information), refined.misfit)
    error, unit = errors_of((view, blank, other, matched, parallax))
    assert (error > 1e3 * unit).all()


def test_where_opinions_differ_the_error_is_larger():
    view, _, _, _, parallax = found(np.random.default_rng(3))
    rho = np.full(GRID.shape, 0.2, np.float32)
    smooth = Refined(rho, np.full_like(rho, 1e6), np.full_like(rho, 5))
    errors = [errors_of((view, smooth, rho * share, rho, parallax))[0][GRID.wrap:-GRID.wrap,
                                                                       20:-20]
              for share in (np.float32(1), np.float32(1.5), np.float32(0.3))]
    assert np.median(errors[1]) > 2 * np.median(errors[0])
    assert np.median(errors[2]) > 2 * np.median(errors[0])


def test_a_fit_finds_the_percentiles():
    """Errors that are Gaussian, of a standard deviation that one look tells."""
    rng = np.random.default_rng(0)
    looks = rng.normal(size=(30000, LOOKS)).astype(np.float32)
    sigma = 0.05 * np.exp(0.5 * looks[:, 3])
    error = (sigma * rng.normal(size=len(looks))).astype(np.float32)
    fitted = fit([Samples(looks, error, np.ones_like(error))], rng, steps=1000)
    out = np.exp(fitted.layers(looks)[-1])
    assert np.median(out[:, 0] / (sigma + 0.003)) == pytest.approx(1.0, abs=0.1)
    assert np.median(out[:, 1] / (2 * sigma + 0.003)) == pytest.approx(1.0, abs=0.15)
    assert np.median(out[:, 2] / (2.054 * sigma + 0.003)) == pytest.approx(1.0, abs=0.2)


def test_a_saved_fit_is_read_as_it_was(tmp_path):
    rng = np.random.default_rng(0)
    looks = (5 + 3 * rng.normal(size=(1000, LOOKS))).astype(np.float32)
    fitted = Fit(looks, rng)
    fitted.save(tmp_path / 'net.npz')
    data = np.load(tmp_path / 'net.npz')
    net = Network(*(tuple(data[f'{name}{n}'] for n in range(3)) for name in ('weight', 'bias')))
    assert [w.shape[1] for w in net.weights] == [*HIDDEN, 3]
    np.testing.assert_allclose(outputs(looks, net), fitted.layers(looks)[-1], atol=1e-3)


@pytest.mark.parametrize(('likely', 'nearer', 'own', 'misfit', 'frames'), [
    (0.1, 0.1, 0.1, 1, 2), (0.5, 0.1, 0.1, 1, 1), (0.9, 0.1, 0.1, 1, 0), (0.1, 0.1, 1.0, 1, 0),
    (0.1, 0.1, 0.1, 200, 0), (0.1, 0.9, 0.1, 1, 0), (0.1, 1.5, 0.1, 1, -1)])
@pytest.mark.parametrize('baselines', [BASELINES, BASELINES[:1]])
def test_what_is_told_decides_for_how_much_it_counts(monkeypatch, likely, nearer, own, misfit,
                                                     frames, baselines):
    """Likely errors and what may be nearer, in units; of pixels and of what is round about."""
    shape = GRID.shape
    rho = np.full(shape, 0.5, np.float32)

    def told(error: float) -> np.ndarray:
        logarithms = np.log([error + LEAST, error + LEAST, nearer])
        return np.broadcast_to(logarithms[:, None, None], (3, *shape)).astype(np.float32)
    view, _, _, matched, parallax = found(np.random.default_rng(0))
    refined = Refined(rho, np.full(shape, 1e9, np.float32), np.full(shape, misfit, np.float32))
    monkeypatch.setattr(judgement, 'percentiles', lambda *_: (told(own), rho))
    monkeypatch.setattr(judgement, 'judged', lambda *_: np.concatenate([
        told(likely), np.ones((2, *shape), np.float32), told(9),  # nothing is completed
        np.zeros((7, *shape), np.float32)]))
    judged = by_looks(Found(view, view, view, refined, rho, matched, parallax),
                      others_of(refined), GRID, baselines)
    np.testing.assert_array_equal(judged.rho, rho)
    assert (judged.frames == frames).all()
    np.testing.assert_allclose(judged.error, likely * rho, rtol=1e-2)
