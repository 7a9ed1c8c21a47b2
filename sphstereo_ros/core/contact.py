"""Time to contact: when the vehicle would reach the nearest obstacle on its way."""
from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .sectors import SECTOR_WIDTH, SectorState, sector_centres

_STILL = 0.1  # m/s: slower is no travel


def time_to_contact(state: NDArray[np.uint8], distance: NDArray[np.float32],
                    velocity: NDArray[np.float64] | None, width: float) -> float | None:
    """Seconds until a vehicle `width` metres wide meets what is measured on its way.

    state, distance : (72,) as in `ObstacleSectors`
    velocity : (3,) m/s, level frame; None = not known

    Returns inf where nothing is on the way or the vehicle stands, None where that is not known:
    without velocity, or where the sector of travel is unknown and nothing else is on the way.
    What stands still is assumed to stay, and the vehicle to keep its velocity.
    """
    if velocity is None:
        return None
    speed = float(np.hypot(velocity[0], velocity[1]))
    if speed < _STILL:
        return float('inf')
    heading = np.arctan2(-velocity[1], velocity[0])  # clockwise
    off = np.abs((sector_centres() - heading + np.pi) % (2 * np.pi) - np.pi)
    nearest_edge = np.maximum(off - SECTOR_WIDTH / 2, 0.0)
    measured = state == SectorState.MEASURED
    ahead = np.where(measured, distance * np.cos(nearest_edge), np.inf)
    on_the_way = (measured & (nearest_edge < np.pi / 2)
                  & (distance * np.sin(nearest_edge) <= width / 2))
    if on_the_way.any():
        return float(ahead[on_the_way].min()) / speed
    travel = off <= SECTOR_WIDTH / 2 + 1e-9
    return None if (state[travel] == SectorState.UNKNOWN).any() else float('inf')
