"""Inverse range, smoothed along each surface.

Errors differ from pixel to pixel, but a surface goes on. Seen from a pixel as the middle of a
perspective picture (gnomonic), 1/z of a plane is linear. Such a plane is laid through each pixel
by moving least squares (Lancaster and Salkauskas 1981) that grow: first what is closest counts,
then what is farther away too, as long as it lies, within its standard deviation, where the plane
found so far goes on (Tukey's weights), and the less the more it differs in grey. What lies
elsewhere, beyond a rim, is not mixed in.
"""
from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray

from .frames import Image8
from .inverse_range import NOTHING
from .jit import fast_kernel, rows_in_parallel
from .warp import Map

_STAGES = ((1, 2, 3), (5, 7), (10, 14))  # px away
_DIRECTIONS = 8
_FRONT = 0.3  # cosine of the angle to what is in front
_APART = 1.25  # standard deviations of both by which what is on the plane differs at most
_GREY = 0.0005  # what differs by so many grey levels squared counts half: 1 over them
_FLAT = 0.02  # px², added to how far what counts spreads: along a line it has no slope across
_LEAST = 1e-5  # of sigma over inverse range, without the pose's share, and of the latter
# Twice: sigma over inverse range with which it stays as it is, and share of sigma that is left.
_TIMES = ((0.003, 1.0), (0.014, 0.7))
_MOST = 0.15  # share of the inverse range by which it changes at most


@cache
def _around() -> tuple[NDArray[np.int32], tuple[int, ...]]:
    """Rows and columns away, (N, 2), and how many of them count at each stage."""
    found: list[tuple[int, int]] = []
    ends = []
    for radii in _STAGES:
        for n, radius in enumerate(radii):
            turn = (np.arange(_DIRECTIONS) + 0.5 * (n % 2)) * 2 * np.pi / _DIRECTIONS
            at = np.rint(radius * np.stack([np.sin(turn), np.cos(turn)], 1)).astype(int)
            found += [(int(row), int(column)) for row, column in at]
        found = list(dict.fromkeys(found))
        ends.append(len(found))
    return np.array(found, np.int32), tuple(ends)


@cache
def _pictures(height: int) -> NDArray[np.float32]:
    """Where each row's pixels see those around them, (height, N, 3): down and to the right in the
    picture, px, and its 1/z over inverse range, 0 where that is not in front.
    """
    pixel = np.pi / height
    down, right = (_around()[0] * pixel).T
    latitude = np.pi / 2 - (np.arange(height) + 0.5)[:, None] * pixel
    other = latitude - down
    ahead = np.sin(other) * np.sin(latitude) + np.cos(other) * np.cos(latitude) * np.cos(right)
    below = np.cos(other) * np.sin(latitude) * np.cos(right) - np.sin(other) * np.cos(latitude)
    beside = np.cos(other) * np.sin(right)
    front = (ahead > _FRONT) & (np.abs(other) < np.pi / 2) & (np.abs(right) < np.pi)
    whole = np.stack([below / pixel, beside / pixel, np.ones_like(ahead)], -1)
    whole /= np.where(front, ahead, np.inf)[..., None]
    return whole.astype(np.float32)


