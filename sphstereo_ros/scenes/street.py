"""The scene `street`: a road between houses, with trees, poles, wires and parked cars."""
from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np

from . import shapes, surfaces
from .builder import Builder
from .scene import Light, Scene

FROM, TO = -75.0, 135.0  # extent along the street, m
KERB = 4.5               # half the road's width
PAVEMENT = 10.5          # outer edge of the pavements
_HEIGHT = 0.12           # of the pavements


def daylight(rng: np.random.Generator) -> Light:
    """A sun 30–55° high at a random side, some clouds."""
    height = np.radians(rng.uniform(30, 55))
    turn = rng.uniform(0, 2 * np.pi)
    sun = (float(np.cos(height) * np.cos(turn)), float(np.cos(height) * np.sin(turn)),
           float(np.sin(height)))
    return Light(sun=sun, clouds=float(rng.uniform(0.3, 0.7)), seed=int(rng.integers(1 << 30)))


def street(seed: int) -> Scene:
    """A straight street along x; the camera's way is near y = 0, x from 0 to 30 m."""
    rng = np.random.default_rng([seed, 1])
    build = Builder(rng)
    ground(build)
    for side in (1, -1):
        houses(build, side)
        furniture(build, side)
        _parked(build, side)
    wires(build)
    end(build)
    hills(build)
    return Scene(build.parts(), daylight(rng))


def end(build: Builder) -> None:
    """The building across the far end of the street."""
    build.add('end', shapes.box((TO + 6, -30, 0), (TO + 16, 30, 14)),
              surfaces.plain_plaster(build.rng))


def hills(build: Builder) -> None:
    """Wooded hills on the horizon."""
    rng = build.rng
    wood = surfaces.seeded(surfaces.FOREST, rng)
    for turn in np.arange(0, 2 * np.pi, 0.45) + rng.uniform(0, 0.4):
        hill = shapes.rounded(rng.uniform(120, 240), rng.uniform(120, 240),
                              rng.uniform(16, 44), 1.0)
        build.add('hill', shapes.moved(hill, 330 * np.cos(turn), 330 * np.sin(turn), -1), wood,
                  True)


def ground(build: Builder) -> None:
    """Road, pavements and the grass about them."""
    rng = build.rng
    grass = surfaces.seeded(surfaces.GRASS, rng)
    build.add('grass', shapes.sheet(-400, 400, -400, 400, -0.06), grass)
    rough, smooth = (surfaces.seeded(m, rng) for m in (surfaces.ASPHALT,
                                                       surfaces.SMOOTH_ASPHALT))
    # New, smooth asphalt in long patches; old, grainy one between.
    edges = np.sort(rng.uniform(FROM, TO, 5))
    for k, (a, b) in enumerate(zip([FROM - 60, *edges], [*edges, TO + 60], strict=True)):
        build.add('road', shapes.sheet(a, b, -KERB, 0.4, 0.0), (smooth, rough)[k % 2])
    edges = np.sort(rng.uniform(FROM, TO, 4))
    for k, (a, b) in enumerate(zip([FROM - 60, *edges], [*edges, TO + 60], strict=True)):
        build.add('road', shapes.sheet(a, b, 0.4, KERB, 0.0), (rough, smooth)[k % 2])
    paint = surfaces.seeded(surfaces.PAINT, rng)
    for x in np.arange(FROM, TO, 6.0):
        build.add('marking', shapes.sheet(x, x + 3.0, -0.06, 0.06, 0.004), paint)
    crossing = float(rng.uniform(10, 22))
    for y in np.arange(-3.5, 3.3, 1.0):
        build.add('marking', shapes.sheet(crossing, crossing + 3.0, y, y + 0.5, 0.005), paint)
    cover = surfaces.seeded(surfaces.DARK_METAL, rng)
    for x in np.arange(FROM, TO, 23.0) + rng.uniform(0, 20):
        disc = shapes.pole(x, float(rng.uniform(-2, 2)), 0.6, 0.004)
        build.add('manhole', disc, replace(cover, grain=0.5, grain_size=0.05))
    patch = surfaces.seeded(surfaces.PATCH, rng)
    for x in rng.uniform(FROM, TO, 16):
        y, length, width = rng.uniform(-3.8, 2.4), rng.uniform(0.8, 5), rng.uniform(0.5, 1.4)
        build.add('patch', shapes.sheet(x, x + length, y, y + width, 0.002), patch)
    for side in (1, -1):
        slabs = surfaces.seeded((surfaces.SLABS, surfaces.COBBLES, surfaces.SMOOTH_ASPHALT)[
            rng.integers(3)], rng)
        inner, outer = sorted((side * (KERB + 0.15), side * (PAVEMENT + 12)))
        build.add('pavement', shapes.box((FROM - 60, inner, -0.2), (TO + 60, outer, _HEIGHT)),
                  slabs)
        inner, outer = sorted((side * KERB, side * (KERB + 0.15)))
        build.add('kerb', shapes.box((FROM - 60, inner, -0.2), (TO + 60, outer, _HEIGHT)),
                  replace(surfaces.CONCRETE, block=(1.0, 9.0), joint=0.012, grain=0.1))


