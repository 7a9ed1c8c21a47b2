"""The command that renders a scene into a folder."""
from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from .binocular import TopCamera, render_binocular, save_binocular
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
SAMPLE_TOP = (2.0, -1.5, 3.0)  # roll, pitch, yaw of the top camera, degrees
SAMPLE_STEPS = (0.0, 0.0, 0.0, 0.28, 0.28, 0.28, 0.28, 0.28, 0.28)  # m between pairs


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
    two = parser.add_argument_group('two cameras', 'frames come in pairs: bottom, top, bottom, …')
    two.add_argument('--binocular', action='store_true', help='a second camera above the first; '
                     '--frames counts pairs, and --spacing 0 hovers')
    two.add_argument('--baseline', type=float, default=0.35, metavar='M', help='metres between '
                     'the two (default: %(default)s)')
    two.add_argument('--top', type=float, nargs=3, default=(0.0, 0.0, 0.0),
                     metavar=('ROLL', 'PITCH', 'YAW'), help='of the top camera in the axes of the '
                     'bottom one, degrees')
    two.add_argument('--direction', type=float, nargs=3, default=(0.0, 0.0, 1.0),
                     metavar=('X', 'Y', 'Z'), help='from the bottom to the top camera '
                     '(default: 0 0 1)')
    two.add_argument('--top-gain', type=float, default=1.0, help="the top camera's exposure over "
                     "the bottom one's (default: %(default)s)")
    two.add_argument('--top-white', type=float, nargs=3, default=(1.0, 1.0, 1.0),
                     metavar=('R', 'G', 'B'), help="its white balance")


def main(args: argparse.Namespace) -> int:
    """Render; 0 done, 2 for arguments that make no sense."""
    problem = _problem(args)
    if problem:
        print(f'scene: {problem}', file=sys.stderr)
        return 2
    if args.binocular:
        _render_pairs(args)
    else:
        _render_frames(args)
    return 0


def _render_frames(args: argparse.Namespace) -> None:
    sequence = render_sequence(args.name, args.seed, args.frames, args.height, args.spacing,
                               **_options(args))
    save_sequence(sequence, args.folder, _title(args), progress=_bar(len(sequence)))
    if args.bag is not None:
        from .bag import write_bag
        write_bag(load_sequence(args.folder), args.bag)


def _render_pairs(args: argparse.Namespace) -> None:
    rig = TopCamera(tuple(np.radians(args.top)), args.baseline, tuple(args.direction),
                    args.top_gain, tuple(args.top_white))
    sequence = render_binocular(args.name, args.seed, args.frames, args.height, rig,
                                spacing=args.spacing, **_options(args))
    save_binocular(sequence, args.folder, f'{_title(args)} binocular',
                   progress=_bar(len(sequence)))
    if args.bag is not None:
        from .bag import write_binocular_bag
        write_binocular_bag(load_sequence(args.folder), args.bag)


def _options(args: argparse.Namespace) -> dict[str, Any]:
    return {'shake_deg': tuple(args.shake), 'exposure': args.exposure,
            'noise': NO_NOISE if args.no_noise else NOISE, 'jpeg': args.jpeg or None,
            'mount': tuple(args.mount), 'nuisance': args.nuisance}


def _title(args: argparse.Namespace) -> str:
    return f'{args.name} {args.nuisance}' if args.nuisance else str(args.name)


def _problem(args: argparse.Namespace) -> str:
    if args.frames < 1 or args.height < 2:
        return 'needs at least one frame and two rows'
    if not 0 <= args.jpeg <= 100:
        return '--jpeg is a quality from 0 to 100'
    if not 0 <= args.shake[0] <= args.shake[1]:
        return '--shake is a least and a largest angle'
    if args.seed < 0:
        return '--seed must not be negative'
    if not (args.baseline > 0 and args.top_gain > 0 and min(args.top_white) > 0
            and any(args.direction)):
        return '--baseline, --top-gain and --top-white must be positive, --direction not zero'
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


def render_binocular_sample(folder: str | Path) -> None:
    """Render what the sample bag of two cameras holds: a street, hovering, then under way."""
    rig = TopCamera(tuple(np.radians(SAMPLE_TOP)), gain=0.75, white_balance=(1.15, 1.0, 0.85))
    sequence = render_binocular('street', SAMPLE_SEED, len(SAMPLE_STEPS) + 1, 480, rig,
                                spacing=SAMPLE_STEPS, jpeg=SAMPLE_QUALITY)
    save_binocular(sequence, folder, 'binocular sample', small_height=SAMPLE_RANGE_HEIGHT,
                   progress=_bar(len(sequence)))


def render_sample(folder: str | Path) -> None:
    """Render what the sample bag holds: a street, 0.28 m and 1–3° of shake between frames."""
    sequence = render_sequence('street', SAMPLE_SEED, SAMPLE_FRAMES, jpeg=SAMPLE_QUALITY)
    save_sequence(sequence, folder, 'sample', small_height=SAMPLE_RANGE_HEIGHT,
                  progress=_bar(len(sequence)))
