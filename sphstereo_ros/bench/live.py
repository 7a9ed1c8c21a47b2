"""The live benchmark: the nodes as processes, frames through DDS at a given rate.

With `pairing.mode` binocular there are two cameras, and every frame of the bottom one is a pair.
"""
from __future__ import annotations

import argparse
import json
import math
import sys
import tempfile
import time
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from sphstereo_ros.core.frames import Drop
from sphstereo_ros.mavlink.encoding import MissingLibraryError
from sphstereo_ros.replay.parameter_files import load_config
from sphstereo_ros.replay.records import BadInput
from sphstereo_ros.replay.sources import IMAGE_TOPICS, STEREO_TOPICS, image_topics, open_source
from sphstereo_ros.ros.conversions import decode_frame

from .autopilot import Autopilot
from .processes import CHAINS, Process, Processes, numbers, private_domain, shipped
from .speed import to_and_fro

DEPTH, CLOUD, MAVLINK = '/depth/image', '/points', 'OBSTACLE_DISTANCE'
START_UP = 120.0  # seconds until the first depth
SETTLE = 3.0
RESTARTED = {'separate': 'pose_stabilisation', 'pipeline': 'pipeline'}
# Metres between the frames of the sample, and between the cameras of the sample of two.
_STEP, _APART = 0.28, 0.35
_SECOND = 1_000_000_000


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `sphstereo bench live`, --json apart."""
    parser.add_argument('--bag', type=Path, metavar='IN', help='frames to send, forth and back '
                        '(default: bags/street.mcap, of two cameras bags/binocular.mcap)')
    parser.add_argument('--height', type=int, default=480, help='rows of the frames sent')
    parser.add_argument('--rate', type=float, metavar='HZ',
                        help='(default: 30, of two cameras 15)')
    parser.add_argument('--apart', type=float, default=0.0, metavar='MS', help='two cameras: the '
                        'top one sends so much later, and stamps so')
    parser.add_argument('--jitter', type=float, default=0.0, metavar='MS',
                        help='two cameras: by how much that varies, either way')
    parser.add_argument('--seconds', type=float, default=30.0, help='to be measured')
    parser.add_argument('--encoding', choices=('mono8', 'bgr8', 'jpeg'), default='mono8')
    parser.add_argument('--chain', choices=tuple(CHAINS), default='separate',
                        help='a process for each stage, or one for all')
    parser.add_argument('--no-obstacles', action='store_true',
                        help='no obstacle detection, and no MAVLink')
    parser.add_argument('--params', type=Path, action='append', default=[], metavar='FILE',
                        help='(default: config/live.yaml)')
    parser.add_argument('-p', action='append', default=[], dest='overrides',
                        metavar='NAME:=VALUE', help='parameter of the nodes')
    parser.add_argument('--no-restart', action='store_true', help='kill no node at the end')


def main(args: argparse.Namespace) -> int:
    """Measure, print a table (and JSON); returns the exit status."""
    try:
        import rclpy  # noqa: F401
    except ImportError as error:
        raise BadInput(f'bench live needs ROS 2, and there is no {error.name}') from error
    files = args.params or [shipped('config/live.yaml')]
    config = load_config(files, args.overrides)  # refused here rather than by each node
    binocular = config.pairing.mode == 'binocular'
    if args.rate is None:
        args.rate = 15.0 if binocular else 30.0
    if args.bag is None:
        args.bag = shipped('bags/binocular.mcap' if binocular else 'bags/street.mcap')
    if args.height < 60 or not args.rate > 0 or not args.seconds >= 1:
        raise BadInput('--height: at least 60; --rate: above 0; --seconds: at least 1')
    if not 0 <= args.jitter <= abs(args.apart) + args.jitter < 1e3 / args.rate:
        raise BadInput('--apart, --jitter: together less than the time between frames')
    if (args.apart or args.jitter) and not binocular:
        raise BadInput('--apart, --jitter: there is one camera (pairing.mode)')
    result = _run(args, node_arguments(files, args.overrides, _APART if binocular else _STEP),
                  binocular)
    print(table(result))
    if args.json:
        print(json.dumps(result))
    return 0


def node_arguments(files: Sequence[Path], overrides: Sequence[str],
                   baseline: float = _STEP) -> list[str]:
    """ROS arguments of a node, with the sample's baseline unless another is given."""
    words = [word for file in files for word in ('--params-file', str(file))]
    given = [o.partition(':=')[0] for o in overrides]
    if not any(name.startswith('baseline.') for name in given):
        overrides = [f'baseline.length:={baseline}', *overrides]
    return [*words, *(word for o in overrides for word in ('-p', o))]


