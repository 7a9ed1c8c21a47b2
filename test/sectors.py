"""Obstacle sectors made by hand, for tests."""
from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from sphstereo_ros.core.frames import FrameKey
from sphstereo_ros.core.sectors import SECTORS, ObstacleSectors, SectorState

FORWARD, RIGHT, LEFT = 4, 22, 58  # indices of the sectors in these directions
STAMP = 1_700_000_000_123_456_789


def sectors(measured: Mapping[int, float] | None = None, free: object = (),
            too_close: object = (), stamp: int = STAMP, minimum: float = 0.3,
            maximum: float = 20.0) -> ObstacleSectors:
    """Sectors that are unknown but for what is given by index."""
    state = np.full(SECTORS, SectorState.UNKNOWN, np.uint8)
    distance = np.full(SECTORS, np.nan, np.float32)
    close = np.zeros(SECTORS, bool)
    state[list(free)] = SectorState.FREE
    for i, metres in (measured or {}).items():
        state[i], distance[i] = SectorState.MEASURED, metres
    for i in too_close:
        state[i], distance[i], close[i] = SectorState.MEASURED, minimum, True
    known = distance[~np.isnan(distance)]
    nearest = float(known.min()) if known.size else None
    return ObstacleSectors(FrameKey(stamp, 'camera_optical'), state, distance, close, minimum,
                           maximum, np.zeros((0, 3), np.float32), nearest)
