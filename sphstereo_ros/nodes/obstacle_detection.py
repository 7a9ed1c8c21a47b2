"""Stage 5 as a node: depth and attitude in, obstacles for people, planners and autopilots out."""
from __future__ import annotations

import importlib.util
from collections.abc import Callable
from functools import partial
from typing import Any

from sphstereo_ros.core import rotations
from sphstereo_ros.core.config import Config, ParameterError
from sphstereo_ros.core.frames import Drop, FrameKey, RangeImage
from sphstereo_ros.core.level import Attitude, AttitudeHistory
from sphstereo_ros.core.obstacles import ObstacleDetection
from sphstereo_ros.core.sectors import ObstacleSectors, SectorState
from sphstereo_ros.mavlink.encoding import MissingLibraryError
from sphstereo_ros.mavlink.link import MavlinkLink
from sphstereo_ros.ros import obstacle_messages, qos
from sphstereo_ros.ros.conversions import imu_sample, odometry_sample
from sphstereo_ros.ros.live_messages import make
from sphstereo_ros.ros.messages import SECOND
from sphstereo_ros.ros.monitor import ERROR
from sphstereo_ros.ros.shell import Output, Shell, run
from sphstereo_ros.ros.stage import RangeInput
from sphstereo_ros.ros.transport import SMALL_PROFILE

# Of the least time between depth images that are used: stamps jitter.
EARLY = 0.9
# Comes with a workspace of PX4's.
PX4 = ('/fmu/in/obstacle_distance', 'px4_msgs/msg/ObstacleDistance')


def level_frame_broadcaster(node: Any) -> Any | None:
    """What sends transforms, where tf2_ros is there."""
    try:
        from tf2_ros import TransformBroadcaster
    except ImportError:
        return None
    return TransformBroadcaster(node)


class ObstacleOutputs:
    """Publishes what is wanted of obstacles, and sends them to the autopilot.

    Raises
    ------
    ParameterError
        where MAVLink is asked for and cannot be had

    """

    def __init__(self, shell: Shell) -> None:
        self._outputs: list[tuple[Output, obstacle_messages.Build]] = [
            (shell.output(kind, topic), build)
            for topic, (kind, build) in obstacle_messages.OUTPUTS.items()]
        if importlib.util.find_spec('px4_msgs') is not None:
            topic, kind = PX4
            self._outputs.append((shell.output(kind, topic), obstacle_messages.px4_message))
        self._broadcaster = level_frame_broadcaster(shell.node)
        self.link = self._linked(shell)

    @staticmethod
    def _linked(shell: Shell) -> MavlinkLink | None:
        config = shell.config
        if not config.mavlink.url:
            return None
        try:
            link = MavlinkLink(config.mavlink, config.obstacles.stall, shell.monitor('mavlink'))
        except (ValueError, MissingLibraryError) as error:
            raise ParameterError(f'obstacles.mavlink.url: {error}') from error
        shell.at_end(link.close)
        return link

    @property
    def wanted(self) -> bool:
        """Whether anybody takes anything."""
        return self.link is not None or any(output.wanted for output, _ in self._outputs)

    def deliver(self, sectors: ObstacleSectors, attitude: Attitude | None,
                arrival: float) -> dict[str, object]:
        """Publish and send; returns what is worth telling."""
        if self.link is not None:  # before all others: here every millisecond counts
            self.link.send(sectors, arrival)
        for output, build in self._outputs:
            output.send(partial(build, make, sectors))
        if self._broadcaster is not None and attitude is not None:
            self._broadcaster.sendTransform(obstacle_messages.level_transform_message(
                make, sectors.key.stamp,
                rotations.quaternion_from_matrix(attitude.rotation.T)))
        states = {state.name.lower(): int((sectors.state == state).sum()) for state in SectorState}
        return {**states, 'nearest_m': 'none' if sectors.nearest is None
                else f'{sectors.nearest:.2f}'}


