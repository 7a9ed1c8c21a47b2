"""`sphstereo calibrate`: pairs by stamps, the parameter file, the pictures, and refusals."""
from __future__ import annotations

import math
from pathlib import Path

import analytic_world
import cv2
import numpy as np
import pytest
from analytic_world import World
from hypothesis import given
from hypothesis import strategies as st
from making_bags import T0, write_bag
from test_calibration import BASELINE, turned

from sphstereo_ros import cli
from sphstereo_ros.cli.calibrate import paired_stamps, spread
from sphstereo_ros.core import rotations
from sphstereo_ros.core.epipolar_picture import LARGE, SMALL, residual_map, residual_picture
from sphstereo_ros.core.frames import Frame, FrameKey
from sphstereo_ros.core.relative_pose import Correspondences
from sphstereo_ros.replay.bag_messages import make
from sphstereo_ros.replay.parameter_files import load_config
from sphstereo_ros.ros import conversions as convert

UP = np.array([0.0, -1.0, 0.0])
WORLD = World(cell=0.5)
HEIGHT = 160
RPY = tuple(math.radians(a) for a in (3.0, -2.0, 4.0))
APART = 4_000_000  # ns between the stamps of a pair
STEP = 100_000_000


def calibrate(*words) -> int:
    try:
        return cli.main(['calibrate', *(str(word) for word in words)])
    except SystemExit as end:
        return end.code


def messages(pairs, top_topic='/top/image', bottom_topic='/bottom/image'):
    """Pairs of (top, bottom) pictures, STEP apart, the top one a little later."""
    for k, pictures in enumerate(pairs):
        for topic, image, late in zip((bottom_topic, top_topic), pictures[::-1], (0, APART),
                                      strict=True):
            stamp = T0 + k * STEP + late
            message = convert.frame_message(make, Frame(FrameKey(stamp, topic[1:4]), image))
            yield topic, stamp, message


@pytest.fixture(scope='module')
def pictures():
    """(top, bottom) from three places."""
    places = [np.array(p) for p in ((0.0, 0.0, 0.0), (0.4, 0.1, -1.5), (-0.5, -0.2, 1.0))]
    return [tuple(analytic_world.look(WORLD, place + up, turn, HEIGHT).image
                  for up, turn in ((BASELINE * UP, turned(RPY)), (0 * UP, np.eye(3))))
            for place in places]


@pytest.fixture(scope='module')
def bag(pictures, tmp_path_factory):
    return write_bag(tmp_path_factory.mktemp('rig') / 'bag', messages(pictures))


def angles(path) -> np.ndarray:
    camera = load_config([path]).camera
    return np.degrees([camera.top_roll, camera.top_pitch, camera.top_yaw])


def test_it_writes_what_the_nodes_load(bag, tmp_path, capsys):
    out = tmp_path / 'rig.yaml'
    assert calibrate(bag, '--out', out) == 0
    np.testing.assert_allclose(angles(out), np.degrees(RPY), atol=0.05)
    config = load_config([out], ['calibration.online:=true'])
    assert config.calibration.pairs == 0
    assert config.baseline.direction == (0.0, 0.0, 1.0)
    text = out.read_text()
    assert text.startswith('# ')
    assert text.count('°\n') == 3
    assert 'baseline.direction' not in text
    said = capsys.readouterr()
    assert said.out.startswith('pairs: 3, ')
    assert 'the scene suffices' in said.out
    assert said.err == ''


def test_the_sample(tmp_path):
    """Its top camera is also darker, and of another white balance (bags/README.md)."""
    sample = Path(__file__).resolve().parent.parent / 'bags' / 'binocular.mcap'
    assert sample.stat().st_size < 5e6
    assert calibrate(sample, '--out', tmp_path / 'rig.yaml', '--max-pairs', 3) == 0
    np.testing.assert_allclose(angles(tmp_path / 'rig.yaml'), (2.0, -1.5, 3.0), atol=0.02)


