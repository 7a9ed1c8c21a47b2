"""The network that chooses between what is measured and remembered, while it is fitted."""
from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from test_memory_judge import (
    AHEAD,
    BASELINES,
    FARTHER,
    FLOOR,
    HEIGHT,
    MEASURED,
    NEARER,
    PASSED_OVER,
    PIXEL,
    WALL,
    opinions,
    view,
)

from sphstereo_ros.bench import memory_judge as bench
from sphstereo_ros.bench.memory_judge import (
    DESIGN,
    Patch,
    _varied,
    fit,
    loss,
    patch_of,
    patches_of,
)
from sphstereo_ros.core.memory_judge import CHANNELS, GREYS, PRESENT, THERE, VIEW, pixel_of
from sphstereo_ros.scenes.sequence import TruthFrame, render_sequence, save_sequence


def truth(distance: float, moving: bool = False) -> TruthFrame:
    shape = (HEIGHT, 2 * HEIGHT)
    mask = np.full(shape, moving)
    return TruthFrame(0, np.zeros((*shape, 3), np.uint8), np.full(shape, distance), np.eye(3),
                      np.zeros(3), moving=mask)


def patch(distance: float, moving: bool = False) -> Patch:
    return patch_of(truth(distance, moving), view(), opinions(), AHEAD, BASELINES)


