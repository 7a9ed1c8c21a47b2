"""Every parameter of the package, stated once.

Each group is a frozen dataclass whose fields carry name, default, unit, bounds and meaning. The
core takes the groups as they are; ROS descriptors, the check of parameter files and the table in
the documentation are all made from the same fields. `resolve` turns names and values, from
wherever they come, into a checked `Config`, or raises `ParameterError`.
"""
from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

Value = bool | int | float | str | tuple[int, ...] | tuple[float, ...]


class ParameterError(ValueError):
    """A parameter was refused; the message says which and why."""


@dataclass(frozen=True)
class Parameter:
    """Name, type, default, bounds, unit and meaning of one parameter.

    `runtime` says whether it may change while a node runs.
    """

    name: str
    kind: type
    default: Value
    meaning: str
    unit: str = ''
    low: float = -math.inf
    high: float = math.inf
    choices: tuple[str, ...] = ()
    runtime: bool = True
    is_array: bool = False

    def checked(self, value: object) -> Value:
        """Return `value` in this parameter's type, or raise ParameterError with the reason."""
        if self.is_array:
            if not isinstance(value, Sequence) or isinstance(value, (str, bytes)) or not value:
                raise ParameterError(f'{self.name}: needs a non-empty list, not {value!r}')
            return tuple(self._scalar(v) for v in value)  # type: ignore[return-value]
        return self._scalar(value)

    def _scalar(self, value: object) -> bool | int | float | str:
        if self.kind is float and isinstance(value, int) and not isinstance(value, bool):
            value = float(value)
        if type(value) is not self.kind:
            raise ParameterError(f'{self.name}: needs {self.kind.__name__}, not {value!r}')
        if isinstance(value, (int, float)) and not isinstance(value, bool):
            if not self.low <= value <= self.high:  # NaN fails too
                raise ParameterError(
                    f'{self.name}: {value} is outside {self.low:g} … {self.high:g}')
        elif self.choices and value not in self.choices:
            raise ParameterError(f'{self.name}: {value!r} is none of {", ".join(self.choices)}')
        return value  # type: ignore[return-value]


def _p(name: str, default: Value, meaning: str, **more: Any) -> Any:
    array = isinstance(default, tuple)
    kind = type(default[0]) if isinstance(default, tuple) else type(default)
    spec = Parameter(name, kind, default, meaning, is_array=array, **more)
    return field(default=default, metadata={'parameter': spec})


@dataclass(frozen=True)
class CameraConfig:
    """The camera: model, mount on the vehicle, what of the vehicle it sees."""

    model: str = _p('camera.model', 'equirectangular', 'projection of the input images',
                    choices=('equirectangular',), runtime=False)
    mask: str = _p('camera.mask', '', 'image file, non-zero = vehicle: unknown there',
                   runtime=False)
    mount_x: float = _p('camera.mount.x', 0.0, 'camera_link in base_link, forward', unit='m',
                        low=-1000.0, high=1000.0)
    mount_y: float = _p('camera.mount.y', 0.0, 'camera_link in base_link, left', unit='m',
                        low=-1000.0, high=1000.0)
    mount_z: float = _p('camera.mount.z', 0.0, 'camera_link in base_link, up', unit='m',
                        low=-1000.0, high=1000.0)
    mount_roll: float = _p('camera.mount.roll', 0.0, 'R = Rz(yaw) Ry(pitch) Rx(roll)', unit='rad',
                           low=-math.pi, high=math.pi)
    mount_pitch: float = _p('camera.mount.pitch', 0.0, 'see camera.mount.roll', unit='rad',
                            low=-math.pi, high=math.pi)
    mount_yaw: float = _p('camera.mount.yaw', 0.0, 'see camera.mount.roll', unit='rad',
                          low=-math.pi, high=math.pi)
    top_roll: float = _p('camera.top.roll', 0.0, 'binocular: top camera_link in the bottom '
                         "one's axes, R = Rz(yaw) Ry(pitch) Rx(roll)", unit='rad', low=-math.pi,
                         high=math.pi)
    top_pitch: float = _p('camera.top.pitch', 0.0, 'see camera.top.roll', unit='rad',
                          low=-math.pi, high=math.pi)
    top_yaw: float = _p('camera.top.yaw', 0.0, 'see camera.top.roll', unit='rad', low=-math.pi,
                        high=math.pi)


