"""The materials of the scenes, each with its variations from a seed."""
from __future__ import annotations

from dataclasses import replace

import numpy as np

from .material import Colour, Material

ASPHALT = Material(colour=(0.105, 0.105, 0.11), stain_colour=(0.075, 0.075, 0.08), stain=0.8,
                   stain_size=3.0, grain=0.15, grain_size=0.025, grain_gain=1.0, crack=0.012,
                   crack_size=2.0, specular=0.02, exponent=12.0)
SMOOTH_ASPHALT = replace(ASPHALT, stain=0.35, grain=0.06, stain_size=6.0, crack=0.0,
                         specular=0.03)
PATCH = replace(ASPHALT, colour=(0.07, 0.07, 0.072), grain=0.1)
PAINT = Material(colour=(0.62, 0.62, 0.6), stain_colour=(0.25, 0.25, 0.25), stain=0.8,
                 stain_size=0.25, grain=0.15, grain_size=0.03)
SLABS = Material(colour=(0.33, 0.32, 0.30), stain_colour=(0.22, 0.21, 0.20), stain=0.5,
                 stain_size=1.2, grain=0.04, grain_size=0.08, block=(0.5, 0.5), block_offset=0.5,
                 block_variation=0.12, joint=0.008, joint_colour=(0.12, 0.12, 0.11))
COBBLES = replace(SLABS, block=(0.2, 0.14), block_variation=0.35, joint=0.02)
CONCRETE = Material(colour=(0.36, 0.355, 0.34), stain_colour=(0.26, 0.26, 0.25), stain=0.5,
                    stain_size=1.5, grain=0.05, grain_size=0.1)
GRASS = Material(colour=(0.10, 0.16, 0.045), stain_colour=(0.16, 0.15, 0.06), stain=0.9,
                 stain_size=1.5, grain=0.4, grain_size=0.12, grain_gain=0.85)
FOREST = Material(colour=(0.06, 0.09, 0.05), stain_colour=(0.1, 0.11, 0.08), stain=0.8,
                  stain_size=25.0, grain=0.5, grain_size=5.0, grain_gain=0.8)
EARTH = Material(colour=(0.17, 0.13, 0.09), stain_colour=(0.25, 0.2, 0.15), stain=0.8,
                 stain_size=0.8, grain=0.3, grain_size=0.15, grain_gain=0.75)
BARK = Material(colour=(0.16, 0.12, 0.09), stain_colour=(0.24, 0.22, 0.18), stain=0.7,
                stain_size=0.5, grain=0.5, grain_size=0.08, grain_gain=0.8,
                stretch=(1.0, 1.0, 5.0))
METAL = Material(colour=(0.30, 0.31, 0.32), specular=0.35, exponent=45.0, stain=0.2,
                 stain_size=1.0, stain_colour=(0.22, 0.22, 0.22))
DARK_METAL = replace(METAL, colour=(0.045, 0.05, 0.05), specular=0.15)
WIRE = Material(colour=(0.03, 0.03, 0.03))
GLASS = Material(colour=(0.012, 0.014, 0.016), mirror=0.09, specular=0.8, exponent=900.0,
                 face_tilt=0.012)
FRAME = Material(colour=(0.62, 0.62, 0.60), grain=0.02, grain_size=0.2)
TYRE = Material(colour=(0.022, 0.022, 0.022), grain=0.1, grain_size=0.03)
LAMP = Material(colour=(1.0, 0.97, 0.9), emission=2.2)
RUBBER = Material(colour=(0.05, 0.05, 0.055), specular=0.1, exponent=20.0)
TILES = Material(colour=(0.30, 0.115, 0.07), stain_colour=(0.18, 0.1, 0.07), stain=0.7,
                 stain_size=1.0, grain=0.1, grain_size=0.05, block=(0.3, 0.25),
                 block_variation=0.25, joint=0.03, joint_colour=(0.09, 0.045, 0.03))
