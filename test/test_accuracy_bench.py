"""The accuracy benchmark: figures of constructed images, methods against exact truth, files."""
from __future__ import annotations

import json

import cv2
import numpy as np
import pytest
import room
from hypothesis import given
from hypothesis import strategies as st

from sphstereo_ros import cli
from sphstereo_ros.bench import speed
from sphstereo_ros.bench.accuracy import Contest, frames_to_skip
from sphstereo_ros.bench.methods import COMPARED, METHODS, Method, method
from sphstereo_ros.bench.scoring import average, compare, solid_angle, weighted_median
from sphstereo_ros.bench.sequences import Scenes, saved
from sphstereo_ros.bench.tables import tables
from sphstereo_ros.core.camera import Equirectangular
from sphstereo_ros.core.chain import StageResults
from sphstereo_ros.replay.records import BadInput
from sphstereo_ros.scenes.sequence import TruthFrame, save_sequence

HEIGHT, STEP = 240, 0.15
FORWARD = np.array([0.0, 0, 1])


def sphere(value: float, height: int = 90) -> np.ndarray:
    return np.full((height, 2 * height), value, np.float32)


def off_forward(height: int = 90) -> np.ndarray:
    return np.degrees(np.arccos(Equirectangular(height, 2 * height).bearings() @ FORWARD))


def images(count: int) -> list[TruthFrame]:
    """A drive through a room, along +z of the camera."""
    out = []
    for i in range(count):
        position = np.array([0, 0, STEP * i])
        grey, distance = room.view(position, np.eye(3), HEIGHT)
        out.append(TruthFrame(i * 33_333_333, np.repeat(grey[..., None], 3, axis=2), distance,
                              np.eye(3), position))
    return out


# scoring

def test_bands_tell_coverage_error_and_calibration() -> None:
    truth = sphere(5)
    truth[:, :90] = 20
    measured = truth * np.float32(1.02)
    measured[:, :45] = np.nan
    measured[:, 150:] = 6  # 20 % too far, a third of the near half
    sigma = sphere(0.2)
    scores = compare(measured, truth, sigma)
    near, middle = scores['0-10'], scores['10-30']
    assert near['coverage'] == pytest.approx(100)
    assert middle['coverage'] == pytest.approx(50)
    assert near['median'] == pytest.approx(2, rel=1e-3)
    assert near['bad'] == pytest.approx(100 / 3)
    # 0.1 m and 0.4 m are 0.5 and 2 sigma; 1 m is 5 sigma.
    assert near['within_1_sigma'] == pytest.approx(200 / 3)
    assert near['within_3_sigma'] == pytest.approx(200 / 3)
    assert middle['within_1_sigma'] == 0
    assert middle['within_3_sigma'] == 100
    assert scores['30-100'] == {'coverage': None, 'median': None, 'bad': None}
    assert scores['danger'] == 0
    assert scores['ghost'] is None
    assert scores['by_range']['14-20']['coverage'] == pytest.approx(50)
    assert scores['by_range']['4.5-6.5']['share'] == pytest.approx(50)


def test_danger_and_ghosts_count_by_solid_angle() -> None:
    truth = sphere(np.inf)
    truth[45:] = 4
    measured = truth.copy()
    measured[45:60] = np.inf
    measured[60:75] = 6.1
    measured[:10] = 9.9
    weight = solid_angle(90)[:, 0]
    scores = compare(measured, truth)
    assert scores['danger'] == pytest.approx(100 * weight[45:75].sum() / weight[45:].sum())
    assert scores['ghost'] == pytest.approx(100 * weight[:10].sum() / weight[:45].sum())
    measured[60:75] = 5.9  # not 1.5 times too far
    measured[:10] = 10.1
    scores = compare(measured, truth)
    assert scores['danger'] == pytest.approx(100 * weight[45:60].sum() / weight[45:].sum())
    assert scores['ghost'] == 0


def test_the_mask_is_not_counted() -> None:
    truth, measured = sphere(4), sphere(4)
    measured[:, :60] = np.inf
    mask = np.zeros(truth.shape, np.uint8)
    mask[:, :60] = 255
    assert compare(measured, truth)['danger'] == pytest.approx(100 / 3)
    scores = compare(measured, truth, mask=mask)
    assert (scores['danger'], scores['0-10']['coverage']) == (0, pytest.approx(100))


def test_the_cone_is_by_angle_from_the_motion() -> None:
    angle, truth = off_forward(), sphere(20)
    measured = np.where(angle < 4, np.nan, truth * 1.01).astype(np.float32)
    measured[angle > 178] = np.inf
    scores = compare(measured, truth, direction=FORWARD)
    ahead, behind = scores['cone']['ahead'], scores['cone']['behind']
    assert [ahead[s]['at_20m']['coverage'] for s in ('0-2', '2-4', '4-8')] == pytest.approx(
        [0, 0, 100])
    assert ahead['2-4']['all']['unknown'] == pytest.approx(100)
    assert ahead['2-4']['all']['median'] is None
    assert ahead['30-90']['at_20m']['median'] == pytest.approx(1, rel=1e-3)
    assert (behind['0-2']['all']['free'], behind['2-4']['all']['free']) == pytest.approx((100, 0))
    total = sum(group['all']['share'] for side in (ahead, behind) for group in side.values())
    assert total == pytest.approx(100)
    assert scores['ahead_at_40m']['0-3']['coverage'] is None
    scores = compare(measured, truth, direction=-FORWARD)
    assert scores['cone']['behind']['2-4']['all']['coverage'] == 0
    assert 'cone' not in compare(measured, truth)


