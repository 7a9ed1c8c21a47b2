from __future__ import annotations

from dataclasses import replace
from functools import cache

import cv2
import numpy as np
import pytest
from analytic_world import World, look

from sphstereo_ros.core import rotations
from sphstereo_ros.core.alignment import Aligner
from sphstereo_ros.core.chain import Chain, StageResults
from sphstereo_ros.core.cloud import point_cloud
from sphstereo_ros.core.config import resolve
from sphstereo_ros.core.frames import Drop, Frame, FrameKey
from sphstereo_ros.core.motion import ImuSample, OdometrySample, TwistSample
from sphstereo_ros.core.pairing import Pairer
from sphstereo_ros.core.stabilisation import Stabiliser
from sphstereo_ros.core.stereo import SphericalStereo

HEIGHT, STEP, PERIOD = 200, 0.28, 33_333_333
FIXED = {'baseline.length': STEP}


@cache
def attitudes() -> tuple[np.ndarray, ...]:
    """A camera that shakes."""
    rng = np.random.default_rng(3)
    return tuple(rotations.exp(rng.uniform(-0.02, 0.02, 3)) for _ in range(4))


@cache
def frames() -> tuple[Frame, ...]:
    """Four frames of a camera that goes forward and shakes."""
    return tuple(
        Frame(FrameKey(k * PERIOD, 'camera_optical'),
              look(World(), (0, 0, STEP * k), attitude, HEIGHT).image)
        for k, attitude in enumerate(attitudes()))


def run(chain: Chain, given: tuple[Frame, ...]) -> list[StageResults | Drop]:
    return [outcome for frame in given for outcome in chain.add_frame(frame)]


def assert_same(a: StageResults, b: StageResults) -> None:
    for one, other in zip(a.aligned.references, b.aligned.references, strict=True):
        np.testing.assert_array_equal(one.pose.rotation, other.pose.rotation)
        np.testing.assert_array_equal(one.pose.position, other.pose.position)
    np.testing.assert_array_equal(a.range_image.range, b.range_image.range)
    np.testing.assert_array_equal(a.range_image.sigma, b.range_image.sigma)
    np.testing.assert_array_equal(a.cloud.xyz, b.cloud.xyz)
    np.testing.assert_array_equal(a.cloud.intensity, b.cloud.intensity)


def test_every_frame_has_one_outcome_and_true_range():
    first, *rest = run(Chain(resolve(FIXED)), frames())
    assert first.cause == 'first_frame'
    assert len(rest) == 3
    for k, result in enumerate(rest, start=1):
        assert isinstance(result, StageResults)
        assert result.range_image.key == result.cloud.key == frames()[k].key
        true = look(World(), (0, 0, STEP * k), attitudes()[k], HEIGHT).range
        error = np.abs(result.range_image.range / true - 1)
        assert np.nanmedian(error) < 0.01
        assert np.isfinite(error).mean() > 0.8
        assert len(result.cloud.xyz) == np.isfinite(result.range_image.range).sum()
    assert Chain(resolve(FIXED)).flush() == []


def test_the_chain_is_its_stages_one_by_one():
    config = resolve(FIXED)
    _, result, *_ = run(Chain(config), frames()[:2])
    pairer = Pairer(config)
    pairer.add_frame(frames()[0])
    paired, = pairer.add_frame(frames()[1])
    stabilised = Stabiliser(config).process(paired)
    aligned = Aligner(config).process(stabilised)
    measured = SphericalStereo(config).process(aligned)
    cloud = point_cloud(measured, frames()[1], config)
    assert_same(result, StageResults(paired, stabilised, aligned, measured, cloud))


def test_the_same_frames_give_the_same_results():
    a, b = (run(Chain(resolve({**FIXED, 'pairing.intervals': [1, 2]})), frames())
            for _ in range(2))
    assert [isinstance(x, Drop) for x in a] == [True, False, False, False]
    for one, other in zip(a[1:], b[1:], strict=True):
        assert_same(one, other)
    assert [len(r.aligned.references) for r in a[1:]] == [1, 2, 2]


def test_warming_up_changes_nothing():
    cold, warm = Chain(resolve(FIXED)), Chain(resolve(FIXED))
    warm.warm_up()
    assert_same(run(cold, frames()[:2])[1], run(warm, frames()[:2])[1])


