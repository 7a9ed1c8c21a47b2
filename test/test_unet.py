"""U-nets as they are fitted and as OpenCV runs them: where torch and onnx are."""
from __future__ import annotations

import cv2
import numpy as np
import pytest

from sphstereo_ros.bench import match_judge, memory_judge, surroundings
from sphstereo_ros.bench.unet import Design, kept_patches, plain

torch = pytest.importorskip('torch')
pytest.importorskip('onnx')


@pytest.mark.parametrize('shape', [(64, 64), (96, 32)])
@pytest.mark.parametrize(('design', 'step'), [(surroundings.DESIGN, 1), (match_judge.DESIGN, 2),
                                              (memory_judge.DESIGN, 1)])
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


def test_patches_that_were_kept_are_found_again(tmp_path):
    rng = np.random.default_rng(0)

    def patch() -> surroundings.Patch:
        x, error, true, weight = (rng.normal(size=(3, 4, 5)).astype(np.float16) for _ in range(4))
        return surroundings.Patch(x, error, true, weight, 0.25)
    made = [patch(), patch()]
    folder, kept = tmp_path / 'street_7', tmp_path / 'kept'
    measured = []

    def patches_of(folder, rng):
        measured.append(rng.integers(1000))
        return made
    for _ in range(2):
        found = kept_patches(folder, kept, surroundings.Patch, patches_of)
        for one, other in zip(found, made, strict=True):
            assert vars(one).keys() == vars(other).keys()
            for name, value in vars(one).items():
                np.testing.assert_array_equal(value, getattr(other, name))
    assert len(measured) == 1
    assert isinstance(found[0].x, np.memmap)
    kept_patches(tmp_path / 'street_8', kept, surroundings.Patch, patches_of)
    assert measured[0] != measured[1]  # each scene's poses are disturbed in their own way
    assert kept_patches(folder, None, surroundings.Patch, patches_of) is made


def test_in_bfloat16_it_is_fitted_as_well():
    design = Design(3, (4, 6), 4, [0.0], deep=True)
    rng = np.random.default_rng(0)

    def draw():
        x = torch.from_numpy(rng.normal(size=(1, 3, 16, 16)).astype(np.float32))
        return x, x[:, :1] - x[:, 1:2]

    def loss(out, wanted):
        return (out - wanted).abs().mean()
    losses = []
    for bfloat16 in (False, True):
        parts = design.fitted(draw, loss, 300, 2, rate=1e-2, bfloat16=bfloat16)
        assert all(p.dtype == torch.float32 for p in parts.values())
        x, wanted = draw()
        losses.append(float(loss(design.forward(parts, x), wanted).detach()))
    assert max(losses) < 0.3
