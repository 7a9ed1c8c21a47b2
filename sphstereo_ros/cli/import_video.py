"""The command `sphstereo import`: a video into a bag."""
from __future__ import annotations

import argparse
import math
import sys
from pathlib import Path

from tqdm import tqdm

from sphstereo_ros.cli import INTERRUPTED
from sphstereo_ros.cli.run import output_path
from sphstereo_ros.interrupts import interrupt_on_signals
from sphstereo_ros.replay.output import McapOutput
from sphstereo_ros.replay.records import BadInput
from sphstereo_ros.replay.video_import import import_video
from sphstereo_ros.replay.videos import Video


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument('video', type=Path, metavar='VIDEO')
    parser.add_argument('output', type=Path, metavar='OUT.mcap')
    parser.add_argument('--quality', type=int, default=95, help='of the JPEG, 1 … 100')
    parser.add_argument('--height', type=int, default=0,
                        help='rows of the images (twice as many columns); 0 = as they are')
    parser.add_argument('--fps', type=float, default=0.0, help="in place of the video's own times")
    parser.add_argument('--start', type=float, default=0.0, help='seconds to leave out')
    parser.add_argument('--end', type=float, default=math.inf, help='second to end at')


def _checked(arguments: argparse.Namespace) -> None:
    for name, low, high in (('quality', 1, 100), ('height', 0, 8192), ('fps', 0, 1000),
                            ('start', 0, math.inf)):
        if not low <= getattr(arguments, name) <= high:
            raise BadInput(f'--{name}: {getattr(arguments, name)} is outside {low} … {high}')
    if not arguments.start < arguments.end:
        raise BadInput('--end: must be after --start')
    if not arguments.video.is_file():
        raise BadInput(f'{arguments.video} is no file')
    if arguments.video.stat().st_size == 0:
        raise BadInput(f'{arguments.video} is empty (0 bytes)')


def main(arguments: argparse.Namespace) -> int:
    """Import a video; returns the exit status."""
    _checked(arguments)
    video = Video(arguments.video, arguments.fps, arguments.start, arguments.end)
    path = output_path(arguments.output, arguments.video, '.mcap')
    interrupt_on_signals()
    interrupted = False
    with McapOutput(path) as output, tqdm(total=video.count(), unit='frame',
                                          disable=None) as progress:
        try:
            import_video(video, output, arguments.quality, arguments.height, progress.update)
        except KeyboardInterrupt:
            interrupted = True
    print(f'written: {output.written} frames of {video.width}×{video.height} to {path}')
    if video.problem:
        print(f'warning: {arguments.video}: {video.problem}', file=sys.stderr)
    return INTERRUPTED if interrupted else 0
