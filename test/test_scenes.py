"""Rendered scenes: range and pose against analytic geometry, effects, files."""
from __future__ import annotations

import argparse
import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

pytest.importorskip('trimesh')
pytest.importorskip('embreex')

from sphstereo_ros.core.camera import Equirectangular
from sphstereo_ros.core.rotations import matrix_from_quaternion, quaternion_from_matrix
from sphstereo_ros.scenes import command, sequence, shapes
from sphstereo_ros.scenes.imaging import (
    NO_NOISE,
    Noise,
    develop,
    through_jpeg,
    to_bytes,
    weak_texture,
    with_noise,
)
from sphstereo_ros.scenes.material import Material
from sphstereo_ros.scenes.render import Camera
from sphstereo_ros.scenes.scene import Part, Scene
from sphstereo_ros.scenes.sequence import (
    FIRST_STAMP,
    REPORTED_SEEDS,
    SCENES,
    TUNING_SEEDS,
    TruthFrame,
    load_sequence,
    render_sequence,
    rounded_range,
    save_sequence,
    true_pose,
)
from sphstereo_ros.scenes.trajectory import (
    BODY_FROM_OPTICAL,
    climb,
    drive,
    mounted,
    roll_pitch_yaw,
    shaken,
)

HEIGHT = 120
SEED = TUNING_SEEDS[0]
CLEAN = {'noise': NO_NOISE, 'jpeg': None, 'exposure': 0.0}
angle = st.floats(-3.1, 3.1)


@pytest.fixture(scope='module')
def room():
    """A ground, a box and a ball, all where analysis has them exactly."""
    ball = shapes.mesh(*_icosphere())
    return Scene([Part('ground', shapes.sheet(-300, 300, -300, 300, 0.0), Material(grain=0.3)),
                  Part('box', shapes.box((4, -1, 0), (6, 1, 2)), Material(colour=(.6, .1, .1))),
                  Part('ball', ball, Material(), position=np.array([-5.0, 2.0, 1.5]))])


def _icosphere():
    trimesh = pytest.importorskip('trimesh')
    ball = trimesh.creation.icosphere(5, 1.0)
    return ball.vertices, ball.faces


@pytest.fixture(scope='module')
def street():
    return render_sequence('street', SEED, 3, 160, **CLEAN)


@pytest.fixture(scope='module')
def street_frames(street):
    return list(street)


def slab_distance(origin, rays, low, high):
    """Where rays enter an axis-aligned box; inf where they miss."""
    with np.errstate(divide='ignore', invalid='ignore'):
        a, b = (low - origin) / rays, (high - origin) / rays
    enter, leave = np.minimum(a, b).max(-1), np.maximum(a, b).min(-1)
    return np.where((enter <= leave) & (enter > 0), enter, np.inf)


def expected_room(origin, rays):
    with np.errstate(divide='ignore'):
        ground = np.where(rays[..., 2] < 0, -origin[2] / rays[..., 2], np.inf)
    beyond = np.abs(origin[:2] + ground[..., None] * rays[..., :2]).max(-1) > 300
    ground[beyond] = np.inf
    box = slab_distance(origin, rays, np.array([4, -1, 0.0]), np.array([6, 1, 2.0]))
    return np.minimum(ground, box)


@settings(max_examples=15, deadline=None)
@given(roll=angle, pitch=st.floats(-1.5, 1.5), yaw=angle, x=st.floats(-2, 2), y=st.floats(-3, 0),
       z=st.floats(0.3, 8))
def test_range_agrees_with_analysis(room, roll, pitch, yaw, x, y, z):
    origin = np.array([x, y, z])
    rotation = roll_pitch_yaw(roll, pitch, yaw) @ BODY_FROM_OPTICAL
    found = Camera(room, rotation, origin, 60).range()
    rays = Equirectangular(60, 120).bearings() @ rotation.T
    expected = expected_room(origin, rays)
    to_ball = np.array([-5.0, 2.0, 1.5]) - origin
    ball = rays @ to_ball > np.sqrt(max(0.0, to_ball @ to_ball - 1.1**2))
    # A ray that grazes an edge may fall on either side of it.
    wrong = ~(np.isclose(found, expected, rtol=1e-5, atol=0) | ball)
    assert wrong.mean() < 1e-3


