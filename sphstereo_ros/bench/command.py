"""The command `sphstereo bench accuracy|obstacles|map|speed|live`."""
from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

from tqdm import tqdm

from sphstereo_ros.replay.parameter_files import load_values
from sphstereo_ros.replay.records import BadInput
from sphstereo_ros.scenes.sequence import NUISANCES, REPORTED_SEEDS, SCENES, TruthFrame

from .methods import COMPARED, METHODS, OBSTACLE_METHODS, PAIR_METHODS, method
from .sequences import GROUND_TRUTH, Scenes, saved


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    kinds = parser.add_subparsers(dest='kind', required=True,
                                  metavar='accuracy|obstacles|map|speed|live')
    accuracy = kinds.add_parser('accuracy', help='pose and range against exact truth')
    _add_accuracy(accuracy)
    speed = kinds.add_parser('speed', help='the chain against one StereoBM call')
    speed.add_argument('--input', type=Path, metavar='IN',
                       help='bag, video or folder of frames (default: the sample bag)')
    speed.add_argument('--pairs', type=int, default=30, help='timed (default: %(default)s)')
    speed.add_argument('--params', type=Path, action='append', default=[], metavar='FILE')
    speed.add_argument('-p', action='append', default=[], dest='overrides', metavar='NAME:=VALUE')
    obstacles = kinds.add_parser('obstacles', help='obstacle sectors against exact truth')
    _add_obstacles(obstacles)
    street = kinds.add_parser('map', help='maps of a drive against exact truth')
    _add_map(street)
    live = kinds.add_parser('live', help='the nodes over DDS')
    for one in (accuracy, obstacles, street, speed):
        one.add_argument('--height', type=int, default=960, help='(default: %(default)s)')
    for one in (accuracy, obstacles, street, speed, live):
        one.add_argument('--json', action='store_true', help='end with one line of JSON')
    from . import live as live_bench
    live_bench.add_arguments(live)


def _add_accuracy(parser: argparse.ArgumentParser) -> None:
    parser.add_argument('folders', type=Path, nargs='*', metavar='FOLDER',
                        help='frames with truth, as `sphstereo scene` writes them; also looked '
                        f'for in ${GROUND_TRUTH} (default: scenes are rendered)')
    parser.add_argument('--scene', choices=SCENES, default='street', help='to be rendered')
    parser.add_argument('--nuisance', choices=NUISANCES, help='what makes the scene harder')
    parser.add_argument('--seeds', type=int, nargs='+', default=REPORTED_SEEDS, metavar='SEED',
                        help='of the scenes to be rendered (default: %(default)s)')
    parser.add_argument('--frames', type=int, default=14, help='of each (default: %(default)s)')
    parser.add_argument('--skip', type=int, help='frames of each that are not scored '
                        '(default: 10; half of a shorter sequence)')
    parser.add_argument('--cache', type=Path, metavar='DIR', help='keep what is rendered here, '
                        'and take it from here the next time')
    parser.add_argument('--plots', type=Path, metavar='DIR', help='write plots as PNG (extra '
                        "'plots')")
    parser.add_argument('--methods', help=f'of {",".join(METHODS)} (default: '
                        f'{",".join(COMPARED)}); with --binocular of {",".join(PAIR_METHODS)} '
                        '(default: all)')
    parser.add_argument('--binocular', action='store_true', help='pairs of two cameras, one above '
                        'the other: of folders whose meta.json has pairs, or rendered')
    parser.add_argument('--params', type=Path, action='append', default=[], metavar='FILE',
                        help='parameters of the method `default`')
    parser.add_argument('-p', action='append', default=[], dest='overrides',
                        metavar='NAME:=VALUE', help='the same, one by one')


