"""Stage 3 as a node: rotations and translations refined, and told as visual odometry."""
from __future__ import annotations

from collections.abc import Callable

import cv2

from sphstereo_ros.core.alignment import Aligner
from sphstereo_ros.core.frames import AlignedWindow, StabilisedWindow
from sphstereo_ros.ros.conversions import odometry_message
from sphstereo_ros.ros.live_messages import make
from sphstereo_ros.ros.shell import Shell, run
from sphstereo_ros.ros.stage import StageComponent, WindowOutput, pose_values
from sphstereo_ros.ros.transport import SMALL_PROFILE


def build(shell: Shell, then: Callable[[AlignedWindow, float], None] | None = None
          ) -> StageComponent[StabilisedWindow, AlignedWindow]:
    """Make the component; `then` takes (window, arrival) in place of a subscriber."""
    odometry = shell.output('nav_msgs/msg/Odometry', 'odometry/visual')
    pairs = WindowOutput(shell, 'pairs/aligned')

    def deliver(_: StabilisedWindow, window: AlignedWindow) -> dict[str, object]:
        odometry.send(lambda: odometry_message(make, window))
        pairs.send(window)
        return pose_values(window)
    return StageComponent(shell, 'motion_alignment', StabilisedWindow, 'pairs/stabilised', Aligner,
                          deliver, then)


def main(args: list[str] | None = None) -> int:
    """Run the node `motion_alignment`; returns its exit status."""
    cv2.setNumThreads(1)  # small images: more threads only wait for each other
    return run('motion_alignment', lambda shell: [build(shell)], args, SMALL_PROFILE)
