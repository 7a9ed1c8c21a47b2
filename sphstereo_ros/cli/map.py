"""The command `sphstereo map`: recordings into one cloud."""
from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from pathlib import Path

from tqdm import tqdm

from sphstereo_ros.cli import INTERRUPTED
from sphstereo_ros.cli.run import output_path
from sphstereo_ros.core.config import Config, resolve
from sphstereo_ros.interrupts import interrupt_on_signals
from sphstereo_ros.replay.map_chunks import Recording
from sphstereo_ros.replay.map_files import SUFFIXES, known_suffix
from sphstereo_ros.replay.map_run import CHUNK, LEAD, MapRun, with_scale, write_map
from sphstereo_ros.replay.parameter_files import load_values
from sphstereo_ros.replay.records import BadInput
from sphstereo_ros.replay.sources import image_topic, open_source


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument('inputs', type=Path, nargs='+', metavar='IN',
                        help='bag, video or folder of frames; several go into one map, in order')
    parser.add_argument('--out', type=Path, metavar='OUT', help='the cloud, one of '
                        f'{", ".join(SUFFIXES)}; the track goes beside it as OUT.tum (default: '
                        'IN_map.ply in this folder)')
    parser.add_argument('--params', type=Path, action='append', default=[], metavar='FILE',
                        help='ROS 2 parameter file, as the nodes take it')
    parser.add_argument('-p', action='append', default=[], dest='overrides',
                        metavar='NAME:=VALUE', help='parameter; always wins over --params')
    parser.add_argument('--topic', default='', help='image topic, if it is not the usual one')
    parser.add_argument('--fps', type=float, default=0.0,
                        help='frame rate of folders of frames, or in place of videos\' times')
    parser.add_argument('--chunk', type=int, default=CHUNK, metavar='FRAMES',
                        help='frames after which what is done is kept for a run that is '
                        'interrupted (default: %(default)s)')
    parser.add_argument('--dask', metavar='ADDRESS', help='make chunks on the workers of this '
                        "Dask scheduler, or local:N for N processes here (extra 'dask')")


def main(arguments: argparse.Namespace) -> int:
    """Map; returns the exit status."""
    if arguments.chunk < 2 * LEAD:
        raise BadInput(f'--chunk: at least {2 * LEAD}')
    given = load_values(arguments.params, arguments.overrides)
    recordings = []
    for path in arguments.inputs:
        source = open_source(path, arguments.fps)
        recordings.append(Recording(path, source, image_topic(source, arguments.topic),
                                    arguments.fps))
    config = _config(given, recordings)
    out = output_path(arguments.out, arguments.inputs[0], '_map.ply')
    for path in arguments.inputs[1:]:
        output_path(out, path, '')
    known_suffix(out)
    run = MapRun(config, recordings, out.with_name(f'{out.name}.parts'), arguments.chunk)
    interrupt_on_signals()
    return _mapped(run, out, arguments.dask)


def _config(given: dict[str, object], recordings: list[Recording]) -> Config:
    config = resolve(with_scale(given, recordings[0].source))
    if config.pairing.mode == 'binocular':
        raise BadInput('pairing.mode is binocular: sphstereo map takes one camera')
    unknown = (config.baseline.source, config.baseline.length) == ('fixed', 0.0) or (
        config.baseline.source, config.baseline.speed) == ('speed', 0.0)
    if unknown and not config.mapping.camera_height:
        raise BadInput('the scale is unknown: give -p baseline.speed:=M/S, '
                       '-p mapping.camera_height:=M, or a bag with /odometry')
    return config


def _mapped(run: MapRun, out: Path, dask: str | None) -> int:
    run.prepare()
    total = sum(recording.count() for recording in run.recordings)
    with tqdm(total=total, initial=run.summary.resumed, unit='frame', disable=None) as progress:
        try:
            if dask is not None:
                _on_cluster(run, dask, progress.update)
            run.process(progress.update)
        except KeyboardInterrupt:
            print(f'interrupted; finished chunks are in {run.folder}: the same command goes on',
                  file=sys.stderr)
            return INTERRUPTED
    frames, points = run.join()
    if not frames:
        run.remove_chunks()
        raise BadInput(f'no frame could be placed: {run.summary.why_not()}')
    if not len(points):
        run.remove_chunks()
        limits = run.config.mapping
        raise BadInput(f'no point was seen by {limits.min_frames} frames (mapping.min_frames) '
                       f'with a sigma below {limits.max_sigma:g} m (mapping.max_sigma)')
    track = out.with_suffix('.tum')
    write_map(out, track, frames, points, run.config)
    run.remove_chunks()
    print('\n'.join([*run.summary.lines(), f'written: {out}, {track}']))
    if run.summary.problems:
        raise BadInput('; '.join(run.summary.problems))
    return 0


def _on_cluster(run: MapRun, address: str, advance: Callable[[int], object]) -> None:
    from sphstereo_ros.replay.map_cluster import cluster, process
    with cluster(address) as client:
        process(run, client, advance)
