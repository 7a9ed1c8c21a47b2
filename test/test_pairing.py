"""Windows of frames: which references, which drops, what waits."""
from __future__ import annotations

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sphstereo_ros.core import rotations
from sphstereo_ros.core.config import ParameterError, resolve
from sphstereo_ros.core.frames import Drop, Frame, FrameKey, PairedWindow
from sphstereo_ros.core.motion import ImuSample, OdometrySample, TwistSample
from sphstereo_ros.core.pairing import (
    MAX_BYTES,
    MAX_WAITING,
    Outcome,
    Pairer,
    farthest_reference,
    frame_bytes,
    nearest_matches,
)

STEP = 33_333_333
Sample = OdometrySample | TwistSample


def frame(stamp: int, frame_id: str = 'camera_optical', height: int = 4) -> Frame:
    return Frame(FrameKey(stamp, frame_id), np.zeros((height, 2 * height), np.uint8))


def odometry(stamp: int, x: float) -> OdometrySample:
    return OdometrySample(stamp, np.array([x, 0.0, 0.0]), np.eye(3))


def pairer(**given: object) -> Pairer:
    return Pairer(resolve({k.replace('__', '.'): v for k, v in given.items()}))


def window(outcome: list[Outcome]) -> tuple[int, list[tuple[int, float]]]:
    """The one window among the outcome: current stamp, and (stamp, baseline) of references."""
    assert len(outcome) == 1, outcome
    assert isinstance(outcome[0], PairedWindow), outcome
    return outcome[0].current.key.stamp, [(r.frame.key.stamp, round(r.pose.baseline, 9))
                                          for r in outcome[0].references]


def cause(outcome: list[Outcome]) -> str:
    assert len(outcome) == 1, outcome
    assert isinstance(outcome[0], Drop), outcome
    return outcome[0].cause


def test_intervals_fill_as_frames_come() -> None:
    p = pairer(pairing__intervals=(3, 1), baseline__length=0.28)
    assert cause(p.add_frame(frame(0))) == 'first_frame'
    assert window(p.add_frame(frame(1))) == (1, [(0, 0.28)])
    assert window(p.add_frame(frame(2))) == (2, [(1, 0.28)])
    assert window(p.add_frame(frame(3))) == (3, [(2, 0.28), (0, 0.84)])
    assert window(p.add_frame(frame(4))) == (4, [(3, 0.28), (1, 0.84)])


def test_a_reference_not_there_yet_is_not_waited_for() -> None:
    p = pairer(pairing__intervals=(2,), baseline__length=0.28)
    assert cause(p.add_frame(frame(0))) == 'first_frame'
    assert cause(p.add_frame(frame(1))) == 'no_reference'
    assert window(p.add_frame(frame(2))) == (2, [(0, 0.56)])


@pytest.mark.parametrize(('second', 'expected'), [
    (frame(STEP, 'other'), 'frame_id_changed'),
    (frame(STEP, height=8), 'size_changed'),
    (frame(-STEP), 'stamp_backward'),
    (frame(1_000_000_001), 'stamp_gap'),
])
def test_a_discontinuity_starts_anew(second: Frame, expected: str) -> None:
    p = pairer(baseline__length=0.28)
    p.add_frame(frame(0))
    assert cause(p.add_frame(second)) == expected
    stamp = second.key.stamp
    third = frame(stamp + STEP, second.key.frame_id, second.image.shape[0])
    assert window(p.add_frame(third)) == (stamp + STEP, [(stamp, 0.28)])


def test_a_duplicate_changes_nothing() -> None:
    p = pairer(baseline__length=0.28)
    p.add_frame(frame(0))
    p.add_frame(frame(STEP))
    assert cause(p.add_frame(frame(STEP))) == 'duplicate_stamp'
    assert window(p.add_frame(frame(2 * STEP))) == (2 * STEP, [(STEP, 0.28)])


def test_a_gap_of_exactly_the_limit_is_none() -> None:
    p = pairer()
    p.add_frame(frame(0))
    assert isinstance(p.add_frame(frame(1_000_000_000))[0], PairedWindow)


def test_a_frame_waits_for_odometry_that_encloses_it() -> None:
    p = pairer(baseline__source='odometry')
    assert p.add_odometry(odometry(0, 0.0)) == []
    assert cause(p.add_frame(frame(0))) == 'first_frame'
    assert p.add_frame(frame(100)) == []
    assert p.add_frame(frame(200)) == []
    assert window(p.add_odometry(odometry(150, 1.5))) == (100, [(0, 1.0)])
    assert window(p.add_odometry(odometry(250, 2.5))) == (200, [(100, 1.0)])


