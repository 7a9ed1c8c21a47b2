"""How far a match of one pair errs, by what is round about."""
from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from room import forward

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
from sphstereo_ros.scenes.sequence import render_sequence, true_pose

GRID = stereo_grid(64)
ROUND, WRAP = 16, MARGIN // 4  # rows at a quarter of the size


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
    assert not np.array_equal(x[:, :ROUND], x[:, ROUND:2 * ROUND])
    assert x.shape[1] % 16 == x.shape[2] % 16 == 0


def test_each_output_tells_of_its_own_pixel(monkeypatch):
    """Sixteen of a percentile, row by row, are four by four pixels at half size."""
    x = np.zeros((1, CHANNELS, 2 * ROUND + 16, 16), np.float32)
    rows, columns = (n // 2 for n in x.shape[2:])
    out = np.arange(48 * rows * columns, dtype=np.float32).reshape(1, 48, rows, columns)
    monkeypatch.setattr(match_judge, '_network', lambda: lambda _: out)
    found = told(x, (64, 64))
    assert found.shape == (3, 32, 32)
    for percentile, row, column in ((0, 0, 0), (1, 5, 18), (2, 31, 30)):
        part = 16 * percentile + 4 * (row % 4) + column % 4
        assert found[percentile, row, column] == out[
            0, part, (row + 2 * ROUND) // 4, column // 4]


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 10_000))
def test_what_is_told_decides_what_stands(seed):
    """Against the rule pixel by pixel; sigma is the error, in pixels."""
    rng = np.random.default_rng(seed)
    match = found(rng)
    before = match.pixels.copy()
    errors = np.log(rng.uniform(0.005, 1, (3, *match.sigma.shape))).astype(np.float32)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(match_judge, 'told', lambda *_: errors)
        after = judged_matcher(lambda *_: match)(*views(rng))
    likely = np.maximum(np.exp(errors[0]) - LEAST, (np.exp(errors[1]) - LEAST) * np.exp(-TAIL))
    likely, nearer = (np.kron(m, np.ones((2, 2))) for m in (likely, np.exp(errors[2]) - LEAST))
    size = np.maximum(before, 1)
    sine = np.abs(np.sin(GRID.theta()))[None]
    near = before + nearer * size > 64 / np.pi / 40 * sine
    stands = (before != UNKNOWN) & (likely <= 0.25) & ~((nearer > 0.25) & near)
    wrong = (after.pixels != UNKNOWN) != stands
    assert wrong.mean() < 1e-3  # on the very border
    np.testing.assert_array_equal(after.pixels[stands & ~wrong], before[stands & ~wrong])
    largest = np.where(stands, size, 1).reshape(*(m for n in match.sigma.shape for m in (n, 2)))
    expected = np.maximum(likely[::2, ::2] * largest.max((1, 3)), 0.02)
    np.testing.assert_allclose(after.sigma, expected, rtol=0.02, atol=0.01)


def test_noise_is_not_believed():
    rng = np.random.default_rng(5)
    match = found(rng)
    before = (match.pixels != UNKNOWN).sum()
    after = judged_matcher(lambda *_: match)(*views(rng))
    assert (after.pixels != UNKNOWN).sum() < 0.1 * before


def test_what_looks_wrong_is_refused():
    """On the sample bag: sky near branches, and what is told to be farther than it is."""
    frames = list(frames_of_bag(Path(__file__).parents[1] / 'bags' / 'street.mcap'))[4:8]
    truth = cv2.resize(frames[-1].range, (960, 480), interpolation=cv2.INTER_NEAREST)
    window = AlignedWindow(as_frame(frames[-1], 480), (Reference(
        as_frame(frames[-2], 480), true_pose(frames[-2], frames[-1])),))
    shares = {}
    for name in ('bm', 'bm_judged'):
        judged_or_not = SphericalStereo(resolve({
            'stereo.matcher': name, 'stereo.num_disparities': 48, 'stereo.block_size': 11,
            'baseline.source': 'odometry'}))
        r = judged_or_not.process(window).range
        near, sky = truth < 10, np.isposinf(truth)
        shares[name] = ((r[sky] < 10).mean(), (r[near] > 1.5 * truth[near]).mean(),
                        np.isfinite(r[near]).mean())
    plain, judged = shares['bm'], shares['bm_judged']
    assert judged[0] < 0.1 * plain[0]
    assert judged[1] < 0.3 * plain[1]
    assert judged[2] > 0.8 * plain[2]


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
        (3, shape[0] // 2, shape[1] // 2), -5, np.float32))  # everything is believed
    assert known()
    with monkeypatch.context() as patch:
        patch.setattr(stereo, 'far_islands', lambda r: everywhere)
        assert known() != looks
    with monkeypatch.context() as patch:
        patch.setattr(stereo, 'floor_plane', lambda *_: np.zeros(3))
        patch.setattr(stereo, 'under_floor', lambda *_: everywhere)
        assert known() != looks


def test_a_pair_is_fitted_to():
    """What is told of a patch is how far the parallax was found wrong."""
    sequence = render_sequence('street', 1, 2, 480)
    patch = patch_of(sequence[1], sequence[0], 480, np.random.default_rng(0))
    rows, columns = (4 * n for n in patch.x.shape[1:])
    assert patch.x.shape[0] == CHANNELS
    assert patch.error.shape == patch.weight.shape == (rows, columns)
    assert np.median(np.abs(patch.error[patch.weight > 0])) < 0.15
