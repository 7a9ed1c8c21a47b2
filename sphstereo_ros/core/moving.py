"""What moves by itself, as far as one camera can tell.

Three signs: flow that leaves its meridian, though nothing at rest explains the picture as well;
parallax below zero; and range under the floor, where nothing at rest can be (a vehicle that keeps
pace has no parallax and seems to be infinitely far away). What moves along the course at a steady
speed of its own shows none of the first two: it has the parallax of something nearer or farther.
Where something is marked, the rest of its body is not believed either.
"""
from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

from .frames import Image8, RelativePose
from .inverse_range import _grid_angles, _polar_row, pose_sigmas
from .jit import kernel, rows_in_parallel
from .matching import UNKNOWN, Parallax
from .moving_bodies import unmarked_parts
from .warp import Map, PolarGrid

if TYPE_CHECKING:
    from .joint import Measurement
    from .range_memory import Remembered

Floats = NDArray[np.float64]

_SIGNIFICANT = 4.0  # standard deviations
_LEAST_ACROSS, _LEAST_BACKWARD = 0.6, 1.0  # px
_UNEXPLAINED = 40.0  # squared grey levels that differ at the best range
_SPECK, _GAP, _RIM = 5, 11, 5  # px at half size: removed, closed, added

# The floor: a plane that carries most of what is seen downward.
_DOWNWARD, _TILT = 0.25, 0.35  # sine of the depression, rad from the vehicle's down
_ON_FLOOR, _CARRIED, _UNDER = 0.06, 0.4, 0.2
_SAMPLES, _LEAST_POINTS = 100, 200
_SLOPE, _HEIGHT = 0.05, 1.3  # rad, times the range: how much lower the floor may run elsewhere
_CERTAIN = 3.0  # standard deviations


@kernel
def _leaving_rows(first: int, last: int, across: Map, sigma: Map, pixels: Map, misfit: Map,
                  sine: Map, pose: Map, out: Image8) -> None:  # pragma: no cover - compiled
    """At half size. pose : standard deviations of rotation (px), direction (rad)"""
    for i in range(first, last):
        for j in range(sine.size):
            along = pixels[2 * i, 2 * j]
            if along == UNKNOWN:
                along = np.float32(0)
            turned = along * pose[1] / sine[j]
            spread = np.float32(_SIGNIFICANT) * np.sqrt(
                sigma[i, j] * sigma[i, j] + pose[0] * pose[0] + turned * turned)
            leaves = abs(across[i, j]) * sine[j] > max(np.float32(_LEAST_ACROSS), spread)
            backward = -along > max(np.float32(_LEAST_BACKWARD), spread)
            unexplained = misfit[2 * i, 2 * j] > np.float32(_UNEXPLAINED)
            out[i, j] = np.uint8(255 if backward or (leaves and unexplained) else 0)


@kernel
def _on_sphere_rows(first: int, last: int, cos_lat: Map, sin_lat: Map, cos_lon: Map, sin_lon: Map,
                    axes: Map, at_pole: Map, found: Image8,
                    out: Image8) -> None:  # pragma: no cover - compiled
    at = np.empty((4, cos_lon.size), np.float32)
    half = np.float32(0.5)
    for i in range(first, last):
        _polar_row(cos_lat[i], sin_lat[i], cos_lon, sin_lon, axes, at_pole[0], at_pole[1],
                   np.float32(1) / at_pole[2], at)
        for j in range(cos_lon.size):
            row = min(max(int(at[3, j] + half), 0), found.shape[0] - 1)
            column = min(max(int(at[2, j] + half), 0), found.shape[1] - 1)
            out[i, j] = found[row, column]


