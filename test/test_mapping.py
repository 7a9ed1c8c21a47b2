from __future__ import annotations

import pickle
import sys
from functools import cache

import numpy as np
import pytest
from analytic_world import World, look, true_pose

from sphstereo_ros.core import rotations
from sphstereo_ros.core.config import resolve
from sphstereo_ros.core.frames import (
    AlignedWindow,
    Drop,
    Frame,
    FrameKey,
    RangeImage,
    Reference,
    RelativePose,
)
from sphstereo_ros.core.ground_scale import ground_scale
from sphstereo_ros.core.mapping import (
    Mapper,
    Submap,
    confirmed,
    first_pose,
)
from sphstereo_ros.core.motion import OdometrySample
from sphstereo_ros.core.registration import registered
from sphstereo_ros.core.submaps import MapBuilder
from sphstereo_ros.core.track import Track, TrackedFrame

HEIGHT, STEP, PERIOD, COUNT = 100, 0.1, 33_333_333, 16
METRES = {'baseline.source': 'odometry', 'mapping.min_frames': 2}
WORLD = World()


def key(k: int) -> FrameKey:
    return FrameKey((k + 1) * PERIOD, 'camera_optical')


@cache
def views():
    """A drive of the camera through a room, with a little shake."""
    rng = np.random.default_rng(3)
    return [look(WORLD, (0, 0, STEP * k), rotations.exp(rng.uniform(-0.05, 0.05, 3)), HEIGHT)
            for k in range(COUNT)]


def window(k: int, unit: float = 1.0, first: int = 0) -> AlignedWindow:
    references = []
    for n in (k - b for b in (1, 4, 10) if k - b >= first):
        true = true_pose(views()[n], views()[k])
        references.append(Reference(Frame(key(n), views()[n].image), RelativePose(
            true.rotation, true.position / unit, 1e-10 * np.eye(6))))
    return AlignedWindow(Frame(key(k), views()[k].image), tuple(references))


def image(k: int, unit: float = 1.0, **changes) -> RangeImage:
    r = (views()[k].range / unit).astype(np.float32)
    return RangeImage(**{'key': key(k), 'range': r, 'sigma': np.float32(0.005) * r,
                         'is_metric': True, **changes})


def mapped(config, frames=range(1, COUNT), first: int = 0, unit=lambda k: 1.0, **more) -> Submap:
    start = views()[first]
    mapper = Mapper(config, first=RelativePose(start.rotation, start.position))
    for k in frames:
        placed = mapper.add(window(k, unit(k), first), image(k, unit(k)), **more)
        assert not isinstance(placed, Drop), placed
    return mapper.finish()


def off_walls(xyz: np.ndarray) -> np.ndarray:
    """Distance of points to the room's surfaces along the ray from the middle of the way."""
    origin = np.array([0, 0, STEP * COUNT / 2])
    way = xyz.astype(float) - origin
    length = np.linalg.norm(way, axis=1)
    return np.abs(WORLD.range(origin, way / length[:, None]) - length)


def test_points_of_all_frames_lie_on_the_surfaces():
    submap = mapped(resolve(METRES))
    assert len(submap.frames) == COUNT
    for frame, view in zip(submap.frames, views(), strict=True):
        np.testing.assert_allclose(frame.position, view.position, atol=1e-6)
    assert len(submap.points) > 5000
    # A voxel's mean is on a wall; posts hide and curve.
    assert np.percentile(off_walls(submap.points.xyz), 90) < 0.01


