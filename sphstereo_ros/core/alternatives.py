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

from .refinement import Agreement, JointRefinement
from .warp import Map, PolarGrid

_ROUND, _WIDE, _SPECK = 15, 31, 3  # px: windows of what is round about, and of what is no surface
_STEADY = 21  # px: window in which the farthest is refined


@dataclass(frozen=True)
class Alternative:
    """rho : 1/m, float32 on a polar grid; agreement : with the references, if it is there."""

    rho: Map
    agreement: Agreement


@dataclass(frozen=True)
class Alternatives:
    """What was measured, nearest and farthest round about, farthest more widely, and what was
    swept.
    """

    measured: Alternative
    near: Alternative
    far: Alternative
    farther: Alternative
    swept: Alternative


def alternatives(rho: Map, swept: Map, refinement: JointRefinement) -> Alternatives:
    """To what was measured, `rho`, 1/m.

    The farthest of a window is the most wrong, too, of what lies far: refined, it is what is seen
    between and behind what is nearer.

    swept : the second opinion, 1/m
    """
    near, far = round_about(rho, refinement.grid, _ROUND, (_ROUND, _WIDE))
    steady = [refinement.refined(m, _STEADY).rho for m in far]
    compared = refinement.compared(rho)
    return Alternatives(*(Alternative(m, compared.agreement(m))
                          for m in (rho, near, *steady, swept)))


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
