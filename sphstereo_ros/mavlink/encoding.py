"""MAVLink 2 messages, as bytes."""
from __future__ import annotations

import importlib
from types import ModuleType
from typing import Any

import numpy as np

from sphstereo_ros.core.sectors import FIRST_SECTOR, SECTOR_WIDTH, ObstacleSectors
from sphstereo_ros.mavlink.distances import autopilot_distances, sector_points

# Of MAV_DISTANCE_SENSOR: there is none for cameras.
SENSOR_UNKNOWN = 4
_UINT32 = 2**32


class MissingLibraryError(ImportError):
    """A library is not installed; the message says which, and how to get it."""


def dialect() -> ModuleType:
    """The dialect with ArduPilot's messages beside the common ones.

    Raises
    ------
    MissingLibraryError
        without pymavlink

    """
    try:
        return importlib.import_module('pymavlink.dialects.v20.ardupilotmega')
    except ImportError as error:
        raise MissingLibraryError('MAVLink needs pymavlink: pip install pymavlink') from error


class Encoder:
    """Makes the messages of one MAVLink component, numbered as they are made.

    Raises
    ------
    MissingLibraryError
        without pymavlink

    """

    def __init__(self, system_id: int, component_id: int) -> None:
        self._dialect = dialect()
        self._mav = self._dialect.MAVLink(None, srcSystem=system_id, srcComponent=component_id)

    def _bytes(self, message: Any) -> bytes:
        packed = bytes(message.pack(self._mav))
        self._mav.seq = (self._mav.seq + 1) % 256
        return packed

    def heartbeat(self, active: bool) -> bytes:
        """HEARTBEAT of an onboard computer; `active`: obstacles are being sent."""
        d = self._dialect
        state = d.MAV_STATE_ACTIVE if active else d.MAV_STATE_STANDBY
        return self._bytes(d.MAVLink_heartbeat_message(
            d.MAV_TYPE_ONBOARD_CONTROLLER, d.MAV_AUTOPILOT_INVALID, 0, 0, state, 3))

    def timesync(self, answer: int, asked: int) -> bytes:
        """TIMESYNC: `asked` is the asking side's time, `answer` the other's, 0 to ask; ns."""
        return self._bytes(self._dialect.MAVLink_timesync_message(answer, asked))

    def obstacle_distance(self, sectors: ObstacleSectors, time_usec: int) -> bytes:
        """OBSTACLE_DISTANCE in BODY_FRD, 72 × 5° from −20° clockwise.

        The sectors are level already: autopilots turn them by yaw alone.
        """
        told = autopilot_distances(sectors)
        width = round(float(np.degrees(SECTOR_WIDTH)), 6)
        return self._bytes(self._dialect.MAVLink_obstacle_distance_message(
            time_usec, SENSOR_UNKNOWN, [int(d) for d in told.distances], int(width), told.minimum,
            told.maximum, width, round(float(np.degrees(FIRST_SECTOR)), 6),
            self._dialect.MAV_FRAME_BODY_FRD))

    def obstacle_points(self, sectors: ObstacleSectors, time_usec: int,
                        count: int) -> list[bytes]:
        """OBSTACLE_DISTANCE_3D: the nearest points of `count` sectors at most.

        All have the same time: that tells ArduPilot that they belong together.
        """
        time_ms = time_usec // 1000 % _UINT32
        return [self._bytes(self._dialect.MAVLink_obstacle_distance_3d_message(
            time_ms, SENSOR_UNKNOWN, self._dialect.MAV_FRAME_BODY_FRD, UNKNOWN_ID,
            float(x), float(y), float(z), sectors.minimum, sectors.maximum))
            for x, y, z in sector_points(sectors, count)]


# obstacle_id of obstacles that are not told apart.
UNKNOWN_ID = 65535


class Decoder:
    """Finds messages in a stream of bytes; what is damaged is skipped."""

    def __init__(self) -> None:
        self._mav = dialect().MAVLink(None)
        self._mav.robust_parsing = True

    def messages(self, data: bytes) -> list[Any]:
        """Messages that are complete with `data`."""
        found = self._mav.parse_buffer(data) or []
        return [m for m in found if m.get_type() != 'BAD_DATA']
