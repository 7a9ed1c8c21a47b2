"""The track of the camera from its windows: every frame's pose, at one scale all along.

A new frame is placed by the references that have a place already, then the newest frames are
adjusted together. Where no sensor measures how far the camera went, every window has its own
scale: the ratio of its baselines, told by the ranges of what its references share, ties it to the
windows before.
"""
from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from . import rotations
from .frames import AlignedWindow, Drop, FrameKey, RelativePose
from .joint import in_steps
from .pose_graph import Edges, Floats, Poses, Priors, optimised, whitening

# Frames that are adjusted when a new one comes: more than the farthest usual reference.
_ADJUSTED, _ITERATIONS = 24, 2
# Standard deviations that no covariance of a relative pose tells: of a rotation, rad; across, and
# along, as a share of the baseline; of any position, m; and along where lengths are assumed, of
# the nearest reference and of others.
_TURN, _ACROSS, _ALONG, _PLACE = 5e-5, 3e-4, 3e-3, 1e-3
_ALONG_NEAREST, _ALONG_FARTHER = 0.01, 0.004
_SCALE = 0.4  # of log scale, where lengths are assumed: speed varies by so much
_MOST_CHANGE = 2.0  # of the scale from one window to the next


@dataclass(frozen=True)
class TrackedFrame:
    """Where a frame was taken.

    rotation : (3, 3) map ← camera_optical; position : (3,) metres, map
    scale : metres in a unit of its window's positions and ranges; 1 where these are metres
    """

    key: FrameKey
    rotation: Floats
    position: Floats
    scale: float = 1.0


