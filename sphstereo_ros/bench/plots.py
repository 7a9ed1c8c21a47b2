"""Pictures of the accuracy benchmark: error against range, coverage against angle, calibration."""
from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from math import erf, sqrt
from pathlib import Path
from typing import Any

import matplotlib
from matplotlib.figure import Figure

from .scoring import BANDS, CONE_STEPS, RANGE_STEPS, SIGMAS

matplotlib.use('Agg')

Summaries = Mapping[str, Mapping[str, Any]]
# % of the sphere: a smaller group is not drawn.
_LEAST_SHARE, _LEAST_OF_CONE = 0.05, 0.005


def write_plots(summaries: Summaries, folder: Path) -> list[Path]:
    """Write one PNG a plot into `folder`; returns their paths.

    summaries : of `Contest.summaries`
    """
    folder.mkdir(parents=True, exist_ok=True)
    scored = {name: s for name, s in summaries.items() if s['frames']}
    plots: dict[str, Callable[[Summaries], Figure]] = {
        'error_by_range': error_by_range, 'coverage_by_angle': coverage_by_angle,
        'sigma_calibration': sigma_calibration}
    paths = []
    for name, plot in plots.items():
        paths.append(folder / f'{name}.png')
        plot(scored).savefig(paths[-1], dpi=110)
    return paths


def error_by_range(summaries: Summaries) -> Figure:
    """Median error and coverage in steps of range."""
    figure = Figure(figsize=(9, 4.2), layout='constrained')
    error, coverage = figure.subplots(1, 2)
    middles = [sqrt(low * high) for low, high in pairwise(RANGE_STEPS)]
    for name, summary in summaries.items():
        groups = list(summary['by_range'].values())
        error.loglog(middles, _values(groups, 'median'), marker='.', label=name)
        coverage.semilogx(middles, _values(groups, 'coverage'), marker='.', label=name)
    error.set(xlabel='range, m', ylabel='median error, %', title='Error against range')
    coverage.set(xlabel='range, m', ylabel='coverage of the solid angle, %', ylim=(0, 102),
                 title='Coverage against range')
    for axes in (error, coverage):
        ticks = [r for r in (1, 2, 5, 10, 20, 50, 100) if middles[0] < 2 * r]
        axes.set_xticks(ticks, [str(t) for t in ticks], minor=False)
        axes.grid(alpha=0.4, which='both')
    steps = (0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50)
    error.set_yticks(steps, [str(step) for step in steps], minor=False)
    error.legend()
    return figure


def coverage_by_angle(summaries: Summaries) -> Figure:
    """Coverage and median error at 20 m, by the angle from the nearer pole of motion."""
    figure = Figure(figsize=(9, 4.2), layout='constrained')
    coverage, error = figure.subplots(1, 2)
    steps = list(pairwise(CONE_STEPS))
    places = range(len(steps))
    for index, (name, summary) in enumerate(summaries.items()):
        for side, style in (('ahead', '-'), ('behind', ':')):
            groups = [g['at_20m'] for g in summary['cone'][side].values()]
            kind = {'marker': '.', 'linestyle': style, 'color': f'C{index}',
                    'label': name if side == 'ahead' else None}
            coverage.plot(places, _values(groups, 'coverage', _LEAST_OF_CONE), **kind)
            error.semilogy(places, _values(groups, 'median', _LEAST_OF_CONE), **kind)
    coverage.set(ylabel='coverage of the solid angle, %', ylim=(0, 102),
                 title='Coverage at 20 m (dotted: behind)')
    ticks = [0.5, 1, 2, 5, 10, 20, 50]
    error.set_yticks(ticks, [str(t) for t in ticks], minor=False)
    error.set(ylabel='median error, %', title='Error at 20 m (dotted: behind)')
    for axes in (coverage, error):
        axes.set_xticks(places, [f'{low:g}–{high:g}' for low, high in steps])
        axes.set_xlabel('angle from the direction of motion, degrees')
        axes.grid(alpha=0.4)
    coverage.legend(loc='lower right')
    return figure


def sigma_calibration(summaries: Summaries) -> Figure:
    """Share of the pixels within k sigma, beside what a normal error has, by band."""
    figure = Figure(figsize=(10, 3.8), layout='constrained')
    expected = [100 * erf(k / sqrt(2)) for k in SIGMAS]
    for axes, (low, high) in zip(figure.subplots(1, len(BANDS), sharey=True), BANDS, strict=True):
        axes.plot(SIGMAS, expected, color='0.3', linewidth=3, alpha=0.5, label='expected')
        # What is asked for at 1 and 2 sigma.
        axes.vlines([1, 2], [60, 92], [76, 98], color='0.3', linewidth=7, alpha=0.3)
        for name, summary in summaries.items():
            band = summary[f'{low:g}-{high:g}']
            shares = [band.get(f'within_{k:g}_sigma') for k in SIGMAS]
            axes.plot(SIGMAS, [float('nan') if s is None else s for s in shares], marker='.',
                      label=name)
        axes.set(xlabel='k', title=f'{low:g}–{high:g} m', ylim=(0, 102))
        axes.grid(alpha=0.4)
    figure.axes[0].set_ylabel('errors within k sigma, % of the pixels')
    figure.axes[0].legend(loc='lower right')
    return figure


def _values(groups: Sequence[Mapping[str, Any]], name: str,
            least: float = _LEAST_SHARE) -> list[float]:
    """NaN where a group has too little to tell."""
    return [float('nan') if g[name] is None or g['share'] < least else g[name]
            for g in groups]
