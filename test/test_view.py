"""Live viewing: what Rerun is told of each message, files for RViz and Foxglove."""
from __future__ import annotations

import json
import re
import signal
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from making_bags import STEP, T0, drive, write_bag

from sphstereo_ros import cli
from sphstereo_ros.core.frames import Drop, FrameKey, PointCloud
from sphstereo_ros.replay.bag_messages import TYPESTORE, make
from sphstereo_ros.replay.offline import TOPICS
from sphstereo_ros.replay.sources import IMAGE_TOPICS, MOTION_TOPICS, STEREO_TOPICS
from sphstereo_ros.ros import conversions as convert
from sphstereo_ros.ros.obstacle_messages import LEVEL_FRAME, OUTPUTS
from sphstereo_ros.view.topics import DEPTHS, VIEWED, viewed

CONFIG = Path(__file__).resolve().parent.parent / 'config'
KEY = FrameKey(T0, 'camera_optical')
# A map is accumulated by a node of its own.
TYPES = {**IMAGE_TOPICS, **STEREO_TOPICS, **MOTION_TOPICS, **VIEWED, **DEPTHS,
         **{f'/{topic}': kind for topic, (kind, _) in OUTPUTS.items()}}


def run(*words):
    try:
        return cli.main([str(word) for word in words])
    except SystemExit as end:
        return end.code


# Files

def displays():
    content = yaml.safe_load((CONFIG / 'sphstereo.rviz').read_text())
    return content['Visualization Manager']


@pytest.mark.parametrize('display', [d for d in displays()['Displays'] if 'Topic' in d],
                         ids=lambda d: d['Name'])
def test_rviz_shows_topics_as_they_are_published(display):
    shown = {'PointCloud2': 'sensor_msgs/msg/PointCloud2', 'Image': 'sensor_msgs/msg/Image',
             'LaserScan': 'sensor_msgs/msg/LaserScan', 'Odometry': 'nav_msgs/msg/Odometry',
             'MarkerArray': 'visualization_msgs/msg/MarkerArray'}
    topic = display['Topic']
    assert TYPES[topic['Value']] == shown[display['Class'].removeprefix('rviz_default_plugins/')]
    given = topic['Value'] in {**IMAGE_TOPICS, **MOTION_TOPICS}  # by whoever, in whatever quality
    assert topic['Reliability Policy'] == ('Best Effort' if given else 'Reliable')
    assert (topic['Durability Policy'], topic['History Policy']) == ('Volatile', 'Keep Last')
    assert topic['Depth'] > 0


def test_rviz_shows_the_main_results():
    manager = displays()
    assert manager['Global Options']['Fixed Frame'] == 'base_link'
    assert manager['Views']['Current']['Target Frame'] == 'base_link'
    assert {'/points', '/map', '/obstacles/markers', '/depth/preview', '/image'} <= {
        d['Topic']['Value'] for d in manager['Displays'] if 'Topic' in d}


def test_foxglove_layout_names_topics_and_panels_that_are_there():
    layout = json.loads((CONFIG / 'foxglove_layout.json').read_text())
    text = json.dumps(layout)
    topics = set(re.findall(r'"(/[a-z/_]+)[".]', text))
    assert {'/points', '/map', '/depth/preview', '/diagnostics', '/obstacles/nearest'} <= topics
    assert topics <= set(TYPES)

    def panels(node):
        return [node] if isinstance(node, str) else panels(node['first']) + panels(node['second'])
    assert sorted(panels(layout['layout'])) == sorted(layout['configById'])
    for plot in layout['configById']['Plot!obstacles']['paths']:
        topic, _, field = plot['value'].partition('.')
        assert field in {name for name, _ in TYPESTORE.fielddefs[TYPES[topic]][1]}
    cloud = layout['configById']['3D!cloud']
    assert cloud['followTf'] in ('base_link', LEVEL_FRAME)


def test_what_is_viewed_has_the_type_that_is_published():
    published = {topic for topic in VIEWED if topic in TOPICS}
    assert published >= {'/depth/preview', '/points', '/obstacles/scan'}
    for topic in VIEWED:
        known = {**IMAGE_TOPICS, **STEREO_TOPICS, **MOTION_TOPICS,
                 **{f'/{name}': kind for name, (kind, _) in OUTPUTS.items()}}.get(topic)
        assert known in (None, VIEWED[topic])


def test_depth_is_viewed_only_without_a_preview():
    image = 'sensor_msgs/msg/Image'
    assert viewed([('/a/depth/image', image), ('/odometry', 'x'), ('/diagnostics', VIEWED[
        '/diagnostics'])], '/a') == {'/a/depth/image': '/depth/image',
                                     '/diagnostics': '/diagnostics'}
    assert viewed([('/depth/image', image), ('/depth/preview', image)]) == {
        '/depth/preview': '/depth/preview'}


