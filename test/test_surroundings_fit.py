"""The network of what is round about, while it is fitted: runs where torch and onnx are."""
from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sphstereo_ros.bench.surroundings import DESIGN, Patch, fit, loss
from sphstereo_ros.bench.unet import plain
from sphstereo_ros.core.surroundings import CHANNELS

torch = pytest.importorskip('torch')
pytest.importorskip('onnx')


def patch_of(x: np.ndarray, error: np.ndarray) -> Patch:
    """Of inputs and errors; the true parallax has the logarithm 1."""
    error = error.astype(np.float16)
    return Patch(x.astype(np.float16), error, np.ones_like(error), np.ones_like(error), 1.0)


def test_a_network_that_was_saved_goes_on():
    parts = plain(DESIGN.begun(torch.Generator().manual_seed(1)))
    found = DESIGN.weights_of(DESIGN.as_onnx(parts))
    assert found.keys() == parts.keys()
    x = np.zeros((CHANNELS, 64, 64), np.float16)
    nothing = np.zeros((128, 128), np.float32)
    same = plain(fit([patch_of(x, nothing)], 0, np.random.default_rng(0), found))
    for name, value in parts.items():
        np.testing.assert_array_equal(same[name], value)


def test_a_fit_tells_small_errors_from_large_ones():
    """Errors are Gaussian, ten times as large where one input is high."""
    rng = np.random.default_rng(0)
    x = rng.normal(0, 0.1, (CHANNELS, 64, 64)).astype(np.float32)
    x[22, :, 32:] += 1
    sigma = np.where(np.arange(128) < 64, 0.02, 0.2)[None] * np.ones((128, 1))
    error = (sigma * rng.normal(size=(128, 128))).astype(np.float32)
    parts = fit([patch_of(x, error)], 240, rng)
    with torch.no_grad():
        out = DESIGN.forward(parts, torch.from_numpy(x)[None]).numpy()[0]
    told = np.exp(out[:4].mean(0))
    small, large = np.median(told[:, 4:28]), np.median(told[:, 36:60])
    assert small == pytest.approx(0.02, rel=0.5)
    assert large == pytest.approx(0.2, rel=0.5)


def test_a_fit_tells_a_range_of_its_own():
    """Parallax that grey tells, and what was measured or lies round about does not."""
    rng = np.random.default_rng(0)
    x = rng.normal(0, 0.1, (CHANNELS, 64, 64)).astype(np.float32)
    x[5:9], x[10:14, :, 32:] = 0, 1  # logarithm of what was measured; grey
    true = np.where(np.arange(128) < 64, 0.5, 1.5)[None] * np.ones((128, 1))
    error = (np.exp(true) - 0.1) / 0.9 - 1  # 0.9 px were measured
    maps = [m.astype(np.float16) for m in (error, true, 1 + 0 * true)]
    parts = fit([Patch(x.astype(np.float16), *maps, 1.0)], 320, rng)
    with torch.no_grad():
        out = DESIGN.forward(parts, torch.from_numpy(x)[None]).numpy()[0]
    larger, likely = out[12:20].reshape(2, 4, *out.shape[1:]), np.exp(out[20:24].mean(0))
    choice = out[32:60].reshape(7, 4, *out.shape[1:]).argmax(0)
    assert np.isin(choice, (4, 6)).mean() > 0.9
    chosen = np.where(choice == 4, *larger).mean(0)
    assert np.median(np.abs(chosen[:, 4:28] - 0.5)) < 0.1
    assert np.median(np.abs(chosen[:, 36:60] - 1.5)) < 0.1
    assert np.median(likely) < 0.2


@pytest.mark.parametrize('first', [0.5, 1.5])
def test_of_its_own_ranges_the_better_one_counts(first):
    """Where either of two may be, one for each costs less than twice what lies between."""
    x = torch.zeros(1, CHANNELS, 8, 8)
    true = torch.where(torch.arange(16) % 2 > 0, 0.5, 1.5).expand(1, 1, 16, 16)
    zero, one = torch.zeros_like(true), torch.ones_like(true)

    def costs(*own: float) -> float:
        out = torch.zeros(1, len(DESIGN.begin), 8, 8)
        for n, larger in enumerate(own):
            out[:, 4 * (3 + n):4 * (4 + n)] = larger
        return float(loss(out, x, zero, true, one, 1.0))
    assert costs(first, 2 - first) < costs(1, 1) - 0.3
    assert costs(first, 2 - first) < costs(first, first) - 0.3


def test_a_fit_chooses():
    """What lies farther round about is right where grey is high, else what was measured."""
    rng = np.random.default_rng(0)
    x = rng.normal(0, 0.1, (CHANNELS, 64, 64)).astype(np.float32)
    x[5:9], x[10:14, :, 32:] = np.log(1.1), 1  # 1 px was measured
    x[37], x[42], x[59] = np.log(1.1 + 2), np.log(1.1 + 0.4), np.log(1.1 + 0.2)  # shares of it
    right = np.where(np.arange(128) < 64, 1, 0.4)[None] * np.ones((128, 1))
    maps = [m.astype(np.float16) for m in (right - 1, np.log(0.1 + right), 1 + 0 * right)]
    parts = fit([Patch(x.astype(np.float16), *maps, 0.1)], 320, rng)
    with torch.no_grad():
        out = DESIGN.forward(parts, torch.from_numpy(x)[None]).numpy()[0]
    choice = out[32:60].reshape(7, 4, *out.shape[1:]).argmax(0)
    assert np.isin(choice[:, :, 4:28], (0, 4, 6)).mean() > 0.9
    assert np.isin(choice[:, :, 36:60], (2, 4, 6)).mean() > 0.9


def test_nothing_is_fitted_to_what_is_not_known():
    x, nothing = np.zeros((CHANNELS, 64, 64)), np.zeros((128, 128))
    unknown = replace(patch_of(x, nothing), weight=nothing.astype(np.float16))
    with pytest.raises(ValueError, match='truth'):
        fit([unknown], 1, np.random.default_rng(0))


def test_one_that_saw_less_goes_on():
    parts = plain(DESIGN.begun(torch.Generator().manual_seed(1)))
    narrow = {name: value[:, :-5] if name == 'enter.weight' else value
              for name, value in parts.items()}
    nothing = np.zeros((128, 128), np.float32)
    x = np.zeros((CHANNELS, 64, 64), np.float16)
    wide = plain(fit([patch_of(x, nothing)], 0, np.random.default_rng(0), narrow))
    assert wide['enter.weight'].shape == parts['enter.weight'].shape
    np.testing.assert_array_equal(wide['enter.weight'][:, :-5], narrow['enter.weight'])
