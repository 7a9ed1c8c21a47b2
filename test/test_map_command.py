from __future__ import annotations

import gc
import os
import resource
import signal
import subprocess
import sys
import time
import tracemalloc
import wave
from pathlib import Path

import cv2
import numpy as np
import pytest
import room
from making_bags import write_bag, write_video

from sphstereo_ros import cli
from sphstereo_ros.core.config import resolve
from sphstereo_ros.core.frames import Frame, FrameKey, PointCloud
from sphstereo_ros.core.rotations import exp
from sphstereo_ros.replay import map_cluster, map_run
from sphstereo_ros.replay.bag_messages import make
from sphstereo_ros.replay.map_chunks import Division, Recording, chunks_of
from sphstereo_ros.replay.map_files import load_cloud, save_cloud, track_lines
from sphstereo_ros.replay.records import BadInput
from sphstereo_ros.replay.sources import open_source
from sphstereo_ros.replay.submap_files import load_chunk
from sphstereo_ros.ros import conversions as convert

STEP, HEIGHT, COUNT = 0.1, 120, 21
CHUNK, LEAD = 8, 4
FAST = ('-p', 'stereo.matcher:=bm', '-p', 'mapping.min_frames:=2', '-p',
        'mapping.max_relative_sigma:=0.1', '-p', 'mapping.max_sigma:=1.0')
# The command with short chunks, in a process of its own.
CODE = ('import sys; from sphstereo_ros.cli import main, map; from sphstereo_ros.replay import '
        f'map_run; map_run.LEAD = map.LEAD = {LEAD}; sys.exit(main(sys.argv[1:]))')


@pytest.fixture(autouse=True)
def _short_chunks(monkeypatch):
    from sphstereo_ros.cli import map as command
    monkeypatch.setattr(map_run, 'LEAD', LEAD)
    monkeypatch.setattr(command, 'LEAD', LEAD)


def odometry(stamp: int, x: float):
    message = make('nav_msgs/msg/Odometry', header=convert.header(make, FrameKey(stamp, 'odom')))
    message.pose.pose.position.x = x
    message.pose.pose.position.y = 7.0
    return message


@pytest.fixture(scope='module')
def bag(tmp_path_factory):
    """A drive through a room, with odometry that starts at (0, 7, 0)."""
    messages = []
    for k, frame in enumerate(room.forward(COUNT, STEP, HEIGHT)):
        messages += [('/odometry', frame.key.stamp, odometry(frame.key.stamp, STEP * k)),
                     ('/image', frame.key.stamp, convert.frame_message(make, frame))]
    return write_bag(tmp_path_factory.mktemp('room') / 'bag', messages)


def command(*words: object) -> int:
    try:
        return cli.main(['map', *(str(word) for word in words)])
    except SystemExit as end:
        return int(str(end.code))


def mapped(bag: Path, out: Path, *words: object) -> int:
    return command(bag, '--out', out, '--chunk', CHUNK, *FAST, *words)


@pytest.fixture(scope='module')
def whole(bag, tmp_path_factory):
    """The map of an undisturbed run."""
    out = tmp_path_factory.mktemp('whole') / 'map.ply'
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(map_run, 'LEAD', LEAD)
        from sphstereo_ros.cli import map as module
        patch.setattr(module, 'LEAD', LEAD)
        assert mapped(bag, out) == 0
    return out


# Files

def cloud(count: int = 50) -> PointCloud:
    rng = np.random.default_rng(1)
    return PointCloud(FrameKey(5, 'odom'), rng.uniform(-20, 20, (count, 3)).astype(np.float32),
                      rng.uniform(0.01, 1, count).astype(np.float32),
                      bgr=rng.integers(0, 256, (count, 3), np.uint8))


@pytest.mark.parametrize(('suffix', 'step'), [('.ply', 0), ('.pcd', 0), ('.las', 1e-4)])
def test_clouds_come_back_from_files(tmp_path, suffix, step):
    path, given = tmp_path / f'cloud{suffix}', cloud()
    save_cloud(path, given)
    read = load_cloud(path)
    np.testing.assert_allclose(read.xyz, given.xyz, atol=0.51 * step + 1e-5 * bool(step))
    np.testing.assert_array_equal(read.sigma, given.sigma)
    np.testing.assert_array_equal(read.bgr, given.bgr)
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


