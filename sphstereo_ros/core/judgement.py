"""What was found on a polar grid, and how far it is believed: by its looks, or by agreement."""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from .alternatives import Alternatives
from .frames import Image8
from .jit import fast_kernel, rows_in_parallel
from .match_judge import CONTRADICTS, likely_error, shows_the_same
from .matching import Parallax
from .refinement import Refined
from .reliability import LEAST, NEAR_BY, expected_error, look, may_be_near, network, percentiles
from .surroundings import inputs, judged, likeliest
from .sweep import reduction
from .warp import Map, PolarGrid, _arctan2

Evidence = NDArray[np.int8]
WIDER = 7  # maps of `Judged.wider`

MISFIT = 150.0  # squared grey levels, beyond which no reference shows the same
# Of the unit: a likely error with which something counts as measured, by what pixels tell
# themselves, and together with what is round about.
_SURE, _SURE_BOTH = 0.8, 0.6
_PLAIN = 0.3  # of the unit: with a smaller likely error it counts for two frames
# Of the unit: what may be nearer by more is not sure, and by still more, what was remembered there
# is not believed either.
_NEARER, _VEILED = 0.6, 1.2
_TAIL = 0.75  # of what is published
# What is completed counts with such a likely error, in its unit, where what was measured is less
# likely, and differs by such a share; not where the nearest reference shows something else, or has
# fewer px of parallax: it shows the same then whatever is there; nor where less than such a share
# of what is round about (of the grid's height) is sure.
_SURE_COMPLETED, _DIFFERS, _SHOWS = 0.3, 0.03, 1.0
# Where nothing may be nearer by more units than that, the nearest reference may differ by so many
# grey levels, and it is enough that the farthest has so many px of parallax.
_PLAINLY, _CONTRADICTS, _SHOWS_FARTHEST = 0.4, 15.0, 4.0
_AMID, _ROUND = 0.15, 1 / 15
# Opinions are the same within a share of the inverse range, or so many pixels at the sweep's size;
# and refinement may move what was matched by so many pixels.
_AGREES, _LEVELS, _SLACK = 0.05, 0.75, 1.5
DEPENDENT = 4.0  # times the noise: differences in grey within a window are not independent
_FLOOR = 0.17  # px: no match beats that


@dataclass(frozen=True)
class Found:
    """What is known of a window on its polar grid, before it is judged; m are units of the poses,
    in a `JointMatcher` nearest baselines.

    view : the current view; now, before : it and the nearest reference's, in one light; refined :
    the measurement; other : second opinion, 1/m; matched, parallax : what the nearest pair's
    matcher found, 1/m and px
    """

    view: Image8
    now: Image8
    before: Image8
    refined: Refined
    other: Map
    matched: Map
    parallax: Parallax


@dataclass(frozen=True)
class Judged:
    """Inverse range, second opinion and likely error (1/m) on the polar grid.

    frames : for how many frames of evidence it counts; 0 = it is not believed, −1 = nor should
    be what is remembered there
    floor : px that no match beats, if the error does not tell them
    wider : float32 (WIDER, …), 1/m, what is told by what is round about: the 68th and 95th
    percentile of the error of `rho`, and the 98th of how much nearer the truth may be; what was
    passed over, measured or completed, and its three; None if it was not asked
    """

    rho: Map
    other: Map
    error: Map
    frames: Evidence
    floor: float = 0.0
    wider: NDArray[np.float32] | None = None


def by_looks(found: Found, others: Alternatives, grid: PolarGrid,
             baselines: Sequence[float]) -> Judged:
    """What looks as here errs so much as a rule, and what is likelier there in its place.

    others : to what was measured; baselines : of the references, m
    """
    seen = look(found.view, found.refined, found.other, found.matched, found.parallax)
    own, unit = percentiles(seen, grid, baselines, network())
    wider = judged(inputs(found.view, seen, others, own, unit, grid, baselines), grid.shape)
    error = expected_error(wider[:3], unit, found.refined, _TAIL)
    sure = found.refined.misfit < MISFIT
    sure &= expected_error(own, unit, found.refined) < np.float32(_SURE) * unit
    told = together(own, wider[:3])
    likely = expected_error(told, unit, found.refined) / unit
    near = may_be_near(told, unit, found.refined.rho, min(baselines))
    sure &= (likely < np.float32(_SURE_BOTH)) & (near < np.float32(_NEARER))
    frames = sure.astype(np.int8) + (sure & (likely < np.float32(_PLAIN)))
    frames = np.where(near < np.float32(_VEILED), frames, np.int8(-1))
    rho = found.refined.rho.copy()
    guess = likeliest(wider, unit, others, grid, baselines)
    scale = np.array([grid.pixel, min(baselines), max(baselines), np.exp(-_TAIL)], np.float32)
    theta = grid.theta().astype(np.float32)
    rows_in_parallel(_complete_rows, len(rho), found.now, found.before, wider[5:8], *guess,
                     _share_round(sure, grid), theta, scale, rho, error, frames)
    both = np.empty((WIDER, *rho.shape), np.float32)
    rows_in_parallel(_wider_rows, len(rho), wider, rho, found.refined.rho, unit, *guess, both)
    return Judged(rho, found.other, error, frames, wider=both)


