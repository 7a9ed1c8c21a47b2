"""The command `sphstereo`: one module a subcommand, loaded when it is called.

Exit status: 0 done, 2 bad usage or input (one line on standard error), 1 internal failure.
"""
from __future__ import annotations

import argparse
import importlib
import sys
import traceback
from collections.abc import Sequence

from sphstereo_ros import __version__
from sphstereo_ros.allocation import keep_buffers
from sphstereo_ros.cli.nodes import missing
from sphstereo_ros.core.config import ParameterError

# Name → module with add_arguments(parser) and main(arguments) → exit status, and what it does.
COMMANDS = {
    'run': ('sphstereo_ros.cli.run', 'depth and clouds from a bag, a video or frames, offline'),
    'map': ('sphstereo_ros.cli.map', 'a drive or flight into one cloud and its track'),
    'replay': ('sphstereo_ros.cli.replay', 'publish the inputs in a bag live, with /clock'),
    'import': ('sphstereo_ros.cli.import_video', 'any 360° video into a bag'),
    'report': ('sphstereo_ros.cli.report', 'a page on a file of results: depth, cloud, errors, '
                                         'timings'),
    'view': ('sphstereo_ros.cli.view', 'a bag or the running topics in a viewer'),
    'mask': ('sphstereo_ros.cli.mask', "the vehicle's mask (camera.mask) from a recording"),
    'calibrate': ('sphstereo_ros.cli.calibrate',
                  'the alignment of two cameras, one above the other'),
    'scene': ('sphstereo_ros.scenes.command', 'render scenes with exact range and pose'),
    'bench': ('sphstereo_ros.bench.command', 'measure accuracy, speed, and the live nodes'),
}
INTERRUPTED = 130


def _parser() -> argparse.ArgumentParser:
    commands = '\n'.join(f'  {name:9} {purpose}' for name, (_, purpose) in COMMANDS.items())
    parser = argparse.ArgumentParser(
        prog='sphstereo', description='Depth in every direction from one 360° camera.',
        epilog=f'commands:\n{commands}\n\nsphstereo COMMAND --help tells more.',
        formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--version', action='version', version=__version__)
    parser.add_argument('command', choices=COMMANDS, metavar='COMMAND')
    parser.add_argument('arguments', nargs=argparse.REMAINDER, metavar='…')
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command; returns its exit status."""
    words = sys.argv[1:] if argv is None else list(argv)
    chosen = _parser().parse_args(words)
    keep_buffers()
    try:
        module = importlib.import_module(COMMANDS[chosen.command][0])
    except ModuleNotFoundError as error:
        if str(error.name).startswith('sphstereo_ros'):
            raise
        print(f'sphstereo {chosen.command}: {missing(error)}', file=sys.stderr)
        return 2
    parser = argparse.ArgumentParser(prog=f'sphstereo {chosen.command}',
                                     description=COMMANDS[chosen.command][1])
    module.add_arguments(parser)
    arguments = parser.parse_args(chosen.arguments)
    try:
        return int(module.main(arguments))
    except (ParameterError, _bad_input()) as error:
        print(f'sphstereo {chosen.command}: {error}', file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return INTERRUPTED
    except Exception:
        traceback.print_exc()
        return 1


def _bad_input() -> type[Exception]:
    from sphstereo_ros.replay.records import BadInput
    return BadInput
