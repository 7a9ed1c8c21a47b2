"""The command `sphstereo run`: the chain offline, results into an mcap file."""
from __future__ import annotations

import argparse
import sys
from pathlib import Path

from tqdm import tqdm

from sphstereo_ros.cli import INTERRUPTED
from sphstereo_ros.interrupts import interrupt_on_signals
from sphstereo_ros.replay.offline import TOPICS, OfflineRun, wanted_topics
from sphstereo_ros.replay.output import McapOutput
from sphstereo_ros.replay.parameter_files import load_config
from sphstereo_ros.replay.records import BadInput
from sphstereo_ros.replay.sources import image_topics, open_source


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument('input', type=Path, metavar='IN',
                        help='bag (mcap or db3, file or folder), video, or folder of frames')
    parser.add_argument('--params', type=Path, action='append', default=[], metavar='FILE',
                        help='ROS 2 parameter file, as the nodes take it')
    parser.add_argument('-p', action='append', default=[], dest='overrides',
                        metavar='NAME:=VALUE', help='parameter; always wins over --params')
    parser.add_argument('--out', type=Path, metavar='OUT.mcap',
                        help='file of results (default: IN_depth.mcap in this folder)')
    parser.add_argument('--topic', default='', help='image topic, if it is not the usual one')
    parser.add_argument('--topics', default='', metavar='A,B',
                        help=f'what to write, of {", ".join(TOPICS)} (default: all but /frames)')
    parser.add_argument('--fps', type=float, default=0.0,
                        help='frame rate of a folder of frames, or in place of a video\'s times')


def output_path(given: Path | None, source: Path, ending: str) -> Path:
    """Where to write: as given, or beside where we are, but never over the input.

    Raises
    ------
    BadInput
        where it is the input, or a folder

    """
    path = given or Path(f'{source.resolve().stem}{ending}')
    if path.is_dir():
        raise BadInput(f'{path} is a folder: give the name of a file')
    files = [source, *source.iterdir()] if source.is_dir() else [source]
    if any(path.exists() and file.exists() and path.samefile(file) for file in files):
        raise BadInput(f'{path} is the input: give another --out')
    return path


def main(arguments: argparse.Namespace) -> int:
    """Run the chain; returns the exit status."""
    config = load_config(arguments.params, arguments.overrides)
    topics = wanted_topics(arguments.topics)
    source = open_source(arguments.input, arguments.fps)
    images = image_topics(source, config.pairing.mode == 'binocular', arguments.topic)
    path = output_path(arguments.out, arguments.input, '_depth.mcap')
    interrupt_on_signals()
    interrupted = False
    with McapOutput(path) as output:
        run = OfflineRun(config, images, output, topics)
        # No bar where nobody watches.
        with tqdm(total=source.count(list(images)), unit='frame', disable=None) as progress:
            try:
                run.process(source, progress.update)
            except KeyboardInterrupt:
                interrupted = True
    print('\n'.join([*run.summary.lines(), f'written: {output.written} messages to {path}']))
    if run.summary.problem:
        print(f'warning: {arguments.input}: {run.summary.problem}', file=sys.stderr)
    return INTERRUPTED if interrupted else 0