def _add_obstacles(parser: argparse.ArgumentParser) -> None:
    parser.add_argument('inputs', type=Path, nargs='*', metavar='FOLDER|BAG',
                        help='frames with truth, as `sphstereo scene` writes them, or a bag with '
                        '/ground_truth/range (default: scenes are rendered, and the sample bag)')
    parser.add_argument('--scenes', nargs='+', choices=SCENES, default=SCENES, metavar='SCENE',
                        help=f'of {", ".join(SCENES)}, to be rendered (default: all)')
    parser.add_argument('--seeds', type=int, nargs='+', default=REPORTED_SEEDS, metavar='SEED',
                        help='of the scenes to be rendered (default: %(default)s)')
    parser.add_argument('--frames', type=int, default=14, help='of each (default: %(default)s)')
    parser.add_argument('--cache', type=Path, metavar='DIR', help='keep what is rendered here, '
                        'and take it from here the next time')
    parser.add_argument('--ground', type=float, default=0.0, metavar='Z', help="height of the "
                        "ground in the sequences' world, metres (default: %(default)s)")
    parser.add_argument('--methods', help=f'of {",".join(OBSTACLE_METHODS)} (default: all)')
    parser.add_argument('--params', type=Path, action='append', default=[], metavar='FILE',
                        help='parameters of the method `default`')
    parser.add_argument('-p', action='append', default=[], dest='overrides',
                        metavar='NAME:=VALUE', help='the same, one by one')


def _add_map(parser: argparse.ArgumentParser) -> None:
    from .mapping import KINDS
    parser.add_argument('--seed', type=int, default=REPORTED_SEEDS[0],
                        help='of the street (default: %(default)s)')
    parser.add_argument('--frames', type=int, default=100, help='(default: %(default)s)')
    parser.add_argument('--kinds', help=f'of {",".join(KINDS)} (default: all)')
    parser.add_argument('--memory', type=int, metavar='FRAMES', help='instead: peak memory of '
                        '`sphstereo map` on so many frames, there and back again')
    parser.add_argument('--cache', type=Path, metavar='DIR', help='keep what is rendered here, '
                        'and take it from here the next time')
    parser.add_argument('-p', action='append', default=[], dest='overrides',
                        metavar='NAME:=VALUE', help='parameter')


def main(args: argparse.Namespace) -> int:
    """Run one benchmark; returns the exit status."""
    if args.kind == 'live':
        from . import live
        return int(live.main(args))
    if args.kind == 'accuracy':
        result = _binocular(args) if args.binocular else _accuracy(args)
    elif args.kind == 'obstacles':
        result = _obstacles(args)
    elif args.kind == 'map':
        result = _map(args)
    else:
        result = _speed(args)
    if args.json:
        print(json.dumps(_rounded(result)))
    return 0


def _rounded(value: Any) -> Any:
    """Numbers to five digits, however deep."""
    if isinstance(value, dict):
        return {name: _rounded(item) for name, item in value.items()}
    return float(f'{value:.5g}') if isinstance(value, float) else value


def _accuracy(args: argparse.Namespace) -> dict[str, Any]:
    from .accuracy import Contest, frames_to_skip
    from .tables import tables
    names = _chosen(args.methods, COMPARED, METHODS)
    write = _plotter() if args.plots is not None else None
    given = load_values(args.params, args.overrides)
    contest = Contest({name: method(name, given) for name in names})
    scenes = Scenes(args.scene, args.seeds, args.frames, args.height, args.nuisance, args.cache)
    for sequence in saved(args.folders) if args.folders else scenes.sequences():
        with tqdm(total=len(sequence), unit='frame', disable=None) as progress:
            contest.add(sequence, frames_to_skip(len(sequence), args.skip), progress.update)
    summaries = contest.summaries()
    print(tables(summaries))
    if write is not None:
        print('\nwritten:', ', '.join(map(str, write(summaries, args.plots))))
    return summaries


def _chosen(given: str | None, default: Sequence[str], there: Sequence[str],
            option: str = '--methods') -> Sequence[str]:
    names = list(default) if given is None else given.split(',')
    unknown = sorted(set(names) - set(there))
    if unknown:
        raise BadInput(f'{option}: {unknown[0]} is none of {", ".join(there)}')
    return names


def _binocular(args: argparse.Namespace) -> dict[str, Any]:
    from .binocular import PairContest, parameters, rendered_pairs, saved_pairs, table
    names = _chosen(args.methods, PAIR_METHODS, PAIR_METHODS)
    given = load_values(args.params, args.overrides)
    contest = PairContest({name: parameters(name, given) for name in names})
    with tqdm(unit='pair', disable=None) as progress:
        if args.folders:
            for folder in args.folders:
                contest.add(saved_pairs(folder), progress.update)
        else:
            try:
                for seed in args.seeds:
                    contest.add(rendered_pairs(args.scene, seed, args.frames, args.height),
                                progress.update)
            except ImportError as error:
                raise BadInput(f"rendering needs the extra 'scenes': {error}") from error
    summaries = contest.summaries()
    print(table(summaries))
    return summaries


