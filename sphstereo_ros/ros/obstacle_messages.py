"""Obstacle sectors → messages, each in the dialect of those who read it."""
from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sphstereo_ros.core.frames import FrameKey
from sphstereo_ros.core.sectors import (
    FIRST_SECTOR,
    SECTOR_WIDTH,
    SECTORS,
    ObstacleSectors,
    SectorState,
)
from sphstereo_ros.mavlink.distances import autopilot_distances
from sphstereo_ros.mavlink.encoding import SENSOR_UNKNOWN
from sphstereo_ros.ros.messages import MessageFactory, header, time_message

# base_link without its roll and pitch: what all sectors and points here are told in.
LEVEL_FRAME = 'base_link_level'
MAV_FRAME_BODY_FRD = 12
FLOAT32 = 7  # sensor_msgs/PointField
INFRARED = 1  # sensor_msgs/Range has no camera
TRIANGLE_LIST = 11  # visualization_msgs/Marker
_MARKER_LIFE = 500_000_000  # nanoseconds: old obstacles vanish from the picture
# Of a centimetre: no rounding of MAVROS, single or double, gets it onto the next whole one.
_INSIDE = 0.05

FloatArray = NDArray[np.float32]


def _level_header(make: MessageFactory, sectors: ObstacleSectors) -> Any:
    return header(make, FrameKey(sectors.key.stamp, LEVEL_FRAME))


def scan_message(make: MessageFactory, sectors: ObstacleSectors) -> Any:
    """Make the sensor_msgs/LaserScan of REP-117: counter-clockwise from behind, 72 × 5°.

    −Inf too close, +Inf free, NaN unknown.
    """
    clockwise = np.where(sectors.state == SectorState.FREE, np.inf, np.nan).astype(np.float32)
    measured = sectors.state == SectorState.MEASURED
    clockwise[measured] = sectors.distance[measured]
    clockwise[measured & sectors.too_close] = -np.inf
    # Sector i is at −20° + 5°·i clockwise, ray k at −180° + 5°·k counter-clockwise.
    behind = round((math.pi - FIRST_SECTOR) / SECTOR_WIDTH)
    ranges = clockwise[(behind - np.arange(SECTORS)) % SECTORS]
    return make('sensor_msgs/msg/LaserScan', header=_level_header(make, sectors),
                angle_min=-math.pi, angle_max=-math.pi + SECTOR_WIDTH * (SECTORS - 1),
                angle_increment=SECTOR_WIDTH, time_increment=0.0, scan_time=0.0,
                range_min=float(sectors.minimum), range_max=float(sectors.maximum),
                ranges=ranges)


def mavros_message(make: MessageFactory, sectors: ObstacleSectors) -> Any:
    """Make the sensor_msgs/LaserScan that MAVROS takes on `obstacle/send`: clockwise from −20°.

    MAVROS cuts 100 times each value to a whole number. So free is a finite value, 1.5 cm beyond
    range_max cut to whole centimetres; NaN is unknown; what is too close is at range_min, and
    nothing measured is at range_max.
    """
    told = autopilot_distances(sectors)
    free, measured = told.maximum + 1, told.distances <= told.maximum
    ranges = np.where(told.distances == free, (free + 0.5) / 100, np.nan)
    ranges[measured] = np.clip(sectors.distance[measured], (told.minimum + 0.5) / 100,
                               (told.maximum - 0.5) / 100)
    return make('sensor_msgs/msg/LaserScan', header=_level_header(make, sectors),
                angle_min=float(FIRST_SECTOR),
                angle_max=float(FIRST_SECTOR) + SECTOR_WIDTH * (SECTORS - 1),
                angle_increment=SECTOR_WIDTH, time_increment=0.0, scan_time=0.0,
                range_min=(told.minimum + _INSIDE) / 100, range_max=(told.maximum + _INSIDE) / 100,
                ranges=ranges.astype(np.float32))


def px4_message(make: MessageFactory, sectors: ObstacleSectors) -> Any:
    """Make the px4_msgs/ObstacleDistance: centimetres, degrees, microseconds."""
    told = autopilot_distances(sectors)
    return make('px4_msgs/msg/ObstacleDistance', timestamp=sectors.key.stamp // 1000,
                frame=MAV_FRAME_BODY_FRD, sensor_type=SENSOR_UNKNOWN, distances=told.distances,
                increment=round(math.degrees(SECTOR_WIDTH), 6), min_distance=told.minimum,
                max_distance=told.maximum, angle_offset=round(math.degrees(FIRST_SECTOR), 6))


def points_message(make: MessageFactory, sectors: ObstacleSectors) -> Any:
    """Make the sensor_msgs/PointCloud2 of the obstacle points: x y z, float32, metres."""
    points = np.ascontiguousarray(sectors.points, '<f4').reshape(-1, 3)
    fields = [make('sensor_msgs/msg/PointField', name=name, offset=4 * i, datatype=FLOAT32,
                   count=1) for i, name in enumerate('xyz')]
    return make('sensor_msgs/msg/PointCloud2', header=_level_header(make, sectors), height=1,
                width=len(points), fields=fields, is_bigendian=False, point_step=12,
                row_step=12 * len(points), data=points.reshape(-1).view(np.uint8), is_dense=True)


