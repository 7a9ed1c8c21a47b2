"""The scene `corridor`: indoors, between painted walls under lamps."""
from __future__ import annotations

from dataclasses import replace

import numpy as np

from . import shapes, surfaces
from .builder import Builder
from .material import Material
from .scene import Light, Scene

_FROM, _TO = -14.0, 42.0
_HEIGHT = 2.7
_BAY = 3.6  # from pillar to pillar


def corridor(seed: int) -> Scene:
    """A corridor along x, about 3 m wide; the camera's way is near y = 0, x from 0 to 28 m."""
    rng = np.random.default_rng([seed, 1])
    build = Builder(rng)
    half = float(rng.uniform(1.35, 1.6))
    _floor_and_ceiling(build, half)
    colour = (0.62, 0.61, 0.56)
    paint = surfaces.seeded(Material(colour=colour, stain_colour=(0.57, 0.56, 0.51), stain=0.5,
                                     stain_size=2.0, grain=0.008, grain_size=0.04), rng)
    dado = surfaces.seeded(replace(
        paint, colour=((0.34, 0.40, 0.36), (0.44, 0.36, 0.26), (0.40, 0.42, 0.46))[
            rng.integers(3)], stain_colour=(0.30, 0.30, 0.28), stain=0.5, stain_size=0.6,
        grain=0.09, grain_size=0.015, dirt=0.3), rng)
    papered = surfaces.seeded(replace(paint, grain=0.13, grain_size=0.03), rng)
    for side, upper in ((1, paint), (-1, papered)):
        _wall(_Side(build, half, side), upper, dado)
    for x in (_FROM, _TO):
        build.add('end', shapes.box((x - 0.1, -half, 0), (x + 0.1, half, _HEIGHT)), paint)
        out = -0.13 * np.sign(x)
        build.add('end door', shapes.box((min(x, x + out), -0.5, 0), (max(x, x + out), 0.5, 2.1)),
                  surfaces.WOOD)
    lamps = _lamps(build)
    return Scene(build.parts(), Light(
        sun_strength=0.0, sun_colour=(1.0, 0.96, 0.88), from_above=(0.16, 0.16, 0.16),
        from_below=(0.34, 0.32, 0.29), lamps=lamps))


def _floor_and_ceiling(build: Builder, half: float) -> None:
    rng = build.rng
    floors = (
        Material(colour=(0.22, 0.23, 0.21), stain_colour=(0.17, 0.18, 0.17), stain=0.5,
                 stain_size=1.0, grain=0.14, grain_size=0.02, mirror=0.04, specular=0.2,
                 exponent=80.0),
        Material(colour=(0.36, 0.34, 0.30), stain_colour=(0.30, 0.28, 0.25), stain=0.6,
                 stain_size=0.5, grain=0.09, grain_size=0.08, block=(0.4, 0.4), block_offset=0.0,
                 block_variation=0.1, joint=0.007, mirror=0.05, specular=0.2, exponent=120.0),
        surfaces.PARQUET)
    build.add('floor', shapes.box((_FROM, -half - 1, -0.2), (_TO, half + 1, 0)),
              surfaces.seeded(floors[rng.integers(3)], rng))
    ceiling = Material(colour=(0.66, 0.66, 0.64), grain=0.09, grain_size=0.03,
                       block=(0.625, 0.625), block_offset=0.0, block_variation=0.02,
                       joint=0.012, joint_colour=(0.42, 0.42, 0.42))
    build.add('ceiling', shapes.box((_FROM, -half - 1, _HEIGHT), (_TO, half + 1, _HEIGHT + 0.1)),
              surfaces.seeded(ceiling, rng))


def _lamps(build: Builder) -> tuple[tuple[float, float, float, float], ...]:
    rng = build.rng
    pitch = float(rng.uniform(2.6, 3.4))
    lamps = []
    for x in np.arange(_FROM + 1.0, _TO, pitch):
        build.add('lamp', shapes.box((x - 0.6, -0.09, _HEIGHT - 0.06), (x + 0.6, 0.09, _HEIGHT)),
                  surfaces.LAMP)
        if rng.random() < 0.9:
            lamps.append((float(x), 0.0, _HEIGHT - 0.1, float(rng.uniform(0.8, 1.0))))
    return tuple(lamps)


class _Side:
    """One wall: shapes are placed along it, y = 0 its face, −y into the corridor."""

    def __init__(self, build: Builder, half: float, side: int) -> None:
        self.build = build
        self.half = half
        self.side = side

    def put(self, name: str, shape: shapes.Mesh, what: Material, smooth: bool = False) -> None:
        """Add a shape that is laid out along the wall from x = 0."""
        if self.side > 0:
            placed = shapes.moved(shape, _FROM, self.half)
        else:
            placed = shapes.moved(shape, _TO, -self.half, yaw=np.pi)
        self.build.add(name, placed, what, smooth)


