"""Fusion of points into voxels: weighted means, in bounded memory.

A point goes into a voxel that fits how uncertain it is: the finest edge is doubled until it is no
less than a quarter of the point's standard deviation. Voxels lie in a hash table of fixed size
(open addressing). When it holds as many as are allowed, those that one frame saw are dropped;
where that is not enough, or these are the most, the finest edge is doubled and all is put anew.
"""
from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .jit import kernel

Map32 = NDArray[np.float32]
Keys = NDArray[np.int64]
Bytes = NDArray[np.uint8]
Counts = NDArray[np.uint16]

LEVELS = 6
_FINENESS = 4.0  # edges in a standard deviation, at most
_EMPTY = -1
_BITS = 20  # of each index: ± 500,000 voxels
_HALF = 1 << (_BITS - 1)
_FILLED = 0.6  # of the table at most
_AFTER = 0.75  # of the voxels that are allowed: so many are left when room was made
# What is kept of a voxel: points, weight Σ 1/σ², weighted offset from its centre in edges (3),
# weighted colour (3).
_SUMS = 8


@dataclass(frozen=True)
class VoxelPoints:
    """Weighted means of N voxels.

    xyz : (N, 3) float32 metres; bgr : (N, 3) uint8; frames : (N,) uint16, how many saw it;
    points : (N,) float32, how many were fused, of the sum of 1/σ² `weight`; level : (N,) uint8,
    0 = the finest `edge` (m), doubled that often
    """

    xyz: Map32
    bgr: Bytes
    frames: Counts
    points: Map32
    weight: Map32
    level: Bytes
    edge: float

    def __len__(self) -> int:
        return len(self.xyz)

    @property
    def sigma(self) -> Map32:
        """Standard deviation of a typical point, metres: errors of consecutive frames are alike,
        so none is claimed to average out.
        """
        return np.asarray(np.sqrt(self.points / self.weight), np.float32)

    def chosen(self, which: NDArray[np.bool_] | NDArray[np.intp]) -> VoxelPoints:
        """Those that are chosen."""
        return VoxelPoints(self.xyz[which], self.bgr[which], self.frames[which],
                           self.points[which], self.weight[which], self.level[which],
                           self.edge)

    def finest(self) -> VoxelPoints:
        """Without those in whose cube a finer one lies: what was seen sharply needs no more."""
        kept = np.ones(len(self), bool)
        for level in range(1, LEVELS):
            finer, these = self.level < level, np.nonzero(self.level == level)[0]
            cells = np.floor(self.xyz / np.float32(self.edge * (1 << level))).astype(np.int64)
            keys = ((cells[:, 0] << (2 * _BITS)) + (cells[:, 1] << _BITS)) + cells[:, 2]
            kept[these] = ~np.isin(keys[these], keys[finer])
        return self.chosen(kept)

    def moved(self, rotation: NDArray[np.float64], position: NDArray[np.float64],
              scale: float) -> VoxelPoints:
        """All at scale · R · x + p."""
        xyz = scale * (self.xyz.astype(np.float64) @ rotation.T) + position
        return VoxelPoints(xyz.astype(np.float32), self.bgr, self.frames, self.points,
                           self.weight / np.float32(scale * scale), self.level, scale * self.edge)


@kernel
def _slot(keys: Keys, key: int) -> Any:  # pragma: no cover - compiled
    """Where `key` is, or is to be put."""
    mask = keys.size - 1
    mixed = key * np.int64(0x1E3779B97F4A7C15)
    at = (mixed ^ (mixed >> np.int64(29))) & mask
    while keys[at] != _EMPTY and keys[at] != key:
        at = (at + 1) & mask
    return at


@kernel
def _add(first: int, xyz: Map32, sigma: Map32, bgr: Bytes, points: Map32, weights: Map32,
         seen: Counts, levels: Bytes, frame: int, edge: float, room: int, keys: Keys, sums: Map32,
         frames: Counts, newest: NDArray[np.int32],
         state: NDArray[np.int64]) -> int:  # pragma: no cover - compiled
    """Add points from number `first`; returns the number of the first that had no room.

    frame : a voxel counts it once; −1 where points stand for several frames
    state : voxels there are; points out of reach
    """
    for n in range(first, xyz.shape[0]):
        level = int(levels[n])
        size = edge * (1 << level)
        while level < LEVELS - 1 and _FINENESS * size < sigma[n]:
            level, size = level + 1, 2 * size
        x, y, z = xyz[n, 0] / size, xyz[n, 1] / size, xyz[n, 2] / size
        if not max(abs(x), abs(y), abs(z)) < _HALF - 1:
            state[1] += 1
            continue
        i, j, k = int(np.floor(x)), int(np.floor(y)), int(np.floor(z))
        key = ((level << (3 * _BITS)) | ((i + _HALF) << (2 * _BITS)) | ((j + _HALF) << _BITS)
               | (k + _HALF))
        at = _slot(keys, key)
        if keys[at] == _EMPTY:
            if state[0] >= room:
                return n
            state[0] += 1
            keys[at] = key
        weight = weights[n]
        sums[at, 0] += points[n]
        sums[at, 1] += weight
        sums[at, 2] += weight * (x - i - 0.5)
        sums[at, 3] += weight * (y - j - 0.5)
        sums[at, 4] += weight * (z - k - 0.5)
        for c in range(3):
            sums[at, 5 + c] += weight * bgr[n, c]
        if frame < 0 or newest[at] != frame:
            newest[at] = frame
            frames[at] = min(int(frames[at]) + int(seen[n]), 65535)
    return int(xyz.shape[0])


