"""What moves and what makes matching hard: exact truth, and that each does what it says."""
from __future__ import annotations

import argparse
from itertools import combinations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

pytest.importorskip('trimesh')
pytest.importorskip('embreex')

from sphstereo_ros.core.camera import Equirectangular
from sphstereo_ros.scenes import command, sequence, shapes
from sphstereo_ros.scenes.hard_streets import repetition_street
from sphstereo_ros.scenes.imaging import NO_NOISE, develop
from sphstereo_ros.scenes.material import Material
from sphstereo_ros.scenes.nuisances import (
    NUISANCES,
    STEP_AT,
    STREETS,
    WALL_AT,
    WALL_SPACING,
    ImageEffects,
    with_nuisance,
)
from sphstereo_ros.scenes.render import Camera, radiance
from sphstereo_ros.scenes.scene import Part, Scene
from sphstereo_ros.scenes.sequence import (
    TUNING_SEEDS,
    RenderedSequence,
    load_sequence,
    render_sequence,
    save_sequence,
)
from sphstereo_ros.scenes.traffic import Mover, traffic
from sphstereo_ros.scenes.trajectory import drive, mounted, shaken

SEED = TUNING_SEEDS[0]
HEIGHT = 64
CLEAN = {'noise': NO_NOISE, 'jpeg': None, 'exposure': 0.0}
LOW, HIGH = np.array([-1.0, -0.8, 0.0]), np.array([1.0, 0.8, 2.0])


def rays_of(frame):
    height = len(frame.range)
    return Equirectangular(height, 2 * height).bearings() @ frame.rotation.T


def moving_box(velocity, start=(6.0, 1.5, 0.0), frames=6, height=60, **effects):
    """A box that moves over a ground, seen from a camera that moves and shakes."""
    ground = Part('ground', shapes.sheet(-300, 300, -300, 300, 0.0), Material(grain=0.5))
    box = Part('box', shapes.box(LOW, HIGH), Material(grain=0.8, grain_size=0.3),
               position=np.array(start))
    rng = np.random.default_rng(3)
    way = mounted(*drive(rng, frames, (0, 0, 1.6), 0.28), shaken(rng, frames, 0.02, 0.05))
    return RenderedSequence(Scene([ground]), way, height, 1, ImageEffects(**effects),
                            [Mover((box,), np.array(velocity))])


@settings(max_examples=12, deadline=None)
@given(st.floats(-20, 20), st.floats(-5, 5), st.integers(0, 5))
def test_what_moves_is_where_its_velocity_says(along, across, index):
    frame = moving_box((along, across, 0.0), (9.0, 4.0, 0.0))[index]
    rays, origin = rays_of(frame), frame.position
    offset = np.array([9.0, 4.0, 0.0]) + index / 30 * np.array([along, across, 0.0])
    with np.errstate(divide='ignore', invalid='ignore'):
        ground = np.where(rays[..., 2] < 0, -origin[2] / rays[..., 2], np.inf)
        a, b = (LOW + offset - origin) / rays, (HIGH + offset - origin) / rays
    ground[np.abs(origin[:2] + ground[..., None] * rays[..., :2]).max(-1) > 300] = np.inf
    enter, leave = np.minimum(a, b).max(-1), np.maximum(a, b).min(-1)
    box = np.where((enter <= leave) & (enter > 0), enter, np.inf)
    on_box = box < ground
    assert on_box.sum() > 5
    # A ray that grazes an edge may fall on either side of it.
    assert np.count_nonzero(frame.moving != on_box) <= 2
    both = frame.moving & on_box
    np.testing.assert_allclose(frame.range[both], box[both], rtol=1e-5)
    still = ~frame.moving & ~on_box
    np.testing.assert_allclose(frame.range[still], ground[still], rtol=1e-5)


