"""A small textured room with exact ranges: enough of a world to test the chain on."""
from __future__ import annotations

import numpy as np

from sphstereo_ros.core.camera import Equirectangular
from sphstereo_ros.core.frames import Frame, FrameKey

LOW, HIGH = np.array([-2.0, -1.5, -4.0]), np.array([3.0, 1.2, 6.0])


def _hash(cells: np.ndarray) -> np.ndarray:
    """Pseudo-random numbers in [0, 1) for integer cells (..., 3)."""
    mixed = cells.astype(np.int64) @ np.array([73856093, 19349663, 83492791])
    mixed = (mixed ^ (mixed >> 13)) * 1274126177
    return ((mixed ^ (mixed >> 16)) & 0xFFFF) / 65536.0


def _noise(points: np.ndarray) -> np.ndarray:
    """Value noise, smooth between the corners of unit cells."""
    base = np.floor(points)
    share = points - base
    share = share * share * (3 - 2 * share)
    total = np.zeros(points.shape[:-1])
    for corner in np.ndindex(2, 2, 2):
        offset = np.array(corner)
        weight = np.prod(np.where(offset == 1, share, 1 - share), axis=-1)
        total += weight * _hash(base + offset)
    return total


def view(position: np.ndarray, rotation: np.ndarray, height: int
         ) -> tuple[np.ndarray, np.ndarray]:
    """Image (H, 2H) uint8 and range (H, 2H) metres from a camera in the room.

    position : of the camera, room axes = optical axes of an unrotated camera;
    rotation : room ← camera_optical
    """
    bearings = Equirectangular(height, 2 * height).bearings() @ rotation.T
    with np.errstate(divide='ignore'):
        walls = np.where(bearings > 0, HIGH - position, LOW - position) / bearings
    distance = np.min(walls, axis=-1)
    points = position + bearings * distance[..., None]
    grey = sum(_noise(points * scale + 17) / i for i, scale in enumerate((3.0, 7.0, 15.0), 1))
    return (40 + 110 * grey).clip(0, 255).astype(np.uint8), distance


def forward(count: int, step: float, height: int, *, first: int = 1_700_000_000_000_000_000,
            period: int = 33_333_333, frame_id: str = 'camera_optical') -> list[Frame]:
    """Frames of a camera that moves `step` metres forward from each to the next."""
    return [Frame(FrameKey(first + i * period, frame_id),
                  view(np.array([0.0, 0.0, step * i]), np.eye(3), height)[0])
            for i in range(count)]
