"""Nodes as processes over DDS, seen by a client that knows standard messages alone."""
from __future__ import annotations

import signal
from collections.abc import Iterator
from functools import cache
from itertools import count
from pathlib import Path

import cv2
import numpy as np
import pytest

pytest.importorskip('rclpy')

import room
from geometry_msgs.msg import TwistStamped
from nav_msgs.msg import Odometry
from nav_msgs.msg import Path as PathMessage
from rcl_interfaces.srv import SetParametersAtomically
from rclpy.parameter import Parameter
from rclpy.qos import ReliabilityPolicy
from ros_graph import Graph, drops, graph, mono8, nanoseconds, odometry, set_stamp
from sensor_msgs.msg import CompressedImage, Image, Imu, PointCloud2

from sphstereo_ros.core.chain import Chain, StageResults
from sphstereo_ros.core.config import resolve
from sphstereo_ros.core.frames import Frame
from sphstereo_ros.core.motion import OdometrySample
from sphstereo_ros.nodes.frame_pairing import TransportChoice

STEP, HEIGHT = 0.15, 240
FULL = 12  # frames until a window has all its references, and one more
STAGES = ('frame_pairing', 'pose_stabilisation', 'motion_alignment', 'spherical_stereo')


@pytest.fixture
def ros(tmp_path: Path) -> Iterator[Graph]:
    with graph(tmp_path) as made:
        yield made


@cache
def frames(count: int = 5) -> tuple[Frame, ...]:
    return tuple(room.forward(count, STEP, HEIGHT))


def moved(i: int) -> tuple[int, float]:
    """Stamp and forward position of frame i."""
    return frames(FULL)[i].key.stamp, STEP * i


@cache
def truth(source: str, matcher: str = 'bm', count: int = 5) -> dict[int, StageResults]:
    """What the core makes of the same frames, by stamp."""
    chain = Chain(resolve({'baseline.source': source, 'stereo.matcher': matcher}))
    results = []
    for i, frame in enumerate(frames(count)):
        stamp, x = moved(i)
        if source == 'odometry':
            chain.add_odometry(OdometrySample(stamp, np.array([x, 0, 0]), np.eye(3)))
        results += chain.add_frame(frame)
    return {r.range_image.key.stamp: r for r in results if isinstance(r, StageResults)}


def floats(message: Image) -> np.ndarray:
    assert (message.encoding, message.step) == ('32FC1', 4 * message.width)
    return np.frombuffer(message.data, np.float32).reshape(message.height, message.width)


def test_four_processes_give_what_the_core_gives(ros: Graph) -> None:
    client = ros.client
    for name in STAGES:
        ros.start(name, 'baseline.source:=odometry', 'stereo.matcher:=bm')
    topics = {'frames': Image, 'pairs': PathMessage, 'pairs/stabilised': PathMessage,
              'pairs/aligned': PathMessage, 'depth/image': Image, 'depth/sigma': Image,
              'depth/preview': Image, 'points': PointCloud2, 'odometry/visual': Odometry}
    for topic, kind in topics.items():
        client.subscribe(kind, topic)
    for topic, readers in (('frames', 4), ('pairs', 2), ('pairs/stabilised', 2),
                           ('pairs/aligned', 2), ('pairs/aligned/covariance', 1),
                           ('odometry/visual', 1), ('depth/image', 1)):
        client.linked(topic, readers)
    motion = client.publisher(Odometry, 'odometry')
    image = client.heard(Image, 'image', 'frame_pairing')
    for i, frame in enumerate(frames(FULL)):
        motion.publish(odometry(*moved(i)))
        image.publish(mono8(frame.key.stamp, frame.image))
        if i:
            client.stamped('points', frame.key.stamp)
    expected = truth('odometry', count=FULL)
    assert sorted(expected) == [f.key.stamp for f in frames(FULL)[1:]]
    assert len(expected[frames(FULL)[-1].key.stamp].aligned.references) == 4
    for stamp, result in expected.items():
        depth, sigma = client.stamped('depth/image', stamp), client.stamped('depth/sigma', stamp)
        assert (depth.header.frame_id, sigma.header.frame_id) == ('camera_optical',) * 2
        np.testing.assert_allclose(floats(depth), result.range_image.range, rtol=1e-5)
        np.testing.assert_allclose(floats(sigma), result.range_image.sigma, rtol=1e-3)
        check_window(client.stamped('pairs/aligned', stamp), result)
        check_cloud(client.stamped('points', stamp), result)
        preview = client.stamped('depth/preview', stamp)
        assert (preview.encoding, len(preview.data)) == ('bgr8', 3 * 2 * HEIGHT**2)
    visual = client.stamped('odometry/visual', frames()[2].key.stamp)
    assert visual.pose.pose.position.z == pytest.approx(STEP, rel=1e-3)
    assert visual.twist.twist.linear.z == pytest.approx(STEP / 0.033333333, rel=1e-3)
    assert visual.pose.covariance[0] > 0
    for topic in topics:
        for info in client.node.get_publishers_info_by_topic(topic):
            assert info.qos_profile.reliability == ReliabilityPolicy.RELIABLE
    for topic in ('image', 'image/compressed'):
        info, = client.node.get_subscriptions_info_by_topic(topic)
        assert info.qos_profile.reliability == ReliabilityPolicy.BEST_EFFORT
    last = frames(FULL)[-1].key.stamp
    client.until(lambda: set(client.statuses()) == set(STAGES), 'diagnostics of all')
    assert nanoseconds(client.received['depth/image'][-1].header.stamp) == last
    for name in STAGES:
        assert set(drops(client.statuses()[name])) <= {'first_frame', 'unknown_encoding'}


