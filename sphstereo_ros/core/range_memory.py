"""What the frames before have told: range carried from frame to frame, with evidence.

The range of the frame before, moved by the relative pose, is compared with the new measurement.
Where they agree they are averaged and evidence grows; where nothing confirms it, evidence fades,
and what is contradicted goes at once or within a few frames. What is measured there but not
believed contradicts, too, if it is something else: a thing that came before what is remembered
looks like that. A pixel is published when enough frames bear it out.

Averaging makes sigma smaller only as far as errors differ: what is far has hardly moved in the
picture from frame to frame, so the same windows match it, and err alike.
"""
from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .beside import beside
from .floor import Floats, floor_plane, floor_seen
from .frames import FrameKey, Image8, Reference, RelativePose
from .history import PoseHistory
from .inverse_range import NOTHING, _grid_angles
from .jit import fast_kernel, kernel, rows_in_parallel
from .joint import Measurement, in_steps
from .judgement import Evidence
from .memory_judge import Opinions, judged, pixel_of
from .reliability import NEAR_BY
from .walls import walls_seen
from .warp import Map, _arctan2

_DOWN = np.array([0.0, 1.0, 0.0])
_MOST = 6.0  # evidence
_CONTRADICTED, _UNCONFIRMED, _UNTOLD = 2.0, 1.0, 0.3  # what a frame takes away of it
_DOUBTED = 3.0  # evidence is no more than that where the newest frame is not believed
_AGREES, _SAME = 3.0, 0.02  # standard deviations, or share of the inverse range
_CONFIRMS, _AGAIN, _BLIND = 0.3, 0.05, 0.05  # shares of it
_GROWTH = 1.25  # of sigma from frame to frame
_MOVES = 2.0  # px that something moves in the picture until the errors' correlation is an e-th
_ALIKE = 0.05  # of it that stays, however much moves: rims, mirrors and weak texture go along
_SURFACE = 2.0  # standard deviations: within, what moves to one pixel is one surface
_PUBLISHED = 2.0  # evidence that is enough
_UNSURE = 0.3  # of the range: with a larger sigma nothing is told to be near by


@dataclass(frozen=True)
class Remembered:
    """ρ (1/m), its σ (NOTHING where unknown), and evidence: float32 (H, 2H).

    chosen : whether a network chose ρ and σ, by their looks
    """

    rho: Map
    sigma: Map
    evidence: Map
    chosen: bool = False


@fast_kernel
def _place_rows(first: int, last: int, old_rho: Map, cos_lat: Map, sin_lat: Map, cos_lon: Map,
                sin_lon: Map, pose: Map, column: Map, row: Map, scale: Map,
                alike: Map) -> None:  # pragma: no cover - compiled
    """Where the current camera sees every pixel, its inverse range as a multiple, and how much the
    errors of both frames are alike there.
    """
    height, width = old_rho.shape
    per_move = np.float32(height / (np.pi * _MOVES))
    per_u, per_v = np.float32(width / (2 * np.pi)), np.float32(height / np.pi)
    left, top = np.float32(0.5 * width - 0.5), np.float32(0.5 * height - 0.5)
    for i in range(first, last):
        for j in range(width):
            r = old_rho[i, j]
            right, down, ahead = cos_lat[i] * sin_lon[j], -sin_lat[i], cos_lat[i] * cos_lon[j]
            a = pose[0, 0] * right + pose[0, 1] * down + pose[0, 2] * ahead
            b = pose[1, 0] * right + pose[1, 1] * down + pose[1, 2] * ahead
            c = pose[2, 0] * right + pose[2, 1] * down + pose[2, 2] * ahead
            x, y, z = a + r * pose[0, 3], b + r * pose[1, 3], c + r * pose[2, 3]
            level = x * x + z * z
            scale[i, j] = np.float32(1) / np.sqrt(level + y * y)
            across = (y * c - z * b)**2 + (z * a - x * c)**2 + (x * b - y * a)**2
            move = np.sqrt(across) * scale[i, j]  # rad; what rotation moves shows the same
            alike[i, j] = np.float32(_ALIKE) + np.float32(1 - _ALIKE) * np.exp(-move * per_move)
            column[i, j] = _arctan2(x, z) * per_u + left
            row[i, j] = _arctan2(y, np.sqrt(level)) * per_v + top


