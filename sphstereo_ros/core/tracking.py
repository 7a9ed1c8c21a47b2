"""Correspondences of bearings between two full spheres, from tracked features."""
from __future__ import annotations

import math
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from .camera import Equirectangular
from .frames import Image8
from .relative_pose import Correspondences
from .warp import resample, rotation_map, with_border

Floats = NDArray[np.float64]
Points = NDArray[np.floating]

# What the structure of a feature says of the error with which it is followed: OpenCV's eigenvalue
# in squared grey levels per full-size pixel, the image's noise over a window of 11 pixels, the
# floor that better structure does not lower, and the worst that is worth following (px).
_BLOCK = 5
_WINDOW = 11
_GREY_SQUARED = (4 * 255 * _BLOCK / 8 / _BLOCK)**2 / 4
_NOISE, _FLOOR, _WORST = 1.5 / _WINDOW, 0.1, 0.5

# Of points followed both ways: px by which one may miss where it began; and the share kept of
# them, those whose windows differ least.
_FOUND_BACK, _ALIKE = 0.25, 0.75

# Descriptors: the nearest must be nearer than the second by this factor; error of a match (px).
_DISTINCT, _MATCHED = 0.8, 0.5

_WRAP = 48  # columns that wrap round on each side, so that tracks cross the seam
_POLE = 0.2  # rad round zenith and nadir where an equirectangular image is too stretched to track