def test_texture_moves_with_what_moves():
    """A box that keeps pace with the camera looks the same in every frame."""
    still = {'noise': NO_NOISE, 'jpeg': None, 'exposure': 0.0}
    frames = moving_box((8.4, 0.0, 0.0), (1.0, 4.0, 0.0), **still)
    way = mounted(np.stack([np.eye(3)] * 2), np.array([[0, 0, 1.6], [0.28, 0, 1.6]]),
                  np.stack([np.eye(3)] * 2))
    frames.trajectory = way
    first, second = frames[0], frames[1]
    np.testing.assert_array_equal(first.moving, second.moving)
    sides = first.moving & np.roll(first.moving, 1, 0) & np.roll(first.moving, -1, 0)
    assert first.image[sides].std() > 8
    change = np.abs(first.image[sides].astype(int) - second.image[sides])
    assert np.percentile(change, 95) <= 4
    ground = ~first.moving & (first.range < 5)
    assert np.abs(first.image[ground].astype(int) - second.image[ground]).mean() > 4


@pytest.fixture(scope='module')
def busy():
    return render_sequence('street', SEED, 13, 96, nuisance='traffic', **CLEAN)


def test_moving_mask_is_where_traffic_hides_the_street(busy):
    for index in (0, 12):
        frame = busy[index]
        empty = Camera(busy.scene, frame.rotation, frame.position, 96).range()
        assert 0.005 < frame.moving.mean() < 0.2
        np.testing.assert_array_equal(frame.moving, frame.range < empty)
        np.testing.assert_array_equal(frame.range[~frame.moving], empty[~frame.moving])


def test_traffic_is_met_as_announced(busy):
    assert not any('tyre' in part.name for part in busy.scene.parts)  # nothing is parked
    first, last = busy.scene_at(0), busy.scene_at(12)
    steps = {}
    for before, after in zip(first.parts, last.parts, strict=True):
        name = before.name.partition(':')[0]
        steps[name] = (after.position - before.position) / 0.4
    camera = (busy.trajectory.positions[12] - busy.trajectory.positions[0]) / 0.4
    assert all(-12 <= steps[f'oncoming {k}'][0] <= -9 for k in (1, 2, 3))
    assert steps['beside'][0] == pytest.approx(camera[0], rel=1e-9)
    assert 1.2 <= steps['pedestrian'][1] <= 1.6
    assert 4.4 <= steps['cyclist'][1] <= 4.8
    np.testing.assert_array_equal(steps['road'], 0)


def bounds(mover, seconds):
    corners = np.concatenate([p.mesh.vertices + p.position for p in mover.at(seconds)])
    return corners.min(axis=0), corners.max(axis=0)


@pytest.mark.parametrize('seed', range(12))
def test_nothing_collides_for_two_seconds(seed):
    movers = traffic(seed, 8.4)
    for seconds in np.arange(0, 2.01, 0.1):
        camera = np.array([8.4 * seconds, 0.0, 1.0])
        boxes = [*(bounds(m, seconds) for m in movers), (camera - 1.0, camera + 1.0)]
        for (low, high), (other_low, other_high) in combinations(boxes, 2):
            assert (low > other_high).any() or (high < other_low).any()


def test_only_traffic_moves():
    assert render_sequence('street', SEED, 1, HEIGHT)[0].moving is None


def test_folder_keeps_what_moves(tmp_path):
    rendered = moving_box((-8.0, 0.0, 0.0), frames=3)
    save_sequence(rendered, tmp_path)
    for saved, read in zip(rendered, load_sequence(tmp_path), strict=True):
        assert saved.moving.any()
        assert read.moving.dtype == bool
        np.testing.assert_array_equal(read.moving, saved.moving)
    (tmp_path / 'moving_0001.png').unlink()
    with pytest.raises(ValueError, match='moving_0001'):
        load_sequence(tmp_path)[1]


@pytest.fixture(scope='module')
def plain_frame():
    return render_sequence('street', SEED, 2, HEIGHT)[1]


@pytest.mark.parametrize('nuisance', [n for n in NUISANCES if n not in STREETS])
def test_nuisance_of_the_picture_leaves_the_scene(plain_frame, nuisance):
    first, again = (render_sequence('street', SEED, 2, HEIGHT, nuisance=nuisance)[1]
                    for _ in range(2))
    np.testing.assert_array_equal(first.image, again.image)
    np.testing.assert_array_equal(first.range, plain_frame.range)
    assert (first.image != plain_frame.image).mean() > 0.3


