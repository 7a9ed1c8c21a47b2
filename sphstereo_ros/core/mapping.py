"""One registered cloud and the track, from the range images of a drive or flight.

Every frame is placed by visual odometry (`track`), its points are fused into voxels with weights
1/σ² (`voxels`), and what is left at the end is what enough frames saw, where nothing sharper is.
"""
from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np

from .camera import Equirectangular
from .cloud import BYTES_PER_POINT, MAX_BYTES
from .config import Config, MappingConfig
from .frames import (
    AlignedWindow,
    Drop,
    Frame,
    FrameKey,
    Image8,
    PointCloud,
    RangeImage,
    RelativePose,
)
from .ground_scale import HEIGHT_SIGMA, ground_scale
from .history import inverse
from .jit import kernel
from .motion import OdometrySample
from .pose_graph import Floats
from .rotations import Mount, mount
from .track import Track, TrackedFrame
from .voxels import Map32, VoxelMap, VoxelPoints

_ROWS = 220  # of a range image that take part, about; each in as many columns as make it even
_LEAST_SIGMA = 0.003  # m: no range is better, whatever it tells
_ALIKE = 1.5  # times sigma: errors of consecutive frames are alike, and their tails are long


@dataclass(frozen=True)
class _Scan:
    """Points of one frame: xyz (N, 3) float32 in its camera's axes and its window's unit; sigma
    (N,) float32; bgr (N, 3).
    """

    key: FrameKey
    xyz: Map32
    sigma: Map32
    bgr: Image8


@dataclass(frozen=True)
class Submap:
    """What became of some frames.

    frames : where they were taken; points : all voxels, fused ones and single ones
    assumed, tracked : length of the way as it was assumed, and as it was tracked: of frames whose
    points are in it and whose windows have scales of their own
    """

    frames: list[TrackedFrame]
    points: VoxelPoints
    assumed: float = 0.0
    tracked: float = 0.0


def first_pose(config: Config, odometry: OdometrySample | None = None) -> RelativePose:
    """The first camera in the map: by odometry, or else where base_link is the map's origin."""
    camera = mount(config.camera)
    if odometry is None:
        return RelativePose(camera.rotation, camera.position)
    return RelativePose(odometry.rotation @ camera.rotation,
                        odometry.rotation @ camera.position + odometry.position)


def has_free_scales(config: Config) -> bool:
    """Whether no sensor measures how far the camera goes between two frames."""
    return config.pairing.mode == 'monocular' and config.baseline.source in ('fixed', 'speed')


@kernel
def _collect(r: Map32, sigma: Map32, moving: Image8, bgr: Image8, bearings: Map32, step: int,
             shift: int, limits: Map32, xyz: Map32, spread: Map32,
             colours: Image8) -> int:  # pragma: no cover - compiled
    """Points of pixels that lie evenly on the sphere; returns how many."""
    count, rows, columns = 0, r.shape[0], r.shape[1]
    for i in range(shift % step, rows, step):
        across = max(1, int(step / np.cos((0.5 - (i + 0.5) / rows) * np.pi)))
        across = min(across, columns)
        for j in range((shift * 7 + i) % across, columns, across):
            distance = r[i, j]
            if not (np.isfinite(distance) and distance > 0 and distance < limits[0]
                    and sigma[i, j] < limits[1] * distance and moving[i, j] == 0):
                continue
            for axis in range(3):
                xyz[count, axis] = bearings[i, j, axis] * distance
                colours[count, axis] = bgr[i, j, axis]
            spread[count] = max(sigma[i, j], limits[2])
            count += 1
    return count


@lru_cache(maxsize=2)
def _bearings(height: int) -> Map32:
    return np.ascontiguousarray(Equirectangular(height, 2 * height).bearings(), np.float32)