@pytest.mark.parametrize('step', [STEP, 0.25])
def test_without_a_baseline_range_is_relative_and_there_is_no_cloud(step):
    metric = run(Chain(resolve({'baseline.length': step})), frames()[:2])[1]
    relative = run(Chain(resolve({})), frames()[:2])[1]
    assert not relative.range_image.is_metric
    assert relative.cloud is None
    both = np.isfinite(metric.range_image.range) & np.isfinite(relative.range_image.range)
    assert both.mean() > 0.8
    np.testing.assert_allclose(step * relative.range_image.range[both],
                               metric.range_image.range[both], rtol=0.01)


def test_drops_of_every_stage_are_returned_and_the_chain_goes_on():
    chain = Chain(resolve(FIXED))
    one, two, three, four = frames()
    black = replace(two, image=np.zeros_like(two.image))
    still = replace(three, image=four.image)
    outcomes = run(chain, (one, black, still, four))
    causes = [x.cause if isinstance(x, Drop) else 'result' for x in outcomes]
    assert causes[2] in {'too_few_points', 'too_few_inliers'}  # its reference is black
    assert causes == ['first_frame', 'too_few_points', causes[2], 'no_parallax']
    after = chain.add_frame(replace(one, key=FrameKey(4 * PERIOD, 'camera_optical'),
                                    image=three.image))
    assert isinstance(after[0], StageResults)


def test_failures_of_late_stages_are_returned():
    chain = Chain(resolve(FIXED))
    chain.add_frame(frames()[0])
    chain.aligner.process = lambda window: Drop('alignment_failed')
    assert chain.add_frame(frames()[1]) == [Drop('alignment_failed')]
    chain = Chain(resolve(FIXED))
    chain.add_frame(frames()[0])
    chain.stereo.process = lambda window: Drop('size_changed')
    assert chain.add_frame(frames()[1]) == [Drop('size_changed')]


def test_a_mask_reaches_every_stage():
    mask = np.zeros((50, 100), np.uint8)
    mask[35:] = 9
    result = run(Chain(resolve(FIXED), mask), frames()[:2])[1]
    hidden = cv2.resize(mask, (2 * HEIGHT, HEIGHT), interpolation=cv2.INTER_NEAREST) != 0
    assert np.isnan(result.range_image.range[hidden]).all()
    assert np.isfinite(result.range_image.range[~hidden]).mean() > 0.72


def test_frames_wait_for_their_odometry():
    """Where odometry gives the distance, results come when its message has come."""
    chain = Chain(resolve({'baseline.source': 'odometry'}))
    assert [d.cause for d in run(chain, frames()[:1])] == ['first_frame']
    assert chain.add_frame(frames()[1]) == []
    got = []
    for k in range(2):
        got += chain.add_odometry(OdometrySample(k * PERIOD, np.array([2 * STEP * k, 0, 0]),
                                                 np.eye(3)))
    result, = got
    assert result.range_image.is_metric
    fixed = run(Chain(resolve(FIXED)), frames()[:2])[1]
    both = np.isfinite(result.range_image.range) & np.isfinite(fixed.range_image.range)
    ratio = result.range_image.range[both] / fixed.range_image.range[both]
    assert np.median(ratio) == pytest.approx(2.0, rel=0.01)  # it was told twice the distance


def test_twist_gives_the_distance():
    chain = Chain(resolve({'baseline.source': 'twist'}))
    got = run(chain, frames()[:2])
    for k in range(-1, 3):
        got += chain.add_twist(TwistSample(k * PERIOD, np.array([STEP / (PERIOD * 1e-9), 0, 0]),
                                           np.zeros(3)))
    got += chain.flush()
    result = next(x for x in got if isinstance(x, StageResults))
    assert result.paired.references[0].pose.baseline == pytest.approx(STEP, rel=1e-6)
    assert result.cloud is not None


def test_an_imu_is_taken_along():
    chain = Chain(resolve(FIXED))
    for k in range(-1, 3):
        assert chain.add_imu(ImuSample(k * PERIOD, np.zeros(3))) == []
    assert isinstance(run(chain, frames()[:2])[1], StageResults)


def test_what_waits_at_the_end_is_dropped_by_name():
    chain = Chain(resolve({'baseline.source': 'odometry'}))
    run(chain, frames()[:2])
    drop, = chain.flush()
    assert drop.cause == 'odometry_missing'
