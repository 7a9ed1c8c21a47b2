"""How far a range image is from the truth: by range, by angle from the motion, where it matters.

All shares are in percent.
"""
from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import lru_cache
from itertools import pairwise
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from sphstereo_ros.core.camera import Equirectangular

BANDS = ((0.0, 10.0), (10.0, 30.0), (30.0, 100.0))
# Finer steps of range for plots (m), and multiples of sigma for its calibration.
RANGE_STEPS = (0.5, 1.0, 1.5, 2.0, 3.0, 4.5, 6.5, 10.0, 14.0, 20.0, 30.0, 45.0, 65.0, 100.0)
SIGMAS = (0.5, 1.0, 1.5, 2.0, 3.0)
# Degrees from the nearer pole of motion, and the range at which the cone is judged (m).
CONE_STEPS = (0.0, 2.0, 4.0, 8.0, 16.0, 30.0, 90.0)
AT_20 = (15.0, 25.0)
# What a vehicle drives at: so far ahead, inside and outside of this angle.
AT_40, WALL_ANGLES = (35.0, 45.0), (0.0, 3.0, 10.0)
# Reported so many times too far is as good as free.
FREE, FARTHER, NEAR = 1.5, 1.1, 10.0

Range = NDArray[np.floating]
Mask = NDArray[np.bool_]


def solid_angle(height: int) -> NDArray[np.float64]:
    """Weight of each row of an equirectangular image, (height, 1): cosine of its latitude."""
    return np.asarray(np.cos((0.5 - (np.arange(height) + 0.5) / height) * np.pi)[:, None])


def compare(measured: Range, truth: Range, sigma: Range | None = None,
            mask: NDArray[np.uint8] | None = None, *,
            direction: NDArray[np.float64] | None = None, moving: Mask | None = None,
            marked: Mask | None = None) -> dict[str, Any]:
    """Score a range image (H, 2H) against the true range (any size; the nearest pixel counts).

    Parameters
    ----------
    measured : metres; NaN unknown, ±Inf as published
    truth : metres; +Inf is sky
    sigma : standard deviation of `measured`, for its calibration
    mask : (H, 2H), non-zero = not counted
    direction : (3,) unit vector of the motion, optical frame; for the figures by angle
    moving : of `truth`'s size, what moves by itself: its own figures, and not in the bands
    marked : (H, 2H), what was reported as moving

    Returns
    -------
    For each band `'lo-hi'`: `coverage` (of its solid angle, with a finite range), `median`
    (relative error), `bad` (pixels with an error over 10 %), and `within_{k}_sigma`.
    `danger`: of the solid angle nearer than 10 m, reported over 1.5 times too far, or +Inf.
    `ghost`: of the sky, reported nearer than 10 m.
    `by_range`: in fine steps of range the group's `share` of the sphere, coverage, median, what
    is `unknown` (NaN), and what is `free` (over 1.5 times too far, or +Inf).
    `cone`: the same `ahead` and `behind`, by degrees from the motion, at 20 m and at `all` ranges.
    `ahead_at_40m`: the same inside and outside of 3°. `moving`: `farther` (by over 10 %),
    `much_farther` (1.5 times), `unknown`, how much of it was `marked`, and of the rest falsely.
    None where there is nothing to score.

    """
    view = _View(measured, truth, sigma, mask)
    moves = _like(moving, view.truth.shape) if moving is not None else None
    still = view.counted if moves is None else view.counted & ~moves
    scores: dict[str, Any] = {}
    for low, high in BANDS:
        scores[f'{low:g}-{high:g}'] = view.band(still & view.between(low, high))
    near, sky = view.counted & (view.truth < NEAR), view.counted & np.isposinf(view.truth)
    scores['danger'] = view.share(near & view.too_far(FREE), near)
    scores['ghost'] = view.share(sky & view.found & (view.measured < NEAR), sky)
    scores['by_range'] = {f'{low:g}-{high:g}': view.group(still & view.between(low, high))
                          for low, high in pairwise(RANGE_STEPS)}
    if direction is not None:
        scores.update(_by_angle(view, still, direction))
    if moves is not None and (moves & view.counted).any():
        scores['moving'] = _of_moving(view, moves & view.counted, still, marked)
    return scores


def _by_angle(view: _View, still: Mask, direction: NDArray[np.float64]) -> dict[str, Any]:
    angle = _angle(view.truth.shape[0], tuple(float(d) for d in direction))
    cone: dict[str, Any] = {}
    for side, from_pole in (('ahead', angle), ('behind', 180 - angle)):
        cone[side] = {name: {'at_20m': view.group(inside & view.between(*AT_20)),
                             'all': view.group(inside & np.isfinite(view.truth))}
                      for name, inside in _steps(from_pole, still, CONE_STEPS)}
    at_40 = still & view.between(*AT_40)
    return {'cone': cone,
            'ahead_at_40m': {name: view.group(inside)
                             for name, inside in _steps(angle, at_40, WALL_ANGLES)}}


