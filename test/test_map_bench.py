from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip('embreex')

import trimesh

from sphstereo_ros import cli
from sphstereo_ros.bench import map_truth, mapping
from sphstereo_ros.core.frames import FrameKey
from sphstereo_ros.core.rotations import exp
from sphstereo_ros.core.track import TrackedFrame
from sphstereo_ros.scenes.material import Material
from sphstereo_ros.scenes.scene import Part, Scene
from sphstereo_ros.scenes.sequence import TruthFrame, render_sequence, save_sequence

NOTHING = np.zeros((0, 0, 3), np.uint8), np.zeros((0, 0))


def drive(count: int = 40) -> list[TruthFrame]:
    """Straight ahead, 0.3 m a frame, with turns."""
    rng = np.random.default_rng(1)
    return [TruthFrame(k, *NOTHING, exp(rng.normal(0, 0.1, 3)), np.array([0.3 * k, 0.0, 1.0]))
            for k in range(count)]


def tracked(truth: list[TruthFrame], turn: np.ndarray, shift: np.ndarray) -> list[TrackedFrame]:
    return [TrackedFrame(FrameKey(f.stamp, ''), turn @ f.rotation, turn @ f.position + shift)
            for f in truth]


def test_a_perfect_track_has_no_error_wherever_its_map_begins():
    truth = drive()
    turn, shift = exp(np.array([0.3, -1.0, 0.5])), np.array([4.0, -2.0, 7.0])
    points = np.random.default_rng(2).normal(size=(9, 3))
    rotations, positions, xyz = map_truth.in_world(
        tracked(truth, turn, shift), points @ turn.T + shift, truth)
    np.testing.assert_allclose(xyz, points, atol=1e-12)
    errors = map_truth.track_errors(rotations, positions, truth)
    assert errors.pop('distance_m') == pytest.approx(39 * 0.3)
    assert max(errors.values()) < 1e-5


def test_errors_of_a_track_are_shares_of_the_way():
    truth = drive()
    rotations = np.stack([f.rotation for f in truth])
    positions = np.stack([f.position for f in truth])
    longer = map_truth.track_errors(rotations, 1.02 * positions - [0, 0, 0.02], truth)
    for name in ('largest_percent', 'end_percent', 'rpe_percent', 'scale_percent'):
        assert longer[name] == pytest.approx(2.0, rel=1e-6)
    # Fitted, two ends are 1 % off: evenly spread that is 1 % / √3.
    assert longer['ate_percent'] == pytest.approx(1 / 3**0.5, rel=0.05)
    turned = map_truth.track_errors(rotations @ exp(np.array([0, 0, 0.01])), positions, truth)
    assert turned['turn_deg'] == pytest.approx(np.degrees(0.01), rel=1e-6)
    assert turned['rpe_percent'] == pytest.approx(1.0, rel=0.15)


@pytest.fixture(scope='module')
def box() -> Scene:
    """4 × 4 × 4 m about the origin, seen from inside, and a tilted plate in it."""
    plate = trimesh.creation.box((1.0, 1.0, 0.02))
    return Scene([Part('walls', trimesh.creation.box((4, 4, 4)), Material((0.5, 0.5, 0.5))),
                  Part('plate', plate, Material((0.5, 0.5, 0.5)), exp(np.array([0.5, 0.3, 0])),
                       np.array([0.3, 0.2, -0.4]))])


def test_the_distance_to_a_surface_is_the_shortest(box):
    xyz = np.array([[1.9, 0, 1.0], [-1.0, 1.7, 0.2], [2.05, 0, 0], [1.0, -1.2, -1.96]])
    np.testing.assert_allclose(map_truth.surface_distance(box, xyz), [0.1, 0.3, 0.05, 0.04],
                               atol=1e-5)
    above = np.array([[0.3, 0.2, -0.4]]) + exp(np.array([0.5, 0.3, 0])) @ [0.1, -0.2, 0.07]
    np.testing.assert_allclose(map_truth.surface_distance(box, above), [0.06], atol=1e-5)


def test_points_are_right_within_5_cm_and_1_percent_of_the_range(box):
    way = np.array([[0.0, 0.0, 0.0]])
    good = np.array([[1.95, 1.0, 0.5], [1.0, 1.94, 0.5]])
    loose, wrong = np.array([[1.9, 0.5, 1.0]]), np.array([[1.7, 0.2, 1.0]])
    told = map_truth.point_errors(np.concatenate([good, loose, wrong]), way, box)
    assert told['points_near'] == 4
    assert told['right_percent'] == 50.0
    assert told['loose_percent'] == 75.0


def test_coverage_is_of_patches():
    surface = np.array([[0.1 * k, 0, 0] for k in range(100)])
    assert map_truth.coverage(surface, surface[:30])['covered_percent'] == pytest.approx(31, abs=1)


def test_the_constant_speed_of_the_paper_keeps_directions_and_the_length_of_the_way():
    truth = [replace(f, position=np.array([0.01 * f.stamp**2, 0.003 * f.stamp, 0.0]))
             for f in drive()]
    assumed = mapping.at_constant_speed(truth)
    before, after = (np.diff([f.position for f in frames], axis=0) for frames in (truth, assumed))
    lengths = np.linalg.norm(after, axis=1)
    np.testing.assert_allclose(lengths, lengths[0])
    assert lengths.sum() == pytest.approx(np.linalg.norm(before, axis=1).sum())
    np.testing.assert_allclose(np.cross(before, after), 0, atol=1e-12)


def test_the_command_measures_what_sphstereo_map_makes(tmp_path, capsys):
    frames, height = 9, 120
    save_sequence(render_sequence('street', 1, frames, height), tmp_path / 'drive_1_9x120')
    words = ['bench', 'map', '--seed', '1', '--frames', str(frames), '--height', str(height),
             '--cache', str(tmp_path), '--kinds', 'odometry', '-p', 'stereo.matcher:=bm', '-p',
             'mapping.min_frames:=2', '--json']
    assert cli.main(words) == 0
    figures = json.loads(capsys.readouterr().out.splitlines()[-1])['odometry']
    assert 6 <= figures['placed'] <= figures['frames'] == frames
    assert figures['largest_percent'] < 1.0
    assert figures['points_near'] > 100
    assert 5 < figures['right_percent'] <= 100
    with pytest.raises(SystemExit) as end:
        cli.main([*words[:-6], '--kinds', 'none'])
    assert end.value.code == 2
