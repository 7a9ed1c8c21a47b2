"""A small world with exact range: a textured room, and posts in it, seen by closed forms.

World axes are those of a camera that is not turned: x right, y down, z forward. The camera is at
the origin unless it is moved.
"""
from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import cv2
import numpy as np

from sphstereo_ros.core.camera import Equirectangular
from sphstereo_ros.core.frames import Frame, FrameKey, PairedWindow, Reference, RelativePose

Vector = tuple[float, float, float]


@dataclass(frozen=True)
class World:
    """A room from `low` to `high` (metres) with posts (x, z, radius) from floor to ceiling.

    cell : metres of the coarsest texture; blank_above : the ceiling is one even grey
    """

    low: Vector = (-4.0, -3.0, -9.0)
    high: Vector = (5.0, 1.6, 10.0)
    posts: tuple[Vector, ...] = ((2.0, 3.0, 0.3), (-2.2, -1.5, 0.4), (-1.5, 5.0, 0.25))
    cell: float = 0.8
    blank_above: bool = False

    def range(self, position: np.ndarray, rays: np.ndarray) -> np.ndarray:
        """Distance from `position` to what each unit ray (..., 3) meets first."""
        with np.errstate(divide='ignore', invalid='ignore'):
            ahead = np.where(rays > 0, self.high, self.low)
            distance = ((ahead - position) / rays)
        distance = np.where(rays == 0, np.inf, distance).min(axis=-1)
        flat = np.hypot(rays[..., 0], rays[..., 2])
        for x, z, radius in self.posts:
            along = (x - position[0]) * rays[..., 0] + (z - position[2]) * rays[..., 2]
            apart = (x - position[0])**2 + (z - position[2])**2 - radius**2
            with np.errstate(divide='ignore', invalid='ignore'):
                root = (along - np.sqrt(along**2 - flat**2 * apart)) / flat**2
            distance = np.where(root > 0, np.minimum(distance, root), distance)  # NaN: not met
        return distance

    def brightness(self, points: np.ndarray) -> np.ndarray:
        """Grey level of points (..., 3): smooth noise that fills the space."""
        out = 128 + sum(weight * _noise(points / (self.cell * size), seed)
                        for seed, (size, weight) in enumerate(
                            ((1.0, 150.0), (0.5, 110.0), (0.25, 80.0), (0.125, 50.0))))
        if self.blank_above:
            out = np.where(points[..., 1] < self.low[1] + 1e-6, 200.0, out)
        return np.clip(out, 0, 255)


@dataclass(frozen=True)
class Ball(World):
    """A hollow sphere about the origin: seen from there, everything is `radius` metres away."""

    radius: float = 3.0

    def range(self, position: np.ndarray, rays: np.ndarray) -> np.ndarray:
        """Distance from `position` (inside) to the sphere, along each unit ray (..., 3)."""
        along = rays @ position
        return np.sqrt(along**2 + self.radius**2 - position @ position) - along


@cache
def _lattice(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-0.5, 0.5, 64**3).astype(np.float32)


def _noise(points: np.ndarray, seed: int) -> np.ndarray:
    """Random values on the whole-numbered lattice, smoothly interpolated, −½ … ½."""
    points = points.astype(np.float32) + np.float32(17.3 + seed)
    floor = np.floor(points)
    t = points - floor
    t = t * t * (3 - 2 * t)
    low = floor.astype(np.int32) & 63
    high = (low + 1) & 63
    table, out = _lattice(seed), np.zeros(points.shape[:-1], np.float32)
    for corner in range(8):
        upper = [(corner >> axis) & 1 for axis in range(3)]
        x, y, z = ((high if up else low)[..., axis] for axis, up in enumerate(upper))
        weight = np.prod([t[..., a] if up else 1 - t[..., a] for a, up in enumerate(upper)],
                         axis=0)
        out += weight * table[(x * 64 + y) * 64 + z]
    return out


@dataclass(frozen=True)
class View:
    """What a camera sees: image (H, 2H) uint8, exact range (H, 2H), and where it is."""

    image: np.ndarray
    range: np.ndarray
    rotation: np.ndarray  # X_world = rotation · X_camera + position
    position: np.ndarray


def look(world: World, position: Vector | np.ndarray = (0.0, 0.0, 0.0),
         rotation: np.ndarray | None = None, height: int = 280, noise: float = 1.0) -> View:
    """A picture from `position` (four rays a pixel), with grey noise of `noise` levels."""
    position, turn = np.asarray(position, float), np.eye(3) if rotation is None else rotation
    rays = Equirectangular(2 * height, 4 * height).bearings() @ turn.T
    points = position + rays * world.range(position, rays)[..., None]
    fine = world.brightness(points)
    grey = cv2.resize(fine.astype(np.float32), (2 * height, height), interpolation=cv2.INTER_AREA)
    seed = abs(hash((tuple(position), tuple(turn.ravel())))) % 2**32
    grey = grey + noise * np.random.default_rng(seed).normal(size=grey.shape)
    rays = Equirectangular(height, 2 * height).bearings() @ turn.T
    return View(np.clip(np.round(grey), 0, 255).astype(np.uint8), world.range(position, rays),
                turn, position)


def true_pose(reference: View, current: View) -> RelativePose:
    """Pose of the reference camera in the current one's frame."""
    return RelativePose(current.rotation.T @ reference.rotation,
                        current.rotation.T @ (reference.position - current.position))


def window(current: View, *references: tuple[View, RelativePose]) -> PairedWindow:
    """A window of views with the poses that are believed beforehand."""
    def frame(view: View, stamp: int) -> Frame:
        return Frame(FrameKey(stamp, 'camera_optical'), view.image)

    return PairedWindow(frame(current, 100), tuple(
        Reference(frame(view, 99 - i), pose) for i, (view, pose) in enumerate(references)))
