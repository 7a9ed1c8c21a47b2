"""The network that judges a match, while it is fitted: runs where torch and onnx are."""
from __future__ import annotations

import numpy as np
import pytest

from sphstereo_ros.bench.match_judge import DESIGN, Patch, fit
from sphstereo_ros.core.match_judge import CHANNELS

torch = pytest.importorskip('torch')
pytest.importorskip('onnx')


def test_a_fit_tells_small_errors_from_large_ones_and_completes():
    """Errors are Gaussian, ten times as large where one input is high; another tells the truth."""
    rng = np.random.default_rng(0)
    x = rng.normal(0, 0.1, (CHANNELS, 64, 64)).astype(np.float16)
    x[4:8, :, 32:] += 1
    x[16] = rng.uniform(0, 2, (16, 16)).repeat(4, 0).repeat(4, 1)
    true = np.exp(x[16].astype(float)).repeat(4, 0).repeat(4, 1) + 1
    sigma = np.where(np.arange(256) < 128, 0.02, 0.2)[None]
    found = (true / (1 + sigma * rng.normal(size=true.shape))).clip(0, 99)
    parts = fit([Patch(x, *(m.astype(np.float16) for m in (found, true, np.ones_like(true))))],
                300, rng)
    with torch.no_grad():
        out = DESIGN.forward(parts, torch.from_numpy(x.astype(np.float32))[None]).numpy()[0]
    told = np.exp(out[:16].mean(0))
    small, large = np.median(told[:, 2:14]), np.median(told[:, 18:30])
    assert small == pytest.approx(0.02, rel=0.5)
    assert large == pytest.approx(0.2, rel=0.5)
    completed = out[48:64].reshape(4, 4, 32, 32).transpose(2, 0, 3, 1).reshape(128, 128)
    off = np.abs(completed - np.log(0.5 + true[::2, ::2]))
    assert np.median(off) < 0.15  # a guess would be off by 0.5
    assert np.exp(np.median(out[64:80])) == pytest.approx(np.quantile(off, 0.683), rel=0.6)