def check_window(message: PathMessage, result: StageResults) -> None:
    """The aligned window: reference behind, current last, headers that name the frames."""
    window = result.aligned
    assert nanoseconds(message.header.stamp) == window.current.key.stamp
    *references, current = message.poses
    assert {pose.header.frame_id for pose in message.poses} == {'camera_optical'}
    assert nanoseconds(current.header.stamp) == window.current.key.stamp
    for sent, reference in zip(reversed(references), window.references, strict=True):
        assert nanoseconds(sent.header.stamp) == reference.frame.key.stamp
        p = sent.pose.position
        np.testing.assert_allclose([p.x, p.y, p.z], reference.pose.position, atol=1e-9)
    assert references[-1].pose.position.z == pytest.approx(-STEP, rel=1e-3)
    assert (current.pose.position.z, current.pose.orientation.w) == (0.0, 1.0)


def check_cloud(message: PointCloud2, result: StageResults) -> None:
    """Points in base_link: the left wall is at +y of an unrotated mount."""
    assert result.cloud is not None
    assert message.header.frame_id == 'base_link'
    assert [f.name for f in message.fields] == ['x', 'y', 'z', 'intensity', 'sigma']
    points = np.frombuffer(message.data, np.float32).reshape(-1, 5)
    np.testing.assert_allclose(points[:, :3], result.cloud.xyz, rtol=1e-5, atol=1e-5)
    left = points[(points[:, 1] > 0) & (np.abs(points[:, ::2][:, :2]) < 0.3).all(axis=1), 1]
    assert np.median(left) == pytest.approx(-room.LOW[0], rel=0.03)


def test_pipeline_on_compressed_images_without_a_baseline(ros: Graph) -> None:
    """Relative depth, never on depth/image; intermediates are there for who wants them."""
    client = ros.client
    ros.start('pipeline', 'stereo.matcher:=bm', 'use_sim_time:=true', '--remap __ns:=/robot')
    for topic, kind in (('depth/relative', Image), ('depth/image', Image), ('pairs', PathMessage),
                        ('points', PointCloud2), ('frames', Image)):
        client.subscribe(kind, f'/robot/{topic}')
        client.linked(f'/robot/{topic}')
    image = client.heard(CompressedImage, '/robot/image/compressed', 'pipeline: frame_pairing')
    for i, frame in enumerate(frames()):
        image.publish(png(frame.key.stamp, frame.image))
        sent = client.stamped('/robot/frames', frame.key.stamp)
        np.testing.assert_array_equal(np.frombuffer(sent.data, np.uint8), frame.image.reshape(-1))
        if i:
            depth = client.stamped('/robot/depth/relative', frame.key.stamp)
            np.testing.assert_allclose(
                floats(depth), truth('fixed')[frame.key.stamp].range_image.range, rtol=1e-5)
            window = client.stamped('/robot/pairs', frame.key.stamp)
            assert window.poses[-2].pose.position.z == pytest.approx(-1e-6)
    assert not client.received['/robot/depth/image']
    assert not client.received['/robot/points']
    statuses = client.until(lambda: len(client.statuses()) == 5 and client.statuses(), 'statuses')
    assert set(statuses) == {f'pipeline: {part}' for part in (*STAGES, 'obstacle_detection')}


