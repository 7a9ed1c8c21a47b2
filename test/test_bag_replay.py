"""The node bag_replay over DDS."""
from __future__ import annotations

import signal
from itertools import pairwise

import numpy as np
import pytest

pytest.importorskip('rclpy')

from making_bags import STEP, T0, drive, odometry, raw_image, write_bag
from nav_msgs.msg import Odometry
from rclpy.qos import QoSProfile, ReliabilityPolicy
from ros_graph import graph, nanoseconds
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import CompressedImage, Image

from sphstereo_ros.core.frames import FrameKey
from sphstereo_ros.replay.bag_messages import make
from sphstereo_ros.ros import conversions as convert


@pytest.fixture
def ros(tmp_path):
    with graph(tmp_path) as made:
        yield made


def stamps(messages):
    return [nanoseconds(m.header.stamp) for m in messages]


@pytest.mark.parametrize('storage', ['mcap', 'db3'])
def test_whole_bag_arrives_in_order_and_the_node_ends(ros, tmp_path, storage):
    truth = convert.depth_message(make, FrameKey(T0, 'truth'), np.zeros((4, 8), np.float32))
    messages = [*drive(10, '/image', raw_image), ('/truth/range', T0, truth)]
    bag = write_bag(tmp_path / 'bag', messages, storage)
    client = ros.client
    client.subscribe(Image, '/image')
    client.subscribe(Odometry, '/odometry')
    client.subscribe(Clock, '/clock', depth=1000)
    node = ros.start('bag_replay', f'replay.bag:="{bag}"', 'replay.rate:=4.0', 'replay.wait:=20.0')
    client.message('/image', 9)
    client.message('/odometry', 9)
    client.until(lambda: client.received['/clock']
                 and nanoseconds(client.received['/clock'][-1].clock) == T0 + 9 * STEP,
                 'the last stamp on /clock')
    assert node.ended() == 0
    assert stamps(client.received['/image']) == [T0 + k * STEP for k in range(10)]
    assert [m.pose.pose.position.x for m in client.received['/odometry']] == pytest.approx(
        [0.3 * k for k in range(10)])
    for k, message in enumerate(client.received['/image']):
        assert bytes(message.data) == raw_image(k).data.tobytes()
        assert message.header.frame_id == 'camera'
    clock = [nanoseconds(m.clock) for m in client.received['/clock']]
    assert all(b >= a for a, b in pairwise(clock))
    assert clock[-1] == T0 + 9 * STEP
    assert len(clock) >= 10
    assert '/truth/range' not in dict(client.node.get_topic_names_and_types())
    assert 'played 20 messages' in node.log


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM])
def test_loop_goes_on_with_rising_stamps_until_a_signal(ros, tmp_path, number):
    bag = write_bag(tmp_path / 'bag', drive(4))
    ros.client.subscribe(CompressedImage, '/front/image/compressed')
    node = ros.start('bag_replay', '-r __ns:=/front', f'replay.bag:={bag}', 'replay.loop:=true',
                     'replay.rate:=5.0')
    ros.client.message('/front/image/compressed', 12)
    assert node.stop(number) == 0
    received = stamps(ros.client.received['/front/image/compressed'])
    assert all(b > a for a, b in pairwise(received))
    assert {(b - a) % STEP for a, b in pairwise(received)} == {0}
    assert 'Traceback' not in node.log


def test_best_effort_subscribers_match(ros, tmp_path):
    bag = write_bag(tmp_path / 'bag', drive(4))
    received = ros.client.received['/image/compressed']
    ros.client.node.create_subscription(
        CompressedImage, '/image/compressed', received.append,
        QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT))
    ros.start('bag_replay', f'replay.bag:={bag}', 'replay.loop:=true')
    ros.client.message('/image/compressed', 1)


def test_start_offset_and_topic(ros, tmp_path):
    messages = [(topic, T0 + k * STEP, raw_image(k)) for k in range(6)
                for topic in ('/front', '/rear')] + [('/odometry', T0, odometry(0))]
    bag = write_bag(tmp_path / 'bag', messages)
    ros.client.subscribe(Image, '/image')
    node = ros.start('bag_replay', f'replay.bag:={bag}', 'replay.topic:=/rear',
                     'replay.start_offset:=0.3', 'replay.wait:=20.0')
    assert node.ended() == 0
    ros.client.message('/image', 2)
    assert stamps(ros.client.received['/image']) == [T0 + k * STEP for k in (3, 4, 5)]


@pytest.mark.parametrize(('word', 'reason'), [
    ('replay.bag:=none.mcap', 'none.mcap does not exist'),
    ('replay.rate:=1.0', 'must name a bag'), ('replay.rate:=0.0', 'outside')])
def test_bad_input_is_refused(ros, word, reason):
    node = ros.start('bag_replay', word)
    assert node.ended() == 2
    assert reason in node.log
    assert 'Traceback' not in node.log
