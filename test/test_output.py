from __future__ import annotations

import numpy as np
import pytest
from making_bags import T0, jpeg_image, odometry, raw_image
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import Reader

from sphstereo_ros.core.frames import (
    Drop,
    Frame,
    FrameKey,
    PointCloud,
    Reference,
    RelativePose,
    StabilisedWindow,
)
from sphstereo_ros.replay.bag_messages import TYPESTORE, make
from sphstereo_ros.replay.output import McapOutput
from sphstereo_ros.replay.sources import BadInput, open_source
from sphstereo_ros.ros import conversions as convert

KEY = FrameKey(T0, 'camera_optical')
DEPTH = np.array([[1.5, np.nan, np.inf, -np.inf]], np.float32)


def messages():
    image = np.zeros((8, 16), np.uint8)
    window = StabilisedWindow(Frame(KEY, image), (Reference(
        Frame(FrameKey(T0 - 10**8, 'camera_optical'), image),
        RelativePose(position=np.array([0.0, 0.0, -0.3]), covariance=np.eye(6) * 1e-6)),))
    cloud = PointCloud(KEY, np.array([[1, 2, 3]], np.float32), np.array([0.1], np.float32),
                       intensity=np.array([200], np.uint8))
    return {'/depth/image': convert.depth_message(make, KEY, DEPTH),
            '/pairs': convert.window_message(make, window),
            '/odometry/visual': convert.odometry_message(make, window),
            '/points': convert.cloud_message(make, cloud),
            '/frames': raw_image(0), '/image/compressed': jpeg_image(0),
            '/diagnostics': convert.diagnostic_message(
                make, T0, [convert.Status('pipeline', 1, 'text', {'drops': 3})])}


@pytest.fixture
def written(tmp_path):
    path = tmp_path / 'results.mcap'
    with McapOutput(path) as output:
        for topic, message in messages().items():
            output.write(topic, T0, message)
    return path


def check(topic, message):
    """What any reader must find."""
    if topic == '/diagnostics':
        status, = message.status
        assert (status.name, status.values[0].key, status.values[0].value) == (
            'pipeline', 'drops', '3')
        assert status.level in (1, b'\x01')
    elif topic == '/depth/image':
        np.testing.assert_array_equal(convert.read_depth(message), DEPTH)
    elif topic == '/pairs':
        assert [p.pose.position.z for p in message.poses] == [-0.3, 0.0]
    elif topic == '/odometry/visual':
        assert message.pose.pose.position.z == pytest.approx(0.3)
        assert len(message.pose.covariance) == 36
    elif topic == '/points':
        np.testing.assert_array_equal(convert.read_cloud(message).xyz, [[1, 2, 3]])
    else:
        frame = convert.decode_frame(message)
        assert not isinstance(frame, Drop)
        assert frame.key == FrameKey(T0, 'camera')
    assert convert.nanoseconds(message.header.stamp) == T0


def test_mcap_ros2_support_reads_it(written):
    with written.open('rb') as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        assert reader.get_header().profile == 'ros2'
        found = [(channel.topic, message.log_time, decoded) for _, channel, message, decoded
                 in reader.iter_decoded_messages()]
    assert {topic for topic, _, _ in found} == set(messages())
    for topic, time, message in found:
        assert time == T0
        check(topic, message)


def test_rosbags_reads_it(written):
    with Reader(written) as reader:
        assert {c.topic: c.msgtype for c in reader.connections} == {
            topic: message.__msgtype__ for topic, message in messages().items()}
        for connection, time, data in reader.messages():
            assert time == T0
            check(connection.topic, TYPESTORE.deserialize_cdr(data, connection.msgtype))


def test_its_own_definitions_are_enough_for_rosbags(written):
    with AnyReader([written]) as reader:  # types from the file alone
        for connection, _, data in reader.messages():
            check(connection.topic, reader.deserialize(data, connection.msgtype))


def test_own_sources_read_it(written):
    source = open_source(written)
    records = list(source.records(source.topics))
    assert len(records) == len(messages())
    assert source.problem == ''
    for record in records:
        check(record.topic, record.message())


def write_and_fail(path):
    with McapOutput(path) as output:
        for k in range(3):
            output.write('/odometry', T0 + k, odometry(k))
        raise RuntimeError('stop')


def test_exception_leaves_a_complete_file(tmp_path):
    path = tmp_path / 'results.mcap'
    with pytest.raises(RuntimeError, match='stop'):
        write_and_fail(path)
    source = open_source(path)
    assert source.count(['/odometry']) == 3
    assert source.problem == ''


def test_what_was_flushed_survives_a_killed_process(tmp_path):
    path = tmp_path / 'results.mcap'
    output = McapOutput(path)
    noise = np.random.default_rng(0).integers(0, 256, (512, 1024, 3), np.uint8)
    for k in range(8):  # 1.5 MB each, more than a chunk
        output.write('/frames', T0 + k, convert.image_message(make, FrameKey(T0 + k, ''), noise))
    copy = tmp_path / 'left.mcap'
    copy.write_bytes(path.read_bytes())  # as it is without close()
    output.close()
    source = open_source(copy)
    times = [record.time for record in source.records(['/frames'])]
    assert times == [T0 + k for k in range(len(times))]
    assert len(times) >= 6
    assert 'truncated after' in source.problem


@pytest.mark.parametrize('seed', range(20))
def test_flipped_byte_is_noticed(tmp_path, seed):
    path = tmp_path / 'results.mcap'
    random = np.random.default_rng(seed)
    with McapOutput(path) as output:
        for k in range(4):
            image = random.integers(0, 256, (512, 1024, 3), np.uint8)
            output.write('/frames', T0 + k, convert.image_message(make, FrameKey(T0, ''), image))
    content = bytearray(path.read_bytes())
    content[int(random.integers(2000, len(content) - 4000))] ^= 1 << int(random.integers(8))
    path.write_bytes(content)
    source = open_source(path)
    count = len(list(source.records(['/frames'])))
    assert count < 4
    assert f'after {count} messages' in source.problem


def test_folder_that_is_not_there(tmp_path):
    with pytest.raises(BadInput, match='cannot write'):
        McapOutput(tmp_path / 'none' / 'results.mcap')


@pytest.mark.parametrize('seed', range(5))
def test_flipped_byte_is_noticed_without_an_index_too(tmp_path, seed):
    path = tmp_path / 'results.mcap'
    random = np.random.default_rng(seed)
    output = McapOutput(path)
    for k in range(8):
        image = random.integers(0, 256, (512, 1024, 3), np.uint8)
        output.write('/frames', T0 + k, convert.image_message(make, FrameKey(T0, ''), image))
    content = bytearray(path.read_bytes())  # as a killed process leaves it
    output.close()
    content[len(content) // 2 + int(random.integers(1000))] ^= 1
    path.write_bytes(content)
    source = open_source(path)
    count = len(list(source.records(['/frames'])))
    assert 0 < count < 6
    assert f'truncated after {count} messages' in source.problem