@kernel
def _splat(old: tuple[Map, ...], at_column: Map, at_row: Map, scale: Map,
           new: tuple[Map, ...]) -> None:  # pragma: no cover - compiled
    """Every known pixel to where it is seen. What is nearest hides the rest; of one surface, what
    is seen closest to the pixel's centre counts: the nearest would be what errs most.

    old, new : inverse range, its standard deviation, evidence, how much errors are alike
    """
    rho, sigma = new[0], new[1]
    height, width = rho.shape
    least, share = np.float32(0.2), np.zeros(rho.shape, np.float32)
    for i in range(height):
        for j in range(width):
            if old[1][i, j] >= NOTHING:
                continue
            per_n = scale[i, j]
            moved, spread = old[0][i, j] * per_n, old[1][i, j] * per_n * per_n
            u, v = at_column[i, j] + 1, at_row[i, j] + 1  # not negative
            u0, v0 = np.int32(u), np.int32(v)
            fu, fv = u - np.float32(u0), v - np.float32(v0)
            for dv in range(2):
                row = v0 + dv - 1
                if row < 0 or row >= height:
                    continue
                wv = fv if dv else 1 - fv
                for du in range(2):
                    here = wv * (fu if du else 1 - fu)
                    if here < least:
                        continue
                    column = u0 + du - 1
                    column = column + width if column < 0 else column
                    column = column - width if column >= width else column
                    nearer = moved - rho[row, column]
                    same = np.float32(_SURFACE) * min(spread, sigma[row, column])
                    if sigma[row, column] >= NOTHING or nearer > same or (
                            nearer > -same and here > share[row, column]):
                        rho[row, column], sigma[row, column] = moved, spread
                        new[2][row, column], new[3][row, column] = old[2][i, j], old[3][i, j]
                        share[row, column] = here


@kernel
def _doubted(level: float, found_again: bool, blind: bool,
             fade: float) -> np.float32:  # pragma: no cover - compiled
    """Evidence that is left where a frame is not believed.

    found_again : it measures the same nevertheless; blind : its grey tells nothing, so it
    contradicts nothing either
    """
    if blind:
        return np.float32(level - max(_UNTOLD, fade))
    loss = _UNCONFIRMED if found_again else _CONTRADICTED
    return np.float32(min(level, _DOUBTED) - max(loss, fade))


@kernel
def _update_rows(first: int, last: int, new_rho: Map, new_sigma: Map, told: Map, frames: Evidence,
                 fade: float, alike: Map, rho: Map, sigma: Map,
                 evidence: Map) -> None:  # pragma: no cover - compiled
    """The moved memory (rho, sigma, evidence) becomes the new one, pixel by pixel."""
    for i in range(first, last):
        for j in range(rho.shape[1]):
            measured, spread = new_rho[i, j], new_sigma[i, j]
            counts = np.float32(max(frames[i, j], 0)) if spread < NOTHING else np.float32(0)
            if sigma[i, j] >= NOTHING:
                rho[i, j] = measured if counts > 0 else np.float32(0)
                sigma[i, j] = spread if counts > 0 else np.float32(NOTHING)
                evidence[i, j] = counts
                continue
            old, before = rho[i, j], sigma[i, j] * np.float32(_GROWTH)
            level, s, off = evidence[i, j], before, abs(measured - old)
            same = off < max(_AGREES * np.sqrt(s * s + spread * spread), _SAME * old)
            again = off < max(np.float32(_AGAIN) * old, before)
            if same and (counts > 0 or again):
                w, w_new = 1 / (s * s), 1 / (spread * spread)
                rho[i, j] = (w * old + w_new * measured) / (w + w_new)
                ours, theirs = w * s / (w + w_new), w_new * spread / (w + w_new)
                s = np.sqrt(ours * ours + theirs * theirs + 2 * alike[i, j] * ours * theirs)
            # What could be anything confirms nothing.
            if same and counts > 0 and off < max(np.float32(_CONFIRMS) * old, 3 * before):
                level += counts
            elif counts > 0 and not same:
                level -= np.float32(max(_CONTRADICTED, fade))
                if measured > old:  # what is nearer counts at once
                    rho[i, j], s, level = measured, spread, counts
                elif level <= 0:  # what is farther has to wait, however plain it looks
                    rho[i, j], s, level = measured, spread, np.float32(1)
            else:
                blind = told[i, j] > np.float32(_BLIND) * max(old, measured)
                level = _doubted(level, again, blind, fade)
            evidence[i, j] = min(level, np.float32(_MOST))
            sigma[i, j] = s if level > 0 else np.float32(NOTHING)


