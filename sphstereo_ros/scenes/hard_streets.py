"""Streets with a nuisance built in: `occlusion`, `repetition`, `traffic` and `wall`."""
from __future__ import annotations

from dataclasses import replace

import numpy as np

from . import shapes, surfaces
from .builder import Builder
from .material import Material
from .nuisances import WALL_AT, WALL_SIZE
from .scene import Scene
from .street import (
    FROM,
    KERB,
    PAVEMENT,
    TO,
    daylight,
    end,
    furniture,
    ground,
    hills,
    houses,
    wires,
)

_NEAR_FROM, _NEAR_TO = -25.0, 60.0  # where the camera passes, m


def _scene(build: Builder) -> Scene:
    hills(build)
    return Scene(build.parts(), daylight(build.rng))


def occlusion_street(seed: int) -> Scene:
    """Thin things close by before a far background.

    On the right, 3 to 4 m from the camera, a bar fence and poles before a field with houses 45 m
    away; on the left small trees and poles before the houses.
    """
    build = Builder(np.random.default_rng([seed, 1]))
    ground(build)
    houses(build, 1)
    wires(build)
    end(build)
    _bar_fence(build, -3.5, _NEAR_FROM, _NEAR_TO, 2.4)
    _far_side(build)
    rng = build.rng
    leaves = surfaces.foliage(rng)
    for x in np.arange(_NEAR_FROM, _NEAR_TO, 4.5):
        build.tree(float(x + rng.uniform(-1, 1)), float(rng.uniform(3.2, 4.2)),
                   float(rng.uniform(3.4, 4.4)), 1.1, 0.07, 1500, leaves)
    for side in (1, -1):
        for x in np.arange(_NEAR_FROM, _NEAR_TO, 1.6):
            build.add('pole', shapes.pole(float(x + rng.uniform(-0.7, 0.7)),
                                          side * float(rng.uniform(2.4, 3.8)),
                                          float(rng.uniform(0.02, 0.09)),
                                          float(rng.uniform(2.0, 4.0))),
                      (surfaces.METAL, surfaces.DARK_METAL, surfaces.BARK)[rng.integers(3)],
                      True)
    return _scene(build)


def _bar_fence(build: Builder, y: float, first: float, last: float, height: float) -> None:
    """Bars 16 mm thick every 0.12 m, posts every 2.4 m, two rails."""
    bars = np.stack(np.broadcast_arrays(np.arange(first, last, 0.12), y, 0.0), -1)
    posts = bars[::20]
    fence = [shapes.box(bars - (0.008, 0.008, 0), np.add(bars, (0.008, 0.008, height))),
             shapes.box(posts - (0.03, 0.03, 0), np.add(posts, (0.03, 0.03, height + 0.1)))]
    fence += [shapes.box((first, y - 0.015, z), (last, y + 0.015, z + 0.04))
              for z in (0.15, height - 0.15)]
    build.add('fence', shapes.joined(fence), surfaces.DARK_METAL)


def _far_side(build: Builder) -> None:
    """Houses 45 m to the right, and some trees before them."""
    rng = build.rng
    x = FROM
    while x < TO:
        width = float(rng.uniform(9, 16))
        build.house(x + width, -45.0 + float(rng.uniform(-3, 3)), np.pi,
                    (width, 9.0, float(rng.choice([4.6, 7.4, 10.2]))))
        x += width + float(rng.uniform(0, 9))
    leaves = surfaces.foliage(rng)
    for x in np.arange(FROM, TO, 17.0):
        build.tree(float(x), float(rng.uniform(-38, -20)), float(rng.uniform(5, 9)), 2.2, 0.25,
                   2000, leaves)


_PITCH = 2.4  # of pillars and windows, m
_STOREY = 2.9
_PLAIN = Material(colour=(0.4, 0.39, 0.36))
_BRICKS = Material(colour=(0.27, 0.12, 0.08), block=(0.24, 0.0725), joint=0.012,
                   joint_colour=(0.42, 0.40, 0.36))
_STRIPES = Material(colour=(0.5, 0.48, 0.42), block=(0.6, 0.29), block_offset=0.0, joint=0.05,
                    joint_colour=(0.2, 0.16, 0.12))


def repetition_street(seed: int) -> Scene:
    """Facades, pillars and fences that repeat exactly, without any grain or stain.

    Every 2.4 m of a side looks like the next: the facade is a brick or a panel wall with
    windows, behind a row of pillars; a fence of bars every 0.12 m runs along the pavement.
    """
    build = Builder(np.random.default_rng([seed, 1]))
    ground(build)
    for side in (1, -1):
        _repeating_side(build, side, _BRICKS if (side > 0) == (seed % 2 > 0) else _STRIPES)
    end(build)
    return _scene(build)


def _repeating_side(build: Builder, side: int, facade: Material) -> None:
    columns = int((TO - FROM) / _PITCH)
    length, height = columns * _PITCH, 3 * _STOREY + 0.6
    holes = [(c * _PITCH + 0.6, c * _PITCH + 1.8, s * _STOREY + 0.95, s * _STOREY + 2.45)
             for s in range(3) for c in range(columns)]
    front, panes = shapes.wall_with_holes(length, height, holes, 0.15)
    frames = shapes.window_frames(holes, 0.15, 0.06, 2, 2)
    low = np.array([(FROM + (c + 0.5) * _PITCH - 0.2, side * 8.0 - 0.2, 0.0)
                    for c in range(columns)])
    glass = replace(surfaces.GLASS, face_tilt=0.0)
    for name, shape, material in (('facade', front, facade), ('glass', panes, glass),
                                  ('frame', frames, _PLAIN)):
        placed = (shapes.moved(shape, FROM, PAVEMENT) if side > 0 else
                  shapes.moved(shape, FROM + length, -PAVEMENT, yaw=np.pi))
        build.add(name, placed, material)
    build.add('pillar', shapes.box(low, np.add(low, (0.4, 0.4, 3.6))), _PLAIN)
    _bar_fence(build, side * (KERB + 0.4), FROM, TO, 1.1)


def traffic_street(seed: int) -> Scene:
    """The street with nothing parked, so that there is room for what moves (`traffic`)."""
    build = Builder(np.random.default_rng([seed, 1]))
    ground(build)
    for side in (1, -1):
        houses(build, side)
        furniture(build, side)
    wires(build)
    end(build)
    return _scene(build)


_MURAL = Material(colour=(0.50, 0.42, 0.33), stain_colour=(0.16, 0.2, 0.24), stain=0.9,
                  stain_size=1.6, grain=0.35, grain_size=0.5, grain_gain=0.85)


def wall_street(seed: int) -> Scene:
    """A textured wall across an open road, its face at x = WALL_AT; trees and signs beside it."""
    build = Builder(np.random.default_rng([seed, 1]))
    ground(build)
    for side in (1, -1):
        furniture(build, side)
    width, height = WALL_SIZE
    build.add('wall', shapes.box((WALL_AT, -width / 2, 0), (WALL_AT + 0.3, width / 2, height)),
              surfaces.seeded(_MURAL, build.rng))
    return _scene(build)