def test_what_moves_and_what_is_unsure_is_left_out():
    config = resolve(METRES)
    everything = np.full((HEIGHT // 2, HEIGHT), 255, np.uint8)
    blurred = np.float32(0.26) * image(1).range
    for changed in ({'moving': everything}, {'sigma': blurred},
                    {'range': np.full_like(blurred, np.inf)},
                    {'range': np.full_like(blurred, np.nan)}):
        mapper = Mapper(config)
        mapper.add(window(1), image(1, **changed))
        assert len(mapper.finish().points) == 0
    near = mapped(resolve({**METRES, 'mapping.max_range': 4.0}))
    way = np.array([v.position for v in views()])
    away = np.linalg.norm(near.points.xyz[:, None] - way, axis=2).min(axis=1)
    assert away.max() < 4.5


def test_colour_comes_from_the_frame():
    mapper = Mapper(resolve(METRES))
    colour = np.zeros((HEIGHT, 2 * HEIGHT, 3), np.uint8)
    colour[..., 2] = 200
    mapper.add(window(1), image(1), Frame(key(1), views()[1].image, colour))
    assert set(map(tuple, mapper.finish().points.bgr)) == {(0, 0, 200)}


def test_with_a_lag_the_map_is_nearly_the_same():
    start = views()[0]
    live = Mapper(resolve(METRES), lag=3, first=RelativePose(start.rotation, start.position))
    for k in range(1, COUNT):
        live.add(window(k), image(k))
        assert live.fused == max(0, k - 3)
    whole = mapped(resolve(METRES))
    assert len(live.finish().points) == pytest.approx(len(whole.points), rel=0.01)


def test_a_map_that_goes_on_keeps_no_more():
    """Forth and back for long: all of the mapper's state stays as large. (Voxels are bounded by
    themselves.)
    """
    live = Mapper(resolve({**METRES, 'mapping.max_points': 5000}), lag=3)
    live.track = Track(first_pose(resolve({})), keep=12)
    order = [COUNT - 1 - abs(COUNT - 1 - k % (2 * COUNT - 2)) for k in range(101)]
    sizes = []
    for k in range(1, len(order)):
        references = tuple(Reference(Frame(key(n), views()[0].image), true_pose(
            views()[order[n]], views()[order[k]])) for n in (k - 1, k - 4) if n >= 0)
        measured = RangeImage(key(k), image(order[k]).range, image(order[k]).sigma, True)
        placed = live.add(AlignedWindow(Frame(key(k), views()[0].image), references), measured)
        assert not isinstance(placed, Drop)
        sizes.append(len(pickle.dumps({name: value for name, value in vars(live).items()
                                       if name not in ('voxels', '_waiting')})))
        assert len(live._waiting) <= 3
    assert live.fused == len(sizes) - 3
    assert max(sizes[70:]) < 1.01 * max(sizes[40:70])


def test_without_any_scale_there_is_no_map():
    assert Mapper(resolve({})).add(window(1), image(1, is_metric=False)).cause == 'no_scale'


def test_range_images_of_different_units_become_one_map():
    """As with an assumed speed while the true one varies."""
    config = resolve({'baseline.source': 'speed', 'baseline.speed': 3.0,
                      'mapping.min_frames': 2})
    submap = mapped(config, unit=lambda k: 1 + 0.3 * np.sin(k))
    builder = MapBuilder(config)
    builder.add(submap)
    frames, points = builder.finish()
    length = np.linalg.norm(frames[-1].position - frames[0].position)
    assumed = sum(STEP / (1 + 0.3 * np.sin(k)) for k in range(1, COUNT))
    assert length == pytest.approx(assumed, rel=0.002)
    true_size = points.moved(np.eye(3), np.zeros(3), STEP * (COUNT - 1) / assumed).xyz
    start = views()[0].position
    scaled = start + (points.xyz - start) * STEP * (COUNT - 1) / length
    assert true_size.shape == scaled.shape
    assert np.percentile(off_walls(scaled), 90) < 0.03


def test_the_camera_height_gives_metres():
    """The floor is 1.6 m below; ranges and ways come in a unit of 0.37 m."""
    config = resolve({'mapping.camera_height': 1.6, 'mapping.min_frames': 2})
    submap = mapped(config, unit=lambda k: 0.37)
    for frame, view in zip(submap.frames, views(), strict=True):
        np.testing.assert_allclose(frame.position, view.position, atol=0.02)
    assert np.percentile(off_walls(submap.points.xyz), 90) < 0.03


def test_ground_scale_is_exact_and_says_where_there_is_none():
    config = resolve({}).camera
    flat = image(3, 0.5)
    assert ground_scale(flat, config, 1.6) == pytest.approx(0.5, rel=0.01)
    assert ground_scale(flat, config, 3.2) == pytest.approx(1.0, rel=0.01)
    nothing = image(3, range=np.full((HEIGHT, 2 * HEIGHT), np.nan, np.float32))
    assert ground_scale(nothing, config, 1.6) is None


@pytest.mark.parametrize('dip', [60, 40, 30])
def test_ground_that_is_not_seen_right_below_gives_the_scale_too(dip):
    """The vehicle hides it, or two stills of paving tell nothing there."""
    hidden = image(3, 0.5).range.copy()
    hidden[round((0.5 + dip / 180) * HEIGHT):] = np.nan
    assert ground_scale(image(3, range=hidden), resolve({}).camera, 1.6) == pytest.approx(
        0.5, rel=0.02)


def test_only_what_is_seen_often_and_sharply_is_kept():
    submap = mapped(resolve(METRES))
    config = resolve({'mapping.min_frames': 4, 'mapping.max_sigma': 0.02}).mapping
    kept = confirmed(submap.points, config)
    assert 0 < len(kept) < len(submap.points)
    assert kept.frames.min() >= 4
    assert kept.sigma.max() <= 0.02 < submap.points.sigma.max()


# Submaps

def moved(submap: Submap, pose: RelativePose, scale: float = 1.0) -> Submap:
    frames = [TrackedFrame(f.key, pose.rotation @ f.rotation,
                           scale * pose.rotation @ f.position + pose.position, scale * f.scale)
              for f in submap.frames]
    return Submap(frames, submap.points.moved(pose.rotation, pose.position, scale),
                  submap.assumed, scale * submap.tracked)


ELSEWHERE = RelativePose(rotations.exp([0.3, -1.0, 0.5]), np.array([4.0, -2.0, 7.0]))


@pytest.mark.parametrize('source', ['odometry', 'speed'])
def test_submaps_that_share_frames_are_joined_exactly(source):
    speed = {'baseline.speed': 3.0} if source == 'speed' else {}
    config = resolve({**METRES, 'baseline.source': source, **speed})
    one = mapped(config, range(1, 10))
    other = mapped(config, range(7, COUNT), first=6)
    scale = 1.7 if source == 'speed' else 1.0
    builder = MapBuilder(config)
    assert builder.add(one) is None
    assert builder.add(moved(other, ELSEWHERE, scale)) is None
    frames, points = builder.finish()
    assert [f.key for f in frames] == [key(k) for k in range(COUNT)]
    for frame, view in zip(frames, views(), strict=True):
        np.testing.assert_allclose(frame.position, view.position, atol=1e-3)
    assert np.percentile(off_walls(points.xyz), 90) < 0.015


def test_over_a_gap_clouds_are_registered():
    config = resolve(METRES)
    one, other = mapped(config, range(1, 8)), mapped(config, range(10, COUNT), first=9)
    nudged = moved(other, RelativePose(rotations.exp([0.01, 0.02, -0.01]),
                                       np.array([0.08, -0.05, 0.06])))
    odometry = [RelativePose(views()[k].rotation, views()[k].position) for k in (
        0, 7, 9, COUNT - 1)]
    odometry[2:] = [RelativePose(pose.rotation, pose.position + np.array([0.1, 0, -0.1]))
                    for pose in odometry[2:]]
    builder = MapBuilder(config)
    assert builder.add(one, (odometry[0], odometry[1])) is None
    assert builder.add(nudged, (odometry[2], odometry[3])) is None
    frames, _ = builder.finish()
    np.testing.assert_allclose(frames[-1].position, views()[-1].position, atol=0.03)


def test_without_the_library_only_odometry_leads_over_a_gap(monkeypatch):
    monkeypatch.setitem(sys.modules, 'small_gicp', None)
    config = resolve(METRES)
    one, other = mapped(config, range(1, 8)), mapped(config, range(10, COUNT), first=9)
    builder = MapBuilder(config)
    builder.add(one)
    refused = builder.add(other)
    assert refused.cause == 'not_joined'
    assert 'small_gicp' in refused.detail
    assert len(builder.finish()[0]) == 8
    poses = [RelativePose(views()[k].rotation, views()[k].position)
             for k in (0, 7, 9, COUNT - 1)]
    builder = MapBuilder(config)
    builder.add(one, (poses[0], poses[1]))
    assert builder.add(moved(other, ELSEWHERE), (poses[2], poses[3])) is None
    np.testing.assert_allclose(builder.finish()[0][-1].position, views()[-1].position, atol=1e-3)


def test_clouds_that_do_not_fit_are_refused():
    pytest.importorskip('small_gicp')
    xyz = mapped(resolve(METRES)).points.xyz
    assert not isinstance(registered(xyz, xyz, RelativePose()), Drop)
    assert registered(xyz, xyz + np.float32([0, 40, 0]),
                      RelativePose()).cause == 'not_registered'
    assert registered(xyz, xyz[:100], RelativePose()).cause == 'not_registered'


def test_odometry_places_the_first_camera():
    config = resolve({'camera.mount.x': 1.0})
    turned = rotations.exp([0, 0, np.pi / 2])
    pose = first_pose(config, OdometrySample(0, np.array([10.0, 20.0, 30.0]), turned))
    np.testing.assert_allclose(pose.position, [10.0, 21.0, 30.0], atol=1e-12)
    # What is ahead of the camera is to the left of the world, that is along y.
    np.testing.assert_allclose(pose.rotation @ [0, 0, 1], [0, 1, 0], atol=1e-12)