def frames(path: Path, height: int, colour: bool,
           binocular: bool = False) -> dict[str, NDArray[np.uint8]]:
    """All images of an input, forth and back: (N, H, 2H) grey or (N, H, 2H, 3) BGR, by camera:
    `camera`, or `bottom` and `top`.
    """
    source = open_source(path)
    sides = image_topics(source, binocular)
    read: dict[str, list[NDArray[np.uint8]]] = {side or 'camera': [] for side in sides.values()}
    for record in source.records(list(sides)):
        message = record.message()
        frame = message if isinstance(message, Drop) else decode_frame(message, 0, colour)
        if not isinstance(frame, Drop):
            image = frame.image if frame.colour is None else frame.colour
            read[sides[record.topic] or 'camera'].append(
                cv2.resize(image, (2 * height, height), interpolation=cv2.INTER_AREA))
    count = min(len(images) for images in read.values())
    if count < 2:
        raise BadInput(f'{path}: less than two frames')
    return {name: np.stack(to_and_fro(read[name][:count], 2 * count - 2))
            for name in sorted(read)}


@dataclass
class Usage:
    """Memory (MB) and CPU (seconds) of a process over time."""

    seconds: list[float]
    memory: list[float]
    cpu: list[float]

    def summary(self) -> dict[str, Any]:
        """Memory at start and end, its growth in the second half, share of one core."""
        half = len(self.seconds) // 2
        span = self.seconds[-1] - self.seconds[half]
        growth = float(np.polyfit(self.seconds[half:], self.memory[half:], 1)[0]) * 60 \
            if span > 0 else math.nan
        return {'memory_start_mb': round(self.memory[0], 1),
                'memory_end_mb': round(self.memory[-1], 1),
                'growth_mb_per_min': round(growth, 2) if math.isfinite(growth) else None,
                'cpu_percent': round(100 * (self.cpu[-1] - self.cpu[0])
                                     / max(self.seconds[-1] - self.seconds[0], 1e-3), 1)}


def _run(args: argparse.Namespace, parameters: list[str], binocular: bool) -> dict[str, Any]:
    from .observer import Observer
    with tempfile.TemporaryDirectory() as place, ExitStack() as open_ones:
        folder = Path(place)
        cameras = frames(args.bag, args.height, args.encoding != 'mono8', binocular)
        for name, images in cameras.items():
            np.save(folder / f'{name}.npy', images)
        private_domain()
        arrivals: dict[str, list[tuple[int, int]]] = {}
        if not args.no_obstacles:
            autopilot = open_ones.enter_context(_autopilot())
            arrivals[MAVLINK] = autopilot.arrivals
            # The camera of this benchmark knows no attitude.
            parameters = [*parameters, '-p', 'obstacles.require_attitude:=false',
                          '-p', f'obstacles.mavlink.url:={autopilot.url}']
        with Processes(folder) as processes, Observer() as observer:
            for topic, kind in ((DEPTH, 'sensor_msgs/msg/Image'),
                                (CLOUD, 'sensor_msgs/msg/PointCloud2')):
                arrivals[topic] = observer.watch(topic, kind).arrivals
            processes.start_chain(args.chain, parameters)
            if not args.no_obstacles and args.chain == 'separate':
                processes.start('obstacle_detection', '--ros-args', *parameters)
            processes.start('camera', sys.executable, '-m', 'sphstereo_ros.bench.camera',
                            *(str(folder / f'{name}.npy') for name in cameras),
                            '--rate', str(args.rate), '--apart', str(args.apart),
                            '--jitter', str(args.jitter), '--encoding', args.encoding,
                            '--sent', str(folder / 'sent.json'))
            bench = LiveBench(observer, processes)
            first = bench.start_up()
            window, usage, drops = bench.measure(args.seconds)
            restart = None if args.no_restart else bench.restart(
                args.chain, parameters, inputs(args.chain, binocular))
            processes.stop('camera')
            sent = json.loads((folder / 'sent.json').read_text())
            statuses = processes.stop(*processes.running)
    result = {'chain': args.chain, 'cameras': len(cameras), 'height': args.height,
              'encoding': args.encoding, 'apart_ms': args.apart, 'jitter_ms': args.jitter,
              'rate_wanted': args.rate, 'seconds': args.seconds, **flow(sent, arrivals, window),
              'stages': drops, 'processes': usage, 'first_depth_s': first, 'restart': restart,
              'exit_statuses': statuses}
    return {**result, 'cpu_ms_per_depth': cpu_per_depth(result)}


