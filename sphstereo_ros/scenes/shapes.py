"""Meshes that scenes are made of: boxes, tubes, facades, trees, cars. World axes, metres."""
from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any, TypeAlias

import numpy as np
import trimesh
from numpy.typing import NDArray

Array = NDArray[Any]
Mesh: TypeAlias = trimesh.Trimesh
Rectangle = tuple[float, float, float, float]


def mesh(vertices: Any, faces: Any) -> Mesh:
    """A mesh of vertices (n, 3) and faces (m, 3), taken as they are."""
    return Mesh(np.asarray(vertices, np.float64), np.asarray(faces, np.int64), process=False)


def joined(meshes: Sequence[Mesh]) -> Mesh:
    """One mesh of several."""
    return meshes[0] if len(meshes) == 1 else trimesh.util.concatenate(list(meshes))


def moved(shape: Mesh, x: float = 0.0, y: float = 0.0, z: float = 0.0, yaw: float = 0.0) -> Mesh:
    """A copy, turned by `yaw` about the vertical through the origin, then shifted."""
    c, s = np.cos(yaw), np.sin(yaw)
    turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    return mesh(shape.vertices @ turn.T + (x, y, z), shape.faces)


def quads(corners: Array) -> Mesh:
    """Quads from their corners (n, 4, 3), in order round each."""
    first = 4 * np.arange(len(corners))[:, None]
    faces = (first + np.array([0, 1, 2, 0, 2, 3])).reshape(-1, 3)
    return mesh(np.reshape(corners, (-1, 3)), faces)


_CORNERS = np.array([(x, y, z) for x in (0, 1) for y in (0, 1) for z in (0, 1)])
_SIDES = np.array([(0, 1, 3), (0, 3, 2), (4, 6, 7), (4, 7, 5), (0, 4, 5), (0, 5, 1),
                   (2, 3, 7), (2, 7, 6), (0, 2, 6), (0, 6, 4), (1, 5, 7), (1, 7, 3)])


def box(low: Any, high: Any) -> Mesh:
    """The axis-aligned box between two corners (3,), or boxes between pairs of them (n, 3)."""
    low, high = np.atleast_2d(low), np.atleast_2d(high)
    points = low[:, None] + _CORNERS * (high - low)[:, None]
    faces = 8 * np.arange(len(low))[:, None, None] + _SIDES
    return mesh(points.reshape(-1, 3), faces.reshape(-1, 3))


def sheet(x0: float, x1: float, y0: float, y1: float, z: float) -> Mesh:
    """A horizontal rectangle."""
    return quads(np.array([[(x0, y0, z), (x1, y0, z), (x1, y1, z), (x0, y1, z)]]))


def tube(path: Any, radii: Any, sides: int = 10) -> Mesh:
    """A round tube along `path` (n, 3) with a radius at each point, its ends closed by cones."""
    path = np.asarray(path, np.float64)
    radii = np.broadcast_to(np.asarray(radii, np.float64), len(path))
    along = np.gradient(path, axis=0)
    along /= np.linalg.norm(along, axis=1)[:, None]
    helper = np.eye(3)[np.argmin(np.abs(along).max(axis=0))]
    side = np.cross(along, helper)
    side /= np.linalg.norm(side, axis=1)[:, None]
    other = np.cross(along, side)
    turn = 2 * np.pi * np.arange(sides) / sides
    ring = (np.cos(turn)[None, :, None] * side[:, None]
            + np.sin(turn)[None, :, None] * other[:, None])
    points = path[:, None] + radii[:, None, None] * ring
    index = np.arange(len(path) * sides).reshape(len(path), sides)
    a, b = index[:-1], np.roll(index[:-1], -1, axis=1)
    c, d = np.roll(index[1:], -1, axis=1), index[1:]
    faces = [np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)]
    for tip, ring_index in ((index.size, index[0]), (index.size + 1, index[-1])):
        faces.append(np.stack([ring_index, np.roll(ring_index, -1), np.full(sides, tip)], -1))
    return mesh(np.concatenate([points.reshape(-1, 3), path[[0, -1]]]), np.concatenate(faces))


