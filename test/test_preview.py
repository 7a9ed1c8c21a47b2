from __future__ import annotations

import numpy as np

from sphstereo_ros.core.frames import FrameKey, RangeImage
from sphstereo_ros.core.preview import FAR, NEAR, colour_map


def coloured(*ranges: float, is_metric: bool = True) -> np.ndarray:
    r = np.array([ranges], np.float32)
    return colour_map(RangeImage(FrameKey(0, ''), r, 0.1 * np.abs(r), is_metric))[0].astype(int)


def test_near_is_red_and_far_is_blue():
    near, middle, far = coloured(NEAR * 1.3, np.sqrt(NEAR * FAR), FAR / 1.3)
    assert near[2] > 2 * near[0]  # BGR
    assert middle[1] > max(middle[0], middle[2])
    assert far[0] > far[2]


def test_what_has_no_range_has_colours_of_its_own():
    colours = coloured(np.nan, np.inf, -np.inf, 0.01, 5.0, 1e5)
    assert len({tuple(c) for c in colours}) == 6
    assert colours[0].max() < 40  # unknown is dark
    assert colours[2].min() == 255  # too near is white


def test_beyond_the_scale_is_its_end():
    np.testing.assert_array_equal(coloured(NEAR / 10), coloured(NEAR))
    np.testing.assert_array_equal(coloured(FAR * 10), coloured(FAR))


def test_without_metres_a_baseline_counts_as_thirty_centimetres():
    np.testing.assert_array_equal(coloured(10.0, is_metric=False), coloured(3.0))


def test_shape_and_type():
    r = np.full((20, 40), 3.0, np.float32)
    out = colour_map(RangeImage(FrameKey(0, ''), r, r, True))
    assert out.shape == (20, 40, 3)
    assert out.dtype == np.uint8
