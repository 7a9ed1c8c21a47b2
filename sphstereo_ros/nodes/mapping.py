"""The map as a node: depth and aligned windows in, one registered cloud and the track out."""
from __future__ import annotations

from collections import OrderedDict
from functools import partial
from typing import Any

import numpy as np

from sphstereo_ros.core.baseline import Track as SensorTrack
from sphstereo_ros.core.baseline import interpolate_odometry
from sphstereo_ros.core.config import Config
from sphstereo_ros.core.frames import (
    AlignedWindow,
    Drop,
    Frame,
    FrameKey,
    RangeImage,
)
from sphstereo_ros.core.mapping import Mapper, base_pose, first_pose
from sphstereo_ros.core.motion import OdometrySample
from sphstereo_ros.core.rotations import mount
from sphstereo_ros.core.track import TrackedFrame
from sphstereo_ros.ros import qos
from sphstereo_ros.ros.conversions import (
    cloud_message,
    decode_frame,
    odometry_sample,
    read_window,
    track_message,
)
from sphstereo_ros.ros.live_messages import make
from sphstereo_ros.ros.matching import Covariances
from sphstereo_ros.ros.messages import SECOND, frame_key
from sphstereo_ros.ros.shell import Shell, run
from sphstereo_ros.ros.stage import COVARIANCE, RangeInput, covariance_topic

WINDOWS = 'pairs/aligned'
# Frames whose points wait for better poses, and what may wait for its other half.
LAG, QUEUE, KEPT = 12, 4, 60
# Windows that were lost in a row before the map begins anew.
LOST = 30
_NO_PIXELS = np.zeros((2, 4), np.uint8)


