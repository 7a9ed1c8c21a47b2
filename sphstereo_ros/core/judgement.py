"""What was found on a polar grid, and how far it is believed: by its looks, or by agreement."""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .frames import Image8
from .matching import Parallax
from .refinement import Refined
from .reliability import expected_error, look, may_be_near, network, percentiles
from .surroundings import inputs, judged
from .sweep import reduction
from .warp import Map, PolarGrid

Evidence = NDArray[np.int8]

MISFIT = 150.0  # squared grey levels, beyond which no reference shows the same
# Of the unit: a likely error with which something counts as measured, by what pixels tell
# themselves, and together with what is round about.
_SURE, _SURE_BOTH = 0.8, 0.6
_PLAIN = 0.3  # of the unit: with a smaller likely error it counts for two frames
# Of the unit: what may be nearer by more is not sure, and by still more, what was remembered there
# is not believed either.
_NEARER, _VEILED = 0.6, 1.2
_TAIL = 0.75  # of what is published
# Opinions are the same within a share of the inverse range, or so many pixels at the sweep's size;
# and refinement may move what was matched by so many pixels.
_AGREES, _LEVELS, _SLACK = 0.05, 0.75, 1.5
DEPENDENT = 4.0  # times the noise: differences in grey within a window are not independent
_FLOOR = 0.17  # px: no match beats that


@dataclass(frozen=True)
class Found:
    """What is known of a window on its polar grid, before it is judged.

    view : the current view; refined : the measurement; other : second opinion, 1/m;
    matched, parallax : what the nearest pair's matcher found, 1/m and px
    """

    view: Image8
    refined: Refined
    other: Map
    matched: Map
    parallax: Parallax


@dataclass(frozen=True)
class Judged:
    """Second opinion and likely error (1/m) on the polar grid.

    frames : for how many frames of evidence it counts; 0 = it is not believed, −1 = nor should
    be what is remembered there
    floor : px that no match beats, if the error does not tell them
    """

    other: Map
    error: Map
    frames: Evidence
    floor: float = 0.0


def by_looks(found: Found, grid: PolarGrid, baselines: Sequence[float]) -> Judged:
    """What looks as here errs so much as a rule; baselines of the references in m."""
    seen = look(found.view, found.refined, found.other, found.matched, found.parallax)
    own, unit = percentiles(seen, grid, baselines, network())
    wider = judged(inputs(found.view, seen, own, unit, grid, baselines), grid.shape)
    error = expected_error(wider, unit, found.refined, _TAIL)
    sure = found.refined.misfit < MISFIT
    sure &= expected_error(own, unit, found.refined) < np.float32(_SURE) * unit
    told = together(own, wider)
    likely = expected_error(told, unit, found.refined) / unit
    near = may_be_near(told, unit, found.refined.rho, min(baselines))
    sure &= (likely < np.float32(_SURE_BOTH)) & (near < np.float32(_NEARER))
    frames = sure.astype(np.int8) + (sure & (likely < np.float32(_PLAIN)))
    return Judged(found.other, error, np.where(near < np.float32(_VEILED), frames, np.int8(-1)))


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
    return Judged(other, error, sure.astype(np.int8), _FLOOR)
