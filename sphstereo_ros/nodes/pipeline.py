"""All stages in one process: windows are handed on, and cross the wire only if wanted."""
from __future__ import annotations

from collections.abc import Callable

from sphstereo_ros.nodes import motion_alignment, pose_stabilisation, spherical_stereo
from sphstereo_ros.nodes.frame_pairing import FramePairing
from sphstereo_ros.nodes.obstacle_detection import ObstacleDetectionComponent
from sphstereo_ros.ros.shell import Component, Shell, run


class Linked:
    """A stage that takes its windows from the one before it, not from the graph."""

    def __init__(self, component: Component,
                 subscribe: Callable[[], None] = lambda: None) -> None:
        self.warm_up = component.warm_up
        self.configure = component.configure
        self.subscribe = subscribe


def build(shell: Shell) -> list[Component]:
    """Make the stages, each linked to the next.

    The first link and the last drop what is late; the others wait, so that no work is thrown
    away.
    """
    obstacles = ObstacleDetectionComponent(shell)
    stereo = spherical_stereo.build(shell, obstacles.offer)
    aligner = motion_alignment.build(shell, stereo.hand_over)
    stabiliser = pose_stabilisation.build(shell, aligner.hand_over)
    pairing = FramePairing(shell, stabiliser.offer)
    return [pairing, Linked(stabiliser), Linked(aligner), Linked(stereo),
            Linked(obstacles, obstacles.subscribe_motion)]


def main(args: list[str] | None = None) -> int:
    """Run the node `pipeline`; returns its exit status."""
    return run('pipeline', build, args)
