"""Two cameras over DDS: values, a camera that dies and returns, stamps that differ, bad input."""
from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

pytest.importorskip('rclpy')

from nav_msgs.msg import Path as PathMessage
from ros_graph import Graph, drops, graph, mono8, set_stamp
from sensor_msgs.msg import CompressedImage, Image, PointCloud2
from two_cameras import BASELINE, PERIOD, frame, parameters, turn, view

from sphstereo_ros.core.chain import Chain, StageResults
from sphstereo_ros.core.config import resolve
from sphstereo_ros.core.rotations import matrix_from_quaternion
from sphstereo_ros.core.synchronisation import PATIENCE, Side

GIVEN = parameters(stereo__matcher='bm', pairing__fallback=True, pairing__intervals=[1])
STAGES = ('frame_pairing', 'pose_stabilisation', 'motion_alignment', 'spherical_stereo')
PAIRING = 'pipeline: frame_pairing'
APART = 20_000_000
MOVED = 0.25


@pytest.fixture
def ros(tmp_path: Path) -> Iterator[Graph]:
    with graph(tmp_path) as made:
        yield made


def words(**more: object) -> list[str]:
    return [f'{name}:={str(value).lower() if isinstance(value, bool) else value}'
            for name, value in {**GIVEN, **more}.items()]


def stamp(k: int) -> int:
    return (k + 1) * PERIOD


def raw(side: Side, k: int, forward: float = 0.0, apart: int = 0) -> Image:
    return mono8(stamp(k) + apart, view(side, forward).image, f'{side}_camera')


def png(side: Side, k: int) -> CompressedImage:
    message = CompressedImage(format='png')
    message.data.frombytes(cv2.imencode('.png', view(side).image)[1].tobytes())
    set_stamp(message, stamp(k), f'{side}_camera')
    return message


def floats(message: Image) -> np.ndarray:
    assert message.encoding == '32FC1'
    return np.frombuffer(message.data, np.float32).reshape(message.height, message.width)


def truth() -> StageResults:
    """What the core makes of a pair at rest."""
    chain = Chain(resolve(GIVEN))
    chain.add_view('top', frame('top', stamp(0)))
    result, = chain.add_view('bottom', frame('bottom', stamp(0)))
    assert isinstance(result, StageResults)
    return result


def test_four_processes_give_what_the_core_gives(ros: Graph) -> None:
    """The top camera raw, the bottom one compressed."""
    client = ros.client
    for name in STAGES:
        ros.start(name, *words())
    for topic, kind in (('pairs', PathMessage), ('pairs/aligned', PathMessage),
                        ('depth/image', Image), ('depth/sigma', Image), ('points', PointCloud2),
                        ('frames', Image)):
        client.subscribe(kind, topic)
    for topic, readers in (('frames', 4), ('pairs', 2), ('pairs/stabilised', 1),
                           ('pairs/aligned', 2), ('pairs/aligned/covariance', 1),
                           ('depth/image', 1)):
        client.linked(topic, readers)
    top = client.heard(Image, 'top/image', 'frame_pairing')
    bottom = client.heard(CompressedImage, 'bottom/image/compressed', 'frame_pairing')
    expected = truth()
    for k in range(2):
        bottom.publish(png('bottom', k))
        top.publish(raw('top', k))
        depth = client.stamped('depth/image', stamp(k))
        assert depth.header.frame_id == 'bottom_camera'
        np.testing.assert_allclose(floats(depth), expected.range_image.range, rtol=1e-5)
        np.testing.assert_allclose(floats(client.stamped('depth/sigma', stamp(k))),
                                   expected.range_image.sigma, rtol=1e-3)
        reference, current = client.stamped('pairs/aligned', stamp(k)).poses
        assert (reference.header.frame_id, current.header.frame_id) == ('top_camera',
                                                                        'bottom_camera')
        p, q = reference.pose.position, reference.pose.orientation
        np.testing.assert_allclose([p.x, p.y, p.z], [0, -BASELINE, 0], atol=1e-9)
        np.testing.assert_allclose(matrix_from_quaternion([q.x, q.y, q.z, q.w]), turn(),
                                   atol=1e-9)
        assert client.stamped('points', stamp(k)).width == len(expected.cloud.xyz)
    for name in STAGES:
        told = drops(client.statuses()[name])
        assert set(told) <= {'unknown_encoding', 'empty_image'}, told


def test_a_camera_dies_and_returns(ros: Graph) -> None:
    """The other goes on without scale; where both are there, metres."""
    lost: Side = 'bottom'
    alive: Side = 'top'
    client = ros.client
    ros.start('pipeline', *words())
    for topic in ('depth/image', 'depth/relative'):
        client.subscribe(Image, topic)
        client.linked(topic)
    send = {side: client.heard(Image, f'{side}/image', PAIRING) for side in (lost, alive)}

    def pair(k: int, forward: float) -> None:
        for side, publisher in send.items():
            publisher.publish(raw(side, k, forward))
        np.testing.assert_array_equal(
            client.stamped('depth/image', stamp(k)).header.frame_id, 'bottom_camera')

    pair(0, 0.0)
    for k in range(1, PATIENCE + 4):
        send[alive].publish(raw(alive, k, MOVED * k))
        if k > PATIENCE + 1:
            depth = client.stamped('depth/relative', stamp(k))
            assert depth.header.frame_id == f'{alive}_camera'
            true = view(alive, MOVED * k).range
            assert np.nanmedian(floats(depth)) == pytest.approx(np.median(true) / MOVED, rel=0.1)
    client.until(lambda: client.statuses()[PAIRING].message.startswith(
        f'{lost} camera silent, the other continues as monocular'), 'a warning')
    k = PATIENCE + 4
    send[lost].publish(raw(lost, k, MOVED * k))
    send[alive].publish(raw(alive, k, MOVED * k))
    pair(k + 1, MOVED * (k + 1))
    client.until(lambda: 'silent' not in client.statuses()[PAIRING].message, 'no more warning')
    values = {v.key: v.value for v in client.statuses()[PAIRING].values}
    assert values['cameras'] == 'binocular'


def test_stamps_that_differ_and_bad_input(ros: Graph) -> None:
    client = ros.client
    process = ros.start('pipeline', *words(**{'pairing.tolerance': 0.025}))
    client.subscribe(Image, 'depth/image')
    client.linked('depth/image')
    top = client.heard(Image, 'top/image', PAIRING)
    bottom = client.heard(Image, 'bottom/image', PAIRING)
    jitter = np.random.default_rng(0).integers(-4_000_000, 4_000_000, 5)
    for k, extra in enumerate(jitter):
        bottom.publish(raw('bottom', k))
        top.publish(raw('top', k, apart=APART + int(extra)))
        client.stamped('depth/image', stamp(k))
    bottom.publish(raw('bottom', 5))
    top.publish(raw('top', 5, apart=2 * APART))
    client.dropped(PAIRING, 'top_missing')
    top.publish(raw('top', 5, apart=2 * APART))
    client.dropped(PAIRING, 'top_duplicate')
    top.publish(raw('top', 5))
    client.dropped(PAIRING, 'top_out_of_order')
    small = raw('bottom', 6)
    small.data, small.height, small.width, small.step = small.data[:8 * 16], 8, 16, 16
    top.publish(raw('top', 6))
    bottom.publish(small)
    client.dropped(PAIRING, 'sizes_differ', 2)
    for k in (7, 8):
        bottom.publish(raw('bottom', k))
        top.publish(raw('top', k))
    client.stamped('depth/image', stamp(8))
    assert process.process.poll() is None
    assert 'internal_error' not in process.log
