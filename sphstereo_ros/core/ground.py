"""The ground about the vehicle, as a plane in the level frame.

The plane is found by random samples (Fischler and Bolles 1981), drawn evenly over the ground, not
over the picture: what is near fills most of the picture, and tells little of the slope.
"""
from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .jit import fast_kernel, kernel

Floats = NDArray[np.float64]
Plane = NDArray[np.float32]

# A polar grid in which every cell counts alike: rings in steps of equal ratio.
_RINGS, _WEDGES, _NEAREST, _FARTHEST = 16, 24, 0.3, 25.0
_PER_CELL = 3  # points of a cell that take part
_SAMPLES = 96
_ROUGH, _ROUGH_RATE = 0.08, 0.01  # m, and m per m of distance: how far ground is off its plane
_STEEPEST = math.tan(math.radians(20))
_LEAST_CELLS, _LEAST_SHARE = 12, 0.2  # of the cells that have points
_LEAST_HEIGHT = 0.05  # m: the camera is above the ground
_LEAST_DIP = 0.04  # sine of the angle below the horizon
_LEAST_SURE = 0.15  # m: standard deviation of a point's height


@dataclass(frozen=True)
class Ground:
    """The plane z = slope[0]·x + slope[1]·y + height of the level frame, metres."""

    slope: tuple[float, float]
    height: float

    def at(self, x: Floats, y: Floats) -> Floats:
        """Height of the ground at (x, y)."""
        return np.asarray(self.slope[0] * x + self.slope[1] * y + self.height)


def find_ground(points: Plane, camera: Floats) -> Ground | None:
    """The plane that most of the surface below the camera lies on; None where there is none.

    Parameters
    ----------
    points : (N, 3) metres, level frame: surfaces below the camera's horizon
    camera : (3,) metres, its position

    """
    chosen, weight = _spread_out(points, camera)
    if chosen is None:
        return None
    x, y, z = chosen.T
    cells = weight.sum()
    tolerance = _ROUGH + _ROUGH_RATE * np.hypot(x - camera[0], y - camera[1])
    planes = _candidates(chosen, camera)
    if not len(planes):
        return None
    best = planes[int(np.argmax(_scores(planes, chosen, tolerance, weight)))]
    for _ in range(3):
        off = np.abs(best[0] * x + best[1] * y + best[2] - z) / tolerance
        w = weight * np.clip(1 - off**2, 0, None)
        if weight[off < 1].sum() < max(_LEAST_CELLS, _LEAST_SHARE * cells):
            return None
        design = np.stack([x, y, np.ones_like(x)], axis=1)
        normal = design.T @ (w[:, None] * design)
        best = np.linalg.solve(normal + 1e-9 * np.eye(3), design.T @ (w * z))
    return None if _impossible(best[None], camera)[0] else Ground((best[0], best[1]), best[2])


@fast_kernel
def _scores(planes: Floats, points: Floats, tolerance: Floats,
            weight: Floats) -> Floats:  # pragma: no cover - compiled
    out = np.zeros(len(planes))
    for k in range(len(planes)):
        for i in range(len(points)):
            off = (planes[k, 0] * points[i, 0] + planes[k, 1] * points[i, 1] + planes[k, 2]
                   - points[i, 2]) / tolerance[i]
            out[k] += weight[i] * max(1 - off * off, 0.0)
    return out


def _impossible(planes: Floats, camera: Floats) -> NDArray[np.bool_]:
    below = camera[2] - (planes[:, :2] @ camera[:2] + planes[:, 2])
    return np.asarray((np.hypot(planes[:, 0], planes[:, 1]) > _STEEPEST)
                      | (below < _LEAST_HEIGHT))


def _candidates(points: Floats, camera: Floats) -> Floats:
    """Planes (K, 3) through three points each, none too steep and none above the camera."""
    rng = np.random.default_rng(1)
    triples = points[rng.integers(0, len(points), (_SAMPLES, 3))]
    a, b = triples[:, 1] - triples[:, 0], triples[:, 2] - triples[:, 0]
    normal = np.cross(a, b)
    upright = np.abs(normal[:, 2]) > 0.5 * np.linalg.norm(normal, axis=1)
    upright &= np.abs(normal[:, 2]) > 1e-9
    normal, origin = normal[upright], triples[upright, 0]
    slope = -normal[:, :2] / normal[:, 2:]
    height = origin[:, 2] - (slope * origin[:, :2]).sum(axis=1)
    planes = np.column_stack([slope, height])
    return np.asarray(planes[~_impossible(planes, camera)])


def _spread_out(points: Plane, camera: Floats) -> tuple[Floats | None, Floats]:
    """Some points of every cell about the camera, and weights that sum up to 1 in each."""
    x, y = points[:, 0] - camera[0], points[:, 1] - camera[1]
    distance = np.hypot(x, y)
    ring = np.floor(np.log(np.maximum(distance, 1e-6) / _NEAREST)
                    * (_RINGS / math.log(_FARTHEST / _NEAREST)))
    wedge = np.floor((np.arctan2(y, x) / (2 * np.pi) + 0.5) * _WEDGES) % _WEDGES
    inside = (ring >= 0) & (ring < _RINGS)
    cell = (ring * _WEDGES + wedge)[inside].astype(np.int16)  # small, so quick to sort
    if cell.size < _LEAST_CELLS:
        return None, np.empty(0)
    order = np.argsort(cell, kind='stable')
    first = np.flatnonzero(np.diff(cell[order], prepend=-1))
    count = np.diff(first, append=cell.size)
    share = (np.arange(_PER_CELL) + 0.5) / _PER_CELL
    picked = first[:, None] + (share * count[:, None]).astype(np.intp)
    weight = np.full(picked.size, 1.0 / _PER_CELL)
    return points[inside][order][picked.ravel()].astype(np.float64), weight


@kernel
def surfaces_below(r: Plane, sigma: Plane, rows: Plane, columns: Plane, turn: Plane,
                   camera: Plane, step: int, out: Plane) -> int:  # pragma: no cover - compiled
    """Points of every `step`-th pixel below the horizon whose height is sure; returns how many.

    rows : (H, 2) cos and sin of the latitude; columns : (2H, 2) of the longitude
    turn : (3, 3) level frame ← camera_optical; camera : (3,); out : (N, 3)
    """
    count = 0
    for i in range(step // 2, r.shape[0], step):
        for j in range(step // 2, r.shape[1], step):
            distance = r[i, j]
            if not (np.isfinite(distance) and distance > 0):
                continue
            x, y, z = rows[i, 0] * columns[j, 1], -rows[i, 1], rows[i, 0] * columns[j, 0]
            up = turn[2, 0] * x + turn[2, 1] * y + turn[2, 2] * z
            if up > -_LEAST_DIP or not -up * sigma[i, j] < _LEAST_SURE:
                continue
            for axis in range(3):
                out[count, axis] = camera[axis] + distance * (
                    turn[axis, 0] * x + turn[axis, 1] * y + turn[axis, 2] * z)
            count += 1
    return count
