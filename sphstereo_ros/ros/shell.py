"""The shell every node shares: start, inputs, outputs, diagnostics, and a clean end."""
from __future__ import annotations

import signal
import sys
import traceback
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Protocol

import rclpy
from rclpy.clock import Clock, ClockType
from rclpy.exceptions import (
    InvalidParameterException,
    InvalidParameterTypeException,
    InvalidParameterValueException,
    NameValidationException,
)
from rclpy.executors import ExternalShutdownException
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.qos import QoSProfile
from rclpy.qos_overriding_options import InvalidQosOverridesError

from sphstereo_ros.core.config import Config, ParameterError
from sphstereo_ros.core.frames import Drop
from sphstereo_ros.ros import qos
from sphstereo_ros.ros.conversions import diagnostic_message
from sphstereo_ros.ros.images import read_mask
from sphstereo_ros.ros.live_messages import make, message_class
from sphstereo_ros.ros.monitor import STALL, WARN, Monitor
from sphstereo_ros.ros.parameters import NodeParameters, names_of
from sphstereo_ros.ros.transport import PROFILE, prepare_process
from sphstereo_ros.ros.worker import Worker

# What ROS raises where its own arguments or parameters are wrong.
BAD_ARGUMENTS = (InvalidParameterException, InvalidParameterTypeException,
                 InvalidParameterValueException, NameValidationException, InvalidQosOverridesError)
BAD_COMMAND_LINE = (rclpy_implementation.RCLError, rclpy_implementation.RCLInvalidROSArgsError,
                    rclpy_implementation.UnknownROSArgsError)

USAGE = ('usage: {name} [--ros-args [-p NAME:=VALUE] [--params-file FILE] [-r FROM:=TO] …]\n'
         'parameters: ros2 param describe, or: python -m sphstereo_ros.ros.parameters')


class Component(Protocol):
    """A stage as the shell runs it."""

    def warm_up(self) -> None:
        """Compile and allocate whatever the first frame would wait for."""

    def subscribe(self) -> None:
        """Take inputs from the graph from now on."""

    def configure(self, config: Config) -> None:
        """Take parameters that changed at run time."""


class Output:
    """A publisher that makes its message only while somebody subscribes."""

    def __init__(self, publisher: Any, log: Any, topic: str) -> None:
        self._publisher = publisher
        self._log = log
        self._topic = topic
        self._said = False

    @property
    def wanted(self) -> bool:
        """Whether somebody subscribes."""
        return bool(self._publisher.get_subscription_count())

    def send(self, message: Callable[[], Any]) -> bool:
        """Publish what `message()` gives, if it is wanted."""
        if not self.wanted:
            return False
        if not self._said:
            self._said = True
            self._log.info(f'{self._topic}: published while somebody subscribes')
        self._publisher.publish(message())
        return True