def rising(frame: Frame, i: int) -> Frame:
    """Frame i with something textured beside the camera that rises by 4 px a frame."""
    image = frame.image.copy()
    place = slice(120 - 4 * i, 160 - 4 * i), slice(340, 380)
    noise = np.random.default_rng(0).integers(0, 255, (10, 10), np.uint8)
    image[place] = cv2.resize(noise, (40, 40), interpolation=cv2.INTER_CUBIC)
    return Frame(frame.key, image)


def test_what_moves_is_marked_and_unknown(ros: Graph) -> None:
    client = ros.client
    ros.start('pipeline', 'stereo.matcher:=joint', 'baseline.length:=0.15')
    for topic in ('depth/moving', 'depth/image'):
        client.subscribe(Image, topic)
        client.linked(topic)
    image = client.heard(Image, 'image', 'pipeline: frame_pairing')
    chain = Chain(resolve({'stereo.matcher': 'joint', 'baseline.length': 0.15}))
    for i, frame in enumerate(rising(f, i) for i, f in enumerate(frames()[:4])):
        image.publish(mono8(frame.key.stamp, frame.image))
        expected = chain.add_frame(frame)[0]
        if not i:
            continue
        assert isinstance(expected, StageResults)
        sent = client.stamped('depth/moving', frame.key.stamp)
        assert (sent.encoding, sent.step) == ('mono8', 2 * HEIGHT)
        moving = np.frombuffer(sent.data, np.uint8).reshape(HEIGHT, 2 * HEIGHT)
        assert (moving != expected.range_image.moving).mean() < 1e-3
        depth = floats(client.stamped('depth/image', frame.key.stamp))
        assert np.isnan(depth[moving == 255]).all()
    patch = np.zeros(moving.shape, bool)
    patch[108:148, 340:380] = True
    assert (moving[patch] == 255).mean() > 0.7
    assert (moving[~patch] == 255).mean() < 0.02


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM])
def test_every_node_ends_cleanly(ros: Graph, number: int) -> None:
    processes = [ros.start(name) for name in (*STAGES, 'pipeline')]
    for topic, readers in (('image', 2), ('frames', 3), ('pairs/aligned', 1)):
        ros.client.linked(topic, readers, writers=0)
    for process in processes:
        process.process.send_signal(number)
    for process in processes:
        assert process.ended() == 0, process.log
        assert 'Traceback' not in process.log
    ros.client.until(lambda: ros.client.node.count_publishers('/diagnostics') == 0, 'all to leave')


def test_a_signal_during_the_warm_up_is_no_failure(ros: Graph, tmp_path: Path) -> None:
    ros.environment['NUMBA_CACHE_DIR'] = str(tmp_path)
    process = ros.start('pipeline')
    ros.client.linked('/diagnostics', 1)
    assert process.stop(signal.SIGTERM) == 0, process.log
    assert 'ready' not in process.log
    assert 'Traceback' not in process.log


def test_bad_input_is_a_named_drop_and_the_node_lives(ros: Graph) -> None:
    client = ros.client
    process = ros.start('pipeline', 'baseline.length:=0.15', 'stereo.matcher:=bm')
    client.subscribe(Image, 'depth/image')
    client.linked('depth/image')
    image = client.heard(Image, 'image', 'pipeline: frame_pairing')
    motion = client.publisher(Odometry, 'odometry')
    first, second, third = frames()[:3]
    bad = {cause: mono8(first.key.stamp, first.image) for cause in
           ('unknown_encoding', 'wrong_data_length', 'wrong_step', 'wrong_aspect', 'empty_image')}
    bad['unknown_encoding'].encoding = 'klingon'
    bad['wrong_data_length'].data = bad['wrong_data_length'].data[:-7]
    bad['wrong_step'].step = 3
    bad['wrong_aspect'].width, bad['wrong_aspect'].step = 2 * HEIGHT * HEIGHT * 2, 0
    bad['wrong_aspect'].height = 1
    bad['empty_image'].height = 0
    for cause, message in bad.items():
        image.publish(message)
        if cause != 'wrong_aspect':
            client.dropped('pipeline: frame_pairing', cause)
    motion.publish(odometry(1, float('nan')))
    client.dropped('pipeline: frame_pairing', 'odometry_not_finite')
    image.publish(mono8(second.key.stamp, second.image))
    image.publish(mono8(second.key.stamp, second.image))
    client.dropped('pipeline: frame_pairing', 'duplicate_stamp')
    image.publish(mono8(third.key.stamp, third.image))
    client.stamped('depth/image', third.key.stamp)
    image.publish(mono8(third.key.stamp + 10**7, third.image))
    client.dropped('pipeline: pose_stabilisation', 'no_parallax')
    for changed, cause in ((mono8(third.key.stamp + 2 * 10**7, third.image, 'other'),
                            'frame_id_changed'),
                           (mono8(third.key.stamp, third.image, 'other'), 'stamp_backward'),
                           (mono8(third.key.stamp + 10**10, third.image, 'other'), 'stamp_gap'),
                           (mono8(third.key.stamp + 10**10 + 1, third.image[::2, ::2], 'other'),
                            'size_changed')):
        image.publish(changed)
        client.dropped('pipeline: frame_pairing', cause)
    assert process.process.poll() is None
    assert 'internal_error' not in process.log


