"""A rig of two cameras in the analytic world."""
from __future__ import annotations

from functools import cache

import numpy as np
from analytic_world import View, World, look

from sphstereo_ros.core import rotations
from sphstereo_ros.core.config import Config, resolve
from sphstereo_ros.core.frames import Frame, FrameKey
from sphstereo_ros.core.rotations import OPTICAL_FROM_LINK
from sphstereo_ros.core.synchronisation import Side

BASELINE = 0.35
RPY = (0.02, -0.03, 0.04)  # of the top camera, rad
PERIOD = 66_666_667
HEIGHT = 240
TOP = {'camera.top.roll': RPY[0], 'camera.top.pitch': RPY[1], 'camera.top.yaw': RPY[2]}


def parameters(**more: object) -> dict[str, object]:
    """Of a calibrated rig, over the defaults."""
    return {'pairing.mode': 'binocular', 'baseline.length': BASELINE, **TOP,
            **{name.replace('__', '.'): value for name, value in more.items()}}


def config(**more: object) -> Config:
    return resolve(parameters(**more))


def turn() -> np.ndarray:
    """Of the top camera, bottom ← top, optical."""
    return OPTICAL_FROM_LINK @ rotations.matrix_from_rpy(*RPY) @ OPTICAL_FROM_LINK.T


@cache
def view(side: Side, forward: float = 0.0, height: int = HEIGHT) -> View:
    """What a camera sees when the rig has moved so many metres forward."""
    if side == 'bottom':
        return look(World(), (0.0, 0.0, forward), None, height)
    return look(World(), (0.0, -BASELINE, forward), turn(), height)


def frame(side: Side, stamp: int, forward: float = 0.0, frame_id: str | None = None,
          height: int = HEIGHT) -> Frame:
    return Frame(FrameKey(stamp, f'{side}_camera' if frame_id is None else frame_id),
                 view(side, forward, height).image)


def error(measured: np.ndarray, true: np.ndarray) -> tuple[float, float]:
    """Median relative error, and the share of pixels that have a range."""
    known = np.isfinite(measured)
    return float(np.median(np.abs(measured - true)[known] / true[known])), float(known.mean())
