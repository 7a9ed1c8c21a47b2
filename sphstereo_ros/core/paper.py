"""The motion direction as the paper estimates it (section 3.1), for comparison.

With the assumed direction as the pole, all flow runs down the meridians if the assumption is
right. If not, flow across the meridians at opposite windows of the equator has opposite signs,
and its ratio to the flow along them is the tangent of the error.
"""
from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from .frames import Drop, Image8, RelativePose
from .matching import inverse_search
from .warp import PolarGrid, aligned_pair

Floats = NDArray[np.float64]

_MARGIN, _WRAP = 16, 16
_HALF_WINDOW = np.radians(30.0)


def window_ratio_direction(reference: Image8, current: Image8, pose: RelativePose,
                           iterations: int = 3) -> RelativePose | Drop:
    """The pose with its direction of motion moved by the window ratios; its rotation stays.

    Parameters
    ----------
    reference, current : (H, 2H) uint8, equirectangular
    pose : the start; the ratios are small-angle, so they are taken `iterations` times

    Drops: `no_parallax`, where the flow along the meridians is not positive.

    """
    grid = PolarGrid(current.shape[0], _MARGIN, _WRAP)
    for _ in range(iterations):
        ref, cur, axes = aligned_pair(reference, current, pose, grid)
        flow = -inverse_search('medium', 1).calc(cur, ref, None)
        shift = _shift(flow, grid)
        if shift is None:
            return Drop('no_parallax', 'no flow along the meridians')
        direction = pose.direction + axes[:, :2] @ shift
        direction = direction / np.linalg.norm(direction)
        pose = replace(pose, position=-pose.baseline * direction)
    return pose


def _shift(flow: NDArray[np.float32], grid: PolarGrid) -> Floats | None:
    """Components (2,) of the true direction along the first two polar axes, or None."""
    theta = grid.theta()
    columns = np.abs(theta - np.pi / 2) < _HALF_WINDOW

    def window(centre: float) -> tuple[Floats, Floats]:
        off = (grid.azimuth() - centre + np.pi) % (2 * np.pi) - np.pi
        part = flow[np.abs(off) < _HALF_WINDOW][:, columns]
        return part[..., 0].ravel(), (part[..., 1] * np.sin(theta[columns])).ravel()

    shift = []
    for centre, sign in ((np.pi / 2, 1.0), (0.0, -1.0)):
        (along, across), (along2, across2) = window(centre), window(centre + np.pi)
        down = float(np.median(np.concatenate([along, along2])))
        if down <= 0:
            return None
        shift.append(sign * float(np.median(np.concatenate([across, -across2]))) / down)
    return np.array(shift)
