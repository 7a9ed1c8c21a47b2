"""Sectors in the dialects of those who read them: directions, units, three states."""
from __future__ import annotations

import math
import sys
from dataclasses import replace
from importlib.machinery import ModuleSpec
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from sectors import FORWARD, LEFT, RIGHT, STAMP, sectors

from sphstereo_ros.core.config import resolve
from sphstereo_ros.core.level import Attitude
from sphstereo_ros.core.rotations import matrix_from_quaternion, matrix_from_rpy
from sphstereo_ros.core.sectors import SECTORS, ObstacleSectors, sector_centres
from sphstereo_ros.mavlink.distances import autopilot_distances, sector_points
from sphstereo_ros.replay.bag_messages import TYPESTORE
from sphstereo_ros.replay.bag_messages import make as make_for_bags
from sphstereo_ros.ros import obstacle_messages
from sphstereo_ros.ros.messages import nanoseconds

MAKERS = [make_for_bags]
try:
    import rclpy  # noqa: F401

    from sphstereo_ros.ros.live_messages import make as make_live
except ImportError:
    pass
else:
    MAKERS.append(make_live)
EVERY = [obstacle_messages.scan_message, obstacle_messages.mavros_message,
         obstacle_messages.points_message, obstacle_messages.nearest_message,
         obstacle_messages.time_to_contact_message, obstacle_messages.markers_message]


@pytest.fixture(params=MAKERS, ids=lambda m: m.__module__.rsplit('.', 1)[-1])
def make(request: pytest.FixtureRequest) -> Any:
    return request.param


def serialised(message: Any, kind: str) -> bytes:
    """As CDR; bytes that only fill up are zero."""
    if hasattr(message, '__msgtype__'):
        return bytes(TYPESTORE.serialize_cdr(message, kind))
    from rclpy.serialization import serialize_message
    read = TYPESTORE.deserialize_cdr(serialize_message(message), kind)
    return bytes(TYPESTORE.serialize_cdr(read, kind))


@pytest.mark.parametrize('build', EVERY, ids=lambda b: b.__name__)
def test_live_and_recorded_messages_are_the_same(build: Any) -> None:
    found = replace(sectors({FORWARD: 3.0}, free=[1], too_close=[2]), time_to_contact=2.5,
                    points=np.float32([[1, 2, 3], [4, 5, 6]]))
    kind = build(make_for_bags, found).__msgtype__
    made = {serialised(build(make, found), kind) for make in MAKERS}
    assert len(made) == 1


# REP-117 scan

def ray(message: Any, degrees: float) -> float:
    """The range in a direction, counter-clockwise from forward."""
    index = round((math.radians(degrees) - message.angle_min) / message.angle_increment)
    return float(message.ranges[index % SECTORS])


def test_scan_is_counter_clockwise_in_the_level_frame(make: Any) -> None:
    message = obstacle_messages.scan_message(make, sectors(
        {LEFT: 5.0, FORWARD: 7.0, 40: 9.0}, free=[RIGHT], too_close=[FORWARD + 1]))
    assert ray(message, 90) == 5.0
    assert ray(message, 0) == 7.0
    assert ray(message, 180) == 9.0
    assert ray(message, -90) == math.inf
    assert ray(message, -5) == -math.inf
    assert np.isnan(message.ranges).sum() == SECTORS - 5
    assert (message.angle_min, message.angle_max) == pytest.approx((-math.pi, math.radians(175)))
    assert message.angle_increment == pytest.approx(math.radians(5))
    assert len(message.ranges) == 72
    assert (message.range_min, message.range_max) == (pytest.approx(0.3), 20.0)
    assert message.header.frame_id == 'base_link_level'
    assert nanoseconds(message.header.stamp) == STAMP


@given(st.integers(0, SECTORS - 1))
def test_every_sector_has_its_ray(index: int) -> None:
    message = obstacle_messages.scan_message(make_for_bags, sectors({index: 4.0}))
    assert ray(message, -math.degrees(sector_centres()[index])) == 4.0


# MAVROS

def sent_by_mavros(message: Any, real: type) -> tuple[np.ndarray, int, int, float, float]:
    """What its obstacle_distance plugin makes of a scan of 72 rays, in floats of a size."""
    hundred = real(100)
    centimetres = np.asarray(message.ranges).astype(real) * hundred
    with np.errstate(invalid='ignore'):
        bad = np.isnan(centimetres) | (centimetres >= 65535) | (centimetres < 0)
    whole = np.where(bad, 65535, np.nan_to_num(centimetres, posinf=0, neginf=0)).astype(np.uint16)
    degrees = 180 / math.pi
    return (whole, int(real(np.float32(message.range_min)) * hundred),
            int(real(np.float32(message.range_max)) * hundred),
            float(np.float32(np.float32(message.angle_increment) * degrees)),
            float(np.float32(np.float32(message.angle_min) * degrees)))


