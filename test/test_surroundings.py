"""How far a measurement errs, by what is round about."""
from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from test_reliability import BASELINES, GRID, found, others_of

from sphstereo_ros.bench.accuracy import as_frame
from sphstereo_ros.bench.obstacles import frames_of_bag
from sphstereo_ros.bench.surroundings import patches_of, render_way
from sphstereo_ros.core import judgement
from sphstereo_ros.core.alternatives import Alternative, Alternatives
from sphstereo_ros.core.config import resolve
from sphstereo_ros.core.frames import Reference
from sphstereo_ros.core.joint import JointMatcher
from sphstereo_ros.core.judgement import together
from sphstereo_ros.core.matching import UNKNOWN, matcher
from sphstereo_ros.core.refinement import Agreement, Refined
from sphstereo_ros.core.reliability import look, network, percentiles
from sphstereo_ros.core.surroundings import CHANNELS, inputs, judged, likeliest
from sphstereo_ros.scenes.binocular import render_binocular, save_binocular
from sphstereo_ros.scenes.sequence import load_sequence, save_sequence, true_pose

ROUND, BLOCK = 64, 32  # rows of half size beyond the seam; what sizes are multiples of


def seen_at(parts, baselines=BASELINES):
    view, refined, other, matched, parallax = parts
    seen = look(view, refined, other, matched, parallax)
    told, unit = percentiles(seen, GRID, baselines, network())
    return (inputs(view, seen, others_of(refined), told, unit, GRID, baselines), seen, told,
            unit)


def mean(block) -> float:
    return float(np.mean(np.asarray(block, np.float64)))


@pytest.mark.parametrize(('h', 'w'), [(4, 0), (20, 11), (40, 39), (67, 25)])
def test_the_inputs_of_a_pixel(h, w):
    parts = found(np.random.default_rng(1))
    view, refined, other, matched, _ = parts
    out, seen, told, unit = seen_at(parts)
    block = np.s_[2 * h:2 * h + 2, 2 * w:2 * w + 2]
    theta = GRID.theta()[2 * w:2 * w + 2]
    sine = np.maximum(np.abs(np.sin(theta)), 0.02)[None] * np.ones((2, 1))
    rho, units, grey = refined.rho[block], unit[block], (view[block] / 64.0 - 2)
    known = matched[block] != UNKNOWN
    others = others_of(refined)
    measured, near, far, farther, swept = (a.agreement for a in vars(others).values())

    def grey_of(difference):
        return np.log(2 + difference[block].ravel()) - 2

    def share_of(other):
        return np.log(1.1 + min(other.rho[2 * h, 2 * w] / units[0, 0], 20))
    short, long = (units * b * sine / GRID.pixel for b in BASELINES)
    exact = [*np.maximum(told[0], told[1] - 1.3)[block].ravel(), mean(told[2][block]),
             *np.log(0.1 + short).ravel(), mean(np.clip(rho / units, -1, 1)), *grey.ravel(),
             np.log(0.5 + seen.half[12, h, w]) - 1,
             np.log(0.1 + mean(np.maximum(other[block] * sine / GRID.pixel * BASELINES[0], 0))),
             mean(np.clip((rho - other[block]) / units, -2, 1.5)), mean(known),
             mean(np.where(known, np.clip((rho - matched[block]) / units, -2, 1.5), 0)),
             0.7 * (np.log(4 + mean(refined.misfit[block])) - 3),
             0.2 * np.log(0.01 + mean(refined.information[block] * units**2)),
             0.5 * np.log(0.1 + mean(long)), mean(sine), np.ptp(grey),
             np.log(0.05 + seen.half[13, h, w]) + 1,
             *grey_of(measured.least), *grey_of(measured.most),
             *grey_of(near.least), share_of(others.near),
             *grey_of(far.least), share_of(others.far), *grey_of(near.most),
             *grey_of(far.most), *grey_of(farther.least), *grey_of(farther.most),
             share_of(others.farther), *grey_of(measured.typical),
             *grey_of(near.typical), *grey_of(far.typical), *grey_of(farther.typical),
             *grey_of(swept.least), *grey_of(swept.most), *grey_of(swept.typical),
             share_of(others.swept),
             *(np.log(2 + a.around[h, w]) - 2 for a in (measured, near, far, farther, swept))]
    assert len(exact) == CHANNELS
    np.testing.assert_allclose(out[0, :, ROUND + h, w], exact, rtol=1e-4, atol=1e-4)


