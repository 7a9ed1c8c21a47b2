"""Stage 4 as a node: range on the current frame's grid, its sigma, and the cloud."""
from __future__ import annotations

from collections.abc import Callable

import numpy as np

from sphstereo_ros.core.cloud import point_cloud
from sphstereo_ros.core.frames import AlignedWindow, RangeImage
from sphstereo_ros.core.preview import colour_map
from sphstereo_ros.core.stereo import SphericalStereo
from sphstereo_ros.ros import qos
from sphstereo_ros.ros.conversions import cloud_message, depth_message, image_message
from sphstereo_ros.ros.live_messages import make
from sphstereo_ros.ros.shell import Shell, run
from sphstereo_ros.ros.stage import StageComponent


class RangeOutputs:
    """Publishes what is wanted of a range image."""

    def __init__(self, shell: Shell) -> None:
        self._shell = shell
        image, large = 'sensor_msgs/msg/Image', qos.LARGE_RESULT
        self._depth = shell.output(image, 'depth/image', large)
        self._relative = shell.output(image, 'depth/relative', large)
        self._sigma = shell.output(image, 'depth/sigma', large)
        self._moving = shell.output(image, 'depth/moving', large)
        self._preview = shell.output(image, 'depth/preview', large)
        self._points = shell.output('sensor_msgs/msg/PointCloud2', 'points', large)

    def deliver(self, window: AlignedWindow, measured: RangeImage) -> dict[str, object]:
        """Publish; without a metric baseline there is no depth in metres, and no cloud."""
        key = measured.key
        if measured.is_metric:
            self._depth.send(lambda: depth_message(make, key, measured.range))
            self._sigma.send(lambda: depth_message(make, key, measured.sigma))
            if measured.is_placed:
                self._points.send(lambda: cloud_message(
                    make, point_cloud(measured, window.current, self._shell.config)))
        else:
            self._relative.send(lambda: depth_message(make, key, measured.range))
        moving = measured.moving
        if moving is not None:
            self._moving.send(lambda: image_message(make, key, moving))
        self._preview.send(lambda: image_message(make, key, colour_map(measured)))
        known = np.count_nonzero(~np.isnan(measured.range[::4, ::4])) * 16 / measured.range.size
        return {'metric': measured.is_metric, 'coverage': f'{known:.3f}', **measured.quality}


def build(shell: Shell, then: Callable[[RangeImage, float], None] | None = None
          ) -> StageComponent[AlignedWindow, RangeImage]:
    """Make the component; `then` takes (range image, arrival) in place of a subscriber."""
    return StageComponent(shell, 'spherical_stereo', AlignedWindow, 'pairs/aligned',
                          SphericalStereo, RangeOutputs(shell).deliver, then,
                          colour=shell.config.points.colour)


def main(args: list[str] | None = None) -> int:
    """Run the node `spherical_stereo`; returns its exit status."""
    return run('spherical_stereo', lambda shell: [build(shell)], args)