@pytest.mark.parametrize('real', [np.float32, np.float64])
def test_mavros_makes_of_it_what_is_meant(make: Any, real: type) -> None:
    message = obstacle_messages.mavros_message(make, sectors(
        {LEFT: 5.0, FORWARD: 7.5, 3: 19.999, 5: 20.0}, free=[RIGHT], too_close=[40]))
    sent, least, most, increment, offset = sent_by_mavros(message, real)
    assert (least, most, increment, offset) == (30, 2000, 5.0, -20.0)
    assert (sent[LEFT], sent[FORWARD], sent[RIGHT], sent[40]) == (500, 750, 2001, 30)
    assert (sent[3], sent[5]) == (1999, 1999)
    assert (sent == 65535).sum() == SECTORS - 6
    assert message.ranges[RIGHT] == pytest.approx((math.floor(100 * message.range_max) + 1.5)
                                                  / 100)
    assert math.isnan(message.ranges[0])


limits = st.tuples(st.floats(0.01, 5.0), st.floats(6.0, 655.0))


@given(limits, st.floats(0.0, 800.0), st.sampled_from([np.float32, np.float64]))
def test_mavros_keeps_three_states_apart_at_any_limits(between: tuple[float, float],
                                                       metres: float, real: type) -> None:
    minimum, maximum = between
    distance = float(np.clip(metres, minimum, maximum))
    message = obstacle_messages.mavros_message(make_for_bags, sectors(
        {7: distance}, free=[8], minimum=minimum, maximum=maximum))
    sent, least, most, _, _ = sent_by_mavros(message, real)
    assert least >= 1
    assert sent[8] == most + 1
    assert sent[9] == 65535
    assert least <= sent[7] < most
    assert sent[7] <= 100 * max(distance, minimum) + 0.02
    assert abs(sent[7] - 100 * distance) <= 2.6


# Centimetres of MAVLink and PX4

def test_three_states_in_centimetres() -> None:
    told = autopilot_distances(sectors({0: 4.35, 1: 20.0, 2: 0.3}, free=[3], too_close=[4]))
    assert (told.minimum, told.maximum) == (30, 2000)
    assert told.distances[:6].tolist() == [435, 1999, 30, 2001, 30, 65535]
    assert told.distances.dtype == np.uint16


def test_what_is_measured_without_a_distance_is_unknown() -> None:
    assert autopilot_distances(sectors({0: math.nan})).distances[0] == 65535


@given(limits, st.floats(0.0, 800.0))
def test_measured_is_never_zero_never_the_maximum_and_never_farther(
        between: tuple[float, float], metres: float) -> None:
    minimum, maximum = between
    distance = float(np.float32(np.clip(metres, minimum, maximum)))
    told = autopilot_distances(sectors({0: distance}, free=[1], minimum=minimum,
                                       maximum=maximum))
    assert 1 <= told.minimum <= told.distances[0] < told.maximum < told.distances[1] < 65535
    assert told.distances[0] <= max(100 * distance, told.minimum) + 0.01


def test_points_are_the_nearest_sectors() -> None:
    points = sector_points(sectors({LEFT: 5.0, FORWARD: 7.0, 40: 9.0}, too_close=[RIGHT]), 3)
    np.testing.assert_allclose(points, [[0, 0.3, 0], [0, -5, 0], [7, 0, 0]], atol=1e-5)
    assert (np.linalg.norm(points.astype(np.float32), axis=1) > np.float32(0.3)).all()
    assert sector_points(sectors(), 3).shape == (0, 3)


# PX4

def test_px4_message() -> None:
    """With a class of the same fields: the real one comes with PX4's workspace only."""
    made = obstacle_messages.px4_message(
        lambda name, **fields: SimpleNamespace(name=name, **fields),
        sectors({LEFT: 5.0, 0: 20.0}, free=[RIGHT], too_close=[FORWARD]))
    assert made.name == 'px4_msgs/msg/ObstacleDistance'
    assert made.timestamp == STAMP // 1000
    assert (made.frame, made.increment, made.angle_offset) == (12, 5.0, -20.0)
    assert (made.min_distance, made.max_distance) == (30, 2000)
    assert [made.distances[i] for i in (LEFT, 0, RIGHT, FORWARD, 1)] == [500, 1999, 2001, 30,
                                                                         65535]
    assert made.distances.shape == (72,)


# The rest

def test_points_message(make: Any) -> None:
    points = np.float32([[1, 2, 3], [4, 5, 6]])
    message = obstacle_messages.points_message(make, replace(sectors(), points=points))
    assert [(f.name, f.offset, f.datatype) for f in message.fields] == [
        ('x', 0, 7), ('y', 4, 7), ('z', 8, 7)]
    assert (message.width, message.height, message.point_step) == (2, 1, 12)
    np.testing.assert_array_equal(np.frombuffer(bytes(message.data), '<f4').reshape(2, 3), points)
    assert message.header.frame_id == 'base_link_level'