@pytest.mark.parametrize('suffix', ['.ply', '.pcd', '.las'])
def test_a_broken_cloud_is_refused(tmp_path, suffix):
    path = tmp_path / f'cloud{suffix}'
    path.write_bytes(b'no cloud at all')
    with pytest.raises(BadInput, match='no cloud'):
        load_cloud(path)


def test_what_a_file_needs_is_said(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, 'laspy', None)
    with pytest.raises(BadInput, match="laspy: the extra 'map'"):
        save_cloud(tmp_path / 'cloud.las', cloud())
    with pytest.raises(BadInput, match=r'\.ply, \.pcd, \.las'):
        save_cloud(tmp_path / 'cloud.xyz', cloud())


def test_a_track_is_what_evo_reads(tmp_path):
    from evo.core import metrics
    from evo.tools import file_interface
    rng = np.random.default_rng(2)
    stamps = [1_700_000_000_123_456_789 + k * 33_333_333 for k in range(20)]
    places = rng.uniform(-5, 5, (20, 3))
    turns = [exp(rng.normal(size=3)) for _ in stamps]
    paths = []
    for n, offset in enumerate(([0, 0, 0], [0.3, 0, 0.4])):
        paths.append(tmp_path / f'{n}.tum')
        paths[-1].write_text(track_lines(stamps, turns, list(places + offset)))
    one, other = (file_interface.read_tum_trajectory_file(str(path)) for path in paths)
    np.testing.assert_allclose(one.poses_se3[3][:3, :3], turns[3], atol=1e-6)
    np.testing.assert_allclose(one.timestamps[5], stamps[5] * 1e-9, atol=1e-6)
    error = metrics.APE(metrics.PoseRelation.translation_part)
    error.process_data((one, other))
    assert error.get_statistic(metrics.StatisticsType.rmse) == pytest.approx(0.5, abs=1e-6)


# The command

def test_a_map_and_its_track(whole, capsys):
    from evo.core import metrics
    from evo.core.trajectory import PoseTrajectory3D
    from evo.tools import file_interface
    read = load_cloud(whole)
    assert len(read.xyz) > 2000
    # In `odom`: x ahead, y left, z up; the camera starts at (0, 7, 0).
    axes = read.xyz @ np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0]]) + [7, 0, 0]
    walls = np.minimum(np.abs(axes - room.LOW), np.abs(axes - room.HIGH)).min(axis=1)
    assert np.percentile(walls, 80) < 0.1
    track = file_interface.read_tum_trajectory_file(str(whole.with_suffix('.tum')))
    assert track.num_poses == COUNT
    truth = PoseTrajectory3D(np.array([[STEP * k, 7.0, 0.0] for k in range(COUNT)]),
                             np.tile([1.0, 0, 0, 0], (COUNT, 1)), track.timestamps)
    error = metrics.APE(metrics.PoseRelation.translation_part)
    error.process_data((truth, track))
    assert error.get_statistic(metrics.StatisticsType.max) < 0.01 * STEP * COUNT
    assert sorted(p.name for p in whole.parent.iterdir()) == ['map.ply', 'map.tum']


def start(bag: Path, out: Path, *words: str, code: str = CODE) -> subprocess.Popen[bytes]:
    return subprocess.Popen([sys.executable, '-c', code, 'map', str(bag), '--out', str(out),
                             '--chunk', str(CHUNK), *FAST, *words], stdout=subprocess.PIPE,
                            stderr=subprocess.PIPE)


def test_a_killed_run_goes_on_and_ends_in_the_same_map(bag, whole, tmp_path, monkeypatch):
    out = tmp_path / 'map.ply'
    parts = out.with_name('map.ply.parts')
    process = start(bag, out)
    deadline = time.monotonic() + 120
    while not list(parts.glob('input_*.npz')):
        assert process.poll() is None, process.stderr.read()
        assert time.monotonic() < deadline
        os.sched_yield()
    process.send_signal(signal.SIGKILL)
    process.wait()
    finished = {p.name: p.stat().st_mtime_ns for p in parts.glob('input_*.npz')}
    assert 0 < len(finished) < 3
    assert not out.exists()
    kept = []
    monkeypatch.setattr(map_run, 'load_chunk', lambda path: (
        kept.append((path.name, path.stat().st_mtime_ns)), load_chunk(path))[1])
    assert mapped(bag, out) == 0
    assert finished.items() <= set(kept)
    assert out.read_bytes() == whole.read_bytes()
    assert out.with_suffix('.tum').read_bytes() == whole.with_suffix('.tum').read_bytes()
    assert not parts.exists()


