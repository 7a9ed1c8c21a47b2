"""A third opinion: does a pixel lie on the plane that its surroundings form?

The inverse range of a plane is linear in the bearing, and over a small patch of the image linear
in the pixel. Roads and walls with little texture are measured well here and there; a measurement
in between that nothing confirms is still believed if it lies on the plane of those round it.
"""
from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from .inverse_range import NOTHING
from .warp import Map

Floats = NDArray[np.float64]

_ROWS = 160  # every n-th pixel and row takes part, so that about so many rows do
_WINDOWS = 48  # windows from pole to pole, half overlapping
_LEAST = 0.25  # of a window must be known,
_CENTRED = 0.2  # and on all sides: their centre lies that near to the window's, of its width
_FLAT = 0.05  # relative deviation from the plane, of what is known
_ON_PLANE = 0.06  # and of a measurement that lies on it
_NEARER = 1.5  # times its inverse range: a second opinion that outweighs a plane
_FARTHEST = 1 / 60  # 1/m (or 1/step): beyond, planes are too small to tell


def on_planes(rho: Map, sigma: Map, measured: Map, other: Map) -> NDArray[np.bool_]:
    """Which measurements lie on the plane of what is known round about.

    Parameters
    ----------
    rho, sigma : (H, 2H) what is known, 1/m; sigma is NOTHING elsewhere
    measured : (H, 2H) 1/m, everywhere
    other : (H, 2H) 1/m, a second opinion; where it is much nearer, the plane may be what lies
        behind something, and nothing is believed

    Returns
    -------
    (H, 2H), true only where nothing is known yet

    """
    step = max(len(rho) // _ROWS, 1)
    half = max(len(rho) // _WINDOWS // step, 2)
    plane, flat = _planes(rho[::step, ::step], sigma[::step, ::step], half)
    size = rho.shape[::-1]
    expected = cv2.resize(plane, size, interpolation=cv2.INTER_LINEAR)
    believed = cv2.resize(flat.view(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0
    return np.asarray((sigma >= NOTHING) & believed & (other < _NEARER * measured)
                      & (np.abs(measured - expected) < _ON_PLANE * expected))


def _planes(rho: Map, sigma: Map, half: int) -> tuple[Map, NDArray[np.bool_]]:
    """Value at each pixel of the plane fitted round it, and whether that is one."""
    rho, sigma = (np.pad(m, ((0, 0), (half, half)), mode='wrap') for m in (rho, sigma))
    known = (sigma < NOTHING) & (rho > _FARTHEST)
    weight = known.astype(np.float64)
    value = np.where(known, rho, 0).astype(np.float64)
    y, x = np.indices(rho.shape, np.float64)
    width = 2 * half + 1

    def mean(a: Floats) -> Floats:
        return np.asarray(cv2.boxFilter(a, -1, (width, width), borderType=cv2.BORDER_REFLECT))

    count = mean(weight)
    per = 1 / np.maximum(count, 1e-9)
    mx, my, mr = mean(weight * x) * per, mean(weight * y) * per, mean(value) * per
    xx, yy = mean(weight * x * x) * per - mx * mx, mean(weight * y * y) * per - my * my
    xy = mean(weight * x * y) * per - mx * my
    rx, ry = mean(value * x) * per - mx * mr, mean(value * y) * per - my * mr
    determinant = xx * yy - xy * xy + 1e-6
    a, b = (rx * yy - ry * xy) / determinant, (ry * xx - rx * xy) / determinant
    plane = mr + a * (x - mx) + b * (y - my)
    rest = np.maximum(mean(value * value) * per - mr * mr - a * rx - b * ry, 0)
    flat = ((count > _LEAST) & (np.sqrt(rest) < _FLAT * plane)
            & (np.abs(x - mx) < _CENTRED * width) & (np.abs(y - my) < _CENTRED * width))
    inside = slice(half, -half)
    return plane[:, inside].astype(np.float32), np.ascontiguousarray(flat[:, inside])
