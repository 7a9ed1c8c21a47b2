"""The network that judges a match, while it is fitted: runs where torch and onnx are."""
from __future__ import annotations

import numpy as np
import pytest

from sphstereo_ros.bench.match_judge import DESIGN, Patch, fit
from sphstereo_ros.core.match_judge import CHANNELS

torch = pytest.importorskip('torch')
pytest.importorskip('onnx')


def test_a_fit_tells_small_errors_from_large_ones():
    """Errors are Gaussian, ten times as large where one input is high."""
    rng = np.random.default_rng(0)
    x = rng.normal(0, 0.1, (CHANNELS, 64, 64)).astype(np.float16)
    x[4:8, :, 32:] += 1
    sigma = np.where(np.arange(256) < 128, 0.02, 0.2)[None] * np.ones((256, 1))
    error = (sigma * rng.normal(size=sigma.shape)).astype(np.float16)
    parts = fit([Patch(x, error, np.ones_like(error))], 120, rng)
    with torch.no_grad():
        out = DESIGN.forward(parts, torch.from_numpy(x.astype(np.float32))[None]).numpy()[0]
    told = np.exp(out[:16].mean(0))
    small, large = np.median(told[:, 2:14]), np.median(told[:, 18:30])
    assert small == pytest.approx(0.02, rel=0.5)
    assert large == pytest.approx(0.2, rel=0.5)