WOOD = Material(colour=(0.26, 0.16, 0.085), stain_colour=(0.16, 0.1, 0.05), stain=0.7,
                stain_size=0.4, grain=0.3, grain_size=0.04, stretch=(1.0, 1.0, 9.0),
                block=(0.12, 30.0), block_variation=0.15, joint=0.006)
PARQUET = replace(WOOD, block=(1.2, 0.12), block_variation=0.25, stretch=(9.0, 1.0, 1.0),
                  joint=0.003, mirror=0.03, specular=0.1, exponent=60.0)

_PLASTERS: tuple[Colour, ...] = ((0.62, 0.58, 0.48), (0.60, 0.60, 0.58), (0.55, 0.42, 0.28),
                                 (0.48, 0.50, 0.46), (0.58, 0.46, 0.40), (0.40, 0.44, 0.50))
_PAINTS: tuple[Colour, ...] = ((0.30, 0.012, 0.015), (0.02, 0.04, 0.14), (0.45, 0.45, 0.46),
                               (0.02, 0.02, 0.022), (0.62, 0.62, 0.60), (0.10, 0.13, 0.10))
_GREENS: tuple[Colour, ...] = ((0.075, 0.14, 0.025), (0.10, 0.17, 0.03), (0.16, 0.15, 0.03),
                               (0.05, 0.11, 0.03))


def _pick(rng: np.random.Generator, colours: tuple[Colour, ...]) -> Colour:
    r, g, b = np.array(colours[rng.integers(len(colours))]) * rng.uniform(0.88, 1.12)
    return float(r), float(g), float(b)


def seeded(material: Material, rng: np.random.Generator) -> Material:
    """The same material with its own noise."""
    return replace(material, seed=int(rng.integers(1, 1 << 30)))


def _darker(colour: Colour, share: float) -> Colour:
    return colour[0] * share, colour[1] * share, colour[2] * share


def plain_plaster(rng: np.random.Generator) -> Material:
    """Fresh paint: next to no texture."""
    colour = _pick(rng, _PLASTERS)
    return seeded(Material(colour=colour, stain_colour=_darker(colour, 0.94), stain=0.6,
                           stain_size=3.0, grain=0.012, grain_size=0.1, dirt=0.25), rng)


def old_plaster(rng: np.random.Generator) -> Material:
    """Rough render with stains."""
    colour = _pick(rng, _PLASTERS)
    return seeded(Material(colour=colour, stain_colour=_darker(colour, 0.6), stain=0.9,
                           stain_size=1.6, grain=0.16, grain_size=0.2, grain_gain=0.8,
                           stretch=(1.0, 1.0, 1.8), crack=0.006, crack_size=1.2, dirt=0.5), rng)


def brick(rng: np.random.Generator) -> Material:
    """Brickwork."""
    tone = float(rng.uniform(0.8, 1.2))
    return seeded(Material(colour=_darker((0.27, 0.12, 0.08), tone),
                           stain_colour=_darker((0.18, 0.1, 0.075), tone), stain=0.7,
                           stain_size=1.5, grain=0.12, grain_size=0.06, block=(0.25, 0.075),
                           block_variation=0.3, joint=0.012, joint_colour=(0.32, 0.30, 0.27),
                           dirt=0.3), rng)


def wall(rng: np.random.Generator) -> Material:
    """One of the wall materials; the plain one every fifth time."""
    return (plain_plaster, old_plaster, old_plaster, brick, brick)[rng.integers(5)](rng)


def car_paint(rng: np.random.Generator) -> Material:
    """Glossy paint."""
    return seeded(Material(colour=_pick(rng, _PAINTS), mirror=0.05, specular=0.7,
                           exponent=350.0), rng)


def foliage(rng: np.random.Generator) -> Material:
    """Leaves."""
    return seeded(Material(colour=_pick(rng, _GREENS), face_variation=0.55, specular=0.06,
                           exponent=15.0, translucent=0.45), rng)
