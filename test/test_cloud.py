from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sphstereo_ros.core.camera import Equirectangular
from sphstereo_ros.core.cloud import MAX_BYTES, default_stride, point_cloud
from sphstereo_ros.core.config import resolve
from sphstereo_ros.core.frames import Frame, FrameKey, RangeImage

KEY = FrameKey(5, 'camera_optical')
H = 24


def example(seed: int = 0) -> tuple[RangeImage, Frame]:
    rng = np.random.default_rng(seed)
    r = rng.uniform(0.5, 50, (H, 2 * H)).astype(np.float32)
    kind = rng.integers(0, 6, r.shape)
    r[kind == 0], r[kind == 1], r[kind == 2] = np.nan, np.inf, -np.inf
    sigma = np.where(np.isfinite(r), 0.01 * r, np.nan).astype(np.float32)
    colour = rng.integers(0, 255, (H, 2 * H, 3), np.uint8)
    return RangeImage(KEY, r, sigma, True), Frame(KEY, colour[..., 0].copy(), colour)


def single(u: int, v: int, distance: float) -> RangeImage:
    r = np.full((H, 2 * H), np.nan, np.float32)
    r[v, u] = distance
    return RangeImage(KEY, r, 0.1 * r, True)


def test_points_are_range_times_bearing():
    range_image, frame = example()
    cloud = point_cloud(range_image, frame, resolve({'points.stride': 1}))
    known = np.isfinite(range_image.range)
    optical = Equirectangular(H, 2 * H).bearings()[known] * range_image.range[known][:, None]
    # base_link of a camera without mount: x forward (z), y left (−x), z up (−y)
    expected = np.stack([optical[:, 2], -optical[:, 0], -optical[:, 1]], axis=1)
    assert cloud.key == KEY
    assert len(cloud.xyz) == known.sum()
    np.testing.assert_allclose(cloud.xyz, expected, rtol=1e-5, atol=1e-5)
    np.testing.assert_array_equal(cloud.sigma, range_image.sigma[known])
    np.testing.assert_array_equal(cloud.intensity, frame.image[known])
    assert cloud.bgr is None
    assert cloud.xyz.dtype == cloud.sigma.dtype == np.float32


@pytest.mark.parametrize(('mount', 'expected'), [
    # What the camera sees 10 m straight ahead, half a pixel right and below its centre.
    ({'x': 1.0, 'y': 2.0, 'z': 3.0}, (11, 2, 3)),
    ({'yaw': np.pi / 2}, (0, 10, 0)),
    ({'pitch': np.pi / 2}, (0, 0, -10)),
    ({'roll': np.pi / 2}, (10, 0, 0)),
    ({'yaw': np.pi, 'pitch': np.pi / 2, 'z': 0.5}, (0, 0, -9.5)),
    ({'yaw': np.pi / 2, 'roll': np.pi / 2, 'x': -1.0}, (-1, 10, 0)),
])
def test_mount_brings_points_to_base_link(mount, expected):
    config = resolve({f'camera.mount.{k}': v for k, v in mount.items()})
    _, frame = example()
    cloud = point_cloud(single(H, H // 2, 10.0), frame, config)
    # The pixel nearest to the centre is half a pixel off: 10 m · π / 48 = 0.65 m each way.
    np.testing.assert_allclose(cloud.xyz, [expected], atol=0.7)
    offset = np.linalg.norm(cloud.xyz[0] - [mount.get(axis, 0.0) for axis in 'xyz'])
    assert offset == pytest.approx(10.0, rel=1e-5)


def test_a_rolled_camera_sees_its_right_below():
    config = resolve({'camera.mount.roll': np.pi / 2, 'points.stride': 1})
    _, frame = example()
    (x, y, z), = point_cloud(single(3 * H // 2, H // 2, 10.0), frame, config).xyz
    assert z == pytest.approx(-10, abs=0.1)
    assert abs(x) < 0.7
    assert abs(y) < 0.7


@given(st.integers(240, 2160))
def test_default_stride_keeps_a_cloud_within_8_megabytes_and_no_coarser(height):
    def size(stride: int) -> int:
        return len(range(0, height, stride)) * len(range(0, 2 * height, stride)) * 20

    stride = default_stride(height)
    assert size(stride) <= MAX_BYTES == 8_000_000
    assert stride == 1 or size(stride - 1) > MAX_BYTES


def test_stride_takes_every_nth_row_and_column():
    range_image, frame = example()
    for stride in (1, 2, 3, 5, 256):
        cloud = point_cloud(range_image, frame, resolve({'points.stride': stride}))
        r = range_image.range[::stride, ::stride]
        assert len(cloud.xyz) == len(cloud.sigma) == np.isfinite(r).sum()
        np.testing.assert_allclose(np.linalg.norm(cloud.xyz, axis=1), r[np.isfinite(r)], rtol=1e-5)
    small = point_cloud(range_image, frame, resolve({}))  # stride 0: this small one is not thinned
    assert len(small.xyz) == np.isfinite(range_image.range).sum()


def test_large_images_are_thinned_by_default():
    height = 960
    r = np.full((height, 2 * height), 3.0, np.float32)
    frame = Frame(KEY, np.zeros(r.shape, np.uint8))
    cloud = point_cloud(RangeImage(KEY, r, 0.1 * r, True), frame, resolve({}))
    assert MAX_BYTES / 4 < 20 * len(cloud.xyz) <= MAX_BYTES


def test_colour_where_it_is_asked_for():
    range_image, frame = example()
    cloud = point_cloud(range_image, frame, resolve({'points.colour': True}))
    np.testing.assert_array_equal(cloud.bgr, frame.colour[np.isfinite(range_image.range)])
    assert cloud.intensity is None
    grey = point_cloud(range_image, Frame(KEY, frame.image), resolve({'points.colour': True}))
    np.testing.assert_array_equal(grey.intensity, frame.image[np.isfinite(range_image.range)])
    assert grey.bgr is None


def test_nothing_known_is_a_cloud_without_points():
    _, frame = example()
    r = np.full((H, 2 * H), np.nan, np.float32)
    cloud = point_cloud(RangeImage(KEY, r, r, True), frame, resolve({}))
    assert cloud.xyz.shape == (0, 3)
    assert cloud.sigma.shape == cloud.intensity.shape == (0,)