def test_an_equal_stamp_needs_no_later_message() -> None:
    p = pairer(baseline__source='odometry')
    p.add_frame(frame(0))
    p.add_odometry(odometry(0, 0.0))
    p.add_odometry(odometry(100, 1.0))
    assert window(p.add_frame(frame(100))) == (100, [(0, 1.0)])


def test_a_frame_waits_for_twist() -> None:
    p = pairer(baseline__source='twist')
    p.add_frame(frame(0))
    p.add_twist(TwistSample(0, np.array([2.0, 0, 0]), np.zeros(3)))
    assert p.add_frame(frame(500_000_000)) == []
    out = p.add_twist(TwistSample(500_000_000, np.array([2.0, 0, 0]), np.zeros(3)))
    assert window(out) == (500_000_000, [(0, 1.0)])


def test_frames_do_not_wait_for_ever() -> None:
    p = pairer(baseline__source='odometry')
    p.add_frame(frame(0))
    for i in range(1, MAX_WAITING + 1):
        assert p.add_frame(frame(i)) == []
    assert cause(p.add_frame(frame(MAX_WAITING + 1))) == 'odometry_missing'
    assert [d.cause for d in p.flush() if isinstance(d, Drop)] == ['odometry_missing'] * 10
    assert p.flush() == []


def test_what_waits_is_dropped_before_a_new_start() -> None:
    p = pairer(baseline__source='odometry')
    p.add_frame(frame(0))
    p.add_frame(frame(1))
    out = p.add_frame(frame(2, 'other'))
    assert [d.cause for d in out if isinstance(d, Drop)] == ['odometry_missing',
                                                             'frame_id_changed']


def test_a_recording_that_loops() -> None:
    """Stamps run backward by seconds, in odometry as in frames, and the second round is whole."""
    p = pairer(baseline__source='odometry')
    outcomes: list[Outcome] = []
    for _ in range(2):
        for i in range(100):
            outcomes += p.add_frame(frame(i * STEP)) + p.add_odometry(odometry(i * STEP, 0.3 * i))
    causes = Counter(o.cause for o in outcomes if isinstance(o, Drop))
    assert causes == {'first_frame': 1, 'stamp_backward': 1}
    assert sum(isinstance(o, PairedWindow) for o in outcomes) == 198


def test_sensor_drops_come_on_top() -> None:
    p = pairer()
    p.add_imu(ImuSample(0, np.zeros(3)))
    assert cause(p.add_imu(ImuSample(0, np.zeros(3)))) == 'imu_duplicate'
    assert cause(p.add_odometry(odometry(0, np.nan))) == 'odometry_invalid'


def test_baselines_take_the_nearest_match() -> None:
    p = pairer(pairing__baselines=(1.0, 0.3), baseline__length=0.28)
    assert cause(p.add_frame(frame(0))) == 'first_frame'
    assert window(p.add_frame(frame(1))) == (1, [(0, 0.28)])
    assert window(p.add_frame(frame(2))) == (2, [(1, 0.28)])
    # 0.84 is not taken for 1.0: 1.12 comes nearer.
    assert window(p.add_frame(frame(3))) == (3, [(2, 0.28)])
    assert window(p.add_frame(frame(4))) == (4, [(3, 0.28), (0, 1.12)])
    assert window(p.add_frame(frame(5))) == (5, [(4, 0.28), (1, 1.12)])


def test_hover_among_baselines() -> None:
    """Frames of a hover are no references; what lies before it still is."""
    p = pairer(pairing__baselines=(1.0,), baseline__source='odometry')
    outcomes = []
    for i, x in enumerate([0.0, 0.5, 1.0, 1.001, 1.002]):
        p.add_odometry(odometry(i, x))
        outcomes.append(p.add_frame(frame(i)))
    assert window(outcomes[4]) == (4, [(0, 1.002)])
    p = pairer(pairing__baselines=(1.0,), baseline__source='odometry')
    for i in range(2):
        p.add_odometry(odometry(i, 0.0))
        last = p.add_frame(frame(i))
    assert cause(last) == 'baseline_too_short'


def test_hover_among_intervals() -> None:
    p = pairer(pairing__intervals=(1, 3), baseline__source='odometry')
    for i, x in enumerate([0.0, 0.5, 1.0, 1.001]):
        p.add_odometry(odometry(i, x))
        last = p.add_frame(frame(i))
    assert window(last) == (3, [(0, 1.001)])


def test_a_baseline_out_of_reach_is_named() -> None:
    p = pairer(pairing__baselines=(2.8,), baseline__length=0.28)
    p.add_frame(frame(0))
    assert cause(p.add_frame(frame(1))) == 'no_reference'


@pytest.mark.parametrize('given', [{'baseline.source': 'fixed'}, {'baseline.source': 'speed'}])
def test_baselines_need_metres(given: dict[str, object]) -> None:
    with pytest.raises(ParameterError, match=r'pairing\.baselines'):
        resolve({'pairing.baselines': (1.0,), **given})


