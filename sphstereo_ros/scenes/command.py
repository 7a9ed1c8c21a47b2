"""The command that renders a scene into a folder."""
from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

from tqdm import tqdm

from .nuisances import STREETS, check
from .sequence import (
    NO_NOISE,
    NOISE,
    NUISANCES,
    SCENES,
    TUNING_SEEDS,
    load_sequence,
    render_sequence,
    save_sequence,
)

# The sample bag's content: a scene that is neither tuned on nor reported.
SAMPLE_SEED = 42
SAMPLE_FRAMES = 20
SAMPLE_QUALITY = 92
SAMPLE_RANGE_HEIGHT = 240


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument('name', choices=SCENES, help='the scene')
    parser.add_argument('folder', type=Path, help='where to write; must be empty or not exist')
    parser.add_argument('--seed', type=int, default=TUNING_SEEDS[0],
                        help='of layout, textures, way and noise (default: %(default)s)')
    parser.add_argument('--frames', type=int, default=10, help='(default: %(default)s)')
    parser.add_argument('--height', type=int, default=960,
                        help='image rows; columns are twice that (default: %(default)s)')
    parser.add_argument('--spacing', type=float, help='metres between frames '
                        "(default: the scene's own)")
    parser.add_argument('--shake', type=float, nargs=2, default=(1.0, 3.0),
                        metavar=('LOW', 'HIGH'), help='rotation between frames, degrees '
                        '(default: 1 3)')
    parser.add_argument('--nuisance', choices=NUISANCES, help='something that makes it hard: '
                        f'{", ".join(STREETS)} are for the street alone')
    parser.add_argument('--exposure', type=float, default=0.05,
                        help='largest relative change of exposure (default: %(default)s)')
    parser.add_argument('--no-noise', action='store_true', help='no image noise')
    parser.add_argument('--jpeg', type=int, default=92, metavar='QUALITY',
                        help='0 writes PNG files (default: %(default)s)')
    parser.add_argument('--bag', type=Path, metavar='OUT.mcap', help='also write a bag of it')
    parser.add_argument('--mount', type=float, nargs=3, default=(0.0, 0.0, 0.0),
                        metavar=('ROLL', 'PITCH', 'YAW'), help='of the camera, radians')


def main(args: argparse.Namespace) -> int:
    """Render; 0 done, 2 for arguments that make no sense."""
    problem = _problem(args)
    if problem:
        print(f'scene: {problem}', file=sys.stderr)
        return 2
    sequence = render_sequence(
        args.name, args.seed, args.frames, args.height, args.spacing, tuple(args.shake),
        args.exposure, NO_NOISE if args.no_noise else NOISE, args.jpeg or None,
        tuple(args.mount), nuisance=args.nuisance)
    name = f'{args.name} {args.nuisance}' if args.nuisance else args.name
    save_sequence(sequence, args.folder, name, progress=_bar(len(sequence)))
    if args.bag is not None:
        from .bag import write_bag
        write_bag(load_sequence(args.folder), args.bag)
    return 0


def _problem(args: argparse.Namespace) -> str:
    if args.frames < 1 or args.height < 2:
        return 'needs at least one frame and two rows'
    if not 0 <= args.jpeg <= 100:
        return '--jpeg is a quality from 0 to 100'
    if not 0 <= args.shake[0] <= args.shake[1]:
        return '--shake is a least and a largest angle'
    if args.seed < 0:
        return '--seed must not be negative'
    try:
        check(args.name, args.nuisance)
    except ValueError as error:
        return str(error)
    if args.folder.exists() and (not args.folder.is_dir() or any(args.folder.iterdir())):
        return f'{args.folder} exists and is not an empty folder'
    try:
        import embreex
        import trimesh
    except ImportError as error:
        return f"{error}; the extra 'scenes' brings it"
    del embreex, trimesh
    return ''


def _bar(total: int) -> Callable[[Iterator[int]], Iterator[int]]:
    def bar(frames: Iterator[int]) -> Iterator[int]:
        return iter(tqdm(frames, total=total, unit='frame'))

    return bar


def render_sample(folder: str | Path) -> None:
    """Render what the sample bag holds: a street, 0.28 m and 1–3° of shake between frames."""
    sequence = render_sequence('street', SAMPLE_SEED, SAMPLE_FRAMES, jpeg=SAMPLE_QUALITY)
    save_sequence(sequence, folder, 'sample', small_height=SAMPLE_RANGE_HEIGHT,
                  progress=_bar(len(sequence)))