def _obstacles(args: argparse.Namespace) -> dict[str, Any]:
    from .obstacles import ObstacleContest, sequence_line, table
    names = _chosen(args.methods, OBSTACLE_METHODS, OBSTACLE_METHODS)
    given = load_values(args.params, args.overrides)
    contest = ObstacleContest({name: method(name, given) for name in names}, args.ground)
    with tqdm(unit='frame', disable=None) as progress:
        for name, sequence in _obstacle_inputs(args):
            for label, summary in contest.add(name, sequence, progress.update).items():
                progress.write(sequence_line(name, label, summary), file=sys.stderr)
    summaries = contest.summaries()
    print(table(summaries))
    return summaries


def _obstacle_inputs(args: argparse.Namespace) -> Iterator[tuple[str, Iterable[TruthFrame]]]:
    """Names and frames of what was asked for."""
    from .obstacles import frames_of_bag
    from .processes import shipped
    bags = [path for path in args.inputs if path.is_file()]
    for path in bags if args.inputs else [shipped('bags/street.mcap')]:
        yield path.name, frames_of_bag(path)
    folders = [path for path in args.inputs if path not in bags]
    for path, sequence in zip(folders, saved(folders), strict=True):
        yield path.name, sequence
    for name in () if args.inputs else args.scenes:
        scenes = Scenes(name, args.seeds, args.frames, args.height, None, args.cache)
        yield from ((name, sequence) for sequence in scenes.sequences())


def _map(args: argparse.Namespace) -> dict[str, Any]:
    import tempfile

    from .mapping import KINDS, Drive, measure, peak_memory, table
    kinds = _chosen(args.kinds, KINDS, KINDS, '--kinds')
    given = load_values([], args.overrides)
    with tempfile.TemporaryDirectory() as folder:
        drive = Drive(args.seed, args.frames, args.height, args.cache or Path(folder))
        if args.memory:
            peak = peak_memory(drive, args.memory, [w for v in args.overrides for w in ('-p', v)])
            print(f'peak memory of {args.memory} frames: {peak["peak_mb"]:.0f} MB')
            return dict(peak)
        with tqdm(total=len(kinds) * args.frames, unit='frame', disable=None) as progress:
            figures = measure(drive, kinds, given, progress.update)
    print(table(figures))
    return dict(figures)


def _plotter() -> Callable[[dict[str, Any], Path], list[Path]]:
    """Known to be there before hours of measuring."""
    try:
        from .plots import write_plots
    except ImportError as error:
        raise BadInput(f"--plots needs the extra 'plots': {error}") from error
    return write_plots


def _speed(args: argparse.Namespace) -> dict[str, Any]:
    from .live import frames
    from .processes import shipped
    from .speed import measure, one_reference, stage_times, window_cost
    images = frames(args.input or shipped('bags/street.mcap'), args.height,
                    colour=False)['camera']
    own = load_values(args.params, args.overrides)
    given = one_reference({'stereo.matcher': 'bm', **own})
    stages = stage_times(images, given)
    result = {**measure(images, given, args.pairs), **window_cost(images, own, args.pairs)}
    for name, value in stages.items():
        print(f'{name:20}{value:8.1f} ms')
    print(f'{"whole chain":20}{result["chain_ms"]:8.1f} ms\n'
          f'{"StereoBM(96, 15)":20}{result["bm_ms"]:8.1f} ms\n'
          f'{"ratio":20}{result["ratio"]:8.2f}    ({result["pairs"]} pairs)')
    if result['window_ratio'] is not None:
        print(f'{"full window":20}{result["window_ms"]:8.1f} ms\n'
              f'{"one reference":20}{result["single_ms"]:8.1f} ms\n'
              f'{"ratio":20}{result["window_ratio"]:8.2f}')
    if result['dropped']:
        print(f'dropped: {result["dropped"]}', file=sys.stderr)
    return {**result, 'stages_ms': stages}