def test_beyond_the_seam_comes_what_lies_there():
    out, seen, _, _ = seen_at(found(np.random.default_rng(2)))
    rows, wrap = seen.half.shape[1], GRID.wrap // 2
    inner = rows - 2 * wrap
    x = out[0]
    np.testing.assert_array_equal(x[:, :ROUND + wrap], x[:, inner:inner + ROUND + wrap])
    assert not np.array_equal(x[:, :ROUND // 2], x[:, ROUND // 2:ROUND])


def test_sizes_halve_evenly():
    out, seen, told, _ = seen_at(found(np.random.default_rng(3)))
    assert out.shape[2] % BLOCK == out.shape[3] % BLOCK == 0
    assert out.shape[2] >= seen.half.shape[1] + 2 * ROUND
    assert judged(out, GRID.shape).shape == (15, *told.shape[1:])


@settings(max_examples=8, deadline=None)
@given(st.floats(0.01, 100), st.integers(0, 100))
def test_only_what_is_relative_counts(scale, seed):
    """A world ten times as large, seen over baselines ten times as long, looks the same."""
    small, large = (judged(seen_at(found(np.random.default_rng(seed), s),
                                   [s * b for b in BASELINES])[0], GRID.shape)
                    for s in (1.0, scale))
    np.testing.assert_allclose(small, large, atol=0.05)


def test_a_view_that_is_turned_is_judged_as_before():
    """About the direction of motion; the network sees 64 px of half size beyond the seam."""
    parts = found(np.random.default_rng(4))
    turn, wrap = 16, GRID.wrap

    def turned(image):
        inner = np.roll(image[wrap:-wrap], turn, 0)
        return np.ascontiguousarray(np.concatenate([inner[-wrap:], inner, inner[:wrap]]))

    def closed(image, by=1):
        border = wrap // by
        inner = image[border:-border]
        return np.ascontiguousarray(np.concatenate([inner[-border:], inner, inner[:border]]))

    view, refined, other, matched, parallax = parts
    refined = Refined(*(closed(m) for m in (refined.rho, refined.information, refined.misfit)))
    first = (closed(view), refined, closed(other), closed(matched), parallax)
    second = (turned(first[0]), Refined(*(turned(m) for m in (
        refined.rho, refined.information, refined.misfit))), turned(first[2]), turned(first[3]),
        parallax)
    parallax.sigma[:] = 0.5
    a, b = (judged(seen_at(p)[0], GRID.shape)[:, wrap:-wrap] for p in (first, second))
    np.testing.assert_allclose(np.roll(a, turn, 1)[:, 64:-64], b[:, 64:-64], atol=0.3)


def told_of(choice: np.ndarray, *larger: np.ndarray) -> np.ndarray:
    """What the network tells, if of seven ranges it chooses that one; its own, if any, are so much
    larger.
    """
    told = np.zeros((15, *GRID.shape), np.float32)
    told[3:5] = larger or 0
    np.put_along_axis(told, 8 + choice[None], np.float32(1), 0)
    return told


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 1000), st.floats(0.01, 100))
def test_the_networks_own_ranges_are_as_much_larger_as_told(seed, scale):
    """The network tells by how much the logarithm of the shortest baseline's parallax, and a tenth
    of a pixel, is larger than where the unit was measured.
    """
    rng, baselines = np.random.default_rng(seed), [scale * b for b in BASELINES]
    unit, *true = (rng.uniform(0.01, 2, GRID.shape).astype(np.float32) / scale for _ in range(3))
    pixel = GRID.pixel / np.maximum(np.abs(np.sin(GRID.theta())), 0.02)
    measured, *wanted = (np.log(0.1 + m * min(baselines) / pixel) for m in (unit, *true))
    second = rng.integers(0, 2, GRID.shape) > 0
    told = told_of(np.where(second, 6, 4), *(m - measured for m in wanted))
    others = others_of(Refined(unit, unit, unit))
    rho, its_unit = likeliest(told, unit, others, GRID, baselines)
    np.testing.assert_allclose(rho, np.where(second, true[1], true[0]), rtol=1e-3,
                               atol=1e-4 / scale)
    np.testing.assert_allclose(its_unit, np.maximum(rho, pixel / max(baselines)), rtol=1e-5)


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 1000))
def test_the_likeliest_is_what_was_chosen(seed):
    rng = np.random.default_rng(seed)
    ranges = rng.uniform(0.01, 2, (5, *GRID.shape)).astype(np.float32)
    others = Alternatives(*(Alternative(m, Agreement(m, m, m, m)) for m in ranges))
    choice = rng.integers(0, 5, GRID.shape)
    told = told_of(np.where(choice < 4, choice, 5))  # the fifth and the last are its own
    rho, unit = likeliest(told, ranges[0], others, GRID, BASELINES)
    np.testing.assert_array_equal(rho, np.take_along_axis(ranges, choice[None], 0)[0])
    assert (unit >= rho).all()


