"""Things that move: parts at a constant velocity, and the traffic of the street."""
from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from . import shapes, surfaces
from .builder import Builder
from .material import Material
from .scene import Part

_LANE = 3.0  # from the middle of the road to that of the lanes beside the camera's, m
_SKIN = Material(colour=(0.45, 0.28, 0.2))


@dataclass(frozen=True)
class Mover:
    """Something that moves without turning.

    parts : where they are at the stamp of frame 0; their names are unique in the scene;
    velocity : (3,) m/s, world
    """

    parts: tuple[Part, ...]
    velocity: NDArray[np.float64]

    def at(self, seconds: float) -> list[Part]:
        """The parts that many seconds after frame 0."""
        return [replace(p, position=p.position + seconds * self.velocity) for p in self.parts]


def traffic(seed: int, speed: float) -> list[Mover]:
    """Three oncoming cars, one beside the camera at its `speed` (m/s), and two who cross.

    The camera drives along x near y = 0 from x = 0 on. A cyclist crosses from the right about
    12 m ahead, a pedestrian to the left about 20 m ahead. Nothing collides for the first 2 s.
    """
    rng = np.random.default_rng([seed, 7])
    start = float(rng.uniform(13, 17))
    oncoming = -float(rng.uniform(9, 12))
    movers = []
    for k, gap in enumerate(np.cumsum([0.0, *rng.uniform(36, 40, 2)])):
        movers.append(_car(rng, f'oncoming {k + 1}', (start + gap, _LANE), np.pi, oncoming))
    movers.append(_car(rng, 'beside', (float(rng.uniform(0, 2.5)), -_LANE), 0.0, speed))
    movers.append(_placed(_pedestrian(rng), 'pedestrian', (float(rng.uniform(18, 21)), 1.4),
                          (0.0, float(rng.uniform(1.2, 1.6)))))
    movers.append(_placed(_cyclist(rng), 'cyclist', (float(rng.uniform(11, 12.5)), -3.0),
                          (0.0, float(rng.uniform(4.4, 4.8)))))
    return movers


def _placed(build: Builder, name: str, at: tuple[float, float],
            velocity: tuple[float, float]) -> Mover:
    """What was built about the origin, as a mover whose parts are named after it."""
    position = np.array([*at, 0.0])
    parts = tuple(replace(p, name=f'{name}: {p.name}', position=position) for p in build.parts())
    return Mover(parts, np.array([*velocity, 0.0]))


def _car(rng: np.random.Generator, name: str, at: tuple[float, float], yaw: float,
         speed: float) -> Mover:
    build = Builder(rng)
    build.car(0.0, 0.0, yaw)
    return _placed(build, name, at, (speed, 0.0))


def _cloth(rng: np.random.Generator) -> Material:
    r, g, b = rng.uniform(0.05, 0.5, 3)
    return surfaces.seeded(Material(
        colour=(float(r), float(g), float(b)), stain_colour=(0.1, 0.1, 0.12), stain=0.5,
        stain_size=0.3, grain=0.25, grain_size=0.08, grain_gain=0.8), rng)


def _limb(build: Builder, cloth: Material, path: list[tuple[float, float, float]],
          radius: float) -> None:
    build.add('limb', shapes.tube(path, radius), cloth, True)


def _body(build: Builder, cloth: Material, z: float, lean: float = 0.0) -> None:
    """Torso and head above the hips at height `z`; `lean` metres forward (+y) at the head."""
    torso = shapes.rounded(0.42, 0.26, 0.66, 0.6, 20)
    build.add('torso', shapes.moved(torso, 0, 0.45 * lean, z + 0.28), cloth, True)
    head = shapes.rounded(0.17, 0.21, 0.25, 1.0, 20)
    build.add('head', shapes.moved(head, 0, lean, z + 0.76), _SKIN, True)


def _pedestrian(rng: np.random.Generator) -> Builder:
    """Someone who walks along +y, in mid-stride; about 1.75 m tall."""
    build = Builder(rng)
    coat, trousers = _cloth(rng), _cloth(rng)
    _body(build, coat, 0.86)
    for side in (0.1, -0.1):
        stride = float(np.sign(side)) * 0.3
        _limb(build, trousers, [(side, stride, 0), (side, 0.4 * stride + 0.08, 0.45),
                                (side, 0, 0.9)], 0.075)
        _limb(build, coat, [(2.4 * side, 0, 1.38), (2.5 * side, -0.6 * stride, 0.85)], 0.05)
    return build


def _cyclist(rng: np.random.Generator) -> Builder:
    """Someone who cycles along +y."""
    build = Builder(rng)
    coat, trousers = _cloth(rng), _cloth(rng)
    turn = np.linspace(0, 2 * np.pi, 33)
    for y in (-0.52, 0.52):
        ring = np.stack([0 * turn, y + 0.33 * np.cos(turn), 0.35 + 0.33 * np.sin(turn)], -1)
        build.add('wheel', shapes.tube(ring, 0.018, sides=6), surfaces.TYRE, True)
    frame = [[(0, -0.52, 0.35), (0, -0.1, 0.3), (0, 0.36, 0.75), (0, -0.2, 0.8),
              (0, -0.52, 0.35)], [(0, -0.1, 0.3), (0, -0.24, 0.98)],
             [(0, 0.52, 0.35), (0, 0.36, 0.75), (0, 0.33, 1.02)],
             [(-0.28, 0.33, 1.02), (0.28, 0.33, 1.02)]]
    paint = surfaces.car_paint(rng)
    for path in frame:
        build.add('frame', shapes.tube(path, 0.018, sides=8), paint, True)
    _body(build, coat, 0.98, 0.22)
    for side, knee in ((0.1, 0.75), (-0.1, 0.6)):
        _limb(build, trousers, [(side, -0.18, 0.98), (side, 0.14, knee),
                                (side, -0.08, knee - 0.42)], 0.07)
        _limb(build, coat, [(2 * side, 0.12, 1.45), (2.5 * side, 0.33, 1.04)], 0.045)
    return build
