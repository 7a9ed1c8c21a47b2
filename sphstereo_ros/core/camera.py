"""Camera models: pixels to bearings and back.

Frames follow REP-103: `camera_optical` is x right, y down, z forward. A pixel position (u, v)
counts from the centre of the first pixel, as in OpenCV: pixel centres are whole numbers.
"""
from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.floating]


class CameraModel(Protocol):
    """A central camera: every pixel has one bearing through one centre."""

    @property
    def height(self) -> int:
        """Image rows."""

    @property
    def width(self) -> int:
        """Image columns."""

    def project(self, bearings: FloatArray) -> FloatArray:
        """Bearings (..., 3) of any length, camera_optical → pixel positions (..., 2) as (u, v)."""

    def unproject(self, pixels: FloatArray) -> FloatArray:
        """Pixel positions (..., 2) as (u, v) → unit bearings (..., 3), camera_optical."""


@dataclass(frozen=True)
class Equirectangular:
    """A full sphere of `height` × `width` pixels that looks along +z at its centre.

    Longitude = 2π((u + ½)/width − ½), latitude (up positive) = π(½ − (v + ½)/height); pixels
    need not be square (1920×1080 for a full sphere is legal).
    """

    height: int
    width: int

    def __post_init__(self) -> None:
        if self.height < 1 or self.width < 1:
            raise ValueError(f'an image of {self.width}×{self.height} pixels has no sphere')

    def project(self, bearings: FloatArray) -> FloatArray:
        """Bearings (..., 3) of any length, camera_optical → pixel positions (..., 2) as (u, v).

        u lies in [−½, width − ½), v in [−½, height − ½]. The zero vector gives NaN.
        """
        x, y, z = (np.asarray(bearings, np.float64)[..., i] for i in range(3))
        horizontal = np.hypot(x, z)
        nowhere = (horizontal == 0) & (y == 0)
        turn = np.arctan2(x, z) / (2 * np.pi) + 0.5
        u = np.where(turn >= 1.0, 0.0, turn) * self.width - 0.5
        v = (0.5 + np.arctan2(y, horizontal) / np.pi) * self.height - 0.5
        return np.stack([np.where(nowhere, np.nan, u), np.where(nowhere, np.nan, v)], axis=-1)

    def unproject(self, pixels: FloatArray) -> FloatArray:
        """Pixel positions (..., 2) as (u, v) → unit bearings (..., 3), camera_optical.

        Columns outside the image wrap round; rows outside are refused by NaN.
        """
        u, v = (np.asarray(pixels, np.float64)[..., i] for i in range(2))
        lon = 2 * np.pi * ((u + 0.5) / self.width - 0.5)
        lat = np.pi * (0.5 - (v + 0.5) / self.height)
        lat = np.where(np.abs(lat) <= np.pi / 2 + 1e-12, lat, np.nan)
        return np.stack([np.cos(lat) * np.sin(lon), -np.sin(lat), np.cos(lat) * np.cos(lon)], -1)

    def bearings(self) -> FloatArray:
        """Unit bearings (height, width, 3) of all pixel centres, camera_optical."""
        v, u = np.mgrid[0:self.height, 0:self.width]
        return self.unproject(np.stack([u, v], axis=-1).astype(np.float64))
