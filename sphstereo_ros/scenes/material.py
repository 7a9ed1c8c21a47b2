"""What surfaces look like: one layered procedural material, described by numbers alone."""
from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Colour = tuple[float, float, float]


@dataclass(frozen=True)
class Material:
    """A surface. Colours are linear RGB reflectances, sizes in metres.

    The layers: `colour` stained towards `stain_colour` by soft noise; grain (noise in octaves
    from `grain_size` down to `grain_fine`); a different brightness for each face (leaves); dirt
    near the object's z = 0; cracks; blocks (bricks, slabs, tiles) with joints. Then the gloss:
    a Blinn highlight of the lights, and a mirror image of the scene weighted by Fresnel's law.
    """

    colour: Colour = (0.5, 0.5, 0.5)
    stain_colour: Colour = (0.4, 0.4, 0.4)
    stain: float = 0.0           # share of stain_colour at most
    stain_size: float = 2.0
    grain: float = 0.0           # relative amplitude of the first octave
    grain_size: float = 0.5
    grain_fine: float = 0.002
    grain_gain: float = 0.6      # amplitude from octave to octave
    stretch: Colour = (1.0, 1.0, 1.0)  # of the grain along the object's axes
    crack: float = 0.0           # width of cracks; 0 = none
    crack_size: float = 1.5
    block: tuple[float, float] = (0.0, 0.0)  # 0 = no blocks
    block_offset: float = 0.5    # of every second row, in blocks
    block_variation: float = 0.0
    joint: float = 0.01
    joint_colour: Colour = (0.3, 0.3, 0.3)
    face_variation: float = 0.0
    face_tilt: float = 0.0       # random tilt of each pair of faces, rad: uneven panes
    dirt: float = 0.0
    specular: float = 0.0
    exponent: float = 20.0
    mirror: float = 0.0          # reflectance at normal incidence; 0 = no mirror image
    emission: float = 0.0        # radiance in units of the colour
    translucent: float = 0.0     # share of light that comes through from behind
    seed: int = 0


def _field(name: str, default: Any) -> tuple[Any, ...]:
    if isinstance(default, tuple):
        return name, np.float64, (len(default),)
    return name, np.int64 if isinstance(default, int) else np.float64


MATERIAL_DTYPE = np.dtype([_field(f.name, f.default) for f in dataclasses.fields(Material)])


def material_table(materials: Sequence[Material]) -> NDArray[np.void]:
    """The materials (n) as records that kernels read."""
    rows = [tuple(getattr(m, name) for name in MATERIAL_DTYPE.names or ()) for m in materials]
    return np.array(rows, MATERIAL_DTYPE)
