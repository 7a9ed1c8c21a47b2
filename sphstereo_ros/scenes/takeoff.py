"""The scene `takeoff`: a yard between houses, seen from a camera that rises."""
from __future__ import annotations

from dataclasses import replace

import numpy as np

from . import shapes, surfaces
from .builder import Builder
from .scene import Scene
from .street import daylight, hills

_NEW_ASPHALT = replace(surfaces.SMOOTH_ASPHALT, grain=0.03)
_SCREED = replace(surfaces.CONCRETE, grain=0.012, crack=0.004)


def takeoff(seed: int) -> Scene:
    """Houses about a yard; the camera starts near the origin, within 2 m, and has 8 m to rise."""
    rng = np.random.default_rng([seed, 1])
    build = Builder(rng)
    _ground(build)
    _houses(build)
    _garden(build)
    _yard(build)
    hills(build)
    return Scene(build.parts(), daylight(rng))


def _ground(build: Builder) -> None:
    rng = build.rng
    build.add('lawn', shapes.sheet(-400, 400, -400, 400, -0.06),
              surfaces.seeded(surfaces.GRASS, rng))
    paving = (surfaces.SLABS, surfaces.COBBLES)[rng.integers(2)]
    build.add('yard', shapes.box((-5, -4.5, -0.3), (6, 5, 0)), surfaces.seeded(paving, rng))
    build.add('drive', shapes.box((6, -2.2, -0.3), (30, 1.6, -0.01)),
              surfaces.seeded(_NEW_ASPHALT, rng))
    build.add('slab', shapes.box((-2.6, -2.6, -0.2), (2.6, 2.6, 0.02)),
              surfaces.seeded(_SCREED, rng))
    build.add('path', shapes.sheet(-24, -5, 0.5, 2.0, -0.03),
              surfaces.seeded(surfaces.EARTH, rng))
    build.add('street', shapes.sheet(30, 37, -200, 200, -0.02),
              surfaces.seeded(surfaces.ASPHALT, rng))


def _houses(build: Builder) -> None:
    """One close house on each of three sides, then two rows of others farther off."""
    rng = build.rng
    build.house(-6.5, 8.0, 0.0, (12.0, 9.0, 5.2))
    build.house(10.0, -8.5, np.pi, (11.0, 9.0, 4.4))
    build.house(-26.0, -7.0, np.pi / 2, (15.0, 9.0, 7.4))
    for x in np.arange(-60, 90, 17.0):
        for y, yaw in ((24.0, 0.0), (-26.0, np.pi)):
            width, height = float(rng.uniform(8, 13)), float(rng.choice([3.2, 4.6, 6.0, 7.4]))
            start = x + float(rng.uniform(0, 4)) + (width if yaw else 0.0)
            build.house(start, y + float(rng.uniform(-2, 2)), yaw, (width, 9.0, height))
    for y in np.arange(-45, 60, 15.0):
        build.house(42.0, y + 11, -np.pi / 2, (11.0, 9.0, float(rng.choice([4.6, 7.4, 10.2]))),
                    bool(rng.random() < 0.4))


def _garden(build: Builder) -> None:
    rng = build.rng
    small, large = surfaces.foliage(rng), surfaces.foliage(rng)
    for k in range(7):
        turn = 0.9 * k + float(rng.uniform(-0.2, 0.2))
        reach = float(rng.uniform(5.5, 9.0))
        leaf, count, kind = ((0.08, 12000, small), (0.15, 5500, large))[k % 2]
        x, y = reach * np.cos(turn), reach * np.sin(turn)
        if abs(y) < 6.8:
            build.tree(x, y, float(rng.uniform(4.0, 7.5)), float(rng.uniform(1.3, 2.1)), leaf,
                       count, kind)
    for _ in range(14):
        x, y = float(rng.uniform(-55, 40)), float(rng.choice([-19.0, 18.5])) + rng.normal(0, 1)
        build.tree(x, y, float(rng.uniform(5, 9)), 2.2, 0.22, 2500, large)
    for y in (-6.3, 6.6):
        hedge = shapes.bush(rng, 14.0, 0.6, 1.2, 0.07, 16000)
        build.add('hedge', shapes.moved(hedge, -20.5, y), small)
    posts = np.array([(x, 5.9, -0.1) for x in np.arange(7, 29, 0.14)])
    bars = [shapes.box(posts - (0.012, 0.012, 0), np.add(posts, (0.012, 0.012, 1.25)))]
    bars += [shapes.box((7, 5.88, z), (29, 5.92, z + 0.04)) for z in (0.2, 1.0)]
    build.add('fence', shapes.joined(bars), surfaces.DARK_METAL)


def _yard(build: Builder) -> None:
    rng = build.rng
    build.car(11.0, -0.4, float(rng.uniform(-0.1, 0.1)))
    build.car(17.5, 0.2, np.pi)
    build.street_lamp(5.2, 4.2, 0.1, 5.0)
    build.sign(6.4, 2.3, 0.06)
    for x, y in ((-4.6, -4.1), (-4.6, 4.6)):
        build.add('pole', shapes.pole(x, y, 0.05, 2.6), surfaces.METAL, True)
    build.add('line', shapes.wire((-4.6, -4.1, 2.5), (-4.6, 4.6, 2.5), 0.15, 0.012),
              surfaces.WIRE)
    for y in (-18.0, 14.0):
        build.add('mast', shapes.pole(27.0, y, 0.24, 8.5), surfaces.BARK, True)
    for offset in (-0.3, 0.3):
        build.add('wire', shapes.wire((27, -18, 8.3 + offset), (27, 14, 8.3 + offset), 0.5,
                                      0.018), surfaces.WIRE)
    x, y = float(rng.uniform(-3.6, -2.6)), float(rng.uniform(-2.5, 2.5))
    table = [shapes.box((x - 0.4, y - 0.7, 0.7), (x + 0.4, y + 0.7, 0.74))]
    table += [shapes.box((x + a - 0.03, y + b - 0.03, 0), (x + a + 0.03, y + b + 0.03, 0.7))
              for a in (-0.35, 0.35) for b in (-0.6, 0.6)]
    build.add('table', shapes.joined(table), surfaces.WOOD)
    shed = surfaces.seeded(surfaces.METAL, rng)
    build.add('shed', shapes.box((-9.5, -6.5, 0), (-6.5, -4.0, 2.2)), shed)
    for _ in range(5):
        low = rng.uniform((2.2, -4, 0), (5.5, 3.5, 0))
        build.add('crate', shapes.box(low, low + rng.uniform(0.3, 0.7, 3)),
                  surfaces.seeded(surfaces.WOOD, rng))
