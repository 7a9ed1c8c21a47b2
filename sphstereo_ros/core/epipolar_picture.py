"""Epipolar residuals over the sphere, for people: how well two cameras are aligned, and where."""
from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from .camera import Equirectangular
from .frames import Image8
from .relative_pose import Correspondences, epipolar_residuals

Floats = NDArray[np.float64]

SMALL, LARGE = 0.003, 3.0  # ends of the colour scale, degrees
_CELL = 3.0  # degrees
_LEGEND = 44  # px
_INK = (235, 235, 235)
_FONT = cv2.FONT_HERSHEY_SIMPLEX


def residual_map(points: Correspondences, rotation: Floats, direction: Floats,
                 cell: float = _CELL) -> Floats:
    """Median distance of the points from their epipolar planes, by cell of the sphere.

    Parameters
    ----------
    points : reference: top camera, current: bottom camera
    rotation, direction : of the top camera, bottom camera_optical
    cell : degrees; the map has 180 / cell rows and twice as many columns

    Returns
    -------
    Degrees, on the bottom camera's equirectangular grid; NaN where no point is

    """
    rows = round(180 / cell)
    residual = np.degrees(np.abs(epipolar_residuals(rotation, direction, points)))
    u, v = np.rint(Equirectangular(rows, 2 * rows).project(points.current)).astype(np.intp).T
    cells = v.clip(0, rows - 1) * 2 * rows + u % (2 * rows)
    order = np.lexsort((residual, cells))
    found, first, counts = np.unique(cells[order], return_index=True, return_counts=True)
    out = np.full(rows * 2 * rows, np.nan)
    out[found] = residual[order][first + counts // 2]
    return out.reshape(rows, 2 * rows)


def residual_picture(image: Image8, residuals: Floats, title: str) -> Image8:
    """The map laid over a picture (H, 2H) of the bottom camera, with a legend: BGR.

    Colours run from SMALL (blue) to LARGE (red) degrees on a logarithmic scale.
    """
    width = image.shape[1]
    known = np.isfinite(residuals)
    level = _level(np.where(known, residuals, SMALL))
    colours = cv2.applyColorMap(level, cv2.COLORMAP_TURBO)
    size = image.shape[::-1]
    colours, shown = (cv2.resize(a, size, interpolation=cv2.INTER_NEAREST)
                      for a in (colours, known.astype(np.uint8)))
    grey = cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)
    mixed = np.where(shown[..., None] != 0, 0.35 * grey + 0.65 * colours, 0.6 * grey)
    return np.vstack([_legend(width, title), np.asarray(mixed, np.uint8)])


def _level(degrees: Floats) -> Image8:
    share = np.log(np.clip(degrees, SMALL, LARGE) / SMALL) / np.log(LARGE / SMALL)
    return np.asarray(np.rint(255 * share), np.uint8)


def _legend(width: int, title: str) -> Image8:
    legend = np.zeros((_LEGEND, width, 3), np.uint8)
    bar = width * 2 // 5
    scale = np.geomspace(SMALL, LARGE, bar)
    legend[4:20, -bar:] = cv2.applyColorMap(_level(scale)[None], cv2.COLORMAP_TURBO)
    cv2.putText(legend, title, (8, 28), _FONT, width / 2000, _INK, 1, cv2.LINE_AA)
    for degrees in (0.003, 0.01, 0.03, 0.1, 0.3, 1.0, 3.0):
        text = f'{degrees:g}'
        across = cv2.getTextSize(text, _FONT, width / 2400, 1)[0][0]
        at = width - bar + round(int(_level(np.array([degrees]))[0]) / 255 * (bar - 1))
        cv2.putText(legend, text, (min(max(at - across // 2, 0), width - across - 2), 36), _FONT,
                    width / 2400, _INK, 1, cv2.LINE_AA)
    return legend
