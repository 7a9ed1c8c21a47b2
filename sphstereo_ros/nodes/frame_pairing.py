"""Stage 1 as a node: images and motion in, working frames and windows out."""
from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

from sphstereo_ros.core.binocular import BinocularPairer
from sphstereo_ros.core.config import Config
from sphstereo_ros.core.frames import Drop, Frame, FrameKey, PairedWindow
from sphstereo_ros.core.pairing import Outcome, Pairer
from sphstereo_ros.core.synchronisation import SIDES, Side
from sphstereo_ros.ros import qos
from sphstereo_ros.ros.conversions import (
    decode_frame,
    frame_message,
    imu_sample,
    odometry_sample,
    twist_sample,
)
from sphstereo_ros.ros.live_messages import make
from sphstereo_ros.ros.shell import Shell, run
from sphstereo_ros.ros.stage import WindowOutput, pose_values

# Seconds of silence after which the other of `image` and `image/compressed` is taken.
SILENCE = 1.0
# A frame that comes a little late must not cost the next one its reference.
FRAMES_WAITING = 3
ARRIVALS_KEPT = 200


class TransportChoice:
    """Which of several topics with the same images is listened to: the first that delivers."""

    def __init__(self) -> None:
        self._active: str | None = None
        self._seen = 0.0

    def accepts(self, topic: str, now: float) -> bool:
        """Whether an image that came on `topic` at `now` (monotonic seconds) is taken."""
        if self._active not in (None, topic) and now - self._seen < SILENCE:
            return False
        self._active, self._seen = topic, now
        return True

    def failed(self, topic: str) -> None:
        """What came on `topic` was no image: another topic may do better."""
        if self._active == topic:
            self._active = None


class FramePairing:
    """Decodes frames, publishes them, and then the windows that name them.

    then : called with (window, arrival) in place of a subscriber: the next stage in this process
    """

    def __init__(self, shell: Shell,
                 then: Callable[[PairedWindow, float], None] | None = None) -> None:
        self._shell = shell
        self._then = then
        self._monitor = shell.monitor('frame_pairing')
        binocular = shell.config.pairing.mode == 'binocular'
        self._sides: tuple[Side | None, ...] = SIDES if binocular else (None,)
        self._choices = {side: TransportChoice() for side in self._sides}
        self._arrivals: dict[FrameKey, float] = {}
        self._frames = shell.output('sensor_msgs/msg/Image', 'frames')
        self._pairs = WindowOutput(shell, 'pairs')
        self._worker = shell.worker('frame_pairing', self._monitor,
                                    FRAMES_WAITING * len(self._sides))
        self._pairer = self._binocular() if binocular else Pairer(shell.config)

    def warm_up(self) -> None:
        """Compile what pairing needs."""
        self._pairer.warm_up()

    def subscribe(self) -> None:
        """Take images and motion from the graph."""
        inputs = [('sensor_msgs/msg/Image', 'image'),
                  ('sensor_msgs/msg/CompressedImage', 'image/compressed')]
        for side in self._sides:
            for kind, name in inputs:
                topic = f'{side}/{name}' if side else name
                self._shell.input(kind, topic, partial(self._take_image, side, topic),
                                  self._monitor, qos.IMAGE_INPUT)
        for kind, topic, read, add in (
                ('nav_msgs/msg/Odometry', 'odometry', odometry_sample, self._pairer.add_odometry),
                ('geometry_msgs/msg/TwistStamped', 'twist', twist_sample, self._pairer.add_twist),
                ('sensor_msgs/msg/Imu', 'imu', imu_sample, self._pairer.add_imu)):
            self._shell.input(kind, topic, partial(self._take_sample, topic, read, add),
                              self._monitor, qos.SENSOR_INPUT)

    def configure(self, config: Config) -> None:
        """Take new parameters between two frames."""
        self._worker.put(partial(self._pairer.configure, config))

    def _binocular(self) -> BinocularPairer:
        """Drift is measured in a thread of its own: frames do not wait for it."""
        beside = self._shell.worker('calibration', self._monitor)
        return BinocularPairer(self._shell.config, self._shell.mask, beside.put)

    def _take_image(self, side: Side | None, topic: str, message: Any) -> None:
        if not self._choices[side].accepts(topic, self._monitor.clock()):
            self._monitor.dropped(Drop('other_transport', f'{topic} repeats another topic'))
            return
        arrival = self._monitor.arrived()
        self._worker.put_newest(partial(self._pair, side, topic, message, arrival))

    def _pair(self, side: Side | None, topic: str, message: Any, arrival: float) -> None:
        config = self._shell.config
        frame = decode_frame(message, config.stereo.working_height, config.points.colour)
        if isinstance(frame, Drop):
            self._choices[side].failed(topic)
            self._monitor.dropped(frame)
            return
        self._publish(self._added(side, frame, arrival))

    def _added(self, side: Side | None, frame: Frame, arrival: float) -> list[Outcome]:
        pairer = self._pairer
        if side is not None and isinstance(pairer, BinocularPairer):
            frame = pairer.named(side, frame)
        self._frames.send(lambda: frame_message(make, frame))
        self._arrivals[frame.key] = arrival
        if side is not None and isinstance(pairer, BinocularPairer):
            return pairer.add_view(side, frame)
        return pairer.add_frame(frame)

    def _take_sample(self, topic: str, read: Callable[[Any], Any],
                     add: Callable[[Any], list[Outcome]], message: Any) -> None:
        sample = read(message)
        if isinstance(sample, Drop):
            self._monitor.dropped(Drop(f'{topic}_{sample.cause}', sample.detail))
        else:
            self._worker.put(lambda: self._publish(add(sample)))

    def _publish(self, outcomes: list[Outcome]) -> None:
        for outcome in outcomes:
            if isinstance(outcome, Drop):
                self._monitor.dropped(outcome)
                continue
            window = outcome
            arrival = self._arrivals.get(window.current.key, self._monitor.clock())
            self._pairs.send(window)
            self._monitor.published(arrival, pose_values(window))
            if self._then is not None:
                self._then(window, arrival)
        self._monitor.tell(self._pairer.values, self._pairer.warning)
        while len(self._arrivals) > ARRIVALS_KEPT:
            del self._arrivals[next(iter(self._arrivals))]


def main(args: list[str] | None = None) -> int:
    """Run the node `frame_pairing`; returns its exit status."""
    return run('frame_pairing', lambda shell: [FramePairing(shell)], args)
