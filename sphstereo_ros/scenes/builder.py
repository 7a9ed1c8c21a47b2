"""Collects meshes by material while a scene is laid out, and builds houses, trees and cars."""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from . import shapes, surfaces
from .material import Material
from .scene import Part
from .shapes import Mesh, Rectangle

Put = Callable[..., None]


class Builder:
    """A scene in the making. What shares a material object and smoothness becomes one part."""

    def __init__(self, rng: np.random.Generator) -> None:
        self.rng = rng
        self._found: dict[tuple[int, bool], tuple[str, Material, list[Mesh]]] = {}

    def add(self, name: str, shape: Mesh, material: Material, smooth: bool = False) -> None:
        """Add a mesh; `name` names the part if it is the first of its material."""
        entry = self._found.setdefault((id(material), smooth), (name, material, []))
        entry[2].append(shape)

    def parts(self) -> list[Part]:
        """All parts, with names made unique."""
        seen: dict[str, int] = {}
        out = []
        for (_, smooth), (name, material, meshes) in self._found.items():
            seen[name] = seen.get(name, 0) + 1
            unique = name if seen[name] == 1 else f'{name} {seen[name]}'
            out.append(Part(unique, shapes.joined(meshes), material, smooth=smooth))
        return out

    def house(self, x: float, y: float, yaw: float, size: tuple[float, float, float],
              shop: bool = False) -> None:
        """A house whose front starts at (x, y) and runs `size[0]` m along `yaw`.

        Its depth size[1] lies to the left of that direction; size[2] is its height. Seen from
        the right, all windows of a house are the same.
        """
        rng = self.rng
        width, depth, height = size
        material = surfaces.wall(rng)
        side = material if rng.random() < 0.5 else surfaces.plain_plaster(rng)
        storeys = max(1, round((height - 0.6) / 2.9))
        holes = self._openings(width, height, storeys, shop)
        recess = float(rng.uniform(0.1, 0.22))

        def put(name: str, shape: Mesh, what: Material, smooth: bool = False) -> None:
            self.add(name, shapes.moved(shape, x, y, 0.0, yaw), what, smooth)

        front, panes = shapes.wall_with_holes(width, height, holes, recess)
        put('front', front, material)
        put('glass', panes, surfaces.GLASS)
        put('frame', shapes.window_frames(holes, recess, 0.06, 2, 2), surfaces.FRAME)
        put('sill', shapes.sills([h for h in holes if h[2] > 0.5]), surfaces.CONCRETE)
        corners = [(width, 0, 0), (width, depth, 0), (0, depth, 0), (0, 0, 0)]
        up = np.array([0.0, 0.0, height])
        put('side', shapes.quads(np.array([[a, b, b + up, a + up] for a, b in zip(
            np.array(corners[:-1]), np.array(corners[1:]), strict=True)])), side)
        self._roof(put, size, material)
        self._trim(put, size, holes, storeys)
        pipe = float(rng.choice([0.15, width - 0.15]))
        put('pipe', shapes.pole(pipe, -0.09, 0.09, height), surfaces.METAL, True)

    def _openings(self, width: float, height: float, storeys: int,
                  shop: bool) -> list[Rectangle]:
        rng = self.rng
        columns = max(2, int(width / rng.uniform(2.2, 3.4)))
        window = float(rng.uniform(0.9, 1.35)), float(rng.uniform(1.2, 1.7))
        pitch = width / columns
        door = int(rng.integers(columns))
        rise = (height - 0.6) / storeys
        holes = []
        for storey in range(storeys):
            for column in range(columns):
                x = (column + 0.5) * pitch
                half, low, tall = window[0] / 2, storey * rise + 0.95, window[1]
                if storey == 0 and column == door:
                    half, low, tall = 0.55, 0.12, 2.15
                elif storey == 0 and shop:
                    half, low, tall = 0.42 * pitch, 0.55, 1.9
                holes.append((x - half, x + half, low, low + min(tall, rise - 1.05)
                              if low > 0.2 else low + tall))
        return holes

    def _trim(self, put: Put, size: tuple[float, float, float], holes: list[Rectangle],
              storeys: int) -> None:
        """Plinth, cornices, and now and then balconies with thin railings."""
        rng, (width, _, height) = self.rng, size
        doors = sorted(h[:2] for h in holes if h[2] < 0.2)
        edges = [0.0, *(e for d in doors for e in d), width]
        put('plinth', shapes.joined([shapes.box((a, -0.04, 0), (b, 0.02, 0.5))
                                     for a, b in zip(edges[::2], edges[1::2], strict=True)]),
            surfaces.CONCRETE)
        if rng.random() < 0.5:
            levels = [(height - 0.6) * k / storeys + 0.35 for k in range(1, storeys)] or [height]
            put('cornice', shapes.joined([shapes.box((0, -0.08, z), (width, 0.02, z + 0.14))
                                          for z in levels]), surfaces.CONCRETE)
        if rng.random() > 0.4:
            return
        for x0, x1, z0, _ in holes:
            if z0 > 3 and rng.random() < 0.6:
                z = z0 - 0.3
                put('balcony', shapes.box((x0 - 0.4, -0.9, z), (x1 + 0.4, 0.02, z + 0.12)),
                    surfaces.CONCRETE)
                put('railing', shapes.railing(x0 - 0.4, x1 + 0.4, 0.88, z + 0.12),
                    surfaces.DARK_METAL)

    def _roof(self, put: Put, size: tuple[float, float, float], material: Material) -> None:
        width, depth, height = size
        if height < 9 or self.rng.random() < 0.4:
            rise = 0.35 * depth * float(self.rng.uniform(0.7, 1.1))
            put('roof', shapes.gable_roof(width, depth, height, rise), surfaces.TILES)
            put('gable', shapes.gables(width, depth, height, rise), material)
            chimney = shapes.box((0.3 * width, 0.35 * depth, height),
                                 (0.3 * width + 0.7, 0.35 * depth + 0.7, height + rise + 0.4))
            put('chimney', chimney, surfaces.CONCRETE)
            gutter = shapes.tube([(-0.4, -0.45, height - 0.25), (width + 0.4, -0.45,
                                                                 height - 0.25)], 0.07)
            put('gutter', gutter, surfaces.METAL, True)
        else:
            put('roof', shapes.box((-0.15, -0.25, height), (width + 0.15, depth, height + 0.35)),
                surfaces.CONCRETE)

    def tree(self, x: float, y: float, height: float, crown: float, leaf: float, count: int,
             foliage: Material) -> None:
        """A tree; `crown` its crown's radius, `leaf` the size of a leaf."""
        wood, leaves = shapes.tree(self.rng, height, crown, leaf, count)
        self.add('wood', shapes.moved(wood, x, y), surfaces.BARK, True)
        self.add('leaves', shapes.moved(leaves, x, y), foliage)

    def car(self, x: float, y: float, yaw: float) -> None:
        """A parked car in a random paint."""
        paint = surfaces.car_paint(self.rng)
        what = {'body': paint, 'glass': CAR_GLASS, 'tyre': surfaces.TYRE, 'hub': surfaces.METAL,
                'lamp': CAR_LAMP}
        for name, shape in shapes.car(float(self.rng.uniform(1.4, 1.75))).items():
            self.add(f'car {name}', shapes.moved(shape, x, y, 0.0, yaw), what[name],
                     name in ('body', 'glass'))

    def street_lamp(self, x: float, y: float, diameter: float, height: float) -> None:
        """A lamp post whose arm reaches over the road (towards y = 0)."""
        arm = -np.sign(y) * 1.3
        self.add('pole', shapes.pole(x, y, diameter, height), surfaces.DARK_METAL, True)
        path = [(x, y, height - 0.1), (x, y + 0.5 * arm, height + 0.25), (x, y + arm,
                                                                        height + 0.3)]
        self.add('pole', shapes.tube(path, 0.03), surfaces.DARK_METAL, True)
        low, high = sorted((y + arm - 0.3, y + arm + 0.3))
        self.add('lamp head', shapes.box((x - 0.12, low, height + 0.25),
                                         (x + 0.12, high, height + 0.38)), surfaces.METAL)

    def sign(self, x: float, y: float, diameter: float) -> None:
        """A sign post with one plate that faces back along x."""
        self.add('post', shapes.pole(x, y, diameter, 2.8), surfaces.METAL, True)
        colour = ((0.45, 0.02, 0.02), (0.02, 0.06, 0.3), (0.6, 0.45, 0.02))[
            self.rng.integers(3)]
        plate = replace(surfaces.METAL, colour=colour, block=(0.11, 0.09), block_variation=0.7,
                        joint_colour=(0.6, 0.6, 0.6), joint=0.012,
                        seed=int(self.rng.integers(1 << 20)))
        self.add('plate', shapes.box((x - diameter / 2 - 0.01, y - 0.32, 2.1),
                                     (x - diameter / 2, y + 0.32, 2.74)), plate)


CAR_GLASS = replace(surfaces.GLASS, face_tilt=0.0, mirror=0.07)
CAR_LAMP = replace(surfaces.METAL, colour=(0.5, 0.4, 0.35), mirror=0.2)