def pole(x: float, y: float, diameter: float, height: float, z: float = 0.0) -> Mesh:
    """A vertical round pole."""
    return tube([(x, y, z), (x, y, z + height)], diameter / 2, sides=16)


def wire(start: Any, end: Any, sag: float, diameter: float) -> Mesh:
    """A hanging wire."""
    s = np.linspace(0, 1, 25)[:, None]
    path = (1 - s) * np.asarray(start) + s * np.asarray(end)
    path[:, 2:] -= 4 * sag * s * (1 - s)
    return tube(path, diameter / 2, sides=6)


def _upright(rectangles: Array, y: Array | float) -> Array:
    """Rectangles (n, 4) of x0, x1, z0, z1 as upright quads (n, 4, 3) at depth y."""
    x0, x1, z0, z1 = rectangles.T
    y = np.broadcast_to(y, len(rectangles))
    return np.stack([np.stack([x0, y, z0], -1), np.stack([x1, y, z0], -1),
                     np.stack([x1, y, z1], -1), np.stack([x0, y, z1], -1)], axis=1)


def wall_with_holes(width: float, height: float, holes: Sequence[Rectangle],
                    depth: float) -> tuple[Mesh, Mesh]:
    """A wall in the plane y = 0, seen from −y, and what fills its holes `depth` behind.

    holes : rectangles x0, x1, z0, z1, not overlapping. Returns (wall with reveals, panes).
    """
    rects = np.array(holes, np.float64).reshape(-1, 4)
    xs = np.unique(np.concatenate([[0, width], rects[:, 0], rects[:, 1]]))
    zs = np.unique(np.concatenate([[0, height], rects[:, 2], rects[:, 3]]))
    cells = np.array([(a, b, c, d) for c, d in pairwise(zs) for a, b in pairwise(xs)])
    middle_x, middle_z = cells[:, :2].mean(axis=1), cells[:, 2:].mean(axis=1)
    open_cell = np.zeros(len(cells), bool)
    for x0, x1, z0, z1 in rects:
        open_cell |= (middle_x > x0) & (middle_x < x1) & (middle_z > z0) & (middle_z < z1)
    pieces = [_upright(cells[~open_cell], 0.0)]
    front, back = _upright(rects, 0.0), _upright(rects, depth)
    for k in range(4):
        m = (k + 1) % 4
        pieces.append(np.stack([front[:, k], front[:, m], back[:, m], back[:, k]], axis=1))
    return quads(np.concatenate(pieces)), quads(back)


def window_frames(holes: Sequence[Rectangle], depth: float, bar: float,
                  rows: int, columns: int) -> Mesh:
    """Frames with glazing bars for the holes of a wall: `rows` × `columns` panes each."""
    low, high = [], []
    for x0, x1, z0, z1 in holes:
        for i in range(columns + 1):
            x = x0 + (x1 - x0 - bar) * i / columns
            low.append((x, depth - 0.04, z0))
            high.append((x + bar, depth + 0.02, z1))
        for i in range(rows + 1):
            z = z0 + (z1 - z0 - bar) * i / rows
            low.append((x0, depth - 0.04, z))
            high.append((x1, depth + 0.02, z + bar))
    return box(low, high)


def sills(holes: Sequence[Rectangle], reach: float = 0.12) -> Mesh:
    """Window sills under the holes of a wall."""
    x0, x1, z0, _ = np.array(holes).T
    depth = np.ones(len(holes))
    return box(np.stack([x0 - 0.1, -reach * depth, z0 - 0.08], -1),
               np.stack([x1 + 0.1, 0.05 * depth, z0], -1))