class ObstacleDetectionComponent:
    """Finds obstacles in the newest depth, for whoever wants them; never twice in the same."""

    def __init__(self, shell: Shell) -> None:
        self._shell = shell
        self._monitor = shell.monitor('obstacle_detection', shell.config.obstacles.stall,
                                      ERROR)
        self._detection = ObstacleDetection(shell.config, shell.mask)
        self._outputs = ObstacleOutputs(shell)
        self._attitudes = AttitudeHistory()
        self._depth = RangeInput(shell, self._monitor, self.offer)
        self._worker = shell.worker('obstacle_detection', self._monitor)
        self._last: FrameKey | None = None
        self._taken: int | None = None

    def warm_up(self) -> None:
        """Compile what detection needs."""
        self._detection.warm_up()

    def subscribe(self) -> None:
        """Take depth and motion from the graph."""
        self._depth.subscribe()
        self.subscribe_motion()

    def subscribe_motion(self) -> None:
        """Take motion alone from the graph: depth is handed on in this process."""
        for kind, topic, read, add in (
                ('nav_msgs/msg/Odometry', 'odometry', odometry_sample,
                 self._attitudes.add_odometry),
                ('sensor_msgs/msg/Imu', 'imu', imu_sample, self._attitudes.add_imu)):
            self._shell.input(kind, topic, partial(self._take_sample, topic, read, add),
                              self._monitor, qos.SENSOR_INPUT)
        if self._outputs.link is not None:
            self._outputs.link.start()

    def configure(self, config: Config) -> None:
        """Take new parameters between two frames."""
        def exchange() -> None:
            self._detection = ObstacleDetection(config, self._shell.mask)
        self._monitor.stall = config.obstacles.stall
        self._worker.put(exchange)

    def offer(self, image: RangeImage, arrival: float) -> None:
        """Take a range image; it replaces one that still waits."""
        if not self._outputs.wanted:
            self._monitor.idle()
            return
        self._monitor.arrived()
        if self._is_early(image.key.stamp):
            self._monitor.dropped(Drop('rate_limit', 'the next one serves'))
            return
        self._taken = image.key.stamp
        self._worker.put_newest(partial(self._process, image, arrival))

    def _is_early(self, stamp: int) -> bool:
        rate, last = self._shell.config.obstacles.max_rate, self._taken
        return rate > 0 and last is not None and 0 < stamp - last < EARLY * SECOND / rate

    def _take_sample(self, topic: str, read: Callable[[Any], Any],
                     add: Callable[[Any], Drop | None], message: Any) -> None:
        sample = read(message)
        if isinstance(sample, Drop):
            self._monitor.dropped(Drop(f'{topic}_{sample.cause}', sample.detail))
            return

        def take() -> None:
            drop = add(sample)
            if drop is not None:
                self._monitor.dropped(drop)
        self._worker.put(take)

    def _process(self, image: RangeImage, arrival: float) -> None:
        before, self._last = self._last, image.key
        if before is not None and image.key.stamp <= before.stamp:
            cause = 'duplicate_stamp' if image.key.stamp == before.stamp else 'stamp_backward'
            self._monitor.dropped(Drop(cause, f'{image.key.stamp} after {before.stamp}'))
            return
        attitude = self._attitudes.at(image.key.stamp)
        found = attitude if isinstance(attitude, Drop) else self._detection.process(image,
                                                                                    attitude)
        if isinstance(found, Drop):
            self._monitor.dropped(found)
            return
        told = attitude if isinstance(attitude, Attitude) else None
        self._monitor.published(arrival, self._outputs.deliver(found, told, arrival))


def main(args: list[str] | None = None) -> int:
    """Run the node `obstacle_detection`; returns its exit status."""
    return run('obstacle_detection', lambda shell: [ObstacleDetectionComponent(shell)], args,
               SMALL_PROFILE)