@fast_kernel
def _sums(rho: Map, sigma: Map, view: Image8, r: int, c: int, around: NDArray[np.int32],
          picture: NDArray[np.float32], plane: tuple[np.float32, np.float32, np.float32],
          sums: Map) -> None:  # pragma: no cover - compiled
    """Into `sums`: weights, weights times where in the picture, their squares and product, and
    times how much 1/z differs; plane : what is found so far, and its slopes down and to the right.
    """
    columns, nothing = rho.shape[1], np.float32(NOTHING)
    here, own, grey = rho[r, c], sigma[r, c] * sigma[r, c], np.float32(view[r, c])
    one, most = np.float32(1), np.float32(_APART * _APART)
    s, zero = one, np.float32(0)
    sy, sx, syy, syx, sxx, sz, syz, sxz = zero, zero, zero, zero, zero, zero, zero, zero
    for k in range(len(around)):
        y, x, ahead = picture[k, 0], picture[k, 1], picture[k, 2]
        if ahead == 0:
            continue
        i, j = r + around[k, 0], c + around[k, 1]
        j += columns if j < 0 else -columns if j >= columns else 0
        if sigma[i, j] >= nothing:
            continue
        spread, z = sigma[i, j] * sigma[i, j], rho[i, j] * ahead - here
        error = z - (plane[0] + plane[1] * y + plane[2] * x)
        squares, bound = error * error, most * (own + spread)
        if squares >= bound:
            continue
        near = one - squares / bound
        unlike = np.float32(view[i, j]) - grey
        w = own * near * near / (spread * (one + np.float32(_GREY) * unlike * unlike))
        s, sy, sx, sz = s + w, sy + w * y, sx + w * x, sz + w * z
        syy, syx, sxx = syy + w * y * y, syx + w * y * x, sxx + w * x * x
        syz, sxz = syz + w * y * z, sxz + w * x * z
    sums[0], sums[1], sums[2], sums[3], sums[4], sums[5] = s, sy, sx, syy, syx, sxx
    sums[6], sums[7], sums[8] = sz, syz, sxz


@fast_kernel
def _plane_of(sums: Map) -> tuple[np.float32, np.float32,
                                  np.float32]:  # pragma: no cover - compiled
    """How much the plane differs from the pixel, and its slopes, of what `_sums` finds."""
    y, x, z = sums[1] / sums[0], sums[2] / sums[0], sums[6] / sums[0]
    flat = np.float32(_FLAT) * sums[0]
    yy, xx = sums[3] - y * sums[1] + flat, sums[5] - x * sums[2] + flat
    yx, yz, xz = sums[4] - y * sums[2], sums[7] - y * sums[6], sums[8] - x * sums[6]
    whole = yy * xx - yx * yx
    down, right = (xx * yz - yx * xz) / whole, (yy * xz - yx * yz) / whole
    return z - down * y - right * x, down, right


@fast_kernel
def _smooth_rows(first: int, last: int, rho: Map, sigma: Map, view: Image8,
                 around: NDArray[np.int32], ends: tuple[int, ...], pictures: NDArray[np.float32],
                 accurate: np.float32, out: Map) -> None:  # pragma: no cover - compiled
    sums, zero = np.empty(9, np.float32), np.float32(0)
    for i in range(first, last):
        for j in range(rho.shape[1]):
            here, spread = rho[i, j], sigma[i, j]
            out[i, j] = here
            if spread >= np.float32(NOTHING) or spread <= accurate * here:
                continue
            plane = (zero, zero, zero)
            for end in ends:
                _sums(rho, sigma, view, i, j, around[:end], pictures[i], plane, sums)
                plane = _plane_of(sums)
            out[i, j] += plane[0]


def smoothed(rho: Map, sigma: Map, pose: Map, view: Image8) -> Map:
    """Inverse range that goes on as its surface does; where none is known, what was given.

    It changes by 15 % at most, and not where it is accurate to 0.3 %.

    Parameters
    ----------
    rho, sigma : float32 (H, 2H) inverse range, and its standard deviation, NOTHING where unknown,
        1/m (or over steps)
    pose : the pose's share of sigma: neighbours err alike by it
    view : uint8 (H, 2H), the same frame, grey

    """
    least = np.float32(_LEAST) * np.maximum(np.abs(rho), np.float32(_LEAST))
    own = np.sqrt(np.maximum(sigma * sigma - pose * pose, least * least))
    around, ends = _around()
    most = np.float32(_MOST) * np.maximum(rho, 0)
    found = rho
    for accurate, left in _TIMES:
        spread = np.where(sigma < NOTHING, np.float32(left) * own, np.float32(NOTHING))
        given, found = found, np.empty_like(rho)
        rows_in_parallel(_smooth_rows, len(rho), given, spread, view, around, ends,
                         _pictures(len(rho)), np.float32(accurate), found)
        found = np.clip(found, rho - most, rho + most)
    return found