def cpu_per_depth(result: dict[str, Any]) -> float | None:
    """Milliseconds of CPU that all nodes together need for a range image."""
    if not result['depth_out']:
        return None
    used = sum(usage['cpu_percent'] for name, usage in result['processes'].items()
               if name != 'camera')
    return float(round(10 * used * result['seconds'] / result['depth_out'], 1))


def _autopilot() -> Autopilot:
    try:
        return Autopilot()
    except MissingLibraryError as error:
        raise BadInput(f'{error}, or leave it out by --no-obstacles') from error


class LiveBench:
    """Measures a chain that runs."""

    def __init__(self, observer: Any, processes: Processes) -> None:
        self._observer = observer
        self._processes = processes

    def start_up(self) -> float:
        """Wait for depth; returns how long it took from the start of the first process."""
        started = min(p.started for p in self._processes.running.values())
        depth = self._observer.topics[DEPTH].arrivals
        ready = self._observer.until(lambda: depth or self._processes.ended(), START_UP)
        ended = self._processes.ended()
        if ended is not None:
            raise RuntimeError(f'{ended.name} ended: {last_lines(ended)}')
        if not ready:
            raise RuntimeError(f'no depth in {START_UP:g} s; {dict(self._observer.totals())}')
        first = round(float(depth[0][1]) / 1e9 - started, 2)
        self._observer.spin(SETTLE)
        return first

    def measure(self, seconds: float) -> tuple[tuple[int, int], dict[str, Any], dict[str, Any]]:
        """Window of monotonic time (ns), use of the machine by process, counts by stage."""
        from .observer import since
        before = self._observer.totals()
        used = {name: Usage([], [], []) for name in self._processes.running}
        start = time.monotonic_ns()
        while True:
            passed = (time.monotonic_ns() - start) / 1e9
            for name, usage in used.items():
                memory, cpu = self._processes.running[name].usage()
                usage.seconds.append(passed)
                usage.memory.append(memory)
                usage.cpu.append(cpu)
            if passed >= seconds:
                break
            self._observer.spin(min(1.0, seconds - passed))
        window = start, time.monotonic_ns()
        return (window, {name: usage.summary() for name, usage in used.items()},
                since(before, self._observer.totals()))

    def restart(self, chain: str, parameters: list[str],
                topics: Sequence[str]) -> dict[str, Any]:
        """Kill a node, start it again, and wait for depth; `topics` are those it takes."""
        name = RESTARTED[chain]
        known = {topic: self._observer.subscriptions(topic, name) for topic in topics}
        self._processes.kill(name)
        self._observer.spin(1.0)
        process = self._processes.start(name, '--ros-args', *parameters)

        def matched() -> bool:
            return all(self._observer.subscriptions(topic, name) - known[topic]
                       for topic in topics)
        if not self._observer.until(matched, START_UP):
            raise RuntimeError(f'{name} did not come back: {last_lines(process)}')
        subscribed = time.monotonic_ns()
        depth = self._observer.topics[DEPTH].arrivals
        so_far = len(depth)
        if not self._observer.until(lambda: len(depth) > so_far, START_UP):
            raise RuntimeError(f'no depth after {name} was restarted')
        return {'node': name,
                'start_to_subscribed_s': round(subscribed / 1e9 - process.started, 2),
                'subscribed_to_depth_s': round((depth[so_far][1] - subscribed) / 1e9, 2)}