class MappingComponent:
    """Maps every frame of which depth and window come."""

    def __init__(self, shell: Shell) -> None:
        self._shell = shell
        self._monitor = shell.monitor('mapping')
        self._worker = shell.worker('mapping', self._monitor, QUEUE)
        self._map = shell.output('sensor_msgs/msg/PointCloud2', 'map', qos.LARGE_RESULT)
        self._track = shell.output('nav_msgs/msg/Odometry', 'map/odometry')
        self._depth = RangeInput(shell, self._monitor, self._take_range)
        self._covariances = Covariances()
        self._windows: OrderedDict[FrameKey, AlignedWindow] = OrderedDict()
        self._images: OrderedDict[FrameKey, tuple[RangeImage, float]] = OrderedDict()
        self._frames: OrderedDict[FrameKey, Any] = OrderedDict()
        self._configure(shell.config)

    def _configure(self, config: Config) -> None:
        self._config = config
        self._odometry: SensorTrack[OdometrySample] = SensorTrack(
            'odometry', round(config.pairing.max_gap * SECOND))
        self._begin()

    def _begin(self) -> None:
        """An empty map."""
        self._mapper: Mapper | None = None
        self._lost = self._newest = 0
        self._last_map = -float('inf')

    def warm_up(self) -> None:
        """Compile what mapping needs."""
        mapper = Mapper(self._config, lag=1)
        mapper.warm_up()

    def subscribe(self) -> None:
        """Take depth, windows, frames and odometry from the graph."""
        take = self._shell.input
        take('nav_msgs/msg/Odometry', 'odometry', self._take_odometry, self._monitor,
             qos.SENSOR_INPUT)
        take('sensor_msgs/msg/Image', 'frames', self._take_frame, self._monitor)
        take(COVARIANCE, covariance_topic(WINDOWS), self._take_covariance, self._monitor,
             qos.PARTS)
        take('nav_msgs/msg/Path', WINDOWS, self._take_window, self._monitor, qos.PARTS)
        self._depth.subscribe()

    def configure(self, config: Config) -> None:
        """Take new parameters: the map begins anew."""
        self._worker.put(partial(self._configure, config))

    def _take_odometry(self, message: Any) -> None:
        sample = odometry_sample(message)
        if isinstance(sample, Drop):
            self._monitor.dropped(Drop(f'odometry_{sample.cause}', sample.detail))
            return

        def add() -> None:
            drop = self._odometry.add(sample)
            if drop is not None:
                self._monitor.dropped(drop)
        self._worker.put(add)

    def _take_frame(self, message: Any) -> None:
        """Kept as it is: only those with depth are decoded."""
        _keep(self._frames, frame_key(message.header), message)

    def _take_covariance(self, message: Any) -> None:
        drop = self._covariances.add(message)
        if drop is not None:
            self._monitor.dropped(Drop(f'covariance_{drop.cause}', drop.detail))

    def _take_window(self, message: Any) -> None:
        geometry = read_window(message)
        if isinstance(geometry, Drop):
            self._monitor.dropped(geometry)
            return
        window = geometry.with_frames(AlignedWindow, {key: Frame(key, _NO_PIXELS)
                                                      for key in geometry.keys})
        assert isinstance(window, AlignedWindow)
        _keep(self._windows, geometry.current, window)
        self._settle()

    def _take_range(self, image: RangeImage, arrival: float) -> None:
        self._monitor.arrived()
        self._images[image.key] = image, arrival
        self._settle()

    def _settle(self) -> None:
        """Hand on what is complete, in order of time; what waits too long has no window."""
        for key in sorted(self._images):
            if key in self._windows:
                image, arrival = self._images.pop(key)
                window = self._covariances.attached(self._windows.pop(key))
                self._worker.put_newest(partial(self._process, window, image,
                                                self._frames.pop(key, None), arrival))
        while len(self._images) > QUEUE:
            key, _ = self._images.popitem(last=False)
            self._monitor.dropped(Drop('window_missing', f'of frame {key.stamp}'))

    def _process(self, window: AlignedWindow, image: RangeImage, message: Any,
                 arrival: float) -> None:
        frame = None if message is None else decode_frame(message, colour=True)
        sample = interpolate_odometry(self._odometry, image.key.stamp)
        if self._mapper is None:
            first = window.references[0].frame.key.stamp
            self._mapper = Mapper(self._config, LAG, first_pose(
                self._config, interpolate_odometry(self._odometry, first)))
        colours = Frame(image.key, np.full(image.range.shape, 128, np.uint8)) \
            if frame is None or isinstance(frame, Drop) else frame
        placed = self._mapper.add(window, image, colours, sample)
        if isinstance(placed, Drop):
            self._dropped(placed, image.key.stamp)
            return
        self._lost, self._newest = 0, image.key.stamp
        self._monitor.published(arrival, self._publish(self._mapper, placed, arrival))

    def _dropped(self, drop: Drop, stamp: int) -> None:
        """After long, or where time jumps back, the map begins anew."""
        self._monitor.dropped(drop)
        self._lost += drop.cause == 'track_lost'
        jumped = self._newest - stamp > self._config.pairing.max_gap * SECOND
        if self._lost >= LOST or jumped:
            self._monitor.dropped(Drop('map_restarted', drop.cause))
            self._begin()

    def _publish(self, mapper: Mapper, placed: TrackedFrame, arrival: float) -> dict[str, object]:
        base = base_pose(placed, mount(self._config.camera))
        self._track.send(partial(track_message, make, placed.key.stamp, *base))
        values: dict[str, object] = {'voxels': len(mapper.voxels),
                                     'voxel_m': f'{mapper.voxels.edge:g}'}
        if not self._map.wanted or arrival - self._last_map < 1 / self._config.mapping.rate \
                or not mapper.fused:
            return values
        self._last_map = arrival
        cloud = mapper.cloud(placed.key.stamp)
        self._map.send(lambda: cloud_message(make, cloud, 'odom'))
        return {**values, 'points': len(cloud.xyz)}


def _keep(kept: OrderedDict[FrameKey, Any], key: FrameKey, value: Any) -> None:
    kept[key] = value
    while len(kept) > KEPT:
        kept.popitem(last=False)


def main(args: list[str] | None = None) -> int:
    """Run the node `mapping`; returns its exit status."""
    return run('mapping', lambda shell: [MappingComponent(shell)], args)
