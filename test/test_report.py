"""The report: its figures are those of the bag, its page stands alone and draws in a browser."""
from __future__ import annotations

import base64
import json
import re
import socket
import sys

import browser
import cv2
import numpy as np
import pytest
import room
from hypothesis import given
from hypothesis import strategies as st
from making_bags import T0

pytest.importorskip('jinja2')
pytest.importorskip('matplotlib')

from sphstereo_ros import cli
from sphstereo_ros.bench.scoring import solid_angle
from sphstereo_ros.core import rotations
from sphstereo_ros.core.frames import (
    AlignedWindow,
    Drop,
    Frame,
    FrameKey,
    PointCloud,
    Reference,
    RelativePose,
)
from sphstereo_ros.replay.bag_messages import make
from sphstereo_ros.replay.output import McapOutput
from sphstereo_ros.report import summary
from sphstereo_ros.report.clouds import certain, read_points, thinned
from sphstereo_ros.report.contents import spread
from sphstereo_ros.report.page import scene_data
from sphstereo_ros.report.tracks import (
    Track,
    laid_over,
    odometry_track,
    track_error,
    visual_track,
)
from sphstereo_ros.ros import conversions as convert

HEIGHT, STEP, COUNT, PERIOD = 120, 0.5, 5, 100_000_000
ERROR, SIGMA = 1.04, 0.05


def key(k, frame_id='camera_optical'):
    return FrameKey(T0 + k * PERIOD, frame_id)


def pose_of(k):
    """Camera k of a drive along a bend, in forward-left-up axes of the first."""
    turn = rotations.matrix_from_rpy(0, 0, 0.1 * k)
    return np.array([STEP * k, 0.05 * k * k, 0.01 * k]), turn


def window(k):
    """The aligned window of frames k and k − 1."""
    link = rotations.OPTICAL_FROM_LINK
    (before, earlier), (position, rotation) = pose_of(k - 1), pose_of(k)
    image = np.zeros((8, 16), np.uint8)
    return AlignedWindow(Frame(key(k), image), (Reference(Frame(key(k - 1), image), RelativePose(
        link @ rotation.T @ earlier @ link.T, link @ rotation.T @ (before - position))),))


def true_range(k):
    return room.view(np.array([0, 0, STEP * k]), np.eye(3), HEIGHT)[1].astype(np.float32)