@dataclass(frozen=True)
class BaselineConfig:
    """Where metres come from."""

    source: str = _p('baseline.source', 'fixed', 'what gives the distance between frames',
                     choices=('fixed', 'speed', 'twist', 'odometry'))
    length: float = _p('baseline.length', 0.0, 'fixed: distance between consecutive frames; '
                       '0 = unknown, the output is relative', unit='m', low=0.0, high=1000.0)
    speed: float = _p('baseline.speed', 0.0, 'speed: times the stamp difference; 0 = unknown',
                      unit='m/s', low=0.0, high=1000.0)
    direction: tuple[float, ...] = _p('baseline.direction', (0.0, 0.0, 1.0), 'binocular: from the '
                                      'bottom to the top camera, along the axes of the bottom '
                                      'camera_link (x forward, y left, z up); its length does '
                                      'not matter', low=-1000.0, high=1000.0)
    minimum: float = _p('baseline.minimum', 0.02, 'a shorter measured baseline is a drop '
                        '(hover)', unit='m', low=0.0, high=1000.0)
    relative_sigma: float = _p('baseline.relative_sigma', 0.0, 'standard deviation of the '
                               'baseline as a share of it, where its source tells none; 0 = left '
                               'out of sigma', low=0.0, high=1.0)


@dataclass(frozen=True)
class PairingConfig:
    """Which frames make a window."""

    mode: str = _p('pairing.mode', 'monocular', 'monocular: one moving camera, on image; '
                   'binocular: two, on top/image and bottom/image',
                   choices=('monocular', 'binocular'), runtime=False)
    tolerance: float = _p('pairing.tolerance', 0.025, 'binocular: how far the stamps of a pair '
                          'may be apart; less than half the time between frames', unit='s',
                          low=0.0, high=10.0)
    fallback: bool = _p('pairing.fallback', False, 'binocular: where one camera is silent, the '
                        'other continues as monocular', runtime=False)
    motion: bool = _p('pairing.motion', True, 'binocular: earlier frames of the bottom camera are '
                      'references, too, where it moved')
    intervals: tuple[int, ...] = _p('pairing.intervals', (1, 4, 7, 10),
                                    'references, frames back', low=1, high=100)
    baselines: tuple[float, ...] = _p('pairing.baselines', (0.0,), 'references by distance '
                                      'instead of pairing.intervals; 0 = unused', unit='m',
                                      low=0.0, high=1000.0)
    max_frames: int = _p('pairing.max_frames', 100, 'how many frames back pairing.baselines may '
                         'reach; fewer where so many take more than 512 MB', low=1, high=1000)
    max_rate: float = _p('pairing.max_rate', 0.0, 'windows a second at most, where later stages '
                         'cannot keep up; frames between serve as references; 0 = every frame',
                         unit='Hz', low=0.0, high=1000.0)
    max_gap: float = _p('pairing.max_gap', 1.0, 'a longer gap between frames, or stamps that run '
                        'backward, empty the buffer', unit='s', low=0.001, high=3600.0)


@dataclass(frozen=True)
class PoseConfig:
    """Relative pose from bearings (stage 2)."""

    working_height: int = _p('pose.working_height', 480, 'image height for tracking', low=60,
                             high=4096)
    max_points: int = _p('pose.max_points', 2500, 'correspondences used', low=50, high=100000)
    inlier_threshold: float = _p('pose.inlier_threshold', 0.003, 'angular residual of an inlier',
                                 unit='rad', low=1e-5, high=0.1)
    min_inliers: int = _p('pose.min_inliers', 60, 'fewer are a drop', low=8)
    min_inlier_ratio: float = _p('pose.min_inlier_ratio', 0.35, 'a smaller share is a drop',
                                 low=0.0, high=1.0)
    min_parallax: float = _p('pose.min_parallax', 0.0015, 'median parallax without rotation '
                             'under which a pair is a hover or a pure rotation', unit='rad',
                             low=0.0, high=1.0)
    seed: int = _p('pose.seed', 1, 'of the random samples: the same input gives the same output',
                   low=0)


@dataclass(frozen=True)
class AlignmentConfig:
    """Motion direction and refinement on the aligned pair (stage 3)."""

    method: str = _p('alignment.method', 'refined', 'refined: features of the aligned pair; '
                     "paper: the window-ratio estimator of the paper's section 3.1",
                     choices=('refined', 'paper'))
    working_height: int = _p('alignment.working_height', 864, 'polar height of the reduced '
                             'aligned copy', unit='px', low=60, high=4096)
    max_points: int = _p('alignment.max_points', 5000, 'features followed, about', low=200,
                         high=100000)
    iterations: int = _p('alignment.iterations', 1, 'refinements', low=0, high=10)
    rotation_sigma: float = _p('alignment.rotation_sigma', 0.005 * math.pi / 180,
                               'least standard deviation of a refined rotation', unit='rad',
                               low=0.0, high=0.1)
    direction_sigma: float = _p('alignment.direction_sigma', 0.02 * math.pi / 180,
                                'least standard deviation of a refined direction', unit='rad',
                                low=0.0, high=0.1)


