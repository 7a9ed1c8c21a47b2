"""Which surface a pixel belongs to, near rims.

Windows see across rims, so what is farther has the range of what is nearer beside it, some pixels
wide: a far street between leaves would be as near as they are. Each pixel chooses between its own
range and those round about (`alternatives`), by how the references look if it lies there and by
what its neighbours choose: as in semi-global matching (Hirschmüller 2008), with candidates in
place of levels, as in fusion moves (Lempitsky et al. 2010). It is put farther only where that
looks better by itself, whatever its neighbours choose.
"""
from __future__ import annotations

import numpy as np

from .alternatives import round_about
from .frames import Image8
from .jit import fast_kernel, kernel, rows_in_parallel
from .refinement import JointRefinement
from .warp import Map

_NEARER, _FARTHER = 15, (9, 15, 31)  # px: windows of what is round about
_SPREAD = 2.0  # px, round which views are compared
_KEEP = 0.025  # of what views may differ, by which another range must look better
# Neighbours of different ranges cost so much of it a unit, up to so many units (a share of the
# range, or a pixel of the longest baseline); less where grey changes, to half at _EDGE levels.
_CHANGE, _MOST, _SHARE, _EDGE = 0.8, 3.0, 0.1, 10.0
_NEVER = 1e6
_COUNT = 2 + len(_FARTHER)


@fast_kernel
def _keep_rows(first: int, last: int, rho: Map, cost: Map) -> None:  # pragma: no cover - compiled
    """What another range than the pixel's own, the first, costs besides."""
    keep, never = np.float32(_KEEP), np.float32(_NEVER)
    for i in range(first, last):
        for j in range(rho.shape[1]):
            for k in range(1, _COUNT):
                worse = cost[i, j, k] >= cost[i, j, 0]
                farther = rho[i, j, k] < rho[i, j, 0]
                cost[i, j, k] += never if farther and worse else keep


@fast_kernel
def _step(cost: Map, rho: Map, rho_before: Map, weight: np.float32, unit: np.float32, before: Map,
          out: Map) -> None:  # pragma: no cover - compiled
    """Least costs of a path that ends in each candidate of a pixel, from those of the one before.
    """
    least = before[0]
    for n in range(1, _COUNT):
        least = min(least, before[n])
    per_unit, most = weight / unit, weight * np.float32(_MOST)
    for k in range(_COUNT):
        best = before[0] + min(abs(rho[k] - rho_before[0]) * per_unit, most)
        for n in range(1, _COUNT):
            best = min(best, before[n] + min(abs(rho[k] - rho_before[n]) * per_unit, most))
        out[k] = cost[k] + best - least


@fast_kernel
def _weight(view: Image8, i: int, j: int, ip: int,
            jp: int) -> np.float32:  # pragma: no cover - compiled
    change = abs(np.float32(view[i, j]) - np.float32(view[ip, jp]))
    return np.float32(_CHANGE * _EDGE) / (np.float32(_EDGE) + change)


@kernel
def _along_rows(first: int, last: int, cost: Map, rho: Map, unit: Map, view: Image8,
                total: Map) -> None:  # pragma: no cover - compiled
    columns = cost.shape[1]
    path = np.empty((2, _COUNT), np.float32)
    for i in range(first, last):
        for way in range(2):
            path[:] = 0
            for n in range(columns):
                j = n if way == 0 else columns - 1 - n
                jp = max(j - 1, 0) if way == 0 else min(j + 1, columns - 1)
                _step(cost[i, j], rho[i, j], rho[i, jp], _weight(view, i, j, i, jp), unit[i, j],
                      path[n % 2], path[1 - n % 2])
                for k in range(_COUNT):
                    total[i, j, k] += path[1 - n % 2, k]


@kernel
def _across_rows(first: int, last: int, cost: Map, rho: Map, unit: Map, view: Image8,
                 total: Map) -> None:  # pragma: no cover - compiled
    """Down and up columns first … last."""
    rows = len(cost)
    path = np.empty((2, last - first, _COUNT), np.float32)
    for way in range(2):
        path[:] = 0
        for n in range(rows):
            i = n if way == 0 else rows - 1 - n
            ip = max(i - 1, 0) if way == 0 else min(i + 1, rows - 1)
            for j in range(first, last):
                c = j - first
                _step(cost[i, j], rho[i, j], rho[ip, j], _weight(view, i, j, ip, j), unit[i, j],
                      path[n % 2, c], path[1 - n % 2, c])
                for k in range(_COUNT):
                    total[i, j, k] += path[1 - n % 2, c, k]


@kernel
def _choice_rows(first: int, last: int, total: Map, rho: Map,
                 out: Map) -> None:  # pragma: no cover - compiled
    for i in range(first, last):
        for j in range(out.shape[1]):
            best = 0
            for k in range(1, total.shape[2]):
                if total[i, j, k] < total[i, j, best]:
                    best = k
            out[i, j] = rho[i, j, best]


def own_surface(rho: Map, refinement: JointRefinement) -> Map:
    """Inverse range (1/m, of the grid's shape), where each pixel has that of the surface it shows.

    Parameters
    ----------
    rho : what was measured, 1/m
    refinement : whose references are compared

    """
    nearer, farther = round_about(rho, refinement.grid, _NEARER, _FARTHER)
    found, cost = (np.empty((*rho.shape, _COUNT), np.float32) for _ in range(2))
    compared = refinement.compared(rho)
    for k, candidate in enumerate((rho, nearer, *farther)):
        found[..., k], cost[..., k] = candidate, compared.difference(candidate, _SPREAD)
    longest = np.float32(max(refinement.baselines))
    sine = np.abs(np.sin(refinement.grid.theta())).astype(np.float32)
    rows_in_parallel(_keep_rows, len(cost), found, cost)
    unit = np.maximum(np.float32(_SHARE) * rho, np.float32(refinement.grid.pixel) / (
        longest * np.maximum(sine, np.float32(0.02))))
    total = np.zeros_like(cost)
    rows_in_parallel(_along_rows, len(cost), cost, found, unit, refinement.view, total)
    rows_in_parallel(_across_rows, cost.shape[1], cost, found, unit, refinement.view, total)
    out = np.empty_like(rho)
    rows_in_parallel(_choice_rows, len(out), total, found, out)
    return out
