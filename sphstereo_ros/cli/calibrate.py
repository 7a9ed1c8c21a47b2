"""The command `sphstereo calibrate`: the alignment of two cameras from an ordinary recording."""
from __future__ import annotations

import argparse
import math
import sys
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from tqdm import tqdm

from sphstereo_ros.cli.run import output_path
from sphstereo_ros.core.calibration import (
    AlignmentCalibration,
    CalibrationResult,
    configured_pose,
)
from sphstereo_ros.core.config import Config, ParameterError
from sphstereo_ros.core.epipolar_picture import residual_map, residual_picture
from sphstereo_ros.core.frames import Drop, Frame, Image8
from sphstereo_ros.core.relative_pose import Correspondences
from sphstereo_ros.interrupts import interrupt_on_signals
from sphstereo_ros.replay.parameter_files import load_config
from sphstereo_ros.replay.player import stamp_of
from sphstereo_ros.replay.records import COMPRESSED, IMAGE, BadInput, Source
from sphstereo_ros.replay.sources import open_source
from sphstereo_ros.ros.images import decode_frame, read_mask
from sphstereo_ros.ros.messages import SECOND

Stamps = tuple[int, int]

_PICTURE = 1440  # columns
# The pictures tell another direction than the one given: more than this, and than 4 sigma.
_LEANS = math.radians(0.3)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument('input', type=Path, metavar='IN',
                        help='bag (mcap or db3, file or folder) with the images of both cameras')
    parser.add_argument('--out', type=Path, metavar='FILE.yaml',
                        help='parameter file (default: IN_calibration.yaml in this folder); '
                             'FILE_before.png and FILE_after.png go with it')
    parser.add_argument('--top-topic', default='', metavar='T', help='images of the top camera '
                        '(default: /top/image or /top/image/compressed)')
    parser.add_argument('--bottom-topic', default='', metavar='T', help='of the bottom one')
    parser.add_argument('--max-pairs', type=int, default=20, metavar='N',
                        help='so many pairs are used, spread evenly (default: %(default)s)')
    parser.add_argument('--direction', default='', metavar='X,Y,Z|estimate', help='from the '
                        'bottom to the top camera, along the axes of the bottom camera_link; or '
                        'estimate it, too (default: baseline.direction)')
    parser.add_argument('--params', type=Path, action='append', default=[], metavar='FILE',
                        help='ROS 2 parameter file, as the nodes take it')
    parser.add_argument('-p', action='append', default=[], dest='overrides',
                        metavar='NAME:=VALUE', help='parameter; always wins over --params')


def main(arguments: argparse.Namespace) -> int:
    """Calibrate; returns the exit status."""
    if arguments.max_pairs < 1:
        raise BadInput('--max-pairs: must be at least 1')
    config = _with_direction(load_config(arguments.params, arguments.overrides),
                             arguments.direction)
    mask = read_mask(config.camera.mask)
    path = output_path(arguments.out, arguments.input, '_calibration.yaml')
    source = open_source(arguments.input)
    topics = (side_topic(source, 'top', arguments.top_topic),
              side_topic(source, 'bottom', arguments.bottom_topic))
    if topics[0] == topics[1]:
        raise BadInput(f'{topics[0]} cannot be both cameras')
    interrupt_on_signals()
    calibration = AlignmentCalibration(config, mask,
                                       estimate_direction=arguments.direction == 'estimate')
    last = _add_pairs(calibration, source, topics, arguments.max_pairs)
    result = calibration.result()
    if isinstance(result, Drop):
        raise BadInput(f'{arguments.input}: {result.cause}: {result.detail}')
    _write(path, parameter_file(result, config, arguments.input.name).encode())
    pictures = _draw(path, calibration, result, last)
    print('\n'.join([*report(result, calibration.drops),
                     f'written: {path}, {" and ".join(p.name for p in pictures)}']))
    for warning in _warnings(result, source, arguments.input):
        print(f'warning: {warning}', file=sys.stderr)
    return 0


def _with_direction(config: Config, text: str) -> Config:
    if text in ('', 'estimate'):
        return config
    try:
        direction = tuple(float(word) for word in text.split(','))
    except ValueError:
        direction = ()
    if len(direction) != 3 or not 1e-6 < math.hypot(*direction) < math.inf:
        raise ParameterError(f"--direction {text}: needs X,Y,Z, not all zero, or 'estimate'")
    return replace(config, baseline=replace(config.baseline, direction=direction))


