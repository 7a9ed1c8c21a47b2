"""The chain over a recorded input, without ROS: the same core, the same parameters."""
from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

from sphstereo_ros.core.binocular import BinocularPairer
from sphstereo_ros.core.chain import Chain, StageResults
from sphstereo_ros.core.config import Config
from sphstereo_ros.core.frames import Drop, Frame, PairedWindow, RangeImage
from sphstereo_ros.core.level import AttitudeHistory
from sphstereo_ros.core.obstacles import ObstacleDetection
from sphstereo_ros.core.preview import colour_map
from sphstereo_ros.core.synchronisation import Side
from sphstereo_ros.replay.bag_messages import make
from sphstereo_ros.replay.output import McapOutput
from sphstereo_ros.replay.records import BadInput, Record, Source
from sphstereo_ros.replay.sources import motion_topics
from sphstereo_ros.ros.conversions import (
    Status,
    cloud_message,
    decode_frame,
    depth_message,
    diagnostic_message,
    frame_message,
    image_message,
    imu_sample,
    odometry_message,
    odometry_sample,
    twist_sample,
    window_message,
)
from sphstereo_ros.ros.images import read_mask
from sphstereo_ros.ros.messages import SECOND
from sphstereo_ros.ros.obstacle_messages import OUTPUTS

TOPICS = ('/frames', '/pairs', '/pairs/stabilised', '/pairs/aligned', '/depth/image',
          '/depth/sigma', '/depth/relative', '/depth/moving', '/depth/preview', '/points',
          '/odometry/visual', '/diagnostics', *(f'/{topic}' for topic in OUTPUTS))
DEFAULT_TOPICS = frozenset(TOPICS) - {'/frames'}  # pixels are large

SAMPLES: dict[str, Callable[[Any], Any]] = {
    '/odometry': odometry_sample, '/twist': twist_sample, '/imu': imu_sample}


def wanted_topics(names: str) -> frozenset[str]:
    """Read 'a,b' as topics to be written; empty = the default ones.

    Raises
    ------
    BadInput
        for a name that is none of them

    """
    topics = frozenset('/' + name.strip().lstrip('/') for name in names.split(',') if name.strip())
    unknown = sorted(topics - set(TOPICS))
    if unknown:
        raise BadInput(f'--topics: {unknown[0]} is none of {", ".join(TOPICS)}')
    return topics or DEFAULT_TOPICS


@dataclass
class Summary:
    """What became of the input."""

    frames: int = 0
    windows: int = 0
    depth_images: int = 0
    relative: int = 0
    drops: Counter[str] = field(default_factory=Counter)
    problem: str = ''

    def lines(self) -> list[str]:
        """One line a figure."""
        depth = f'depth images: {self.depth_images}'
        if self.relative:
            depth += f' ({self.relative} without metric scale, on /depth/relative)'
        return [f'frames in: {self.frames}', f'windows: {self.windows}', depth,
                *(f'dropped, {cause}: {count}' for cause, count in self.drops.most_common())]


