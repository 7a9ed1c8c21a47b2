"""Messages → what Rerun shows of them."""
from __future__ import annotations

from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from sphstereo_ros.core import rotations
from sphstereo_ros.core.frames import Drop, FrameKey, RangeImage
from sphstereo_ros.core.preview import colour_map
from sphstereo_ros.report.clouds import read_points, thinned
from sphstereo_ros.ros.conversions import decode_frame, nanoseconds, odometry_sample, read_depth
from sphstereo_ros.view.topics import PICTURES

# Points of a cloud, rows of a picture, poses of the track: more is thinned, so that a computer
# across the network can follow.
CLOUD_POINTS, MAP_POINTS, PICTURE_HEIGHT, TRACK_POSES = 100_000, 500_000, 480, 2000
TIMELINE = 'stamp'
_JPEG_QUALITY = 80
_POINT_SIZE = 1.5
_RED, _GREEN, _WHITE, _DARK = (220, 40, 40), (60, 170, 80), (240, 240, 240), (16, 21, 26)


def blueprint() -> rrb.Blueprint:
    """What is shown where."""
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Spatial3DView(origin='/world', name='cloud', background=_DARK),
            rrb.Vertical(
                rrb.Spatial2DView(origin='/camera', name='image'),
                rrb.Spatial2DView(origin='/depth/preview', name='depth'),
                rrb.Tabs(rrb.TimeSeriesView(origin='/plots', name='plots'),
                         rrb.TextLogView(origin='/diagnostics', name='diagnostics')),
                row_shares=[2, 2, 1]),
            column_shares=[3, 2]),
        collapse_panels=True)