@kernel
def _read(keys: Keys, sums: Map32, frames: Counts, edge: float, xyz: Map32, bgr: Bytes,
          seen: Counts, points: Map32, weights: Map32,
          levels: Bytes) -> None:  # pragma: no cover - compiled
    count, mask = 0, (1 << _BITS) - 1
    for at in range(keys.size):
        key = keys[at]
        if key == _EMPTY:
            continue
        level = key >> (3 * _BITS)
        size, weight = edge * (1 << level), sums[at, 1]
        for axis in range(3):
            index = ((key >> ((2 - axis) * _BITS)) & mask) - _HALF
            xyz[count, axis] = (index + 0.5 + sums[at, 2 + axis] / weight) * size
            bgr[count, axis] = np.uint8(sums[at, 5 + axis] / weight + 0.5)
        points[count], weights[count] = sums[at, 0], weight
        seen[count], levels[count] = frames[at], level
        count += 1


class VoxelMap:
    """Voxels of the finest edge `edge` (m), or larger ones, at most `most` of them."""

    def __init__(self, edge: float, most: int) -> None:
        self.edge, self._most = edge, most
        self.out_of_reach = 0
        self._clear()

    def __len__(self) -> int:
        return int(self._state[0])

    def _clear(self) -> None:
        slots = 1 << int(np.ceil(np.log2(self._most / _FILLED)))
        self._keys = np.full(slots, _EMPTY, np.int64)
        self._sums = np.zeros((slots, _SUMS), np.float32)
        self._frames = np.zeros(slots, np.uint16)
        self._newest = np.full(slots, -1, np.int32)
        self._state = np.zeros(2, np.int64)

    def add(self, xyz: Map32, sigma: Map32, bgr: Bytes, frame: int) -> None:
        """Fuse the points of one frame.

        xyz : (N, 3) float32 metres; sigma : (N,) float32 metres, not 0; bgr : (N, 3) uint8
        frame : its number
        """
        one = np.ones(len(xyz), np.float32)
        self._fuse(VoxelPoints(xyz, bgr, one.astype(np.uint16), one,
                               np.float32(1) / (sigma * sigma),
                               np.zeros(len(xyz), np.uint8), self.edge), frame)

    def add_voxels(self, points: VoxelPoints) -> None:
        """Fuse what another map holds."""
        self._fuse(points, -1)

    def _fuse(self, given: VoxelPoints, frame: int) -> None:
        sigma, first = given.sigma, 0
        while True:
            first = _add(first, given.xyz, sigma, given.bgr, given.points, given.weight,
                         given.frames, given.level, frame, self.edge, self._most, self._keys,
                         self._sums, self._frames, self._newest, self._state)
            if first == len(given):
                break
            self._make_room()
        self.out_of_reach = int(self._state[1])

    def _make_room(self) -> None:
        """Free a quarter of the room, at least."""
        lost, held = self._state[1], self.points()
        again = held.frames > 1
        if 2 * np.count_nonzero(again) >= len(held):
            held = held.chosen(again)
        while len(held) > _AFTER * self._most:
            self.edge *= 2
            self._clear()
            self._fuse(replace(held, level=np.maximum(held.level, 1) - np.uint8(1),
                               edge=self.edge), -1)
            held = self.points()
        self._clear()
        self._fuse(held, -1)
        self._state[1] += lost

    def points(self) -> VoxelPoints:
        """All voxels, in the order of the table."""
        count = len(self)
        out = VoxelPoints(np.empty((count, 3), np.float32), np.empty((count, 3), np.uint8),
                          np.empty(count, np.uint16), np.empty(count, np.float32),
                          np.empty(count, np.float32), np.empty(count, np.uint8), self.edge)
        _read(self._keys, self._sums, self._frames, self.edge, out.xyz, out.bgr, out.frames,
              out.points, out.weight, out.level)
        return out