def features(image: Image8, spacing: int,
             usable: NDArray[np.bool_] | None = None) -> tuple[Points, Floats]:
    """The pixel with the most structure in each cell of `spacing` × `spacing` pixels.

    Structure is the lesser eigenvalue of the gradient's second moments, taken at half size: which
    pixel is chosen need not be exact.

    Parameters
    ----------
    image : (H, W) uint8
    spacing : px
    usable : (H, W) bool, where features may lie

    Returns
    -------
    (N, 2) float32 positions as (u, v), and (N,) the standard deviation in px with which each is
    expected to be followed

    """
    half = cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    strength = cv2.cornerMinEigenVal(half, _BLOCK)
    cell = max(2, spacing // 2)
    rows, columns = (n // cell for n in strength.shape)
    cells = strength[:rows * cell, :columns * cell].reshape(rows, cell, columns, cell)
    cells = np.ascontiguousarray(cells.swapaxes(1, 2)).reshape(rows, columns, cell * cell)
    best = cells.argmax(axis=2)
    v = 2 * (np.arange(rows)[:, None] * cell + best // cell)
    u = 2 * (np.arange(columns)[None] * cell + best % cell)
    found = cells.max(axis=2)
    sigma = np.sqrt(_FLOOR**2 + _NOISE**2 / np.maximum(found * _GREY_SQUARED, 1e-9))
    keep = sigma < _WORST
    if usable is not None:
        keep &= usable[v, u]
    return np.stack([u[keep], v[keep]], axis=1).astype(np.float32), sigma[keep].astype(float)


def follow(source: Image8, target: Image8, points: Points, *,
           levels: int = 3) -> tuple[Points, NDArray[np.bool_]]:
    """Pyramidal Lucas–Kanade: where `points` (N, 2) of `source` are in `target`, and if found."""
    moved, found, _ = _lucas_kanade(source, target, points, None, levels)
    return moved, found


def follow_both_ways(source: Image8, target: Image8, points: Points, *,
                     levels: int = 3) -> tuple[Points, NDArray[np.bool_]]:
    """Like `follow`, but found are only those that look alike in both images and are found back.

    At the edge of something near, a part of the window moves with what is behind: such a point is
    followed to a wrong place, from which it is not found back.
    """
    moved, found, unlike = _lucas_kanade(source, target, points, None, levels)
    back, _, _ = _lucas_kanade(target, source, moved, points, 0)
    found &= np.linalg.norm(back - points, axis=1) < _FOUND_BACK
    if found.any():
        found &= unlike <= np.quantile(unlike[found], _ALIKE)
    return moved, found


def _lucas_kanade(source: Image8, target: Image8, points: Points, guess: Points | None,
                  levels: int) -> tuple[Points, NDArray[np.bool_], Points]:
    """Points (N, 2) found in `target`, whether they are, and the mean difference in grey (N,)."""
    if not len(points):
        return points, np.zeros(0, bool), np.zeros(0)
    flags, start = 0, None
    if guess is not None:
        flags = cv2.OPTFLOW_USE_INITIAL_FLOW
        start = np.array(guess, np.float32, order='C').reshape(-1, 1, 2)
    found, status, unlike = cv2.calcOpticalFlowPyrLK(
        source, target, np.ascontiguousarray(points, np.float32).reshape(-1, 1, 2), start,
        winSize=(_WINDOW, _WINDOW), maxLevel=levels, flags=flags,
        criteria=(cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 10, 0.003))
    return found[:, 0], status[:, 0].astype(bool), unlike[:, 0]


def spacing_for(count: int, height: int) -> int:
    """Spacing that gives at most about `count` features on a sphere of `height` rows."""
    return max(5, round(math.sqrt(2 * height * height / count)))


def _wrapped(image: Image8) -> Image8:
    return np.asarray(cv2.copyMakeBorder(image, 0, 0, _WRAP, _WRAP, cv2.BORDER_WRAP))


def _usable(image: Image8, mask: Image8 | None) -> NDArray[np.bool_]:
    """Where features may lie in the wrapped image: not at the poles, nor on the vehicle."""
    height, width = image.shape
    usable = np.zeros((height, width + 2 * _WRAP), bool)
    cap = round(_POLE / np.pi * height)
    usable[cap:height - cap, _WRAP:-_WRAP] = True if mask is None else mask[cap:height - cap] == 0
    return usable


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
    wrapped = [_wrapped(im) for im in (current, turned)]
    points, sigma = features(wrapped[0], spacing_for(count, height), _usable(current, mask))
    moved, found = follow(wrapped[0], wrapped[1], points, levels=4)
    found &= np.abs(moved[:, 1] - height / 2) < height / 2 - 1
    camera = Equirectangular(height, width)
    offset = np.array([_WRAP, 0.0])
    before, now = (np.asarray(camera.unproject(p[found] - offset), np.float64)
                   for p in (moved, points))
    return Correspondences(before @ rotation, now, sigma[found] * np.pi / height)


def match(reference: Image8, current: Image8, count: int,
          mask: Image8 | None = None) -> Correspondences:
    """Bearings of the same points in two equirectangular images of (H, 2H) uint8, wherever they
    went: the nearest SIFT descriptors (Lowe 2004) over the whole sphere, each the other's.

    Slower and less exact than `track`, but for rotations of 45° and for large parallax.
    Parameters as for `track`.
    """
    sift = cv2.SIFT_create(count)
    height, width = current.shape
    found = [sift.detectAndCompute(_wrapped(image), _usable(image, mask).astype(np.uint8))
             for image in (reference, current)]
    (points, before), (points_now, now) = found
    if before is None or now is None or min(len(before), len(now)) < 2:
        return Correspondences(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0))
    matcher = cv2.BFMatcher(cv2.NORM_L2)
    back = {m.queryIdx: m.trainIdx for m in matcher.match(before, now)}
    pairs = [(m.trainIdx, m.queryIdx) for m, second in matcher.knnMatch(now, before, k=2)
             if m.distance < _DISTINCT * second.distance and back[m.trainIdx] == m.queryIdx]
    camera = Equirectangular(height, width)

    def bearings(pixels: list[Any]) -> Floats:
        offset = np.array([_WRAP, 0.0])
        return np.asarray(camera.unproject(np.reshape(pixels, (-1, 2)) - offset), np.float64)

    return Correspondences(bearings([points[i].pt for i, _ in pairs]),
                           bearings([points_now[j].pt for _, j in pairs]),
                           np.full(len(pairs), _MATCHED * np.pi / height))
