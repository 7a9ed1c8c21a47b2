from __future__ import annotations

import numpy as np
import pytest

from sphstereo_ros.core.islands import far_islands

HEIGHT = 240


def room(distance: float) -> np.ndarray:
    return np.full((HEIGHT, 2 * HEIGHT), distance, np.float32)


@pytest.mark.parametrize('beyond', [12.0, np.inf])
def test_a_mirror_in_something_near_is_unknown(beyond):
    r = room(3.0)
    r[100:112, 200:216] = beyond
    r[98:100, 190:230] = np.nan  # its frame
    found = far_islands(r)
    assert found[100:112, 200:216].all()
    found[100:112, 200:216] = False
    assert not found.any()


def test_what_is_little_farther_stays():
    r = room(3.0)
    r[100:112, 200:216] = 3.6
    assert not far_islands(r).any()


def large(reaches_down: bool) -> np.ndarray:
    """A far patch of 0.6 % of the image in a wall; a floor may lead there."""
    r = np.full((2 * HEIGHT, 4 * HEIGHT), 3, np.float32)
    r[200:252, 400:452] = 12
    if reaches_down:
        for k in range(48):  # from 12 m to the border in steps
            r[252 + k, 400:452] = 12 - 0.175 * k
    return r


def test_a_large_pane_that_is_framed_all_round_is_unknown():
    found = far_islands(large(reaches_down=False))
    assert found[200:252, 400:452].mean() > 0.95
    assert found.sum() < 60 * 60


def test_a_view_to_which_the_floor_leads_stays():
    assert not far_islands(large(reaches_down=True))[200:252, 400:452].any()


def test_a_wide_view_stays():
    r = room(3.0)
    r[60:140, 100:260] = 20
    assert not far_islands(r).any()


def test_a_far_patch_among_far_things_stays():
    r = room(15.0)
    r[100:112, 200:216] = 80
    assert not far_islands(r).any()


def test_a_near_patch_among_far_things_stays():
    r = room(40.0)
    r[100:112, 200:216] = 2.5
    assert not far_islands(r).any()


def test_an_island_amid_what_is_unknown_stays():
    r = room(np.nan)
    r[:40] = 3
    r[100:112, 200:216] = 20
    assert not far_islands(r).any()


@pytest.mark.parametrize('reaches_down', [False, True])
@pytest.mark.parametrize('by', [520, 536, 700])
def test_the_seam_may_be_anywhere(by, reaches_down):
    """In the patch, too."""
    r = large(reaches_down)
    np.testing.assert_array_equal(far_islands(np.roll(r, by, axis=1)),
                                  np.roll(far_islands(r), by, axis=1))