def test_ball_lies_within_its_facets(room):
    origin = np.array([0.0, 0.0, 1.6])
    found = Camera(room, BODY_FROM_OPTICAL, origin, 480).range()
    rays = Equirectangular(480, 960).bearings() @ BODY_FROM_OPTICAL.T
    to_ball = np.array([-5.0, 2.0, 1.5]) - origin
    along = rays @ to_ball
    miss = np.sqrt(np.maximum(to_ball @ to_ball - along**2, 0))
    inside = (along > 0) & (miss < 0.9)
    expected = along[inside] - np.sqrt(1 - miss[inside]**2)
    assert inside.sum() > 500
    assert np.abs(found[inside] - expected).max() < 2e-3
    assert (found[inside] - expected).min() > -1e-6


def test_ground_is_exact_far_off(room):
    origin = np.array([0.0, 0.0, 1.7])
    camera = Camera(room, BODY_FROM_OPTICAL, origin, 960)
    rays = Equirectangular(960, 1920).bearings() @ BODY_FROM_OPTICAL.T
    expected = expected_room(origin, rays)
    found = camera.range()
    ground = np.isfinite(expected) & (rays @ np.array([-5.0, 2.0, -0.1]) < 5)
    assert expected[ground].max() > 200
    assert np.abs(found[ground] / expected[ground] - 1).max() < 1e-5


def test_part_placed_elsewhere_is_seen_there(room):
    box = next(p for p in room.parts if p.name == 'box')
    moved = Part('box', box.mesh, box.material, position=np.array([1.0, 0.0, 0.0]))
    origin = np.array([0.0, 0.0, 1.0])
    ahead = (60, 120)
    before = Camera(room, BODY_FROM_OPTICAL, origin, HEIGHT)
    after = Camera(room.replaced(moved), BODY_FROM_OPTICAL, origin, HEIGHT)
    assert before.range()[ahead] == pytest.approx(4, rel=1e-3)
    assert after.range()[ahead] == pytest.approx(5, rel=1e-3)


def test_texture_moves_with_its_part():
    board = Material(grain=0.8, grain_size=0.3)
    mesh = shapes.box((3, -2, -2), (3.2, 2, 2))
    shift = np.array([0.4, 0.0, 0.0])
    first = Camera(Scene([Part('board', mesh, board)]), BODY_FROM_OPTICAL, np.zeros(3), HEIGHT)
    scene = Scene([Part('board', mesh, board, position=shift)])
    second = Camera(scene, BODY_FROM_OPTICAL, shift, HEIGHT)
    assert first.picture()[40:80, 100:140].std() > 0.05
    np.testing.assert_allclose(first.picture(), second.picture(), atol=2e-3)


def test_scene_needs_parts():
    with pytest.raises(ValueError, match='at least one'):
        Scene([])


def project(frame: TruthFrame, points):
    height = len(frame.range)
    return Equirectangular(height, 2 * height).project(
        (points - frame.position) @ frame.rotation)


def test_points_of_one_frame_lie_on_the_surfaces_of_the_next(street_frames):
    first, second = street_frames[:2]
    rays = Equirectangular(160, 320).bearings()
    seen = np.isfinite(first.range) & (first.range < 30)
    local = rays[seen] * first.range[seen][:, None]
    pose = true_pose(first, second)
    there = local @ pose.rotation.T + pose.position
    u, v = np.rint(Equirectangular(160, 320).project(there)).astype(int).T
    predicted = np.linalg.norm(there, axis=1)
    found = second.range[v.clip(0, 159), u % 320]
    ratio = found / predicted
    # Rounded to the nearest pixel: most agree within a pixel's slope, edges do not.
    assert np.median(np.abs(ratio - 1)) < 0.01
    assert np.mean(np.abs(ratio - 1) < 0.1) > 0.85


