"""Joins the two halves of a frame window that travel apart: pixels and geometry."""
from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from dataclasses import replace
from threading import Lock
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from sphstereo_ros.core.config import Config
from sphstereo_ros.core.frames import (
    Drop,
    Frame,
    FrameKey,
    FrameWindow,
    RangeImage,
    Reference,
)
from sphstereo_ros.core.pairing import MAX_BYTES, farthest_reference, frame_bytes
from sphstereo_ros.ros.conversions import WindowGeometry, read_covariance

Window = TypeVar('Window', bound=FrameWindow)

MAX_PENDING = 4
# Frames that come while a window is on its way: a second of 30 Hz, longer than a slow chain takes.
SPARE_FRAMES = 30
# Covariances kept, one a reference.
MAX_COVARIANCES = 1000


def frames_needed(config: Config, frame_bytes: int = 1) -> int:
    """How many frames a stage keeps to have all that a window may name.

    frame_bytes : of one frame's images, as the stage has them
    """
    needed = farthest_reference(config.pairing, frame_bytes) + SPARE_FRAMES
    return 2 * needed if config.pairing.mode == 'binocular' else needed


class WindowMatcher(Generic[Window]):
    """Keeps the newest frames, and windows whose frames are still under way.

    A window that never finds its frames is a Drop `frame_missing`: when a later one is complete,
    or when too many wait. Where windows reach farther back than expected (another node's
    parameters were changed), more frames are kept from then on, up to MAX_BYTES.

    needed : how many frames of so many bytes are to be kept
    """

    def __init__(self, kind: type[Window], needed: Callable[[int], int]) -> None:
        self._kind = kind
        self._needed = needed
        self._grown = 0
        self._frames: OrderedDict[FrameKey, Frame] = OrderedDict()
        self._pending: list[tuple[WindowGeometry, float]] = []

    def configure(self, needed: Callable[[int], int]) -> None:
        """Keep another number of frames from the next one on."""
        self._needed = needed
        self._grown = 0

    def add_frame(self, frame: Frame) -> list[tuple[Window | Drop, float]]:
        """Take a frame; gives what it decided, each with the window's time of arrival."""
        self._frames[frame.key] = frame
        self._frames.move_to_end(frame.key)
        size = self._size(frame)
        while len(self._frames) > size:
            self._frames.popitem(last=False)
        return self._settle()

    def add_window(self, window: WindowGeometry,
                   arrival: float) -> list[tuple[Window | Drop, float]]:
        """Take a window; gives what is decided now, each with its time of arrival."""
        self._grow_for(window)
        self._pending.append((window, arrival))
        return self._settle()

    def _size(self, frame: Frame) -> int:
        memory = frame_bytes(frame)
        return max(self._needed(memory), min(self._grown, MAX_BYTES // max(memory, 1)))

    def _grow_for(self, window: WindowGeometry) -> None:
        """Keep twice as many where a frame that is named was thrown away already."""
        if not self._frames:
            return
        oldest = next(iter(self._frames.values()))
        full = len(self._frames) >= self._size(oldest)
        if full and min(window.keys).stamp < oldest.key.stamp:
            self._grown = 2 * len(self._frames)

    def _settle(self) -> list[tuple[Window | Drop, float]]:
        joined = [(w.with_frames(self._kind, self._frames), arrival)
                  for w, arrival in self._pending]
        complete = [i for i, (window, _) in enumerate(joined) if not isinstance(window, Drop)]
        decided = complete[-1] + 1 if complete else max(0, len(joined) - MAX_PENDING)
        del self._pending[:decided]
        return [(Drop('frame_missing', w.detail) if isinstance(w, Drop) else w, arrival)
                for w, arrival in joined[:decided]]


class Covariances:
    """Pose covariances, which travel beside the windows: one message a reference.

    They are told apart by the current frame and by the position, which is the same number by
    number. Nothing waits for them: a reference without one keeps what it has.
    """

    def __init__(self) -> None:
        self._lock = Lock()
        self._known: OrderedDict[tuple[FrameKey, bytes], NDArray[np.float64]] = OrderedDict()

    def add(self, message: Any) -> Drop | None:
        """Take what `covariance_message` makes; the Drop says why it is of no use."""
        read = read_covariance(message)
        if isinstance(read, Drop):
            return read
        current, pose = read
        assert pose.covariance is not None
        with self._lock:
            self._known[current, pose.position.tobytes()] = pose.covariance
            while len(self._known) > MAX_COVARIANCES:
                self._known.popitem(last=False)
        return None

    def attached(self, window: Window) -> Window:
        """The window with the covariances that are there."""
        with self._lock:
            references = tuple(self._with_covariance(window.current.key, reference)
                               for reference in window.references)
        return replace(window, references=references)

    def _with_covariance(self, current: FrameKey, reference: Reference) -> Reference:
        pose = reference.pose
        told = self._known.get((current, pose.position.tobytes()))
        if told is None or pose.covariance is not None:
            return reference
        return replace(reference, pose=replace(pose, covariance=told))


Pixels = NDArray[np.float32]


class RangeMatcher:
    """Joins depth/image and depth/sigma of the same frame.

    What is older than a frame that is complete, or too many newer ones, has lost its other half:
    a Drop `range_missing` or `sigma_missing`.
    """

    def __init__(self) -> None:
        self._ranges: OrderedDict[FrameKey, tuple[Pixels, float]] = OrderedDict()
        self._sigmas: OrderedDict[FrameKey, tuple[Pixels, float]] = OrderedDict()

    def add_range(self, key: FrameKey, pixels: Pixels,
                  arrival: float) -> list[tuple[RangeImage | Drop, float]]:
        """Take depth/image; gives what is decided now, each with its time of arrival."""
        self._ranges[key] = pixels, arrival
        return self._settle(key)

    def add_sigma(self, key: FrameKey, pixels: Pixels,
                  arrival: float) -> list[tuple[RangeImage | Drop, float]]:
        """Take depth/sigma; as `add_range`."""
        self._sigmas[key] = pixels, arrival
        return self._settle(key)

    def _settle(self, key: FrameKey) -> list[tuple[RangeImage | Drop, float]]:
        halves = (self._ranges, 'sigma_missing'), (self._sigmas, 'range_missing')
        complete = key in self._ranges and key in self._sigmas
        decided: list[tuple[RangeImage | Drop, float]] = []
        for waiting, cause in halves:
            lost = list(waiting)[:list(waiting).index(key)] if complete \
                else list(waiting)[:-MAX_PENDING]
            decided += [(Drop(cause, f'of frame {old.stamp}'), waiting.pop(old)[1])
                        for old in lost]
        if complete:
            pixels, arrival = self._ranges.pop(key)
            decided.append((RangeImage(key, pixels, self._sigmas.pop(key)[0], True), arrival))
        return decided