def test_the_pictures_show_before_and_after(bag, tmp_path):
    out = tmp_path / 'rig.yaml'
    assert calibrate(bag, '--out', out, '--max-pairs', 1) == 0
    before, after = (cv2.imread(str(tmp_path / f'rig_{name}.png')) for name in ('before', 'after'))
    assert before.shape == after.shape == (720 + 44, 1440, 3)
    red = [np.mean(p[44:, :, 2].astype(int) - p[44:, :, 0]) for p in (before, after)]
    assert red[0] > 20 > 0 > red[1]  # degrees are red, thousandths of them blue


def test_the_direction_is_written_where_it_is_not_the_default(bag, tmp_path):
    given_, estimated = tmp_path / 'given.yaml', tmp_path / 'estimated.yaml'
    assert calibrate(bag, '--out', given_, '--direction', '0.01,0,2') == 0
    assert load_config([given_]).baseline.direction == (0.01, 0.0, 2.0)
    assert calibrate(bag, '--out', estimated, '--direction', 'estimate') == 0
    direction = load_config([estimated]).baseline.direction
    np.testing.assert_allclose(direction, (0, 0, 1), atol=math.radians(0.5))
    assert direction != (0.0, 0.0, 1.0)
    np.testing.assert_allclose(angles(estimated), np.degrees(RPY), atol=0.15)


def test_a_wrong_direction_is_warned_of(bag, tmp_path, capsys):
    lean = math.tan(math.radians(1.5))
    assert calibrate(bag, '--out', tmp_path / 'r.yaml', '--direction', f'{lean},0,1',
                     '-p', 'calibration.max_sigma:=0.1') == 0
    error = capsys.readouterr().err
    assert error.startswith('warning: the baseline leans by ')
    assert float(error.split('by ')[1].split('°')[0]) == pytest.approx(1.5, abs=0.3)


def test_other_topics_and_a_prior(pictures, tmp_path):
    path = write_bag(tmp_path / 'bag', messages(pictures[:1], '/mast/upper', '/mast/lower'))
    out = tmp_path / 'rig.yaml'
    assert calibrate(path, '--out', out, '--top-topic', '/mast/upper', '--bottom-topic',
                     '/mast/lower', '-p', 'camera.top.yaw:=0.06') == 0
    np.testing.assert_allclose(angles(out), np.degrees(RPY), atol=0.1)


REFUSED = {
    'swapped': (['--top-topic', '/bottom/image', '--bottom-topic', '/top/image'],
                'cameras_swapped: near points move the wrong way'),
    'not there': (['--top-topic', '/none'], 'no image topic /none; image topics there: '
                  '/bottom/image, /top/image'),
    'the same': (['--top-topic', '/bottom/image'], 'cannot be both cameras'),
    'no pairs': (['-p', 'pairing.tolerance:=0.001'], 'no two within pairing.tolerance 0.001 s'),
    'none wanted': (['--max-pairs', '0'], '--max-pairs: must be at least 1'),
    'no direction': (['--direction', 'up'], "--direction up: needs X,Y,Z, not all zero, or"),
    'null': (['--direction', '0,0,0'], 'not all zero'),
    'wrong': (['--direction', '0.2,0,1'], 'wrong_direction: what fits is not '
              'baseline.direction as given, but one that leans by 11.'),
    'uncertain': (['-p', 'calibration.max_sigma:=0.00001'], 'calibration_uncertain: standard '),
}


@pytest.mark.parametrize('case', REFUSED)
def test_refusals_are_one_line(bag, tmp_path, capsys, case):
    words, reason = REFUSED[case]
    out = tmp_path / 'rig.yaml'
    assert calibrate(bag, '--out', out, *words) == 2
    error = capsys.readouterr().err
    assert error.startswith('sphstereo calibrate: ')
    assert reason in error
    assert error.count('\n') == 1
    assert list(tmp_path.iterdir()) == []


