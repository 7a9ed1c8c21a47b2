"""Walls: upright planes that carry much of what is seen, and which of them is behind what.

A window cannot see through leaves, panes or blank paint, but what is seen round about is often
part of one plane (Gallup et al. 2010). The planes are found one after the other by random samples
(Fischler and Bolles 1981).
"""
from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from .floor import plane_at
from .inverse_range import _grid_angles
from .jit import fast_kernel, kernel, rows_in_parallel
from .warp import Map

Floats = NDArray[np.float64]

_ROWS = 240  # of the picture that is looked at
_MOST, _SAMPLES, _POINTS = 10, 400, 4000  # planes, pairs and points for each
_APART = (8, 20)  # rows and columns between a pair at most
_ON, _TAKEN = 0.03, 0.06  # shares of the inverse range: what lies on a plane, and is no other's
_SURE = 0.05  # sigma over inverse range
_LEAST = 60  # points that carry one
_OVER_FLOOR = 1.15  # times nearer than the floor
_LEAST_PIXELS = 2.0  # of parallax
_ROUND, _SUPPORT = (21, 15), 0.03  # columns and rows round about, share of them that it carries


class _Seen:
    """What is sure, at a size at which planes are quickly found."""

    def __init__(self, rho: Map, sigma: Map, floor: Map, pixel: float) -> None:
        step = max(len(rho) // _ROWS, 1)
        c, s, cl, sl = (m[::step].astype(np.float64) for m in _grid_angles(len(rho)))
        self.step = step
        self.bearings = np.stack(np.broadcast_arrays(
            c[:, None] * sl, -s[:, None], c[:, None] * cl), -1)
        self.rho = rho[::step, ::step].astype(np.float64)
        self.area = np.broadcast_to(c[:, None], self.rho.shape)
        self.sure = (sigma[::step, ::step] < _SURE * self.rho) & (
            self.rho > _OVER_FLOOR * floor[::step, ::step]) & (self.rho > _LEAST_PIXELS * pixel)


@fast_kernel
def _expected(plane: Floats, bearing: Floats) -> float:  # pragma: no cover - compiled
    return float(plane[0] * bearing[0] + plane[1] * bearing[1] + plane[2] * bearing[2])


@kernel
def _carried(first: int, last: int, planes: Floats, bearings: Floats, rho: Floats, area: Floats,
             out: Floats) -> None:  # pragma: no cover - compiled
    """Solid angle of what lies on each plane."""
    for k in range(first, last):
        total = 0.0
        for i in range(rho.size):
            there = _expected(planes[k], bearings[i])
            if abs(rho[i] - there) < _ON * there:
                total += area[i]
        out[k] = total


def _through_pairs(seen: _Seen, left: NDArray[np.bool_], upright: tuple[Floats, Floats],
                   rng: np.random.Generator) -> Floats:
    """Upright planes (N, 3) through pairs of points that are close together in the picture."""
    rows, columns = np.nonzero(left)
    one = rng.integers(0, len(rows), _SAMPLES)
    r, c = rows[one], columns[one]
    r2 = np.clip(r + rng.integers(-_APART[0], _APART[0] + 1, _SAMPLES), 0, len(left) - 1)
    c2 = (c + rng.integers(-_APART[1], _APART[1] + 1, _SAMPLES)) % left.shape[1]
    good = left[r2, c2]
    r, c, r2, c2 = (m[good] for m in (r, c, r2, c2))
    across = np.stack([np.stack([seen.bearings[m] @ u for u in upright], -1)
                       for m in ((r, c), (r2, c2))], 1)
    apart = np.abs(np.linalg.det(across)) > 1e-3
    values = np.stack([seen.rho[r, c], seen.rho[r2, c2]], -1)[apart]
    found = np.linalg.solve(across[apart], values[..., None])[..., 0]
    return np.asarray(found @ np.stack(upright), np.float64)


def _fitted(plane: Floats, seen: _Seen, left: NDArray[np.bool_],
            upright: tuple[Floats, Floats]) -> tuple[Floats, int]:
    """The plane through all that lies on it, and how much that is."""
    for _ in range(3):
        there = seen.bearings @ plane
        on = left & (np.abs(seen.rho - there) < _ON * there)
        if on.sum() < _LEAST:
            return plane, 0
        weight = np.sqrt(seen.area[on])
        across = np.stack([seen.bearings[on] @ u for u in upright], -1)
        found = np.linalg.lstsq(across * (weight / seen.rho[on])[:, None], weight, rcond=None)[0]
        plane = np.asarray(found @ np.stack(upright), np.float64)
    return plane, int(on.sum())


def _found(seen: _Seen, up: Floats) -> list[Floats]:
    rng, left = np.random.default_rng(0), seen.sure.copy()
    planes: list[Floats] = []
    first = np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
    first /= np.linalg.norm(first)
    upright = (first, np.cross(up, first))
    while len(planes) < _MOST and left.sum() >= _LEAST:
        tried = _through_pairs(seen, left, upright, rng)
        if not len(tried):
            break
        some = np.flatnonzero(left)
        some = rng.choice(some, min(len(some), _POINTS), replace=False)
        carried = np.empty(len(tried))
        rows_in_parallel(_carried, len(tried), tried, seen.bearings.reshape(-1, 3)[some],
                         seen.rho.ravel()[some], seen.area.ravel()[some], carried)
        plane, count = _fitted(tried[int(np.argmax(carried))], seen, left, upright)
        if count < _LEAST:
            break
        planes.append(plane)
        there = seen.bearings @ plane
        left &= np.abs(seen.rho - there) >= _TAKEN * there
    return planes


@kernel
def _wall_rows(first: int, last: int, cos_lat: Map, sin_lat: Map, cos_lon: Map, sin_lon: Map,
               planes: Map, which: NDArray[np.int32], share: Map, step: int, rho: Map,
               support: Map) -> None:  # pragma: no cover - compiled
    for i in range(first, last):
        r = min(i // step, which.shape[0] - 1)
        for j in range(cos_lon.size):
            c = min(j // step, which.shape[1] - 1)
            plane = planes[which[r, c]]
            there = plane_at(plane, cos_lat[i], sin_lat[i], cos_lon[j], sin_lon[j])
            carried = share[r, c] > np.float32(_SUPPORT) and there > 0
            rho[i, j] = there if carried else np.float32(0)
            support[i, j] = share[r, c] if carried else np.float32(0)


def walls_seen(rho: Map, sigma: Map, floor: Map, down: Floats, pixel: float) -> tuple[Map, Map]:
    """Inverse range of the wall that carries most of what is round about, and that share.

    Parameters
    ----------
    rho, sigma : (H, 2H) inverse range and its standard deviation, 1/m
    floor : (H, 2H) of `floor_seen`
    down : (3,) normal of the floor, or the vehicle's down, optical frame
    pixel : inverse range that is a pixel of parallax, 1/m

    Returns
    -------
    float32 (H, 2H) each, 1/m and 0 to 1; both 0 where there is none

    """
    seen = _Seen(rho, sigma, floor, pixel)
    planes = _found(seen, down)
    out, support = np.zeros((2, *rho.shape), np.float32)
    if planes:
        which, share = _likeliest(seen, planes)
        rows_in_parallel(_wall_rows, len(rho), *_grid_angles(len(rho)),
                         np.array(planes, np.float32), which, share, seen.step, out, support)
    return out, support


def _likeliest(seen: _Seen, planes: list[Floats]) -> tuple[NDArray[np.int32], Map]:
    """Which plane carries most round about, and how much of it, at the size of `seen`."""
    rim, most = _ROUND[0] // 2, np.zeros(seen.rho.shape, np.float32)
    which = np.zeros(seen.rho.shape, np.int32)
    for n, plane in enumerate(planes):
        there = seen.bearings @ plane
        on = (seen.sure & (np.abs(seen.rho - there) < _ON * there)).astype(np.float32)
        share = cv2.blur(cv2.copyMakeBorder(on, 0, 0, rim, rim, cv2.BORDER_WRAP), _ROUND)
        share = np.where(there > 0, share[:, rim:-rim], np.float32(0))
        which[share > most] = n
        most = np.maximum(most, share)
    return which, most
