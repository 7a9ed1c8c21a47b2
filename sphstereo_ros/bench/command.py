"""The command `sphstereo bench accuracy|speed|live`."""
from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from tqdm import tqdm

from sphstereo_ros.replay.parameter_files import load_values
from sphstereo_ros.replay.records import BadInput
from sphstereo_ros.scenes.sequence import REPORTED_SEEDS, SCENES, load_sequence, render_sequence

from .methods import METHODS, parameters


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    kinds = parser.add_subparsers(dest='kind', required=True, metavar='accuracy|speed|live')
    accuracy = kinds.add_parser('accuracy', help='pose and range against exact truth')
    accuracy.add_argument('--sequence', type=Path, nargs='+', metavar='FOLDER',
                          help='frames with truth, as `sphstereo scene` writes them '
                          '(default: scenes are rendered)')
    accuracy.add_argument('--scene', choices=SCENES, default='street', help='to be rendered')
    accuracy.add_argument('--seeds', type=int, nargs='+', default=REPORTED_SEEDS, metavar='SEED',
                          help='of the scenes to be rendered (default: %(default)s)')
    accuracy.add_argument('--frames', type=int, default=3, help='of each (default: %(default)s)')
    accuracy.add_argument('--interval', type=int, default=1, help='frames between the views')
    accuracy.add_argument('--methods', default=','.join(METHODS),
                          help='of %(default)s (default: all)')
    speed = kinds.add_parser('speed', help='the chain against one StereoBM call')
    speed.add_argument('--input', type=Path, metavar='IN',
                       help='bag, video or folder of frames (default: the sample bag)')
    speed.add_argument('--pairs', type=int, default=30, help='timed (default: %(default)s)')
    speed.add_argument('--params', type=Path, action='append', default=[], metavar='FILE')
    speed.add_argument('-p', action='append', default=[], dest='overrides', metavar='NAME:=VALUE')
    live = kinds.add_parser('live', help='the nodes over DDS')
    for one in (accuracy, speed):
        one.add_argument('--height', type=int, default=960, help='(default: %(default)s)')
    for one in (accuracy, speed, live):
        one.add_argument('--json', action='store_true', help='end with one line of JSON')
    from . import live as live_bench
    live_bench.add_arguments(live)


def main(args: argparse.Namespace) -> int:
    """Run one benchmark; returns the exit status."""
    if args.kind == 'live':
        from . import live
        return int(live.main(args))
    result = _accuracy(args) if args.kind == 'accuracy' else _speed(args)
    if args.json:
        print(json.dumps(result))
    return 0


def _sequences(args: argparse.Namespace) -> Iterator[Sequence[Any]]:
    for folder in args.sequence or ():
        try:
            yield load_sequence(folder)
        except (OSError, ValueError) as error:
            raise BadInput(f'{folder}: {error}') from error
    try:
        for seed in () if args.sequence else args.seeds:
            yield render_sequence(args.scene, seed, args.frames, args.height)
    except ImportError as error:
        raise BadInput(f"rendering needs the extra 'scenes': {error}") from error


def _accuracy(args: argparse.Namespace) -> dict[str, Any]:
    from .accuracy import Contest, pairs, table
    names = args.methods.split(',')
    unknown = sorted(set(names) - set(METHODS))
    if unknown:
        raise BadInput(f'--methods: {unknown[0]} is none of {", ".join(METHODS)}')
    contest = Contest({name: parameters(name) for name in names})
    for sequence in _sequences(args):
        total = max(len(sequence) - args.interval, 0)
        for reference, current in tqdm(pairs(sequence, args.interval), total=total, unit='pair'):
            contest.add(reference, current)
    summaries = contest.summaries()
    print(table(summaries))
    return summaries


def _speed(args: argparse.Namespace) -> dict[str, Any]:
    from .live import frames
    from .processes import shipped
    from .speed import measure, stage_times
    images = frames(args.input or shipped('bags/street.mcap'), args.height, colour=False)
    given = {'stereo.matcher': 'bm', **load_values(args.params, args.overrides)}
    stages = stage_times(images, given)
    result = measure(images, given, args.pairs)
    for name, value in stages.items():
        print(f'{name:20}{value:8.1f} ms')
    print(f'{"whole chain":20}{result["chain_ms"]:8.1f} ms\n'
          f'{"StereoBM(96, 15)":20}{result["bm_ms"]:8.1f} ms\n'
          f'{"ratio":20}{result["ratio"]:8.2f}    ({result["pairs"]} pairs)')
    if result['dropped']:
        print(f'dropped: {result["dropped"]}', file=sys.stderr)
    return {**result, 'stages_ms': stages}

