"""The nodes as commands: they say what is missing where there is no ROS 2."""
from __future__ import annotations

import importlib
import sys
from collections.abc import Callable


def _command(name: str) -> Callable[[], int]:
    def start() -> int:
        try:
            module = importlib.import_module(f'sphstereo_ros.nodes.{name}')
        except ModuleNotFoundError as error:
            if str(error.name).startswith('sphstereo_ros'):
                raise
            print(f"{name}: needs ROS 2, and there is no {error.name}: install the package with "
                  "its extra 'ros', or source a ROS 2 installation", file=sys.stderr)
            return 2
        return int(module.main())
    start.__doc__ = f'Run the node `{name}`; returns its exit status.'
    return start


frame_pairing = _command('frame_pairing')
pose_stabilisation = _command('pose_stabilisation')
motion_alignment = _command('motion_alignment')
spherical_stereo = _command('spherical_stereo')
pipeline = _command('pipeline')
bag_replay = _command('bag_replay')
