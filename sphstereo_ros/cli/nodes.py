"""The nodes as commands: they say what is missing where there is no ROS 2."""
from __future__ import annotations

import importlib
import sys
from collections.abc import Callable


def missing(error: ModuleNotFoundError) -> str:
    """One line on a package that is not installed, and where it comes from."""
    if error.name in ('rosbags', 'mcap', 'tqdm'):
        return f'there is no {error.name}: pip install rosbags mcap tqdm'
    return (f"needs ROS 2, and there is no {error.name}: install the package with its extra "
            "'ros', or source a ROS 2 installation")


def _command(name: str) -> Callable[[], int]:
    def start() -> int:
        try:
            module = importlib.import_module(f'sphstereo_ros.nodes.{name}')
        except ModuleNotFoundError as error:
            if str(error.name).startswith('sphstereo_ros'):
                raise
            print(f'{name}: {missing(error)}', file=sys.stderr)
            return 2
        return int(module.main())
    start.__doc__ = f'Run the node `{name}`; returns its exit status.'
    return start


frame_pairing = _command('frame_pairing')
pose_stabilisation = _command('pose_stabilisation')
motion_alignment = _command('motion_alignment')
spherical_stereo = _command('spherical_stereo')
obstacle_detection = _command('obstacle_detection')
mapping = _command('mapping')
pipeline = _command('pipeline')
bag_replay = _command('bag_replay')
