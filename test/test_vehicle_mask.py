"""The vehicle's mask from a recording: vehicles pasted onto rendered streets, and refusals."""
from __future__ import annotations

import cv2
import numpy as np
import pytest
import room
from hypothesis import given
from hypothesis import strategies as st

from sphstereo_ros import cli
from sphstereo_ros.cli.mask import taken
from sphstereo_ros.core import rotations
from sphstereo_ros.core.camera import Equirectangular
from sphstereo_ros.core.config import PoseConfig
from sphstereo_ros.core.frames import Drop
from sphstereo_ros.core.vehicle_mask import VehicleMaskFinder
from sphstereo_ros.scenes.sequence import TUNING_SEEDS, render_sequence

HEIGHT = 320
SHAPES = ('hood', 'legs', 'rider')


def angles(height: int) -> tuple[np.ndarray, np.ndarray]:
    """Longitude and latitude of every pixel, degrees."""
    x, y, z = np.moveaxis(Equirectangular(height, 2 * height).bearings(), -1, 0)
    return np.degrees(np.arctan2(x, z)), np.degrees(np.arcsin(-y))


def vehicle(shape: str, height: int = HEIGHT) -> np.ndarray:
    """Where the vehicle is, (H, 2H) bool: a hood all round, a tripod's legs, a rider behind."""
    lon, lat = angles(height)
    if shape == 'hood':
        return lat < -42 + 6 * np.cos(np.radians(2 * lon))
    if shape == 'rider':
        behind = np.abs(lon) - 180
        return (behind / 22)**2 + ((lat + 35) / 38)**2 < 1
    off = [np.abs((lon - at + 180) % 360 - 180) for at in (-150, -30, 90)]
    return (lat < 10) & (np.min(off, axis=0) < 6)