def houses(build: Builder, side: int) -> None:
    """A row of houses and gardens on one side: 1 is left, −1 right."""
    rng = build.rng
    x = FROM + float(rng.uniform(0, 6))
    while x < TO - 8:
        width = float(rng.uniform(9, 17))
        front = PAVEMENT + float(rng.choice([0.0, 0.0, 0.6, 1.5]))
        if rng.random() < 0.2:
            _garden(build, x, width * 0.7, side)
            x += width * 0.7
            continue
        size = (width, float(rng.uniform(8, 11)), float(rng.choice([4.6, 7.4, 10.2, 13.0])))
        shop = bool(rng.random() < 0.35)
        if side > 0:
            build.house(x, front, 0.0, size, shop)
        else:
            build.house(x + width, -front, np.pi, size, shop)
        x += width + float(rng.choice([0.0, 0.0, 0.0, 2.5]))


def _garden(build: Builder, x: float, width: float, side: int) -> None:
    """A plain garden wall with a tree behind it."""
    rng = build.rng
    near, far = sorted((side * PAVEMENT, side * (PAVEMENT + 0.25)))
    build.add('garden wall', shapes.box((x, near, 0), (x + width, far, 2.0)),
              surfaces.plain_plaster(rng))
    build.tree(x + width / 2, side * (PAVEMENT + 4), float(rng.uniform(6, 9)), 2.6, 0.16, 5000,
               surfaces.foliage(rng))


def furniture(build: Builder, side: int) -> None:
    """Trees, lamps, signs, bollards and bins along the kerb of one side."""
    rng = build.rng
    y = side * (KERB + 0.6)
    small, large = surfaces.foliage(rng), surfaces.foliage(rng)
    start = FROM + float(rng.uniform(0, 12))
    for k, x in enumerate(np.arange(start, TO, 16.0) + rng.uniform(-1.5, 1.5)):
        if rng.random() < 0.25:
            continue
        leaf, count, kind = ((0.085, 13000, small), (0.15, 5500, large))[k % 2]
        if abs(x - 15) > 45:
            leaf, count = 1.8 * leaf, count // 3
        build.tree(float(x), y + side * 0.3, float(rng.uniform(5.5, 8.5)),
                   float(rng.uniform(1.6, 2.4)), leaf, count, kind)
    for x in np.arange(start + 5, TO, 24.0):
        build.street_lamp(float(x), y, float(rng.choice([0.1, 0.15])), 7.0)
    for x in np.arange(start + 2.5, TO, 13.0) + rng.uniform(-1, 1):
        build.sign(float(x), y - side * 0.1, float(rng.choice([0.05, 0.06, 0.076])))
    for x in np.arange(start + 1, TO, 1.6):
        if int((x - start) / 14) % 3 == 1:
            build.add('bollard', shapes.pole(float(x), y - side * 0.25, 0.08, 0.9, _HEIGHT),
                      surfaces.DARK_METAL, True)
    for x in rng.uniform(FROM, TO, 14):
        low = (float(x), side * (PAVEMENT - 0.5) - 0.3, _HEIGHT)
        build.add('bin', shapes.box(low, np.add(low, (0.6, 0.6, 1.0))), surfaces.RUBBER)


def _parked(build: Builder, side: int) -> None:
    rng = build.rng
    x = FROM + float(rng.uniform(0, 5))
    while x < TO:
        if rng.random() < 0.55:
            build.car(x, side * float(rng.uniform(2.95, 3.1)), float(
                rng.normal(0, 0.02)) + np.pi * (side > 0))
        x += float(rng.uniform(5.3, 7.5))


def wires(build: Builder) -> None:
    """Masts with wires along the street, and wires across it."""
    rng = build.rng
    for y in (-6.6, 6.6):
        if rng.random() < 0.4:
            continue
        xs = np.arange(FROM + float(rng.uniform(0, 10)), TO, 28.0)
        for x in xs:
            build.add('mast', shapes.pole(float(x), y, 0.24, 8.4), surfaces.BARK, True)
        for height, offset in ((8.2, -0.3), (8.2, 0.3), (7.6, 0.0)):
            for a, b in pairwise(xs):
                build.add('wire', shapes.wire((a, y + offset, height), (b, y + offset, height),
                                              0.5, 0.018), surfaces.WIRE)
    for x in rng.uniform(FROM, TO, 5):
        build.add('wire', shapes.wire((x, -PAVEMENT, 6.6), (x + 2, PAVEMENT, 6.2), 0.35, 0.02),
                  surfaces.WIRE)
