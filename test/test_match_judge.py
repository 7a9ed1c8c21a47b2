"""How far a match of one pair errs, by what is round about."""
from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from room import forward

from sphstereo_ros.bench import match_judge as fitting
from sphstereo_ros.bench.accuracy import as_frame
from sphstereo_ros.bench.match_judge import patch_of
from sphstereo_ros.bench.obstacles import frames_of_bag
from sphstereo_ros.core import match_judge, stereo
from sphstereo_ros.core.config import resolve
from sphstereo_ros.core.frames import AlignedWindow, Reference, RelativePose
from sphstereo_ros.core.match_judge import CHANNELS, TAIL, inputs, judged_matcher, told
from sphstereo_ros.core.matching import MARGIN, UNKNOWN, Parallax, stereo_grid
from sphstereo_ros.core.reliability import LEAST
from sphstereo_ros.core.stereo import SphericalStereo
from sphstereo_ros.scenes.sequence import REPORTED_SEEDS, render_sequence, true_pose

GRID = stereo_grid(64)
ROUND, WRAP = 32, MARGIN // 4  # rows at a quarter of the size


def views(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    return tuple(rng.integers(0, 256, (2, *GRID.shape)).astype(np.uint8))


def found(rng: np.random.Generator) -> Parallax:
    shape = GRID.shape
    pixels = rng.uniform(0, 12, shape).astype(np.float32)
    pixels[rng.random(shape) < 0.3] = UNKNOWN
    pixels[40:48] = UNKNOWN  # where nothing at all is known
    sigma = rng.uniform(0.1, 2, (shape[0] // 2, shape[1] // 2)).astype(np.float32)
    return Parallax(pixels, sigma, signed=False)


def shown(reference: np.ndarray, row: int, at: float) -> float:
    at = min(max(at, 0), reference.shape[1] - 1.001)
    return float(np.interp(at, np.arange(reference.shape[1]), reference[row].astype(float)))


@pytest.mark.parametrize(('h', 'w'), [(2, 0), (10, 4), (20, 19), (33, 11)])
def test_the_inputs_of_a_pixel(h, w):
    rng = np.random.default_rng(1)
    (current, reference), match = views(rng), found(rng)
    out = inputs(current, reference, match)[0, :, ROUND + h, w]
    cells: list[list[float]] = [[], [], [], []]
    for i, j in ((0, 0), (0, 2), (2, 0), (2, 2)):
        block = 4 * h + i + np.arange(2), 4 * w + j + np.arange(2)  # two pixels across
        known = match.pixels[block] != UNKNOWN
        d = match.pixels[block][known]
        rows, columns = (n[known] for n in block)
        off = [abs(float(current[r, c]) - shown(reference, r, c - p))
               for r, c, p in zip(rows, columns, d, strict=True)]
        for cell, value in zip(cells, (
                np.log(0.5 + (d.mean() if d.size else 0)), known.mean(),
                current[block].mean() / 64 - 2,
                np.log(2 + (np.mean(off) if off else 0)) - 2), strict=True):
            cell.append(value)
    across = np.add.outer((0, 2), np.arange(2)).ravel()
    block = tuple(np.array([(4 * h + i, 4 * w + j) for i in across for j in across
                            if i % 2 == j % 2]).T)
    d = match.pixels[block][match.pixels[block] != UNKNOWN]
    theta = (4 * w + 2 - MARGIN + 0.5) * np.pi / 64
    exact = [*np.concatenate(cells), np.log((0.5 + d.max()) / (0.5 + d.min())) if d.size else 0,
             np.log(0.05 + match.sigma[2 * h:2 * h + 2, 2 * w:2 * w + 2].mean()),
             abs(np.sin(theta)), np.ptp(current[block].astype(float)) / 64]
    assert len(exact) == CHANNELS
    np.testing.assert_allclose(out, exact, rtol=1e-4, atol=1e-4)


def test_beyond_the_seam_comes_what_lies_there():
    rng = np.random.default_rng(2)
    x = inputs(*views(rng), found(rng))[0]
    inner = GRID.shape[0] // 4 - 2 * WRAP
    np.testing.assert_array_equal(x[:, :ROUND + WRAP], x[:, inner:inner + ROUND + WRAP])
    assert not np.array_equal(x[:, :inner // 2], x[:, inner // 2:inner])
    assert x.shape[1] % 32 == x.shape[2] % 32 == 0


def test_each_output_tells_of_its_own_pixel(monkeypatch):
    """Sixteen of a kind, row by row, are four by four pixels at half size."""
    x = np.zeros((1, CHANNELS, 2 * ROUND + 16, 16), np.float32)
    rows, columns = (n // 2 for n in x.shape[2:])
    out = np.arange(112 * rows * columns, dtype=np.float32).reshape(1, 112, rows, columns)
    monkeypatch.setattr(match_judge, '_network', lambda: lambda _: out)
    found = told(x, (64, 64))
    assert found.shape == (7, 32, 32)
    for kind, row, column in ((0, 0, 0), (1, 5, 18), (3, 9, 7), (6, 31, 30)):
        part = 16 * kind + 4 * (row % 4) + column % 4
        assert found[kind, row, column] == out[
            0, part, (row + 2 * ROUND) // 4, column // 4]


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 10_000))
def test_what_is_told_decides_what_stands(seed):
    """Against the rule pixel by pixel; sigma is the error, in pixels."""
    rng = np.random.default_rng(seed)
    current, reference = (100 + view // 16 for view in views(rng))
    match = found(rng)
    before = match.pixels.copy()
    told_of = np.log(rng.uniform(0.005, 1, (7, *match.sigma.shape))).astype(np.float32)
    told_of[3] = np.log(rng.uniform(0.5, 12, match.sigma.shape))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(match_judge, 'told', lambda *_: told_of)
        after = judged_matcher(lambda *_: match)(current, reference)
    whole = np.kron(told_of.astype(float), np.ones((1, 2, 2)))
    bound = 64 / np.pi / 40 * np.abs(np.sin(GRID.theta()))[None]

    def judged(pixels, percentiles):
        share, tail, nearer = np.exp(percentiles) - LEAST
        likely, size = np.maximum(share, tail * np.exp(-TAIL)), np.maximum(pixels, 1)
        hides = (nearer > 0.25) & (pixels + nearer * size > bound)
        stands = (pixels != UNKNOWN) & (likely <= 0.25) & ~hides
        return np.where(stands, likely * size, np.inf)
    completed = np.maximum(np.exp(whole[3]) - 0.5, 0.01)
    errors = np.array([judged(before, whole[:3]), judged(completed, whole[4:])])
    there = [[shown(reference, i, j - completed[i, j]) for j in range(before.shape[1])]
             for i in range(before.shape[0])]
    errors[1][np.abs(current - np.array(there)) > 6] = np.inf
    expected = np.where(errors[1] < errors[0], completed, before)
    least = errors.min(0)
    expected[np.isinf(least)] = UNKNOWN
    wrong = np.abs(after.pixels - expected) > 1e-3
    assert wrong.mean() < 2e-3  # on the very border
    blocks = np.where(np.isinf(least), 0, least).reshape(
        *(m for n in match.sigma.shape for m in (n, 2)))
    off = np.abs(after.sigma - np.maximum(blocks.max((1, 3)), 0.02)) > 0.02 * after.sigma
    assert off.mean() < 5e-3


def test_noise_is_not_believed():
    rng = np.random.default_rng(5)
    match = found(rng)
    before = (match.pixels != UNKNOWN).sum()
    after = judged_matcher(lambda *_: match)(*views(rng))
    assert (after.pixels != UNKNOWN).sum() < 0.1 * before


@pytest.fixture(scope='module')
def of_bag() -> tuple[np.ndarray, dict[str, tuple[np.ndarray, np.ndarray]]]:
    """True range of a frame of the sample bag; range and sigma as matched, and as judged."""
    frames = list(frames_of_bag(Path(__file__).parents[1] / 'bags' / 'street.mcap'))[4:8]
    truth = cv2.resize(frames[-1].range, (960, 480), interpolation=cv2.INTER_NEAREST)
    window = AlignedWindow(as_frame(frames[-1], 480), (Reference(
        as_frame(frames[-2], 480), true_pose(frames[-2], frames[-1])),))
    results = {}
    for name in ('bm', 'bm_judged'):
        result = SphericalStereo(resolve({
            'stereo.matcher': name, 'stereo.num_disparities': 48, 'stereo.block_size': 11,
            'baseline.source': 'odometry'})).process(window)
        results[name] = result.range, result.sigma
    return truth, results


def test_what_looks_wrong_is_refused(of_bag):
    """Sky near branches, and what is told to be farther than it is."""
    truth, results = of_bag
    near, sky = truth < 10, np.isposinf(truth)
    plain, judged = (((r[sky] < 10).mean(), (r[near] > 1.5 * truth[near]).mean())
                     for r, _ in (results['bm'], results['bm_judged']))
    assert judged[0] < 0.1 * plain[0]
    assert judged[1] < 0.1 * plain[1]


def test_what_was_not_found_is_completed(of_bag):
    """What was found wrong or not at all, nearer than 10 m, is known then, and sigma tells."""
    truth, results = of_bag
    plain, (r, sigma) = results['bm'][0], results['bm_judged']
    missed = (truth < 10) & ~(np.abs(plain / truth - 1) < 0.25)
    completed = missed & np.isfinite(r)
    off = np.abs(r / truth - 1)[completed]
    assert completed.sum() > 0.6 * missed.sum()
    assert np.median(off) < 0.05
    assert (r > 1.5 * truth)[completed].mean() < 0.005
    assert (np.abs(r - truth) < 2 * sigma)[completed].mean() > 0.85


@pytest.mark.parametrize(('matcher', 'looks'), [('bm', False), ('bm_judged', True)])
def test_mirrors_and_what_is_under_the_floor_are_looked_for(monkeypatch, matcher, looks):
    frames = forward(2, 0.2, 64)
    pose = RelativePose(np.eye(3), np.array([0.0, 0.0, -0.2]), 1e-9 * np.eye(6))
    window = AlignedWindow(frames[1], (Reference(frames[0], pose),))
    everywhere = np.ones((64, 128), bool)

    def known() -> bool:
        return bool(np.isfinite(SphericalStereo(resolve({
            'stereo.matcher': matcher, 'stereo.num_disparities': 16, 'stereo.block_size': 5,
            'baseline.source': 'odometry'})).process(window).range).any())
    monkeypatch.setattr(match_judge, 'told', lambda x, shape: np.full(
        (7, shape[0] // 2, shape[1] // 2), -5, np.float32))  # everything is believed
    assert known()
    with monkeypatch.context() as patch:
        patch.setattr(stereo, 'far_islands', lambda r: everywhere)
        assert known() != looks
    with monkeypatch.context() as patch:
        patch.setattr(stereo, 'floor_plane', lambda *_: np.zeros(3))
        patch.setattr(stereo, 'under_floor', lambda *_: everywhere)
        assert known() != looks


def test_a_pair_is_fitted_to():
    """A patch tells what was found, and what is true."""
    sequence = render_sequence('street', 1, 2, 480)
    patch = patch_of(sequence[1], sequence[0], 480, np.random.default_rng(0))
    rows, columns = (4 * n for n in patch.x.shape[1:])
    assert patch.x.shape[0] == CHANNELS
    assert patch.found.shape == patch.true.shape == patch.weight.shape == (rows, columns)
    judged = (patch.weight > 0) & (patch.found >= 0)
    error = np.abs(patch.true - patch.found) / np.maximum(patch.found, 1)
    assert judged.mean() > 0.4
    assert np.median(error[judged]) < 0.15
    assert (patch.found < 0).mean() > 0.01


def test_what_is_rendered_for_the_fit_is_determined_and_not_reported(monkeypatch, tmp_path):
    made: list[list[tuple]] = [[], []]
    for calls in made:
        monkeypatch.setattr(fitting, 'render_way', lambda *way, to=calls: to.append(way))
        fitting.render(tmp_path)
    assert made[0] == made[1]
    folders, names, seeds, heights, spacings, nuisances = map(set, zip(*made[0], strict=True))
    assert folders == {tmp_path}
    assert names == {'street', 'takeoff', 'corridor'}
    assert heights == {480}
    assert spacings == {None, 0.2, 0.28, 0.4}
    assert nuisances == {None, 'low_light', 'exposure'}
    assert len(seeds) == len(made[0])
    assert not seeds & {*range(1, 100), *REPORTED_SEEDS}
