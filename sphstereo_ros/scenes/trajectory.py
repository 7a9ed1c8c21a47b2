"""Where the camera is: positions and attitudes for every frame, in the world of a scene."""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

FRAME_RATE = 30.0  # Hz, of all sequences

# Axes of camera_optical (x right, y down, z forward) in a body frame (x forward, y left, z up).
BODY_FROM_OPTICAL: Array = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


@dataclass(frozen=True)
class Trajectory:
    """rotations : (n, 3, 3) world ← camera_optical; positions : (n, 3) metres, world."""

    rotations: Array
    positions: Array

    def __post_init__(self) -> None:
        if self.rotations.shape != (len(self.positions), 3, 3):
            raise ValueError('as many rotations as positions are needed')

    def __len__(self) -> int:
        return len(self.positions)


def roll_pitch_yaw(roll: float, pitch: float, yaw: float) -> Array:
    """Rz(yaw) Ry(pitch) Rx(roll), radians."""
    turned: Array = np.eye(3)
    for axis, angle in zip(np.eye(3)[::-1], (yaw, pitch, roll), strict=True):
        turned = turned @ cv2.Rodrigues(axis * angle)[0]
    return turned


def shaken(rng: np.random.Generator, frames: int, low: float, high: float,
           limit: float = np.radians(5.0)) -> Array:
    """Random attitudes (n, 3, 3) about level.

    Consecutive ones differ by a rotation of `low` to `high` rad about a random axis; none is
    farther than `limit` from level, or than `high`, if that is more.
    """
    attitudes = [np.eye(3)]
    for _ in range(frames - 1):
        angle = rng.uniform(low, high)
        for _ in range(100):
            axis = rng.normal(size=3)
            step = cv2.Rodrigues(axis / np.linalg.norm(axis) * angle)[0]
            new = attitudes[-1] @ step
            if np.arccos(np.clip((np.trace(new) - 1) / 2, -1, 1)) <= max(limit, high):
                break
        attitudes.append(new)
    return np.stack(attitudes)


def _wander(rng: np.random.Generator, frames: int, sigma: float) -> Array:
    """A smooth random sequence (n,) of standard deviation `sigma`."""
    raw = rng.normal(size=frames + 12)
    smooth = np.convolve(raw, np.hanning(15)[1:-1], mode='valid')[:frames]
    return sigma * smooth / float(np.sqrt(np.sum(np.hanning(15) ** 2)))


def _steps(spacing: float | Sequence[float], frames: int) -> Array:
    return np.array(np.broadcast_to(spacing, max(frames - 1, 0)), np.float64)


def drive(rng: np.random.Generator, frames: int, start: Sequence[float],
          spacing: float | Sequence[float], heading: float = 0.0, turn: float = 0.0,
          drift: float = 0.015) -> tuple[Array, Array]:
    """Level travel: (attitudes (n, 3, 3) world ← body, positions (n, 3)).

    spacing : metres between consecutive frames, one or n − 1 values, kept exactly; heading and
    turn : rad and rad a frame, REP-103; drift : standard deviation of the direction of travel
    about the heading, rad, sideways and, half as much, up and down
    """
    yaw = heading + turn * np.arange(frames)
    side, climb = _wander(rng, frames, drift), _wander(rng, frames, 0.5 * drift)
    way = np.stack([np.cos(climb) * np.cos(yaw + side), np.cos(climb) * np.sin(yaw + side),
                    np.sin(climb)], axis=-1)
    steps = _steps(spacing, frames)[:, None] * way[:max(frames - 1, 0)]
    positions = np.asarray(start) + np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
    return np.stack([roll_pitch_yaw(0, 0, y) for y in yaw]), positions


def climb(rng: np.random.Generator, frames: int, start: Sequence[float],
          spacing: float | Sequence[float] | None = None, heading: float = 0.0,
          drift: float = 0.12) -> tuple[Array, Array]:
    """Take-off: as `drive`, but upward.

    spacing : metres between frames; None rises from 0.20 to 0.35 over the sequence;
    drift : standard deviation of the direction of travel about the vertical, rad
    """
    rise = np.linspace(0.20, 0.35, max(frames - 1, 0)) if spacing is None else _steps(
        spacing, frames)
    x, y = _wander(rng, frames, drift)[:-1], _wander(rng, frames, drift)[:-1]
    way = np.stack([np.sin(x), np.sin(y), np.cos(x) * np.cos(y)], axis=-1)
    way /= np.linalg.norm(way, axis=1)[:, None]
    steps = rise[:, None] * way
    positions = np.asarray(start) + np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
    return np.stack([roll_pitch_yaw(0, 0, heading)] * frames), positions


def mounted(attitudes: Array, positions: Array, shake: Array,
            mount: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Trajectory:
    """The trajectory of a camera on a vehicle; mount is its roll, pitch, yaw in `base_link`."""
    camera = roll_pitch_yaw(*mount) @ BODY_FROM_OPTICAL
    return Trajectory(attitudes @ shake @ camera, positions)
