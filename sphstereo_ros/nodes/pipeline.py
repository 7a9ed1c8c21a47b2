"""All four stages in one process: windows are handed on, and cross the wire only if wanted."""
from __future__ import annotations

from sphstereo_ros.nodes import motion_alignment, pose_stabilisation, spherical_stereo
from sphstereo_ros.nodes.frame_pairing import FramePairing
from sphstereo_ros.ros.shell import Component, Shell, run


class Linked:
    """A stage that takes its windows from the one before it, not from the graph."""

    def __init__(self, component: Component) -> None:
        self.warm_up = component.warm_up
        self.configure = component.configure

    def subscribe(self) -> None:
        """Nothing comes from the graph."""


def build(shell: Shell) -> list[Component]:
    """Make the four stages, each linked to the next.

    The first link drops what is late; the others wait, so that no work is thrown away.
    """
    stereo = spherical_stereo.build(shell)
    aligner = motion_alignment.build(shell, stereo.hand_over)
    stabiliser = pose_stabilisation.build(shell, aligner.hand_over)
    pairing = FramePairing(shell, stabiliser.offer)
    return [pairing, Linked(stabiliser), Linked(aligner), Linked(stereo)]


def main(args: list[str] | None = None) -> int:
    """Run the node `pipeline`; returns its exit status."""
    return run('pipeline', build, args)
