"""U-nets as they are fitted and as OpenCV runs them: where torch and onnx are."""
from __future__ import annotations

import cv2
import numpy as np
import pytest

from sphstereo_ros.bench import match_judge, surroundings
from sphstereo_ros.bench.unet import Design, plain

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


def test_a_wider_one_goes_on_where_a_narrower_one_was():
    """With more inputs, channels and outputs it tells the same at first."""
    narrow = Design(5, (4, 6, 6), 4, [0.0] * 4, deep=True)
    wide = Design(7, (6, 6, 8), 5, [0.0] * 6, deep=True)
    start = plain(narrow.begun(torch.Generator().manual_seed(1)))
    x = torch.from_numpy(np.random.default_rng(0).normal(size=(1, 7, 16, 16)).astype(np.float32))
    with torch.no_grad():
        expected = narrow.forward({n: torch.from_numpy(v) for n, v in start.items()}, x[:, :5])
        found = wide.forward(wide.fitted(lambda: (x,), lambda out: out.sum(), 0, 1, start), x)
    np.testing.assert_allclose(found[:, :4], expected, atol=1e-6)
    assert expected.std() > 1e-3
