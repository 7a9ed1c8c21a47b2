"""Point clouds in `base_link` from range images."""
from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from .camera import Equirectangular
from .config import CameraConfig, Config
from .frames import Frame, PointCloud, RangeImage
from .jit import kernel
from .rotations import mount, mounted_on

MAX_BYTES = 8_000_000
BYTES_PER_POINT = 20  # x, y, z, colour or intensity, sigma


def default_stride(height: int) -> int:
    """Least stride that keeps a cloud of a (height, 2·height) range image within MAX_BYTES."""
    stride = 1
    while -(-height // stride) * -(-2 * height // stride) * BYTES_PER_POINT > MAX_BYTES:
        stride += 1
    return stride


@lru_cache(maxsize=4)
def _bearings(height: int, stride: int, camera: CameraConfig) -> NDArray[np.float32]:
    """Bearings (N, 3) of every stride-th pixel and row in base_link."""
    v, u = np.mgrid[0:height:stride, 0:2 * height:stride]
    optical = Equirectangular(height, 2 * height).unproject(np.stack([u, v], -1).astype(float))
    return (optical @ mount(camera).rotation.T).astype(np.float32).reshape(-1, 3)


def point_cloud(range_image: RangeImage, frame: Frame, config: Config) -> PointCloud:
    """Points of the finite ranges, every `points.stride`-th pixel, in `base_link`.

    frame : the current frame, for intensity or colour
    Raises ValueError where it is not known which camera measured.
    """
    camera = _placed(range_image, config.camera)
    height = range_image.range.shape[0]
    stride = config.points.stride or default_stride(height)
    thin = (slice(None, None, stride), slice(None, None, stride))
    r = np.ascontiguousarray(range_image.range[thin]).ravel()
    position = mount(camera).position.astype(np.float32)
    xyz, known = np.empty((r.size, 3), np.float32), np.empty(r.size, np.intp)
    count = _place(r, _bearings(height, stride, camera), position, xyz, known)
    known = known[:count]
    sigma = range_image.sigma[thin].ravel()[known]
    if config.points.colour and frame.colour is not None:
        bgr = frame.colour[thin].reshape(-1, 3)[known]
        return PointCloud(range_image.key, xyz[:count], sigma, bgr=bgr)
    return PointCloud(range_image.key, xyz[:count], sigma, frame.image[thin].ravel()[known])


def _placed(range_image: RangeImage, camera: CameraConfig) -> CameraConfig:
    """The mount of the camera that measured."""
    pose = range_image.camera
    if pose is None:
        raise ValueError('it is not known which camera measured')
    if not pose.position.any():
        return camera
    return mounted_on(camera, pose.rotation, pose.position)


@kernel
def _place(r: NDArray[np.float32], bearings: NDArray[np.float32], position: NDArray[np.float32],
           xyz: NDArray[np.float32],
           known: NDArray[np.intp]) -> int:  # pragma: no cover - compiled
    """Points of the finite ranges, packed; how many, and where they come from in `known`."""
    count = 0
    for i in range(r.size):
        if np.isfinite(r[i]):
            for axis in range(3):
                xyz[count, axis] = bearings[i, axis] * r[i] + position[axis]
            known[count] = i
            count += 1
    return count