@dataclass(frozen=True)
class CalibrationConfig:
    """The alignment of two cameras."""

    pairs: int = _p('calibration.pairs', 0, 'binocular: estimate camera.top.* from the first '
                    'pairs before depth is published, so many at most; 0 = camera.top.* as '
                    'given', low=0, high=1000, runtime=False)
    each_pair: bool = _p('calibration.each_pair', False, 'binocular: estimate rotation and '
                         'direction of each pair by itself, for cameras that are not synchronised '
                         'or not rigid; noisier')
    online: bool = _p('calibration.online', False, 'binocular: follow slow drift of camera.top.*')
    time_constant: float = _p('calibration.time_constant', 20.0, 'of the filter that follows '
                              'drift', unit='s', low=0.1, high=1e6)
    max_rate: float = _p('calibration.max_rate', 0.01 * math.pi / 180, 'fastest drift that is '
                         'followed, about any axis', unit='rad/s', low=0.0, high=1.0)
    max_drift: float = _p('calibration.max_drift', 1.0 * math.pi / 180, 'largest drift that is '
                          'followed, in all', unit='rad', low=0.0, high=math.pi)
    jump: float = _p('calibration.jump', 0.2 * math.pi / 180, 'a pair that differs by more is '
                     'reported and never followed', unit='rad', low=0.0, high=math.pi)
    max_sigma: float = _p('calibration.max_sigma', 0.05 * math.pi / 180, 'standard deviation of '
                          'a rotation above which a calibration is refused', unit='rad', low=0.0,
                          high=math.pi)


@dataclass(frozen=True)
class StereoConfig:
    """Matching along the meridians (stage 4)."""

    matcher: str = _p('stereo.matcher', 'joint', 'joint: all references together, checked by a '
                      'second method and by the frames before; joint_fast: the same from bm, '
                      'checked by itself; pair by pair: flow, flow_fast: dense flow with checks; '
                      'bm, sgbm: as in OpenCV; bm_judged: bm without what looks wrong; hybrid: '
                      'flow averaged with bm',
                      choices=('joint', 'joint_fast', 'hybrid', 'flow', 'flow_fast', 'bm',
                               'bm_judged', 'sgbm'))
    memory: float = _p('stereo.memory', 0.45, 'joint matchers: how long a range is kept that no '
                       'newer frame confirms; 0 = every frame by itself', unit='s', low=0.0,
                       high=0.5)
    num_disparities: int = _p('stereo.num_disparities', 96, 'search range of bm, sgbm and hybrid',
                              unit='px', low=16, high=1024)
    block_size: int = _p('stereo.block_size', 15, 'odd window of bm, sgbm and hybrid',
                         unit='px', low=3, high=51)
    working_height: int = _p('stereo.working_height', 0, 'height of frames and depth; 0 = input',
                             unit='px', low=0, high=8192, runtime=False)


@dataclass(frozen=True)
class RangeConfig:
    """What of the range is published."""

    minimum: float = _p('range.min', 0.3, 'nearer is −Inf', unit='m', low=0.0, high=1000.0)
    maximum: float = _p('range.max', 120.0, 'confidently farther is +Inf', unit='m', low=0.1,
                        high=10000.0)
    max_relative_sigma: float = _p('range.max_relative_sigma', 0.7, 'sigma over range above '
                                   'which the range is unknown; of two cameras, other matchers '
                                   'than joint, and a first window, at most 0.5', low=0.001,
                                   high=10.0)


@dataclass(frozen=True)
class PointsConfig:
    """The point cloud."""

    stride: int = _p('points.stride', 0, 'every n-th pixel and row; 0 = the least that keeps a '
                     'cloud within 8 MB', unit='px', low=0, high=256)
    colour: bool = _p('points.colour', False, 'rgb instead of intensity; frames carry colour',
                      runtime=False)