def _share_round(sure: NDArray[np.bool_], grid: PolarGrid) -> Map:
    """Share of what is sure round about each pixel, on round the sphere."""
    reach = round(_ROUND * grid.height / 2)
    whole = grid.continued(sure.astype(np.float32), reach)
    size = (2 * reach + 1, 2 * reach + 1)
    return np.asarray(cv2.blur(whole, size)[reach:len(whole) - reach], np.float32)


@fast_kernel
def _parallax(theta: np.float32, rho: np.float32, baseline: np.float32,
              pixel: np.float32) -> np.float32:  # pragma: no cover - compiled
    """px by which a reference so far away sees something elsewhere along the meridian."""
    moved = _arctan2(np.sin(theta), np.cos(theta) + rho * baseline)
    return np.float32((theta - moved) / pixel)


@fast_kernel
def _complete_rows(first: int, last: int, view: Image8, before: Image8,
                   told: NDArray[np.float32], guess: Map, unit: Map, amid: Map, theta: Map,
                   scale: Map, rho: Map, error: Map,
                   frames: Evidence) -> None:  # pragma: no cover - compiled
    """What was measured (rho, error, frames) becomes what is completed, where that is likelier.

    told, guess, unit : of `judged` and `likeliest`; amid : share of what is sure round about
    scale : rad of a pixel, shortest and longest baseline, share of the 95th percentile that is
    likely
    """
    for i in range(first, last):
        for j in range(rho.shape[1]):
            likely = likely_error(told, 0, i, j, scale[3])
            if likely > np.float32(_SURE_COMPLETED) or amid[i, j] < np.float32(_AMID):
                continue
            nearer, there = np.exp(told[2, i, j]), guess[i, j]
            spread = likely * unit[i, j]
            alike = np.float32(_DIFFERS) * max(there, rho[i, j])
            if frames[i, j] > 0 and (spread > error[i, j] or abs(there - rho[i, j]) < alike):
                continue
            if nearer > np.float32(_NEARER) and (
                    (there + nearer * unit[i, j]) * np.float32(NEAR_BY) * scale[1] > 1):
                continue
            plainly = nearer < np.float32(_PLAINLY) and _parallax(
                theta[j], there, scale[2], scale[0]) >= np.float32(_SHOWS_FARTHEST)
            pixels = _parallax(theta[j], there, scale[1], scale[0])
            if not (plainly or pixels >= np.float32(_SHOWS)) or not shows_the_same(
                    view, before, i, j, pixels, _CONTRADICTS if plainly else CONTRADICTS):
                continue
            rho[i, j], error[i, j], frames[i, j] = there, spread, np.int8(1)


@fast_kernel
def _wider_rows(first: int, last: int, told: NDArray[np.float32], rho: Map, measured: Map,
                unit: Map, guess: Map, its_unit: Map,
                out: NDArray[np.float32]) -> None:  # pragma: no cover - compiled
    """`Judged.wider`, of what was measured, or completed where `rho` is something else."""
    for i in range(first, last):
        for j in range(rho.shape[1]):
            kept = rho[i, j] == measured[i, j]
            one, other = (0, 5) if kept else (5, 0)
            per = unit[i, j] if kept else its_unit[i, j]
            per_other = its_unit[i, j] if kept else unit[i, j]
            out[3, i, j] = guess[i, j] if kept else measured[i, j]
            for k in range(3):
                out[k, i, j] = per * (np.exp(told[one + k, i, j]) - np.float32(LEAST))
                out[4 + k, i, j] = per_other * (np.exp(told[other + k, i, j]) - np.float32(LEAST))


def together(own: NDArray[np.float32], wider: NDArray[np.float32]) -> NDArray[np.float32]:
    """What a pixel tells by itself and what is round about tell of its error, as one.

    What is round about may refuse what the pixel believes; what it believes by itself counts half.
    """
    return np.asarray(np.maximum(wider, np.float32(0.5) * (own + wider)), np.float32)


def by_agreement(found: Found, other: Map, grid: PolarGrid, baseline: float,
                 swept: bool) -> Judged:
    """Sure where both opinions are the same; the error is what noise and pixels tell.

    other : the second opinion, of a sweep where `swept`, else what was matched
    baseline : of the nearest reference, m
    """
    rho, pixel = found.refined.rho, grid.pixel / baseline
    allowed = np.full_like(rho, _SLACK * pixel)
    if swept:
        allowed = np.maximum(np.float32(_AGREES) * np.abs(rho),
                             np.float32(_LEVELS * reduction(grid.height) * pixel))
    information = np.maximum(found.refined.information, np.float32(1e-9))
    error = np.asarray(np.float32(DEPENDENT) / np.sqrt(information), np.float32)
    sure = (np.abs(rho - other) < allowed) & (found.refined.misfit < MISFIT)
    return Judged(rho, other, error, sure.astype(np.int8), _FLOOR)