def test_a_patch_tells_how_far_each_is_from_the_truth():
    found = patch(8.0)
    true, *others = ((rho + PIXEL) / (MEASURED + PIXEL)
                     for rho in (1 / 8, 0.08, 0.09, PASSED_OVER, FLOOR, WALL, FARTHER, NEARER))
    np.testing.assert_allclose(found.true, np.log(true), atol=1e-3)
    for n, other in enumerate(others):
        np.testing.assert_allclose(found.found[n], np.log(other), atol=1e-3)
    assert found.x.shape == (CHANNELS, HEIGHT // 2, HEIGHT)


def test_the_sky_is_a_truth_and_what_is_unknown_is_none():
    sky = patch(np.inf)
    np.testing.assert_allclose(sky.true, np.log(PIXEL / (MEASURED + PIXEL)), atol=2e-3)
    assert (sky.weight > 0).all()
    assert not patch(np.nan).weight.any()


def test_what_moves_and_was_found_too_near_is_taken_to_be_there():
    """Whatever is farther is wrong, then."""
    found, still = patch(12.0, moving=True), patch(12.0)
    assert not found.true.any()
    np.testing.assert_array_equal(found.weight, still.weight)
    np.testing.assert_array_equal(patch(8.0, moving=True).true, patch(8.0).true)
    assert (patch(8.0, moving=True).weight > 0).all()


def test_far_things_count_more_and_near_ones_that_were_found_far():
    row = HEIGHT // 2
    weights = [float(patch(d).weight[row, 0]) for d in (8.0, 20.0, 50.0, 5.0, 200.0)]
    np.testing.assert_allclose(weights, np.array([1, 2, 3, 2, 1]) * weights[0], rtol=1e-2)


def samples(rng: np.random.Generator) -> Patch:
    """Where grey is high, what was remembered is right, else what was measured; both are sure."""
    size = (64, 64)
    x = rng.normal(0, 0.1, (CHANNELS, *size)).astype(np.float32)
    x[0:4], x[20:24], x[48:52] = 3.0, 0.0, -2.0
    for at in PRESENT:
        x[at:at + 4] = 1.0
    x[20:24, :, 32:] = 1.0
    right = np.broadcast_to(np.arange(128) >= 64, (128, 128))
    found = np.stack([np.full((128, 128), off) for off in (-0.3, 0.3, 0.4, 0.2, 0.5, -0.5, 0.6)])
    true = np.where(right, -0.3, 0.0) + rng.normal(0, 0.01, (128, 128))
    maps = [m.astype(np.float16) for m in (found, true, np.ones((128, 128)))]
    return Patch(x.astype(np.float16), *maps)


def test_a_fit_chooses_and_tells_the_error():
    torch = pytest.importorskip('torch')
    pytest.importorskip('onnx')
    rng = np.random.default_rng(0)
    given = samples(rng)
    parts = fit([given], 400, rng)
    with torch.no_grad():
        x = torch.from_numpy(given.x.astype(np.float32))[None]
        out = torch.nn.functional.pixel_shuffle(DESIGN.forward(parts, x), 2)[0].numpy()
    choice = out[2:10].argmax(0)
    inside = np.s_[8:-8, 8:56], np.s_[8:-8, 72:120]
    assert (choice[inside[0]] == 0).mean() > 0.9
    assert (choice[inside[1]] == 1).mean() > 0.9
    likely = np.exp(out[0])
    assert np.median(likely[8:-8, 8:56]) == pytest.approx(0.013, rel=0.5)


def test_a_choice_that_is_too_far_costs_most():
    torch = pytest.importorskip('torch')
    given = samples(np.random.default_rng(0))
    x = torch.from_numpy(given.x.astype(np.float32))[None]
    found = torch.from_numpy(given.found.astype(np.float32))[None]
    one = torch.ones(1, 1, 128, 128)

    def costs(true: float) -> float:
        out = torch.zeros(1, len(DESIGN.begin), 64, 64)
        out[:, :8] = np.log(0.01)
        out[:, 8:12] = 20.0  # what was measured
        return float(loss(out, x, found, true * one, one))
    assert costs(0.0) < costs(-0.4) < costs(0.4) - 1.0


@pytest.mark.parametrize(('choice', 'at'), [
    (1, 24), (2, 48), (4, 84), (5, 92), (6, 100), (7, 112)])
def test_what_is_not_there_is_no_choice(choice, at):
    torch = pytest.importorskip('torch')
    given = samples(np.random.default_rng(0))
    found = torch.from_numpy(given.found.astype(np.float32))[None]
    one = torch.ones(1, 1, 128, 128)

    def costs(logit: float, *, there: bool) -> float:
        x = torch.from_numpy(given.x.astype(np.float32))[None]
        if not there:
            x[:, at:at + 4] = 2.303 if choice == 2 else 0.0
        out = torch.zeros(1, len(DESIGN.begin), 64, 64)
        out[:, :8], out[:, 8:12] = np.log(0.01), 1.0
        out[:, 8 + 4 * choice:12 + 4 * choice] = logit
        return float(loss(out, x, found, 0.0 * one, one))
    assert costs(9.0, there=True) > costs(-9.0, there=True) + 0.5
    assert costs(9.0, there=False) == pytest.approx(costs(-9.0, there=False), abs=1e-5)


@pytest.mark.parametrize('sky', [True, False])
def test_it_costs_to_take_sky_for_something_or_something_for_sky(sky):
    torch = pytest.importorskip('torch')
    given = samples(np.random.default_rng(0))
    x = torch.from_numpy(given.x.astype(np.float32))[None]
    found = torch.from_numpy(given.found.astype(np.float32))[None]
    one = torch.ones(1, 1, 128, 128)
    level = 3.0  # its parallax is e³ − 1 px: with −3, nothing is there

    def costs(logit: float) -> float:
        out = torch.zeros(1, len(DESIGN.begin), 64, 64)
        out[:, :8] = np.log(0.01)
        out[:, 44:48] = logit
        return float(loss(out, x, found, (-level if sky else -0.2) * one, one))
    assert (costs(3.0) < costs(-3.0) - 2.0) == sky
    assert (costs(-3.0) < costs(3.0) - 2.0) == (not sky)


@pytest.mark.parametrize(('nearer', 'from_near', 'danger'), [
    (0.5, 0.1, True), (0.5, -0.1, False), (0.3, 0.1, False), (-0.5, 0.1, False)])
def test_danger_is_what_is_near_by_and_told_much_farther(nearer, from_near, danger):
    """nearer, from_near : logarithms, of what was measured, and of how far is near by."""
    torch = pytest.importorskip('torch')
    given = samples(np.random.default_rng(0))
    x = torch.from_numpy(given.x.astype(np.float32))[None]
    level = 3.0
    x[:, -1] = np.log(np.exp(level + nearer) - 1) - from_near
    found = torch.from_numpy(given.found.astype(np.float32))[None]
    one = torch.ones(1, 1, 128, 128)

    def costs(logit: float) -> float:
        out = torch.zeros(1, len(DESIGN.begin), 64, 64)
        out[:, :8], out[:, 8:12] = np.log(0.01), 20.0
        out[:, 48:] = logit
        return float(loss(out, x, found, nearer * one, one))
    assert (costs(3.0) < costs(-3.0) - 2.0) == danger
    assert (costs(-3.0) < costs(3.0) - 2.0) == (not danger)
    if danger:
        assert costs(-3.0) - costs(3.0) == pytest.approx(30, rel=0.1)


@pytest.mark.parametrize('surface', [0, 1])
def test_a_floor_or_wall_may_be_missing_or_not_where_it_seems_to_be(surface):
    """Where it is seen by some of four pixels only, only those change."""
    pytest.importorskip('torch')
    given = samples(np.random.default_rng(0))
    x, at = given.x.astype(np.float32), THERE + 8 * surface
    x[at:at + 8] = 0
    x[at:at + 2, 32:], x[at + 4:at + 6, 32:] = 1, 0.2
    there = np.zeros((128, 128), np.bool_)
    there[64::2] = True
    found = given.found.copy()
    found[3 + surface] = np.where(there, 0.2, 0)
    given = replace(given, x=x.astype(np.float16), found=found)
    rng, kinds = np.random.default_rng(1), set()
    for _ in range(60):
        seen, _, drawn, *_ = _varied(given, rng)
        where, own = drawn[0, 3 + surface].numpy(), seen[0, at + 4:at + 8].numpy()
        offs = np.unique(where.round(4))
        assert len(offs) <= 2
        assert np.unique(own.round(3)).tolist() == np.unique(where.round(3)).tolist()
        kinds.add('none' if not where.any() else 'as it is' if 0.2 in offs.round(3) else 'off')
    assert kinds == {'none', 'as it is', 'off'}


def test_in_another_light_greys_differ_as_the_picture_does():
    pytest.importorskip('torch')
    given = samples(np.random.default_rng(0))
    x = given.x.copy()
    x[VIEW:VIEW + 4] = np.where(np.arange(64) >= 32, 0.2, -0.2)
    for at in GREYS:
        x[at:at + 4] = 0.1
    rng, contrasts = np.random.default_rng(1), []
    for _ in range(10):
        seen = _varied(replace(given, x=x), rng)[0][0].numpy()
        contrasts.append(np.ptp(seen[VIEW]) / 0.4)
        for at in GREYS:
            np.testing.assert_allclose(seen[at:at + 4], 0.1 * contrasts[-1], rtol=1e-2)
    assert np.ptp(contrasts) > 0.2


def test_how_far_is_near_by_varies():
    pytest.importorskip('torch')
    given, rng = samples(np.random.default_rng(0)), np.random.default_rng(1)
    drawn = np.stack([_varied(given, rng)[0][0, -1].numpy() for _ in range(20)])
    offs = drawn.mean((1, 2)) - given.x[-1].mean()
    assert np.abs(offs).max() < 0.75
    assert np.ptp(offs) > 1
    assert drawn.std((1, 2)).max() < 0.2


def test_nothing_is_fitted_to_what_is_not_known():
    pytest.importorskip('torch')
    given = samples(np.random.default_rng(0))
    with pytest.raises(ValueError, match='truth'):
        fit([replace(given, weight=0 * given.weight)], 1, np.random.default_rng(0))


def test_the_patches_of_a_sequence_tell_its_truth(tmp_path, monkeypatch):
    pytest.importorskip('trimesh')
    rendered = render_sequence('street', 1, 5, 96)
    save_sequence([rendered[k] for k in range(5)], tmp_path / 'street', 'street')
    monkeypatch.setattr(bench, '_WINDOWS', (((1, 2), 2, (4,), False), ((1,), 3, (4,), True)))
    whole, half = patches_of(tmp_path / 'street', np.random.default_rng(0))
    assert whole.x.shape == (CHANNELS, 48, 96)
    assert half.x.shape == (CHANNELS, 24, 48)
    pixel = pixel_of(96, 2 * np.linalg.norm(rendered[4].position - rendered[3].position))
    level = np.empty((96, 192))
    for n in range(4):  # of four pixels each
        level[n // 2::2, n % 2::2] = np.exp(whole.x[n].astype(float)) - 1
    truth = np.exp(whole.true) * (level + 1) - 1
    known = np.isfinite(rendered[4].range) & (rendered[4].range < 20)
    np.testing.assert_allclose(truth[known] * pixel, 1 / rendered[4].range[known], rtol=0.05)
    assert np.median(np.abs(whole.true[known])) < 0.1  # most was measured well
