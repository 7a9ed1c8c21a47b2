from __future__ import annotations

import os
import signal
import subprocess
import sys
import time

import cv2
import numpy as np
import pytest
import room
from making_bags import T0, odometry, raw_image, write_bag, write_video

from sphstereo_ros import cli
from sphstereo_ros.cli.run import output_path
from sphstereo_ros.core.chain import Chain
from sphstereo_ros.core.config import resolve
from sphstereo_ros.core.frames import Frame, FrameKey
from sphstereo_ros.core.level import Attitude
from sphstereo_ros.core.motion import OdometrySample
from sphstereo_ros.core.obstacles import ObstacleDetection
from sphstereo_ros.replay import offline
from sphstereo_ros.replay.bag_messages import make
from sphstereo_ros.replay.output import McapOutput
from sphstereo_ros.replay.records import FIRST_STAMP, BadInput
from sphstereo_ros.replay.sources import open_source
from sphstereo_ros.ros import conversions as convert
from sphstereo_ros.ros.obstacle_messages import OUTPUTS

STEP, HEIGHT, COUNT = 0.15, 240, 4
FAST = ('-p', 'stereo.matcher:=bm')


@pytest.fixture(scope='module')
def frames():
    return room.forward(COUNT, STEP, HEIGHT)


@pytest.fixture(scope='module')
def bag(frames, tmp_path_factory):
    """A drive through a room, with odometry."""
    messages = []
    for k, frame in enumerate(frames):
        moved = make('nav_msgs/msg/Odometry', header=convert.header(
            make, FrameKey(frame.key.stamp, 'odom')))
        moved.pose.pose.position.x = STEP * k
        messages += [('/odometry', frame.key.stamp, moved),
                     ('/image', frame.key.stamp, convert.frame_message(make, frame))]
    return write_bag(tmp_path_factory.mktemp('room') / 'bag', messages)


def run(*words):
    """Exit status, also where argparse ends the program."""
    try:
        return cli.main([str(word) for word in words])
    except SystemExit as end:
        return end.code


def results(path):
    source = open_source(path)
    found = {}
    for record in source.records(source.topics):
        found.setdefault(record.topic, []).append(record.message())
    assert source.problem == ''
    return found


def truth(frames, **parameters):
    chain = Chain(resolve({'stereo.matcher': 'bm', **parameters}))
    made = []
    for k, frame in enumerate(frames):
        if parameters.get('baseline.source') == 'odometry':
            chain.add_odometry(OdometrySample(frame.key.stamp, np.array([STEP * k, 0, 0]),
                                              np.eye(3)))
        made += chain.add_frame(frame)
    return made[1:]  # the first frame has no reference


# run

def test_run_gives_what_the_core_gives(bag, frames, tmp_path, capsys):
    out = tmp_path / 'out.mcap'
    assert run('run', bag, *FAST, '-p', 'baseline.source:=odometry', '--out', out) == 0
    found = results(out)
    assert set(found) == {'/pairs', '/pairs/stabilised', '/pairs/aligned', '/depth/image',
                          '/depth/sigma', '/depth/preview', '/points', '/odometry/visual',
                          '/diagnostics', *(f'/{topic}' for topic in OUTPUTS)}
    expected = truth(frames, **{'baseline.source': 'odometry'})
    assert len(found['/depth/image']) == len(expected) == COUNT - 1
    for k, result in enumerate(expected):
        key = frames[k + 1].key
        for topic, values in (('/depth/image', result.range_image.range),
                              ('/depth/sigma', result.range_image.sigma)):
            assert convert.frame_key(found[topic][k].header) == key
            np.testing.assert_array_equal(convert.read_depth(found[topic][k]), values)
        cloud = convert.read_cloud(found['/points'][k])
        assert cloud.key == FrameKey(key.stamp, 'base_link')
        np.testing.assert_array_equal(cloud.xyz, result.cloud.xyz)
        geometry = convert.read_window(found['/pairs/aligned'][k])
        assert geometry.keys == (frames[k].key, key)
        np.testing.assert_allclose(geometry.references[0][1].position,
                                   result.aligned.references[0].pose.position)
    exact = room.view(np.array([0, 0, STEP * 3]), np.eye(3), HEIGHT)[1]
    measured = convert.read_depth(found['/depth/image'][-1])
    known = np.isfinite(measured)
    assert known.mean() > 0.5
    assert np.median(np.abs(measured - exact)[known] / exact[known]) < 0.05
    values = {v.key: v.value for v in found['/diagnostics'][-1].status[0].values}
    assert (values['frames_in'], values['frames_out'], values['drops.first_frame']) == (
        '4', '3', '1')
    lines = capsys.readouterr().out.splitlines()
    assert lines[:4] == ['frames in: 4', 'windows: 3', 'depth images: 3',
                         'dropped, first_frame: 1']


