"""The demonstration: a recording through the four live nodes, and what comes out of them.

Run as `python -m sphstereo_ros.bench.demo BAG --out FOLDER`. The recording is replayed through
DDS twice: slowly, where every frame but the first must get its depth, and looped in real time.
"""
from __future__ import annotations

import argparse
import json
import shutil
import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from sphstereo_ros.core.config import ParameterError
from sphstereo_ros.core.frames import Drop, Image8
from sphstereo_ros.interrupts import interrupt_on_signals
from sphstereo_ros.replay.bag_messages import TYPESTORE
from sphstereo_ros.replay.output import McapOutput
from sphstereo_ros.replay.player import stamp_of
from sphstereo_ros.replay.ply import write_ply
from sphstereo_ros.replay.records import BadInput
from sphstereo_ros.replay.sources import image_topic, open_source
from sphstereo_ros.ros.conversions import decode_frame, read_cloud, read_depth

from .live import last_lines
from .processes import STAGES, Processes, numbers, private_domain, shipped
from .scoring import BANDS, average, compare

TRUTH = '/ground_truth/range'
IMAGE, DEPTH, CLOUD, PREVIEW = '/image/compressed', '/depth/image', '/points', '/depth/preview'
RECORDED = {IMAGE: 'sensor_msgs/msg/CompressedImage', DEPTH: 'sensor_msgs/msg/Image',
            CLOUD: 'sensor_msgs/msg/PointCloud2', PREVIEW: 'sensor_msgs/msg/Image',
            '/odometry/visual': 'nav_msgs/msg/Odometry',
            '/diagnostics': 'diagnostic_msgs/msg/DiagnosticArray'}
SLOW = 0.2
START_UP = 90.0  # seconds for nodes to be ready, and for the last results to arrive
LAST_RESULT = 20.0
COLOURS = ('points.colour:=true',)


@dataclass
class Pass:
    """What one replay brought: messages by topic and stamp, and figures."""

    messages: dict[str, dict[int, bytes]]
    figures: dict[str, Any]


class Progress:
    """Lines that say what is going on, with the time since the start."""

    def __init__(self) -> None:
        self._start = time.monotonic()

    def __call__(self, text: str) -> None:
        """Print a line."""
        print(f'[{time.monotonic() - self._start:5.1f} s] {text}', flush=True)


def recorded(path: Path, topic: str) -> dict[int, bytes]:
    """Messages of a topic of a bag as they are there, by stamp."""
    return {stamp_of(r.serialised()): r.serialised() for r in open_source(path).records([topic])}


def play(bag: Path, parameters: list[str], logs: Path, say: Progress, rate: float,
         loop_seconds: float = 0.0) -> Pass:
    """Start the four nodes, replay `bag` to them, and collect what they publish.

    loop_seconds : how long to loop after the first depth; 0 = once, to the end
    """
    from .observer import Observer
    private_domain()
    with Processes(logs) as processes, Observer() as observer:
        messages: dict[str, dict[int, bytes]] = {topic: {} for topic in RECORDED}
        for topic, kind in RECORDED.items():
            if not loop_seconds:
                observer.watch(topic, kind, messages[topic].__setitem__)
            elif topic in (IMAGE, DEPTH, CLOUD):
                observer.watch(topic, kind)
        processes.start_chain('separate', parameters)
        _wait_ready(observer, processes)
        say(f'{len(STAGES)} nodes are ready; replay at {rate:g} × real time')
        # Two: frame_pairing and the observer.
        processes.start('sphstereo', 'replay', str(bag), '--rate', str(rate), '--wait', '30',
                        '--subscriptions', '2', *(['--loop'] if loop_seconds else []))
        if loop_seconds:
            begin, end = _loop(observer, processes, loop_seconds)
        else:
            begin, end = _once(observer, processes, say, len(recorded(bag, image_topic(
                open_source(bag)))))
        observer.spin(1.5)  # one more report in /diagnostics
        totals = observer.totals()
        arrivals = {topic: seen.arrivals for topic, seen in observer.topics.items()}
        statuses = processes.stop(*processes.running)
    bad = {name: status for name, status in statuses.items() if status}
    if bad:
        raise RuntimeError(f'exit statuses {bad}; see {logs}')
    return Pass(messages, _figures(arrivals, totals, begin, end))


def _wait_ready(observer: Any, processes: Processes) -> None:
    inputs = (IMAGE, '/pairs', '/pairs/stabilised', '/pairs/aligned')

    def ready() -> bool:
        return all(observer.subscriptions(topic, node)
                   for topic, node in zip(inputs, STAGES, strict=True))
    _until(observer, processes, ready, START_UP, 'the nodes to be ready')


def _until(observer: Any, processes: Processes, condition: Any, timeout: float,
           what: str) -> None:
    met = observer.until(lambda: condition() or processes.ended(), timeout)
    ended = processes.ended()
    if ended is not None and not condition():
        raise RuntimeError(f'{ended.name} ended: {last_lines(ended)}')
    if not met:
        raise RuntimeError(f'waited in vain for {what}')


