"""Scenes: parts (a mesh with a material) under a light, and rays cast at them.

The world is REP-103: x forward, y left, z up, metres. Keep a scene within some hundred metres of
the origin: the ray caster decides in float32 which triangle a ray hits.
"""
from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import trimesh
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from numpy.typing import NDArray

from .material import Colour, Material, material_table
from .shading import plane_distance

Array = NDArray[Any]


@dataclass(frozen=True)
class Part:
    """A mesh of one material, in its own axes, placed in the world.

    rotation : (3, 3) world ← part; position : (3,) metres. Textures stick to the part: a part
    that is placed elsewhere in the next frame is a moving object.
    smooth : shade with normals interpolated between vertices
    """

    name: str
    mesh: trimesh.Trimesh
    material: Material
    rotation: NDArray[np.float64] = field(default_factory=lambda: np.eye(3))
    position: NDArray[np.float64] = field(default_factory=lambda: np.zeros(3))
    smooth: bool = False


@dataclass(frozen=True)
class Light:
    """Sun, sky and lamps. Colours are linear RGB radiances.

    sun : (3,) unit vector toward the sun; lamps : rows of x, y, z, power, which replace the sun
    """

    sun: Colour = (0.35, 0.45, 0.82)
    sun_strength: float = 2.6
    sun_colour: Colour = (1.0, 0.93, 0.82)
    zenith: Colour = (0.16, 0.30, 0.62)
    horizon: Colour = (0.62, 0.72, 0.85)
    cloud_colour: Colour = (0.95, 0.95, 0.97)
    clouds: float = 0.35
    from_above: Colour = (0.42, 0.52, 0.68)
    from_below: Colour = (0.22, 0.21, 0.19)
    seed: int = 0
    lamps: tuple[tuple[float, float, float, float], ...] = ()

    def record(self) -> np.void:
        """The light as a record that kernels read."""
        fields = [f for f in dataclasses.fields(self) if f.name != 'lamps']
        dtype = [(f.name, np.float64, (3,)) if isinstance(f.default, tuple) else
                 (f.name, np.int64 if isinstance(f.default, int) else np.float64) for f in fields]
        row = tuple(getattr(self, f.name) for f in fields)
        record: np.void = np.array([row], np.dtype(dtype))[0]
        return record


@dataclass(frozen=True)
class Hits:
    """First surfaces along n rays: face (n,) int32, −1 for none; corners (n, 2) barycentric;
    distance (n,) float64 metres, +inf for none.
    """

    face: NDArray[np.int32]
    corners: NDArray[np.float32]
    distance: NDArray[np.float64]


class Scene:
    """Parts and a light, ready for rays. Not changed once built: see `replaced`."""

    def __init__(self, parts: Sequence[Part], light: Light | None = None) -> None:
        """`parts` must not be empty (ValueError); all meshes together are one ray-cast scene."""
        if not parts:
            raise ValueError('a scene needs at least one part')
        self.parts = tuple(parts)
        self.light = light or Light()
        corners = [_world_triangles(p) for p in self.parts]
        # Truth is the geometry as the ray caster has it: rounded to float32.
        packed = np.concatenate(corners).astype(np.float32)
        exact = packed.astype(np.float64)
        cross = np.cross(exact[:, 1] - exact[:, 0], exact[:, 2] - exact[:, 0])
        area = np.linalg.norm(cross, axis=1)
        keep = area > 1e-12
        part = np.repeat(np.arange(len(corners)), [len(c) for c in corners])[keep]
        smooth = np.concatenate([_corner_normals(p) for p in self.parts])[keep]
        self.face_part: NDArray[np.int64] = part
        self.anchors: NDArray[np.float64] = np.ascontiguousarray(exact[keep, 0])
        self.normals: NDArray[np.float64] = cross[keep] / area[keep, None]
        flat = np.isnan(smooth[:, 0, 0])
        smooth[flat] = self.normals[flat, None, :]
        self.corner_normals: NDArray[np.float32] = smooth.astype(np.float32)
        self.placements: NDArray[np.float64] = np.stack(
            [np.column_stack([p.rotation, p.position]) for p in self.parts])
        self.materials = material_table([p.material for p in self.parts])
        self.lamps: NDArray[np.float64] = np.array(self.light.lamps, np.float64).reshape(-1, 4)
        self.light_record = self.light.record()
        self._embree = EmbreeScene(robust=True)
        TriangleMesh(self._embree, np.ascontiguousarray(packed[keep]))
        self.cast(np.zeros((1, 3)), np.array([[0.0, 0.0, 1.0]]))  # builds the tree, once

    def replaced(self, *parts: Part) -> Scene:
        """The same scene with the parts of the same names replaced, others added."""
        new = {p.name: p for p in parts}
        kept = [new.pop(p.name, p) for p in self.parts]
        return Scene([*kept, *new.values()], self.light)

    def cast(self, origins: Array, rays: Array) -> Hits:
        """First hits of rays from `origins` (n, 3) along unit `rays` (n, 3), world frame."""
        found = self._embree.run(np.ascontiguousarray(origins, np.float32),
                                 np.ascontiguousarray(rays, np.float32), output=True)
        face = found['primID']
        distance = np.empty(len(face))
        plane_distance(origins, rays, face, self.anchors, self.normals, distance)
        return Hits(face, np.stack([found['u'], found['v']], axis=-1), distance)

    def blocked(self, origins: Array, rays: Array, lengths: Array) -> NDArray[np.bool_]:
        """Whether something lies within `lengths` (n,) metres along each ray."""
        found = self._embree.run(np.ascontiguousarray(origins, np.float32),
                                 np.ascontiguousarray(rays, np.float32),
                                 np.ascontiguousarray(lengths, np.float32), query='OCCLUDED')
        blocked: NDArray[np.bool_] = found != -1
        return blocked


def _world_triangles(part: Part) -> NDArray[np.float64]:
    triangles: NDArray[np.float64] = np.asarray(part.mesh.triangles) @ part.rotation.T
    return triangles + part.position


def _corner_normals(part: Part) -> NDArray[np.float64]:
    """Vertex normals (f, 3, 3) in the world; NaN where the part is flat."""
    if not part.smooth:
        return np.full((len(part.mesh.faces), 3, 3), np.nan)
    normals: NDArray[np.float64] = np.asarray(part.mesh.vertex_normals)[part.mesh.faces]
    return normals @ part.rotation.T