def paint(shape: str, textured: bool, height: int = HEIGHT) -> np.ndarray:
    """The vehicle's own grey levels, (H, 2H)."""
    if not textured:  # plain, but for the light
        return 215 + 8 * np.sin(np.radians(angles(height)[0]))
    noise = np.random.default_rng(7).uniform(30, 200, (height // 10, height // 5))
    return cv2.resize(noise, (2 * height, height), interpolation=cv2.INTER_CUBIC)


def found_on(frames: list[np.ndarray], shape: str = '', textured: bool = False, gains=None):
    """What the finder says of frames with a vehicle pasted onto them, as bright as `gains`."""
    finder, rng = VehicleMaskFinder(PoseConfig()), np.random.default_rng(3)
    height = len(frames[0])
    for frame, gain in zip(frames, gains or [1.0] * len(frames), strict=True):
        picture = frame.astype(float)
        if shape:
            cover = cv2.GaussianBlur(vehicle(shape, height).astype(float), (0, 0), 0.6)
            own = gain * paint(shape, textured, height) + rng.normal(0, 1.5, frame.shape)
            picture = picture * (1 - cover) + own * cover
        finder.add(picture.clip(0, 255).astype(np.uint8))
    return finder.result()


def overlap(mask: np.ndarray, truth: np.ndarray) -> float:
    weight = np.cos(np.radians(angles(len(mask))[1]))
    return float(weight[(mask != 0) & truth].sum() / weight[(mask != 0) | truth].sum())


@pytest.fixture(scope='module')
def street() -> tuple[list[np.ndarray], list[float]]:
    """Frames, and how bright they are beside the first."""
    pytest.importorskip('embreex')
    frames = list(render_sequence('street', TUNING_SEEDS[0], 14, HEIGHT))
    return ([cv2.cvtColor(frame.image, cv2.COLOR_BGR2GRAY) for frame in frames],
            [frame.exposure**0.45 for frame in frames])


@pytest.mark.parametrize('textured', [True, False], ids=['textured', 'plain'])
@pytest.mark.parametrize('shape', SHAPES)
def test_vehicles_are_found(street, shape: str, textured: bool) -> None:
    found = found_on(street[0], shape, textured, street[1])
    assert overlap(found.mask, vehicle(shape)) > 0.8
    weight = np.cos(np.radians(angles(HEIGHT)[1]))
    assert found.share == pytest.approx(weight[found.mask != 0].sum() / weight.sum())


def test_nothing_is_masked_where_nothing_stays(street) -> None:
    assert found_on(street[0]).share < 0.005


def test_a_camera_that_does_not_turn_tells_nothing() -> None:
    drive = [frame.image for frame in room.forward(12, 0.15, HEIGHT)]
    for shape in ('', 'hood'):
        found = found_on(drive, shape, True)
        assert isinstance(found, Drop)
        assert found.cause == 'too_little_turn'
    still = found_on([drive[0]] * 12)
    assert isinstance(still, Drop)
    assert still.cause == 'too_little_turn'


def turning(count: int, height: int = 240) -> list[np.ndarray]:
    """A camera that turns and moves in a room."""
    rng = np.random.default_rng(5)
    return [room.view(np.array([0, 0, 0.1 * i]), rotations.exp(rng.normal(0, 0.04, 3)), height)[0]
            for i in range(count)]


def test_few_frames_tell_nothing() -> None:
    found = found_on(turning(5))
    assert isinstance(found, Drop)
    assert found.cause == 'too_few_frames'


def test_exposure_does_not_matter() -> None:
    gains = ([1, 0.8, 0.7, 0.9] * 4)[:14]
    dimmed = [f * gain for f, gain in zip(turning(14), gains, strict=True)]
    assert overlap(found_on(dimmed, 'legs', True, gains).mask, vehicle('legs', 240)) > 0.8


def test_frames_of_another_size_are_left_out() -> None:
    finder = VehicleMaskFinder(PoseConfig())
    for frame in turning(10):
        finder.add(frame)
        finder.add(np.zeros((100, 200), np.uint8))
    assert finder.frames == 10


@given(st.integers(0, 100000), st.integers(1, 1000))
def test_frames_are_taken_in_stretches_from_all_over(total: int, most: int) -> None:
    chosen = [i for i, take in zip(range(total), taken(total, most), strict=False) if take]
    assert len(chosen) <= most
    if total <= most:
        assert chosen == list(range(total))
    elif most >= 60:
        assert len(chosen) > most / 2
        assert chosen[-1] > total / 3
        joined = np.diff(chosen) == 1
        assert joined.mean() > 0.8


# command

@pytest.fixture(scope='module')
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp('frames')
    truth, own = vehicle('rider', 240), paint('rider', True, 240)
    for i, frame in enumerate(turning(14)):
        picture = np.where(truth, own, frame).clip(0, 255).astype(np.uint8)
        # A full sphere stored with pixels that are not square.
        cv2.imwrite(str(folder / f'{i:02}.png'), cv2.resize(picture, (480, 270)))
    return folder


def test_command_writes_the_mask_and_a_preview(folder, tmp_path, capsys) -> None:
    out, preview = tmp_path / 'mask.png', tmp_path / 'preview.png'
    assert cli.main(['mask', str(folder), '--out', str(out), '--preview', str(preview)]) == 0
    mask = cv2.imread(str(out), cv2.IMREAD_UNCHANGED)
    assert mask.shape == (270, 480)
    assert set(np.unique(mask)) == {0, 255}
    square = cv2.resize(mask, (480, 240), interpolation=cv2.INTER_NEAREST)
    assert overlap(square, vehicle('rider', 240)) > 0.8
    told = float(capsys.readouterr().out.split()[1])
    weight = np.cos(np.radians(angles(240)[1]))
    assert told == pytest.approx(100 * weight[square != 0].sum() / weight.sum(), abs=0.5)
    red = cv2.imread(str(preview)).astype(int)
    coloured = np.abs(red[..., 2] - red[..., 1]) > 20
    assert (coloured == (cv2.resize(mask, red.shape[1::-1]) > 127)).mean() > 0.98


@pytest.mark.parametrize('words', [['--frames', '0'], ['--frames', '5'], ['--topic', '/none']])
def test_command_refuses_in_one_line(folder, tmp_path, words, capsys) -> None:
    out = tmp_path / 'mask.png'
    assert cli.main(['mask', str(folder), '--out', str(out), *words]) == 2
    error = capsys.readouterr().err.strip()
    assert error.startswith('sphstereo mask: ')
    assert '\n' not in error
    assert not out.exists()