def _once(observer: Any, processes: Processes, say: Progress, frames: int) -> tuple[int, int]:
    depth = observer.topics[DEPTH].arrivals
    replay = processes.running['sphstereo']
    shown = 0
    while replay.status is None:
        observer.spin(0.2)
        if len(depth) >= shown + 5:
            shown = len(depth)
            say(f'depth of {shown} of {frames} frames')
    if replay.status:
        raise RuntimeError(f'replay failed: {last_lines(replay)}')
    del processes.running['sphstereo']
    clouds = observer.topics[CLOUD].arrivals
    observer.until(lambda: min(len(depth), len(clouds)) >= frames - 1, LAST_RESULT)
    images = observer.topics[IMAGE].arrivals
    return images[0][1] if images else 0, time.monotonic_ns()


def _loop(observer: Any, processes: Processes, seconds: float) -> tuple[int, int]:
    depth = observer.topics[DEPTH].arrivals
    _until(observer, processes, lambda: depth, START_UP, 'the first depth')
    begin = time.monotonic_ns()
    observer.spin(seconds)
    return begin, time.monotonic_ns()


def _figures(arrivals: Mapping[str, list[tuple[int, int]]], totals: dict[str, dict[str, int]],
             begin: int, end: int) -> dict[str, Any]:
    seconds = (end - begin) / 1e9
    inside = {topic: [(stamp, at) for stamp, at in arrivals[topic] if begin <= at < end]
              for topic in (IMAGE, DEPTH, CLOUD)}
    came = dict(arrivals[IMAGE])
    latency = [(at - came[stamp]) / 1e6 for stamp, at in inside[DEPTH] if stamp in came]
    drops: dict[str, dict[str, int]] = {}
    for part, counts in totals.items():
        causes = {c: n for c, n in counts.items() if n and c not in ('frames_in', 'frames_out')}
        if causes:
            drops[part] = causes
    return {'seconds': round(seconds, 2), 'frames_in': len(inside[IMAGE]),
            'depth_out': len(inside[DEPTH]), 'clouds_out': len(inside[CLOUD]),
            'rate_in_hz': _rate(inside[IMAGE]), 'rate_depth_hz': _rate(inside[DEPTH]),
            'latency_ms': numbers(latency), 'drops': drops}


def _rate(arrivals: list[tuple[int, int]]) -> float:
    """Messages a second from the first to the last; 0 for less than two."""
    if len(arrivals) < 2:
        return 0.0
    return round((len(arrivals) - 1) / (arrivals[-1][1] - arrivals[0][1]) * 1e9, 2)


def _decoded(data: bytes, topic: str) -> Any:
    return TYPESTORE.deserialize_cdr(data, RECORDED[topic])


def score(depths: Mapping[int, bytes], truths: Mapping[int, bytes]) -> dict[str, Any]:
    """Mean error of the depth images that have a true range of the same stamp."""
    scores = []
    for stamp in sorted(depths.keys() & truths.keys()):
        measured, truth = (read_depth(_decoded(data, DEPTH)) for data in (depths[stamp],
                                                                          truths[stamp]))
        if not isinstance(measured, Drop) and not isinstance(truth, Drop):
            scores.append(compare(measured, truth))
    return {'frames': len(scores), **(average(scores) if scores else {})}


def write_results(done: Pass, folder: Path) -> None:
    """Bag of results, previews beside their input, and the cloud of the last frame."""
    with McapOutput(folder / 'results.mcap') as output:
        stamped = [(stamp, topic, data) for topic, messages in done.messages.items()
                   for stamp, data in messages.items()]
        for stamp, topic, data in sorted(stamped):
            output.write_serialised(topic, RECORDED[topic], stamp, data)
    pictures = folder / 'previews'
    pictures.mkdir()
    for index, stamp in enumerate(sorted(done.messages[PREVIEW])):
        preview = decode_frame(_decoded(done.messages[PREVIEW][stamp], PREVIEW), 0, True)
        image = decode_frame(_decoded(done.messages[IMAGE][stamp], IMAGE), 0, True) \
            if stamp in done.messages[IMAGE] else Drop('missing')
        if isinstance(preview, Drop) or isinstance(image, Drop):
            continue
        cv2.imwrite(str(pictures / f'{index:04d}.png'), beside(image.colour, preview.colour))
    if done.messages[CLOUD]:
        cloud = read_cloud(_decoded(done.messages[CLOUD][max(done.messages[CLOUD])], CLOUD))
        if not isinstance(cloud, Drop):
            write_ply(folder / 'cloud.ply', cloud)


def write_page(results: Path, bag: Path, folder: Path) -> str:
    """Make the page of `sphstereo report`; returns what is to be said of it."""
    try:
        from sphstereo_ros.report.contents import Reading
        from sphstereo_ros.report.page import write_report
    except ModuleNotFoundError as error:
        return f'no report: there is no {error.name}'
    contents = Reading(open_source(results), [open_source(bag)]).read()
    page = write_report(contents, folder, f'{bag.name}, live',
                        f'sphstereo report {results} --input {bag} -o {folder}')[0]
    return f'open {page} in a browser'


