"""Stage 2 as a node: rotation and direction of motion of each reference."""
from __future__ import annotations

from collections.abc import Callable

import cv2

from sphstereo_ros.core.frames import PairedWindow, StabilisedWindow
from sphstereo_ros.core.stabilisation import Stabiliser
from sphstereo_ros.ros.shell import Shell, run
from sphstereo_ros.ros.stage import StageComponent, WindowOutput, pose_values
from sphstereo_ros.ros.transport import SMALL_PROFILE


def build(shell: Shell, then: Callable[[StabilisedWindow, float], None] | None = None
          ) -> StageComponent[PairedWindow, StabilisedWindow]:
    """Make the component; `then` takes (window, arrival) in place of a subscriber."""
    pairs = WindowOutput(shell, 'pairs/stabilised')

    def deliver(_: PairedWindow, window: StabilisedWindow) -> dict[str, object]:
        pairs.send(window)
        return pose_values(window)
    return StageComponent(shell, 'pose_stabilisation', PairedWindow, 'pairs', Stabiliser, deliver,
                          then)


def main(args: list[str] | None = None) -> int:
    """Run the node `pose_stabilisation`; returns its exit status."""
    cv2.setNumThreads(1)  # small images: more threads only wait for each other
    return run('pose_stabilisation', lambda shell: [build(shell)], args, SMALL_PROFILE)