def side_topic(source: Source, side: str, wanted: str = '') -> str:
    """The image topic of a camera: `wanted`, or the usual raw or compressed one.

    Raises
    ------
    BadInput
        where it is not there

    """
    images = sorted(topic for topic, kind in source.topics.items() if kind in (IMAGE, COMPRESSED))
    there = f'image topics there: {", ".join(images) or "none"}'
    if wanted:
        if wanted not in images:
            raise BadInput(f'no image topic {wanted}; {there}')
        return wanted
    for topic in (f'/{side}/image', f'/{side}/image/compressed'):
        if topic in images and source.count([topic]):
            return topic
    raise BadInput(f'no topic /{side}/image or /{side}/image/compressed; {there}; '
                   f'choose with --{side}-topic')


# Pairs

def paired_stamps(top: Sequence[int], bottom: Sequence[int], tolerance: float) -> list[Stamps]:
    """Stamps (ns) that belong together: each the other's nearest, `tolerance` seconds at most."""
    one, two = (np.unique(np.asarray(stamps, np.int64)) for stamps in (top, bottom))
    if not len(one) or not len(two):
        return []
    near, back = _nearest(one, two), _nearest(two, one)
    mutual = back[near] == np.arange(len(one))
    close = np.abs(two[near] - one) <= round(tolerance * SECOND)
    return [(int(one[k]), int(two[near[k]])) for k in np.nonzero(mutual & close)[0]]


def _nearest(stamps: np.ndarray[tuple[int], np.dtype[np.int64]],
             among: np.ndarray[tuple[int], np.dtype[np.int64]],
             ) -> np.ndarray[tuple[int], np.dtype[np.intp]]:
    right = np.searchsorted(among, stamps).clip(1, len(among) - 1) if len(among) > 1 \
        else np.zeros(len(stamps), np.intp)
    left = np.maximum(right - 1, 0)
    return np.where(stamps - among[left] <= among[right] - stamps, left, right)