def beside(image: Image8 | None, preview: Image8 | None) -> Image8:
    """Two BGR pictures side by side, the first at the size of the second."""
    assert image is not None
    assert preview is not None
    small = cv2.resize(image, preview.shape[1::-1], interpolation=cv2.INTER_AREA)
    return np.asarray(np.hstack([small, preview]), np.uint8)


def _line(name: str, figures: Mapping[str, Any]) -> str:
    latency = figures['latency_ms']
    return (f'{name:22}{figures["frames_in"]:8}{figures["depth_out"]:7}{figures["clouds_out"]:8}'
            f'{figures["rate_in_hz"]:9.1f}{figures["rate_depth_hz"]:9.1f}'
            f'{latency["p50"] or float("nan"):10.0f}{latency["p95"] or float("nan"):9.0f}')


def table(summary: Mapping[str, Any]) -> str:
    """The summary for people."""
    lines = [f'{"":22}{"frames":>8}{"depth":>7}{"clouds":>8}{"in Hz":>9}{"out Hz":>9}'
             f'{"p50 ms":>10}{"p95 ms":>9}',
             _line(f'slow ({SLOW:g} × real time)', summary['slow']),
             _line('looped in real time', summary['live']), '']
    for name in ('slow', 'live'):
        drops = [f'{part}: ' + ', '.join(f'{n} {cause}' for cause, n in causes.items())
                 for part, causes in summary[name]['drops'].items()]
        lines.append(f'drops, {name}: {"; ".join(drops) or "none"}')
    accuracy = summary['accuracy']
    lines += ['', f'range against the truth ({accuracy["frames"]} frames)',
              f'{"":10}{"coverage %":>12}{"median error %":>16}{"over 10 % wrong, %":>20}']
    for low, high in BANDS if accuracy['frames'] else ():
        scores = accuracy[f'{low:g}-{high:g}']
        values = [float('nan') if scores[key] is None else scores[key]
                  for key in ('coverage', 'median', 'bad')]
        lines.append(f'{f"{low:g}-{high:g} m":10}{values[0]:12.1f}{values[1]:16.2f}'
                     f'{values[2]:20.1f}')
    return '\n'.join(lines)


def run(arguments: argparse.Namespace) -> int:
    """Run the demonstration; returns the exit status."""
    say = Progress()
    bag, folder = arguments.bag, arguments.out
    truths, images = recorded(bag, TRUTH), recorded(bag, IMAGE)
    if not images:
        raise BadInput(f'{bag}: no images on {IMAGE}')
    if folder.exists():
        shutil.rmtree(folder)
    folder.mkdir(parents=True)
    parameters = ['--params-file', str(arguments.params or shipped('config/live.yaml')),
                  '-p', 'baseline.source:=odometry']
    say(f'{bag}: {len(images)} frames; starting the nodes')
    slow = play(bag, [*parameters, *(w for p in COLOURS for w in ('-p', p))],
                folder / 'logs' / 'slow', say, SLOW)
    write_results(slow, folder)
    say('starting the nodes again')
    live = play(bag, parameters, folder / 'logs' / 'live', say, 1.0, arguments.seconds)
    missing = sorted(images.keys() - slow.messages[DEPTH].keys())[1:]
    summary = {'slow': slow.figures, 'live': live.figures,
               'accuracy': score(slow.messages[DEPTH], truths),
               'slow_frames_without_depth': len(missing)}
    (folder / 'summary.json').write_text(json.dumps(summary, indent=1) + '\n')
    (folder / 'summary.txt').write_text(table(summary) + '\n')
    said = write_page(folder / 'results.mcap', bag, folder / 'report')
    say(f'results are in {folder}/; {said}\n\n{table(summary)}')
    if missing or len(slow.messages[DEPTH]) < len(images) - 1:
        print(f'\nFAILED: {len(missing)} frames beside the first have no depth', file=sys.stderr)
        return 1
    return 0


def main() -> int:
    """Run as a command; returns its exit status."""
    parser = argparse.ArgumentParser(prog='demo', description='a recording through the live nodes')
    parser.add_argument('bag', type=Path)
    parser.add_argument('--out', type=Path, default=Path('out'), help='emptied before')
    parser.add_argument('--params', type=Path, metavar='FILE', help='(default: config/live.yaml)')
    parser.add_argument('--seconds', type=float, default=15.0, help='of the real-time pass')
    arguments = parser.parse_args()
    interrupt_on_signals()
    try:
        return run(arguments)
    except (BadInput, ParameterError) as error:
        print(f'demo: {error}', file=sys.stderr)
        return 2
    except RuntimeError as error:
        print(f'demo: FAILED: {error}', file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        return 130


if __name__ == '__main__':
    sys.exit(main())
