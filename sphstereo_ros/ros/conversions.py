"""Messages ↔ core, as plain functions; the contents page of all conversions.

Reading is by field names, so messages of rclpy and messages out of a bag serve alike; making
takes a `MessageFactory`. What cannot be read is a `Drop`, never an exception.
"""
from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from sphstereo_ros.core import rotations
from sphstereo_ros.core.frames import (
    Drop,
    Frame,
    FrameKey,
    FrameWindow,
    PointCloud,
    Reference,
    RelativePose,
)
from sphstereo_ros.core.motion import ImuSample, OdometrySample, TwistSample
from sphstereo_ros.ros.images import (
    compressed_message,
    decode_frame,
    depth_message,
    frame_message,
    image_message,
    read_depth,
)
from sphstereo_ros.ros.messages import (
    SECOND,
    MessageFactory,
    bad_stamp,
    frame_key,
    header,
    nanoseconds,
    time_message,
)

__all__ = [
    'MessageFactory', 'Status', 'WindowGeometry', 'cloud_message', 'compressed_message',
    'decode_frame', 'depth_message', 'diagnostic_message', 'frame_key', 'frame_message', 'header',
    'image_message', 'imu_sample', 'nanoseconds', 'odometry_message', 'odometry_sample',
    'read_cloud', 'read_depth', 'read_stamped_depth', 'read_window', 'time_message',
    'track_message', 'twist_sample', 'window_message',
]

FloatArray = NDArray[np.float64]
Window = TypeVar('Window', bound=FrameWindow)

UNIT_TOLERANCE = 1e-3
GREATEST_POSITION = 1e9
FLOAT32 = 7  # sensor_msgs/PointField


def _vector(make: MessageFactory, name: str, values: FloatArray) -> Any:
    return make(f'geometry_msgs/msg/{name}', **{
        axis: float(value) for axis, value in zip('xyzw', values, strict=False)})


def _pose(make: MessageFactory, position: FloatArray, rotation: FloatArray) -> Any:
    return make('geometry_msgs/msg/Pose', position=_vector(make, 'Point', position),
                orientation=_vector(make, 'Quaternion',
                                    rotations.quaternion_from_matrix(rotation)))


def _read_vector(msg: Any) -> FloatArray:
    return np.array([msg.x, msg.y, msg.z], np.float64)


def _read_rotation(msg: Any) -> FloatArray | Drop:
    quaternion = np.array([msg.x, msg.y, msg.z, msg.w], np.float64)
    norm = math.hypot(*quaternion)
    if not math.isfinite(norm):
        return Drop('not_finite', f'orientation {quaternion}')
    if abs(norm - 1) > UNIT_TOLERANCE:
        return Drop('invalid_quaternion', f'length {norm:.6g}')
    return rotations.matrix_from_quaternion(quaternion)


def _read_pose(pose: Any) -> tuple[FloatArray, FloatArray] | Drop:
    """geometry_msgs/Pose → position, rotation."""
    position = _read_vector(pose.position)
    if not np.abs(position).max() < GREATEST_POSITION:  # nor is NaN
        return Drop('not_finite', f'position {position}')
    rotation = _read_rotation(pose.orientation)
    return rotation if isinstance(rotation, Drop) else (position, rotation)


# Frame windows

# Covariances of messages are of position then rotation, those of the core the other way round.
_SWAP = np.block([[np.zeros((3, 3)), np.eye(3)], [np.eye(3), np.zeros((3, 3))]])


@dataclass(frozen=True)
class WindowGeometry:
    """A frame window without its pixels: what a nav_msgs/Path says.

    references : key and pose of each, in the order of the window (nearest first)
    """

    current: FrameKey
    references: tuple[tuple[FrameKey, RelativePose], ...]

    @property
    def keys(self) -> tuple[FrameKey, ...]:
        """All frames of the window, current last."""
        return (*(key for key, _ in reversed(self.references)), self.current)

    def with_frames(self, kind: type[Window], frames: Mapping[FrameKey, Frame]) -> Window | Drop:
        """Join with the frames it names; a frame that is not there is a Drop."""
        missing = [key for key in self.keys if key not in frames]
        if missing:
            return Drop('missing_frame', f'{len(missing)} of {len(self.keys)}')
        return kind(frames[self.current], tuple(
            Reference(frames[key], pose) for key, pose in self.references))