class Shell:
    """One ROS node: its parameters, topics, monitors and workers."""

    def __init__(self, name: str, words: Sequence[str] = ()) -> None:
        self.node = rclpy.create_node(name)
        self.log = self.node.get_logger()
        self.parameters = NodeParameters(self.node, names_of(name), words)
        self.mask = read_mask(self.config.camera.mask)
        self._monitors: list[Monitor] = []
        self._workers: list[Worker] = []
        self._last_actions: list[Callable[[], None]] = []
        self._diagnostics = self.node.create_publisher(
            message_class('diagnostic_msgs/msg/DiagnosticArray'), '/diagnostics', qos.RESULT)
        # A steady clock: simulated time may stand still.
        self.node.create_timer(1.0, self._report, clock=Clock(clock_type=ClockType.STEADY_TIME))

    @property
    def config(self) -> Config:
        """The parameters that hold now."""
        return self.parameters.config

    def monitor(self, part: str, stall: float = STALL, stall_level: int = WARN) -> Monitor:
        """Make the monitor of a part of this node; a part of its own name is the node itself."""
        name = self.node.get_name()
        monitor = Monitor(name if part == name else f'{name}: {part}', on_new_cause=lambda drop:
                          self.log.warning(f'{part}: dropped, {drop.cause}: {drop.detail} '
                                           '(said once; counted in /diagnostics)'),
                          stall=stall, stall_level=stall_level)
        self._monitors.append(monitor)
        return monitor

    def worker(self, name: str, monitor: Monitor, capacity: int = 1) -> Worker:
        """Make a thread whose failures and superseded jobs `monitor` counts."""
        worker = Worker(name, lambda: monitor.dropped(Drop('superseded', 'a newer one came')),
                        partial(self.failed, monitor), capacity)
        self._workers.append(worker)
        return worker

    def at_end(self, action: Callable[[], None]) -> None:
        """Call `action` when the node ends."""
        self._last_actions.append(action)

    def output(self, kind: str, topic: str, profile: QoSProfile = qos.RESULT) -> Output:
        """Publish messages of `kind` (package/msg/Type) on `topic`."""
        publisher = self.node.create_publisher(message_class(kind), topic, profile,
                                               qos_overriding_options=qos.overridable())
        return Output(publisher, self.log, topic)

    def input(self, kind: str, topic: str, take: Callable[[Any], None], monitor: Monitor,
              profile: QoSProfile = qos.RESULT) -> None:
        """Subscribe to `topic`; a failure of `take` is counted and does not end the node."""
        def guarded(message: Any) -> None:
            try:
                take(message)
            except Exception as error:
                self.failed(monitor, error)
        self.node.create_subscription(message_class(kind), topic, guarded, profile,
                                      qos_overriding_options=qos.overridable())

    def failed(self, monitor: Monitor, error: Exception) -> None:
        """Count an exception; the first of a stage is logged with its traceback."""
        if not rclpy.ok():  # nothing can be published any more: that is no failure
            return
        lines = traceback.format_exception(error)
        fresh = monitor.count('internal_error') == 0
        monitor.dropped(Drop('internal_error', f'{type(error).__name__}: {error}'))
        if fresh:
            self.log.error(f'{monitor.name}: {"".join(lines)}')

    def _report(self) -> None:
        stamp = self.node.get_clock().now().nanoseconds
        self._diagnostics.publish(diagnostic_message(
            make, stamp, [monitor.status() for monitor in self._monitors]))

    def spin(self) -> None:
        """Work until the context is shut down."""
        executor = _executor()
        executor.add_node(self.node)
        try:
            while rclpy.ok():
                executor.spin_once(timeout_sec=1.0)
        finally:
            executor.remove_node(self.node)

    def close(self) -> None:
        """End the threads and the node."""
        for worker in self._workers:
            worker.stop()
        for action in self._last_actions:
            action()
        self.node.destroy_node()


def _executor() -> Any:
    try:  # far cheaper at high rates
        from rclpy.experimental import EventsExecutor
    except ImportError:
        from rclpy.executors import SingleThreadedExecutor as EventsExecutor
    return EventsExecutor()


def run(name: str, build: Callable[[Shell], Sequence[Component]],
        args: Sequence[str] | None = None, profile: Path = PROFILE) -> int:
    """Start the node `name`, work until a signal ends it, and return its exit status.

    build : makes the node's components, in the order in which data passes them
    profile : of the transport; PROFILE where the node sends large messages
    """
    words = list(sys.argv if args is None else args)
    warning = prepare_process(profile)
    shell = None
    try:
        stray = _init(words)
        if stray:
            return _usage(name, stray)
        shell = Shell(name, words)
        if warning:
            shell.log.warning(warning)
        _work(shell, build)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    except (ParameterError, *BAD_ARGUMENTS) as error:
        return _refuse(name, str(error).splitlines()[0])
    except Exception:
        # A signal may end the context in the midst of anything, which then fails.
        if rclpy.ok():
            raise
    finally:
        # A launch system may send SIGINT twice.
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        if shell is not None:
            shell.close()
        rclpy.try_shutdown()
    return 0


def _init(words: Sequence[str]) -> list[str]:
    """Start ROS; returns the words that are not for it."""
    try:
        rclpy.init(args=words)
        return list(rclpy.utilities.remove_ros_args(words))[1:]
    except BAD_COMMAND_LINE as error:
        raise ParameterError(f'bad ROS arguments: {error}') from error


def _work(shell: Shell, build: Callable[[Shell], Sequence[Component]]) -> None:
    components = build(shell)
    for component in reversed(components):
        component.warm_up()
        if not rclpy.ok():
            return
    for component in reversed(components):
        component.subscribe()

    def changed(config: Config) -> None:
        for component in components:
            component.configure(config)
    shell.parameters.on_change = changed
    shell.log.info('ready')
    shell.spin()


def _refuse(name: str, reason: str) -> int:
    print(f'{name}: {reason}', file=sys.stderr)
    return 2


def _usage(name: str, words: Sequence[str]) -> int:
    if words[0] in ('-h', '--help'):
        print(USAGE.format(name=name))
        return 0
    return _refuse(name, f'{words[0]}: unknown argument\n{USAGE.format(name=name)}')