def test_other_parameters_start_anew(bag, tmp_path, monkeypatch, capsys):
    out = tmp_path / 'map.ply'
    monkeypatch.setattr(map_run.MapRun, 'join', lambda self: (_ for _ in ()).throw(BadInput('x')))
    assert mapped(bag, out) == 2
    parts = out.with_name('map.ply.parts')
    before = {p.name: p.stat().st_mtime_ns for p in parts.glob('*.npz')}
    assert len(before) == 3
    assert mapped(bag, out) == 2
    assert {p.name: p.stat().st_mtime_ns for p in parts.glob('*.npz')} == before
    assert mapped(bag, out, '-p', 'mapping.voxel:=0.1') == 2
    after = {p.name: p.stat().st_mtime_ns for p in parts.glob('*.npz')}
    assert all(after[name] != before[name] for name in before)


def test_a_folder_of_something_else_is_left_alone(bag, tmp_path, capsys):
    parts = tmp_path / 'map.ply.parts'
    parts.mkdir()
    (parts / 'thesis.txt').write_text('three years')
    assert mapped(bag, tmp_path / 'map.ply') == 2
    assert 'in the way' in capsys.readouterr().err
    assert (parts / 'thesis.txt').read_text() == 'three years'


def test_no_room_is_said_and_finished_chunks_stay(bag, tmp_path, capsys):
    out = tmp_path / 'map.ply'
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, hard))
    try:
        assert mapped(bag, out) == 2
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    error = capsys.readouterr().err.strip().splitlines()
    assert len(error) == 1
    assert error[0].startswith('sphstereo map: cannot write ')
    assert [p.name for p in out.with_name('map.ply.parts').iterdir()] == ['job.json']
    assert mapped(bag, out) == 0