def test_a_wall_ahead_is_unknown_or_free_inside_the_cone() -> None:
    angle, truth = off_forward(180), sphere(40, 180)
    measured = np.where(angle < 3, np.nan, truth * 1.05).astype(np.float32)
    measured[angle < 1] = 61
    wall = compare(measured, truth, direction=FORWARD)['ahead_at_40m']
    inside = (1 - np.cos(np.radians(1))) / (1 - np.cos(np.radians(3)))
    assert wall['0-3']['free'] == pytest.approx(100 * inside, abs=4)
    assert wall['0-3']['unknown'] == pytest.approx(100 * (1 - inside), abs=4)
    assert wall['3-10']['median'] == pytest.approx(5, rel=1e-3)


def test_what_moves_has_its_own_figures() -> None:
    truth, measured = sphere(8), sphere(8)
    moving = np.zeros(truth.shape, bool)
    moving[:, :40] = True
    measured[:, :10] = 8.9
    measured[:, 10:20] = 13
    measured[:, 20:30] = np.nan
    marked = np.zeros(truth.shape, np.uint8)
    marked[:, 30:60] = 255
    scores = compare(measured, truth, moving=moving, marked=marked)
    assert scores['moving'] == pytest.approx({
        'share': 100 * 40 / 180, 'farther': 50, 'much_farther': 25, 'unknown': 25, 'marked': 25,
        'falsely_marked': 100 * 20 / 140})
    assert scores['0-10']['bad'] == 0
    assert scores['danger'] == pytest.approx(100 * 10 / 180)
    assert 'moving' not in compare(measured, truth, moving=~np.ones_like(moving))


