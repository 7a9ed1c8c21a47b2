"""The command `sphstereo mask`: the image that camera.mask takes, from a recording."""
from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from tqdm import tqdm

from sphstereo_ros.cli.run import output_path
from sphstereo_ros.core.config import PoseConfig
from sphstereo_ros.core.frames import Drop, Frame, Image8
from sphstereo_ros.core.vehicle_mask import VehicleMaskFinder
from sphstereo_ros.replay.records import BadInput, Source
from sphstereo_ros.replay.sources import image_topic, open_source
from sphstereo_ros.ros.conversions import decode_frame

# Frames of a long recording are taken in stretches of so many, spread evenly.
_STRETCH = 30
_RED = (40, 40, 220)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument('input', type=Path, metavar='IN',
                        help='bag (mcap or db3, file or folder), video, or folder of frames')
    parser.add_argument('--out', type=Path, metavar='MASK.png',
                        help='the mask, 255 = vehicle (default: IN_mask.png in this folder)')
    parser.add_argument('--preview', type=Path, metavar='FILE.png',
                        help='also write a frame with the mask laid over it in red')
    parser.add_argument('--frames', type=int, default=300,
                        help='looked at, at most (default: %(default)s)')
    parser.add_argument('--topic', default='', help='image topic, if it is not the usual one')
    parser.add_argument('--fps', type=float, default=0.0, help='frame rate of a folder of frames')


def taken(total: int, most: int, stretch: int = _STRETCH) -> Iterator[bool]:
    """Whether to look at frame 0, 1, … of about `total`: `most`, in stretches spread evenly."""
    period = max(1, round(total / max(1, most // stretch))) if total > most else 1
    left, index = most, 0
    while left:
        take = period == 1 or index % period < stretch
        left -= take
        index += 1
        yield take


def main(arguments: argparse.Namespace) -> int:
    """Find the mask; returns the exit status."""
    if arguments.frames < 1:
        raise BadInput('--frames: must be at least 1')
    path = output_path(arguments.out, arguments.input, '_mask.png')
    source = open_source(arguments.input, arguments.fps)
    topic = image_topic(source, arguments.topic)
    finder = VehicleMaskFinder(PoseConfig())
    last = None
    for picture in _pictures(source, topic, arguments.frames):
        finder.add(picture.frame, picture.continues)
        last = picture
    found = finder.result()
    if isinstance(found, Drop):
        raise BadInput(f'{arguments.input}: {found.detail}')
    assert last is not None
    _write(path, _resized(found.mask, _size(last)))
    if arguments.preview is not None:
        _write(arguments.preview, preview(last.frame, found.mask))
    print(f'vehicle: {100 * found.share:.1f} % of the sphere, from {finder.frames} frames\n'
          f'written: {path} (use it with -p camera.mask:={path})')
    return 0


@dataclass(frozen=True)
class _Picture:
    """A message, its frame (H, 2H), and whether it follows the picture before."""

    message: Any
    frame: Image8
    continues: bool


def _pictures(source: Source, topic: str, most: int) -> Iterator[_Picture]:
    total = source.count([topic])
    continues = False
    with tqdm(total=min(total, most), unit='frame', disable=None) as progress:
        for record, take in zip(source.records([topic]), taken(total, most), strict=False):
            message = record.message() if take else None
            frame = message if message is None or isinstance(message, Drop) else decode_frame(
                message)
            if isinstance(frame, Frame):
                yield _Picture(message, frame.image, continues)
                progress.update()
            continues = isinstance(frame, Frame)


def _size(picture: _Picture) -> tuple[int, int]:
    """Width and height as recorded."""
    message = picture.message
    if hasattr(message, 'encoding'):
        return int(message.width), int(message.height)
    raw = cv2.imdecode(np.frombuffer(message.data, np.uint8), cv2.IMREAD_GRAYSCALE)
    return int(raw.shape[1]), int(raw.shape[0])


def _resized(mask: Image8, size: tuple[int, int]) -> Image8:
    smooth = cv2.resize(mask, size, interpolation=cv2.INTER_LINEAR)
    return np.where(smooth > 127, np.uint8(255), np.uint8(0))


def preview(frame: Image8, mask: Image8) -> Image8:
    """The frame (H, 2H) as BGR, with the mask of any size over it in red."""
    picture = cv2.cvtColor(frame, cv2.COLOR_GRAY2BGR)
    covered = _resized(mask, frame.shape[::-1]) != 0
    picture[covered] = picture[covered] // 2 + np.array(_RED, np.uint8) // 2
    return np.asarray(picture, np.uint8)


def _write(path: Path, image: Image8) -> None:
    good, data = cv2.imencode('.png', image)
    if not good:
        raise BadInput(f'{path}: cannot be made')
    try:
        path.write_bytes(data.tobytes())
    except OSError as error:
        raise BadInput(f'{path}: {error.strerror}') from error
