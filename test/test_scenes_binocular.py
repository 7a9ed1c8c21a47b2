"""Two cameras in rendered scenes: the same world, the rig as it is said to be."""
from __future__ import annotations

import argparse
import json

import numpy as np
import pytest

pytest.importorskip('embreex')

from sphstereo_ros.core.camera import Equirectangular
from sphstereo_ros.core.rotations import OPTICAL_FROM_LINK, matrix_from_rpy, top_rpy
from sphstereo_ros.replay.sources import open_source
from sphstereo_ros.ros.conversions import decode_frame, odometry_sample, read_depth
from sphstereo_ros.scenes import command
from sphstereo_ros.scenes.bag import write_binocular_bag
from sphstereo_ros.scenes.binocular import TopCamera, render_binocular, save_binocular
from sphstereo_ros.scenes.imaging import NO_NOISE
from sphstereo_ros.scenes.sequence import load_sequence, render_sequence, true_pose

HEIGHT = 32
RPY = (0.05, -0.03, 0.08)
RIG = TopCamera(RPY, 0.4, (0.1, 0.0, 1.0))


@pytest.fixture(scope='module')
def rendered():
    return render_binocular('corridor', 1, 2, HEIGHT, RIG)


def test_frames_alternate_and_pairs_share_a_stamp(rendered):
    assert len(rendered) == 4
    stamps = [rendered[k].stamp for k in range(4)]
    assert stamps[0] == stamps[1] < stamps[2] == stamps[3]
    for k, (top, bottom) in enumerate(rendered.pairs()):
        np.testing.assert_array_equal(bottom.image, rendered[2 * k].image)
        np.testing.assert_array_equal(top.range, rendered[2 * k + 1].range)
    with pytest.raises(IndexError):
        rendered[4]


def test_the_bottom_camera_is_that_of_the_sequence_alone(rendered):
    alone = render_sequence('corridor', 1, 2, HEIGHT)
    np.testing.assert_array_equal(rendered[2].image, alone[1].image)
    np.testing.assert_array_equal(rendered[2].position, alone[1].position)


def test_the_top_camera_is_where_the_rig_says(rendered):
    up = np.array([0.1, 0, 1]) / np.hypot(0.1, 1) * 0.4
    for top, bottom in rendered.pairs():
        pose = true_pose(top, bottom)
        np.testing.assert_allclose(pose.rotation, rendered.true_pose().rotation, atol=1e-12)
        np.testing.assert_allclose(pose.position, rendered.true_pose().position, atol=1e-9)
        np.testing.assert_allclose(top_rpy(pose.rotation), RPY, atol=1e-12)
        np.testing.assert_allclose(OPTICAL_FROM_LINK.T @ pose.position, up, atol=1e-9)


def test_both_see_the_same_world(rendered):
    """A point that the bottom camera ranges is as far from the top one as that one ranges it."""
    top, bottom = next(rendered.pairs())
    rays = Equirectangular(HEIGHT, 2 * HEIGHT).bearings()
    pose = true_pose(top, bottom)
    points = (rays * bottom.range[..., None] - pose.position) @ pose.rotation
    expected = np.linalg.norm(points, axis=-1)
    u, v = np.moveaxis(np.rint(Equirectangular(HEIGHT, 2 * HEIGHT).project(points)).astype(int),
                       -1, 0)
    found = top.range[v.clip(0, HEIGHT - 1), u % (2 * HEIGHT)]
    assert np.median(np.abs(found / expected - 1)) < 0.02


def test_the_top_camera_may_be_darker_and_of_another_colour():
    plain = render_binocular('corridor', 1, 1, HEIGHT, noise=NO_NOISE, jpeg=None)
    tinted = render_binocular('corridor', 1, 1, HEIGHT,
                              TopCamera(gain=0.5, white_balance=(1.0, 1.0, 0.5)),
                              noise=NO_NOISE, jpeg=None)
    np.testing.assert_array_equal(plain[0].image, tinted[0].image)
    before, after = plain[1].image.astype(float), tinted[1].image.astype(float)
    assert 0.5 < after[..., 2].mean() / before[..., 2].mean() < 0.85  # sRGB of half the light
    assert after[..., 0].mean() / before[..., 0].mean() < 0.6


