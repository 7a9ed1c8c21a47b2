"""What obstacle detection finds: the distance of the nearest obstacle in each of 72 directions."""
from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from .frames import FrameKey

SECTORS = 72
SECTOR_WIDTH = 2 * np.pi / SECTORS
# With sector 0 forward, ArduPilot writes its front face at both ends of the array, and the later
# run hides the earlier.
FIRST_SECTOR = np.radians(-20.0)


class SectorState(IntEnum):
    """What is known of a sector."""

    UNKNOWN = 0
    FREE = 1
    MEASURED = 2


def sector_centres() -> NDArray[np.float64]:
    """Direction of each sector's middle, (72,) rad, clockwise seen from above, 0 = forward."""
    return np.asarray(FIRST_SECTOR + SECTOR_WIDTH * np.arange(SECTORS))


@dataclass(frozen=True)
class ObstacleSectors:
    """Obstacles round the vehicle, in the level frame: `base_link` without its roll and pitch.

    key : frame of the depth they come from
    state : uint8 (72,), SectorState; sector i is centred on −20° + 5°·i, clockwise from above
    distance : float32 (72,) metres, horizontal, from the level frame's origin; NaN where nothing
        was measured, never outside [minimum, maximum]
    too_close : bool (72,), measured nearer than `minimum`; `distance` is `minimum` there
    minimum, maximum : metres, between which distances are told
    points : float32 (N, 3) metres, obstacle points in the level frame (x forward, y left, z up)
    nearest : metres to the nearest measured obstacle in any sector, None if there is none
    time_to_contact : seconds to the nearest obstacle in the sector of travel; inf where that is
        free or is not approached; None where that is unknown
    """

    key: FrameKey
    state: NDArray[np.uint8]
    distance: NDArray[np.float32]
    too_close: NDArray[np.bool_]
    minimum: float
    maximum: float
    points: NDArray[np.float32]
    nearest: float | None = None
    time_to_contact: float | None = None