@given(st.lists(st.floats(0, 100), min_size=1, max_size=30))
def test_equal_weights_give_the_median(values: list[float]) -> None:
    given_ = np.array(values)
    low, high = np.sort(given_)[[(len(values) - 1) // 2, len(values) // 2]]
    assert low <= weighted_median(given_, np.ones(len(values))) <= high


def test_weights_move_the_median() -> None:
    assert weighted_median(np.array([3.0, 1, 2]), np.array([5.0, 1, 1])) == 3
    assert weighted_median(np.empty(0), np.empty(0)) is None


def test_averages_weigh_groups_by_their_share() -> None:
    scores = [{'a': 1.0, 'band': {'median': 1.0, 'bad': None}, 'g': {'share': 3.0, 'median': 1.0}},
              {'a': 3.0, 'band': {'median': 2.0, 'bad': None}, 'g': {'share': 1.0, 'median': 5.0},
               'moving': {'share': 1.0, 'farther': 7.0}}]
    assert average(scores) == {
        'a': 2.0, 'band': {'median': 1.5, 'bad': None}, 'g': {'share': 2.0, 'median': 2.0},
        'moving': {'share': 1.0, 'farther': 7.0}}
    empty = {'g': {'share': 0.0, 'median': None, 'coverage': None}}
    assert average([empty])['g'] == empty['g']


# methods

@pytest.mark.parametrize('name', METHODS)
def test_every_method_has_valid_parameters(name: str) -> None:
    Contest({name: method(name)})


def test_only_the_default_method_takes_given_parameters() -> None:
    given_ = {'range.max': 77.0}
    assert method('default', given_).parameters == given_
    assert all('range.max' not in method(name, given_).parameters
               for name in METHODS if name != 'default')


# contest

FAST = {'stereo.matcher': 'bm'}


@pytest.fixture(scope='module')
def summaries():
    contest = Contest({
        'window': Method({**FAST, 'pairing.intervals': [1, 3]}, remembers=True),
        'one': Method({**FAST, 'pairing.intervals': [1]}),
        'exact': Method({**FAST, 'pairing.intervals': [1]}, true_pose=True),
        'blind': Method({**FAST, 'pairing.intervals': [1], 'pose.min_inliers': 100000})})
    ticks = []
    contest.add(images(5), skip=3, advance=lambda: ticks.append(1))
    assert len(ticks) == 5
    return contest.summaries()


def test_poses_are_by_frames_back(summaries) -> None:
    assert summaries['exact']['references'] == {
        '1': {'rotation_deg': pytest.approx(0, abs=1e-6), 'direction_deg': pytest.approx(0),
              'lost': 0}}
    assert list(summaries['window']['references']) == ['1', '3']
    for errors in summaries['window']['references'].values():
        assert 0 < errors['rotation_deg'] < 0.1
        assert errors['lost'] == 0
    assert [s['frames'] for s in summaries.values()] == [2, 2, 2, 2]


def test_depth_is_scored(summaries) -> None:
    for name in ('window', 'one', 'exact'):
        assert summaries[name]['0-10']['coverage'] > 50
        assert summaries[name]['0-10']['median'] < 3
        assert summaries[name]['drops'] == {}


def test_a_dropped_frame_knows_nothing(summaries) -> None:
    assert sum(summaries['blind']['drops'].values()) == 2
    assert summaries['blind']['0-10']['coverage'] == 0
    assert summaries['blind']['danger'] == 0


def test_tables_tell_all_methods(summaries) -> None:
    text = tables(summaries)
    assert [line.split()[1] for line in text.splitlines()[4:8]] == list(summaries)
    assert '2 (2 too_few_points)' in text
    assert tables({'none': {'frames': 0}}) == 'no frame was scored'


def test_plots_are_written(summaries, tmp_path) -> None:
    pytest.importorskip('matplotlib')
    from sphstereo_ros.bench.plots import coverage_by_angle, error_by_range, write_plots
    paths = write_plots(summaries, tmp_path / 'new')
    assert [path.name for path in paths] == ['error_by_range.png', 'coverage_by_angle.png',
                                             'sigma_calibration.png']
    for path in paths:
        height, width = cv2.imread(str(path)).shape[:2]
        assert width > height > 300
    error, coverage = error_by_range(summaries).axes
    names = [line.get_label() for line in error.get_lines()]
    assert names == list(summaries)
    drawn = coverage.get_lines()[names.index('one')].get_ydata()
    told = [g['coverage'] for g in summaries['one']['by_range'].values() if g['share'] > 0.05]
    np.testing.assert_allclose(drawn[np.isfinite(drawn)], told)
    assert len(coverage_by_angle(summaries).axes[0].get_lines()) == 2 * len(summaries)


def test_short_sequences_are_scored_from_the_middle() -> None:
    assert [frames_to_skip(n, None) for n in (8, 10, 11, 14)] == [4, 5, 10, 10]
    assert frames_to_skip(8, 2) == 2


# the window's cost

def test_the_window_is_timed_beside_one_reference(monkeypatch) -> None:
    drive = [frame.image for frame in room.forward(5, STEP, 120)]
    given_ = {**FAST, 'baseline.length': STEP, 'pairing.intervals': [1, 2, 3]}
    clock, add_frame = [0.0], speed.Chain.add_frame

    def a_second_a_reference(chain, frame):
        outcomes = add_frame(chain, frame)
        clock[0] += sum(len(o.aligned.references) for o in outcomes
                        if isinstance(o, StageResults))
        return outcomes

    monkeypatch.setattr(speed.Chain, 'add_frame', a_second_a_reference)
    monkeypatch.setattr(speed.time, 'perf_counter', lambda: clock[0])
    assert speed.window_cost(drive, given_, 4) == {
        'window_ms': 3000, 'single_ms': 1000, 'window_ratio': 3}
    far = {**given_, 'pairing.intervals': [1, 9]}
    assert speed.window_cost(drive, far, 4)['window_ratio'] is None


# sequences and command

def test_folders_are_found_beside_other_ground_truth(tmp_path, monkeypatch) -> None:
    save_sequence(images(2), tmp_path / 'truth' / 'room')
    monkeypatch.setenv('SPHSTEREO_GROUND_TRUTH', str(tmp_path / 'truth'))
    from pathlib import Path
    assert [len(s) for s in saved([Path('room'), tmp_path / 'truth' / 'room'])] == [2, 2]
    with pytest.raises(BadInput, match='elsewhere'):
        next(saved([Path('elsewhere')]))


def test_rendered_scenes_are_kept(tmp_path) -> None:
    pytest.importorskip('embreex')
    scenes = Scenes('street', [1], frames=2, height=32, cache=tmp_path)
    first = [frame.image for frame in next(scenes.sequences())]
    image = tmp_path / 'street_1_2x32' / 'frame_0001.jpg'
    written = image.stat().st_mtime_ns
    again = [frame.image for frame in next(scenes.sequences())]
    assert image.stat().st_mtime_ns == written
    np.testing.assert_array_equal(first, again)
    rendered = [frame.image for frame in next(Scenes('street', [1], 2, 32).sequences())]
    np.testing.assert_array_equal(first, rendered)


def test_command_ends_with_json(tmp_path, capsys) -> None:
    save_sequence(images(3), tmp_path / 'room')
    words = ['bench', 'accuracy', str(tmp_path / 'room'), '--methods', 'default', '--json',
             '-p', 'stereo.matcher:=bm', '-p', 'pairing.intervals:=[1]']
    assert cli.main(words) == 0
    found = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert found['default']['frames'] == 2
    assert found['default']['0-10']['coverage'] > 50


@pytest.mark.parametrize(('words', 'message'), [
    (['--methods', 'default,magic'], 'magic is none of'), (['nowhere'], 'nowhere')])
def test_command_refuses_in_one_line(words, message, capsys) -> None:
    assert cli.main(['bench', 'accuracy', *words]) == 2
    error = capsys.readouterr().err.strip()
    assert message in error
    assert '\n' not in error


def test_all_compared_methods_exist() -> None:
    assert set(COMPARED) <= set(METHODS)