def test_hovering_stays_in_place():
    hovering = render_binocular('street', 1, 3, HEIGHT, spacing=0.0)
    np.testing.assert_allclose(np.ptp(hovering.bottom.trajectory.positions, axis=0), 0, atol=1e-12)
    turned = hovering.bottom.trajectory.rotations
    assert not np.allclose(turned[0], turned[1], atol=1e-3)


def test_folder_and_bag_hold_it(rendered, tmp_path):
    save_binocular(rendered, tmp_path / 'folder', small_height=16)
    meta = json.loads((tmp_path / 'folder' / 'meta.json').read_text())
    assert [f['role'] for f in meta['frames']] == ['bottom', 'top'] * 2
    assert [(p['bottom'], p['top']) for p in meta['pairs']] == [(0, 1), (2, 3)]
    np.testing.assert_allclose(np.radians(meta['pairs'][0]['top_in_bottom_rpy_deg']), RPY)
    assert meta['pairs'][0]['baseline_m'] == 0.4
    loaded = load_sequence(tmp_path / 'folder')
    path = tmp_path / 'pairs.mcap'
    write_binocular_bag(loaded, path)
    source = open_source(path)
    assert set(source.topics) == {'/bottom/image/compressed', '/top/image/compressed',
                                  '/odometry', '/ground_truth/range'}
    found = {topic: [r.message() for r in source.records([topic])] for topic in source.topics}
    assert all(len(messages) == 2 for messages in found.values())
    for side, offset in (('bottom', 0), ('top', 1)):
        for k, message in enumerate(found[f'/{side}/image/compressed']):
            frame = decode_frame(message)
            assert frame.key.stamp == rendered[2 * k].stamp
            assert frame.key.frame_id == ('camera_optical', 'top_camera_optical')[offset]
            assert bytes(message.data) == rendered[2 * k + offset].jpeg
    truth = read_depth(found['/ground_truth/range'][1])
    assert truth.shape == (16, 32)
    np.testing.assert_allclose(truth, rendered.camera(2, 16).range(), rtol=3e-4)
    pose = odometry_sample(found['/odometry'][1])
    np.testing.assert_allclose(pose.rotation @ OPTICAL_FROM_LINK.T, rendered[2].rotation,
                               atol=1e-7)
    np.testing.assert_allclose(pose.position, rendered[2].position)
    save_folder = tmp_path / 'mono'
    from sphstereo_ros.scenes.sequence import save_sequence
    save_sequence(render_sequence('corridor', 1, 1, HEIGHT), save_folder)
    with pytest.raises(ValueError, match='no pairs'):
        write_binocular_bag(load_sequence(save_folder), tmp_path / 'no.mcap')


def test_roll_pitch_yaw_as_elsewhere():
    np.testing.assert_allclose(top_rpy(OPTICAL_FROM_LINK @ matrix_from_rpy(*RPY)
                                       @ OPTICAL_FROM_LINK.T), RPY)


def _command(*words):
    parser = argparse.ArgumentParser()
    command.add_arguments(parser)
    return command.main(parser.parse_args([str(word) for word in words]))


def test_command_renders_pairs(tmp_path, capsys):
    folder, bag = tmp_path / 'out', tmp_path / 'pairs.mcap'
    assert _command('corridor', folder, '--binocular', '--frames', 2, '--height', HEIGHT,
                    '--top', 1, -2, 3, '--baseline', 0.2, '--direction', 0, 0.1, 1, '--spacing', 0,
                    '--top-gain', 0.7, '--bag', bag) == 0
    capsys.readouterr()
    meta = json.loads((folder / 'meta.json').read_text())
    np.testing.assert_allclose(meta['pairs'][1]['top_in_bottom_rpy_deg'], (1, -2, 3))
    np.testing.assert_allclose(meta['pairs'][1]['top_in_bottom_xyz'],
                               0.2 * np.array([0, 0.1, 1]) / np.hypot(0.1, 1))
    assert meta['frames'][0]['position_m'] == meta['frames'][2]['position_m']
    assert open_source(bag).count(['/top/image/compressed']) == 2
    assert _command('corridor', tmp_path / 'no', '--binocular', '--baseline', 0) == 2
    assert 'must be positive' in capsys.readouterr().err