def measured(k):
    """4 % too far; the upper half of the left side is unknown, that of the right side beyond."""
    depth = true_range(k) * np.float32(ERROR)
    depth[:HEIGHT // 2, :HEIGHT] = np.nan
    depth[:HEIGHT // 2, HEIGHT:] = np.inf
    return depth


def odometry(k):
    position, rotation = pose_of(k)
    x, y, z, w = rotations.quaternion_from_matrix(rotation)
    message = make('nav_msgs/msg/Odometry', header=convert.header(make, key(k, 'odom')),
                   child_frame_id='base_link')
    message.pose.pose.position = make('geometry_msgs/msg/Point',
                                      **dict(zip('xyz', map(float, position), strict=True)))
    message.pose.pose.orientation = make('geometry_msgs/msg/Quaternion', x=x, y=y, z=z, w=w)
    return message


def cloud(k, count=3000):
    """Points on a wall 5 m to the left, red, in base_link."""
    random = np.random.default_rng(k)
    xyz = np.stack([random.uniform(-4, 4, count), np.full(count, 5.0),
                    random.uniform(-1, 1, count)], axis=1).astype(np.float32)
    return PointCloud(key(k), xyz, np.full(count, SIGMA, np.float32),
                      bgr=np.full((count, 3), (20, 30, 220), np.uint8))


def diagnostics(k, **values):
    return convert.diagnostic_message(make, key(k).stamp, [convert.Status(
        'pipeline', 0, '', values)])


def scan(k):
    ranges = np.full(72, np.nan, np.float32)
    ranges[:30], ranges[30:40], ranges[40] = np.inf, 3.0, -np.inf
    return make('sensor_msgs/msg/LaserScan', header=convert.header(make, key(k, 'level')),
                angle_min=-np.pi, angle_max=np.pi, angle_increment=np.pi / 36, range_min=0.3,
                range_max=20.0, ranges=ranges)


def results():
    """Topic, frame and message of all that a run writes."""
    for k in range(1, COUNT):
        depth = measured(k)
        sigma = np.where(np.isfinite(depth), SIGMA, np.nan).astype(np.float32)
        for topic, message in {
                '/depth/image': convert.depth_message(make, key(k), depth),
                '/depth/sigma': convert.depth_message(make, key(k), sigma),
                '/pairs/aligned': convert.window_message(make, window(k)),
                '/odometry/visual': convert.odometry_message(make, window(k)),
                '/points': convert.cloud_message(make, cloud(k)),
                '/obstacles/scan': scan(k),
                '/diagnostics': diagnostics(k, frames_in=k + 1, frames_out=k, drops=k,
                                            **{'drops.no_parallax': k})}.items():
            yield topic, k, message


def inputs():
    for k in range(COUNT):
        grey = np.full((HEIGHT, 2 * HEIGHT), 90, np.uint8)
        yield '/odometry', k, odometry(k)
        yield '/image', k, convert.image_message(make, key(k), grey)
        yield '/ground_truth/range', k, convert.depth_message(make, key(k), true_range(k))


def write(path, messages, late=0):
    with McapOutput(path) as output:
        for topic, k, message in messages:
            output.write(topic, key(k).stamp + late * (topic != '/image'), message)
    return path


def run(*words):
    try:
        return cli.main([str(word) for word in words])
    except SystemExit as end:
        return end.code


@pytest.fixture(scope='module')
def reported(tmp_path_factory):
    folder = tmp_path_factory.mktemp('report')
    out = write(folder / 'out.mcap', results())
    given = write(folder / 'in.mcap', inputs())
    assert run('report', out, '--input', given, '-o', folder / 'page') == 0
    return folder / 'page'


# Figures

def test_figures_are_those_of_the_bag(reported):
    told = json.loads((reported / 'report.json').read_text())
    overview = told['overview']
    assert (overview['depth_images'], overview['images'], overview['metric']) == (4, 5, True)
    assert overview['seconds'] == pytest.approx(0.3)
    assert overview['known'] == pytest.approx(50)
    assert overview['beyond'] == pytest.approx(25)
    length = sum(np.linalg.norm(pose_of(k)[0] - pose_of(k - 1)[0]) for k in range(1, COUNT))
    assert overview['distance'] == pytest.approx(length)
    assert told['drops'] == [{'stage': 'pipeline', 'cause': 'no_parallax', 'count': 4}]
    assert (told['stages'][0]['frames_in'], told['stages'][0]['rate_in']) == (5, None)
    assert told['latency'] is None  # two bags tell no common time
    topics = {topic['topic']: topic for topic in told['topics']}
    assert (topics['/depth/image']['messages'], topics['/image']['messages']) == (4, 5)
    assert topics['/image']['rate'] == pytest.approx(10)
    assert topics['/image']['gap'] == pytest.approx(0.1)


def test_errors_are_those_against_the_truth(reported):
    accuracy = json.loads((reported / 'report.json').read_text())['accuracy']
    near = accuracy['bands'][0]
    assert (accuracy['frames'], near['band']) == (4, '0–10 m')
    assert near['median'] == pytest.approx(4, abs=1e-3)
    assert near['bad'] == 0
    weights = np.broadcast_to(solid_angle(HEIGHT), (HEIGHT, 2 * HEIGHT))
    # What is reported beyond is over 1.5 times too far, wherever the truth is near.
    danger = []
    for k in range(1, COUNT):
        near_by = true_range(k) < 10
        danger.append(100 * weights[near_by & np.isinf(measured(k))].sum()
                      / weights[near_by].sum())
    assert accuracy['danger'] == pytest.approx(np.mean(danger))
    assert near['within_1_sigma'] == pytest.approx(100 * np.mean([
        (np.abs(measured(k) - true_range(k)) < SIGMA)[np.isfinite(measured(k))].mean()
        for k in range(1, COUNT)]))


def test_tracks_are_compared(reported):
    given, visual = json.loads((reported / 'report.json').read_text())['tracks']
    assert (given['track'], given['poses'], given['rmse']) == ('/odometry', 5, None)
    assert visual['track'] == '/odometry/visual, chained'
    assert visual['length'] == pytest.approx(given['length'])
    assert visual['rmse'] < 1e-6


def test_cloud_is_placed_by_odometry(reported):
    content = (reported / 'cloud.ply').read_bytes()
    head, _, body = content.partition(b'end_header\n')
    count = int(re.search(rb'element vertex (\d+)', head)[1])
    points = np.frombuffer(body, np.dtype([('xyz', '<f4', 3), ('rgb', 'u1', 3), ('sigma', '<f4')]))
    assert len(points) == count == json.loads(
        (reported / 'report.json').read_text())['overview']['points'] == 4 * 3000
    assert (points['rgb'] == (220, 30, 20)).all()
    placed = np.concatenate([cloud(k).xyz @ pose_of(k)[1].T + pose_of(k)[0]
                             for k in range(1, COUNT)])
    np.testing.assert_allclose(points['xyz'], placed, atol=1e-4)


def test_pictures_lie_beside_the_page(reported):
    names = {path.stem for path in reported.glob('*.png')}
    assert names == {'frames', 'error_by_range', 'coverage_by_angle', 'sigma_calibration',
                     'error_picture', 'top_view', 'trajectory', 'obstacles'}
    for path in [*reported.glob('*.png'), *reported.glob('previews/*.png')]:
        assert cv2.imread(str(path)).std() > 5, path
    assert len(list(reported.glob('previews/*.png'))) == 4


# The page

def test_page_refers_to_nothing_outside(reported):
    page = (reported / 'index.html').read_text(encoding='utf-8')
    for link in re.findall(r'\b(?:src|href)="([^"]*)"', page):
        assert link.startswith(('data:', '#')), link[:80]
    assert "default-src 'none'" in page
    assert not re.search(r'@import|url\((?!data:)|fetch\(|XMLHttpRequest|WebSocket', re.sub(
        r'<script>/\*! three\.js.*?</script>', '', page, flags=re.DOTALL))


in_browser = pytest.mark.skipif(browser.PROGRAM is None, reason='there is no Chromium')


@pytest.fixture(scope='module')
def page(reported, tmp_path_factory):
    with browser.Browser(tmp_path_factory.mktemp('profile')) as opened:
        opened.open((reported / 'index.html').as_uri())
        yield opened


@in_browser
def test_no_request_leaves_the_page(page, reported):
    assert [url for url in page.requests if not url.startswith('data:')] == [
        (reported / 'index.html').as_uri()]
    assert page.errors == []


@in_browser
def test_canvas_draws_and_turns(page):
    assert page.value("document.getElementById('view').dataset.points") == '12000'
    before = page.picture('#view').astype(int)
    red = (before[..., 2] > 150) & (before[..., :2] < 100).all(axis=-1)
    assert red.mean() > 0.005
    place = '''(() => { document.getElementById('view').scrollIntoView({block: 'center'});
        const box = document.getElementById('view').getBoundingClientRect();
        return [box.x + box.width / 2, box.y + box.height / 2]; })()'''
    x, y = page.value(place)
    page.drag((x, y), (x + 120, y + 40))
    turned = page.picture('#view').astype(int)
    assert (np.abs(turned - before).max(axis=-1) > 40).mean() > 0.005
    page.value('''(() => { const menu = document.getElementById('colour'); menu.value = 'height';
        menu.dispatchEvent(new Event('change')); })()''')
    recoloured = page.picture('#view').astype(int)
    assert (np.abs(recoloured - turned).max(axis=-1) > 40).mean() > 0.005


@in_browser
def test_player_shows_the_frames(page):
    page.value("document.querySelectorAll('#strip img')[2].click()")
    assert page.value("document.getElementById('when').textContent") == '0.20 s'
    assert page.value('''document.getElementById('player-depth').src
        === document.querySelectorAll('#strip img')[2].src''')
    assert page.value("document.getElementById('play').textContent") == 'Play'
    assert page.value('''new Promise((done) => {
        const shown = document.getElementById('player-depth').src;
        document.getElementById('play').click();
        const timer = setInterval(() => {
            if (document.getElementById('player-depth').src === shown) return;
            clearInterval(timer);
            done(true);
        }, 20); })''')


@in_browser
def test_a_request_would_be_refused(reported, tmp_path):
    """What the tests above look at does see requests, and the page's policy stops them."""
    with socket.create_server(('127.0.0.1', 0)) as server:
        server.settimeout(0)
        picture = f'http://127.0.0.1:{server.getsockname()[1]}/a.png'
        page = (reported / 'index.html').read_text().replace(
            '<main>', f'<main><img src="{picture}">', 1)
        (tmp_path / 'guarded.html').write_text(page)
        with browser.Browser(tmp_path / 'profile') as opened:
            opened.open((tmp_path / 'guarded.html').as_uri())
            assert any('Content Security Policy' in error for error in opened.errors)
            with pytest.raises(BlockingIOError):
                server.accept()
            (tmp_path / 'open.html').write_text(f'<img src="{picture}">')
            server.close()
            opened.open((tmp_path / 'open.html').as_uri())
            assert picture in opened.requests


# Whatever bag

def told_of(folder):
    return json.loads((folder / 'report.json').read_text())


def test_live_recording_tells_latency_and_drops_over_a_restart(tmp_path):
    counts = {1: 3, 2: 5, 3: 1, 4: 2}  # the node was restarted after the second report
    messages = sorted([*((t, k, m) for t, k, m in inputs() if t == '/image'),
                       *((t, k, m) for t, k, m in results() if t == '/depth/image')],
                      key=lambda each: each[1])
    rates = {1: 0.0, 2: 9.5, 3: 9.0, 4: 0.0}
    messages += [('/diagnostics', k, diagnostics(k, frames_in=k, rate_out=rates[k],
                                                 latency_p50_ms=40 + k,
                                                 **{'drops.superseded': count}))
                 for k, count in counts.items()]
    bag = write(tmp_path / 'live.mcap', messages, late=30_000_000)
    assert run('report', bag, '-o', tmp_path / 'page') == 0
    told = told_of(tmp_path / 'page')
    assert told['latency'] == {'p50': 30.0, 'p95': 30.0, 'frames': 4}
    assert told['drops'] == [{'stage': 'pipeline', 'cause': 'superseded', 'count': 7}]
    stage, = told['stages']
    assert (stage['rate_out'], stage['latency_p50_ms'], stage['frames_in']) == (9.25, 44, 4)
    assert (tmp_path / 'page' / 'latency.png').is_file()
    assert told['accuracy'] is None
    assert told['overview']['points'] is None


def test_namespace_and_map_of_other_fields(tmp_path):
    points = np.zeros(500, np.dtype([('id', '<u2'), ('z', '<f8'), ('x', '<f4'), ('y', '<f4'),
                                     ('intensity', '<u2')]))
    points['x'], points['z'], points['intensity'] = np.arange(500), 7, 300
    points['y'][::5] = np.nan
    fields = [make('sensor_msgs/msg/PointField', name=name, datatype=kind, count=1,
                   offset=points.dtype.fields[name][1]) for name, kind in
              (('x', 7), ('y', 7), ('z', 8), ('intensity', 4))]
    message = make('sensor_msgs/msg/PointCloud2', header=convert.header(make, key(1, 'map')),
                   height=1, width=500, fields=fields, point_step=points.itemsize,
                   row_step=500 * points.itemsize, data=points.view(np.uint8))
    bag = write(tmp_path / 'map.mcap', [('/robot/map', 1, message), ('/robot/odometry', 1,
                                                                     odometry(1))])
    assert run('report', bag, '-o', tmp_path / 'page') == 0
    told = told_of(tmp_path / 'page')
    assert told['overview']['points'] == 400
    assert told['overview']['cloud_source'] == 'the map'
    assert [t['topic'] for t in told['topics']] == ['/map', '/odometry']
    read = read_points(message)
    np.testing.assert_array_equal(read.xyz[:, 0], [x for x in range(500) if x % 5])
    assert (read.xyz[:, 2] == 7).all()
    assert (read.intensity == 255).all()
    assert np.isnan(read.sigma).all()


def test_a_map_is_in_the_frame_of_its_own_track(tmp_path):
    def tracks_of(name, *topics):
        bag = write(tmp_path / f'{name}.mcap', [(topic, k, odometry(k)) for k in range(3)
                                                for topic in ('/odometry', '/map/odometry')]
                    + list(topics))
        assert run('report', bag, '-o', tmp_path / name) == 0
        return [track['track'] for track in told_of(tmp_path / name)['tracks']]
    points = convert.cloud_message(make, cloud(1))
    assert tracks_of('one', ('/map', 1, points)) == ['/map/odometry', '/odometry']
    assert tracks_of('two', ('/points', 1, points)) == ['/odometry', '/map/odometry']


def test_relative_depth_alone(tmp_path, capsys):
    bag = write(tmp_path / 'relative.mcap', [
        ('/depth/relative', k, convert.depth_message(make, key(k), measured(k)))
        for k in range(3)])
    assert run('report', bag, '-o', tmp_path / 'page') == 0
    assert 'No length is known' in (tmp_path / 'page' / 'index.html').read_text()
    assert told_of(tmp_path / 'page')['overview']['metric'] is False
    assert 'index.html' in capsys.readouterr().out


def test_obstacles_alone(tmp_path):
    bag = write(tmp_path / 'scan.mcap', [('/obstacles/scan', 1, scan(1))])
    assert run('report', bag, '-o', tmp_path / 'page') == 0
    assert {p.name for p in (tmp_path / 'page').iterdir()} == {
        'index.html', 'report.json', 'obstacles.png'}


def test_damaged_messages_are_counted(tmp_path):
    good = convert.depth_message(make, key(1), measured(1))
    bad = convert.depth_message(make, key(2), measured(2))
    bad.step = 3
    bag = write(tmp_path / 'bad.mcap', [('/depth/image', 1, good), ('/depth/image', 2, bad)])
    assert run('report', bag, '-o', tmp_path / 'page') == 0
    assert told_of(tmp_path / 'page')['unreadable'] == {'/depth/image': 1}
    assert '1 message could not be read' in (tmp_path / 'page' / 'index.html').read_text()


@pytest.fixture
def results_bag(tmp_path):
    return write(tmp_path / 'out.mcap', results())


def refused(capsys, *words):
    """The one line that refuses these words."""
    assert run('report', *words) == 2
    out, err = capsys.readouterr()
    assert not out
    assert err.count('\n') == 1, err
    return err


def test_bad_input_is_refused_in_one_line(tmp_path, capsys, results_bag):
    out = ('-o', tmp_path / 'page')
    plain = write(tmp_path / 'in.mcap', inputs())
    assert 'holds no results' in refused(capsys, plain, *out)
    assert 'does not exist' in refused(capsys, tmp_path / 'none.mcap', *out)
    (tmp_path / 'empty.mcap').touch()
    assert 'is empty' in refused(capsys, tmp_path / 'empty.mcap', *out)
    (tmp_path / 'file').write_text('')
    assert 'is a file' in refused(capsys, results_bag, '-o', tmp_path / 'file')
    (tmp_path / 'page').mkdir()
    (tmp_path / 'page' / 'index.html').mkdir()
    assert 'cannot write' in refused(capsys, results_bag, *out)


def test_truncated_bag_is_refused_unless_partial(tmp_path, capsys, results_bag):
    cut = tmp_path / 'cut.mcap'
    with McapOutput(tmp_path / 'long.mcap') as output:  # several chunks
        for k in range(12):
            noise = np.random.default_rng(k).uniform(1, 9, (480, 960)).astype(np.float32)
            output.write('/depth/image', key(k).stamp, convert.depth_message(make, key(k), noise))
    content = (tmp_path / 'long.mcap').read_bytes()
    cut.write_bytes(content[:2 * len(content) // 3])
    line = refused(capsys, cut, '-o', tmp_path / 'page')
    assert 'truncated after' in line
    assert '--partial' in line
    assert not (tmp_path / 'page').exists()
    assert run('report', cut, '-o', tmp_path / 'page', '--partial') == 0
    told = told_of(tmp_path / 'page')
    assert 2 <= told['overview']['depth_images'] < 12
    assert 'truncated after' in told['problems'][0]
    assert 'could not be read to its end' in (tmp_path / 'page' / 'index.html').read_text()


def test_missing_extra_is_said_in_one_line(capsys, monkeypatch, results_bag, tmp_path):
    monkeypatch.setitem(sys.modules, 'sphstereo_ros.report.page', None)
    monkeypatch.delitem(sys.modules, 'sphstereo_ros.report.page')
    monkeypatch.setitem(sys.modules, 'jinja2', None)
    line = refused(capsys, results_bag, '-o', tmp_path / 'page')
    assert 'jinja2' in line
    assert 'pip install' in line


# Parts

@given(st.integers(0, 500), st.integers(1, 40))
def test_spread_is_even(count, most):
    items = list(range(count))
    chosen = spread(items, most)
    assert len(chosen) == min(count, most)
    assert len(set(chosen)) == len(chosen)
    if most > 1 and count > 1:
        assert (chosen[0], chosen[-1]) == (0, count - 1)
        assert np.ptp(np.diff(chosen)) <= 1


@given(st.integers(1, 3000), st.integers(1, 400), st.integers(0, 2**32 - 1))
def test_thinning_keeps_the_most_certain(count, most, seed):
    random = np.random.default_rng(seed)
    whole = PointCloud(key(0), random.normal(0, 3, (count, 3)).astype(np.float32),
                       random.permutation(count).astype(np.float32),
                       intensity=random.integers(0, 256, count, np.uint8))
    few = thinned(whole, most)
    assert len(few.xyz) <= most
    assert len(few.xyz) == len(few.sigma) == len(few.intensity) >= 1
    assert few.sigma.min() == 0  # it is the most certain of its voxel, whichever that is
    places = few.sigma.astype(int)
    order = np.argsort(whole.sigma)
    np.testing.assert_array_equal(few.xyz, whole.xyz[order][places])
    np.testing.assert_array_equal(few.intensity, whole.intensity[order][places])


def test_certain_points_alone_are_accumulated():
    xyz = np.array([[10, 0, 0], [10, 0, 0], [70, 0, 0]], np.float32)
    sigma = np.array([0.4, 0.6, 0.1], np.float32)
    assert certain(PointCloud(key(0), xyz, sigma)).sigma.tolist() == [np.float32(0.4)]
    unknown = PointCloud(key(0), xyz, np.full(3, np.nan, np.float32))
    assert len(certain(unknown).xyz) == 2


def test_steps_of_odometry_visual_make_a_track():
    steps = [convert.odometry_message(make, window(k)) for k in range(1, COUNT)]
    paths = [convert.window_message(make, window(k)) for k in range(1, COUNT)]
    for track in (visual_track('v', [], steps), visual_track('v', paths, [])):
        assert np.abs(track.stamps - [key(k).stamp for k in range(COUNT)]).max() < 2000
        for k in range(COUNT):
            np.testing.assert_allclose(track.positions[k], pose_of(k)[0], atol=1e-9)
            np.testing.assert_allclose(track.orientations[k], pose_of(k)[1], atol=1e-9)
    # A gap begins anew; the longer part counts.
    assert visual_track('v', [], steps[:1] + steps[2:]).stamps[0] == key(2).stamp
    assert visual_track('v', [], []) is None


def test_steps_without_metres_make_no_track():
    far = window(1)
    reference = far.references[0]
    unscaled = AlignedWindow(far.current, (Reference(reference.frame, RelativePose(
        reference.pose.rotation, reference.pose.position * 1e-6)),))
    assert visual_track('v', [convert.window_message(make, unscaled)],
                        [convert.odometry_message(make, unscaled)]) is None


def test_error_of_a_track_is_free_of_its_frame_but_not_of_its_scale():
    given = odometry_track('given', [odometry(k) for k in range(COUNT)])
    turn = rotations.matrix_from_rpy(0.3, -0.2, 1.0)
    other = Track('other', given.stamps, given.positions @ turn.T + 5,
                  turn @ given.orientations)
    assert track_error(other, given).greatest < 1e-9
    np.testing.assert_allclose(laid_over(other, given).positions, given.positions, atol=1e-9)
    longer = Track('longer', given.stamps, 1.1 * given.positions, given.orientations)
    centred = given.positions - given.positions.mean(0)
    assert track_error(longer, given).rmse == pytest.approx(
        0.1 * np.sqrt((centred**2).sum(axis=1).mean()))
    middle = given.at(key(0).stamp + PERIOD // 2)
    np.testing.assert_allclose(middle[0], (pose_of(0)[0] + pose_of(1)[0]) / 2)
    np.testing.assert_allclose(middle[1], rotations.matrix_from_rpy(0, 0, 0.05), atol=1e-9)
    assert given.at(key(0).stamp - PERIOD) is None
    assert given.at(key(COUNT).stamp) is None


def test_page_holds_the_points():
    whole = cloud(1)
    data = scene_data(whole, [])
    steps = np.frombuffer(base64.b64decode(data['positions']), '<u2').reshape(-1, 3)
    np.testing.assert_allclose(steps * data['step'] + data['origin'], whole.xyz,
                               atol=data['step'])
    assert data['step'] < 2e-4
    codes = np.frombuffer(base64.b64decode(data['sigma']), np.uint8)
    assert 10 ** ((codes[0] - 1) / 254 * 4 - 3) == pytest.approx(SIGMA, rel=0.02)
    colours = np.frombuffer(base64.b64decode(data['colours']), np.uint8)
    assert colours[:3].tolist() == [220, 30, 20]


@pytest.mark.parametrize(('change', 'cause'), [
    ({'fields': []}, 'unknown_fields'), ({'point_step': 8}, 'unknown_fields'),
    ({'width': 7}, 'wrong_data_length'), ({'row_step': 1}, 'wrong_data_length')])
def test_clouds_that_cannot_be_read(change, cause):
    message = convert.cloud_message(make, cloud(1))
    for name, value in change.items():
        setattr(message, name, value)
    drop = read_points(message)
    assert isinstance(drop, Drop)
    assert drop.cause == cause


def test_no_diagnostics_is_no_row():
    assert (summary.drops([]), summary.stages([])) == ([], [])