def _wall(side: _Side, paint: Material, dado: Material) -> None:
    """A wall with doors in every second bay or so, pillars between bays, a skirting board."""
    rng, length, put = side.build.rng, _TO - _FROM, side.put
    starts = np.arange(0.4, length - _BAY, _BAY)
    doors = [(float(s + 0.7), float(s + 1.65), 0.0, 2.1) for s in starts if rng.random() < 0.6]
    wall, leaves = shapes.wall_with_holes(length, _HEIGHT, doors, 0.12)
    door = surfaces.seeded((surfaces.WOOD, replace(surfaces.METAL, colour=(0.25, 0.3, 0.34)))[
        rng.integers(2)], rng)
    put('wall', wall, paint)
    put('door', leaves, door)
    edges = [0.0, *(e for d in doors for e in (d[0] - 0.07, d[1] + 0.07)), length]
    spans = list(zip(edges[::2], edges[1::2], strict=True))
    put('dado', shapes.joined([shapes.box((a, -0.004, 0), (b, 0, 1.15)) for a, b in spans]), dado)
    put('skirting', shapes.joined([shapes.box((a, -0.015, 0), (b, 0, 0.1)) for a, b in spans]),
        surfaces.RUBBER)
    for x0, x1, _, z in doors:
        _door_fittings(side, x0, x1, z)
    for s in starts:
        put('pillar', shapes.box((s - 0.15, -0.22, 0), (s + 0.15, 0.02, _HEIGHT)), _PILLAR)
        _fitting(side, float(s) + 2.65)
    for out, diameter in ((0.16, 0.05), (0.26, 0.03)):
        if rng.random() < 0.8:
            path = [(0, -out, _HEIGHT - 0.14), (length, -out, _HEIGHT - 0.14)]
            put('pipe', shapes.tube(path, diameter / 2), surfaces.METAL, True)


def _door_fittings(side: _Side, x0: float, x1: float, z: float) -> None:
    put = side.put
    frame = [shapes.box((x0 - 0.07, -0.02, 0), (x0, 0.12, z + 0.07)),
             shapes.box((x1, -0.02, 0), (x1 + 0.07, 0.12, z + 0.07)),
             shapes.box((x0, -0.02, z), (x1, 0.12, z + 0.07))]
    put('door frame', shapes.joined(frame), surfaces.FRAME)
    put('handle', shapes.tube([(x0 + 0.1, 0.06, 1.05), (x0 + 0.24, 0.06, 1.05)], 0.011),
        surfaces.METAL, True)
    put('plate', shapes.box((x1 + 0.2, -0.01, 1.5), (x1 + 0.42, 0, 1.62)), _PAPER)
    if side.build.rng.random() < 0.4:
        put('pane', shapes.box((x0 + 0.3, 0.1, 1.2), (x1 - 0.3, 0.13, 1.9)), _PANE)


_PANE = replace(surfaces.GLASS, face_tilt=0.0)
_PAPER = Material(colour=(0.6, 0.6, 0.57), block=(0.05, 0.018), block_offset=0.3,
                  block_variation=0.5, joint=0.006, joint_colour=(0.6, 0.6, 0.57))
_POSTER = replace(_PAPER, block=(0.12, 0.1), colour=(0.3, 0.4, 0.5), joint=0.02)
_RED = replace(surfaces.METAL, colour=(0.4, 0.01, 0.01), specular=0.6)
_LOCKER = replace(surfaces.METAL, block=(0.3, 1.9), joint=0.006)
_PILLAR = replace(surfaces.CONCRETE, grain=0.12, grain_size=0.06, colour=(0.5, 0.49, 0.46))
_CORK = replace(surfaces.EARTH, grain_size=0.02)


def _fitting(side: _Side, x: float) -> None:
    """Something that hangs on the wall or stands before it, about x; now and then nothing."""
    rng, put = side.build.rng, side.put
    kind = rng.integers(7)
    if kind == 0:
        put('board', shapes.box((x - 0.5, -0.03, 1.1), (x + 0.5, 0, 1.8)), _CORK)
        for _ in range(6):
            a, b = rng.uniform(x - 0.46, x + 0.25), rng.uniform(1.14, 1.45)
            put('paper', shapes.box((a, -0.034, b), (a + 0.21, -0.03, b + 0.3)),
                surfaces.seeded(_PAPER, rng))
    elif kind == 1:
        put('extinguisher', shapes.pole(x, -0.12, 0.16, 0.5, 0.5), _RED, True)
    elif kind == 2:
        low = np.array([(x - 0.5 + 0.06 * k, -0.12, 0.15) for k in range(16)])
        put('radiator', shapes.box(low, np.add(low, (0.04, 0.1, 0.6))), surfaces.FRAME)
    elif kind == 3:
        put('locker', shapes.box((x - 0.5, -0.4, 0), (x + 0.4, 0, 1.9)), _LOCKER)
    elif kind == 4:
        put('poster', shapes.box((x - 0.35, -0.006, 1.2), (x + 0.25, 0, 2.0)),
            surfaces.seeded(_POSTER, rng))
    elif kind == 5:
        put('stand', shapes.pole(x, -0.25, 0.06, 1.7), surfaces.DARK_METAL, True)