# Rerun

@pytest.fixture
def scene():
    """A scene in a stream that remembers what it is told."""
    pytest.importorskip('rerun')
    from sphstereo_ros.view.scene import Scene

    class Stream:
        def __init__(self):
            self.logged, self.time = {}, None

        def set_time(self, timeline, timestamp):
            assert timeline == 'stamp'
            self.time = timestamp

        def log(self, path, what, static=False):
            name = '/'.join(path) if isinstance(path, list) else path
            self.logged[name] = (what, None if static else self.time)

    return Scene(Stream())


def logged(scene, path):
    return scene._stream.logged[path][0]


def numbers(batch):
    return np.array(batch.as_arrow_array().to_pylist())


def test_cloud_keeps_places_and_colours(scene):
    xyz = np.arange(9, dtype=np.float32).reshape(3, 3)
    bgr = np.array([[1, 2, 3], [4, 5, 6], [7, 8, 9]], np.uint8)
    cloud = PointCloud(KEY, xyz, np.full(3, 0.1, np.float32), bgr=bgr)
    scene.show('/points', convert.cloud_message(make, cloud))
    shown = logged(scene, 'world/base_link/points')
    np.testing.assert_array_equal(numbers(shown.positions), xyz)
    assert [f'{c:08x}' for c in numbers(shown.colors)] == ['030201ff', '060504ff', '090807ff']
    assert scene._stream.time == np.datetime64(T0, 'ns')
    scene.show('/map', convert.cloud_message(make, cloud, 'odom'))
    np.testing.assert_array_equal(numbers(logged(scene, 'world/map').positions), xyz)


def test_odometry_moves_the_vehicle_and_levels_the_obstacles(scene):
    message = make('nav_msgs/msg/Odometry', header=convert.header(make, FrameKey(T0, 'odom')))
    message.pose.pose.position.x = 2.0
    half = np.pi / 8
    message.pose.pose.orientation = make('geometry_msgs/msg/Quaternion', x=np.sin(half), y=0.0,
                                         z=0.0, w=np.cos(half))  # 45° of roll
    scene.show('/odometry', message)
    pose, level = (logged(scene, f'world/{name}') for name in ('base_link', 'level'))
    np.testing.assert_allclose(numbers(pose.translation)[0], [2, 0, 0])
    np.testing.assert_allclose(numbers(level.mat3x3)[0], np.eye(3).ravel(), atol=1e-6)
    column_major = numbers(pose.mat3x3)[0].reshape(3, 3).T
    np.testing.assert_allclose(column_major @ [0, 1, 0], [0, 0.5**0.5, 0.5**0.5], atol=1e-6)
    scene.show('/odometry', message)
    assert np.shape(numbers(logged(scene, 'world/track').strips)) == (1, 2, 3)


def test_scan_shows_measured_and_free_but_not_unknown(scene):
    ranges = np.array([3.0, np.inf, np.nan, -np.inf], np.float32)
    scene.show('/obstacles/scan', make(
        'sensor_msgs/msg/LaserScan', header=convert.header(make, KEY), angle_min=0.0,
        angle_increment=np.pi / 2, range_min=0.5, range_max=20.0, ranges=ranges))
    shown = logged(scene, 'world/level/obstacles')
    reach = np.linalg.norm(numbers(shown.strips), axis=2)
    np.testing.assert_allclose(reach, [[3, 3], [20, 20], [0.5, 0.5]], rtol=1e-5)
    red, green, near = numbers(shown.colors)
    assert red == near != green
    first = numbers(shown.strips)[0]
    assert np.degrees(np.arctan2(first[:, 1], first[:, 0])).tolist() == pytest.approx([-45, 45])


def test_pictures_and_depth(scene):
    bgr = np.zeros((60, 120, 3), np.uint8)
    bgr[..., 2] = 200
    for topic, path in (('/image', 'camera'), ('/depth/preview', 'depth/preview')):
        scene.show(topic, convert.image_message(make, KEY, bgr))
        data = bytes(logged(scene, path).blob.as_arrow_array().to_pylist()[0])
        picture = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
        assert np.abs(picture.reshape(-1, 3).mean(0) - (0, 0, 200)).max() < 4
    depth = np.full((60, 120), np.nan, np.float32)
    scene.show('/depth/image', convert.depth_message(make, KEY, depth))
    data = bytes(logged(scene, 'depth/preview').blob.as_arrow_array().to_pylist()[0])
    assert cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR).max() < 40


