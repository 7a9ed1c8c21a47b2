"""Hollows: what two frames see is one world."""
from __future__ import annotations

import cv2
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from sphstereo_ros.bench.hollows import hollow
from sphstereo_ros.core.camera import Equirectangular


@settings(max_examples=12, deadline=None)
@given(st.integers(0, 10**6), st.floats(0.01, 3))
def test_what_one_frame_sees_another_sees_there_too(seed, step):
    """In range and in grey, ten steps apart."""
    before, now = hollow(seed, (1, 11), step)
    assert np.linalg.norm(now.position - before.position) > 9.9 * step
    height = len(now.range)
    camera = Equirectangular(height, 2 * height)
    rays = camera.bearings() @ before.rotation.T
    points = before.position + before.range[..., None] * rays - now.position
    distance = np.linalg.norm(points, axis=-1)
    x, y, z = np.moveaxis(points @ now.rotation, -1, 0) / distance
    column = (np.arctan2(x, z) / (2 * np.pi) + 0.5) * 2 * height - 0.5
    row = (np.arcsin(np.clip(y, -1, 1)) / np.pi + 0.5) * height - 0.5
    use = (np.abs(row - height / 2) < height / 3) & (column > 1) & (column < 2 * height - 2)

    def there(image: np.ndarray) -> np.ndarray:
        return cv2.remap(image.astype(np.float32), column.astype(np.float32),
                         row.astype(np.float32), cv2.INTER_CUBIC)[use]
    np.testing.assert_allclose(there(now.range), distance[use], rtol=0.01)
    grey = before.image[..., 0].astype(np.float32)[use]
    apart = there(now.image[..., 0]) - grey
    assert np.median(np.abs(apart)) < 0.25 * np.std(grey) + 4
    assert np.std(grey) > 2


def test_a_seed_is_a_world():
    one, same, other = (hollow(seed, (1, 2), 0.28)[0] for seed in (5, 5, 6))
    np.testing.assert_array_equal(one.image, same.image)
    assert one.image.shape != other.image.shape or (one.image != other.image).any()
