from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sphstereo_ros.core.block_matching import CAP, MAX_BLOCK, UNIQUE, block_match
from sphstereo_ros.core.config import PARAMETERS, StereoConfig
from sphstereo_ros.core.matching import UNKNOWN, matcher


def views(seed: int, shape: tuple[int, int], blur: float,
          shift: float) -> tuple[np.ndarray, np.ndarray]:
    """Two noisy views of one texture: shifted by `shift` above, and by twice as much below; partly
    flat, and partly periodic (so that matches are not unique).
    """
    rng = np.random.default_rng(seed)
    texture = rng.normal(size=(shape[0], shape[1] + 200))
    texture = cv2.GaussianBlur(texture, (0, 0), blur) if blur else texture
    texture = 128 + 60 * texture / texture.std()
    texture[:, 120:150] = 90
    texture[40:70] = 128 + 80 * np.sin(np.arange(texture.shape[1]) / 2)
    rows, columns = (a.astype(np.float32) for a in np.mgrid[:shape[0], :shape[1]])
    moved = columns + np.where(rows < shape[0] / 2, shift, 2 * shift).astype(np.float32)
    seen = [cv2.remap(texture.astype(np.float32), at, rows, cv2.INTER_LINEAR)
            for at in (columns, moved)]
    return tuple(np.clip(np.round(s + rng.normal(size=shape)), 0, 255).astype(np.uint8)
                 for s in seen)


def of_opencv(current: np.ndarray, reference: np.ndarray, disparities: int,
              block: int) -> np.ndarray:
    stereo = cv2.StereoBM_create(disparities, block)
    stereo.setUniquenessRatio(UNIQUE)
    found = stereo.compute(current, reference)
    return np.where(found > 0, found / 16, UNKNOWN).astype(np.float32)


@given(st.integers(0, 10**6), st.sampled_from([16, 32, 48, 96]),
       st.sampled_from([5, 7, 11, 15, 21, 31]), st.sampled_from([0.0, 1.0, 3.0]),
       st.floats(0.0, 20.0))
@settings(deadline=None, max_examples=25)
def test_inside_every_parallax_is_that_of_opencv(seed, disparities, block, blur, shift):
    current, reference = views(seed, (150, 260), blur, shift)
    half = block // 2
    inside = (slice(half, -half), slice(disparities - 1 + half, -half))
    found = block_match(current, reference, disparities, block, UNKNOWN)
    assert found.shape == current.shape
    np.testing.assert_array_equal(found[inside],
                                  of_opencv(current, reference, disparities, block)[inside])


def test_the_comparison_is_of_known_and_unknown_pixels():
    current, reference = views(1, (150, 260), 1.0, 6.3)
    found = block_match(current, reference, 48, 11, UNKNOWN)[10:-10, 60:-10]
    assert 0.4 < (found != UNKNOWN).mean() < 0.95


def test_nothing_is_lost_at_the_rim():
    """Where OpenCV is silent: in columns less than the search range, and beside every edge."""
    current, reference = views(2, (150, 260), 1.0, 3.0)
    found = block_match(current, reference, 96, 15, UNKNOWN)
    assert (np.abs(found[:40, 8:100] - 3) < 0.5).mean() > 0.9
    assert (np.abs(found[0, 8:100] - 3) < 0.5).mean() > 0.8
    assert (np.abs(found[-1, 16:100] - 6) < 0.5).mean() > 0.8


@pytest.mark.parametrize('height', [1, 2, 5])
def test_images_lower_than_the_window_are_matched(height):
    current, reference = (v[:height].copy() for v in views(3, (150, 260), 1.0, 4.0))
    found = block_match(current, reference, 32, 21, UNKNOWN)
    assert found.shape == (height, 260)
    assert (np.abs(found[:, 20:110] - 4) < 0.5).mean() > 0.8


def test_sums_of_the_largest_window_do_not_overflow():
    """Full contrast, as unlike as can be."""
    assert np.iinfo(np.uint16).max > MAX_BLOCK**2 * 2 * CAP
    stripes = np.where(np.arange(200) % 8 < 4, 0, 255).astype(np.uint8)
    current = np.tile(stripes, (100, 1))
    reference = np.tile(np.roll(stripes, 2), (100, 1))
    reference[::2] = 255 - reference[::2]
    half = MAX_BLOCK // 2
    inside = (slice(half, -half), slice(31 + half, -half))
    found = block_match(current, reference, 32, MAX_BLOCK, UNKNOWN)
    np.testing.assert_array_equal(found[inside],
                                  of_opencv(current, reference, 32, MAX_BLOCK)[inside])


def test_every_window_that_may_be_configured_is_matched():
    current, reference = views(4, (150, 260), 1.0, 5.0)
    largest = int(PARAMETERS['stereo.block_size'].high)
    assert largest > MAX_BLOCK
    for block in (MAX_BLOCK, MAX_BLOCK + 2, largest):
        match = matcher(StereoConfig(matcher='bm', num_disparities=32, block_size=block))
        assert np.median(match(current, reference).pixels[15:30, 60:100]) == pytest.approx(
            5, abs=0.3)