def test_obstacles_are_written_where_attitude_and_metres_are_known(bag, frames, tmp_path, capsys):
    out = tmp_path / 'out.mcap'
    words = (*FAST, '--out', out, '--topics', 'obstacles/scan,obstacles/mavros')
    assert run('run', bag, *words, '-p', 'baseline.source:=odometry',
               '-p', 'obstacles.max:=3.0') == 0
    found = results(out)
    detection = ObstacleDetection(resolve({'obstacles.max': 3.0}))
    # The level frame moves as base_link does.
    level = Attitude(velocity=np.array([STEP / 0.033333333, 0, 0]))
    for topic in ('obstacles/scan', 'obstacles/mavros'):
        assert len(found[f'/{topic}']) == COUNT - 1
        for message, result in zip(found[f'/{topic}'],
                                   truth(frames, **{'baseline.source': 'odometry'}), strict=True):
            expected = OUTPUTS[topic][1](make, detection.process(result.range_image, level))
            np.testing.assert_array_equal(message.ranges, expected.ranges)
            assert message.header == expected.header
    assert np.isfinite(found['/obstacles/scan'][-1].ranges).sum() > 10
    assert run('run', bag, *words) == 0  # without metres
    assert 'written: 0 messages' in capsys.readouterr().out


def test_what_moves_is_written_where_the_matcher_can_tell(bag, frames, tmp_path):
    out = tmp_path / 'out.mcap'
    assert run('run', bag, *FAST, '-p', 'stereo.matcher:=joint', '--out', out,
               '--topics', 'depth/moving') == 0
    expected = truth(frames, **{'stereo.matcher': 'joint'})
    found = results(out)['/depth/moving']
    assert len(found) == len(expected) == COUNT - 1
    for message, result, frame in zip(found, expected, frames[1:], strict=True):
        assert convert.frame_key(message.header) == frame.key
        assert (message.encoding, message.step) == ('mono8', message.width)
        image = np.asarray(message.data).reshape(message.height, message.width)
        np.testing.assert_array_equal(image, result.range_image.moving)


def test_run_twice_gives_the_same_file(bag, tmp_path):
    for name in ('one.mcap', 'two.mcap'):
        assert run('run', bag, *FAST, '-p', 'baseline.length:=0.15', '--out', tmp_path / name) == 0
    assert (tmp_path / 'one.mcap').read_bytes() == (tmp_path / 'two.mcap').read_bytes()


def test_without_a_baseline_nothing_is_called_metres(bag, tmp_path, capsys):
    out = tmp_path / 'out.mcap'
    assert run('run', bag, *FAST, '--out', out) == 0
    found = results(out)
    assert not {'/depth/image', '/depth/sigma', '/points'} & set(found)
    assert len(found['/depth/relative']) == 3
    assert '3 without metric scale' in capsys.readouterr().out


def test_topics_limit_what_is_written(bag, frames, tmp_path):
    out = tmp_path / 'out.mcap'
    assert run('run', bag, *FAST, '-p', 'baseline.length:=0.15', '--out', out,
               '--topics', 'depth/image,/frames') == 0
    found = results(out)
    assert set(found) == {'/depth/image', '/frames'}
    again = convert.decode_frame(found['/frames'][2])
    assert again.key == frames[2].key
    np.testing.assert_array_equal(again.image, frames[2].image)


def test_parameter_file_and_override(bag, tmp_path):
    file = tmp_path / 'parameters.yaml'
    file.write_text('/**: {ros__parameters: {stereo: {matcher: bm, working_height: 120}, '
                    'baseline.length: 9.0, use_sim_time: true}}')
    out = tmp_path / 'out.mcap'
    assert run('run', bag, '--params', file, '-p', 'baseline.length:=0.15', '--out', out,
               '--topics', 'depth/image,odometry/visual') == 0
    found = results(out)
    assert convert.read_depth(found['/depth/image'][0]).shape == (120, 240)
    assert found['/odometry/visual'][0].pose.pose.position.z == pytest.approx(0.15, rel=0.01)


