"""What else may be where something was measured: what lies nearest and farthest round about.

Windows see across rims, so near one a pixel has the range of the wrong side. How the references
look if a pixel lies there instead, each pixel by itself, tells which.
"""
from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from .refinement import JointRefinement
from .warp import Map

_ROUND, _WIDE, _SPECK = 15, 31, 3  # px: windows of what is round about, and of what is no surface


@dataclass(frozen=True)
class Alternative:
    """Maps of a polar grid, float32.

    rho : 1/m; least, most : difference in grey, of the references, if it is there (of
        `JointRefinement.agreement`)
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
    speck, window, wide = (np.ones((n, n), np.uint8) for n in (_SPECK, _ROUND, _WIDE))
    near, far = cv2.erode(rho, speck), cv2.dilate(rho, speck)
    maps = (rho, cv2.dilate(near, window), cv2.erode(far, window), cv2.erode(far, wide))
    return Alternatives(*(Alternative(m, *refinement.agreement(m))
                          for m in (np.asarray(m, np.float32) for m in maps)))
