"""The network of what is round about, while it is fitted: runs where torch and onnx are."""
from __future__ import annotations

import numpy as np
import pytest

from sphstereo_ros.bench.surroundings import DESIGN, Patch, fit
from sphstereo_ros.bench.unet import plain
from sphstereo_ros.core.surroundings import CHANNELS

torch = pytest.importorskip('torch')
pytest.importorskip('onnx')


def test_a_network_that_was_saved_goes_on():
    parts = plain(DESIGN.begun(torch.Generator().manual_seed(1)))
    found = DESIGN.weights_of(DESIGN.as_onnx(parts))
    assert found.keys() == parts.keys()
    x = np.zeros((CHANNELS, 64, 64), np.float16)
    nothing = np.zeros((128, 128), np.float32)
    same = plain(fit([Patch(x, nothing, nothing + 1)], 0, np.random.default_rng(0), found))
    for name, value in parts.items():
        np.testing.assert_array_equal(same[name], value)


def test_a_fit_tells_small_errors_from_large_ones():
    """Errors are Gaussian, ten times as large where one input is high."""
    rng = np.random.default_rng(0)
    x = rng.normal(0, 0.1, (CHANNELS, 64, 64)).astype(np.float32)
    x[22, :, 32:] += 1
    sigma = np.where(np.arange(128) < 64, 0.02, 0.2)[None] * np.ones((128, 1))
    error = (sigma * rng.normal(size=(128, 128))).astype(np.float32)
    parts = fit([Patch(x.astype(np.float16), error, np.ones_like(error))], 60, rng)
    with torch.no_grad():
        out = DESIGN.forward(parts, torch.from_numpy(x)[None]).numpy()[0]
    told = np.exp(out[:4].mean(0))
    small, large = np.median(told[:, 4:28]), np.median(told[:, 36:60])
    assert small == pytest.approx(0.02, rel=0.5)
    assert large == pytest.approx(0.2, rel=0.5)


def test_one_that_saw_less_goes_on():
    parts = plain(DESIGN.begun(torch.Generator().manual_seed(1)))
    narrow = {name: value[:, :-5] if name == 'enter.weight' else value
              for name, value in parts.items()}
    nothing = np.zeros((128, 128), np.float32)
    x = np.zeros((CHANNELS, 64, 64), np.float16)
    wide = plain(fit([Patch(x, nothing, nothing + 1)], 0, np.random.default_rng(0), narrow))
    assert wide['enter.weight'].shape == parts['enter.weight'].shape
    np.testing.assert_array_equal(wide['enter.weight'][:, :-5], narrow['enter.weight'])