@dataclass(frozen=True)
class ObstaclesConfig:
    """What is an obstacle: all of it in the level frame, from the origin of `base_link`."""

    height_above: float = _p('obstacles.height_above', 1.0, 'obstacles are looked for up to that '
                             'much above base_link', unit='m', low=0.0, high=100.0)
    height_below: float = _p('obstacles.height_below', 1.0, 'and down to that much below it',
                             unit='m', low=0.0, high=100.0)
    minimum: float = _p('obstacles.min', 0.3, 'what is nearer is told as that far', unit='m',
                        low=0.01, high=10.0)
    maximum: float = _p('obstacles.max', 20.0, 'farther obstacles are not told', unit='m',
                        low=0.5, high=600.0)
    ground_clearance: float = _p('obstacles.ground_clearance', 0.2, 'what is lower above the '
                                 'ground is no obstacle', unit='m', low=0.0, high=2.0)
    vehicle_width: float = _p('obstacles.vehicle_width', 0.6, 'of the way that must be free, for '
                              'the time to contact', unit='m', low=0.0, high=100.0)
    hidden_width: float = _p('obstacles.hidden_width', 1.0, 'a sector is unknown where something '
                             'so wide, or a post, could stand unseen, much nearer than what is '
                             'measured; 0 = it is told as measured, all the same', unit='m',
                             low=0.0, high=100.0)
    trust_sky: bool = _p('obstacles.trust_sky', False, 'more than 11° above the horizon, a sector '
                         'may be free where nothing is measured: plain sky has no range, but '
                         'neither has a branch before it that was missed')
    require_attitude: bool = _p('obstacles.require_attitude', True, 'without roll and pitch there '
                                'is no result; false: base_link is taken for level')
    max_rate: float = _p('obstacles.max_rate', 0.0, 'depth images a second at most in which '
                         'obstacles are looked for; 0 = all', unit='Hz', low=0.0, high=1000.0)
    stall: float = _p('obstacles.stall', 0.5, 'no new depth for so long is an error in '
                      '/diagnostics; what is older is not sent', unit='s', low=0.05, high=10.0)


@dataclass(frozen=True)
class MavlinkConfig:
    """The way of obstacles to an autopilot."""

    url: str = _p('obstacles.mavlink.url', '', 'autopilot: udpout:HOST:PORT (sends there), '
                  'udpin:HOST:PORT (listens here), tcp:HOST:PORT or /dev/DEVICE,BAUD; '
                  'empty = no MAVLink', runtime=False)
    system_id: int = _p('obstacles.mavlink.system_id', 1, 'that of the vehicle', low=1, high=255,
                        runtime=False)
    component_id: int = _p('obstacles.mavlink.component_id', 196, '196 = obstacle avoidance',
                           low=1, high=255, runtime=False)
    send_3d: bool = _p('obstacles.mavlink.send_3d', False, 'OBSTACLE_DISTANCE_3D, too: ArduPilot '
                       'only', runtime=False)
    points_3d: int = _p('obstacles.mavlink.points_3d', 12, 'how many points at most, the nearest, '
                        'one a sector', low=1, high=72, runtime=False)


@dataclass(frozen=True)
class MappingConfig:
    """The map of a drive or flight."""

    voxel: float = _p('mapping.voxel', 0.05, 'points within such a cube become one; uncertain '
                      'points in cubes up to 32 times as large', unit='m', low=0.001, high=100.0)
    max_points: int = _p('mapping.max_points', 2_000_000, 'of a map, about 100 bytes each; when '
                         'it has as many, what one frame saw is dropped, then cubes are doubled',
                         low=1000, high=100_000_000, runtime=False)
    max_range: float = _p('mapping.max_range', 40.0, 'what is farther from the camera is left out',
                          unit='m', low=0.1, high=10000.0)
    max_relative_sigma: float = _p('mapping.max_relative_sigma', 0.25, 'sigma over range above '
                                   'which a range is left out', low=0.0001, high=1.0)
    max_sigma: float = _p('mapping.max_sigma', 2.0, 'standard deviation above which a point is '
                          'left out', unit='m', low=0.0001, high=1000.0)
    min_frames: int = _p('mapping.min_frames', 5, 'points that fewer frames saw are left out',
                         low=1, high=1000)
    camera_height: float = _p('mapping.camera_height', 0.0, 'height of the camera above the '
                              'ground, from which metres come where baseline.source tells none; '
                              '0 = unknown', unit='m', low=0.0, high=1000.0)
    rate: float = _p('mapping.rate', 0.5, 'how often the node publishes the map, at most',
                     unit='Hz', low=0.001, high=1000.0)