def railing(x0: float, x1: float, reach: float, z: float) -> Mesh:
    """A balcony's railing of thin bars, `reach` before the wall y = 0, standing on z."""
    feet = [(x, -reach) for x in np.arange(x0, x1, 0.12)]
    feet += [(x, -y) for x in (x0, x1) for y in np.arange(0.05, reach + 0.01, 0.12)]
    low = np.array([(x - 0.008, y - 0.008, z) for x, y in feet])
    bars = box(low, np.add(low, (0.016, 0.016, 0.95)))
    rails = box([(x0, -reach - 0.02, z + 0.95), (x0 - 0.02, -reach, z + 0.95),
                 (x1 - 0.02, -reach, z + 0.95)],
                [(x1, -reach + 0.02, z + 1.0), (x0 + 0.02, 0, z + 1.0),
                 (x1 + 0.02, 0, z + 1.0)])
    return joined([bars, rails])


def gable_roof(length: float, depth: float, eaves: float, rise: float,
               overhang: float = 0.4) -> Mesh:
    """A saddle roof over [0, length] × [0, depth], its ridge along x."""
    x0, x1, y0, y1 = -overhang, length + overhang, -overhang, depth + overhang
    low, top, middle = eaves - rise * overhang / (depth / 2), eaves + rise, depth / 2
    slopes = quads(np.array([
        [(x0, y0, low), (x1, y0, low), (x1, middle, top), (x0, middle, top)],
        [(x1, y1, low), (x0, y1, low), (x0, middle, top), (x1, middle, top)]]))
    soffit = quads(slopes.vertices.reshape(2, 4, 3)[:, ::-1] - (0, 0, 0.15))
    return joined([slopes, soffit])


def gables(length: float, depth: float, eaves: float, rise: float) -> Mesh:
    """The two triangles that close a saddle roof."""
    points = [(x, y, z) for x in (0.0, length)
              for y, z in ((0.0, eaves), (depth, eaves), (depth / 2, eaves + rise))]
    return mesh(points, [(0, 1, 2), (3, 5, 4)])


def leaves(rng: np.random.Generator, centres: Array, size: float) -> Mesh:
    """A leaf, two triangles folded along its rib, at each of `centres` (n, 3); random poses."""
    n = len(centres)
    rib = rng.normal((0, 0, -0.4), 1, (n, 3))
    rib /= np.linalg.norm(rib, axis=1)[:, None]
    across = np.cross(rib, rng.normal(size=(n, 3)))
    across /= np.linalg.norm(across, axis=1)[:, None]
    fold = 0.25 * np.cross(rib, across)
    length = size * rng.uniform(0.7, 1.3, (n, 1))
    corners = np.stack([centres - rib * length / 2, centres + (across + fold) * length / 3,
                        centres + rib * length / 2, centres + (fold - across) * length / 3], 1)
    return quads(corners)


def tree(rng: np.random.Generator, height: float, crown: float, leaf: float,
         count: int) -> tuple[Mesh, Mesh]:
    """(Trunk and branches, leaves) of a tree at the origin; `crown` is the crown's radius.

    The leaves sit in clusters about the twigs, so that the crown has gaps of all sizes.
    """
    fork = height * rng.uniform(0.3, 0.4)
    lean = rng.normal(0, 0.25, 2)
    stem = np.array([(0, 0, 0), (*(0.3 * lean), fork * 0.5), (*lean, fork),
                     (*(1.4 * lean), height * 0.7)])
    thick = 0.035 * height
    wood = [tube(stem, thick * np.array([1.15, 0.9, 0.75, 0.3]), sides=12)]
    twigs = []
    for i in range(14):
        turn = 2.4 * i + rng.uniform(-0.4, 0.4)
        low = fork + (height * 0.7 - fork) * rng.uniform(0, 1) ** 1.3
        reach = crown * rng.uniform(0.55, 1.0)
        start = np.array([*(lean * low / fork), low])
        end = start + np.array([reach * np.cos(turn), reach * np.sin(turn),
                                rng.uniform(0.15, 0.95) * (height - low)])
        bend = (start + end) / 2 + rng.normal(0, 0.15, 3) - (0, 0, 0.1)
        wood.append(tube([start, bend, end], thick * np.array([0.4, 0.25, 0.07]), sides=6))
        twigs += [bend, end, (bend + end) / 2]
        for _ in range(3):
            twig = end + rng.normal(0, 0.28 * crown, 3)
            wood.append(tube([bend, (bend + twig) / 2 + rng.normal(0, .1, 3), twig],
                             thick * np.array([0.16, 0.1, 0.04]), sides=4))
            twigs += [twig, (bend + twig) / 2]
    pick = rng.integers(len(twigs), size=count)
    spread = 0.17 * crown * rng.uniform(0.5, 1.5, (len(twigs), 1))
    centres = np.array(twigs)[pick] + spread[pick] * rng.normal(size=(count, 3))
    return joined(wood), leaves(rng, centres[centres[:, 2] > 0.55 * fork], leaf)