def nearest_message(make: MessageFactory, sectors: ObstacleSectors) -> Any:
    """Make the sensor_msgs/Range of the nearest obstacle all round.

    +Inf where every sector is free, NaN where nothing is measured but not all is known. What is
    too close is at min_range.
    """
    nearest = sectors.nearest
    if nearest is None:
        nearest = math.inf if (sectors.state == SectorState.FREE).all() else math.nan
    return make('sensor_msgs/msg/Range', header=_level_header(make, sectors),
                radiation_type=INFRARED, field_of_view=2 * math.pi,
                min_range=float(sectors.minimum), max_range=float(sectors.maximum),
                range=float(nearest))


def time_to_contact_message(make: MessageFactory, sectors: ObstacleSectors) -> Any:
    """Make the std_msgs/Float32: seconds; +Inf where nothing is approached, NaN unknown."""
    seconds = sectors.time_to_contact
    return make('std_msgs/msg/Float32', data=math.nan if seconds is None else float(seconds))


def markers_message(make: MessageFactory, sectors: ObstacleSectors) -> Any:
    """Make the visualization_msgs/MarkerArray for people: a wedge for each sector.

    Measured: up to the obstacle, red (near) to yellow (far); free: green up to the maximum;
    unknown: grey, half as far.
    """
    colours, reach = _looks(sectors)
    edges = FIRST_SECTOR + SECTOR_WIDTH * (np.arange(SECTORS + 1) - 0.5)
    corners = np.zeros((SECTORS, 3, 3))
    for place, edge in ((1, edges[1:]), (2, edges[:-1])):  # counter-clockwise, seen from above
        corners[:, place, 0] = reach * np.cos(edge)
        corners[:, place, 1] = -reach * np.sin(edge)
    points = [make('geometry_msgs/msg/Point', x=float(x), y=float(y), z=float(z))
              for x, y, z in corners.reshape(-1, 3)]
    shades = [make('std_msgs/msg/ColorRGBA', r=float(r), g=float(g), b=float(b), a=float(a))
              for r, g, b, a in np.repeat(colours, 3, axis=0)]
    life = time_message(make, _MARKER_LIFE)
    marker = make('visualization_msgs/msg/Marker', header=_level_header(make, sectors),
                  ns='obstacles', id=0, type=TRIANGLE_LIST, action=0,
                  scale=make('geometry_msgs/msg/Vector3', x=1.0, y=1.0, z=1.0),
                  color=make('std_msgs/msg/ColorRGBA', r=1.0, g=1.0, b=1.0, a=1.0),
                  lifetime=make('builtin_interfaces/msg/Duration', sec=life.sec,
                                nanosec=life.nanosec),
                  points=points, colors=shades)
    return make('visualization_msgs/msg/MarkerArray', markers=[marker])


def _looks(sectors: ObstacleSectors) -> tuple[FloatArray, FloatArray]:
    """Colour (72, 4) and length (72,) of the wedges."""
    colours = np.full((SECTORS, 4), (0.5, 0.5, 0.5, 0.4), np.float32)
    reach = np.full(SECTORS, sectors.maximum / 2, np.float32)
    free = sectors.state == SectorState.FREE
    colours[free], reach[free] = (0.1, 0.7, 0.2, 0.3), sectors.maximum
    measured = (sectors.state == SectorState.MEASURED) & ~np.isnan(sectors.distance)
    reach[measured] = sectors.distance[measured]
    colours[measured] = (0.9, 0.0, 0.1, 0.8)
    colours[measured, 1] = sectors.distance[measured] / sectors.maximum
    return colours, reach


def level_transform_message(make: MessageFactory, stamp: int,
                            quaternion: NDArray[np.float64]) -> Any:
    """Make the geometry_msgs/TransformStamped base_link → LEVEL_FRAME.

    quaternion : (x, y, z, w) of base_link ← level frame
    """
    rotation = make('geometry_msgs/msg/Quaternion', **{
        axis: float(value) for axis, value in zip('xyzw', quaternion, strict=True)})
    return make('geometry_msgs/msg/TransformStamped',
                header=header(make, FrameKey(stamp, 'base_link')), child_frame_id=LEVEL_FRAME,
                transform=make('geometry_msgs/msg/Transform', rotation=rotation))


Build = Callable[[MessageFactory, ObstacleSectors], Any]

# Topic → type, and what makes the message.
OUTPUTS: dict[str, tuple[str, Build]] = {
    'obstacles/scan': ('sensor_msgs/msg/LaserScan', scan_message),
    'obstacles/mavros': ('sensor_msgs/msg/LaserScan', mavros_message),
    'obstacles/points': ('sensor_msgs/msg/PointCloud2', points_message),
    'obstacles/nearest': ('sensor_msgs/msg/Range', nearest_message),
    'obstacles/time_to_contact': ('std_msgs/msg/Float32', time_to_contact_message),
    'obstacles/markers': ('visualization_msgs/msg/MarkerArray', markers_message),
}