class RangeMemory:
    """Fuses measurements over time.

    seconds : how long what nothing confirms is kept at most
    farthest : range, m, confidently beyond which all is told to be free, and has to be surer
    down : (3,) unit vector, the vehicle's, optical frame
    """

    def __init__(self, seconds: float, farthest: float = math.inf,
                 down: Floats = _DOWN) -> None:
        self._seconds = seconds
        self._farthest = farthest
        self._down = down
        self._history = PoseHistory()
        self._key: FrameKey | None = None
        self._kept: Remembered | None = None
        self._frames = 0
        self._metric = True

    def fused(self, key: FrameKey, references: tuple[Reference, ...], new: Measurement,
              vehicle: NDArray[np.bool_] | None = None,
              view: Image8 | None = None) -> Remembered:
        """Memory and the new measurement of frame `key` as one; it is the memory from now on.

        The result is what is likeliest by its looks, where `view`, the frame's grey, is given, the
        measurement tells what is `wider` round about, and something was remembered. Else it has
        only what enough frames bear out, and nothing near by (`NEAR_BY` baselines) that is
        uncertain.
        """
        metric = all(r.pose.is_metric for r in references)
        frames = new.frames if vehicle is None else np.where(vehicle, np.int8(0), new.frames)
        moved, alike = self._moved(key, references, metric, new.rho.shape)
        before = (moved.rho.copy(), moved.sigma.copy(), moved.evidence.copy(), alike)
        fade = self._fade(key)
        rows_in_parallel(_update_rows, len(new.rho), new.rho, new.sigma, new.told, frames, fade,
                         alike, moved.rho, moved.sigma, moved.evidence)
        self._key, self._kept, self._metric = key, moved, metric
        self._frames += 1
        baselines = [in_steps(r.pose).baseline for r in references]
        if view is not None and new.wider is not None and self._frames > 1:
            pixel = float(pixel_of(len(view), max(baselines)))
            likely = np.where(moved.sigma < NOTHING, moved.rho, new.rho)
            opinions = Opinions((new.rho, new.sigma, new.other, new.told), frames, before,
                                (moved.rho, moved.sigma, moved.evidence),
                                *self._surfaces(moved, pixel),
                                beside(likely, moved.sigma, view, pixel), new.pose, new.wider)
            return Remembered(*self._judged(view, opinions, references[0].pose.direction,
                                            (min(baselines), max(baselines))), moved.evidence,
                              chosen=True)
        enough = (moved.evidence >= min(self._frames, _PUBLISHED)) & (frames >= 0)
        near_by = moved.rho * np.float32(NEAR_BY * min(baselines)) > 1
        enough &= ~near_by | (moved.sigma < np.float32(_UNSURE) * moved.rho)
        return Remembered(moved.rho, np.where(enough, moved.sigma, np.float32(NOTHING)),
                          moved.evidence)

    def _surfaces(self, known: Remembered, pixel: float) -> tuple[Map, tuple[Map, Map]]:
        """The floor, and the walls and how much they carry; pixel : as of `walls_seen`."""
        plane = floor_plane(known.rho, known.sigma, self._down)
        floor = floor_seen(plane, len(known.rho))
        up = self._down if plane is None else plane / np.linalg.norm(plane)
        return floor, walls_seen(known.rho, known.sigma, floor, up, pixel)

    def _judged(self, view: Image8, opinions: Opinions, direction: Floats,
                baselines: tuple[float, float]) -> tuple[Map, Map]:
        """The likeliest inverse range and its sigma."""
        return judged(view, opinions, direction, baselines,
                      1 / self._farthest if self._metric else 0.0)

    def forget(self, where: NDArray[np.bool_]) -> None:
        """Keep nothing of these pixels of the newest frame."""
        if self._kept is not None:
            self._kept.sigma[where] = NOTHING
            self._kept.evidence[where] = 0

    def _fade(self, key: FrameKey) -> float:
        """What time alone takes of the evidence of one frame."""
        if self._key is None or self._seconds <= 0:
            return _MOST
        return _MOST * (key.stamp - self._key.stamp) * 1e-9 / self._seconds

    def _moved(self, key: FrameKey, references: tuple[Reference, ...], metric: bool,
               shape: tuple[int, ...]) -> tuple[Remembered, Map]:
        """What was kept, as the camera of frame `key` would see it, empty if that is unknown; and
        the correlation of its errors with those of that frame.
        """
        empty = Remembered(np.zeros(shape, np.float32), np.full(shape, NOTHING, np.float32),
                           np.zeros(shape, np.float32))
        likeness = np.ones(shape, np.float32)
        if metric != self._metric:  # poses in metres and in steps make no chain
            self._history = PoseHistory()
        self._history.begin(key)
        for reference in references:
            self._history.add(key, reference.frame.key, in_steps(reference.pose))
        pose = self._pose_of_kept(key)
        if pose is None or self._kept is None or self._kept.rho.shape != shape or (
                metric != self._metric):
            self._frames = 0
            return empty, likeness
        placed = np.column_stack([pose.rotation, pose.position]).astype(np.float32)
        kept = self._kept
        column, row, scale, alike = (np.empty(shape, np.float32) for _ in range(4))
        rows_in_parallel(_place_rows, shape[0], kept.rho, *_grid_angles(shape[0]), placed, column,
                         row, scale, alike)
        _splat((kept.rho, kept.sigma, kept.evidence, alike), column, row, scale,
               (empty.rho, empty.sigma, empty.evidence, likeness))
        return empty, likeness

    def _pose_of_kept(self, key: FrameKey) -> RelativePose | None:
        if self._key is None or key <= self._key or (
                key.frame_id != self._key.frame_id
                or (key.stamp - self._key.stamp) * 1e-9 > self._seconds):
            return None
        return self._history.between(self._key, key)
