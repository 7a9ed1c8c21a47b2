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

from .floor import floor_plane, under_floor
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
