"""The live benchmark and the demonstration: figures, processes, files."""
from __future__ import annotations

import argparse
import fcntl
import json
import math
import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from sphstereo_ros.bench import live, processes
from sphstereo_ros.bench.live import CLOUD, DEPTH, Usage, flow, node_arguments
from sphstereo_ros.bench.processes import Processes, numbers
from sphstereo_ros.core.frames import FrameKey, PointCloud
from sphstereo_ros.replay.ply import write_ply
from sphstereo_ros.replay.records import BadInput

SAMPLE = Path(__file__).resolve().parent.parent / 'bags' / 'street.mcap'
MS = 1_000_000


def sleeper(*words: str) -> list[str]:
    return [sys.executable, '-c', 'import signal, sys, time\n' + '\n'.join(words)
            + '\nprint("up", flush=True)\ntime.sleep(60)']


def until_up(process: processes.Process) -> None:
    while 'up' not in process.log.read_text():
        assert process.status is None


def test_flow_counts_what_is_inside_the_window() -> None:
    sent = [0, 100 * MS, 200 * MS, 300 * MS, 400 * MS]
    depth = [(0, 50 * MS), (100 * MS, 120 * MS), (200 * MS, 240 * MS), (300 * MS, 450 * MS)]
    result = flow(sent, {DEPTH: depth, CLOUD: depth[1:2]}, (100 * MS, 400 * MS))
    assert (result['sent'], result['rate_in']) == (3, 10.0)
    assert (result['depth_out'], result['rate_depth']) == (2, 6.67)
    assert result['depth_latency_ms'] == {'p50': 40.0, 'p95': 40.0}
    assert result['cloud_latency_ms'] == {'p50': 20.0, 'p95': 20.0}
    assert flow(sent, {DEPTH: [], CLOUD: []}, (0, MS))['depth_latency_ms']['p50'] is None


def test_frames_without_depth_are_counted_once_they_had_time() -> None:
    sent = [k * 500 * MS for k in range(8)]
    depth = [(stamp, stamp + 900 * MS) for stamp in sent if stamp not in (sent[1], sent[2])]
    result = flow(sent, {DEPTH: depth, CLOUD: []}, (sent[1], sent[7]))
    # Of the last second nothing is held against the nodes.
    assert (result['sent'], result['without_depth']) == (6, 2)
    assert flow(sent, {DEPTH: depth[:1], CLOUD: []}, (0, sent[7]))['without_depth'] == 4


def test_cpu_is_that_of_the_nodes_alone() -> None:
    result = {'seconds': 10.0, 'depth_out': 50, 'processes': {
        'camera': {'cpu_percent': 90.0}, 'a': {'cpu_percent': 30.0}, 'b': {'cpu_percent': 20.0}}}
    assert live.cpu_per_depth(result) == 100.0
    assert live.cpu_per_depth({**result, 'depth_out': 0}) is None


def test_numbers_are_those_of_the_values() -> None:
    assert numbers(list(range(100))) == {'p50': 50, 'p95': 95}
    assert numbers([3.14159], 2) == {'p50': 3.14, 'p95': 3.14}


def test_growth_is_of_the_second_half() -> None:
    seconds = [float(t) for t in range(9)]
    usage = Usage(seconds, [10.0, 20, 30, 40, 50, 51, 52, 53, 54], [t / 2 for t in seconds])
    assert usage.summary() == {'memory_start_mb': 10.0, 'memory_end_mb': 54.0,
                               'growth_mb_per_min': 60.0, 'cpu_percent': 50.0}


@pytest.mark.parametrize(('overrides', 'length'), [
    ([], ['-p', 'baseline.length:=0.28']),
    (['stereo.matcher:=bm'], ['-p', 'baseline.length:=0.28']),
    (['baseline.source:=odometry'], [])])
def test_a_given_baseline_is_kept(overrides: list[str], length: list[str]) -> None:
    words = node_arguments([Path('a.yaml')], overrides)
    assert words == ['--params-file', 'a.yaml', *length,
                     *(w for o in overrides for w in ('-p', o))]