def _steps(angle: Range, of: Mask, edges: Sequence[float]) -> Iterator[tuple[str, Mask]]:
    for low, high in pairwise(edges):
        yield f'{low:g}-{high:g}', of & (angle >= low) & (angle < high)


def _of_moving(view: _View, moves: Mask, still: Mask, marked: Mask | None) -> dict[str, Any]:
    scores = {'share': view.share(moves, np.ones_like(moves)),
              'farther': view.share(moves & view.too_far(FARTHER), moves),
              'much_farther': view.share(moves & view.too_far(FREE), moves),
              'unknown': view.share(moves & np.isnan(view.measured), moves)}
    if marked is not None:
        scores['marked'] = view.share(moves & (marked != 0), moves)
        scores['falsely_marked'] = view.share(still & (marked != 0), still)
    return scores


class _View:
    """A measured and a true range image of one size, and their differences."""

    def __init__(self, measured: Range, truth: Range, sigma: Range | None,
                 mask: NDArray[np.uint8] | None) -> None:
        self.measured = measured
        self.truth = _like(truth.astype(np.float32), measured.shape)
        self.weight = np.broadcast_to(solid_angle(len(measured)), measured.shape)
        self.counted: Mask = np.ones(measured.shape, bool) if mask is None else mask == 0
        self.found: Mask = np.isfinite(measured) & (measured > 0)
        with np.errstate(invalid='ignore', divide='ignore'):
            error = np.abs(measured - self.truth)
            self._relative = 100 * error / self.truth
            self._deviation = None if sigma is None else error / sigma

    def between(self, low: float, high: float) -> Mask:
        """Where the truth lies in (low, high] metres."""
        return np.asarray((self.truth > low) & (self.truth <= high))

    def too_far(self, times: float) -> Mask:
        """Where the range reported is over `times` the true one, or +Inf."""
        far = self.found & (self.measured > times * self.truth)
        return np.asarray(far | np.isposinf(self.measured) & np.isfinite(self.truth))

    def share(self, part: Mask, whole: Mask) -> float | None:
        """Of the solid angle of `whole`."""
        total = float(self.weight[whole].sum())
        return 100 * float(self.weight[part].sum()) / total if total > 0 else None

    def band(self, inside: Mask) -> dict[str, float | None]:
        """Figures of a band, errors by pixels."""
        found = inside & self.found
        scores: dict[str, float | None] = {'coverage': self.share(found, inside),
                                           'median': None, 'bad': None}
        if found.any():
            relative = self._relative[found]
            scores['median'] = float(np.median(relative))
            scores['bad'] = 100 * float((relative > 10).mean())
            if self._deviation is not None:
                deviation = self._deviation[found]
                for k in SIGMAS:
                    scores[f'within_{k:g}_sigma'] = 100 * float((deviation < k).mean())
        return scores

    def group(self, inside: Mask) -> dict[str, float | None]:
        """Figures of a group that may be small: with its share of the sphere, by solid angle."""
        found = inside & self.found
        return {'share': self.share(inside, np.ones_like(inside)),
                'coverage': self.share(found, inside),
                'median': weighted_median(self._relative[found], self.weight[found]),
                'unknown': self.share(inside & np.isnan(self.measured), inside),
                'free': self.share(inside & self.too_far(FREE), inside)}


def _like(image: NDArray[Any], shape: tuple[int, ...]) -> NDArray[Any]:
    if image.shape == shape:
        return image
    smaller = cv2.resize(image.astype(np.float32), shape[::-1], interpolation=cv2.INTER_NEAREST)
    return np.asarray(smaller, image.dtype)


@lru_cache(maxsize=4)
def _angle(height: int, direction: tuple[float, float, float]) -> NDArray[np.float64]:
    """Degrees (H, 2H) from `direction`."""
    along = Equirectangular(height, 2 * height).bearings() @ np.asarray(direction)
    return np.asarray(np.degrees(np.arccos(np.clip(along, -1, 1))))


def weighted_median(values: Range, weights: Range) -> float | None:
    """The value below which half of the weight lies; None without values."""
    if not values.size:
        return None
    order = np.argsort(values)
    sums = np.cumsum(weights[order])
    return float(values[order[np.searchsorted(sums, sums[-1] / 2)]])


def average(scores: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Mean of each figure over the scores that have it; None where none has.

    A group that tells its share of the sphere counts by it: where a frame sees little of it, its
    figures mean little.
    """
    out: dict[str, Any] = {}
    for name in dict.fromkeys(name for score in scores for name in score):
        having = [s for s in scores if s.get(name) is not None]
        if having and isinstance(having[0][name], Mapping):
            out[name] = average([s[name] for s in having])
            continue
        weights = [1.0 if name == 'share' else s.get('share', 1.0) for s in having]
        out[name] = (float(np.average([s[name] for s in having], weights=weights))
                     if sum(weights) > 0 else None)
    return out
