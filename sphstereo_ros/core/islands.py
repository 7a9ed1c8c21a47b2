"""Far range in the middle of something near: a mirror, a pane, or a view through a gap.

A window or car paint that mirrors shows the world behind it, with a parallax that no geometry can
tell from a real one. A real view between near things looks the same, so both are unknown.
"""
from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

_NEAR = (2.0, 2.8, 3.9, 5.5)  # m: each is looked at as the border between near and far
_BEYOND = 1.3  # far begins that many times farther
_STEP = 4  # px: every n-th pixel and row is looked at
_RING = 15  # of those, how wide the ring round an island may be
# Islands up to so large a share of all pixels; so much of what is known in the ring must be near.
# A large one must be framed: a real view, down a corridor say, has a floor that leads there.
_SMALL, _LARGE = (0.002, 0.5), (0.008, 0.9)
_FRAMED = 60  # of those looked at: a large island of fewer tells nothing of its frame


def far_islands(distance: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Where patches of far range lie among what is near.

    distance : (H, 2H) metres; NaN unknown, ±Inf as published. Returns (H, 2H).
    """
    small = distance[::_STEP, ::_STEP]
    size, more = small.size, small.shape[1] // 4
    # On round the sphere: a patch that the seam cuts is not two small ones.
    small = np.concatenate([small[:, -more:], small, small[:, :more]], axis=1)
    known = ~np.isnan(small)
    found = np.zeros(small.shape, bool)
    for border in _NEAR:
        near = known & (small < border)
        if near.any():
            found |= _islands(known & (small > _BEYOND * border), near, known, size)
    inside = np.ascontiguousarray(found[:, more:-more])
    return np.asarray(cv2.resize(inside.view(np.uint8), distance.shape[::-1],
                                 interpolation=cv2.INTER_NEAREST) > 0)


def _islands(far: NDArray[np.bool_], near: NDArray[np.bool_],
             known: NDArray[np.bool_], pixels: int) -> NDArray[np.bool_]:
    """Connected patches of `far`, not too large, that what is `near` surrounds where `known`.

    pixels : of the whole sphere
    """
    count, labels, statistics, _ = cv2.connectedComponentsWithStats(far.view(np.uint8),
                                                                    connectivity=8)
    size = statistics[:, cv2.CC_STAT_AREA]
    small = size < _SMALL[0] * pixels
    candidate = small | ((size < _LARGE[0] * pixels) & (size >= _FRAMED))
    candidate[0] = False
    inside = candidate[labels]
    if not inside.any():
        return np.asarray(inside)
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (_RING, _RING))
    grown = cv2.dilate(np.where(inside, labels, 0).astype(np.float32), kernel).astype(np.intp)
    ring = (grown > 0) & ~inside
    around = np.bincount(grown[ring & known], minlength=count)
    of_near = np.bincount(grown[ring & near], minlength=count)
    needed = np.where(small, _SMALL[1], _LARGE[1])
    return np.asarray((candidate & (of_near > needed * np.maximum(around, 1)))[labels])