def test_all_processes_end_whatever_happened(tmp_path: Path,
                                             monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(processes, 'PATIENCE', 1.0)
    started: list[processes.Process] = []

    def work() -> None:
        with Processes(tmp_path) as running:
            started.append(running.start('polite', *sleeper()))
            started.append(running.start('deaf', *sleeper('signal.signal(2, signal.SIG_IGN)')))
            for process in started:
                until_up(process)
            raise RuntimeError('in the midst')
    with pytest.raises(RuntimeError, match='in the midst'):
        work()
    assert [process.status for process in started] == [-signal.SIGINT, -signal.SIGKILL]


def test_an_ended_process_is_told(tmp_path: Path) -> None:
    with Processes(tmp_path) as running:
        up = running.start('up', *sleeper())
        down = running.start('down', sys.executable, '-c', 'print("why"); raise SystemExit(3)')
        assert down.wait(20) == 3
        assert running.ended() is down
        assert live.last_lines(down) == 'why'
        memory, cpu = up.usage()
        assert memory > 1
        assert cpu >= 0
        running.kill('down')
        assert running.ended() is None


def test_processes_end_with_the_one_that_started_them(tmp_path: Path) -> None:
    script = ('import os, sys, pathlib; from sphstereo_ros.bench.processes import Processes\n'
              f'p = Processes(pathlib.Path({str(tmp_path)!r}))\n'
              f'c = p.start("child", *{sleeper()!r})\n'
              'while "up" not in c.log.read_text(): pass\n'
              'print(c._popen.pid, flush=True); os.kill(os.getpid(), 9)')
    ended = subprocess.run([sys.executable, '-c', script], stdout=subprocess.PIPE, check=False,
                           timeout=60)
    assert ended.returncode == -signal.SIGKILL
    child = int(ended.stdout)
    for _ in range(10_000_000):
        try:
            state = Path(f'/proc/{child}/stat').read_text().rpartition(')')[2].split()[0]
        except FileNotFoundError:
            return
        if state == 'Z':
            return
    pytest.fail('the child lives on')


def test_only_abandoned_shared_memory_is_found(tmp_path: Path,
                                               monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(processes, '_SHARED_MEMORY', tmp_path)
    names = ('fastrtps_used', 'fastrtps_left', 'fastrtps_port7400')
    for name in names:
        (tmp_path / name).touch()
        (tmp_path / f'{name}_el').touch()
    with (tmp_path / 'fastrtps_used_el').open('rb') as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        assert processes._abandoned_segments() == {tmp_path / 'fastrtps_left'}


def test_shared_memory_left_by_others_before_stays(tmp_path: Path,
                                                   monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(processes, '_SHARED_MEMORY', tmp_path)

    def leave(name: str) -> None:
        (tmp_path / name).touch()
        (tmp_path / f'{name}_el').touch()
    leave('fastrtps_before')
    with Processes(tmp_path / 'logs'):
        leave('fastrtps_since')
    assert sorted(p.name for p in tmp_path.glob('fastrtps_*')) == ['fastrtps_before',
                                                                   'fastrtps_before_el']


def test_unknown_command_is_bad_input(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(BadInput, match='no_such_node'):
        processes.command('no_such_node')


def test_command_of_a_ros_installation_is_found(tmp_path: Path,
                                                monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / 'lib' / 'sphstereo_ros' / 'some_node'
    path.parent.mkdir(parents=True)
    path.touch()
    monkeypatch.setenv('AMENT_PREFIX_PATH', os.pathsep.join(['', str(tmp_path)]))
    assert processes.command('some_node') == str(path)
    assert processes.shipped('config/live.yaml').is_file()
    with pytest.raises(BadInput, match='config/nothing'):
        processes.shipped('config/nothing.yaml')


@pytest.mark.parametrize('coloured', [False, True])
def test_ply_holds_the_cloud(tmp_path: Path, coloured: bool) -> None:
    xyz = np.array([[1, 2, 3], [-4, 5.5, 6]], np.float32)
    sigma = np.array([0.5, 0.25], np.float32)
    bgr = np.array([[1, 2, 3], [4, 5, 6]], np.uint8)
    path = tmp_path / 'a.ply'
    write_ply(path, PointCloud(FrameKey(0, 'c'), xyz, sigma, bgr=bgr) if coloured else
              PointCloud(FrameKey(0, 'c'), xyz, sigma, np.array([7, 9], np.uint8)))
    header, _, body = path.read_bytes().partition(b'end_header\n')
    lines = header.decode().split('\n')
    assert lines[:3] == ['ply', 'format binary_little_endian 1.0', 'element vertex 2']
    assert [line.split()[1:] for line in lines[3:-1]] == [
        *(['float', a] for a in 'xyz'), *(['uchar', c] for c in ('red', 'green', 'blue')),
        ['float', 'sigma']]
    points = np.frombuffer(body, np.dtype([('xyz', '<f4', 3), ('rgb', 'u1', 3), ('s', '<f4')]))
    np.testing.assert_array_equal(points['xyz'], xyz)
    np.testing.assert_array_equal(points['s'], sigma)
    np.testing.assert_array_equal(points['rgb'], bgr[:, ::-1] if coloured else
                                  [[7, 7, 7], [9, 9, 9]])


def test_camera_messages_are_the_frames() -> None:
    pytest.importorskip('rclpy')
    from rclpy.serialization import deserialize_message
    from sensor_msgs.msg import CompressedImage, Image

    from sphstereo_ros.bench.camera import messages
    from sphstereo_ros.ros.conversions import decode_frame
    grey = np.random.default_rng(1).integers(0, 256, (2, 60, 120), np.uint8)
    smooth = np.full((1, 60, 120, 3), 90, np.uint8)
    for message, frame in zip(messages(grey, 'mono8'), grey, strict=True):
        np.testing.assert_array_equal(
            decode_frame(deserialize_message(bytes(message), Image)).image, frame)
    picture, = messages(smooth, 'jpeg')
    decoded = decode_frame(deserialize_message(bytes(picture), CompressedImage))
    np.testing.assert_allclose(decoded.image, 90, atol=2)


def test_camera_leaves_late_frames_out() -> None:
    pytest.importorskip('rclpy')
    from sphstereo_ros.bench import camera

    class Publisher:
        """Takes so long for each that half the rate is left; then Ctrl-C."""

        def __init__(self) -> None:
            self.stamps: list[int] = []

        def publish(self, data: bytes) -> None:
            sec, nanosec = np.frombuffer(data, '<u4', 2, 4)
            self.stamps.append(int(sec) * 10**9 + int(nanosec))
            if len(self.stamps) == 5:
                raise KeyboardInterrupt
            end = camera.time.monotonic() + 0.02
            while camera.time.monotonic() < end:
                pass
    publisher = Publisher()
    import rclpy
    rclpy.init(domain_id=99)
    try:
        sent = camera.play([(publisher, [bytearray(16)])], 100.0)
    finally:
        rclpy.shutdown()
    assert sent == publisher.stamps[:4]
    assert min(np.diff(publisher.stamps)) >= 19 * MS


def test_two_cameras_send_apart() -> None:
    pytest.importorskip('rclpy')
    import rclpy

    from sphstereo_ros.bench import camera
    sent: list[tuple[str, int]] = []

    class Publisher:
        """Notes what it sends; Ctrl-C after four pairs."""

        def __init__(self, name: str) -> None:
            self.name = name

        def publish(self, data: bytes) -> None:
            sec, nanosec = np.frombuffer(data, '<u4', 2, 4)
            sent.append((self.name, int(sec) * 10**9 + int(nanosec)))
            if len(sent) == 8:
                raise KeyboardInterrupt
    rclpy.init(domain_id=99)
    try:
        wanted = iter([0.02, -0.01, 0.02, -0.01])
        stamps = camera.play([(Publisher('bottom'), [bytearray(16)]),
                              (Publisher('top'), [bytearray(16)])], 20.0, lambda: next(wanted))
    finally:
        rclpy.shutdown()
    assert [name for name, _ in sent] == 2 * ['bottom', 'top', 'top', 'bottom']
    assert stamps == [stamp for name, stamp in sent if name == 'bottom'][:len(stamps)]
    gaps = np.diff([stamp for _, stamp in sent])[::2]
    np.testing.assert_array_equal(gaps, np.array([20, 10, 20, 10]) * MS)


def test_demonstration_scores_what_came_against_the_truth() -> None:
    pytest.importorskip('rclpy')
    from sphstereo_ros.bench import demo
    from sphstereo_ros.replay.bag_messages import TYPESTORE, make
    from sphstereo_ros.ros.conversions import depth_message

    def image(value: float) -> bytes:
        depth = np.full((30, 60), value, np.float32)
        message = depth_message(make, FrameKey(1, 'c'), depth)
        return bytes(TYPESTORE.serialize_cdr(message, 'sensor_msgs/msg/Image'))
    scores = demo.score({1: image(5.5), 2: image(8.0), 3: image(1.0)},
                        {1: image(5.0), 2: image(4.0), 4: image(1.0)})
    assert scores['frames'] == 2
    assert scores['0-10']['coverage'] == pytest.approx(100)
    assert scores['0-10']['median'] == pytest.approx((10 + 100) / 2)
    assert scores['10-30']['median'] is None
    assert demo.score({}, {}) == {'frames': 0}


TWO = '-p pairing.mode:=binocular'


@pytest.mark.parametrize('wrong', ['--rate 0', '--height 10', '--seconds 0', '-p no.such:=1',
                                   '--apart 5', f'{TWO} --apart 60 --jitter 7',
                                   f'{TWO} --jitter -1'])
def test_bad_options_are_refused_before_anything_starts(
        wrong: str, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip('rclpy')
    monkeypatch.setattr(live, '_run', lambda *_: pytest.fail('started'))
    parser = argparse.ArgumentParser()
    parser.add_argument('--json', action='store_true')
    live.add_arguments(parser)
    with pytest.raises(ValueError, match=r'--rate|no\.such|--apart'):
        live.main(parser.parse_args(wrong.split()))


def test_live_bench_measures_the_nodes() -> None:
    pytest.importorskip('rclpy')
    pytest.importorskip('pymavlink')
    if not SAMPLE.exists():
        pytest.skip('no sample bag')
    done = subprocess.run(
        [sys.executable, '-m', 'sphstereo_ros.cli', 'bench', 'live', '--bag', str(SAMPLE),
         '--height', '240', '--rate', '4', '--seconds', '3', '--chain', 'pipeline', '--json',
         '-p', 'stereo.working_height:=240'],
        stdout=subprocess.PIPE, timeout=120, check=True)
    result = json.loads(done.stdout.decode().splitlines()[-1])
    assert 11 <= result['sent'] <= 13
    assert 0 < result['depth_out'] <= 14
    assert 0 < result['depth_latency_ms']['p50'] < 5000
    # As many as there are depth images, but for one under way at either end.
    assert abs(result['mavlink_out'] - result['depth_out']) <= 2
    assert 0 < result['mavlink_latency_ms']['p50'] < 5000
    assert result['stages']['pipeline: frame_pairing']['frames_in'] > 0
    assert result['processes']['pipeline']['memory_end_mb'] > 50
    assert result['restart']['node'] == 'pipeline'
    assert math.isfinite(result['restart']['subscribed_to_depth_s'])
    assert result['exit_statuses'] == {'pipeline': 0}


def test_live_bench_measures_two_cameras() -> None:
    pytest.importorskip('rclpy')
    pair = SAMPLE.with_name('binocular.mcap')
    if not pair.exists():
        pytest.skip('no sample bag')
    known = [f'camera.top.{axis}:={np.radians(angle)}'
             for axis, angle in (('roll', 2.0), ('pitch', -1.5), ('yaw', 3.0))]
    done = subprocess.run(
        [sys.executable, '-m', 'sphstereo_ros.cli', 'bench', 'live', '--bag', str(pair),
         '--height', '240', '--rate', '4', '--seconds', '3', '--chain', 'pipeline', '--json',
         '--apart', '20', '--jitter', '4', '--no-obstacles', '--no-restart',
         '--params', str(SAMPLE.parents[1] / 'config' / 'binocular_live.yaml'),
         *(word for name in (*known, 'stereo.working_height:=240', 'calibration.pairs:=0')
           for word in ('-p', name))],
        stdout=subprocess.PIPE, timeout=120, check=True)
    *table, line = done.stdout.decode().splitlines()
    result = json.loads(line)
    assert result['cameras'] == 2
    assert 11 <= result['sent'] <= 13
    assert 0 < result['depth_out'] <= 14
    pairing = result['stages']['pipeline: frame_pairing']
    # Both cameras' frames, but for one under way at either end.
    assert abs(pairing['frames_in'] - 2 * pairing['frames_out']) <= 4
    assert result['cpu_ms_per_depth'] > 1
    assert table[0].startswith('pipeline: pairs of 480×240 mono8, stamps 20 ± 4 ms apart')


def test_the_table_of_the_demonstration_has_the_bands() -> None:
    pytest.importorskip('rclpy')
    from sphstereo_ros.bench import demo
    from sphstereo_ros.bench.scoring import average, compare

    truth = np.full((32, 64), 5.0)
    figures = {'frames_in': 20, 'depth_out': 19, 'clouds_out': 19, 'rate_in_hz': 6.0,
               'rate_depth_hz': 6.0, 'latency_ms': {'p50': 60.0, 'p95': None}, 'drops': {}}
    accuracy = {'frames': 1, **average([compare(1.02 * truth, truth)])}
    text = demo.table({'slow': figures, 'live': figures, 'accuracy': accuracy})
    band = next(line for line in text.splitlines() if line.startswith('0-10 m'))
    assert band.split()[2:] == ['100.0', '2.00', '0.0']
    assert '0-10 m' not in demo.table({'slow': figures, 'live': figures,
                                       'accuracy': demo.score({}, {})})