def test_a_world_point_projects_to_where_its_range_says(street_frames):
    for frame in street_frames:
        v, u = np.argwhere(np.isfinite(frame.range))[::997].T
        rays = Equirectangular(160, 320).unproject(np.stack([u, v], -1).astype(float))
        points = rays * frame.range[v, u][:, None] @ frame.rotation.T + frame.position
        assert len(points) > 20
        np.testing.assert_allclose(project(frame, points), np.stack([u, v], -1), atol=1e-6)
        assert points[:, 2].min() > -1.5  # nothing under the ground


def test_true_pose_is_the_step(street_frames):
    pose = true_pose(street_frames[0], street_frames[1])
    assert pose.baseline == pytest.approx(0.28, rel=1e-9)
    rotation_angle = np.degrees(np.arccos((np.trace(pose.rotation) - 1) / 2))
    assert 1 <= rotation_angle <= 3
    # The camera moves forward: the direction of travel is near its axis, not behind it.
    assert pose.direction[2] > 0.95
    back = true_pose(street_frames[1], street_frames[0])
    np.testing.assert_allclose(back.rotation @ pose.position + back.position, 0, atol=1e-12)


def test_pictures_agree_with_range(street_frames):
    """A pixel looks the same from both frames: the mean difference shrinks when it is warped."""
    first, second = street_frames[:2]
    pose = true_pose(first, second)
    rays = Equirectangular(160, 320).bearings()
    near = np.isfinite(first.range) & (first.range < 20)
    there = (rays[near] * first.range[near][:, None]) @ pose.rotation.T + pose.position
    u, v = np.rint(Equirectangular(160, 320).project(there)).astype(int).T
    here = first.image[near].astype(float)
    warped = np.abs(second.image[v.clip(0, 159), u % 320] - here).mean()
    straight = np.abs(second.image[near] - here).mean()
    assert warped < 0.6 * straight


@pytest.mark.parametrize('name', SCENES)
def test_scene_is_determined_by_its_seed(name):
    first = render_sequence(name, SEED, 2, 64)[1]
    sequence._build.cache_clear()
    again = render_sequence(name, SEED, 2, 64)[1]
    other = render_sequence(name, TUNING_SEEDS[1], 2, 64)[1]
    np.testing.assert_array_equal(first.image, again.image)
    np.testing.assert_array_equal(first.range, again.range)
    np.testing.assert_array_equal(first.rotation, again.rotation)
    assert (first.range != other.range).mean() > 0.3
    assert (first.rotation != other.rotation).any()


@pytest.mark.parametrize('name', SCENES)
def test_a_fifth_and_more_is_weakly_textured(name):
    frame = render_sequence(name, SEED, 1, 480, **CLEAN)[0]
    assert weak_texture(frame.image, frame.range) >= 0.2
    assert frame.image.std() > 25  # and the rest is not
    assert frame.range.min() > 0.3


def test_weak_texture_counts_flat_and_not_sky():
    image = np.full((60, 120), 100.0)
    image[:, 60:] += np.random.default_rng(1).normal(0, 20, (60, 60))
    distance = np.ones((60, 120))
    assert weak_texture(image, distance) == pytest.approx(0.5, abs=0.08)
    distance[:, :60] = np.inf
    assert weak_texture(image, distance) < 0.08


def test_seeds_are_fixed_and_disjoint():
    assert TUNING_SEEDS == (1, 2, 3, 4, 5)
    assert REPORTED_SEEDS == (1001, 1002, 1003, 1004, 1005)
    assert command.SAMPLE_SEED not in TUNING_SEEDS + REPORTED_SEEDS


def test_exposure_changes_brightness(street):
    lit = render_sequence('street', SEED, 3, 160, noise=NO_NOISE, jpeg=None, exposure=0.4)
    assert lit.exposures[0] == 1
    ratio = lit.exposures[1]
    assert abs(np.log(ratio)) > 0.02
    plain, changed = street[1].image.mean(), lit[1].image.mean()
    assert (changed - plain) * np.log(ratio) > 0
    np.testing.assert_array_equal(street[0].image, lit[0].image)


def test_noise_has_the_stated_strength():
    flat = np.full((200, 400, 3), 128.0, np.float32)
    noisy = with_noise(flat, Noise(1.0, 2.0), np.random.default_rng(3))
    assert noisy.std() == pytest.approx(np.sqrt(1 + 4 * 128 / 255), rel=0.02)
    np.testing.assert_array_equal(with_noise(flat, NO_NOISE, np.random.default_rng(3)), flat)