class Scene:
    """Shows messages in a recording stream.

    unreadable : messages by topic that could not be shown
    """

    def __init__(self, stream: rr.RecordingStream) -> None:
        self._stream = stream
        self._track: list[NDArray[np.float64]] = []
        self.shown: dict[str, int] = {}
        self.unreadable: dict[str, int] = {}
        self._show: dict[str, Callable[[Any], bool]] = {
            **dict.fromkeys(PICTURES, self._picture),
            '/depth/preview': self._preview, '/depth/moving': self._moving,
            '/depth/image': self._depth, '/depth/relative': self._relative,
            '/points': self._points, '/map': self._map, '/odometry': self._odometry,
            '/odometry/visual': self._step, '/obstacles/scan': self._scan,
            '/obstacles/nearest': self._nearest, '/diagnostics': self._diagnostics}
        stream.log('world', rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        self._log('world/base_link/axes', rr.Arrows3D(vectors=np.eye(3), colors=np.eye(
            3, dtype=np.uint8) * 220), static=True)

    def _log(self, path: str | list[str], what: Any, **options: Any) -> None:
        self._stream.log(path, what, **options)

    def show(self, name: str, message: Any) -> None:
        """Show a message (or count a Drop) of the topic `name`, at its stamp."""
        good = False
        if not isinstance(message, Drop):
            stamp = nanoseconds(message.header.stamp)
            self._stream.set_time(TIMELINE, timestamp=np.datetime64(stamp, 'ns'))
            good = self._show[name](message)
        counts = self.shown if good else self.unreadable
        counts[name] = counts.get(name, 0) + 1

    def _log_picture(self, path: str, bgr: NDArray[np.uint8] | None) -> bool:
        if bgr is None:
            return False
        done = cv2.imencode('.jpg', bgr, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])[1]
        self._log(path, rr.EncodedImage(contents=done.tobytes(), media_type='image/jpeg'))
        return True

    def _picture(self, message: Any) -> bool:
        frame = decode_frame(message, PICTURE_HEIGHT, True)
        return not isinstance(frame, Drop) and self._log_picture('camera', frame.colour)

    def _preview(self, message: Any) -> bool:
        frame = decode_frame(message, 0, True)
        return not isinstance(frame, Drop) and self._log_picture('depth/preview', frame.colour)

    def _moving(self, message: Any) -> bool:
        frame = decode_frame(message, 0, True)
        return not isinstance(frame, Drop) and self._log_picture('depth/moving', frame.colour)

    def _depth(self, message: Any, is_metric: bool = True) -> bool:
        depth = read_depth(message)
        if isinstance(depth, Drop):
            return False
        step = max(1, len(depth) // PICTURE_HEIGHT)
        small = np.ascontiguousarray(depth[::step, ::step])
        return self._log_picture('depth/preview', colour_map(
            RangeImage(FrameKey(0, ''), small, small, is_metric)))

    def _relative(self, message: Any) -> bool:
        return self._depth(message, is_metric=False)

    def _points(self, message: Any) -> bool:
        return self._cloud('world/base_link/points', message, CLOUD_POINTS)

    def _map(self, message: Any) -> bool:
        return self._cloud('world/map', message, MAP_POINTS)

    def _cloud(self, path: str, message: Any, most: int) -> bool:
        cloud = read_points(message)
        if isinstance(cloud, Drop):
            return False
        few = thinned(cloud, most)
        colours: Any = _WHITE
        if few.bgr is not None:
            colours = few.bgr[:, ::-1]
        elif few.intensity is not None:
            colours = np.repeat(few.intensity[:, None], 3, axis=1)
        self._log(path, rr.Points3D(few.xyz, colors=colours,
                                    radii=rr.Radius.ui_points(_POINT_SIZE)))
        return True

    def _odometry(self, message: Any) -> bool:
        sample = odometry_sample(message)
        if isinstance(sample, Drop):
            return False
        yaw = rotations.rpy_from_matrix(sample.rotation)[2]
        level = rotations.matrix_from_rpy(0.0, 0.0, float(yaw))
        for path, rotation in (('world/base_link', sample.rotation), ('world/level', level)):
            self._log(path, rr.Transform3D(translation=sample.position, mat3x3=rotation))
        self._track.append(sample.position)
        if len(self._track) > TRACK_POSES:
            self._track = self._track[::2]
        self._log('world/track', rr.LineStrips3D([np.array(self._track)], colors=_WHITE))
        return True

    def _step(self, message: Any) -> bool:
        sample = odometry_sample(message)
        if isinstance(sample, Drop):  # no metres: NaN, as documented
            return False
        self._plot('step, m', float(np.linalg.norm(sample.position)))
        return True

    def _scan(self, message: Any) -> bool:
        ranges = np.asarray(message.ranges, np.float64)
        angles = message.angle_min + message.angle_increment * np.arange(len(ranges))
        measured = np.isfinite(ranges) | np.isneginf(ranges)
        reach = np.where(np.isneginf(ranges), message.range_min, ranges)
        reach[np.isposinf(ranges)] = message.range_max
        wanted = measured | np.isposinf(ranges)  # unknown is a gap
        half = abs(message.angle_increment) / 2
        arcs = [[(r * np.cos(a + turn), r * np.sin(a + turn), 0.0) for turn in (-half, half)]
                for r, a in zip(reach[wanted], angles[wanted], strict=True)]
        colours = np.where(measured[wanted, None], _RED, _GREEN).astype(np.uint8)
        self._log('world/level/obstacles', rr.LineStrips3D(
            np.array(arcs).reshape(-1, 2, 3), colors=colours, radii=rr.Radius.ui_points(3.0)))
        return True

    def _nearest(self, message: Any) -> bool:
        if np.isfinite(message.range):  # no point in the plot where it is free or unknown
            self._plot('nearest obstacle, m', float(message.range))
        return True

    def _plot(self, name: str, value: float) -> None:
        self._log(['plots', name], rr.Scalars(value))

    def _diagnostics(self, message: Any) -> bool:
        for status in message.status:
            values = {str(v.key): str(v.value) for v in status.values}
            for key, unit in (('rate_out', 'Hz'), ('latency_p50_ms', 'ms')):
                try:
                    self._plot(f'{status.name}, {unit}', float(values[key]))
                except (KeyError, ValueError):
                    continue
            level = _level(status.level)
            drops = ', '.join(f'{value} {key[6:]}' for key, value in values.items()
                              if key.startswith('drops.') and value != '0')
            if level != 'INFO' or drops:
                text = f'{status.name}: {status.message}' + (f' (dropped: {drops})' if drops
                                                             else '')
                self._log('diagnostics', rr.TextLog(text, level=level))
        return True


def _level(level: Any) -> str:
    number = level[0] if isinstance(level, bytes) else int(level)
    return {0: 'INFO', 1: 'WARN'}.get(number, 'ERROR')