@pytest.mark.parametrize('nuisance', STREETS)
def test_nuisance_of_the_scene_is_determined_by_its_seed(plain_frame, nuisance):
    first = render_sequence('street', SEED, 2, HEIGHT, nuisance=nuisance)[1]
    sequence._build.cache_clear()
    again = render_sequence('street', SEED, 2, HEIGHT, nuisance=nuisance)[1]
    other = render_sequence('street', TUNING_SEEDS[1], 2, HEIGHT, nuisance=nuisance)[1]
    np.testing.assert_array_equal(first.image, again.image)
    np.testing.assert_array_equal(first.range, again.range)
    assert (first.moving is None) == (nuisance != 'traffic')
    assert (first.range != plain_frame.range).mean() > 0.05
    assert (first.range != other.range).mean() > 0.05


def depth_edges(distance):
    """Share of the pixels up to 45° from the horizon where something within 6 m hides what is
    three times as far.
    """
    middle = np.minimum(distance, 1e3)[len(distance) // 4:3 * len(distance) // 4]
    beside = np.roll(middle, 1, axis=1)
    near, far = np.minimum(middle, beside), np.maximum(middle, beside)
    return float(np.mean((near < 6) & (far > 3 * near)))


def test_occlusion_puts_thin_things_before_the_distance():
    plain, hard = (render_sequence('street', SEED, 1, 240, nuisance=n).camera(0).range()
                   for n in (None, 'occlusion'))
    assert depth_edges(hard) > 0.03
    assert depth_edges(hard) > 3 * depth_edges(plain)


def test_repetition_repeats_exactly():
    """From 2.4 m on, the sides of the street look the same, down to the bricks."""
    scene = repetition_street(SEED)
    rng = np.random.default_rng(1)
    rays = rng.uniform((-0.7, 1, -0.05), (0.7, 1, 0.4), (4000, 3)) * rng.choice(
        [(1, 1, 1), (1, -1, 1)], 4000)
    rays /= np.linalg.norm(rays, axis=1)[:, None]
    origins = [np.tile((x, 0.0, 1.8), (4000, 1)) for x in (1.0, 3.4)]
    here, there = (scene.cast(o, rays) for o in origins)
    # A ray that grazes an edge may fall on either side of it.
    same = np.isclose(here.distance, there.distance, rtol=1e-4)
    assert same.mean() > 0.99
    names = [scene.parts[k].name for k in np.unique(scene.face_part[here.face[same]])]
    assert {'facade', 'glass', 'frame'} <= {n.split()[0] for n in names}
    beside = np.abs(here.distance * rays[:, 1])
    assert np.isclose(beside, 7.8).mean() > 0.02  # pillars
    colours = [radiance(scene, o, rays, 1e-4)[0][same] for o in origins]
    assert colours[0].std() > 0.1
    assert np.mean(np.abs(colours[0] - colours[1]).max(axis=1) < 1e-3) > 0.98


def test_wall_is_forty_metres_ahead_at_frame_twelve():
    frames = render_sequence('street', SEED, 14, 480, nuisance='wall', shake_deg=(0, 0))
    np.testing.assert_allclose(np.diff(frames.trajectory.positions, axis=0),
                               np.tile((8 / 30, 0, 0), (13, 1)), atol=1e-12)
    camera = frames.camera(12)
    assert camera.position[0] == pytest.approx(WALL_AT - 40)
    distance, part = camera.range_and_parts()
    names = [p.name for p in camera.scene.parts]
    wall = part == names.index('wall')
    rays = Equirectangular(480, 960).bearings() @ camera.rotation.T
    np.testing.assert_allclose(distance[wall] * rays[wall][:, 0], 40, rtol=1e-5)
    points = camera.position + distance[wall][:, None] * rays[wall]
    assert np.ptp(points[:, 1]) == pytest.approx(8, abs=0.6)
    assert points[:, 2].max() == pytest.approx(5, abs=0.3)
    picture = camera.picture()[wall].mean(axis=1)
    assert picture.std() > 0.15 * picture.mean()  # textured
    assert pytest.approx(8) == WALL_SPACING * 30


def test_exposure_varies_strongly_and_steps():
    effects = with_nuisance(ImageEffects(), 'exposure')
    for seed in range(20):
        varied = effects.exposures(seed, 15)
        assert varied[0] == 1
        before, after = varied[:12], 2 * varied[12:]
        assert round(STEP_AT * 15) == 12
        both = np.concatenate([before, after])
        assert np.abs(np.log(both)).max() <= 0.4
        assert np.abs(np.diff(np.log(both))).max() > 0.2
    frames = render_sequence('street', SEED, 2, HEIGHT, nuisance='exposure', noise=NO_NOISE,
                             jpeg=None)
    assert frames.exposures[1] == effects.exposures(SEED, 2)[1]


def test_low_light_is_dark_and_noisy():
    frames = render_sequence('street', SEED, 1, HEIGHT, nuisance='low_light', jpeg=None)
    noisy = frames[0].image.astype(float)
    light = frames.camera(0).picture()
    clean = develop(light, frames.effects.gain)
    plain = develop(light)
    assert clean.mean() < 0.6 * plain.mean()
    grey = (clean > 40) & (clean < 80)
    residual = (noisy - clean)[grey]
    assert residual.std() == pytest.approx(np.sqrt(16 + 64 * clean[grey].mean() / 255), rel=0.05)
    assert abs(residual.mean()) < 0.5


def test_rolling_exposure_moves_by_a_third_of_its_period():
    effects = with_nuisance(ImageEffects(), 'rolling_exposure')
    rows = [effects.row_exposures(SEED, k, 400) for k in range(4)]
    # 25 ms of readout hold 2.5 periods of 100 Hz; 160 rows are one.
    assert all(np.ptp(r) == pytest.approx(0.4, abs=1e-3) for r in rows)
    np.testing.assert_allclose(rows[0][160:], rows[0][:-160], atol=1e-9)
    np.testing.assert_allclose(rows[3], rows[0], atol=1e-6)
    assert np.abs(rows[1] - rows[0]).max() > 0.3
    later = np.interp(np.arange(200) + 160 / 3, np.arange(400), rows[0])
    np.testing.assert_allclose(rows[1][:200], later, atol=1e-3)


def test_rolling_exposure_is_in_the_picture():
    plain, rolling = (render_sequence('street', SEED, 2, HEIGHT, nuisance=n, **CLEAN)[1].image
                      for n in (None, 'rolling_exposure'))
    exposure = with_nuisance(ImageEffects(), 'rolling_exposure').row_exposures(SEED, 1, HEIGHT)
    change = (rolling.astype(float) - plain).mean(axis=(1, 2))
    bright, dark = exposure > 1.1, exposure < 0.9
    assert change[bright].min() > 1
    assert change[dark].max() < -1


@pytest.mark.parametrize(('name', 'nuisance', 'reason'), [
    ('takeoff', 'traffic', 'only the street'), ('corridor', 'wall', 'only the street'),
    ('street', 'rain', 'none of occlusion')])
def test_nuisance_that_is_not_there_is_refused(name, nuisance, reason):
    with pytest.raises(ValueError, match=reason):
        render_sequence(name, SEED, 1, HEIGHT, nuisance=nuisance)


def command_line(*given):
    parser = argparse.ArgumentParser()
    command.add_arguments(parser)
    return parser.parse_args(list(given))


def test_command_renders_a_nuisance(tmp_path):
    out = tmp_path / 'out'
    args = command_line('corridor', str(out), '--frames', '1', '--height', '32', '--jpeg', '0',
                        '--nuisance', 'low_light')
    assert command.main(args) == 0
    loaded = load_sequence(out)
    assert loaded.meta['sequence'] == 'corridor low_light'
    expected = render_sequence('corridor', SEED, 1, 32, jpeg=None, nuisance='low_light')[0]
    np.testing.assert_array_equal(loaded[0].image, expected.image)


def test_command_refuses_a_nuisance_of_another_scene(tmp_path, capsys):
    args = command_line('corridor', str(tmp_path / 'out'), '--nuisance', 'wall')
    assert command.main(args) == 2
    assert 'only the street' in capsys.readouterr().err