def test_diagnostics_are_plotted_and_told(scene):
    scene.show('/diagnostics', convert.diagnostic_message(make, T0, [
        convert.Status('stereo', 1, 'slow', {'rate_out': '9.5', 'latency_p50_ms': 'none',
                                             'drops.superseded': 4, 'drops.other': 0})]))
    assert numbers(logged(scene, 'plots/stereo, Hz').scalars).tolist() == [9.5]
    assert 'plots/stereo, ms' not in scene._stream.logged
    text = logged(scene, 'diagnostics')
    assert text.text.as_arrow_array().to_pylist() == ['stereo: slow (dropped: 4 superseded)']
    assert text.level.as_arrow_array().to_pylist() == ['WARN']


def test_what_cannot_be_shown_is_counted(scene):
    bad = convert.depth_message(make, KEY, np.ones((8, 16), np.float32))
    bad.step = 1
    scene.show('/depth/image', bad)
    scene.show('/points', Drop('undecodable_message'))
    assert (scene.shown, scene.unreadable) == ({}, {'/depth/image': 1, '/points': 1})
    free = make('sensor_msgs/msg/Range', header=convert.header(make, KEY), range=np.inf)
    scene.show('/obstacles/nearest', free)
    assert scene.shown == {'/obstacles/nearest': 1}
    assert 'plots/nearest obstacle, m' not in scene._stream.logged


# The command

def entities(path):
    """Paths that a recording has, as Rerun's own reader prints them."""
    printed = subprocess.run([sys.executable, '-m', 'rerun', 'rrd', 'print', str(path)],
                             capture_output=True, text=True, check=True, timeout=60)
    return set(re.findall(r'(?<= )/[a-z_/]+', printed.stdout))


def test_bag_into_a_file(tmp_path, capsys):
    pytest.importorskip('rerun')
    bag = write_bag(tmp_path / 'bag', drive(4))
    points = PointCloud(KEY, np.ones((5, 3), np.float32), np.ones(5, np.float32),
                        intensity=np.zeros(5, np.uint8))
    other = write_bag(tmp_path / 'results', [
        ('/robot/points', T0 + k * STEP, convert.cloud_message(make, points)) for k in range(2)])
    out = tmp_path / 'out.rrd'
    assert run('view', other, bag, '--save', out) == 0
    assert 'shown: 4 /image/compressed, 4 /odometry, 2 /points\n' in capsys.readouterr().out
    assert {'/camera', '/world/base_link', '/world/base_link/points',
            '/world/track'} <= entities(out)


def refused(capsys, *words):
    assert run('view', *words) == 2
    out, err = capsys.readouterr()
    assert not out
    assert err.count('\n') == 1, err
    return err


def test_bad_usage_is_refused_in_one_line(tmp_path, capsys, monkeypatch):
    pytest.importorskip('rerun')
    bag = write_bag(tmp_path / 'bag', drive(2))
    assert 'give a bag, or --live' in refused(capsys)
    assert 'give a bag, or --live' in refused(capsys, bag, '--live')
    assert 'does not exist' in refused(capsys, tmp_path / 'none')
    assert 'is the input' in refused(capsys, bag, '--save', bag)
    assert 'cannot write' in refused(capsys, bag, '--save', tmp_path / 'none' / 'a.rrd')
    nothing = write_bag(tmp_path / 'twist', [('/twist', T0, make(
        'geometry_msgs/msg/TwistStamped', header=convert.header(make, KEY)))])
    assert 'holds nothing to view' in refused(capsys, nothing)
    monkeypatch.setitem(sys.modules, 'rerun', None)
    assert 'pip install rerun-sdk' in refused(capsys, bag)


def test_running_topics(tmp_path):
    pytest.importorskip('rerun')
    pytest.importorskip('rclpy')
    from ros_graph import Client, NodeProcess, environment
    from sensor_msgs.msg import PointCloud2

    from sphstereo_ros.ros.live_messages import make as make_live
    private = environment()
    out = tmp_path / 'live.rrd'
    view = NodeProcess('import sys; from sphstereo_ros.cli import main; sys.exit(main())', private,
                       tmp_path / 'log', 'view', '--live', '--namespace', 'robot', '--save',
                       str(out))
    client = Client(int(private['ROS_DOMAIN_ID']))
    try:
        noise = np.random.default_rng(1).normal(0, 3, (50_000, 3)).astype(np.float32)
        message = convert.cloud_message(make_live, PointCloud(
            KEY, noise, np.ones(50_000, np.float32), intensity=np.zeros(50_000, np.uint8)))
        publisher = client.publisher(PointCloud2, '/robot/points')
        before = out.stat().st_size
        timer = client.node.create_timer(0.2, lambda: publisher.publish(message))
        client.until(lambda: out.stat().st_size > before + 300_000, 'a cloud in the file')
        client.node.destroy_timer(timer)
        assert view.stop(signal.SIGINT) == 0
    finally:
        client.close()
        view.process.kill()
    assert re.search(r'shown: [1-9]\d* /points\n', view.log), view.log
    assert '/world/base_link/points' in entities(out)