def test_outputs_that_are_missing_are_an_error():
    ranges = np.ones(GRID.shape, np.float32)
    with pytest.raises(ValueError, match='14 outputs, not 15'):
        likeliest(told_of(np.zeros(GRID.shape, int))[:14], ranges,
                  others_of(Refined(ranges, ranges, ranges)), GRID, BASELINES)


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 1000))
def test_what_is_round_about_may_refuse_but_not_believe_alone(seed):
    own, wider = np.random.default_rng(seed).normal(size=(2, 3, 4, 5)).astype(np.float32)
    told = together(own, wider)
    assert (told >= wider - 1e-6).all()
    assert (told >= 0.5 * (own + wider) - 1e-6).all()
    np.testing.assert_allclose(together(own, own), own, atol=1e-6)


def test_noise_is_not_believed():
    """Ranges without any rhyme: an error of a fifth at least is told of nearly all."""
    out, _, told, _ = seen_at(found(np.random.default_rng(5)))
    assert np.mean(together(told, judged(out, GRID.shape)[:3])[0] > np.log(0.2)) > 0.9


@pytest.mark.parametrize(('references', 'least'), [(3, 0.85), (1, 0.8)])
def test_sky_behind_leaves_is_refused(monkeypatch, references, least):
    """On the sample bag: sky that would be measured nearer than 10 m."""
    frames = list(frames_of_bag(Path(__file__).parents[1] / 'bags' / 'street.mcap'))[4:15]
    current = frames[-1]
    window = [Reference(as_frame(f, 480), true_pose(f, current))
              for f in (frames[-2], frames[-5], frames[0])[:references]]
    sky = cv2.resize(np.isposinf(current.range).view(np.uint8), (960, 480),
                     interpolation=cv2.INTER_NEAREST) > 0
    near = cv2.resize((current.range < 10).view(np.uint8), (960, 480),
                      interpolation=cv2.INTER_NEAREST) > 0
    matcher_ = JointMatcher('joint', matcher(resolve({}).stereo))

    def believed() -> tuple[float, float]:
        found = matcher_.measure(as_frame(current, 480), window)
        sure = (found.frames > 0) & (found.sigma < 0.3 * found.rho)
        return (sure & (found.rho > 0.1))[sky].mean(), sure[near].mean()
    ghosts, known = believed()
    assert known > least
    # A network that believes everything leaves the decision to what a pixel tells by itself.
    monkeypatch.setattr(judgement, 'judged', lambda x, shape: np.broadcast_to(
        np.float32([-9] * 3 + [0] * 2 + [9] * 3 + [9] + [0] * 6)[:, None, None], (15, *shape)))
    alone, _ = believed()
    assert ghosts < 0.25 * alone


def test_a_pair_of_cameras_is_fitted_to(tmp_path):
    """The network's patch of a pair: what is told of it is how far it was measured wrong."""
    save_binocular(render_binocular('corridor', 1, 1, 160), tmp_path, 'corridor')
    patch, = patches_of(tmp_path, np.random.default_rng(0))
    rows, columns = (2 * n for n in patch.x.shape[1:])
    assert patch.x.shape[0] == CHANNELS
    assert patch.error.shape == patch.true.shape == patch.weight.shape == (rows, columns)
    assert 0.9 < np.mean(patch.weight > 0) <= 1
    assert np.median(np.abs(patch.error[patch.weight > 0])) < 0.1


@pytest.fixture(scope='module')
def way(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp('ways')
    render_way(folder, 'corridor', 1, 96, None, None)
    return folder / 'corridor_1'


def test_a_way_is_fitted_to_with_four_to_one_references(way):
    ratios = [p.ratio for p in patches_of(way, np.random.default_rng(0))]
    assert ratios == pytest.approx([0.1, 1 / 7, 1 / 4, 1], rel=0.05)


def test_of_what_moves_the_fit_is_told_what_seems_too_far(way, tmp_path):
    frames = list(load_sequence(way))
    rows = np.arange(96)[:, None] + 0 * frames[-1].range
    nearer, farther = rows < 30, rows > 65
    moved = np.where(nearer, 0.5, np.where(farther, 2, 1)) * frames[-1].range
    save_sequence([*frames[:-1], replace(frames[-1], range=moved, moving=nearer | farther)],
                  tmp_path)
    still, patch = (patches_of(folder, np.random.default_rng(0))[0] for folder in (way, tmp_path))
    told = (patch.weight > 0) & (still.weight > 0)
    too_far = told & (patch.error > still.error + 0.01)
    assert 0.1 < np.mean(too_far) < 0.5
    gone = (patch.weight == 0) & (still.weight > 0)
    assert 0.1 < np.mean(gone) < 0.4
    same = ~too_far & (np.abs(patch.error - still.error) < 0.01 + 0.01 * np.abs(still.error))
    assert (too_far | same)[told].mean() > 0.99
