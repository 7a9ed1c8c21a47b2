"""Which camera of a rig a window is of."""
from __future__ import annotations

from .frames import FrameWindow, RelativePose


class Rig:
    """Learns the cameras' names from windows that have both.

    binocular : whether there are two cameras
    """

    def __init__(self, binocular: bool) -> None:
        self._binocular = binocular
        self._known: dict[str, RelativePose] = {}

    def camera(self, window: FrameWindow) -> RelativePose | None:
        """Pose of the current camera in the frame of the bottom one (the only one, if there is
        one); None where no window has told yet which of them it is.
        """
        if not self._binocular:
            return RelativePose()
        name, first = window.current.key.frame_id, window.references[0]
        if first.is_beside(window.current):
            self._known = {name: RelativePose(), first.frame.key.frame_id: first.pose}
        pose = self._known.get(name)
        return pose if pose is None or pose.is_metric or not pose.position.any() else None
