"""The network that judges a match, while it is fitted: runs where torch and onnx are."""
from __future__ import annotations

import cv2
import numpy as np
import pytest

from sphstereo_ros.bench.match_judge import DESIGN, Patch, fit
from sphstereo_ros.bench.unet import plain
from sphstereo_ros.core.match_judge import CHANNELS

torch = pytest.importorskip('torch')
pytest.importorskip('onnx')


@pytest.mark.parametrize('shape', [(64, 64), (96, 32)])
def test_opencv_runs_what_was_fitted(shape):
    parts = DESIGN.begun(torch.Generator().manual_seed(1))
    net = cv2.dnn.readNetFromONNX(np.frombuffer(DESIGN.as_onnx(plain(parts)), np.uint8))
    x = np.random.default_rng(0).normal(size=(1, CHANNELS, *shape)).astype(np.float32)
    net.setInput(x)
    with torch.no_grad():
        expected = DESIGN.forward(parts, torch.from_numpy(x)).numpy()
    assert expected.shape == (1, 48, *(n // 2 for n in shape))
    np.testing.assert_allclose(net.forward(), expected, atol=1e-4)


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