class Mapper:
    """Maps frames one after the other.

    config : all parameters
    lag : so many frames wait for better poses before their points are fused; 0 = all wait
    first : pose of the first camera in the map
    """

    def __init__(self, config: Config, lag: int = 0, first: RelativePose | None = None) -> None:
        self._config = config
        self._free = has_free_scales(config)
        self._by_height = self._free and config.mapping.camera_height > 0
        self._lag = lag
        self.track = Track(first or first_pose(config), self._free, not self._by_height,
                           keep=4 * lag and max(4 * lag, 150))
        self.voxels = VoxelMap(config.mapping.voxel, config.mapping.max_points)
        self._waiting: deque[_Scan] = deque()
        self._fused = 0
        self._count = 0
        self._scale: float | None = None
        self._steps: list[tuple[FrameKey, float]] = []
        self._odometry: RelativePose | None = None

    def add(self, window: AlignedWindow, image: RangeImage, colours: Frame | None = None,
            odometry: OdometrySample | None = None, fuse: bool = True) -> TrackedFrame | Drop:
        """Place a window's current frame, and keep its points.

        Parameters
        ----------
        window, image : of the same frame
        colours : the frame, where it is not the window's own that has them
        odometry : pose of base_link at its stamp: places the frame where the images do not
        fuse : whether its points are wanted

        Returns
        -------
        Drops: `no_scale`, where there are no metres; and those of `Track.add`

        """
        if not image.is_metric and not self._by_height:
            return Drop('no_scale', 'neither baseline.source nor mapping.camera_height tells it')
        scale = self._scale_by_ground(image)
        if self._by_height and scale is None and not len(self.track):
            return Drop('no_ground', 'no ground is found below the camera')
        placed = self.track.add(window, self._link(odometry),
                                (scale, HEIGHT_SIGMA) if scale else None)
        if isinstance(placed, Drop):
            return placed
        self._scale = placed.scale
        if odometry is not None:
            self._odometry = first_pose(self._config, odometry)
        else:
            self._odometry = None
        if fuse and not self._lag:
            self._steps.append((window.current.key, window.references[0].pose.baseline))
        if fuse:
            self._waiting.append(self._scan(image, colours or window.current))
        while self._lag and len(self._waiting) > self._lag:
            self._fuse(self._waiting.popleft())
        return placed

    def finish(self) -> Submap:
        """All that waits is fused; what has become of all frames, or with a lag, of the newest."""
        if not self._lag:
            self.track.adjust_all()
        while self._waiting:
            self._fuse(self._waiting.popleft())
        frames = self.track.frames
        if not self._free or self._by_height:
            return Submap(frames, self.voxels.points())
        return Submap(frames, self.voxels.points(), sum(step for _, step in self._steps),
                      sum(self.track[key].scale * step for key, step in self._steps))

    def cloud(self, stamp: int) -> PointCloud:
        """What is worth keeping so far, in `odom`: so many points that they take up to 8 MB."""
        points = confirmed(self.voxels.points(), self._config.mapping)
        most = MAX_BYTES // BYTES_PER_POINT
        if len(points) > most:  # voxels come in the order of a hash: any part is even
            points = points.chosen(np.linspace(0, len(points) - 1, most).astype(np.intp))
        return map_cloud(points, stamp)

    def warm_up(self) -> None:
        """Compile what `add` and `cloud` need; only before the first frame."""
        key = FrameKey(0, '')
        nothing = np.full((8, 16), np.nan, np.float32)
        scan = self._scan(RangeImage(key, nothing, nothing, True),
                          Frame(key, np.zeros((8, 16), np.uint8)))
        self.voxels.add(scan.xyz, scan.sigma, scan.bgr, 0)
        self.voxels.points()
        self._count = 0

    @property
    def fused(self) -> int:
        """How many frames have their points in the map."""
        return self._fused

    def _scale_by_ground(self, image: RangeImage) -> float | None:
        if not self._by_height:
            return None
        return ground_scale(image, self._config.camera, self._config.mapping.camera_height,
                            self._scale)

    def _link(self, odometry: OdometrySample | None) -> RelativePose | None:
        """Pose of the newest frame of the track in this one, as odometry tells."""
        if odometry is None or self._odometry is None:
            return None
        now, before = first_pose(self._config, odometry), self._odometry
        back = inverse(now)
        return RelativePose(back.rotation @ before.rotation,
                            back.rotation @ before.position + back.position)

    def _scan(self, image: RangeImage, frame: Frame) -> _Scan:
        limits = self._config.mapping
        height, width = image.range.shape
        colours = frame.colour if frame.colour is not None else cv2.merge([frame.image] * 3)
        if colours.shape[:2] != image.range.shape:
            colours = cv2.resize(colours, (width, height), interpolation=cv2.INTER_AREA)
        moving = np.zeros((height, width), np.uint8) if image.moving is None else cv2.resize(
            image.moving, (width, height), interpolation=cv2.INTER_NEAREST)
        step = max(1, round(height / _ROWS))
        room = height * width
        xyz, spread = np.empty((room // step, 3), np.float32), np.empty(room // step, np.float32)
        bgr = np.empty((room // step, 3), np.uint8)
        farthest = limits.max_range / (self._scale or 1.0)
        least = _LEAST_SIGMA / (self._scale or 1.0)
        count = _collect(image.range, image.sigma, moving, np.ascontiguousarray(colours),
                         _bearings(height), step, self._count,
                         np.array([farthest, limits.max_relative_sigma, least], np.float32),
                         xyz, spread, bgr)
        self._count += 1
        return _Scan(image.key, xyz[:count].copy(), np.float32(_ALIKE) * spread[:count],
                     bgr[:count].copy())

    def _fuse(self, scan: _Scan) -> None:
        placed = self.track[scan.key]
        turn = (placed.scale * placed.rotation).astype(np.float32)
        xyz = scan.xyz @ turn.T + placed.position.astype(np.float32)
        self.voxels.add(xyz, scan.sigma * np.float32(placed.scale), scan.bgr, self._fused)
        self._fused += 1


def confirmed(points: VoxelPoints, config: MappingConfig) -> VoxelPoints:
    """What enough frames saw, sharp enough, where nothing sharper is."""
    return points.chosen((points.frames >= config.min_frames)
                         & (points.sigma <= config.max_sigma)).finest()


def map_cloud(points: VoxelPoints, stamp: int, frame_id: str = 'odom') -> PointCloud:
    """The points as a cloud."""
    return PointCloud(FrameKey(stamp, frame_id), points.xyz, points.sigma, bgr=points.bgr)


def base_pose(frame: TrackedFrame, camera: Mount) -> tuple[Floats, Floats]:
    """Rotation (3, 3) and position (3,) of base_link in the map."""
    rotation = frame.rotation @ camera.rotation.T
    return rotation, frame.position - rotation @ camera.position