@pytest.mark.parametrize('kind', ['folder', 'video'])
def test_run_without_a_bag(frames, tmp_path, kind):
    source = tmp_path / 'frames'
    source.mkdir()
    if kind == 'video':
        source = tmp_path / 'ride.avi'
        writer = cv2.VideoWriter(str(source), cv2.VideoWriter_fourcc(*'MJPG'), 30.0,
                                 (2 * HEIGHT, HEIGHT))
    for k, frame in enumerate(frames):
        if kind == 'folder':
            cv2.imwrite(str(source / f'{k}.png'), frame.image)
        else:
            writer.write(cv2.cvtColor(frame.image, cv2.COLOR_GRAY2BGR))
    if kind == 'video':
        writer.release()
    out = tmp_path / 'out.mcap'
    assert run('run', source, *FAST, '-p', 'baseline.length:=0.15', '--out', out) == 0
    stamps = [convert.nanoseconds(m.header.stamp) for m in results(out)['/depth/image']]
    np.testing.assert_allclose(stamps, FIRST_STAMP + np.arange(1, COUNT) * 1e9 / 30, atol=1e6)


def test_only_other_image_topic_is_found_or_named(frames, tmp_path, capsys):
    messages = [(topic, f.key.stamp, convert.frame_message(make, f)) for f in frames
                for topic in ('/left', '/right')]
    bag = write_bag(tmp_path / 'two', messages)
    out = tmp_path / 'out.mcap'
    assert run('run', bag, '--out', out) == 2
    assert 'there are /left, /right; choose with --topic' in capsys.readouterr().err
    assert not out.exists()
    assert run('run', bag, *FAST, '--topic', '/right', '--out', out) == 0
    assert len(results(out)['/depth/relative']) == 3


def test_bad_images_and_samples_are_counted_by_cause(bag, frames, tmp_path, capsys):
    broken = raw_image(0)
    broken.step = 1
    bent = odometry(0)
    bent.pose.pose.orientation.w = 0.5
    bent.header.stamp = convert.time_message(make, frames[1].key.stamp + 1)
    messages = [('/image', f.key.stamp, convert.frame_message(make, f)) for f in frames]
    messages[2:2] = [('/image', frames[1].key.stamp + 1, broken),
                     ('/odometry', frames[1].key.stamp + 1, bent)]
    out = tmp_path / 'out.mcap'
    assert run('run', write_bag(tmp_path / 'bad', messages), *FAST, '--out', out) == 0
    lines = capsys.readouterr().out.splitlines()
    assert 'frames in: 5' in lines
    assert 'dropped, wrong_step: 1' in lines
    assert 'dropped, odometry_invalid_quaternion: 1' in lines
    assert len(results(out)['/depth/relative']) == 3


def test_frame_that_waits_for_odometry_at_the_end_is_accounted_for(frames, tmp_path, capsys):
    messages = [('/image', f.key.stamp, convert.frame_message(make, f)) for f in frames]
    moved = odometry(0)
    moved.header.stamp = convert.time_message(make, frames[0].key.stamp)
    messages.insert(0, ('/odometry', frames[0].key.stamp, moved))
    assert run('run', write_bag(tmp_path / 'short', messages), *FAST, '-p',
               'baseline.source:=odometry', '--out', tmp_path / 'out.mcap') == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[:3] == ['frames in: 4', 'windows: 0', 'depth images: 0']
    assert sum(int(line.split(': ')[1]) for line in lines if line.startswith('dropped')) == 4


def test_truncated_bag_gives_what_there_is_and_a_warning(bag, tmp_path, capsys):
    cut, out = tmp_path / 'cut.mcap', tmp_path / 'out.mcap'
    with McapOutput(tmp_path / 'many.mcap') as output:  # several chunks
        source = open_source(bag)
        for k in range(4):
            for record in source.records(['/image']):
                output.write('/image', record.time + k * 10**10, record.message())
    content = (tmp_path / 'many.mcap').read_bytes()
    cut.write_bytes(content[:int(0.6 * len(content))])
    assert run('run', cut, '--out', out, '--topics', 'frames') == 0
    said = capsys.readouterr()
    frames = len(results(out)['/frames'])
    assert 0 < frames < 16
    assert f'frames in: {frames}' in said.out
    assert said.err.splitlines()[-1].startswith(f'warning: {cut}: truncated after {frames} mess')


