"""Resampling: one map per view, straight from the input's pixels to the aligned polar grid.

The polar grid has one row per azimuth and one column per polar angle, so that a match lies on the
same row and its parallax is a shift along the columns. Both sides carry a margin: the rows wrap
round, the columns run on over the poles along the same great circle, so a matcher meets neither
the seam nor an edge.
"""
from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from .frames import Image8, RelativePose
from .jit import fast_kernel, rows_in_parallel
from .sphere import polar_axes

Floats = NDArray[np.float64]
Map = NDArray[np.float32]

# Pixels that `with_border` adds on each side of a full sphere, so that interpolation near the seam
# and the poles reads what lies beyond them.
BORDER = 4


@dataclass(frozen=True)
class PolarGrid:
    """An aligned polar grid: `height` columns of polar angle 0 … π and 2·height rows of azimuth.

    margin : columns added beyond each pole; wrap : rows added at the top and at the bottom
    """

    height: int
    margin: int = 0
    wrap: int = 0

    @property
    def shape(self) -> tuple[int, int]:
        """Rows (azimuth) and columns (polar angle) with margins."""
        return 2 * self.height + 2 * self.wrap, self.height + 2 * self.margin

    @property
    def pixel(self) -> float:
        """Angle of one pixel, rad: the same along θ and (at θ = 90°) along the azimuth."""
        return float(np.pi / self.height)

    def theta(self) -> Floats:
        """Polar angle of every column, rad; outside 0 … π in the margins."""
        return np.asarray((np.arange(self.shape[1]) - self.margin + 0.5) * self.pixel, np.float64)

    def azimuth(self) -> Floats:
        """Azimuth of every row, rad."""
        return np.asarray((np.arange(self.shape[0]) - self.wrap + 0.5) * self.pixel, np.float64)

    def continued(self, values: NDArray[Any], rows: int) -> NDArray[Any]:
        """`values` of this grid with so many more rows at either end, on round the sphere."""
        count = 2 * self.height
        return np.asarray(values[(np.arange(-rows, self.shape[0] + rows) - self.wrap) % count
                                 + self.wrap])