FAILING = """
import sys
from sphstereo_ros.core.frames import PairedWindow
from sphstereo_ros.ros.shell import run
from sphstereo_ros.ros.stage import StageComponent

class Stage:
    def warm_up(self):
        pass
    def process(self, window):
        raise ValueError('no such luck')

sys.argv[0] = 'node'
sys.exit(run('pose_stabilisation', lambda shell: [StageComponent(
    shell, 'pose_stabilisation', PairedWindow, 'pairs', lambda config, mask: Stage(), None)]))
"""


def test_an_exception_is_counted_and_ends_nothing(ros: Graph) -> None:
    client = ros.client
    process = ros.start('pose_stabilisation', code=FAILING)
    image = client.heard(Image, 'frames', 'pose_stabilisation')
    pairs = client.heard(PathMessage, 'pairs', 'pose_stabilisation')
    for stamp in range(1, 4):
        image.publish(mono8(stamp, np.zeros((8, 16), np.uint8)))
        if stamp > 1:
            pairs.publish(window(stamp - 1, stamp))
            client.dropped('pose_stabilisation', 'internal_error', stamp - 1)
    levels = [s.level for m in client.received['/diagnostics'] for s in m.status]
    assert b'\x02' in levels
    assert process.log.count('ValueError: no such luck') == 2  # the traceback, the named drop
    assert process.log.count('Traceback') == 1
    assert process.stop() == 0


def test_a_running_stage_takes_new_parameters(ros: Graph) -> None:
    """The same frames, before and after one more matcher was asked for."""
    client = ros.client
    ros.start('pipeline', 'stereo.matcher:=bm')
    client.subscribe(Image, 'depth/relative')
    client.linked('depth/relative')
    image = client.heard(Image, 'image', 'pipeline: frame_pairing')
    for frame in frames()[:2]:
        image.publish(mono8(frame.key.stamp, frame.image))
    client.stamped('depth/relative', frames()[1].key.stamp)
    matcher = Parameter('stereo.matcher', value='sgbm').to_parameter_msg()
    answer = client.call(SetParametersAtomically, '/pipeline/set_parameters_atomically',
                         SetParametersAtomically.Request(parameters=[matcher]))
    assert answer.result.successful
    image.publish(mono8(frames()[2].key.stamp, frames()[2].image))
    depth = client.stamped('depth/relative', frames()[2].key.stamp)
    expected = truth('fixed', 'sgbm')[frames()[2].key.stamp].range_image.range
    np.testing.assert_allclose(floats(depth), expected, rtol=1e-5)


def test_stages_name_what_is_wrong_with_windows(ros: Graph) -> None:
    client = ros.client
    ros.start('pose_stabilisation')
    image = client.heard(Image, 'frames', 'pose_stabilisation')
    pairs = client.heard(PathMessage, 'pairs', 'pose_stabilisation')
    client.dropped('pose_stabilisation', 'too_few_poses')
    broken = mono8(5, np.zeros((8, 16), np.uint8))
    broken.encoding = 'klingon'
    image.publish(broken)
    client.dropped('pose_stabilisation', 'unknown_encoding')
    stamps = count(1)

    def missed() -> bool:  # one window at a time: a burst may overrun the queue
        stamp = next(stamps)
        pairs.publish(window(stamp, stamp + 1))
        return drops(client.statuses()['pose_stabilisation']).get('frame_missing', 0) >= 2
    client.until(missed, 'windows without frames')