def window_message(make: MessageFactory, window: FrameWindow) -> Any:
    """Make a nav_msgs/Path: one pose a frame, the farthest reference first, current last.

    Poses are in the current camera's optical frame; each header names its frame. Covariances
    have no place in a Path.
    """
    poses = [(r.frame.key, r.pose.position, r.pose.rotation) for r in reversed(window.references)]
    poses.append((window.current.key, np.zeros(3), np.eye(3)))
    stamped = [make('geometry_msgs/msg/PoseStamped', header=header(make, key),
                    pose=_pose(make, position, rotation)) for key, position, rotation in poses]
    return make('nav_msgs/msg/Path', header=header(make, window.current.key), poses=stamped)


def read_window(msg: Any) -> WindowGeometry | Drop:
    """Read a nav_msgs/Path as the geometry of a window, or say why not.

    Causes: invalid_stamp, too_few_poses, wrong_current (the last pose is not the header's frame
    at identity), duplicate_frame, not_finite, invalid_quaternion.
    """
    if len(msg.poses) < 2:
        return Drop('too_few_poses', str(len(msg.poses)))
    for each in (msg.header, *(pose.header for pose in msg.poses)):
        drop = bad_stamp(each)
        if drop is not None:
            return drop
    current = frame_key(msg.header)
    keys = [frame_key(pose.header) for pose in msg.poses]
    if keys[-1] != current:
        return Drop('wrong_current', f'{keys[-1]} is last in the window of {current}')
    if len(set(keys)) != len(keys):
        return Drop('duplicate_frame', str(current))
    poses = []
    for stamped in msg.poses:
        pose = _read_pose(stamped.pose)
        if isinstance(pose, Drop):
            return pose
        poses.append(RelativePose(rotation=pose[1], position=pose[0]))
    if poses[-1].baseline > 1e-9 or rotations.angle(poses[-1].rotation) > 1e-6:
        return Drop('wrong_current', 'the current pose is not the identity')
    return WindowGeometry(current, tuple(zip(keys[-2::-1], poses[-2::-1], strict=True)))


def covariance_message(make: MessageFactory, current: FrameKey, pose: RelativePose) -> Any:
    """Make the geometry_msgs/PoseWithCovarianceStamped of a reference whose covariance is known.

    The pose is the one that the window's nav_msgs/Path has for this reference, in the current
    camera's optical frame, number by number; the header is the current frame's.
    """
    covariance = _SWAP @ np.asarray(pose.covariance) @ _SWAP
    return make('geometry_msgs/msg/PoseWithCovarianceStamped', header=header(make, current),
                pose=make('geometry_msgs/msg/PoseWithCovariance',
                          pose=_pose(make, pose.position, pose.rotation),
                          covariance=covariance.reshape(-1)))


def read_covariance(msg: Any) -> tuple[FrameKey, RelativePose] | Drop:
    """Read what `covariance_message` makes: the current frame, and the reference's pose in it.

    Causes: invalid_stamp, not_finite, invalid_quaternion, unknown_covariance.
    """
    drop = bad_stamp(msg.header)
    if drop is not None:
        return drop
    pose = _read_pose(msg.pose.pose)
    if isinstance(pose, Drop):
        return pose
    covariance = _covariance(msg.pose.covariance)
    if covariance is None:
        return Drop('unknown_covariance')
    return frame_key(msg.header), RelativePose(pose[1], pose[0], _SWAP @ covariance @ _SWAP)