def test_frames_kept_are_bounded() -> None:
    p = pairer(pairing__baselines=(500.0,), baseline__length=1.0)
    for i in range(150):
        p.add_frame(frame(i))
    assert len(p._frames) == 100
    p.configure(resolve({'pairing.intervals': (2,)}))
    assert len(p._frames) == 2
    assert window(p.add_frame(frame(999))) == (999, [(148, 2e-6)])


def test_memory_of_frames_is_bounded() -> None:
    config = resolve({'pairing.baselines': (1.0,), 'baseline.length': 0.1}).pairing
    assert farthest_reference(config, 1) == 100
    assert farthest_reference(config, MAX_BYTES // 7) == 7
    assert farthest_reference(config, 2 * MAX_BYTES) == 1
    config = resolve({'pairing.baselines': (1.0,), 'baseline.length': 0.1,
                      'pairing.max_frames': 300}).pairing
    assert farthest_reference(config, 1) == 300
    assert farthest_reference(resolve({}).pairing, MAX_BYTES) == 10
    colour = np.zeros((4, 8, 3), np.uint8)
    assert frame_bytes(replace(frame(0), colour=colour)) == 4 * 8 * 4


def test_the_pose_follows_parameters_at_run_time() -> None:
    p = pairer(baseline__length=0.28)
    p.add_frame(frame(0))
    p.configure(resolve({'baseline.length': 0.5}))
    assert window(p.add_frame(frame(1))) == (1, [(0, 0.5)])


@given(st.lists(st.floats(0.0, 10.0), max_size=12), st.lists(st.floats(0.01, 10.0), min_size=1,
                                                            max_size=3))
def test_nearest_match_is_the_nearest(distances: list[float], wanted: list[float]) -> None:
    chosen = nearest_matches(distances, wanted)
    assert len(set(chosen)) == len(chosen) <= len(wanted)
    for want in wanted:
        if distances and want <= max(distances):
            best = min(abs(d - want) for d in distances)
            assert any(abs(distances[i] - want) == best for i in chosen)


def sensed(source: str, i: int, places: list[float]) -> Sample:
    """What tells that the vehicle is at `places[i]` at tick i; its speed changes at ticks."""
    if source == 'odometry':
        return odometry(i * STEP, places[i])
    # Trapezoids between samples: half way the rate has the mean of both.
    ahead = (places[i + 1] - places[i]) / (STEP / 1e9) if i + 1 < len(places) else 0.0
    return TwistSample(i * STEP, np.array([ahead, 0, 0]), np.array([0.0, 0.0, 0.3]))


@settings(deadline=None)
@given(st.lists(st.sampled_from([0.0, 0.001, 0.03, 0.1, 0.28, 0.5, 1.7]), min_size=1,
                max_size=40),
       st.sampled_from([(0.3, 1.0, 3.0), (1.0,), (0.5, 0.6)]),
       st.sampled_from(['odometry', 'twist', 'speed']))
def test_references_are_as_far_as_wanted_whatever_the_speed(
        steps: list[float], wanted: tuple[float, ...], source: str) -> None:
    """Hover, walk and drive: each wanted baseline has the frame that is nearest to it, as far
    back in time as that may be; what is not reached is left out.
    """
    p = pairer(pairing__baselines=wanted, baseline__source=source, baseline__speed=2.0,
               camera__mount__x=0.4, pairing__max_gap=0.5)
    places = [0.0, *np.cumsum(steps)]
    for i in range(len(places)):
        outcome = p.add_frame(frame(i * STEP))
        if source != 'speed':
            add = p.add_odometry if source == 'odometry' else p.add_twist
            outcome += add(sensed(source, i, places))  # type: ignore[arg-type]
        if i == 0:
            assert cause(outcome) == 'first_frame'
            continue
        found = {e: p._priors.between(e * STEP, i * STEP, i - e) for e in range(i)}
        apart = {e: pose.baseline for e, pose in found.items() if not isinstance(pose, Drop)}
        if isinstance(outcome[0], Drop):
            assert not apart or max(apart.values()) < min(wanted)
            assert outcome[0].cause == ('no_reference' if apart else 'baseline_too_short')
            continue
        got = {r.frame.key.stamp // STEP: r.pose.baseline for r in outcome[0].references}
        assert list(got.values()) == sorted(got.values())
        assert got == pytest.approx({e: apart[e] for e in got}, abs=1e-9)
        for want in wanted:
            if want <= max(apart.values()):
                nearest = min(abs(d - want) for d in apart.values())
                assert min(abs(d - want) for d in got.values()) == pytest.approx(nearest, abs=1e-4)
        assert len(got) <= len(wanted)


@pytest.mark.parametrize('source', ['odometry', 'twist'])
def test_distances_are_those_of_the_poses(source: str) -> None:
    """Also with a lever arm and turns, and after a sample that comes late."""
    p = pairer(pairing__baselines=(0.7,), baseline__source=source, camera__mount__x=1.5,
               camera__mount__y=-0.3, baseline__minimum=0.0)
    for i in range(20):
        turned = rotations.exp((0.0, 0.0, 0.05 * i))
        p.add_odometry(OdometrySample(i * STEP, np.array([0.1 * i, 0.02 * i * i, 0.0]), turned))
        p.add_twist(TwistSample(i * STEP, np.array([0.1 * i, 0.3, 0.0]),
                                np.array([0.0, 0.0, 0.1 * i])))
    stamps = [i * STEP for i in range(18, 2, -1)]
    for late in (False, True):
        if late:
            at = 18 * STEP + STEP // 2
            p.add_odometry(OdometrySample(at, np.array([9.0, 9.0, 0.0]), np.eye(3)))
            p.add_twist(TwistSample(at, np.array([40.0, 0.0, 0.0]), np.zeros(3)))
        expected = [p._priors.between(s, 18 * STEP + 3 * STEP // 4, 1).baseline for s in stamps]
        found = list(p._priors.distances(18 * STEP + 3 * STEP // 4, stamps))
        np.testing.assert_allclose(found, expected, rtol=1e-9)


def test_beyond_the_reach_of_the_sensor_nothing_is_found() -> None:
    p = pairer(pairing__baselines=(0.5,), baseline__source='odometry')
    p.add_odometry(odometry(2 * STEP, 1.0))
    p.add_odometry(odometry(3 * STEP, 1.6))
    stamps = [2 * STEP, STEP, 0]
    assert list(p._priors.distances(3 * STEP, stamps)) == pytest.approx(
        [0.6, np.nan, np.nan], nan_ok=True)


EVENTS = st.one_of(
    st.tuples(st.just('frame'), st.integers(0, 60), st.sampled_from(['a', 'b'])),
    st.tuples(st.sampled_from(['odometry', 'twist', 'imu', 'flush']), st.integers(0, 60),
              st.just('')))


@given(st.lists(EVENTS, max_size=60), st.sampled_from(['fixed', 'twist', 'odometry']),
       st.sampled_from([(1,), (1, 3), (2,)]))
def test_every_frame_has_one_outcome(events: list[tuple[str, int, str]], source: str,
                                     intervals: tuple[int, ...]) -> None:
    """Whatever comes in whatever order: no frame is lost, none is told of twice."""
    p = pairer(baseline__source=source, pairing__intervals=intervals, pairing__max_gap=1.0)
    out: list[Outcome] = []
    frames = 0
    for kind, tick, name in events:
        stamp = tick * 50_000_000
        if kind == 'frame':
            frames += 1
            out += p.add_frame(frame(stamp, name))
        elif kind == 'odometry':
            out += p.add_odometry(odometry(stamp, 0.1 * tick))
        elif kind == 'twist':
            out += p.add_twist(TwistSample(stamp, np.array([2.0, 0, 0]), np.zeros(3)))
        elif kind == 'imu':
            out += p.add_imu(ImuSample(stamp, np.zeros(3)))
        else:
            out += p.flush()
    out += p.flush()
    of_sensors = ('odometry_duplicate', 'odometry_backward', 'twist_duplicate', 'twist_backward',
                  'imu_duplicate', 'imu_backward')
    told = [o for o in out if not (isinstance(o, Drop) and o.cause in of_sensors)]
    assert len(told) == frames
    for o in told:
        if isinstance(o, PairedWindow):
            stamps = [r.frame.key.stamp for r in o.references]
            assert 1 <= len(set(stamps)) == len(stamps) <= len(intervals)
            assert all(s < o.current.key.stamp for s in stamps)
            assert {r.frame.key.frame_id for r in o.references} == {o.current.key.frame_id}
            assert o.is_metric == (source != 'fixed')


def test_at_most_so_many_windows_a_second_and_all_frames_are_references() -> None:
    p = pairer(pairing__intervals=(1, 2), baseline__length=0.28, pairing__max_rate=15.0)
    outcomes = [p.add_frame(frame(i * STEP)) for i in range(9)]
    assert [o[0].cause if isinstance(o[0], Drop) else 'window' for o in outcomes] == [
        'first_frame', 'window', *['rate_limit', 'window'] * 3, 'rate_limit']
    assert window(outcomes[3]) == (3 * STEP, [(2 * STEP, 0.28), (STEP, 0.56)])


def test_without_a_limit_every_frame_has_a_window() -> None:
    p = pairer(pairing__intervals=(1,), baseline__length=0.28)
    assert cause(p.add_frame(frame(0))) == 'first_frame'
    for i in range(1, 5):
        assert window(p.add_frame(frame(i)))[0] == i