def with_border(image: NDArray[Any]) -> NDArray[Any]:
    """A full sphere (H, W[, C]) with BORDER pixels around it that continue it over seam and poles.

    Beyond a pole the sphere goes on half a turn away, upside down.
    """
    height, width = image.shape[:2]
    out = np.empty((height + 2 * BORDER, width + 2 * BORDER, *image.shape[2:]), image.dtype)
    out[BORDER:-BORDER, BORDER:-BORDER] = image
    out[BORDER:-BORDER, :BORDER] = image[:, -BORDER:]
    out[BORDER:-BORDER, -BORDER:] = image[:, :BORDER]
    columns = (np.arange(width + 2 * BORDER) - BORDER + width // 2) % width
    out[:BORDER] = image[BORDER - 1::-1][:, columns]
    out[-BORDER:] = image[:-BORDER - 1:-1][:, columns]
    return out


@fast_kernel
def _arctan2(y: np.float32, x: np.float32) -> np.float32:  # pragma: no cover - compiled
    """Four-quadrant arctangent to 5e-7 rad, without branches so that it runs in vectors."""
    ax, ay = abs(x), abs(y)
    large = max(ax, ay)
    small = min(ax, ay)
    q = small / max(large, np.float32(1e-30))
    s = q * q
    p = np.float32(0.0068117758)
    p = p * s + np.float32(-0.033604167)
    p = p * s + np.float32(0.07962361)
    p = p * s + np.float32(-0.13233338)
    p = p * s + np.float32(0.19807814)
    p = p * s + np.float32(-0.33317369)
    p = p * s + np.float32(0.9999961)
    a = p * q
    a = np.float32(1.57079637) - a if ay > ax else a
    a = np.float32(3.14159274) - a if x < 0 else a
    return -a if y < 0 else a


@fast_kernel
def _polar_map_rows(first: int, last: int, cos_theta: Map, sin_theta: Map, cos_azimuth: Map,
                    sin_azimuth: Map, axes: Map, scale_u: np.float32, scale_v: np.float32,
                    map_u: Map, map_v: Map) -> None:  # pragma: no cover - compiled
    centre_u = scale_u * np.float32(np.pi) - np.float32(0.5) + np.float32(BORDER)
    centre_v = scale_v * np.float32(np.pi / 2) - np.float32(0.5) + np.float32(BORDER)
    tx, ty, tz = axes[0, 2], axes[1, 2], axes[2, 2]
    for i in range(first, last):
        c, s = cos_azimuth[i], sin_azimuth[i]
        ex = c * axes[0, 0] + s * axes[0, 1]
        ey = c * axes[1, 0] + s * axes[1, 1]
        ez = c * axes[2, 0] + s * axes[2, 1]
        for j in range(cos_theta.size):
            st, ct = sin_theta[j], cos_theta[j]
            x = st * ex + ct * tx
            y = st * ey + ct * ty
            z = st * ez + ct * tz
            map_u[i, j] = _arctan2(x, z) * scale_u + centre_u
            map_v[i, j] = _arctan2(y, np.sqrt(x * x + z * z)) * scale_v + centre_v


def polar_map(grid: PolarGrid, axes: Floats, shape: tuple[int, int]) -> tuple[Map, Map]:
    """Where each pixel of `grid` lies in an equirectangular image, for `cv2.remap`.

    Parameters
    ----------
    grid : the aligned polar grid
    axes : (3, 3) from `polar_axes`, in the optical frame of the view to be resampled
    shape : (H, W) of the image; the map is for the same image `with_border`

    Returns
    -------
    map_u, map_v : float32 of grid.shape, accurate to about 1e-3 pixel

    """
    height, width = shape
    theta, azimuth = grid.theta(), grid.azimuth()
    map_u, map_v = np.empty(grid.shape, np.float32), np.empty(grid.shape, np.float32)
    parts = [np.ascontiguousarray(a, np.float32) for a in (
        np.cos(theta), np.sin(theta), np.cos(azimuth), np.sin(azimuth), axes)]
    rows_in_parallel(_polar_map_rows, grid.shape[0], *parts, np.float32(width / (2 * np.pi)),
                     np.float32(height / np.pi), map_u, map_v)
    return map_u, map_v


def rotation_map(rotation: Floats, shape: tuple[int, int]) -> tuple[Map, Map]:
    """Map that shows an equirectangular image (H, W) as a camera turned by `rotation` sees it.

    rotation : (3, 3), bearing in the image's camera = rotation · bearing in the turned camera.
    The map is for the image `with_border`; float32, accurate to about 1e-3 pixel.
    """
    height, width = shape
    theta = (np.arange(height) + 0.5) * np.pi / height
    azimuth = (np.arange(width) + 0.5) * 2 * np.pi / width - np.pi
    # Columns of the turned image are azimuths about its −y axis (up), counted from +z toward +x.
    axes = np.asarray(rotation) @ np.array([[0.0, 1, 0], [0, 0, -1], [1, 0, 0]])
    map_u, map_v = np.empty((width, height), np.float32), np.empty((width, height), np.float32)
    parts = [np.ascontiguousarray(a, np.float32) for a in (
        np.cos(theta), np.sin(theta), np.cos(azimuth), np.sin(azimuth), axes)]
    rows_in_parallel(_polar_map_rows, width, *parts, np.float32(width / (2 * np.pi)),
                     np.float32(height / np.pi), map_u, map_v)
    return np.ascontiguousarray(map_u.T), np.ascontiguousarray(map_v.T)


def resample(bordered: NDArray[Any], maps: tuple[Map, Map],
             interpolation: int = cv2.INTER_LINEAR) -> NDArray[Any]:
    """`cv2.remap` of an image `with_border`; maps from this module never leave it."""
    return np.asarray(cv2.remap(bordered, maps[0], maps[1], interpolation,
                                borderMode=cv2.BORDER_REPLICATE))


def aligned_pair(reference: Image8, current: Image8, pose: RelativePose,
                 grid: PolarGrid) -> tuple[Image8, Image8, Floats]:
    """Both views on the polar grid: (reference, current, axes of the current view)."""
    axes = polar_axes(pose.direction)
    return (resample(with_border(reference),
                     polar_map(grid, pose.rotation.T @ axes, reference.shape)),
            resample(with_border(current), polar_map(grid, axes, current.shape)), axes)
