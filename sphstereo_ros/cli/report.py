"""The command `sphstereo report`: a file of results as one page, with a cloud and pictures."""
from __future__ import annotations

import argparse
from pathlib import Path

from tqdm import tqdm

from sphstereo_ros.interrupts import interrupt_on_signals
from sphstereo_ros.replay.bags import bag_files
from sphstereo_ros.replay.records import BadInput, Source
from sphstereo_ros.replay.sources import open_source


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument('results', type=Path, metavar='OUT.mcap',
                        help='bag with results, of sphstereo run or recorded from the nodes')
    parser.add_argument('-o', '--out', type=Path, required=True, metavar='DIR',
                        help='folder for index.html, cloud.ply and pictures')
    parser.add_argument('--input', type=Path, action='append', default=[], metavar='BAG',
                        help='what the results were made from: images, odometry and true ranges '
                             'that OUT.mcap does not have')
    parser.add_argument('--partial', action='store_true',
                        help='report on what can be read of a truncated bag')


def main(arguments: argparse.Namespace) -> int:
    """Write the report; returns the exit status."""
    try:
        from sphstereo_ros.report.contents import Reading
        from sphstereo_ros.report.page import write_report
    except ModuleNotFoundError as error:
        if str(error.name).startswith('sphstereo_ros'):
            raise
        raise BadInput(f"there is no {error.name}: pip install jinja2 matplotlib (the package's "
                       "extra 'report')") from error
    folder: Path = arguments.out
    if folder.exists() and not folder.is_dir():
        raise BadInput(f'{folder} is a file: give a folder')
    results = _open(arguments.results)
    try:
        reading = Reading(results, [_open(path) for path in arguments.input])
    except BadInput as error:
        raise BadInput(f'{arguments.results} {error}') from error
    interrupt_on_signals()
    with tqdm(total=reading.total, unit='message', disable=None) as progress:
        contents = reading.read(progress.update)
    if contents.problems and not arguments.partial:
        raise BadInput(f'{arguments.results}: {contents.problems[0]}; --partial reports on what '
                       'can be read')
    words = ''.join(f' --input {path}' for path in arguments.input)
    try:
        written = write_report(contents, folder, arguments.results.name,
                               f'sphstereo report {arguments.results}{words} -o {folder}')
    except OSError as error:
        raise BadInput(f'cannot write {error.filename or folder}: {error.strerror}') from error
    print(f'written: {written[0]} ({written[0].stat().st_size / 1e6:.1f} MB) and '
          f'{len(written) - 1} files beside it')
    return 0


def _open(path: Path) -> Source:
    source = open_source(path)
    if not bag_files(path) and not (path / 'metadata.yaml').exists():
        raise BadInput(f'{path} is no bag')
    return source