class Breaking(Chain):
    """Computes one window, and then meets something unexpected."""

    error: BaseException = RuntimeError('unexpected')

    def process(self, paired):
        if getattr(self, 'done', False):
            raise self.error
        self.done = True
        return super().process(paired)


@pytest.mark.parametrize(('error', 'status'), [(RuntimeError('unexpected'), 1),
                                               (KeyboardInterrupt(), 130)])
def test_nothing_computed_is_lost(bag, tmp_path, monkeypatch, capsys, error, status):
    monkeypatch.setattr(offline, 'Chain', Breaking)
    monkeypatch.setattr(Breaking, 'error', error)
    out = tmp_path / 'out.mcap'
    assert run('run', bag, *FAST, '--out', out) == status
    assert len(results(out)['/depth/relative']) == 1
    assert ('Traceback' in capsys.readouterr().err) == (status == 1)


# Bad usage and bad input

@pytest.mark.parametrize(('words', 'reason'), [
    (['run', 'none.mcap'], 'none.mcap does not exist'),
    (['run', 'zero.mcap'], 'is empty'),
    (['run', 'text.mp4'], 'no video'),
    (['run', 'BAG', '-p', 'baseline.lenght:=1'], 'baseline.lenght: no node'),
    (['run', 'BAG', '-p', 'baseline.length:=-1'], 'outside'),
    (['run', 'BAG', '-p', 'baseline.length'], 'NAME:=VALUE'),
    (['run', 'BAG', '-p', 'camera.mask:=none.png'], 'camera.mask: cannot read'),
    (['run', 'BAG', '--params', 'none.yaml'], 'none.yaml: No such file'),
    (['run', 'BAG', '--topics', 'depht/image'], '/depht/image is none of'),
    (['run', 'BAG', '--topic', '/other'], 'no image topic /other; there is /image'),
    (['run', 'BAG', '--out', 'BAG'], 'is the input'),
    (['run', 'BAG', '--out', 'none/out.mcap'], 'cannot write'),
    (['run', 'BAG', '--out', '.'], 'is a folder'),
    (['import', 'none.mp4', 'out.mcap'], 'none.mp4 is no file'),
    (['import', 'zero.mcap', 'out.mcap'], 'is empty'),
    (['import', 'text.mp4', 'out.mcap'], 'no video'),
    (['import', 'phone.mp4', 'out.mcap'], 'no full sphere'),
    (['import', 'text.mp4', 'out.mcap', '--quality', '0'], '--quality: 0 is outside'),
    (['import', 'text.mp4', 'out.mcap', '--start', '3', '--end', '2'], '--end'),
    (['import', 'ride.mp4', 'out.mcap', '--start', '60'], 'no frame in this span')])