def off_meridian(parallax: Parallax, misfit: Map, grid: PolarGrid, axes: Floats,
                 pose: RelativePose, height: int) -> Image8 | None:
    """Where flow leaves its meridian, or runs backward along it.

    Parameters
    ----------
    parallax : of the nearest pair on `grid` (even height and margins); with `across`, else the
        answer is None
    misfit : of grid.shape, squared grey levels that remain at the best range
    axes : (3, 3) of the grid, current optical frame
    pose : of the nearest reference
    height : of the current frame

    Returns
    -------
    uint8 (height // 2, 2 * (height // 2)), 255 = moves

    """
    if parallax.across is None:
        return None
    half = PolarGrid(grid.height // 2, grid.margin // 2, grid.wrap // 2)
    rotation, direction, _ = pose_sigmas(pose)
    found = np.empty(parallax.across.shape, np.uint8)
    sine = np.maximum(np.abs(np.sin(half.theta())), 0.02).astype(np.float32)
    rows_in_parallel(_leaving_rows, len(found), parallax.across, parallax.sigma, parallax.pixels,
                     misfit, sine, np.array([rotation / grid.pixel, direction], np.float32), found)
    out = np.empty((height // 2, 2 * (height // 2)), np.uint8)
    at_pole = np.array([half.margin - 0.5, half.wrap - 0.5, half.pixel], np.float32)
    rows_in_parallel(_on_sphere_rows, len(out), *_grid_angles(len(out)),
                     np.ascontiguousarray(axes, np.float32), at_pole, found, out)
    return out


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


@kernel
def _under_rows(first: int, last: int, cos_lat: Map, sin_lat: Map, cos_lon: Map, sin_lon: Map,
                plane: Map, least: np.float32, rho: Map, sigma: Map,
                out: Image8) -> None:  # pragma: no cover - compiled
    for i in range(first, last):
        for j in range(cos_lon.size):
            on_floor = (plane[0] * cos_lat[i] * sin_lon[j] - plane[1] * sin_lat[i]
                        + plane[2] * cos_lat[i] * cos_lon[j])
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


def cleaned(mask: Image8) -> Image8:
    """Without specks and small gaps, and a little wider; over the seam, too.

    Windows see half of what moves at its rim.
    """
    rim = 2 * _GAP
    wide = cv2.copyMakeBorder(mask, 0, 0, rim, rim, cv2.BORDER_WRAP)
    for operation, size in ((cv2.MORPH_OPEN, _SPECK), (cv2.MORPH_CLOSE, _GAP),
                            (cv2.MORPH_DILATE, _RIM)):
        wide = cv2.morphologyEx(wide, operation, cv2.getStructuringElement(
            cv2.MORPH_ELLIPSE, (size, size)))
    return np.ascontiguousarray(wide[:, rim:-rim])


def moving_parts(known: Remembered, measured: Measurement, down: Floats, *,
                 metric: bool = True) -> tuple[NDArray[np.bool_], Image8]:
    """Where range is wrong because something moves, and what moves.

    Parameters
    ----------
    known : what all frames so far tell; measured : what the newest one does
    down : (3,) unit vector, the vehicle's, optical frame
    metric : whether ρ is 1/m: else nothing tells how tall things are, and only marks are wrong

    Returns
    -------
    bool (H, 2H), and uint8 (H, 2H), 255 = moves. The first has the second, what may be an
    unmarked part of it, and single pixels that lie under the floor, too.

    """
    height, width = known.rho.shape
    half = (2 * (height // 2), height // 2)
    plane = floor_plane(known.rho, known.sigma, down)
    wrong = np.zeros(known.rho.shape, np.bool_)
    signs = np.zeros(half[::-1], np.uint8) if measured.moving is None else measured.moving
    if plane is not None:
        wrong |= under_floor(known.rho, known.sigma, plane) != 0
        # What keeps pace looks like nothing that was fitted to: both opinions, not its sigma.
        under = (under_floor(measured.rho, measured.told, plane)
                 & under_floor(measured.other, measured.told, plane))
        signs = signs | cv2.resize(under, half, interpolation=cv2.INTER_NEAREST)
    moving = np.asarray(cv2.resize(cleaned(signs), (width, height),
                                   interpolation=cv2.INTER_NEAREST), np.uint8)
    if plane is not None and metric:
        wrong |= unmarked_parts(moving, known.rho, known.sigma, plane)
    return wrong | (moving != 0), moving
