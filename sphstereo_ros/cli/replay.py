"""The command `sphstereo replay`: the node `bag_replay` with its parameters as options."""
from __future__ import annotations

import argparse
import json
from pathlib import Path

from sphstereo_ros.replay.records import BadInput


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument('input', type=Path, metavar='IN.mcap',
                        help='bag (mcap or db3, file or folder), video, or folder of frames')
    parser.add_argument('--rate', type=float, default=1.0, help='speed, times real time')
    parser.add_argument('--loop', action='store_true', help='begin again at the end')
    parser.add_argument('--start', type=float, default=0.0, help='seconds to leave out')
    parser.add_argument('--wait', type=float, default=0.0, metavar='SECONDS',
                        help='longest wait for subscriptions before the start')
    parser.add_argument('--subscriptions', type=int, default=1, metavar='N',
                        help='how many subscriptions to images to wait for (default: 1)')
    parser.add_argument('--topic', default='', help='image topic, if it is not the usual one')


def node_arguments(arguments: argparse.Namespace) -> list[str]:
    """Arguments of the node that do the same."""
    values: dict[str, object] = {
        'bag': str(arguments.input), 'topic': arguments.topic, 'rate': arguments.rate,
        'loop': arguments.loop, 'start_offset': arguments.start, 'wait': arguments.wait,
        'subscriptions': arguments.subscriptions}
    words = ['bag_replay', '--ros-args']
    for name, value in values.items():
        # A YAML parser reads the value; JSON is YAML.
        words += ['-p', f'replay.{name}:={json.dumps(value, ensure_ascii=False)}']
    return words


def main(arguments: argparse.Namespace) -> int:
    """Replay; returns the exit status."""
    try:
        from sphstereo_ros.nodes import bag_replay
    except ImportError as error:
        raise BadInput(f'replay needs ROS 2, and there is no {error.name}') from error
    return bag_replay.main(node_arguments(arguments))