def bad_inputs(folder: Path) -> dict[str, Path]:
    names = ('missing', 'zero.mp4', 'cut.mp4', 'portrait.mp4', 'audio.mp4')
    files = {name: folder / name for name in names}
    files['zero.mp4'].touch()
    good = write_video(folder / 'good.mp4').read_bytes()
    files['cut.mp4'].write_bytes(good[:len(good) // 2])
    write_video(files['portrait.mp4'], sizes=(64, 128))
    with wave.open(str(files['audio.mp4']), 'wb') as sound:
        sound.setnchannels(1)
        sound.setsampwidth(2)
        sound.setframerate(8000)
        sound.writeframes(bytes(16000))
    return files


@pytest.mark.parametrize('name', ['missing', 'zero.mp4', 'cut.mp4', 'portrait.mp4', 'audio.mp4'])
def test_input_that_is_none_is_one_line(tmp_path, name, capfd):
    path = bad_inputs(tmp_path)[name]
    assert command(path, '--out', tmp_path / 'map.ply', '-p', 'baseline.speed:=3.0') == 2
    told = capfd.readouterr()
    assert told.out == ''
    assert len(told.err.splitlines()) == 1
    assert told.err.startswith('sphstereo map: ')
    assert name in told.err
    assert not (tmp_path / 'map.ply').exists()


def test_what_was_read_of_a_truncated_video_is_mapped_and_it_is_said(tmp_path, capfd):
    whole = tmp_path / 'whole.avi'
    writer = cv2.VideoWriter(str(whole), cv2.VideoWriter_fourcc(*'MJPG'), 30.0,
                             (2 * HEIGHT, HEIGHT))
    for frame in room.forward(COUNT, STEP, HEIGHT):
        writer.write(cv2.cvtColor(frame.image, cv2.COLOR_GRAY2BGR))
    writer.release()
    cut, out = tmp_path / 'cut.avi', tmp_path / 'map.ply'
    cut.write_bytes(whole.read_bytes()[:int(0.7 * whole.stat().st_size)])
    assert mapped(cut, out, '-p', f'baseline.speed:={30 * STEP}') == 2
    told = capfd.readouterr().err.splitlines()
    assert len(told) == 1
    assert 'broken off after' in told[0]
    track = np.loadtxt(out.with_suffix('.tum'))
    assert 10 <= len(track) < COUNT
    np.testing.assert_allclose(track[:, 1], STEP * np.arange(len(track)), atol=0.05)
    assert len(load_cloud(out).xyz) > 1000


def test_without_scale_it_is_refused(tmp_path, capsys):
    video = write_video(tmp_path / 'video.mp4')
    assert command(video, '--out', tmp_path / 'map.ply') == 2
    assert 'baseline.speed' in capsys.readouterr().err


def test_bad_usage_is_refused(bag, tmp_path, capsys):
    assert command(bag, '--out', tmp_path / 'map.obj') == 2
    assert command(bag, '--out', bag) == 2
    assert command(bag, '--out', tmp_path / 'a.ply', '--chunk', 3) == 2
    assert command(bag, '--out', tmp_path / 'a.ply', '-p', 'pairing.mode:=binocular') == 2
    assert command(bag, '--out', tmp_path / 'none' / 'a.ply', *FAST) == 2
    assert command() == 2


def test_two_stills_make_a_map_and_an_empty_one_is_refused(tmp_path, capsys):
    frames = room.forward(2, STEP, HEIGHT)
    bag = write_bag(tmp_path / 'bag', [('/image', frame.key.stamp, convert.frame_message(
        make, frame)) for frame in frames])
    out, known = tmp_path / 'map.ply', ('-p', f'baseline.length:={STEP}')
    assert command(bag, '--out', out, *FAST, *known) == 2
    error = capsys.readouterr().err.splitlines()
    assert len(error) == 1
    assert 'mapping.min_frames' in error[0]
    assert not list(tmp_path.glob('map*'))
    assert command(bag, '--out', out, *FAST, *known, '-p', 'mapping.min_frames:=1') == 0
    assert len(load_cloud(out).xyz) > 500
    np.testing.assert_allclose(np.loadtxt(out.with_suffix('.tum'))[:, 1], [0, STEP], atol=1e-6)


def test_two_stills_from_beside_each_other_make_a_map(tmp_path):
    """The way is across the picture: to the right."""
    bag = write_bag(tmp_path / 'bag', [('/image', key.stamp, convert.frame_message(
        make, Frame(key, room.view(np.array([3 * STEP * k, 0, 0]), np.eye(3), HEIGHT)[0])))
        for k, key in enumerate(FrameKey(10**9 + k * 10**8, 'camera') for k in range(2))])
    out = tmp_path / 'map.ply'
    assert command(bag, '--out', out, *FAST, '-p', f'baseline.length:={3 * STEP}', '-p',
                   'mapping.min_frames:=1') == 0
    np.testing.assert_allclose(np.loadtxt(out.with_suffix('.tum'))[1, 1:4], [0, -3 * STEP, 0],
                               atol=0.01)
    assert len(load_cloud(out).xyz) > 500


def test_why_there_is_no_map_is_told(tmp_path, capsys):
    """The same still twice."""
    image = room.forward(1, STEP, HEIGHT)[0].image
    bag = write_bag(tmp_path / 'bag', [('/image', key.stamp, convert.frame_message(
        make, Frame(key, image))) for key in (FrameKey(10**9, 'a'), FrameKey(2 * 10**9, 'a'))])
    assert command(bag, '--out', tmp_path / 'map.ply', '-p', 'baseline.length:=1.0') == 2
    error = capsys.readouterr().err.splitlines()
    assert len(error) == 1
    assert error[0].startswith('sphstereo map: no frame could be placed: no_parallax: ')
    assert 'first_frame' not in error[0]


def test_several_inputs_become_one_map(tmp_path, whole):
    """Two halves of one drive, as two bags."""
    frames = room.forward(COUNT, STEP, HEIGHT)
    halves = []
    for n, part in enumerate((slice(0, 11), slice(11, COUNT))):
        messages = []
        for k, frame in list(enumerate(frames))[part]:
            messages += [('/odometry', frame.key.stamp, odometry(frame.key.stamp, STEP * k)),
                         ('/image', frame.key.stamp, convert.frame_message(make, frame))]
        halves.append(write_bag(tmp_path / f'bag{n}', messages))
    out = tmp_path / 'map.ply'
    assert command(*halves, '--out', out, '--chunk', CHUNK, *FAST) == 0
    track = np.loadtxt(out.with_suffix('.tum'))
    assert len(track) == COUNT
    np.testing.assert_allclose(track[:, 1], STEP * np.arange(COUNT), atol=0.03)


def test_one_chunk_after_the_other_keeps_no_more(bag):
    """Not one of the frames that went by."""
    config = resolve({'stereo.matcher': 'bm', 'baseline.source': 'odometry',
                      'mapping.max_points': 10_000})
    sizes = []
    tracemalloc.start()
    for _ in chunks_of(Recording(bag, open_source(bag), '/image'), config, Division(6, LEAD),
                       lambda _: True):
        gc.collect()
        sizes.append(tracemalloc.get_traced_memory()[0])
    tracemalloc.stop()
    frame = 2 * HEIGHT * HEIGHT
    assert len(sizes) == 4  # the last one is half as long
    assert sizes[2] - sizes[1] < 3 * frame, np.diff(sizes) / frame


# Many machines

def test_two_workers_make_the_same_map(bag, whole, tmp_path):
    """All of it: the command itself makes no chunk here."""
    pytest.importorskip('distributed')
    out = tmp_path / 'map.ply'
    code = CODE.replace('sys.exit', 'map_run.MapRun.process = lambda *_: None; sys.exit')
    process = start(bag, out, '--dask', 'local:2', code=code)
    _, told = process.communicate(timeout=300)
    assert process.returncode == 0, told
    # To rounding: sums of other numbers of threads differ in their last bits.
    made, expected = load_cloud(out).xyz, load_cloud(whole).xyz
    assert abs(len(made) - len(expected)) <= 0.001 * len(expected)
    cells = [{tuple(cell) for cell in np.rint(xyz / 0.01).astype(int)} for xyz in (made, expected)]
    assert len(cells[0] & cells[1]) > 0.99 * len(cells[1])
    np.testing.assert_allclose(*(np.loadtxt(path.with_suffix('.tum')) for path in (out, whole)),
                               atol=1e-5)


class Nobody:
    """A scheduler that must not be asked."""

    def submit(self, *_, **__):
        raise AssertionError('a finished chunk is made again')


def test_workers_make_only_chunks_that_are_missing(bag, tmp_path):
    pytest.importorskip('distributed')
    source = open_source(bag)
    run = map_run.MapRun(resolve({}), [Recording(bag, source, '/image')], tmp_path, CHUNK)
    for n, chunk, _ in run.counted():
        run.path(n, chunk).touch()
    map_cluster.process(run, Nobody(), lambda _: None)
    run.path(0, 1).unlink()
    with pytest.raises(AssertionError, match='made again'):
        map_cluster.process(run, Nobody(), lambda _: None)


def test_a_chunk_by_itself_and_one_that_is_not_there(bag):
    config, division = resolve({'stereo.matcher': 'bm', 'baseline.source': 'odometry'}), Division(
        CHUNK, LEAD)
    arguments = bag, '/image', 0.0, config, division
    assert map_cluster._chunk(*arguments, 2).frames == COUNT - 2 * CHUNK
    assert map_cluster._chunk(*arguments, 3) is None


def test_a_cluster_that_is_not_there_is_one_line(bag, tmp_path, capsys, monkeypatch):
    pytest.importorskip('distributed')
    for address in ('local:0', 'local:many', 'nonsense://here'):
        assert mapped(bag, tmp_path / 'map.ply', '--dask', address) == 2
        assert capsys.readouterr().err.startswith('sphstereo map: --dask')
    monkeypatch.setitem(sys.modules, 'distributed', None)
    assert mapped(bag, tmp_path / 'map.ply', '--dask', 'local:2') == 2
    assert "the extra 'dask'" in capsys.readouterr().err