def spread(pairs: Sequence[Stamps], most: int) -> list[Stamps]:
    """`most` of them, as evenly as can be."""
    if len(pairs) <= most:
        return list(pairs)
    chosen = np.rint(np.linspace(0, len(pairs) - 1, most)).astype(int) if most > 1 \
        else np.array([len(pairs) // 2])
    return [pairs[k] for k in chosen]


def _frames(source: Source, topics: tuple[str, str], pairs: Sequence[Stamps],
            height: int) -> Iterator[tuple[Frame | Drop, Frame | Drop]]:
    """The frames of these pairs, (top, bottom), in the order in which they are complete."""
    partner = {topics[0]: dict(pairs), topics[1]: {b: a for a, b in pairs}}
    waiting: dict[str, dict[int, Frame | Drop]] = {topic: {} for topic in topics}
    for record in source.records(topics):
        stamp = stamp_of(record.serialised())
        other_stamp = partner[record.topic].pop(stamp, None)
        if other_stamp is None:
            continue
        message = record.message()
        frame = message if isinstance(message, Drop) else decode_frame(message, height)
        other = topics[1] if record.topic == topics[0] else topics[0]
        if other_stamp not in waiting[other]:
            waiting[record.topic][stamp] = frame
            continue
        mate = waiting[other].pop(other_stamp)
        yield (frame, mate) if record.topic == topics[0] else (mate, frame)


def _add_pairs(calibration: AlignmentCalibration, source: Source, topics: tuple[str, str],
               most: int) -> Image8 | None:
    """Give the pairs to the calibration; returns the last picture of the bottom camera."""
    config = calibration.config
    stamps: dict[str, list[int]] = {topic: [] for topic in topics}
    for record in source.records(topics):
        if record.cdr is not None and len(record.cdr) >= 12:
            stamps[record.topic].append(stamp_of(record.serialised()))
    found = paired_stamps(stamps[topics[0]], stamps[topics[1]], config.pairing.tolerance)
    if not found:
        raise BadInput(f'no_pairs: {len(stamps[topics[0]])} images on {topics[0]}, '
                       f'{len(stamps[topics[1]])} on {topics[1]}, no two within '
                       f'pairing.tolerance {config.pairing.tolerance:g} s')
    chosen = spread(found, most)
    last = None
    # No bar where nobody watches.
    with tqdm(total=len(chosen), unit='pair', disable=None) as progress:
        for top, bottom in _frames(source, topics, chosen, config.stereo.working_height):
            if isinstance(top, Drop) or isinstance(bottom, Drop):
                calibration.drops += [drop for drop in (top, bottom) if isinstance(drop, Drop)]
            else:
                calibration.add(top, bottom)
                last = bottom.image
            progress.update()
    return last


# What is told

def parameter_file(result: CalibrationResult, config: Config, source: str) -> str:
    """A ROS 2 parameter file that gives the alignment to every node."""
    lines = ['# Alignment of the top camera in the axes of the bottom camera_link, from '
             f'{source}: {result.pairs} pairs,',
             f'# {result.points} points in {100 * result.share:.0f} % of the sphere, residual '
             f'{math.degrees(result.residual):.4f}°. Radians; behind: degrees ± one standard '
             'deviation.',
             '/**:', '  ros__parameters:']
    for name, angle, sigma in zip(('roll', 'pitch', 'yaw'), result.rpy, result.rpy_sigma,
                                  strict=True):
        lines.append(f'    camera.top.{name}: {angle:.8f}  # {_degrees(angle)} ± '
                     f'{_degrees(sigma)}')
    direction = [float(x) for x in config.baseline.direction]
    if result.direction_estimated:
        vector = ', '.join(f'{x:.7f}' for x in result.link_direction)
        lines.append(f'    baseline.direction: [{vector}]  # ± {_degrees(result.direction_sigma)}')
    elif direction != [0.0, 0.0, 1.0]:
        lines.append(f'    baseline.direction: {direction}  # as given')
    lines.append('    calibration.pairs: 0  # take camera.top.* from here, estimate nothing first')
    return '\n'.join(lines) + '\n'


def report(result: CalibrationResult, drops: Sequence[Drop]) -> list[str]:
    """What was found, one line a figure."""
    lines = [f'pairs: {result.pairs}, {result.points} points in {100 * result.share:.0f} % of the '
             f'sphere, residual {math.degrees(result.residual):.4f}°, median parallax '
             f'{math.degrees(result.parallax):.2f}°']
    lines += [f'not used, {cause}: {count}'
              for cause, count in Counter(drop.cause for drop in drops).most_common()]
    lines += [f'{name:5} {math.degrees(angle):9.4f}° ± {math.degrees(sigma):.4f}°'
              for name, angle, sigma in zip(('roll', 'pitch', 'yaw'), result.rpy,
                                            result.rpy_sigma, strict=True)]
    vector = ', '.join(f'{x:.5f}' for x in result.link_direction)
    lines.append(f'direction ({vector}), ' + (
        f'estimated ± {_degrees(result.direction_sigma)}' if result.direction_estimated else
        'as given; ' + ('the scene is too far away to tell another' if math.isnan(result.lean) else
                        f'the pictures tell {_degrees(result.lean)} ± '
                        f'{_degrees(result.lean_sigma)} from it')))
    lines.append('the scene suffices: standard deviation about the weakest axis '
                 f'{_degrees(result.sigma)}')
    return lines


def _warnings(result: CalibrationResult, source: Source, path: Path) -> Iterator[str]:
    if not result.direction_estimated and result.lean > max(_LEANS, 4 * result.lean_sigma):
        yield (f'the baseline leans by {_degrees(result.lean)} ± {_degrees(result.lean_sigma)} '
               'from the direction given: give it by --direction X,Y,Z, or --direction estimate')
    if source.problem:
        yield f'{path}: {source.problem}'


def _degrees(angle: float) -> str:
    return f'{math.degrees(angle):.4f}°'


def _draw(path: Path, calibration: AlignmentCalibration, result: CalibrationResult,
          image: Image8 | None) -> list[Path]:
    """Residuals of all points with the alignment believed before, and with the one found."""
    assert image is not None
    parts = [fit.points for fit in calibration.fits]
    points = Correspondences(*(np.concatenate([getattr(p, name) for p in parts])
                               for name in ('reference', 'current', 'sigma')))
    small = cv2.resize(image, (_PICTURE, _PICTURE // 2), interpolation=cv2.INTER_AREA)
    before = configured_pose(calibration.config, 1.0)
    written = []
    for name, rotation, direction in (('before', before.rotation, before.position),
                                      ('after', result.rotation, result.direction)):
        residuals = residual_map(points, rotation, direction)
        title = (f'{name}: median distance from the epipolar plane '
                 f'{np.nanmedian(residuals):.3f} deg')
        done, data = cv2.imencode('.png', residual_picture(np.asarray(small), residuals, title))
        assert done
        written.append(path.with_name(f'{path.stem}_{name}.png'))
        _write(written[-1], data.tobytes())
    return written


def _write(path: Path, data: bytes) -> None:
    try:
        path.write_bytes(data)
    except OSError as error:
        raise BadInput(f'{path}: {error.strerror}') from error