def odometry_message(make: MessageFactory, window: FrameWindow) -> Any:
    """Make the nav_msgs/Odometry of the motion from the nearest reference to the current frame.

    pose : the current camera in the reference camera's optical frame (header.frame_id);
    twist : the mean velocity between the two, in the current camera's axes (child_frame_id).
    Covariances are position then rotation; all zero = unknown. What is not known (the position
    without a metric baseline, the velocity between frames of the same stamp) is NaN.
    """
    reference = window.references[0]
    pose = reference.pose
    inverse = pose.rotation.T
    position = -inverse @ pose.position
    # First order of the inverse, in (rotation, position) of the pose:
    # position −R'·dp − R'·[p]·dr, rotation −R'·dr.
    jacobian = np.block([[-inverse @ rotations.skew(pose.position), -inverse],
                         [-inverse, np.zeros((3, 3))]])
    known = np.zeros((6, 6)) if pose.covariance is None else pose.covariance
    pose_covariance = jacobian @ known @ jacobian.T
    seconds = (window.current.key.stamp - reference.frame.key.stamp) / SECOND
    rate = 1 / seconds if seconds else math.nan
    linear, twist_covariance = -pose.position * rate, _SWAP @ known @ _SWAP * rate**2
    if not pose.is_metric:
        position, linear = np.full(3, math.nan), np.full(3, math.nan)
        pose_covariance[:3], pose_covariance[:, :3] = math.nan, math.nan
        twist_covariance[:3], twist_covariance[:, :3] = math.nan, math.nan
    twist = make('geometry_msgs/msg/Twist', linear=_vector(make, 'Vector3', linear),
                 angular=_vector(make, 'Vector3', -rotations.log(pose.rotation) * rate))
    key = FrameKey(window.current.key.stamp, reference.frame.key.frame_id)
    return make(
        'nav_msgs/msg/Odometry', header=header(make, key),
        child_frame_id=window.current.key.frame_id,
        pose=make('geometry_msgs/msg/PoseWithCovariance', pose=_pose(make, position, inverse),
                  covariance=pose_covariance.reshape(-1)),
        twist=make('geometry_msgs/msg/TwistWithCovariance', twist=twist,
                   covariance=twist_covariance.reshape(-1)))


def track_message(make: MessageFactory, stamp: int, rotation: FloatArray,
                  position: FloatArray) -> Any:
    """Make the nav_msgs/Odometry of base_link in the map, which is in `odom`; covariance and
    twist are unknown.
    """
    return make('nav_msgs/msg/Odometry', header=header(make, FrameKey(stamp, 'odom')),
                child_frame_id='base_link', pose=make(
                    'geometry_msgs/msg/PoseWithCovariance', pose=_pose(make, position, rotation)))


# Depth

def read_stamped_depth(msg: Any) -> tuple[FrameKey, NDArray[np.float32]] | Drop:
    """Read depth/image or depth/sigma: what names the frame, and (H, W) float32 metres.

    Causes: invalid_stamp, and those of `read_depth`.
    """
    drop = bad_stamp(msg.header)
    if drop is not None:
        return drop
    pixels = read_depth(msg)
    return pixels if isinstance(pixels, Drop) else (frame_key(msg.header), pixels)


# Point clouds

def cloud_message(make: MessageFactory, cloud: PointCloud, frame_id: str = 'base_link') -> Any:
    """Make a sensor_msgs/PointCloud2: x y z, rgb or intensity, sigma; all float32."""
    count = len(cloud.xyz)
    points = np.empty((count, 5), '<f4')
    points[:, :3] = cloud.xyz
    if cloud.bgr is not None:
        blue, green, red = (cloud.bgr[:, i].astype(np.uint32) for i in range(3))
        points.view('<u4')[:, 3] = red << 16 | green << 8 | blue
    elif cloud.intensity is not None:
        points[:, 3] = cloud.intensity
    else:
        points[:, 3] = math.nan
    points[:, 4] = cloud.sigma
    names = ('x', 'y', 'z', 'intensity' if cloud.bgr is None else 'rgb', 'sigma')
    fields = [make('sensor_msgs/msg/PointField', name=name, offset=4 * i, datatype=FLOAT32,
                   count=1) for i, name in enumerate(names)]
    return make('sensor_msgs/msg/PointCloud2',
                header=header(make, FrameKey(cloud.key.stamp, frame_id)), height=1, width=count,
                fields=fields, is_bigendian=False, point_step=20, row_step=20 * count,
                data=points.reshape(-1).view(np.uint8), is_dense=True)


