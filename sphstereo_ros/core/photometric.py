"""Two views of the same world in different light: one is made to look like the other."""
from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from .frames import Image8

_LEVELS = 256
# Light that differs: how far round about, of half a turn, on cells of so many pixels; grey levels;
# percentile that differs by a share.
_LIGHT, _CELL, _DARK, _MOSTLY, _SAME = 1 / 30, 8, 8.0, 90, 0.08


def matched(image: Image8, like: Image8) -> Image8:
    """`image` (H, 2H) with the grey levels that `like` (any size) has at the same quantiles.

    Gain, offset, exposure and tone curve, and white balance as far as grey levels tell, go with
    any monotone curve; the two spheres see (nearly) the same, so their histograms, weighted by
    solid angle, differ by that curve alone (histogram matching, Gonzalez and Woods).
    """
    source, target = (_quantiles(picture) for picture in (image, like))
    curve = np.interp(source, target, np.arange(_LEVELS))
    return np.asarray(np.rint(curve).astype(np.uint8)[image])


def like(image: Image8, model: Image8) -> Image8:
    """`image` with the contrast and brightness of `model`, where they differ by much.

    Both show nearly the same, pixel by pixel: (H, W) uint8.
    """
    (mean, spread), (wanted, wanted_spread) = (
        (float(m[0, 0]), float(s[0, 0])) for m, s in
        (cv2.meanStdDev(i[::4, ::4]) for i in (image, model)))
    gain = min(max(wanted_spread / max(spread, 1e-3), 0.3), 3.0)
    if abs(np.log(gain)) < 0.05 and abs(mean - wanted) < 3:
        return image
    table = np.clip(gain * (np.arange(256) - mean) + wanted, 0, 255).round().astype(np.uint8)
    return np.asarray(cv2.LUT(image, table), np.uint8)


def in_one_light(image: Image8, model: Image8) -> tuple[Image8, Image8]:
    """Both images as if taken in the same light; of (H, W) uint8, nearly aligned.

    The image gets the contrast and brightness of `model`, where they differ by much. Where the
    light differs from place to place (a rolling shutter under lamps that flicker, two lenses),
    both lose what changes slowly: to make one as bright as the other round about would print the
    other's shades on what is blank.
    """
    alike = like(image, model)
    reach = _LIGHT * min(image.shape) / _CELL
    size = (image.shape[1] // _CELL, image.shape[0] // _CELL)
    slow = [cv2.GaussianBlur(cv2.resize(i, size, interpolation=cv2.INTER_AREA), (0, 0), reach)
            for i in (alike, model)]
    there, here = (s.astype(np.float32) + _DARK for s in slow)
    if float(np.percentile(np.abs(np.log(there / here)), _MOSTLY)) < _SAME:
        return alike, model
    quick = [cv2.addWeighted(i, 1.0, cv2.resize(s, i.shape[::-1]), -1.0, 128.0)
             for i, s in zip((alike, model), slow, strict=True)]
    return np.asarray(quick[0], np.uint8), np.asarray(quick[1], np.uint8)


def normalised(image: Image8, contrast: float = 20.0, floor: float = 12.0,
               radius: float = 8.0) -> Image8:
    """The image (H, 2H) with the same mean and nearly the same contrast everywhere.

    What differs smoothly between two cameras goes: gain, exposure, vignetting, white balance on
    surfaces of different colour. Soft edges (shadows), which a small difference in brightness
    would shift, go too.

    contrast : standard deviation of the result, grey levels; floor : grey levels of contrast that
    are not raised fully; radius : px, of the surroundings that count
    """
    border = round(3 * radius)
    wide = cv2.copyMakeBorder(image, 0, 0, border, border, cv2.BORDER_WRAP).astype(np.float32)
    detail = wide - cv2.GaussianBlur(wide, (0, 0), radius, borderType=cv2.BORDER_REPLICATE)
    deviation = cv2.sqrt(cv2.GaussianBlur(detail * detail, (0, 0), radius,
                                          borderType=cv2.BORDER_REPLICATE))
    out = 128 + contrast * detail / (deviation + np.float32(floor))
    return np.asarray(np.clip(np.rint(out[:, border:-border]), 0, 255), np.uint8)


def _quantiles(image: Image8) -> NDArray[np.float64]:
    """Share of the sphere (256,) that is darker than each level or, by half, as bright."""
    height = image.shape[0]
    weight = np.cos(np.pi * ((np.arange(height) + 0.5) / height - 0.5))
    rows = np.broadcast_to(weight[:, None], image.shape)
    share = np.bincount(image.ravel(), weights=rows.ravel(), minlength=_LEVELS)
    # Levels that do not occur have none: strictly rising, for interpolation.
    share = share / share.sum() + 1e-9
    return np.asarray((np.cumsum(share) - share / 2) / share.sum())