def inputs(chain: str, binocular: bool) -> tuple[str, ...]:
    """What the node that is restarted subscribes to."""
    if chain == 'separate':
        return '/pairs', '/frames'
    return tuple(STEREO_TOPICS if binocular else IMAGE_TOPICS)


def last_lines(process: Process) -> str:
    """What a process wrote last, for a message."""
    return ' / '.join(process.log.read_text(errors='replace').splitlines()[-3:])


def flow(sent: Sequence[int], arrivals: dict[str, list[tuple[int, int]]],
         window: tuple[int, int]) -> dict[str, Any]:
    """Rates and latencies of what was sent and arrived within a window of time (ns).

    sent : stamps of the frames, with two cameras of the bottom one's; `without_depth` are those of
    which no range image ever came, but for the last second's
    """
    begin, end = window
    seconds = (end - begin) / 1e9
    inside = [stamp for stamp in sent if begin <= stamp < end]
    came = {stamp for stamp, _ in arrivals[DEPTH]}
    out: dict[str, Any] = {
        'sent': len(inside), 'rate_in': round(len(inside) / seconds, 2),
        'without_depth': sum(stamp not in came for stamp in inside if stamp < end - _SECOND)}
    for topic, name in ((DEPTH, 'depth'), (CLOUD, 'cloud'), (MAVLINK, 'mavlink')):
        if topic not in arrivals:
            continue
        there = [(stamp, at) for stamp, at in arrivals[topic] if begin <= at < end]
        latency = numbers([(at - stamp) / 1e6 for stamp, at in there])
        out |= {f'{name}_out': len(there), f'rate_{name}': round(len(there) / seconds, 2),
                f'{name}_latency_ms': latency}
    return out


def table(result: dict[str, Any]) -> str:
    """The result for people."""
    pairs = result['cameras'] == 2
    stamps = f', stamps {result["apart_ms"]:g} ± {result["jitter_ms"]:g} ms apart' if pairs else ''
    lines = [f'{result["chain"]}: {"pairs of " if pairs else ""}'
             f'{2 * result["height"]}×{result["height"]} {result["encoding"]}{stamps}, '
             f'{result["rate_wanted"]:g} Hz wanted, {result["seconds"]:g} s',
             f'{"pairs sent" if pairs else "sent":12}  {result["sent"]:6}  '
             f'{result["rate_in"]:6.1f} Hz   {result["without_depth"]} of them without depth']
    for name in ('depth', 'cloud', 'mavlink'):
        if f'{name}_out' not in result:
            continue
        latency = result[f'{name}_latency_ms']
        lines.append(f'{name:12}  {result[f"{name}_out"]:6}  {result[f"rate_{name}"]:6.1f} Hz   '
                     f'stamp → arrival p50 {latency["p50"]} ms, p95 {latency["p95"]} ms')
    lines.append('drops of the stages')
    for part, counts in result['stages'].items():
        dropped = [f'{n} {cause}' for cause, n in counts.items()
                   if n and cause not in ('frames_in', 'frames_out')]
        lines.append(f'  {part:34}{counts.get("frames_in", 0):6} in'
                     f'{counts.get("frames_out", 0):7} out   {", ".join(dropped) or "none"}')
    lines.append('processes')
    for name, usage in result['processes'].items():
        start, end = usage['memory_start_mb'], usage['memory_end_mb']
        lines.append(f'  {name:34}{start:8.1f} →{end:7.1f} MB'
                     f' ({usage["growth_mb_per_min"]} MB/min)  {usage["cpu_percent"]:.0f} % CPU')
    lines.append(f'CPU of the nodes for a range image: {result["cpu_ms_per_depth"]} ms')
    lines.append(f'first depth {result["first_depth_s"]} s after the start')
    if result['restart']:
        back = result['restart']
        lines.append(f'{back["node"]} killed and restarted: subscribed after '
                     f'{back["start_to_subscribed_s"]} s, depth {back["subscribed_to_depth_s"]} s '
                     'later')
    if any(result['exit_statuses'].values()):
        lines.append(f'exit statuses: {result["exit_statuses"]}')
    return '\n'.join(lines)
