"""The command `sphstereo view`: a bag, or the running topics, in a viewer."""
from __future__ import annotations

import argparse
import contextlib
import os
import sys
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from tqdm import tqdm

from sphstereo_ros.cli import INTERRUPTED
from sphstereo_ros.cli.run import output_path
from sphstereo_ros.interrupts import interrupt_on_signals
from sphstereo_ros.replay.records import BadInput, Source
from sphstereo_ros.replay.sources import open_source
from sphstereo_ros.report.contents import namespace_of

PORT = 9090


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument('inputs', type=Path, nargs='*', metavar='IN',
                        help='bag, video, or folder of frames; several are laid over each other')
    parser.add_argument('--live', action='store_true',
                        help='the running topics instead of IN; needs ROS 2')
    parser.add_argument('--namespace', default='', help='of the running topics, as in /robot')
    parser.add_argument('--seconds', type=float, default=0.0,
                        help='end --live after so long (default: Ctrl-C ends it)')
    parser.add_argument('--web', action='store_true',
                        help='in a browser; without a screen it is always so')
    parser.add_argument('--port', type=int, default=PORT,
                        help='of the page for browsers, the next is for its data '
                             '(default: %(default)s)')
    parser.add_argument('--save', type=Path, metavar='FILE.rrd',
                        help='into a file for `rerun FILE.rrd` instead')
    parser.add_argument('--fps', type=float, default=0.0, help='frame rate of a folder of frames')


def main(arguments: argparse.Namespace) -> int:
    """View; returns the exit status."""
    if bool(arguments.inputs) == arguments.live:
        raise BadInput('give a bag, or --live')
    try:
        import rerun

        from sphstereo_ros.view import scene
    except ImportError as error:
        if str(error.name).startswith('sphstereo_ros'):
            raise
        raise BadInput(f"Rerun cannot be loaded ({str(error).splitlines()[0]}): pip install "
                       "rerun-sdk, which needs NumPy 2 (the package's extra 'view')") from error
    sources = [open_source(path, arguments.fps) for path in arguments.inputs]
    topics = _topics(sources, arguments.inputs)
    interrupt_on_signals()
    stream = rerun.RecordingStream('sphstereo')
    serves = _open(rerun, stream, scene.blueprint(), arguments)
    shown = scene.Scene(stream)
    status = 0
    try:
        if arguments.live:
            _follow(shown, arguments.namespace, arguments.seconds)
        else:
            _read(sources, topics, shown)
    except KeyboardInterrupt:
        status = 0 if arguments.live else INTERRUPTED
    stream.flush()
    _tell(shown, sources, arguments)
    if serves and not arguments.live and not status:
        print('Ctrl-C ends it', flush=True)
        with contextlib.suppress(KeyboardInterrupt):
            threading.Event().wait()
    return status


def _topics(sources: Sequence[Source], paths: Sequence[Path]) -> list[dict[str, str]]:
    """What is viewed of each: topics, and their names without the namespace."""
    from sphstereo_ros.view.topics import viewed
    found: list[dict[str, str]] = []
    for source, path in zip(sources, paths, strict=True):
        there = [(t, kind) for t, kind in source.topics.items() if source.count([t])]
        taken = {name for names in found for name in names.values()}
        names = viewed(there, namespace_of(source) or '')
        if not names:
            raise BadInput(f'{path} holds nothing to view')
        found.append({topic: name for topic, name in names.items() if name not in taken})
    return found


def _open(rerun: Any, stream: Any, blueprint: Any, arguments: argparse.Namespace) -> bool:
    """Open where it is shown; returns whether this process serves it."""
    if arguments.save is not None:
        path: Path = arguments.save
        for given in arguments.inputs:
            output_path(path, given, '.rrd')
        if path.is_dir() or not path.resolve().parent.is_dir():
            raise BadInput(f'cannot write {path}')
        stream.save(path, default_blueprint=blueprint)
        return False
    screen = os.environ.get('DISPLAY') or os.environ.get('WAYLAND_DISPLAY')
    if screen and not arguments.web:
        rerun.spawn(recording=stream, default_blueprint=blueprint)
        return False
    data_port = arguments.port + 1
    try:
        address = rerun.serve_grpc(grpc_port=data_port, default_blueprint=blueprint,
                                   recording=stream, server_memory_limit='1GB')
        rerun.serve_web_viewer(web_port=arguments.port, open_browser=bool(screen),
                               connect_to=address)
    except (RuntimeError, OSError) as error:
        raise BadInput(f'cannot serve: {str(error).strip().splitlines()[0]}') from error
    print(f'open http://127.0.0.1:{arguments.port}/?url={address.replace("+", "%2B")}\n'
          f"(from elsewhere: this computer's address in both places, ports {arguments.port} and "
          f'{data_port})', flush=True)
    return True


def _read(sources: Sequence[Source], topics: Sequence[dict[str, str]], shown: Any) -> None:
    total = sum(source.count(list(names)) for source, names in zip(sources, topics, strict=True))
    with tqdm(total=total, unit='message', disable=None) as progress:
        for source, names in zip(sources, topics, strict=True):
            for record in source.records(list(names)):
                shown.show(names[record.topic], record.message())
                progress.update()


def _follow(shown: Any, namespace: str, seconds: float) -> None:
    try:
        from sphstereo_ros.view import live
    except ImportError as error:
        raise BadInput(f'--live needs ROS 2, and there is no {error.name}') from error
    live.follow(namespace, shown.show, seconds)


def _tell(shown: Any, sources: Sequence[Source], arguments: argparse.Namespace) -> None:
    counts = ', '.join(f'{count} {name}' for name, count in sorted(shown.shown.items()))
    print(f'shown: {counts or "nothing"}')
    if arguments.save is not None:
        print(f'written: {arguments.save}')
    bad = ', '.join(f'{count} of {name}' for name, count in sorted(shown.unreadable.items()))
    if bad:
        print(f'warning: could not be shown: {bad}', file=sys.stderr)
    for source, path in zip(sources, arguments.inputs, strict=True):
        if source.problem:
            print(f'warning: {path}: {source.problem}', file=sys.stderr)
