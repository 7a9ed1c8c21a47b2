"""Views on a polar grid with exact inverse range: what joint matching works on."""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from analytic_world import View, World, look, true_pose

from sphstereo_ros.core import rotations
from sphstereo_ros.core.frames import RelativePose
from sphstereo_ros.core.matching import stereo_grid
from sphstereo_ros.core.sphere import polar_axes, polar_bearings
from sphstereo_ros.core.warp import PolarGrid, polar_map, resample, with_border

Vector = tuple[float, float, float]
HEIGHT = 160


@dataclass(frozen=True)
class PolarView:
    """The current view on its polar grid, and its references (images and poses)."""

    image: np.ndarray
    grid: PolarGrid
    axes: np.ndarray
    pairs: list[tuple[np.ndarray, RelativePose]]
    current: View
    world: World

    def rho(self, grid: PolarGrid | None = None) -> np.ndarray:
        """Exact inverse range on `grid`, 1/m."""
        grid = grid or self.grid
        bearings = polar_bearings(grid.theta()[None], grid.azimuth()[:, None], self.axes)
        rays = bearings @ self.current.rotation.T
        return (1 / self.world.range(self.current.position, rays)).astype(np.float32)

    def theta(self, grid: PolarGrid | None = None) -> np.ndarray:
        """Degrees from the direction of motion, of every pixel."""
        grid = grid or self.grid
        return np.broadcast_to(np.degrees(grid.theta()), grid.shape)


def polar_view(world: World, positions: Sequence[Vector], turn: Vector = (0, 0, 0),
               reference_turn: Vector = (0, 0, 0), height: int = HEIGHT) -> PolarView:
    """A camera at the origin; references at `positions`, nearest first."""
    current = look(world, rotation=rotations.exp(turn), height=height)
    views = [look(world, at, rotations.exp(reference_turn), height) for at in positions]
    pairs = [(view.image, true_pose(view, current)) for view in views]
    grid, axes = stereo_grid(height), polar_axes(pairs[0][1].direction)
    image = resample(with_border(current.image), polar_map(grid, axes, current.image.shape))
    return PolarView(np.asarray(image, np.uint8), grid, axes, pairs, current, world)
