"""Videos and folders of frames as sources of `/image` or `/image/compressed`."""
from __future__ import annotations

import math
import os
import re
from collections import Counter
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from sphstereo_ros.core.frames import Drop, FrameKey, Image8
from sphstereo_ros.replay import bag_messages
from sphstereo_ros.replay.records import COMPRESSED, FIRST_STAMP, IMAGE, BadInput, Record
from sphstereo_ros.replay.spherical_metadata import read_layout
from sphstereo_ros.ros.conversions import compressed_message, image_message
from sphstereo_ros.ros.images import compressed_size, wrong_size

FRAME_SUFFIXES = ('.jpg', '.jpeg', '.png')
CAMERA = 'camera_optical'
DEFAULT_FPS = 30.0
HIGHEST_FPS = 1000.0
# What a file lacks is told in one line; FFmpeg's own log would stand beside it.
os.environ.setdefault('OPENCV_FFMPEG_LOGLEVEL', '-8')


@dataclass(frozen=True)
class VideoFrame:
    """One frame: stamp in nanoseconds, (H, W, 3) BGR."""

    stamp: int
    image: Image8


class Video:
    """The frames of a video file.

    fps : replaces the file's own times; start, end : seconds of the video to be read
    """

    def __init__(self, path: Path, fps: float = 0.0, start: float = 0.0,
                 end: float = math.inf) -> None:
        self._path, self._fps, self._start, self._end = path, fps, start, end
        self._layout = read_layout(path)
        capture = self._open()
        reported = float(capture.get(cv2.CAP_PROP_FPS))
        self._total = max(0, int(capture.get(cv2.CAP_PROP_FRAME_COUNT)))
        good, first = capture.read()
        capture.release()
        if not good or first is None:
            raise BadInput(f'{path} holds no picture that can be read')
        if self._layout.problem:
            raise BadInput(f'{path}: {self._layout.problem}, as its metadata tells')
        self.height, self.width = self._layout.one_eye(np.asarray(first, np.uint8)).shape[:2]
        drop = wrong_size(self.height, self.width)
        if drop is not None:
            raise BadInput(f'{path}: {self.width}×{self.height} is no full sphere, which is twice '
                           'as wide as high')
        self.rate = fps or (reported if 0 < reported <= HIGHEST_FPS else DEFAULT_FPS)
        self.problem = ''

    def _open(self) -> cv2.VideoCapture:
        capture = cv2.VideoCapture(str(self._path))
        if not capture.isOpened():
            raise BadInput(f'{self._path} is no bag, and no video that can be read')
        return capture

    def count(self) -> int:
        """How many frames there are, as far as the file says."""
        seconds = min(self._end, self._total / self.rate) - self._start
        return max(0, round(seconds * self.rate))

    def frames(self) -> Iterator[VideoFrame]:
        """Read the frames; their stamps rise strictly and start at FIRST_STAMP."""
        capture = self._open()
        index, last = 0, -1.0
        try:
            while capture.grab():
                time = index / self.rate
                if not self._fps:
                    told = float(capture.get(cv2.CAP_PROP_POS_MSEC)) / 1000
                    # Some containers tell no times: zero for all frames.
                    time = told if told > last else max(last, 0.0) + (index > 0) / self.rate
                index, last = index + 1, time
                if time >= self._end:
                    return
                if time < self._start:
                    continue
                good, image = capture.retrieve()
                if not good or image is None:
                    break
                yield VideoFrame(FIRST_STAMP + round(time * 1e9),
                                 self._layout.one_eye(np.asarray(image, np.uint8)))
        finally:
            capture.release()
        if index < 0.98 * self._total - 2:
            self.problem = f'broken off after {index} of {self._total} frames'


class VideoSource:
    """A video as a source of raw images."""

    def __init__(self, path: Path, fps: float = 0.0) -> None:
        self._video = Video(path, fps)
        self.topics: Mapping[str, str] = {'/image': IMAGE}

    @property
    def problem(self) -> str:
        """What broke the reading off."""
        return self._video.problem

    def count(self, topics: Collection[str]) -> int:
        """How many frames there are, as far as the file says."""
        return self._video.count() if '/image' in topics else 0

    def records(self, topics: Collection[str]) -> Iterator[Record]:
        """Read the frames."""
        if '/image' not in topics:
            return
        for frame in self._video.frames():
            message = image_message(bag_messages.make, FrameKey(frame.stamp, CAMERA), frame.image)
            yield Record('/image', IMAGE, frame.stamp, given=message)


def natural_order(path: Path) -> list[tuple[int, int, str]]:
    """Sort key by which frame_9 comes before frame_10."""
    return [(0, int(part), '') if part.isdigit() else (1, 0, part)
            for part in re.split(r'(\d+)', path.name)]


def _frame_files(path: Path) -> list[Path]:
    """Frames in order: the files of the commonest kind (a mask may lie beside them)."""
    files = [p for p in path.iterdir() if p.suffix.lower() in FRAME_SUFFIXES]
    kinds = Counter(p.suffix.lower() for p in files)
    commonest = max(sorted(kinds), key=kinds.__getitem__, default='')
    return sorted((p for p in files if p.suffix.lower() == commonest), key=natural_order)


class FolderSource:
    """A folder of JPEG or PNG frames, at a fixed rate, as a source of compressed images."""

    def __init__(self, path: Path, fps: float = 0.0) -> None:
        self._files = _frame_files(path)
        if not self._files:
            raise BadInput(f'{path} holds no bag and no frames ({", ".join(FRAME_SUFFIXES)})')
        self._fps = fps or DEFAULT_FPS
        self.topics: Mapping[str, str] = {'/image/compressed': COMPRESSED}
        self.problem = ''
        size = compressed_size(self._files[0].read_bytes())
        if not isinstance(size, Drop) and wrong_size(size.height, size.width):
            raise BadInput(f'{self._files[0]}: {size.width}×{size.height} is no full sphere, '
                           'which is twice as wide as high')

    def count(self, topics: Collection[str]) -> int:
        """How many frames there are."""
        return len(self._files) if '/image/compressed' in topics else 0

    def records(self, topics: Collection[str]) -> Iterator[Record]:
        """Read the frames."""
        if '/image/compressed' not in topics:
            return
        for index, file in enumerate(self._files):
            stamp = FIRST_STAMP + round(index / self._fps * 1e9)
            kind = 'png' if file.suffix.lower() == '.png' else 'jpeg'
            message = compressed_message(bag_messages.make, FrameKey(stamp, CAMERA), kind,
                                         file.read_bytes())
            yield Record('/image/compressed', COMPRESSED, stamp, given=message)
