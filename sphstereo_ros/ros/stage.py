"""A core stage as a component: windows in, results out, in a thread of its own."""
from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, Generic, Protocol, TypeVar

import numpy as np

from sphstereo_ros.core import rotations
from sphstereo_ros.core.config import Config
from sphstereo_ros.core.frames import Drop, FrameKey, FrameWindow, Image8, RangeImage
from sphstereo_ros.ros import qos
from sphstereo_ros.ros.conversions import (
    covariance_message,
    decode_frame,
    read_stamped_depth,
    read_window,
    window_message,
)
from sphstereo_ros.ros.live_messages import make
from sphstereo_ros.ros.matching import (
    Covariances,
    Pixels,
    RangeMatcher,
    WindowMatcher,
    frames_needed,
)
from sphstereo_ros.ros.monitor import Monitor
from sphstereo_ros.ros.shell import Shell

In = TypeVar('In', bound=FrameWindow)
Taken = TypeVar('Taken', bound=FrameWindow, contravariant=True)
Out = TypeVar('Out', covariant=True)
Made = TypeVar('Made')
AddHalf = Callable[[FrameKey, Pixels, float], list[tuple[RangeImage | Drop, float]]]

COVARIANCE = 'geometry_msgs/msg/PoseWithCovarianceStamped'


def covariance_topic(pairs: str) -> str:
    """Where the covariances of the windows on the topic `pairs` travel."""
    return f'{pairs}/covariance'


class WindowOutput:
    """Publishes windows on a topic, and the covariances of their poses beside it."""

    def __init__(self, shell: Shell, topic: str) -> None:
        self._covariances = shell.output(COVARIANCE, covariance_topic(topic), qos.PARTS)
        self._windows = shell.output('nav_msgs/msg/Path', topic)

    def send(self, window: FrameWindow) -> None:
        """Publish what somebody subscribes to; covariances first, for nothing waits for them."""
        for reference in window.references:
            if reference.pose.covariance is not None:
                self._covariances.send(partial(covariance_message, make, window.current.key,
                                               reference.pose))
        self._windows.send(partial(window_message, make, window))


class RangeInput:
    """Takes range images from the graph: depth/image and depth/sigma, joined.

    take : called with each, and its time of arrival
    """

    def __init__(self, shell: Shell, monitor: Monitor,
                 take: Callable[[RangeImage, float], None]) -> None:
        self._shell, self._monitor = shell, monitor
        self._take = take
        self._matcher = RangeMatcher()

    def subscribe(self) -> None:
        """Take both halves from the graph."""
        for topic, add in (('depth/image', self._matcher.add_range),
                           ('depth/sigma', self._matcher.add_sigma)):
            self._shell.input('sensor_msgs/msg/Image', topic, partial(self._take_half, add),
                              self._monitor, qos.LARGE_RESULT)

    def _take_half(self, add: AddHalf, message: Any) -> None:
        half = read_stamped_depth(message)
        if isinstance(half, Drop):
            self._monitor.dropped(half)
            return
        for image, arrival in add(*half, self._monitor.clock()):
            if isinstance(image, Drop):
                self._monitor.dropped(image)
            else:
                self._take(image, arrival)


class Stage(Protocol[Taken, Out]):
    """One step of the chain, as the core has it."""

    def warm_up(self) -> None:
        """Compile what `process` needs."""

    def process(self, window: Taken) -> Out | Drop:
        """Do the step."""


# What `deliver` returns is told in /diagnostics.
Deliver = Callable[[In, Made], dict[str, object]]


