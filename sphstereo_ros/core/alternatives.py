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

_ROUND, _SPECK = 15, 3  # px: windows of what is round about, and of what is no surface


@dataclass(frozen=True)
class Alternatives:
    """Maps of a polar grid, float32.

    least, most : difference in grey, of the references, of what was measured (of
        `JointRefinement.agreement`)
    near, far : 1/m, nearest and farthest round about; near_least, far_least : as `least`
    """

    least: Map
    most: Map
    near: Map
    near_least: Map
    far: Map
    far_least: Map


def alternatives(rho: Map, refinement: JointRefinement) -> Alternatives:
    """Of what was measured, 1/m."""
    speck, window = (np.ones((n, n), np.uint8) for n in (_SPECK, _ROUND))
    near = np.asarray(cv2.dilate(cv2.erode(rho, speck), window), np.float32)
    far = np.asarray(cv2.erode(cv2.dilate(rho, speck), window), np.float32)
    least, most = refinement.agreement(rho)
    return Alternatives(least, most, near, refinement.agreement(near)[0], far,
                        refinement.agreement(far)[0])
