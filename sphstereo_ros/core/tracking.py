"""Correspondences of bearings between two full spheres, from tracked features."""
from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from .camera import Equirectangular
from .frames import Image8
from .relative_pose import Correspondences
from .warp import resample, rotation_map, with_border

Floats = NDArray[np.float64]
Points = NDArray[np.floating]

_WRAP = 48  # columns that wrap round on each side, so that tracks cross the seam
_POLE = 0.2  # rad round zenith and nadir where an equirectangular image is too stretched to track


def features(image: Image8, spacing: int, usable: NDArray[np.bool_] | None = None) -> Points:
    """The pixel with the most structure in each neighbourhood of about `spacing` pixels.

    Structure is the lesser eigenvalue of the gradient's second moments, taken at half size: which
    pixel is chosen need not be exact.

    Parameters
    ----------
    image : (H, W) uint8
    spacing : px
    usable : (H, W) bool, where features may lie

    Returns
    -------
    (N, 2) float32 positions as (u, v)

    """
    half = cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    strength = cv2.cornerMinEigenVal(half, 5)
    width = max(3, spacing // 2 | 1)
    best = cv2.dilate(strength, np.ones((width, width), np.uint8))
    chosen = (strength == best) & (strength > max(0.3 * float(np.median(strength)), 1e-6))
    rows, columns = np.nonzero(chosen)
    points = np.stack([2 * columns, 2 * rows], axis=1)
    if usable is not None:
        points = points[usable[points[:, 1], points[:, 0]]]
    return points.astype(np.float32)


def follow(source: Image8, target: Image8, points: Points, *, window: int = 11,
           levels: int = 3) -> tuple[Points, NDArray[np.bool_]]:
    """Pyramidal Lucas–Kanade: where `points` (N, 2) of `source` are in `target`, and if found."""
    if not len(points):
        return points, np.zeros(0, bool)
    found, status, _ = cv2.calcOpticalFlowPyrLK(
        source, target, points[:, None], None, winSize=(window, window), maxLevel=levels,
        criteria=(cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 10, 0.003))
    return found[:, 0], status[:, 0].astype(bool)


def spacing_for(count: int, height: int) -> int:
    """Spacing that gives at most about `count` features on a sphere of `height` rows."""
    return max(5, round(math.sqrt(2 * height * height / count)))


def track(reference: Image8, current: Image8, rotation: Floats, count: int,
          mask: Image8 | None = None) -> Correspondences:
    """Bearings of the same points in two equirectangular images of (H, 2H) uint8.

    Parameters
    ----------
    reference, current : the images, at the resolution to track in
    rotation : (3, 3) prior, X_cur ≈ rotation · X_ref at infinity; the reference is turned by it
        first, so that the motion left is small
    count : so many features at most, about
    mask : (H, 2H), non-zero = vehicle

    """
    height, width = current.shape
    turned = reference
    if not np.allclose(rotation, np.eye(3), atol=1e-6):
        turned = resample(with_border(reference), rotation_map(rotation.T, reference.shape))
    wrapped = [cv2.copyMakeBorder(im, 0, 0, _WRAP, _WRAP, cv2.BORDER_WRAP)
               for im in (current, turned)]
    usable = np.zeros(wrapped[0].shape, bool)
    cap = round(_POLE / np.pi * height)
    usable[cap:height - cap, _WRAP:-_WRAP] = True if mask is None else mask[cap:height - cap] == 0
    points = features(wrapped[0], spacing_for(count, height), usable)
    moved, found = follow(wrapped[0], wrapped[1], points, levels=4)
    found &= np.abs(moved[:, 1] - height / 2) < height / 2 - 1
    camera = Equirectangular(height, width)
    offset = np.array([_WRAP, 0.0])
    before, now = (np.asarray(camera.unproject(p[found] - offset), np.float64)
                   for p in (moved, points))
    return Correspondences(before @ rotation, now)
