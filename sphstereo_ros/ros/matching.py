"""Joins the two halves of a frame window that travel apart: pixels and geometry."""
from __future__ import annotations

from collections import OrderedDict
from dataclasses import replace
from threading import Lock
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from sphstereo_ros.core import rotations
from sphstereo_ros.core.config import Config
from sphstereo_ros.core.frames import AlignedWindow, Drop, Frame, FrameKey, FrameWindow
from sphstereo_ros.core.pairing import MAX_FRAMES
from sphstereo_ros.ros.conversions import WindowGeometry
from sphstereo_ros.ros.messages import nanoseconds

Window = TypeVar('Window', bound=FrameWindow)

MAX_PENDING = 4
# Frames that come while a window is on its way: a second of 30 Hz, longer than a slow chain takes.
SPARE_FRAMES = 30


def frames_needed(config: Config) -> int:
    """How many frames a stage keeps to have all that a window may name."""
    pairing = config.pairing
    by_distance = pairing.baselines != (0.0,)
    return (MAX_FRAMES if by_distance else max(pairing.intervals)) + SPARE_FRAMES


class WindowMatcher(Generic[Window]):
    """Keeps the newest frames, and windows whose frames are still under way.

    A window that never finds its frames is a Drop `frame_missing`: when a later one is complete,
    or when too many wait.
    """

    def __init__(self, kind: type[Window], size: int) -> None:
        self.size = size
        self._kind = kind
        self._frames: OrderedDict[FrameKey, Frame] = OrderedDict()
        self._pending: list[tuple[WindowGeometry, float]] = []

    def add_frame(self, frame: Frame) -> list[tuple[Window | Drop, float]]:
        """Take a frame; gives what it decided, each with the window's time of arrival."""
        self._frames[frame.key] = frame
        self._frames.move_to_end(frame.key)
        while len(self._frames) > self.size:
            self._frames.popitem(last=False)
        return self._settle()

    def add_window(self, window: WindowGeometry,
                   arrival: float) -> list[tuple[Window | Drop, float]]:
        """Take a window; gives what is decided now, each with its time of arrival."""
        self._pending.append((window, arrival))
        return self._settle()

    def _settle(self) -> list[tuple[Window | Drop, float]]:
        joined = [(w.with_frames(self._kind, self._frames), arrival)
                  for w, arrival in self._pending]
        complete = [i for i, (window, _) in enumerate(joined) if not isinstance(window, Drop)]
        decided = complete[-1] + 1 if complete else max(0, len(joined) - MAX_PENDING)
        del self._pending[:decided]
        return [(Drop('frame_missing', w.detail) if isinstance(w, Drop) else w, arrival)
                for w, arrival in joined[:decided]]


class Covariances:
    """Pose covariances that came with visual odometry, for windows of the same stamp.

    Nothing waits for them: a window without one keeps what it has.
    """

    def __init__(self, size: int = 2 * SPARE_FRAMES) -> None:
        self._size = size
        self._lock = Lock()
        self._by_stamp: OrderedDict[int, NDArray[np.float64]] = OrderedDict()

    def add(self, message: Any) -> None:
        """Take a nav_msgs/Odometry as `odometry_message` makes it; what is unknown is left out."""
        covariance = np.array(message.pose.covariance, np.float64).reshape(6, 6)
        if not np.isfinite(covariance).all() or not covariance.any():
            return
        with self._lock:
            self._by_stamp[nanoseconds(message.header.stamp)] = covariance
            while len(self._by_stamp) > self._size:
                self._by_stamp.popitem(last=False)

    def attached(self, window: AlignedWindow) -> AlignedWindow:
        """The window with the covariance of its nearest reference, where that is there."""
        nearest, *others = window.references
        with self._lock:
            told = self._by_stamp.get(window.current.key.stamp)
        if told is None or nearest.pose.covariance is not None:
            return window
        # The message tells of the inverse pose, position first: undo both.
        pose = nearest.pose
        back = np.block([[np.zeros((3, 3)), -pose.rotation],
                         [-pose.rotation, rotations.skew(pose.position) @ pose.rotation]])
        known = replace(pose, covariance=back @ told @ back.T)
        return AlignedWindow(window.current, (replace(nearest, pose=known), *others))