class StageComponent(Generic[In, Made]):
    """Runs a core stage on the newest window.

    name : of the stage; kind : window type it takes; topic : where such windows come from
    make_stage : (Config, mask) → stage
    deliver : called in the stage's thread with (window, result); returns values to tell
    then : called after it with (result, arrival): the next stage in this process
    colour : whether frames are decoded in colour
    """

    def __init__(self, shell: Shell, name: str, kind: type[In], topic: str,
                 make_stage: Callable[[Config, Image8 | None], Stage[In, Made]],
                 deliver: Deliver[In, Made], then: Callable[[Made, float], None] | None = None,
                 colour: bool = False) -> None:
        self.monitor = shell.monitor(name)
        self._shell = shell
        self._topic = topic
        self._colour = colour
        self._make_stage = make_stage
        self._deliver = deliver
        self._then = then
        self._stage = make_stage(shell.config, shell.mask)
        self._matcher = WindowMatcher(kind, partial(frames_needed, shell.config))
        self._covariances = Covariances()
        self._worker = shell.worker(name, self.monitor)

    def warm_up(self) -> None:
        """Compile what the stage needs."""
        self._stage.warm_up()

    def subscribe(self) -> None:
        """Take frames and windows from the graph."""
        self._shell.input('sensor_msgs/msg/Image', 'frames', self._take_frame, self.monitor)
        # Before the windows: of messages that wait, they are taken first.
        self._shell.input(COVARIANCE, covariance_topic(self._topic), self._take_covariance,
                          self.monitor, qos.PARTS)
        self._shell.input('nav_msgs/msg/Path', self._topic, self._take_window, self.monitor)

    def configure(self, config: Config) -> None:
        """Make the stage anew with `config`, once the running window is done."""
        self._matcher.configure(partial(frames_needed, config))

        def exchange() -> None:
            stage = self._make_stage(config, self._shell.mask)
            stage.warm_up()
            self._stage = stage
        self._worker.put(exchange)

    def hand_over(self, window: In, arrival: float) -> None:
        """Take a window from the stage before, in this process; waits until this one is free."""
        self.monitor.arrived()
        self._worker.put_when_free(partial(self._process, window, arrival))

    def offer(self, window: In, arrival: float) -> None:
        """Take a window; it replaces one that still waits."""
        self.monitor.arrived()
        self._worker.put_newest(partial(self._process, window, arrival))

    def _take_frame(self, message: Any) -> None:
        frame = decode_frame(message, colour=self._colour)
        if isinstance(frame, Drop):
            self.monitor.dropped(frame)
        else:
            self._settle(self._matcher.add_frame(frame))

    def _take_covariance(self, message: Any) -> None:
        drop = self._covariances.add(message)
        if drop is not None:
            self.monitor.dropped(Drop(f'covariance_{drop.cause}', drop.detail))

    def _take_window(self, message: Any) -> None:
        arrival = self.monitor.arrived()
        window = read_window(message)
        if isinstance(window, Drop):
            self.monitor.dropped(window)
        else:
            self._settle(self._matcher.add_window(window, arrival))

    def _settle(self, decided: list[tuple[In | Drop, float]]) -> None:
        for window, arrival in decided:
            if isinstance(window, Drop):
                self.monitor.dropped(window)
            else:
                self._worker.put_newest(partial(self._process, window, arrival))

    def _process(self, window: In, arrival: float) -> None:
        result = self._stage.process(self._covariances.attached(window))
        if isinstance(result, Drop):
            self.monitor.dropped(result)
            return
        values = self._deliver(window, result)
        self.monitor.published(arrival, values)
        if self._then is not None:
            self._then(result, arrival)


def pose_values(window: FrameWindow) -> dict[str, object]:
    """What /diagnostics tells of a window's poses."""
    nearest = window.references[0].pose
    values: dict[str, object] = {
        'references': len(window.references),
        'baseline_m': ' '.join(f'{r.pose.baseline:.3f}' if r.pose.is_metric else 'unknown'
                               for r in window.references),
        'rotation_deg': f'{np.degrees(rotations.angle(nearest.rotation)):.3f}'}
    if nearest.covariance is not None:
        sigma = np.degrees(np.sqrt(np.trace(nearest.covariance[:3, :3])))
        values['rotation_sigma_deg'] = f'{sigma:.4f}'
    return values
