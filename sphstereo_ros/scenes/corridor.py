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
    for side in (1, -1):
        _wall(build, half, side, paint)
        _fittings(build, half, side)
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
                 stain_size=1.0, grain=0.06, grain_size=0.02, mirror=0.04, specular=0.2,
                 exponent=80.0),
        Material(colour=(0.36, 0.34, 0.30), stain_colour=(0.30, 0.28, 0.25), stain=0.6,
                 stain_size=0.5, grain=0.05, grain_size=0.1, block=(0.4, 0.4), block_offset=0.0,
                 block_variation=0.06, joint=0.005, mirror=0.05, specular=0.2, exponent=120.0),
        surfaces.PARQUET)
    build.add('floor', shapes.box((_FROM, -half - 1, -0.2), (_TO, half + 1, 0)),
              surfaces.seeded(floors[rng.integers(3)], rng))
    ceiling = Material(colour=(0.66, 0.66, 0.64), grain=0.012, grain_size=0.02,
                       block=(0.625, 0.625), block_offset=0.0, block_variation=0.015,
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


def _wall(build: Builder, half: float, side: int, paint: Material) -> None:
    """A wall with doors in every second bay or so, pillars between bays, a skirting board."""
    rng = build.rng
    length = _TO - _FROM
    starts = np.arange(0.4, length - _BAY, _BAY)
    doors = [(float(s + 0.9), float(s + 1.85), 0.0, 2.1) for s in starts if rng.random() < 0.6]
    wall, leaves = shapes.wall_with_holes(length, _HEIGHT, doors, 0.12)
    door = surfaces.seeded((surfaces.WOOD, replace(surfaces.METAL, colour=(0.25, 0.3, 0.34)))[
        rng.integers(2)], rng)

    def put(name: str, shape: shapes.Mesh, what: Material, smooth: bool = False) -> None:
        # A wall's front is y = 0, seen from −y: that of the left side as it is, else turned.
        if side > 0:
            placed = shapes.moved(shape, _FROM, half)
        else:
            placed = shapes.moved(shape, _TO, -half, yaw=np.pi)
        build.add(name, placed, what, smooth)

    put('wall', wall, paint)
    put('door', leaves, door)
    edges = [0.0, *(e for d in doors for e in d[:2]), length]
    spans = list(zip(edges[::2], edges[1::2], strict=True))
    put('skirting', shapes.joined([shapes.box((a, -0.015, 0), (b, 0, 0.1)) for a, b in spans]),
        surfaces.RUBBER)
    for x0, x1, _, z in doors:
        frame = [shapes.box((x0 - 0.07, -0.02, 0), (x0, 0.12, z + 0.07)),
                 shapes.box((x1, -0.02, 0), (x1 + 0.07, 0.12, z + 0.07)),
                 shapes.box((x0, -0.02, z), (x1, 0.12, z + 0.07))]
        put('door frame', shapes.joined(frame), surfaces.FRAME)
        put('handle', shapes.tube([(x0 + 0.1, 0.06, 1.05), (x0 + 0.24, 0.06, 1.05)], 0.011),
            surfaces.METAL, True)
        put('plate', shapes.box((x1 + 0.2, -0.01, 1.5), (x1 + 0.42, 0, 1.62)), _PAPER)
        if rng.random() < 0.4:
            put('pane', shapes.box((x0 + 0.3, 0.1, 1.2), (x1 - 0.3, 0.13, 1.9)),
                replace(surfaces.GLASS, face_tilt=0.0))
    for s in starts:
        put('pillar', shapes.box((s - 0.15, -0.22, 0), (s + 0.15, 0.02, _HEIGHT)), paint)


_PAPER = Material(colour=(0.6, 0.6, 0.57), block=(0.05, 0.018), block_offset=0.3,
                  block_variation=0.5, joint=0.006, joint_colour=(0.6, 0.6, 0.57))


def _fittings(build: Builder, half: float, side: int) -> None:
    rng = build.rng
    y = side * half
    inner = -side

    def against(x0: float, x1: float, depth: float, z0: float, z1: float) -> shapes.Mesh:
        low, high = sorted((y, y + inner * depth))
        return shapes.box((x0, low, z0), (x1, high, z1))

    for offset, diameter in ((0.16, 0.05), (0.26, 0.03)):
        path = [(_FROM, y + inner * offset, _HEIGHT - 0.14), (_TO, y + inner * offset,
                                                             _HEIGHT - 0.14)]
        if rng.random() < 0.8:
            build.add('pipe', shapes.tube(path, diameter / 2), surfaces.METAL, True)
    for x in np.arange(_FROM + 0.4, _TO - _BAY, _BAY) + 2.9:
        kind = rng.integers(7)
        if kind == 0:
            build.add('board', against(x - 0.5, x + 0.4, 0.03, 1.1, 1.75), replace(
                surfaces.EARTH, grain_size=0.02))
            for _ in range(5):
                a, b = rng.uniform(x - 0.46, x + 0.1), rng.uniform(1.14, 1.4)
                build.add('paper', against(a, a + 0.21, 0.034, b, b + 0.3),
                          surfaces.seeded(_PAPER, rng))
        elif kind == 1:
            build.add('extinguisher', shapes.pole(x, y + inner * 0.12, 0.16, 0.5, 0.5),
                      replace(surfaces.METAL, colour=(0.4, 0.01, 0.01), specular=0.6), True)
        elif kind == 2:
            fins = [against(x - 0.5 + 0.06 * k, x - 0.46 + 0.06 * k, 0.12, 0.15, 0.75)
                    for k in range(16)]
            build.add('radiator', shapes.joined(fins), surfaces.FRAME)
        elif kind == 3:
            build.add('locker', against(x - 0.5, x + 0.4, 0.4, 0.0, 1.9),
                      replace(surfaces.METAL, block=(0.3, 1.9), joint=0.006))
        elif kind == 4:
            build.add('poster', against(x - 0.35, x + 0.25, 0.004, 1.0, 1.8), surfaces.seeded(
                replace(_PAPER, block=(0.12, 0.1), colour=(0.3, 0.4, 0.5), joint=0.02), rng))
        elif kind == 5:
            build.add('stand', shapes.pole(x, y + inner * 0.25, 0.06, 1.7), surfaces.DARK_METAL,
                      True)