class Track:
    """Places frames one after the other.

    first : pose of the first frame in the map
    free_scales : whether windows' lengths are assumed, so that each has a scale of its own
    believed : whether the assumed lengths are right on average
    keep : so many frames are remembered, at least; 0 = all
    """

    def __init__(self, first: RelativePose, free_scales: bool = False, believed: bool = True,
                 keep: int = 0) -> None:
        self._first, self._free, self._keep = first, free_scales, keep
        self._believed = believed
        self._keys: list[FrameKey] = []
        self._poses = Poses(np.zeros((0, 3, 3)), np.zeros((0, 3)), np.zeros(0))
        self._edges: list[tuple[int, int, RelativePose, Floats]] = []
        self._scales: dict[int, tuple[float, float]] = {}
        self._index: dict[FrameKey, int] = {}
        self._newest: FrameKey | None = None

    def __len__(self) -> int:
        return len(self._keys)

    def __contains__(self, key: FrameKey) -> bool:
        return key in self._index

    def __getitem__(self, key: FrameKey) -> TrackedFrame:
        return self._frame(self._index[key])

    @property
    def frames(self) -> list[TrackedFrame]:
        """All frames that are remembered, in order of time."""
        return sorted((self._frame(n) for n in range(len(self))), key=lambda f: f.key)

    def _frame(self, n: int) -> TrackedFrame:
        poses = self._poses
        return TrackedFrame(self._keys[n], poses.rotations[n], poses.positions[n],
                            math.exp(poses.log_scales[n]))

    def add(self, window: AlignedWindow, link: RelativePose | None = None,
            scale: tuple[float, float] | None = None) -> TrackedFrame | Drop:
        """Place the current frame, and those of its references that have no place yet.

        Parameters
        ----------
        window : of one camera; references of another are left out
        link : pose of the newest frame of the track in the current one, metres: used where no
            reference has a place
        scale : that of the window, if it is known, and the standard deviation of its logarithm

        Returns
        -------
        Drops: `stamp_backward`; `track_lost`, where nothing tells the place

        """
        key = window.current.key
        if self._newest is not None and key.stamp <= self._newest.stamp:
            return Drop('stamp_backward', f'{key.stamp} after {self._newest.stamp}')
        references = [(r.frame.key, in_steps(r.pose)) for r in window.references
                      if not r.is_beside(window.current)]
        log_scale = math.log(scale[0]) if scale else None
        if not self._keys and references:
            self._append(references[0][0], self._first.rotation, self._first.position,
                         log_scale or 0.0)
        known = [(self._index[k], pose) for k, pose in references if k in self._index]
        if known:
            self._place(key, known, log_scale)
        elif link is not None and self._newest is not None:
            self._append_linked(key, link, self._index[self._newest], log_scale)
        else:
            return Drop('track_lost', f'{len(references)} references, none with a place')
        current = self._index[key]
        if scale is not None and self._free:
            self._scales[current] = math.log(scale[0]), scale[1]
        self._place_others(current, references)
        self._adjust(len(self) - _ADJUSTED, _ITERATIONS)
        self._newest = key
        placed = self._frame(current)
        self._forget()
        return placed

    def adjust_all(self, iterations: int = 8) -> None:
        """Adjust all frames together."""
        self._adjust(0, iterations)

    def _append(self, key: FrameKey, rotation: Floats, position: Floats, log_scale: float) -> None:
        self._index[key] = len(self._keys)
        self._keys.append(key)
        poses = self._poses
        self._poses = Poses(np.concatenate([poses.rotations, rotation[None]]),
                            np.concatenate([poses.positions, position[None]]),
                            np.append(poses.log_scales, log_scale))

    def _append_linked(self, key: FrameKey, link: RelativePose, before: int,
                       log_scale: float | None) -> None:
        """A pose behind a gap: its window's scale is that of the last one, until more is known."""
        last = self._frame(before)
        rotation = last.rotation @ link.rotation.T
        self._append(key, rotation, last.position - rotation @ link.position,
                     self._poses.log_scales[before] if log_scale is None else log_scale)
        scale = math.exp(self._poses.log_scales[-1])
        unit = RelativePose(link.rotation, link.position / scale, link.covariance)
        self._edges.append((len(self) - 1, before, unit, self._whitening(unit, True)))

    def _place_others(self, current: int, references: list[tuple[FrameKey, RelativePose]]) -> None:
        """Where windows were left out, their frames are only references: they hold the track
        together.
        """
        placed = self._frame(current)
        for key, pose in references:
            if key in self._index:
                continue
            self._append(key, placed.rotation @ pose.rotation, placed.position
                         + placed.scale * placed.rotation @ pose.position,
                         math.log(placed.scale))
            self._edges.append((current, len(self) - 1, pose, self._whitening(pose, False)))

    def _place(self, key: FrameKey, known: list[tuple[int, RelativePose]],
               log_scale: float | None) -> None:
        """A first pose: turned as the reference tells that most agree with, placed by all."""
        poses = self._poses
        rotation = _middle([poses.rotations[n] @ pose.rotation.T for n, pose in known])
        there = np.stack([poses.positions[n] for n, _ in known])
        way = np.stack([rotation @ p.position for _, p in known])
        before = -1 if self._newest is None else self._index[self._newest]
        chosen = float(poses.log_scales[before]) if log_scale is None else log_scale
        if self._free and len(known) > 1:
            a, b = way - way.mean(axis=0), there - there.mean(axis=0)
            told = float((a * b).sum() / max((a * a).sum(), 1e-12))
            if abs(math.log(max(told, 1e-12)) - chosen) < math.log(_MOST_CHANGE):
                chosen = math.log(told)
        position = np.median(there - math.exp(chosen) * way, axis=0)
        self._append(key, rotation, position, chosen if self._free else 0.0)
        nearest = min(p.baseline for _, p in known)
        for n, each in known:
            self._edges.append((len(self) - 1, n, each, self._whitening(
                each, each.baseline <= 1.01 * nearest)))

    def _whitening(self, pose: RelativePose, is_nearest: bool) -> Floats:
        along = pose.direction
        share = _ALONG
        if self._free:
            share = _ALONG_NEAREST if is_nearest else _ALONG_FARTHER
        covariance = np.zeros((6, 6)) if pose.covariance is None else pose.covariance.copy()
        covariance[:3, :3] += _TURN**2 * np.eye(3)
        covariance[3:, 3:] += (pose.baseline * _ACROSS)**2 * np.eye(3)
        covariance[3:, 3:] += (pose.baseline * share)**2 * np.outer(along, along)
        if not self._free:  # a unit is a metre
            covariance[3:, 3:] += _PLACE**2 * np.eye(3)
        return whitening(covariance)

    def _adjust(self, first: int, iterations: int) -> None:
        """Adjust the frames from `first` on; what they refer to before that is held."""
        first = max(first, 0)
        chosen = [e for e in self._edges if e[0] >= first and e[1] >= 0]
        if not chosen:
            return
        oldest = min(first, *(e[1] for e in chosen))
        part = slice(oldest, len(self))
        start = Poses(self._poses.rotations[part], self._poses.positions[part],
                      self._poses.log_scales[part])
        edges = Edges(np.array([e[0] - oldest for e in chosen]),
                      np.array([e[1] - oldest for e in chosen]),
                      np.stack([e[2].rotation for e in chosen]),
                      np.stack([e[2].position for e in chosen]),
                      np.stack([e[3] for e in chosen]))
        found = optimised(start, edges, self._priors(oldest), max(first - oldest, 1), self._free,
                          iterations)
        for whole, new in ((self._poses.rotations, found.rotations),
                           (self._poses.positions, found.positions),
                           (self._poses.log_scales, found.log_scales)):
            whole[part] = new

    def _priors(self, oldest: int) -> Priors:
        priors = Priors(*np.full((2, len(self) - oldest), np.nan))
        if self._free and self._believed:
            priors.log_scale[:], priors.log_scale_sigma[:] = 0.0, _SCALE
        for n, (value, sigma) in self._scales.items():
            if n >= oldest:
                priors.log_scale[n - oldest], priors.log_scale_sigma[n - oldest] = value, sigma
        return priors

    def _forget(self) -> None:
        """Once twice as many are there as are to be kept, the older half goes."""
        count = len(self) - self._keep
        if not self._keep or count < self._keep:
            return
        self._keys = self._keys[count:]
        self._index = {key: n for n, key in enumerate(self._keys)}
        self._poses = Poses(*(values[count:] for values in (
            self._poses.rotations, self._poses.positions, self._poses.log_scales)))
        self._edges = [(i - count, k - count, pose, white) for i, k, pose, white in self._edges
                       if k >= count]
        self._scales = {n - count: value for n, value in self._scales.items() if n >= count}


def _middle(candidates: list[Floats]) -> Floats:
    """The rotation that is nearest to the others."""
    apart = [sum(rotations.angle(a.T @ b) for b in candidates) for a in candidates]
    return candidates[int(np.argmin(apart))]