@dataclass(frozen=True)
class ReplayConfig:
    """The node `bag_replay`."""

    bag: str = _p('replay.bag', '', 'bag, video or folder of frames to play', runtime=False)
    topic: str = _p('replay.topic', '', 'image topic to play as `image`; empty = as recorded',
                    runtime=False)
    rate: float = _p('replay.rate', 1.0, 'speed, as a multiple of real time', low=0.001,
                     high=1000.0, runtime=False)
    loop: bool = _p('replay.loop', False, 'begin again at the end, with stamps that go on rising',
                    runtime=False)
    start_offset: float = _p('replay.start_offset', 0.0, 'how much of the beginning to leave out',
                             unit='s', low=0.0, high=1e6, runtime=False)
    wait: float = _p('replay.wait', 0.0, 'longest wait for subscriptions before the start',
                     unit='s', low=0.0, high=3600.0, runtime=False)
    subscriptions: int = _p('replay.subscriptions', 1, 'how many subscriptions to images to wait '
                            'for', low=1, high=1000, runtime=False)


@dataclass(frozen=True)
class Config:
    """All groups."""

    camera: CameraConfig = CameraConfig()
    baseline: BaselineConfig = BaselineConfig()
    pairing: PairingConfig = PairingConfig()
    pose: PoseConfig = PoseConfig()
    alignment: AlignmentConfig = AlignmentConfig()
    calibration: CalibrationConfig = CalibrationConfig()
    stereo: StereoConfig = StereoConfig()
    range: RangeConfig = RangeConfig()
    points: PointsConfig = PointsConfig()
    obstacles: ObstaclesConfig = ObstaclesConfig()
    mavlink: MavlinkConfig = MavlinkConfig()
    mapping: MappingConfig = MappingConfig()
    replay: ReplayConfig = ReplayConfig()


def _specs() -> Iterator[tuple[str, str, Parameter]]:
    for group in dataclasses.fields(Config):
        for item in dataclasses.fields(group.default):  # type: ignore[arg-type]
            yield group.name, item.name, item.metadata['parameter']


PARAMETERS: dict[str, Parameter] = {spec.name: spec for _, _, spec in _specs()}


def resolve(given: Mapping[str, object]) -> Config:
    """Check `given` (names → values, all others at their default) and build the Config.

    Raises
    ------
    ParameterError
        for an unknown name, a wrong type, a value out of bounds, or values that exclude each other

    """
    for name in given:
        if name not in PARAMETERS:
            raise ParameterError(f'{name}: no node of this package has such a parameter')
    values = {name: PARAMETERS[name].checked(value) for name, value in given.items()}
    groups: dict[str, dict[str, Value]] = {}
    for group, item, spec in _specs():
        if spec.name in values:
            groups.setdefault(group, {})[item] = values[spec.name]
    default = Config()
    config = dataclasses.replace(default, **{
        group: dataclasses.replace(getattr(default, group), **items)
        for group, items in groups.items()})
    _check_together(config, values)
    return config


def _check_together(config: Config, given: Mapping[str, Value]) -> None:
    direction = config.baseline.direction
    if len(direction) != 3 or math.hypot(*direction) < 1e-6:
        raise ParameterError(f'baseline.direction: {list(direction)} is no direction: needs x, y, '
                             'z, not all zero')
    baselines = config.pairing.baselines
    if (baselines != (0.0,) and config.pairing.mode == 'binocular'
            and config.baseline.source == 'fixed'):
        raise ParameterError('pairing.baselines: baseline.length is that between the cameras; '
                             'how far the rig moves, baseline.source must tell')
    if 0.0 in baselines and len(baselines) > 1:
        raise ParameterError('pairing.baselines: 0 (unused) cannot stand beside other baselines')
    if baselines != (0.0,) and 'pairing.intervals' in given:
        raise ParameterError('pairing.intervals and pairing.baselines: give one of them, not both')
    if baselines != (0.0,) and ((config.baseline.source, config.baseline.length) == ('fixed', 0.0)
                                or (config.baseline.source, config.baseline.speed)
                                == ('speed', 0.0)):
        raise ParameterError('pairing.baselines: baseline.source tells no metres')
    if config.stereo.num_disparities % 16:
        raise ParameterError('stereo.num_disparities: must be a multiple of 16')
    if config.stereo.block_size % 2 == 0:
        raise ParameterError('stereo.block_size: must be odd')
    if config.range.minimum >= config.range.maximum:
        raise ParameterError('range.min: must be less than range.max')
    if config.obstacles.minimum >= config.obstacles.maximum:
        raise ParameterError('obstacles.min: must be less than obstacles.max')
    if config.obstacles.height_above + config.obstacles.height_below <= 0:
        raise ParameterError('obstacles.height_above, obstacles.height_below: there is no height '
                             'between them')
