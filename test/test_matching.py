from __future__ import annotations

import numpy as np
import pytest
from analytic_world import _noise

from sphstereo_ros.core.config import PARAMETERS, StereoConfig
from sphstereo_ros.core.matching import (
    MARGIN,
    UNKNOWN,
    Matcher,
    Parallax,
    matcher,
    structure,
    structure_sigma,
)

MATCHERS = PARAMETERS['stereo.matcher'].choices
ONE_SIDED = ('bm', 'bm_judged', 'sgbm', 'joint_fast')  # their search ends at zero
ROWS, COLUMNS = 200, 240
INSIDE = (slice(20, -20), slice(70, -20))


def content(columns: np.ndarray, rows: np.ndarray, plane: float = 0.0) -> np.ndarray:
    """Grey levels of a smooth texture at any position."""
    columns, rows = np.broadcast_arrays(columns, rows)
    points = np.stack([columns, rows, np.full(columns.shape, plane)], axis=-1)
    grey = 128 + sum(weight * _noise(points / cell, seed) for seed, (cell, weight) in
                     enumerate(((24.0, 120.0), (12.0, 100.0), (6.0, 80.0))))
    return np.clip(np.round(grey), 0, 255).astype(np.uint8)


def pair(parallax: float, across: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Current and reference view: what is at column c now was at column c − parallax."""
    columns, rows = np.arange(COLUMNS)[None], np.arange(ROWS)[:, None]
    return content(columns, rows), content(columns + parallax, rows + across)


def made(name: str, **more: int) -> Matcher:
    return matcher(StereoConfig(matcher=name, **{'num_disparities': 48, **more}))


def known(found: Parallax) -> np.ndarray:
    return found.pixels != np.float32(UNKNOWN)


@pytest.mark.parametrize('name', MATCHERS)
@pytest.mark.parametrize('parallax', [1.5, 4.25, 13.6])
def test_a_known_shift_is_found_with_its_sign_and_fraction(name, parallax):
    found = made(name)(*pair(parallax))
    assert found.pixels.shape == (ROWS, COLUMNS)
    assert found.pixels.dtype == found.sigma.dtype == np.float32
    assert found.sigma.shape == (ROWS // 2, COLUMNS // 2)
    inside = found.pixels[INSIDE][known(found)[INSIDE]]
    assert len(inside) > 0.8 * found.pixels[INSIDE].size
    # OpenCV's block matchers lean toward whole pixels.
    bias = {'bm': 0.1, 'bm_judged': 0.1, 'joint_fast': 0.1, 'sgbm': 0.3}.get(name, 0.06)
    assert np.median(inside) == pytest.approx(parallax, abs=bias)
    assert np.median(np.abs(inside - parallax)) < (0.5 if name == 'flow_fast' else 0.3)


@pytest.mark.parametrize('name', MATCHERS)
def test_only_a_signed_matcher_sees_parallax_below_zero(name):
    found = made(name)(*pair(-2.5))
    inside = found.pixels[INSIDE][known(found)[INSIDE]]
    assert found.signed == (name not in ONE_SIDED)
    if found.signed:
        assert np.median(inside) == pytest.approx(-2.5, abs=0.06)
    else:
        assert (inside > 0).all()
        assert len(inside) < 0.35 * found.pixels[INSIDE].size


@pytest.mark.parametrize('name', ONE_SIDED)
def test_the_first_columns_are_not_lost(name):
    """Columns left of the search range: without padding all are empty beside one pole."""
    found = made(name, num_disparities=96)(*pair(3.0))
    first = found.pixels[20:-20, 20:96]
    assert (np.abs(first - 3.0) < 0.3).mean() > 0.8
    rim = found.pixels[:, 20:-20]
    assert (np.abs(rim[[MARGIN, -MARGIN - 1]] - 3.0) < 0.5).mean() > 0.5


@pytest.mark.parametrize('name', [m for m in MATCHERS if m not in ONE_SIDED])
def test_motion_across_the_meridian_is_unknown(name):
    assert known(made(name)(*pair(3.0)))[INSIDE].mean() > 0.95
    assert known(made(name)(*pair(3.0, across=4.0)))[INSIDE].mean() < 0.1


@pytest.mark.parametrize('name', [m for m in MATCHERS if m not in ONE_SIDED])
def test_views_that_show_different_things_are_mostly_unknown(name):
    columns, rows = np.arange(COLUMNS)[None], np.arange(ROWS)[:, None]
    found = made(name)(content(columns, rows), content(columns, rows, plane=500.0))
    assert known(found)[INSIDE].mean() < 0.35


@pytest.mark.parametrize('name', MATCHERS)
def test_a_matcher_is_the_same_for_the_same_images(name):
    images = pair(5.3)
    again = made(name)
    first, second = again(*images), again(*images)  # and keeps nothing from one to the next
    np.testing.assert_array_equal(first.pixels, second.pixels)
    np.testing.assert_array_equal(first.sigma, second.sigma)


@pytest.mark.parametrize('name', MATCHERS)
def test_less_contrast_is_less_certain(name):
    current, reference = pair(4.0)
    faint = [(128 + (im - 128.0) * 0.1).astype(np.uint8) for im in (current, reference)]
    clear, vague = made(name)(current, reference), made(name)(*faint)
    assert (clear.sigma > 0).all()
    assert np.median(vague.sigma) > 1.5 * np.median(clear.sigma)


@pytest.mark.parametrize('amplitude', [20.0, 80.0])
def test_structure_is_the_root_mean_square_gradient_along_theta(amplitude):
    wave = 128 + amplitude * np.sin(2 * np.pi * np.arange(256) / 32)
    along = np.round(np.tile(wave, (256, 1))).astype(np.uint8)
    expected = amplitude * 2 * np.pi / 32 / np.sqrt(2)
    middle = (slice(20, -20), slice(20, -20))
    got = structure(along, window=33)[middle]  # two whole waves, nearly
    assert got.mean() == pytest.approx(expected, rel=0.1)
    assert structure(np.ascontiguousarray(along.T))[middle].max() < 0.05 * expected
    assert structure(np.full((40, 60), 90, np.uint8)).max() == 0
    assert structure(along).shape == (128, 128)


def test_sigma_falls_with_structure_to_a_floor():
    rng = np.random.default_rng(0)
    sigmas = [float(np.median(structure_sigma(np.clip(
        128 + contrast * rng.normal(size=(64, 64)), 0, 255).astype(np.uint8), (0.1, 2.0))))
        for contrast in (0.0, 1.0, 5.0, 20.0, 60.0)]
    assert sigmas == sorted(sigmas, reverse=True)
    assert 0.1 < sigmas[-1] < 0.2 * sigmas[0]
    assert 1.9 < sigmas[0] < 2.1


def test_all_block_sizes_work_with_all_matchers():
    for name in ('bm', 'sgbm'):
        for block in (5, 15, 21):
            found = made(name, block_size=block)(*pair(4.0))
            assert np.median(found.pixels[INSIDE][known(found)[INSIDE]]) == pytest.approx(
                4.0, abs=0.1)