def test_first_transport_that_delivers_is_kept() -> None:
    choice = TransportChoice()
    assert choice.accepts('image', 0.0)
    assert not choice.accepts('image/compressed', 0.9)
    assert choice.accepts('image', 0.95)
    assert not choice.accepts('image/compressed', 1.9)
    assert choice.accepts('image/compressed', 1.95)
    assert not choice.accepts('image', 2.0)
    choice.failed('image')
    assert not choice.accepts('image', 2.0)
    choice.failed('image/compressed')
    assert choice.accepts('image', 2.0)


def test_twist_and_imu_reach_the_pairing(ros: Graph) -> None:
    """Half a second forward at 2 m/s; what the IMU says badly is named."""
    client = ros.client
    ros.start('frame_pairing', 'baseline.source:=twist')
    client.subscribe(PathMessage, 'pairs')
    client.linked('pairs')
    motion = client.publisher(TwistStamped, 'twist')
    imu = client.heard(Imu, 'imu', 'frame_pairing')
    image = client.heard(Image, 'image', 'frame_pairing')
    grey = np.zeros((8, 16), np.uint8)
    for stamp in (10**9, 10**9 + 500_000_000):
        twist = TwistStamped()
        set_stamp(twist, stamp, 'base_link')
        twist.twist.linear.x = 2.0
        motion.publish(twist)
        image.publish(mono8(stamp, grey))
    position = client.stamped('pairs', 10**9 + 500_000_000).poses[0].pose.position
    assert (position.x, position.y, position.z) == pytest.approx((0.0, 0.0, -1.0))
    bad = Imu()
    bad.angular_velocity_covariance[0] = -1.0
    imu.publish(bad)
    client.dropped('frame_pairing', 'imu_no_angular_velocity')


def test_both_transports_of_one_camera_give_every_frame_once(ros: Graph) -> None:
    client = ros.client
    ros.start('frame_pairing')
    client.subscribe(PathMessage, 'pairs')
    client.linked('pairs')
    raw = client.heard(Image, 'image', 'frame_pairing')
    compressed = client.publisher(CompressedImage, 'image/compressed')
    image = frames()[0].image
    for stamp in range(1, 5):
        raw.publish(mono8(stamp, image))
        compressed.publish(png(stamp, image))
        if stamp > 1:
            client.stamped('pairs', stamp)
    client.dropped('frame_pairing', 'other_transport')
    assert len(client.received['pairs']) == 3
    assert drops(client.statuses()['frame_pairing']).keys() == {
        'first_frame', 'unknown_encoding', 'other_transport'}


def png(stamp: int, image: np.ndarray) -> CompressedImage:
    message = CompressedImage(format='png')
    message.data.frombytes(cv2.imencode('.png', image)[1].tobytes())
    set_stamp(message, stamp, 'camera_optical')
    return message


def window(reference: int, current: int) -> PathMessage:
    from geometry_msgs.msg import PoseStamped
    message = PathMessage(poses=[PoseStamped(), PoseStamped()])
    for part, stamp in ((message.poses[0], reference), (message.poses[1], current),
                        (message, current)):
        set_stamp(part, stamp, 'camera_optical')
    message.poses[0].pose.position.z = -1.0
    return message


def test_a_node_that_comes_back_is_in_the_flow_again(ros: Graph) -> None:
    client = ros.client
    options = ('baseline.length:=0.15', 'stereo.matcher:=bm')
    processes = {name: ros.start(name, *options) for name in STAGES}
    client.subscribe(Image, 'depth/image')
    for topic, readers in (('frames', 3), ('pairs', 1), ('pairs/stabilised', 1),
                           ('pairs/aligned', 1), ('depth/image', 1)):
        client.linked(topic, readers)
    image = client.heard(Image, 'image', 'frame_pairing')
    stamp, sent, wanted = frames()[0].key.stamp, 0, 1

    def flows() -> bool:
        """Whether one more depth image came; else sends the next frame, as a camera does."""
        nonlocal stamp, sent
        if len(client.received['depth/image']) >= wanted:
            return True
        stamp, sent = stamp + 33_333_333, sent + 1
        image.publish(mono8(stamp, frames()[sent % 2].image))
        return False
    client.until(flows, 'depth')
    processes['pose_stabilisation'].process.kill()
    assert processes['pose_stabilisation'].ended() == -signal.SIGKILL
    # What is under way may still come out.
    client.linked('pairs/stabilised')
    wanted = len(client.received['depth/image']) + 6
    ros.start('pose_stabilisation', *options)
    client.until(flows, 'depth after the restart')