class OfflineRun:
    """Feeds records to the chain and writes what comes out.

    images : topics of the images, and of which of two cameras each is
    output : None to compute only; topics : what is written
    """

    def __init__(self, config: Config, images: Mapping[str, Side | None],
                 output: McapOutput | None,
                 topics: Collection[str] = DEFAULT_TOPICS) -> None:
        self.summary = Summary()
        self._config = config
        self._images = dict(images)
        self._output = output
        self._topics = topics
        mask = read_mask(config.camera.mask)
        self._chain = Chain(config, mask)
        self._obstacles = ObstacleDetection(config, mask)
        self._attitudes = AttitudeHistory()
        self._level_known = not config.obstacles.require_attitude
        pairer = self._chain.pairer
        self._add_sample: dict[str, Callable[[Any], Sequence[PairedWindow | Drop]]]
        self._add_sample = {'/odometry': pairer.add_odometry, '/twist': pairer.add_twist,
                            '/imu': pairer.add_imu}
        self._stamp = 0
        self._reported = 0

    def process(self, source: Source, advance: Callable[[], object] = lambda: None) -> Summary:
        """Run all of `source`; `advance` is called after each image.

        What was computed is written even when this is interrupted.
        """
        topics = [*self._images, *motion_topics(source)]
        try:
            for record in source.records(topics):
                self._take(record)
                if record.topic in self._images:
                    advance()
            self._pass_on(self._chain.pairer.flush())
        finally:
            self.summary.problem = source.problem
            self._write('/diagnostics', self._stamp, self._diagnostics)
        return self.summary

    def _take(self, record: Record) -> None:
        message = record.message()
        if record.topic in self._images:
            self.summary.frames += 1
            self._take_image(self._images[record.topic], message)
        elif isinstance(message, Drop):
            self._drop(message)
        else:
            self._take_sample(record.topic, message)

    def _take_sample(self, topic: str, message: Any) -> None:
        sample = SAMPLES[topic](message)
        if isinstance(sample, Drop):
            self._drop(Drop(f'{topic[1:]}_{sample.cause}', sample.detail))
            return
        # What they throw away is counted by the pairing.
        if topic == '/odometry':
            self._attitudes.add_odometry(sample)
        elif topic == '/imu':
            self._attitudes.add_imu(sample)
        self._level_known |= topic != '/twist'
        self._pass_on(self._add_sample[topic](sample))

    def _take_image(self, side: Side | None, message: Any) -> None:
        frame = message if isinstance(message, Drop) else decode_frame(
            message, self._config.stereo.working_height, self._config.points.colour)
        if isinstance(frame, Drop):
            self._drop(frame)
            return
        pairer = self._chain.pairer
        if side is not None and isinstance(pairer, BinocularPairer):
            frame = pairer.named(side, frame)
        self._write('/frames', frame.key.stamp, partial(self._frame, frame))
        if side is not None and isinstance(pairer, BinocularPairer):
            self._pass_on(pairer.add_view(side, frame))
        else:
            self._pass_on(pairer.add_frame(frame))
        self._stamp = frame.key.stamp
        if abs(self._stamp - self._reported) >= SECOND:
            self._reported = self._stamp
            self._write('/diagnostics', self._stamp, self._diagnostics)

    @staticmethod
    def _frame(frame: Frame) -> Any:
        return frame_message(make, frame)

    def _drop(self, drop: Drop) -> None:
        self.summary.drops[drop.cause] += 1

    def _pass_on(self, windows: Sequence[PairedWindow | Drop]) -> None:
        for window in windows:
            if isinstance(window, Drop):
                self._drop(window)
                continue
            self.summary.windows += 1
            self._write('/pairs', window.current.key.stamp,
                        partial(window_message, make, window))
            results = self._chain.process(window)
            if isinstance(results, Drop):
                self._drop(results)
            else:
                self._write_results(results)

    def _write_results(self, results: StageResults) -> None:
        measured, key = results.range_image, results.range_image.key
        self.summary.depth_images += 1
        self.summary.relative += not measured.is_metric
        outputs: dict[str, Callable[[], Any]] = {
            '/pairs/stabilised': lambda: window_message(make, results.stabilised),
            '/pairs/aligned': lambda: window_message(make, results.aligned),
            '/odometry/visual': lambda: odometry_message(make, results.aligned),
            '/depth/preview': lambda: image_message(make, key, colour_map(measured))}
        if measured.is_metric:  # depth without metric scale is never on /depth/image
            outputs['/depth/image'] = lambda: depth_message(make, key, measured.range)
            outputs['/depth/sigma'] = lambda: depth_message(make, key, measured.sigma)
        else:
            outputs['/depth/relative'] = lambda: depth_message(make, key, measured.range)
        moving = measured.moving
        if moving is not None:
            outputs['/depth/moving'] = lambda: image_message(make, key, moving)
        cloud = results.cloud
        if cloud is not None:
            outputs['/points'] = lambda: cloud_message(make, cloud)
        for topic, message in outputs.items():
            self._write(topic, key.stamp, message)
        if measured.is_metric:
            self._write_obstacles(measured)

    def _write_obstacles(self, measured: RangeImage) -> None:
        wanted = [topic for topic in OUTPUTS if f'/{topic}' in self._topics]
        if self._output is None or not wanted or not self._level_known:
            return
        attitude = self._attitudes.at(measured.key.stamp)
        found = attitude if isinstance(attitude, Drop) else self._obstacles.process(measured,
                                                                                    attitude)
        if isinstance(found, Drop):
            self._drop(found)
            return
        for topic in wanted:
            self._write(f'/{topic}', measured.key.stamp, partial(OUTPUTS[topic][1], make, found))

    def _diagnostics(self) -> Any:
        summary = self.summary
        values = {'frames_in': summary.frames, 'windows': summary.windows,
                  'frames_out': summary.depth_images, 'drops': sum(summary.drops.values()),
                  **{f'drops.{cause}': n for cause, n in sorted(summary.drops.items())}}
        level, text = (1, summary.problem) if summary.problem else (0, 'running offline')
        return diagnostic_message(make, self._stamp, [Status('pipeline', level, text, values)])

    def _write(self, topic: str, stamp: int, message: Callable[[], Any]) -> None:
        if self._output is not None and topic in self._topics:
            self._output.write(topic, stamp, message())