def read_cloud(msg: Any) -> PointCloud | Drop:
    """Read a sensor_msgs/PointCloud2 as `cloud_message` makes it, or say why not.

    Causes: invalid_stamp, unknown_fields, wrong_data_length.
    """
    drop = bad_stamp(msg.header)
    if drop is not None:
        return drop
    names = [f.name for f in msg.fields]
    expected = [(4 * i, FLOAT32, 1) for i in range(5)]
    if names[:3] + names[4:] != ['x', 'y', 'z', 'sigma'] or names[3] not in ('rgb', 'intensity') \
            or [(f.offset, f.datatype, f.count) for f in msg.fields] != expected \
            or msg.is_bigendian or msg.point_step != 20:
        return Drop('unknown_fields', ' '.join(names)[:80])
    data = np.frombuffer(msg.data, np.uint8)
    if data.size != 20 * int(msg.width) * int(msg.height):
        return Drop('wrong_data_length', f'{data.size} bytes for {msg.width}×{msg.height} points')
    points = data.view('<f4').reshape(-1, 5)
    xyz, sigma = points[:, :3].copy(), points[:, 4].copy()
    if names[3] == 'rgb':
        packed = points.view('<u4')[:, 3]
        bgr = np.stack([packed, packed >> 8, packed >> 16], axis=1).astype(np.uint8)
        return PointCloud(frame_key(msg.header), xyz, sigma, bgr=bgr)
    with np.errstate(invalid='ignore'):
        intensity = np.clip(np.nan_to_num(points[:, 3]), 0, 255).astype(np.uint8)
    return PointCloud(frame_key(msg.header), xyz, sigma, intensity=intensity)


# Motion

def _covariance(values: Any) -> FloatArray | None:
    """36 numbers → (6, 6); None where they say that nothing is known."""
    matrix = np.array(values, np.float64).reshape(6, 6)
    known = np.isfinite(matrix).all() and matrix.any() and (np.diag(matrix) >= 0).all()
    return matrix if known else None


def odometry_sample(msg: Any) -> OdometrySample | Drop:
    """nav_msgs/Odometry → pose of base_link in odom.

    Causes: invalid_stamp, not_finite, invalid_quaternion. A covariance that is all zero, not
    finite or has a negative variance is unknown.
    """
    drop = bad_stamp(msg.header)
    if drop is not None:
        return drop
    pose = _read_pose(msg.pose.pose)
    if isinstance(pose, Drop):
        return pose
    return OdometrySample(nanoseconds(msg.header.stamp), pose[0], pose[1],
                          _covariance(msg.pose.covariance))


def twist_sample(msg: Any) -> TwistSample | Drop:
    """geometry_msgs/TwistStamped → velocity of base_link; causes: invalid_stamp, not_finite."""
    drop = bad_stamp(msg.header)
    if drop is not None:
        return drop
    linear, angular = _read_vector(msg.twist.linear), _read_vector(msg.twist.angular)
    if not (np.isfinite(linear).all() and np.isfinite(angular).all()):
        return Drop('not_finite', f'twist {linear} {angular}')
    return TwistSample(nanoseconds(msg.header.stamp), linear, angular)


def imu_sample(msg: Any) -> ImuSample | Drop:
    """sensor_msgs/Imu (in base_link axes) → angular velocity, and orientation if there is one.

    Causes: invalid_stamp, no_angular_velocity, not_finite, invalid_quaternion. REP-145: a first
    covariance of −1 says that the sensor does not measure it; a zero quaternion says so too.
    """
    drop = bad_stamp(msg.header)
    if drop is not None:
        return drop
    if msg.angular_velocity_covariance[0] == -1:
        return Drop('no_angular_velocity')
    angular = _read_vector(msg.angular_velocity)
    if not np.isfinite(angular).all():
        return Drop('not_finite', f'angular velocity {angular}')
    stamp, q = nanoseconds(msg.header.stamp), msg.orientation
    if msg.orientation_covariance[0] == -1 or q.x == q.y == q.z == q.w == 0:
        return ImuSample(stamp, angular)
    rotation = _read_rotation(q)
    return rotation if isinstance(rotation, Drop) else ImuSample(stamp, angular, rotation)


# Diagnostics

@dataclass(frozen=True)
class Status:
    """One diagnostic_msgs/DiagnosticStatus; level: 0 OK, 1 warning, 2 error, 3 stale."""

    name: str
    level: int = 0
    message: str = ''
    values: Mapping[str, object] = field(default_factory=dict)


def diagnostic_message(make: MessageFactory, stamp: int, statuses: Sequence[Status]) -> Any:
    """Make a diagnostic_msgs/DiagnosticArray; stamp in nanoseconds."""
    return make('diagnostic_msgs/msg/DiagnosticArray', header=header(make, FrameKey(stamp, '')),
                status=[make('diagnostic_msgs/msg/DiagnosticStatus', level=s.level, name=s.name,
                             message=s.message,
                             values=[make('diagnostic_msgs/msg/KeyValue', key=key,
                                          value=str(value)) for key, value in s.values.items()])
                        for s in statuses])
