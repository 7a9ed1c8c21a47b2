"""Sectors as autopilots take them: whole centimetres, clockwise, three states."""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sphstereo_ros.core.sectors import ObstacleSectors, SectorState, sector_centres

UNKNOWN = 65535
# max + 1 must be no UNKNOWN.
GREATEST = UNKNOWN - 2
# Of a centimetre: what float32 loses of 4.35 m must not cost one.
_ROUNDING = 0.01


@dataclass(frozen=True)
class AutopilotDistances:
    """What OBSTACLE_DISTANCE carries, of MAVLink and of px4_msgs.

    distances : uint16 (72,) centimetres, sector i centred on −20° + 5°·i clockwise; maximum + 1 =
        free, 65535 = unknown; what is measured lies in [minimum, maximum − 1], since PX4 takes
        exactly the maximum for free, and ArduPilot ignores less than the minimum
    minimum, maximum : centimetres, minimum ≥ 1
    """

    distances: NDArray[np.uint16]
    minimum: int
    maximum: int


def autopilot_distances(sectors: ObstacleSectors) -> AutopilotDistances:
    """Sectors in whole centimetres; never farther than measured."""
    maximum = int(np.clip(np.floor(100 * sectors.maximum + _ROUNDING), 3, GREATEST))
    minimum = int(np.clip(np.floor(100 * sectors.minimum + _ROUNDING), 1, maximum - 2))
    metres = np.where(sectors.too_close, sectors.minimum, sectors.distance).astype(np.float64)
    measured = (sectors.state == SectorState.MEASURED) & ~np.isnan(metres)
    whole = np.floor(100 * np.where(measured, metres, 0.0) + _ROUNDING)
    distances = np.full(metres.shape, UNKNOWN, np.uint16)
    distances[sectors.state == SectorState.FREE] = maximum + 1
    distances[measured] = np.clip(whole[measured], minimum, maximum - 1).astype(np.uint16)
    return AutopilotDistances(distances, minimum, maximum)


def sector_points(sectors: ObstacleSectors, count: int) -> NDArray[np.float64]:
    """The nearest obstacle of each measured sector, of these the `count` nearest.

    Returns (N, 3) metres, x forward, y right, z down, level, nearest first; each lies on its
    sector's middle, and no nearer than `minimum`, for ArduPilot ignores what is.
    """
    metres = np.where(sectors.too_close, sectors.minimum, sectors.distance).astype(np.float64)
    measured = np.flatnonzero((sectors.state == SectorState.MEASURED) & ~np.isnan(metres))
    nearest = measured[np.argsort(metres[measured], kind='stable')][:count]
    # Rounded to float32 they must stay between the limits.
    distance = np.clip(metres[nearest], sectors.minimum * (1 + 1e-6), sectors.maximum * (1 - 1e-6))
    angle = sector_centres()[nearest]
    return np.stack([distance * np.cos(angle), distance * np.sin(angle),
                     np.zeros(len(nearest))], axis=1)