@given(st.floats(0, 20), st.floats(0.01, 20))
def test_tone_curve_rises(light, more):
    values = develop(np.array([[[light] * 3, [light + more] * 3]]))
    assert 0 <= values[0, 0, 0] <= values[0, 1, 0] <= 255.001


def test_jpeg_loses_more_at_lower_quality(street_frames):
    image = street_frames[0].image
    losses = [np.abs(through_jpeg(image, q).astype(int) - image).mean() for q in (95, 60)]
    assert 0 < losses[0] < losses[1]


def test_shake_stays_within_its_bounds():
    attitudes = shaken(np.random.default_rng(5), 60, np.radians(1), np.radians(3))
    steps = np.swapaxes(attitudes[:-1], 1, 2) @ attitudes[1:]
    angles = np.degrees(np.arccos((np.trace(steps, axis1=1, axis2=2) - 1) / 2))
    assert angles.min() >= 1 - 1e-6
    assert angles.max() <= 3 + 1e-6
    tilt = np.degrees(np.arccos((np.trace(attitudes, axis1=1, axis2=2) - 1) / 2))
    assert tilt.max() <= 5 + 1e-6


@settings(deadline=None)
@given(st.lists(st.floats(0.01, 3), min_size=1, max_size=20), st.integers(0, 99))
def test_spacing_is_kept_exactly(spacing, seed):
    frames = len(spacing) + 1
    for way in (drive, climb):
        _, positions = way(np.random.default_rng(seed), frames, (1, 2, 3), spacing)
        steps = np.linalg.norm(np.diff(positions, axis=0), axis=1)
        np.testing.assert_allclose(steps, spacing, rtol=1e-9)


def test_take_off_rises_by_the_stated_steps():
    _, positions = climb(np.random.default_rng(1), 8, (0, 0, 1))
    assert np.all(np.diff(positions[:, 2]) > 0.17)
    steps = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    np.testing.assert_allclose(steps[[0, -1]], (0.20, 0.35))


def test_mount_turns_the_camera_away_from_travel():
    attitudes, positions = drive(np.random.default_rng(1), 2, (0, 0, 1), 0.28, drift=0.0)
    still = np.stack([np.eye(3)] * 2)
    left = mounted(attitudes, positions, still, (0.0, 0.0, 0.5))
    travel = (positions[1] - positions[0]) @ left.rotations[1]
    # Yaw turns the camera to the left, so travel is to the right of its centre.
    assert np.arctan2(travel[0], travel[2]) == pytest.approx(0.5)
    down = mounted(attitudes, positions, still, (0.0, 0.3, 0.0))
    travel = (positions[1] - positions[0]) @ down.rotations[1]
    assert np.arctan2(travel[1], travel[2]) == pytest.approx(-0.3)


def test_turn_adds_up():
    turning = render_sequence('street', SEED, 5, 64, shake_deg=(0, 0), turn_deg=2.0)
    relative = turning.trajectory.rotations[0].T @ turning.trajectory.rotations[4]
    assert np.degrees(np.arccos((np.trace(relative) - 1) / 2)) == pytest.approx(8, abs=1e-6)


@settings(deadline=None)
@given(angle, st.floats(-1.5, 1.5), angle)
def test_quaternion_round_trip(roll, pitch, yaw):
    rotation = roll_pitch_yaw(roll, pitch, yaw)
    again = matrix_from_quaternion(quaternion_from_matrix(rotation))
    np.testing.assert_allclose(again, rotation, atol=1e-7)


@pytest.mark.parametrize('bad', [(0, 0, 0, 0), (np.nan, 0, 0, 1)])
def test_no_rotation_is_refused(bad):
    with pytest.raises(ValueError, match='no rotation'):
        matrix_from_quaternion(bad)


