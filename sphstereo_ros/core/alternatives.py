"""What else may be where something was measured: what lies nearest and farthest round about.

Windows see across rims, so near one a pixel has the range of the wrong side. How the references
look if a pixel lies there instead, each pixel by itself, tells which.
"""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from .refinement import JointRefinement
from .warp import Map, PolarGrid

_ROUND, _WIDE, _SPECK = 15, 31, 3  # px: windows of what is round about, and of what is no surface


@dataclass(frozen=True)
class Alternative:
    """Maps of a polar grid, float32.

    rho : 1/m; least, most : difference in grey, of the references, if it is there (of
        `Comparison.agreement`)
    """

    rho: Map
    least: Map
    most: Map


@dataclass(frozen=True)
class Alternatives:
    """What was measured, nearest and farthest round about, and farthest more widely."""

    measured: Alternative
    near: Alternative
    far: Alternative
    farther: Alternative


def alternatives(rho: Map, refinement: JointRefinement) -> Alternatives:
    """Of what was measured, 1/m."""
    near, (far, farther) = round_about(rho, refinement.grid, _ROUND, (_ROUND, _WIDE))
    compared = refinement.compared(rho)
    return Alternatives(*(Alternative(m, *compared.agreement(m))
                          for m in (rho, near, far, farther)))


def round_about(rho: Map, grid: PolarGrid, nearer: int,
                farther: Sequence[int]) -> tuple[Map, list[Map]]:
    """The nearest in a window of so many px, and the farthest in each of some, without specks."""
    def square(size: int) -> NDArray[np.uint8]:
        return np.ones((size, size), np.uint8)
    more = max(nearer, *farther) // 2 + _SPECK
    whole, inside = grid.continued(rho, more), slice(more, -more)
    near, far = cv2.erode(whole, square(_SPECK)), cv2.dilate(whole, square(_SPECK))
    found = [cv2.dilate(near, square(nearer)), *(cv2.erode(far, square(n)) for n in farther)]
    first, *others = (np.ascontiguousarray(m[inside], np.float32) for m in found)
    return first, others