def bush(rng: np.random.Generator, length: float, width: float, height: float, leaf: float,
         count: int) -> Mesh:
    """A clipped hedge of leaves from the origin along x."""
    centres = rng.uniform((0, -width / 2, 0), (length, width / 2, height), (count, 3))
    centres += rng.normal(0, 0.04, centres.shape)
    return leaves(rng, centres, leaf)


def rounded(length: float, width: float, height: float, power: float,
            sides: int = 40) -> Mesh:
    """A superellipsoid about the origin: a box with rounded edges, closed and smooth."""
    lat = np.linspace(-np.pi / 2, np.pi / 2, sides // 2 + 1)
    lon = np.linspace(0, 2 * np.pi, sides, endpoint=False)

    def wave(value: Array) -> Array:
        return np.sign(value) * np.abs(value) ** power

    a, b = np.meshgrid(lat, lon, indexing='ij')
    points = np.stack([length / 2 * wave(np.cos(a)) * wave(np.cos(b)),
                       width / 2 * wave(np.cos(a)) * wave(np.sin(b)),
                       height / 2 * wave(np.sin(a))], axis=-1)
    index = np.arange(a.size).reshape(a.shape)
    p, q = index[:-1], np.roll(index[:-1], -1, axis=1)
    r, s = np.roll(index[1:], -1, axis=1), index[1:]
    faces = np.concatenate([np.stack([p, q, r], -1).reshape(-1, 3),
                            np.stack([p, r, s], -1).reshape(-1, 3)])
    return mesh(points.reshape(-1, 3), faces)


def car(tall: float = 1.45) -> dict[str, Mesh]:
    """A parked car along x at the origin: body, glass, wheels and lights by name."""
    body = rounded(4.3, 1.76, 0.62, 0.32)
    body.vertices[:, 2] += 0.58
    cabin = rounded(2.5, 1.5, 1.1, 0.4)
    top = np.clip(cabin.vertices[:, 2] / 0.55, 0, 1)[:, None]
    cabin.vertices[:, :2] *= 1 - 0.18 * top
    cabin.vertices += (-0.2, 0.0, tall - 0.55)
    roof = rounded(1.75, 1.16, 0.12, 0.4)
    roof.vertices += (-0.2, 0.0, tall - 0.02)
    wheels = [tube([(x, y - 0.1, 0.31), (x, y + 0.1, 0.31)], 0.31, sides=24)
              for x in (-1.3, 1.3) for y in (-0.8, 0.8)]
    hubs = [tube([(x, y - 0.115, 0.31), (x, y + 0.115, 0.31)], 0.17, sides=10)
            for x in (-1.3, 1.3) for y in (-0.8, 0.8)]
    lights = [box((x - 0.04, y - 0.16, 0.62), (x + 0.04, y + 0.16, 0.74))
              for x in (-2.1, 2.1) for y in (-0.6, 0.6)]
    return {'body': joined([body, roof]), 'glass': cabin, 'tyre': joined(wheels),
            'hub': joined(hubs), 'lamp': joined(lights)}
