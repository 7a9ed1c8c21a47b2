"""The command `sphstereo bench accuracy|speed|live`."""
from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from tqdm import tqdm

from sphstereo_ros.core.frames import Image8
from sphstereo_ros.replay.parameter_files import load_values
from sphstereo_ros.replay.records import BadInput
from sphstereo_ros.scenes.sequence import REPORTED_SEEDS, SCENES, load_sequence, render_sequence

from .methods import METHODS


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    kinds = parser.add_subparsers(dest='kind', required=True, metavar='accuracy|speed|live')
    accuracy = kinds.add_parser('accuracy', help='pose and range against exact truth')
    _input(accuracy)
    accuracy.add_argument('--interval', type=int, default=1, help='frames between the views')
    accuracy.add_argument('--methods', default=','.join(METHODS),
                          help='of %(default)s (default: all)')
    speed = kinds.add_parser('speed', help='the chain against one StereoBM call')
    _input(speed)
    speed.add_argument('--pairs', type=int, default=30, help='timed (default: %(default)s)')
    speed.add_argument('--params', type=Path, action='append', default=[], metavar='FILE')
    speed.add_argument('-p', action='append', default=[], dest='overrides', metavar='NAME:=VALUE')
    live = kinds.add_parser('live', help='the nodes over DDS')
    live.add_argument('--json', action='store_true', help='end with one line of JSON')
    from . import live as live_bench
    live_bench.add_arguments(live)


def _input(parser: argparse.ArgumentParser) -> None:
    parser.add_argument('--sequence', type=Path, metavar='FOLDER',
                        help='frames with truth, as `sphstereo scene` writes them '
                        '(default: a scene is rendered)')
    parser.add_argument('--scene', choices=SCENES, default='street', help='to be rendered')
    parser.add_argument('--seed', type=int, default=REPORTED_SEEDS[0])
    parser.add_argument('--frames', type=int, default=12)
    parser.add_argument('--height', type=int, default=960)
    parser.add_argument('--json', action='store_true', help='end with one line of JSON')


def main(args: argparse.Namespace) -> int:
    """Run one benchmark; returns the exit status."""
    if args.kind == 'live':
        from . import live
        return int(live.main(args))
    result = _accuracy(args) if args.kind == 'accuracy' else _speed(args)
    if args.json:
        print(json.dumps(result))
    return 0


def _sequence(args: argparse.Namespace) -> Sequence[Any]:
    if args.sequence is not None:
        try:
            return load_sequence(args.sequence)
        except (OSError, ValueError) as error:
            raise BadInput(f'{args.sequence}: {error}') from error
    try:
        return render_sequence(args.scene, args.seed, args.frames, args.height)
    except ImportError as error:
        raise BadInput(f"rendering needs the extra 'scenes': {error}") from error


def _accuracy(args: argparse.Namespace) -> dict[str, Any]:
    from .accuracy import Contest, pairs, table
    names = args.methods.split(',')
    unknown = sorted(set(names) - set(METHODS))
    if unknown:
        raise BadInput(f'--methods: {unknown[0]} is none of {", ".join(METHODS)}')
    contest = Contest({name: METHODS[name] for name in names})
    sequence = _sequence(args)
    total = max(len(sequence) - args.interval, 0)
    for reference, current in tqdm(pairs(sequence, args.interval), total=total, unit='pair'):
        contest.add(reference, current)
    summaries = contest.summaries()
    print(table(summaries))
    return summaries


def _speed(args: argparse.Namespace) -> dict[str, Any]:
    from .speed import measure, stage_times
    sequence = _sequence(args)
    images = [_grey(sequence[i].image)
              for i in tqdm(range(min(len(sequence), args.frames)), unit='frame')]
    parameters = {'stereo.matcher': 'bm', **load_values(args.params, args.overrides)}
    stages = stage_times(images, parameters)
    result = measure(images, parameters, args.pairs)
    for name, value in stages.items():
        print(f'{name:20}{value:8.1f} ms')
    print(f'{"whole chain":20}{result["chain_ms"]:8.1f} ms\n'
          f'{"StereoBM(96, 15)":20}{result["bm_ms"]:8.1f} ms\n'
          f'{"ratio":20}{result["ratio"]:8.2f}    ({result["pairs"]} pairs)')
    if result['dropped']:
        print(f'dropped: {result["dropped"]}', file=sys.stderr)
    return {**result, 'stages_ms': stages}


def _grey(image: Image8) -> Image8:
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), np.uint8)
