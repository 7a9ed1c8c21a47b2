"""Range images for people."""
from __future__ import annotations

import cv2
import numpy as np

from .frames import Image8, RangeImage

NEAR, FAR = 0.5, 100.0  # ends of the colour scale, metres (or steps · 0.3)
_UNKNOWN, _BEYOND, _TOO_NEAR = (24, 24, 24), (90, 60, 40), (255, 255, 255)  # BGR


def colour_map(range_image: RangeImage) -> Image8:
    """Colours (H, 2H, 3) BGR: red near to blue far on a logarithmic scale of NEAR … FAR metres.

    Unknown is nearly black, beyond the maximum is slate, nearer than the minimum is white.
    Without metric scale a step between frames counts as 0.3 m.
    """
    r = range_image.range if range_image.is_metric else range_image.range * np.float32(0.3)
    finite = np.isfinite(r)
    shown = np.where(finite, np.clip(r, NEAR, FAR), FAR)
    level = np.log(shown / FAR) / np.log(NEAR / FAR)
    out = cv2.applyColorMap((255 * level).astype(np.uint8), cv2.COLORMAP_TURBO)
    out[np.isnan(r)] = _UNKNOWN
    out[np.isposinf(r)] = _BEYOND
    out[np.isneginf(r)] = _TOO_NEAR
    return np.asarray(out)