def test_rounded_range_keeps_its_bits():
    values = np.random.default_rng(2).uniform(0.3, 300, 1000)
    rounded = rounded_range(np.append(values, np.inf))
    assert np.abs(rounded[:-1] / values - 1).max() < 1.6e-5
    assert np.abs(rounded[:-1] / values - 1).max() > 1e-6
    assert np.isposinf(rounded[-1])


@pytest.mark.parametrize('jpeg', [None, 90])
def test_folder_round_trip(tmp_path, jpeg):
    rendered = render_sequence('corridor', SEED, 3, 64, jpeg=jpeg)
    save_sequence(rendered, tmp_path, 'corridor', small_height=16)
    loaded = load_sequence(tmp_path)
    assert len(loaded) == 3
    for index, (saved, read) in enumerate(zip(rendered, loaded, strict=True)):
        assert read.stamp == saved.stamp == FIRST_STAMP + round(index / 30 * 1e9)
        np.testing.assert_array_equal(read.image, saved.image)
        np.testing.assert_allclose(read.range, saved.range, rtol=2e-5)
        np.testing.assert_allclose(read.rotation, saved.rotation, atol=1e-7)
        np.testing.assert_array_equal(read.position, saved.position)
        assert read.exposure == saved.exposure
        assert read.jpeg == saved.jpeg
    with np.load(tmp_path / 'range_small_0001.npz') as data:
        assert data['range'].shape == (16, 32)


def test_folder_says_the_motion_in_body_axes(tmp_path):
    rendered = render_sequence('corridor', SEED, 2, 64, shake_deg=(2, 2))
    save_sequence(rendered, tmp_path)
    entry = json.loads((tmp_path / 'meta.json').read_text())['frames'][0]['motion_to_next']
    assert entry['distance_m'] == pytest.approx(0.14)
    assert entry['rotation_angle_deg'] == pytest.approx(2, abs=1e-4)
    pose = true_pose(rendered[1], rendered[0])  # of the next frame in this one
    np.testing.assert_allclose(BODY_FROM_OPTICAL @ pose.position / pose.baseline,
                               entry['direction_cam'], atol=1e-7)


def test_folder_that_is_none_is_refused(tmp_path):
    with pytest.raises(FileNotFoundError):
        load_sequence(tmp_path)
    (tmp_path / 'meta.json').write_text('[]')
    with pytest.raises(ValueError, match='no list of frames'):
        load_sequence(tmp_path)


@pytest.mark.parametrize(('name', 'frames', 'height'),
                         [('moon', 1, 64), ('street', 0, 64), ('street', 1, 0)])
def test_bad_requests_are_refused(name, frames, height):
    with pytest.raises(ValueError, match=r'moon|frames'):
        render_sequence(name, SEED, frames, height)


def test_frames_are_indexed_like_a_list(street):
    np.testing.assert_array_equal(street[-1].range, street[2].range)
    with pytest.raises(IndexError):
        street[3]


def _arguments(*given):
    parser = argparse.ArgumentParser()
    command.add_arguments(parser)
    return parser.parse_args(list(given))


def test_command_renders_a_folder(tmp_path, capsys):
    out = tmp_path / 'out'
    args = _arguments('corridor', str(out), '--frames', '2', '--height', '32', '--jpeg', '0')
    assert command.main(args) == 0
    assert [p.name for p in sorted(out.glob('frame*'))] == ['frame_0000.png', 'frame_0001.png']
    assert load_sequence(out)[1].range.shape == (32, 64)
    capsys.readouterr()
    assert command.main(args) == 2
    assert 'not an empty folder' in capsys.readouterr().err


@pytest.mark.parametrize(('extra', 'reason'), [
    (('--frames', '0'), 'one frame'), (('--jpeg', '101'), 'quality'),
    (('--shake', '3', '1'), 'angle'), (('--seed', '-1'), 'negative')])
def test_command_refuses_nonsense(tmp_path, capsys, extra, reason):
    assert command.main(_arguments('street', str(tmp_path / 'out'), *extra)) == 2
    error = capsys.readouterr().err
    assert reason in error
    assert error.count('\n') == 1


def test_picture_is_rounded_to_bytes():
    np.testing.assert_array_equal(to_bytes(np.array([-3.0, 0.6, 254.4, 300.0])), [0, 1, 254, 255])
