"""Points in space, seen from two cameras: the truth for tests of the relative pose."""
from __future__ import annotations

import numpy as np

from sphstereo_ros.core import rotations
from sphstereo_ros.core.relative_pose import Correspondences

MOTIONS = {'forward': (0.0, 0.0, -1.0), 'backward': (0.0, 0.0, 1.0), 'left': (1.0, 0.0, 0.0),
           'right': (-1.0, 0.0, 0.0), 'up': (0.0, 1.0, 0.0), 'down': (0.0, -1.0, 0.0),
           'oblique': (0.3, -0.6, 0.7)}  # position of the reference camera


def unit(v: np.ndarray) -> np.ndarray:
    v = np.asarray(v, np.float64)
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def random_rotation(rng: np.random.Generator, angle: float) -> np.ndarray:
    return rotations.exp(angle * unit(rng.normal(size=3)))


def two_views(rng: np.random.Generator, shape: tuple[int, ...], rotation: np.ndarray,
              position: np.ndarray, near: float = 1.5,
              far: float = 20.0) -> tuple[np.ndarray, np.ndarray]:
    """Bearings (*shape, 3) in the reference and in the current view, of points all around."""
    points = unit(rng.normal(size=(*shape, 3))) * rng.uniform(near, far, (*shape, 1))
    return unit((points - np.asarray(position)) @ rotation), unit(points)


def disturbed(rng: np.random.Generator, bearings: np.ndarray, sigma: float) -> np.ndarray:
    """Bearings with an error of `sigma` rad each way."""
    return unit(bearings + sigma * rng.normal(size=bearings.shape))


def matches(reference: np.ndarray, current: np.ndarray, sigma: float = 1e-3) -> Correspondences:
    """Correspondences that are expected to be equally good."""
    return Correspondences(reference, current, np.full(len(reference), sigma))


def correspondences(rng: np.random.Generator, count: int, rotation: np.ndarray,
                    position: np.ndarray, *, noise: float = 0.0, outliers: float = 0.0,
                    **distances: float) -> Correspondences:
    """The first `outliers` · count correspondences are wrong: another direction altogether."""
    reference, current = two_views(rng, (count,), rotation, position, **distances)
    wrong = round(outliers * count)
    reference[:wrong] = unit(rng.normal(size=(wrong, 3)))
    return matches(disturbed(rng, reference, noise), disturbed(rng, current, noise))


def angle_between(a: np.ndarray, b: np.ndarray) -> float:
    """Radians."""
    return float(np.arctan2(np.linalg.norm(np.cross(a, b)), np.dot(a, b)))