@pytest.mark.parametrize(('found', 'expected'), [
    (sectors({LEFT: 5.0, 3: 2.5}, free=[1]), 2.5), (sectors(too_close=[9]), 0.3),
    (sectors(free=range(SECTORS)), math.inf), (sectors(free=range(71)), math.nan)])
def test_nearest(make: Any, found: ObstacleSectors, expected: float) -> None:
    message = obstacle_messages.nearest_message(make, found)
    assert message.range == pytest.approx(expected, nan_ok=True)
    assert (message.min_range, message.max_range) == (pytest.approx(0.3), 20.0)
    assert message.field_of_view == pytest.approx(2 * math.pi)


@pytest.mark.parametrize(('seconds', 'told'), [(2.5, 2.5), (math.inf, math.inf),
                                               (None, math.nan)])
def test_time_to_contact(make: Any, seconds: float | None, told: float) -> None:
    message = obstacle_messages.time_to_contact_message(
        make, replace(sectors(), time_to_contact=seconds))
    assert message.data == pytest.approx(told, nan_ok=True)


def test_markers_show_what_is_left_on_the_left(make: Any) -> None:
    marker, = obstacle_messages.markers_message(make, sectors({LEFT: 5.0}, free=[RIGHT])).markers
    corners = np.array([[p.x, p.y, p.z] for p in marker.points]).reshape(SECTORS, 3, 3)
    colours = np.array([[c.r, c.g, c.b, c.a] for c in marker.colors]).reshape(SECTORS, 3, 4)
    middle = corners[:, 1:].mean(axis=1)
    assert middle[LEFT, 1] == pytest.approx(5.0, abs=0.01)
    assert abs(middle[LEFT, 0]) < 0.01
    assert middle[RIGHT, 1] == pytest.approx(-20.0, abs=0.05)
    red, green = colours[LEFT, 0, :2], colours[RIGHT, 0, :2]
    assert red[0] > red[1]
    assert green[1] > green[0]
    assert marker.lifetime.sec + marker.lifetime.nanosec > 0


class FakeObstacleDistance:
    """The fields of px4_msgs/ObstacleDistance."""

    @staticmethod
    def get_fields_and_field_types() -> dict[str, str]:
        return {'timestamp': 'uint64', 'frame': 'uint8', 'sensor_type': 'uint8',
                'distances': 'uint16[72]', 'increment': 'float', 'min_distance': 'uint16',
                'max_distance': 'uint16', 'angle_offset': 'float'}


class FakeShell:
    """Takes what is published, by topic."""

    def __init__(self) -> None:
        self.config, self.node = resolve({}), None
        self.sent: dict[str, Any] = {}

    def output(self, kind: str, topic: str) -> Any:
        return SimpleNamespace(wanted=True, send=lambda message: self.sent.update(
            {topic: message()}))


@pytest.mark.parametrize('there', [True, False])
def test_px4_gets_it_where_its_messages_are(there: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip('rclpy')
    from sphstereo_ros.nodes.obstacle_detection import ObstacleOutputs
    if there:
        for name in ('px4_msgs', 'px4_msgs.msg'):
            module = ModuleType(name)
            module.__spec__ = ModuleSpec(name, None)
            monkeypatch.setitem(sys.modules, name, module)
        monkeypatch.setattr(module, 'ObstacleDistance', FakeObstacleDistance, raising=False)
    shell = FakeShell()
    outputs = ObstacleOutputs(shell)  # type: ignore[arg-type]
    outputs.deliver(sectors({LEFT: 5.0}), Attitude(), 0.0)
    topic = '/fmu/in/obstacle_distance'
    assert set(shell.sent) == {*obstacle_messages.OUTPUTS, *([topic] if there else [])}
    if there:
        assert isinstance(shell.sent[topic], FakeObstacleDistance)
        assert shell.sent[topic].distances[LEFT] == 500


def test_level_frame_is_told_where_tf2_is(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip('rclpy')
    from sphstereo_ros.nodes.obstacle_detection import ObstacleOutputs
    told: list[Any] = []
    module = ModuleType('tf2_ros')
    module.TransformBroadcaster = lambda node: SimpleNamespace(  # type: ignore[attr-defined]
        sendTransform=told.append)
    monkeypatch.setitem(sys.modules, 'tf2_ros', module)
    outputs = ObstacleOutputs(FakeShell())  # type: ignore[arg-type]
    roll = math.radians(20)
    outputs.deliver(sectors(), Attitude(matrix_from_rpy(roll, 0, 0)), 0.0)
    outputs.deliver(sectors(), None, 0.0)  # nothing is known of it
    transform, = told
    assert transform.header.frame_id == 'base_link'
    assert transform.child_frame_id == 'base_link_level'
    assert nanoseconds(transform.header.stamp) == STAMP
    rotation = transform.transform.rotation
    # The level frame's up, in base_link: the vehicle rolled to the right.
    up = matrix_from_quaternion([rotation.x, rotation.y, rotation.z, rotation.w])[:, 2]
    np.testing.assert_allclose(up, [0, math.sin(roll), math.cos(roll)], atol=1e-12)
