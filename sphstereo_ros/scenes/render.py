"""Rendering of full-sphere frames: radiance for the picture, one exact hit a pixel for range."""
from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from sphstereo_ros.core.jit import rows_in_parallel

from .scene import Scene
from .shading import pixel_rays, shade

Array = NDArray[Any]

_CENTRE = np.zeros((1, 2))
_CHUNK = 1 << 17  # rays in flight at once, per thread
_EDGE_CONTRAST = 0.08


def _grid(count: int) -> NDArray[np.float64]:
    steps = (np.arange(count) + 0.5) / count - 0.5
    return np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)


def radiance(scene: Scene, origins: Array, rays: Array, angle: float, samples: int = 1,
             travelled: Array | None = None) -> tuple[Array, Array]:
    """Linear RGB (n, 3) float32 along `rays` (n, 3) from `origins` (n, 3), and the faces (n,) hit.

    angle : of a pixel, rad; samples : that many consecutive rays belong to a pixel;
    travelled : (n,) metres already behind a ray that was mirrored
    """
    count = len(rays)
    hits = scene.cast(origins, rays)
    base, direct = np.empty((count, 3), np.float32), np.empty((count, 3), np.float32)
    shadow_from, shadow_to = np.empty((count, 3)), np.empty((count, 3))
    mirror_rays = np.empty((count, 3))
    shadow_length, mirror = np.empty(count), np.empty(count)
    shade(samples, origins, rays, hits.distance,
          np.zeros(count) if travelled is None else travelled, angle, hits.face, hits.corners,
          scene.normals, scene.corner_normals, scene.face_part, scene.placements, scene.materials,
          scene.light_record, scene.lamps, base, direct, shadow_from, shadow_to, shadow_length,
          mirror, mirror_rays)
    lit = np.flatnonzero(shadow_length > 0)
    if len(lit):
        blocked = scene.blocked(shadow_from[lit], shadow_to[lit], shadow_length[lit])
        base[lit] += np.where(blocked[:, None], np.float32(0), direct[lit])
    shiny = np.flatnonzero(mirror > 0)
    if len(shiny) and travelled is None:
        image, _ = radiance(scene, shadow_from[shiny], mirror_rays[shiny], angle, 1,
                            hits.distance[shiny])
        weight = mirror[shiny, None].astype(np.float32)
        base[shiny] = (1 - weight) * base[shiny] + weight * np.minimum(image, 4.0)
    return base, hits.face


class Camera:
    """A full-sphere camera somewhere in a scene.

    rotation : (3, 3) world ← camera_optical; position : (3,) metres
    """

    def __init__(self, scene: Scene, rotation: Array, position: Array, height: int) -> None:
        self.scene = scene
        self.rotation = np.asarray(rotation, np.float64)
        self.position = np.asarray(position, np.float64)
        self.height = height

    def range(self) -> NDArray[np.float64]:
        """Distance (H, 2H) to the first surface through each pixel's centre; +inf is sky."""
        return self.range_and_parts()[0]

    def range_and_parts(self) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """The range, and which of the scene's parts (H, 2H) it is of; −1 is sky."""
        out = np.empty(2 * self.height**2)
        parts = np.empty(out.size, np.int64)

        def rows(pixels: Array) -> None:
            rays = self._rays(pixels, _CENTRE)
            hits = self.scene.cast(self._origins(len(rays)), rays)
            out[pixels] = hits.distance
            parts[pixels] = np.where(hits.face < 0, -1, self.scene.face_part[hits.face])

        self._each_chunk(np.arange(out.size), 1, rows)
        return out.reshape(self.height, -1), parts.reshape(self.height, -1)

    def picture(self, samples: int = 2, edge_samples: int = 4) -> NDArray[np.float32]:
        """Linear RGB (H, 2H, 3): samples² rays a pixel, edge_samples² where they disagree."""
        out = np.empty((2 * self.height**2, 3), np.float32)
        edges = np.zeros(len(out), np.bool_)

        def first(pixels: Array) -> None:
            colour, part = self._sampled(pixels, samples)
            out[pixels] = colour.mean(axis=1)
            spread = (np.ptp(colour, axis=1) / (0.2 + colour.mean(axis=1))).max(axis=1)
            edges[pixels] = (spread > _EDGE_CONTRAST) | (np.ptp(part, axis=1) > 0)

        def second(pixels: Array) -> None:
            out[pixels] = self._sampled(pixels, edge_samples)[0].mean(axis=1)

        self._each_chunk(np.arange(len(out)), samples**2, first)
        if edge_samples > samples:
            self._each_chunk(np.flatnonzero(edges), edge_samples**2, second)
        return out.reshape(self.height, -1, 3)

    def _sampled(self, pixels: Array, samples: int) -> tuple[Array, Array]:
        rays = self._rays(pixels, _grid(samples))
        colour, face = radiance(self.scene, self._origins(len(rays)), rays, np.pi / self.height,
                                samples**2)
        part = np.where(face < 0, -1, self.scene.face_part[face])
        # Clipped before the average, as a lens' glare would not be: keeps highlights' edges soft.
        colour = np.minimum(colour, 3.0)
        return colour.reshape(len(pixels), -1, 3), part.reshape(len(pixels), -1)

    def _rays(self, pixels: Array, offsets: Array) -> NDArray[np.float64]:
        rays = np.empty((len(pixels) * len(offsets), 3))
        pixel_rays(self.height, pixels, offsets, self.rotation, rays)
        return rays

    def _origins(self, count: int) -> NDArray[np.float64]:
        return np.tile(self.position, (count, 1))

    @staticmethod
    def _each_chunk(pixels: Array, samples: int, function: Any) -> None:
        """Call `function` on pieces of `pixels`, dealt out evenly over the threads."""
        size = max(1, _CHUNK // samples)
        pieces = [pixels[i:i + size] for i in range(0, len(pixels), size)]
        # Sky is cheap and ground is not: neighbours go to different threads.
        order = [*range(0, len(pieces), 2), *range(1, len(pieces), 2)]

        def work(first: int, last: int) -> None:
            for i in range(first * len(order) // 1024, last * len(order) // 1024):
                function(pieces[order[i]])

        rows_in_parallel(work, 1024)
