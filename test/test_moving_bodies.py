"""What belongs to something that moves, though it does not show it, is not told as far."""
from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sphstereo_ros.core import rotations
from sphstereo_ros.core.camera import Equirectangular
from sphstereo_ros.core.moving_bodies import unmarked_parts

HEIGHT, CAMERA, AWAY, HOUSE = 192, 1.6, 3.0, 12.0  # rows; m
TURNS = (np.eye(3), rotations.matrix_from_rpy(0.3, -0.2, 0.1))


class Street:
    """A floor, a body `AWAY` m to the side over the azimuths `beside` (rad), a house behind.

    turn : (3, 3) optical frame ← x right, y down, z ahead over the floor
    camera : its height over the floor, m
    """

    def __init__(self, turn: np.ndarray = TURNS[0], azimuth: float = 0.0,
                 camera: float = CAMERA) -> None:
        level = Equirectangular(HEIGHT, 2 * HEIGHT).bearings() @ turn
        self.plane = turn @ [0, 1 / camera, 0]
        self.beside = (np.arctan2(level[..., 0], level[..., 2]) - azimuth + np.pi
                       ) % (2 * np.pi) - np.pi
        along = np.hypot(level[..., 0], level[..., 2])
        down = level[..., 1]
        self.tall = camera - AWAY * down / along  # m over the floor, that far away
        self.at_body = along / AWAY
        self.rho = np.maximum(along / HOUSE, down / camera).astype(np.float32)

    def part(self, low: float, high: float, left: float = -0.5,
             right: float = 0.5) -> np.ndarray:
        """Pixels of heights `low` to `high` m, `left` to `right` rad beside the body's middle."""
        return ((self.tall > low) & (self.tall < high)
                & (self.beside > left) & (self.beside < right))

    def taken(self, marked: np.ndarray, relative: float = 0.05,
              rho: np.ndarray | None = None) -> np.ndarray:
        rho = self.rho if rho is None else rho
        return unmarked_parts(np.uint8(255) * marked, rho, np.float32(relative) * rho, self.plane)


@pytest.mark.parametrize('turn', TURNS)
@pytest.mark.parametrize('azimuth', [0.0, 1.2, np.pi - 0.1, -2.0])
def test_the_roof_of_what_is_marked_is_unknown(turn, azimuth):
    street = Street(turn, azimuth)
    taken = street.taken(street.part(0, 1.1))
    assert taken[street.part(1.1, 1.5, -0.45, 0.45)].all()
    assert not taken[street.part(1.75, 9)].any()
    assert not taken[np.abs(street.beside) > 0.6].any()


@pytest.mark.parametrize('azimuth', [0.0, 1.2, np.pi - 0.1])
@pytest.mark.parametrize('panes', [(0.6, 1.1), (0.95, 1.1)])
def test_doors_without_a_mark_belong_to_it(azimuth, panes):
    street = Street(azimuth=azimuth)
    taken = street.taken(street.part(0, 1.1, -0.5, -0.12) | street.part(0, 1.1, 0.12, 0.5)
                         | street.part(*panes))
    assert taken[street.part(0.9, 1.5, -0.45, 0.45)].all()


@pytest.mark.parametrize('camera', [0.05, 0.5, 1.6, 30.0])
def test_what_carries_the_camera_hides_nothing_around(camera):
    """A deck, a tripod, a roof: it keeps pace, too, where no vehicle mask was given."""
    street = Street(camera=camera)
    deck = street.tall < camera - AWAY * np.tan(np.radians(62))
    assert 0.1 < deck.mean() < 0.2
    assert not street.taken(deck).any()


def test_over_a_low_camera_a_body_may_be_as_tall_as_a_car():
    street = Street(camera=0.5)
    taken = street.taken(street.part(0, 0.35))
    assert taken[street.part(0.35, 1.5, -0.45, 0.45)].all()
    assert not taken[street.part(2.1, 9)].any()


def test_two_bodies_leave_a_view_between_them():
    street = Street()
    taken = street.taken(street.part(0, 1.1, -0.9, -0.4) | street.part(0, 1.1, 0.4, 0.9))
    assert not taken[street.part(0, 9, -0.3, 0.3)].any()


def test_what_is_measured_sharply_over_the_rim_is_kept():
    street = Street()
    taken = street.taken(street.part(0, 1.1), relative=0.01)
    assert taken[street.part(0, 1.2, -0.45, 0.45) & (street.rho < street.at_body / 1.4)].all()
    assert not taken[street.part(1.45, 9)].any()


def test_what_is_no_farther_than_it_is_kept():
    street = Street()
    near = np.maximum(street.rho, (0.9 * street.at_body).astype(np.float32))
    assert not street.taken(street.part(0, 1.1), rho=near).any()


def test_infinitely_far_is_behind_it():
    street = Street()
    sky = np.where(street.tall > 0.5, np.float32(0), street.rho)
    assert street.taken(street.part(0, 1.1), rho=sky)[street.part(1.1, 1.5, -0.45, 0.45)].all()


@pytest.mark.parametrize('marked', [(0.0, 0.3), (2.5, 4.0)])
def test_a_shadow_and_what_stands_on_no_floor_are_no_bodies(marked):
    street = Street()
    assert not street.taken(street.part(*marked)).any()


def test_nothing_marked_nothing_taken():
    street = Street()
    assert not street.taken(street.part(5, 4)).any()


@settings(max_examples=25, deadline=None)
@given(st.floats(-0.3, 0.3), st.floats(-0.3, 0.3), st.floats(-3.1, 3.1), st.floats(0.7, 1.4),
       st.floats(0.15, 0.6))
def test_only_what_is_farther_and_no_taller_than_a_body_is_taken(roll, pitch, azimuth, tall,
                                                                 half):
    street = Street(rotations.matrix_from_rpy(pitch, azimuth, roll), azimuth)
    taken = street.taken(street.part(0, tall, -half, half))
    assert taken[street.part(tall, tall + 0.3, 0.06 - half, half - 0.06)].all()
    assert not (taken & (street.rho > street.at_body / 1.2)).any()
    assert not (taken & (street.tall > 2.2)).any()