def test_scenes_that_do_not_suffice(pictures, tmp_path, capsys):
    """Plain pictures; texture in a corner of the sphere; all far away, the direction wanted."""
    plain = [tuple(np.full_like(im, 90) for im in pair) for pair in pictures[:1]]
    path = write_bag(tmp_path / 'plain', messages(plain))
    assert calibrate(path, '--out', tmp_path / 'r.yaml') == 2
    assert 'too_few_points: 0 points with texture' in capsys.readouterr().err
    far = World((-400, -300, -900), (500, 160, 1000), (), cell=50)
    views = [tuple(analytic_world.look(far, up, turn, HEIGHT).image for up, turn in (
        (BASELINE * UP, turned(RPY)), (0 * UP, np.eye(3))))]
    path = write_bag(tmp_path / 'far', messages(views))
    assert calibrate(path, '--out', tmp_path / 'r.yaml') == 0
    np.testing.assert_allclose(angles(tmp_path / 'r.yaml'), np.degrees(RPY), atol=0.05)
    assert 'too far away to tell another' in capsys.readouterr().out
    assert calibrate(path, '--out', tmp_path / 'd.yaml', '--direction', 'estimate') == 2
    assert 'no_parallax: the scene is too far away' in capsys.readouterr().err


def test_a_recording_of_one_camera_is_refused(pictures, tmp_path, capsys):
    path = write_bag(tmp_path / 'bag', (m for m in messages(pictures[:1]) if 'top' in m[0]))
    assert calibrate(path, '--out', tmp_path / 'r.yaml') == 2
    assert 'no topic /bottom/image or /bottom/image/compressed' in capsys.readouterr().err


# Stamps

stamps = st.lists(st.integers(0, 10**9), max_size=30)


@given(stamps, stamps, st.floats(0, 0.1))
def test_each_frame_is_in_one_pair_at_most_and_they_are_near(top, bottom, tolerance):
    pairs = paired_stamps(top, bottom, tolerance)
    assert all(a in top and b in bottom for a, b in pairs)
    assert all(abs(a - b) <= round(tolerance * 1e9) for a, b in pairs)
    for side in zip(*pairs, strict=True):
        assert len(set(side)) == len(side)
        assert list(side) == sorted(side)
    for a, b in pairs:
        assert abs(a - b) == min(abs(a - other) for other in bottom)
        assert abs(a - b) == min(abs(other - b) for other in top)


@given(st.lists(st.integers(0, 10**9).map(lambda n: 1000 * n), unique=True, max_size=30),
       st.integers(-400, 400))
def test_all_frames_of_a_rig_with_an_offset_are_paired(bottom, offset):
    top = [stamp + offset for stamp in bottom]
    assert paired_stamps(top[::-1], bottom, 1e-6) == [
        (stamp + offset, stamp) for stamp in sorted(bottom)]


def test_pairs_are_spread_evenly():
    pairs = [(k, k) for k in range(100)]
    assert spread(pairs, 200) == pairs
    assert spread(pairs, 1) == [(50, 50)]
    assert [a for a, _ in spread(pairs, 4)] == [0, 33, 66, 99]


# Pictures

def test_residuals_by_place():
    rng = np.random.default_rng(1)
    current = rng.normal(size=(20000, 3))
    current /= np.linalg.norm(current, axis=1, keepdims=True)
    yaw = math.radians(0.5)
    points = Correspondences(current, current, np.full(len(current), 1e-3))
    found = residual_map(points, rotations.exp([0, yaw, 0]), UP)
    assert found.shape == (60, 120)
    latitude = np.radians(88.5 - 3 * np.arange(60))
    middle = np.nanmedian(found, axis=1)
    np.testing.assert_allclose(middle[5:55], 0.5 * np.cos(latitude)[5:55], rtol=0.1)
    half = residual_map(points[current[:, 0] > 0], np.eye(3), UP)
    assert np.isnan(half[:, :55]).all()
    assert np.nanmax(half) < 1e-6


def test_colours_run_from_blue_to_red():
    image = np.full((60, 120), 100, np.uint8)
    residuals = np.full((6, 12), np.nan)
    residuals[0, 0], residuals[0, 11] = 2 * SMALL, LARGE / 2
    picture = residual_picture(image, residuals, 'x')[-60:].astype(int)
    assert picture[5, 5, 0] > picture[5, 5, 2] + 50
    assert picture[5, 115, 2] > picture[5, 115, 0] + 50
    np.testing.assert_array_equal(picture[30], 60)  # unknown: the picture alone, darker
