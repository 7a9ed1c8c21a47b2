"""Light that changes between frames, over the picture: the range does not."""
from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from analytic_world import View, World, look, true_pose

from sphstereo_ros.core.config import resolve
from sphstereo_ros.core.frames import AlignedWindow, Frame, FrameKey, RangeImage, Reference
from sphstereo_ros.core.photometric import in_one_light
from sphstereo_ros.core.stereo import SphericalStereo

HEIGHT = 280
V, U = np.mgrid[0:HEIGHT, 0:2 * HEIGHT]


@cache
def views() -> tuple[View, ...]:
    """The last is current."""
    return tuple(look(World(), (0, 0, z), height=HEIGHT) for z in (-1.12, -0.28, 0.0))


def lit(view: View, gain: np.ndarray | float) -> np.ndarray:
    return np.clip(0.7 * view.image * gain, 0, 255).astype(np.uint8)


def banded(phase: float) -> np.ndarray:
    """A rolling shutter under lamps that flicker by a third."""
    return 1 + 0.3 * np.sin(2 * np.pi * (2.5 * V / HEIGHT + phase))


LIGHTS = {'bands': banded, 'two lenses': lambda phase: np.where(U < HEIGHT, 1 + 0.3 * phase, 1.0),
          'half the exposure': lambda phase: 0.5 + 0.7 * phase}


def score(light: object) -> tuple[float, float]:
    """Share that is known, and of it the share with an error over 5 %."""
    stereo = SphericalStereo(resolve({'stereo.matcher': 'joint'}))
    frames = [Frame(FrameKey(i, ''), lit(view, light(0.33 * i) if callable(light) else 1.0))
              for i, view in enumerate(views())]
    found = stereo.process(AlignedWindow(frames[2], tuple(
        Reference(frames[i], true_pose(views()[i], views()[2])) for i in (1, 0))))
    assert isinstance(found, RangeImage)
    known = np.isfinite(found.range)
    wrong = np.abs(found.range / views()[2].range - 1)[known] > 0.05
    return float(known.mean()), float(wrong.mean())


@pytest.mark.parametrize('name', LIGHTS)
def test_range_stands_as_in_steady_light(name):
    coverage, wrong = score(LIGHTS[name])
    steady_coverage, steady_wrong = score(None)
    assert steady_coverage > 0.8
    assert coverage > steady_coverage - 0.2
    assert wrong < steady_wrong + 0.05


def test_where_light_is_steady_nothing_is_changed():
    view = views()[2].image
    brighter = np.clip(view.astype(int) + 2, 0, 255).astype(np.uint8)
    assert in_one_light(view, view)[0] is in_one_light(view, view)[1] is view
    assert in_one_light(brighter, view)[0] is brighter


def test_one_exposure_changes_one_image():
    model = lit(views()[2], 1.0)
    made, kept = in_one_light(lit(views()[2], 0.5), model)
    assert kept is model
    assert np.abs(made.astype(float) - model).mean() < 2


def test_what_is_blank_stays_blank():
    """No shade of the other image may be printed on it: it would be matched with itself."""
    blank = lit(views()[1], banded(0.33))
    blank[:, :HEIGHT] = 128
    made, model = in_one_light(blank, lit(views()[2], 1.0))
    assert (model != lit(views()[2], 1.0)).any()
    inner = made[:, 60:HEIGHT - 60].astype(int)
    assert np.ptp(inner) <= 2
