"""U-nets as they are fitted and as OpenCV runs them: where torch and onnx are."""
from __future__ import annotations

import cv2
import numpy as np
import pytest

from sphstereo_ros.bench import match_judge, surroundings
from sphstereo_ros.bench.unet import plain

torch = pytest.importorskip('torch')
pytest.importorskip('onnx')


@pytest.mark.parametrize('shape', [(64, 64), (96, 32)])
@pytest.mark.parametrize(('design', 'step'), [(surroundings.DESIGN, 1), (match_judge.DESIGN, 2)])
def test_opencv_runs_what_was_fitted(design, step, shape):
    parts = design.begun(torch.Generator().manual_seed(1))
    net = cv2.dnn.readNetFromONNX(np.frombuffer(design.as_onnx(plain(parts)), np.uint8))
    x = np.random.default_rng(0).normal(size=(1, design.channels, *shape)).astype(np.float32)
    net.setInput(x)
    with torch.no_grad():
        expected = design.forward(parts, torch.from_numpy(x)).numpy()
    assert expected.shape == (1, len(design.begin), *(n // step for n in shape))
    np.testing.assert_allclose(net.forward(), expected, atol=1e-4)
