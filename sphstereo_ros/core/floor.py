"""The floor: a plane that carries most of what is seen downward."""
from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .frames import Image8
from .inverse_range import _grid_angles
from .jit import fast_kernel, kernel, rows_in_parallel
from .warp import Map

Floats = NDArray[np.float64]

_DOWNWARD, _TILT = 0.25, 0.35  # sine of the depression, rad from the vehicle's down
_ON_FLOOR, _CARRIED, _UNDER = 0.06, 0.4, 0.2
_SAMPLES, _LEAST_POINTS = 100, 200
_SLOPE, _HEIGHT = 0.05, 1.3  # rad, times the range: how much lower the floor may run elsewhere
_CERTAIN = 3.0  # standard deviations


def floor_plane(rho: Map, sigma: Map, down: Floats) -> Floats | None:
    """The plane that carries most of what is seen downward, as m with m · bearing = 1 / range.

    Parameters
    ----------
    rho, sigma : (H, 2H) inverse range and its standard deviation
    down : (3,) unit vector, optical frame: the vehicle's, the floor may be inclined

    Returns
    -------
    (3,) 1/m; None where no such plane is seen, or much lies under it

    """
    d, p, s, weight = _seen_downward(rho, sigma, down)
    if len(p) < _LEAST_POINTS:
        return None
    chosen = np.random.default_rng(0).integers(0, len(p), (_SAMPLES, 3))
    planes = np.linalg.pinv(d[chosen], rcond=1e-3) @ p[chosen][..., None]
    expected = d @ planes[..., 0].T
    on_it = np.abs(p[:, None] - expected) < _ON_FLOOR * expected + 2 * s[:, None]
    plane: Floats = planes[int(np.argmax(weight @ on_it)), :, 0]
    for _ in range(3):
        expected = d @ plane
        near = np.abs(p - expected) < _ON_FLOOR * expected + 2 * s
        if near.sum() < 3:
            return None
        plane = np.asarray(np.linalg.lstsq(d[near] * weight[near, None], p[near] * weight[near],
                                           rcond=None)[0], np.float64)
    expected = d @ plane
    near = np.abs(p - expected) < _ON_FLOOR * expected + 2 * s
    under = p + _CERTAIN * s < expected / _HEIGHT
    total = weight.sum()
    if weight[near].sum() < _CARRIED * total or weight[under].sum() > _UNDER * total:
        return None
    inclined = plane @ down < np.cos(_TILT) * np.linalg.norm(plane)
    return None if inclined else np.asarray(plane, np.float64)


def _seen_downward(rho: Map, sigma: Map,
                   down: Floats) -> tuple[Floats, Floats, Floats, Floats]:
    """Bearings (N, 3), ρ, σ and solid angle of some of the points under the camera."""
    step = max(len(rho) // 48, 1)
    lat_cos, lat_sin, lon_cos, lon_sin = _grid_angles(len(rho))
    c, s = lat_cos[::step, None], lat_sin[::step, None]
    cl, sl = lon_cos[None, ::step], lon_sin[None, ::step]
    bearings = np.stack([c * sl, -s + 0 * sl, c * cl], -1).astype(np.float64)
    p, spread = (m[::step, ::step].astype(np.float64) for m in (rho, sigma))
    good = (bearings @ down > _DOWNWARD) & (spread < 0.1 * p)
    weight = np.broadcast_to(c, p.shape).astype(np.float64)
    return bearings[good], p[good], spread[good], weight[good]


@fast_kernel
def plane_at(plane: Map, cos_lat: np.float32, sin_lat: np.float32, cos_lon: np.float32,
             sin_lon: np.float32) -> np.float32:  # pragma: no cover - compiled
    """Inverse range of the plane in that direction."""
    return np.float32(plane[0] * cos_lat * sin_lon - plane[1] * sin_lat
                      + plane[2] * cos_lat * cos_lon)


@kernel
def _under_rows(first: int, last: int, cos_lat: Map, sin_lat: Map, cos_lon: Map, sin_lon: Map,
                plane: Map, least: np.float32, rho: Map, sigma: Map,
                out: Image8) -> None:  # pragma: no cover - compiled
    for i in range(first, last):
        for j in range(cos_lon.size):
            on_floor = plane_at(plane, cos_lat[i], sin_lat[i], cos_lon[j], sin_lon[j])
            limit = (on_floor - least) / np.float32(_HEIGHT)
            out[i, j] = np.uint8(
                255 if rho[i, j] + np.float32(_CERTAIN) * sigma[i, j] < limit else 0)


def under_floor(rho: Map, sigma: Map, plane: Floats) -> Image8:
    """Where the range is surely beyond the floor: uint8 (H, 2H), 255 = there.

    The floor may fall by 3°, or lie lower by a third, elsewhere.
    """
    out = np.empty(rho.shape, np.uint8)
    least = np.float32(np.linalg.norm(plane) * np.sin(_SLOPE))
    rows_in_parallel(_under_rows, len(out), *_grid_angles(len(out)),
                     np.asarray(plane, np.float32), least, rho, sigma, out)
    return out


@kernel
def _floor_rows(first: int, last: int, cos_lat: Map, sin_lat: Map, cos_lon: Map, sin_lon: Map,
                plane: Map, out: Map) -> None:  # pragma: no cover - compiled
    for i in range(first, last):
        for j in range(cos_lon.size):
            out[i, j] = max(np.float32(0), plane_at(plane, cos_lat[i], sin_lat[i], cos_lon[j],
                                                    sin_lon[j]))


def floor_seen(plane: Floats | None, height: int) -> Map:
    """Inverse range of the floor if nothing hides it, float32 (H, 2H), 1/m; 0 where there is none.

    plane : of `floor_plane`
    """
    if plane is None:
        return np.zeros((height, 2 * height), np.float32)
    out = np.empty((height, 2 * height), np.float32)
    rows_in_parallel(_floor_rows, height, *_grid_angles(height), np.asarray(plane, np.float32),
                     out)
    return out