def test_bad_input_is_one_line_and_status_2(words, reason, bag, tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    (tmp_path / 'zero.mcap').touch()
    (tmp_path / 'text.mp4').write_text('hello' * 50)
    write_video(tmp_path / 'phone.mp4', (64, 128))
    write_video(tmp_path / 'ride.mp4')
    capfd.readouterr()
    assert run(*(bag if word == 'BAG' else word for word in words)) == 2
    lines = [line for line in capfd.readouterr().err.splitlines()
             if line.startswith('sphstereo')]
    assert len(lines) == 1
    assert reason in lines[0]


@pytest.mark.parametrize('words', [[], ['fly'], ['run'], ['run', 'a', '--speed', '3'],
                                   ['import', 'a'], ['run', 'a', '--fps', 'many']])
def test_bad_usage_is_status_2(words, capsys):
    assert run(*words) == 2
    assert 'usage' in capsys.readouterr().err


@pytest.mark.parametrize('words', [['--help'], ['run', '--help'], ['replay', '--help'],
                                   ['import', '--help'], ['scene', '--help']])
def test_help(words, capsys):
    assert run(*words) == 0
    assert 'usage: sphstereo' in capsys.readouterr().out


def test_input_is_never_overwritten(bag):
    with pytest.raises(BadInput, match='is the input'):
        output_path(bag, bag.parent, '.mcap')


def test_default_output_is_in_this_folder(bag, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert str(output_path(None, bag, '_depth.mcap')) == f'{bag.stem}_depth.mcap'


# import

def test_import_of_a_video(tmp_path, capsys):
    video = write_video(tmp_path / 'ride.mp4', (128, 64), frames=12, fps=25.0)
    out = tmp_path / 'ride.mcap'
    assert run('import', video, out, '--quality', '80') == 0
    found = results(out)
    assert set(found) == {'/image/compressed'}
    frames = [convert.decode_frame(m) for m in found['/image/compressed']]
    assert [f.key for f in frames] == [FrameKey(FIRST_STAMP + k * 40_000_000, 'camera_optical')
                                       for k in range(12)]
    np.testing.assert_allclose([f.image.mean() for f in frames], 20 * np.arange(12), atol=8)
    assert 'written: 12 frames of 128×64' in capsys.readouterr().out


def test_import_at_another_size_rate_and_span(tmp_path):
    video = write_video(tmp_path / 'ride.mp4', (128, 64), frames=12, fps=25.0)
    out = tmp_path / 'ride.mcap'
    assert run('import', video, out, '--height', '32', '--fps', '10', '--start', '0.25',
               '--end', '0.75') == 0
    frames = [convert.decode_frame(m) for m in results(out)['/image/compressed']]
    assert [f.key.stamp for f in frames] == [FIRST_STAMP + k * 10**8 for k in range(3, 8)]
    assert {f.image.shape for f in frames} == {(32, 64)}


# The program as a process

def test_interrupted_program_leaves_its_results(tmp_path):
    """SIGTERM in the middle: a complete file, no traceback."""
    frames = [('/image', T0 + k, Frame(FrameKey(T0 + k * 10**8, 'c'), np.full(
        (240, 480), k % 250, np.uint8))) for k in range(8000)]
    bag = tmp_path / 'long.mcap'
    with McapOutput(bag) as output:
        for topic, stamp, frame in frames:
            output.write(topic, stamp, convert.frame_message(make, frame))
    out = tmp_path / 'out.mcap'
    process = subprocess.Popen(
        [sys.executable, '-m', 'sphstereo_ros.cli', 'run', str(bag), '--out', str(out),
         '--topics', 'frames'], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        env={**os.environ, 'PYTHONUNBUFFERED': '1'})
    while process.poll() is None and not (out.exists() and out.stat().st_size > 1000):
        time.sleep(0.01)
    process.send_signal(signal.SIGTERM)
    said, errors = process.communicate(timeout=60)
    assert process.returncode == 130, errors
    assert 'Traceback' not in errors
    written = results(out)['/frames']
    assert 0 < len(written) < 8000
    counted = int(said.split('frames in: ')[1].split()[0])
    assert len(written) <= counted <= len(written) + 1  # the one that was interrupted


def test_commands_start_quickly_by_loading_only_what_they_need():
    code = ('import sys; from sphstereo_ros.cli import main\n'
            'try: main(["--version"])\nexcept SystemExit: pass\n'
            'print([m for m in ("cv2", "numba", "rosbags", "rclpy") if m in sys.modules])')
    done = subprocess.run([sys.executable, '-c', code], capture_output=True, text=True,
                          timeout=60, check=True)
    assert done.stdout.splitlines()[-1] == '[]'


def test_run_works_without_rclpy(bag, tmp_path):
    """`run` must not even try to import it."""
    code = ('import sys\nsys.modules["rclpy"] = None\nsys.modules["sensor_msgs"] = None\n'
            'from sphstereo_ros.cli import main\n'
            f'sys.exit(main(["run", {str(bag)!r}, "--out", {str(tmp_path / "o.mcap")!r}, '
            '"--topics", "frames"]))')
    done = subprocess.run([sys.executable, '-c', code], capture_output=True, text=True,
                          timeout=100)
    assert done.returncode == 0, done.stderr


def test_replay_without_ros_says_so():
    code = ('import sys\nsys.modules["rclpy"] = None\nfrom sphstereo_ros.cli import main\n'
            'sys.exit(main(["replay", "any.mcap"]))')
    done = subprocess.run([sys.executable, '-c', code], capture_output=True, text=True,
                          timeout=100)
    assert done.returncode == 2
    assert done.stderr.splitlines() == [
        'sphstereo replay: replay needs ROS 2, and there is no rclpy']
