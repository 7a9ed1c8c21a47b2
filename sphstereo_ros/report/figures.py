"""Plots of a report."""
from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import cv2
import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from sphstereo_ros.bench.plots import coverage_by_angle, error_by_range, sigma_calibration
from sphstereo_ros.bench.scoring import average
from sphstereo_ros.core.frames import FrameKey, PointCloud, RangeImage
from sphstereo_ros.core.preview import colour_map
from sphstereo_ros.report.contents import Contents, Judged, Shares
from sphstereo_ros.report.tracks import Track, laid_over

matplotlib.use('Agg')

# Points of the top view, and the share of them that lies inside of its edges (%).
_TOP_POINTS, _INSIDE = 150_000, 98
_ERROR = 30.0  # %, end of the colour scale


def all_figures(contents: Contents) -> dict[str, Figure]:
    """Every plot that the contents have something for, by name."""
    found: dict[str, Figure] = {}
    if len(contents.shares) > 1:
        found['frames'] = shares_over_time(contents.shares, contents.is_metric)
    latencies = latencies_over_time(contents.diagnostics)
    if latencies is not None:
        found['latency'] = latencies
    if contents.scores:
        found.update(_errors(contents))
    if contents.cloud is not None:
        found['top_view'] = top_view(contents.cloud, contents.tracks)
    if contents.tracks:
        found['trajectory'] = trajectory(contents.tracks)
    if contents.scans:
        found['obstacles'] = obstacles(contents.scans[-1])
    if len(contents.nearest) > 1:
        found['nearest'] = nearest_over_time(contents.nearest)
    return found


def _errors(contents: Contents) -> dict[str, Figure]:
    summary = {'range': {'frames': len(contents.scores), **average(contents.scores)}}
    found = {'error_by_range': error_by_range(summary)}
    if any('within_1_sigma' in summary['range'][band] for band in ('0-10', '10-30', '30-100')):
        found['sigma_calibration'] = sigma_calibration(summary)
    if 'cone' in summary['range']:
        found['coverage_by_angle'] = coverage_by_angle(summary)
    if contents.judged is not None:
        found['error_picture'] = error_picture(contents.judged)
    return found


def _seconds(stamps: Sequence[int]) -> NDArray[np.float64]:
    return (np.array(stamps, np.int64) - min(stamps)) / 1e9


def shares_over_time(shares: Sequence[Shares], is_metric: bool) -> Figure:
    """What share of the sphere each depth image knows, and its median range."""
    figure = Figure(figsize=(9, 3.2), layout='constrained')
    part, middle = figure.subplots(1, 2)
    seconds = _seconds([s.stamp for s in shares])
    part.plot(seconds, [s.known for s in shares], label='known')
    part.plot(seconds, [s.beyond for s in shares], label='beyond range.max')
    if any(s.too_near for s in shares):
        part.plot(seconds, [s.too_near for s in shares], label='nearer than range.min')
    part.set(xlabel='s', ylabel='% of the solid angle', ylim=(0, 102), title='What is known')
    part.legend()
    middle.plot(seconds, [s.median for s in shares])
    middle.set(xlabel='s', ylabel='m' if is_metric else 'steps', ylim=(0, None),
               title='Median range')
    for axes in (part, middle):
        axes.grid(alpha=0.4)
    return figure


def latencies_over_time(diagnostics: Sequence[Any]) -> Figure | None:
    """Latency (median) and rate of each stage; None where fewer than two reports tell them."""
    series: dict[str, list[tuple[int, float, float]]] = {}
    for message in diagnostics:
        stamp = int(message.header.stamp.sec) * 10**9 + int(message.header.stamp.nanosec)
        for status in message.status:
            values = {v.key: v.value for v in status.values}
            rate, latency = (_number(values.get(key)) for key in ('rate_out', 'latency_p50_ms'))
            if math.isfinite(rate) or math.isfinite(latency):
                series.setdefault(str(status.name), []).append((stamp, rate, latency))
    lines = {name: rows for name, rows in series.items() if len(rows) > 1}
    if not lines:
        return None
    figure = Figure(figsize=(9, 3.2), layout='constrained')
    rates, latencies = figure.subplots(1, 2)
    start = min(rows[0][0] for rows in lines.values())
    for name, rows in lines.items():
        seconds = [(stamp - start) / 1e9 for stamp, _, _ in rows]
        rates.plot(seconds, [rate for _, rate, _ in rows], label=name)
        latencies.plot(seconds, [latency for _, _, latency in rows], label=name)
    rates.set(xlabel='s', ylabel='Hz', ylim=(0, None), title='Results per second')
    latencies.set(xlabel='s', ylabel='ms', ylim=(0, None), title='Arrival to result, median')
    rates.legend(fontsize='small')
    for axes in (rates, latencies):
        axes.grid(alpha=0.4)
    return figure


def _number(value: object) -> float:
    try:
        return float(str(value))
    except ValueError:
        return math.nan


def error_picture(judged: Judged) -> Figure:
    """A range image, the truth, and the relative error."""
    truth = cv2.resize(judged.truth, judged.measured.shape[::-1], interpolation=cv2.INTER_NEAREST)
    figure = Figure(figsize=(9, 7.4), layout='constrained')
    pictures: Mapping[str, NDArray[np.float32]] = {'Range': judged.measured, 'True range': truth}
    grid = figure.subplots(3, 1)
    for axes, (title, image) in zip(grid, pictures.items(), strict=False):
        colours = colour_map(RangeImage(FrameKey(0, ''), image, image, True))
        axes.imshow(colours[..., ::-1])
        axes.set_title(title)
    with np.errstate(invalid='ignore', divide='ignore'):
        error = 100 * (judged.measured - truth) / truth
    error[~np.isfinite(error)] = np.nan
    shown = grid[2].imshow(error, cmap='coolwarm', vmin=-_ERROR, vmax=_ERROR)
    grid[2].set_facecolor('0.1')
    grid[2].set_title('Error, %: red too far, blue too near, black not compared')
    figure.colorbar(shown, ax=list(grid), extend='both', shrink=0.3, anchor=(0, 0))
    for axes in grid:
        axes.set(xticks=[], yticks=[])
    return figure


def _edges(values: NDArray[np.floating[Any]], margin: float = 2.0) -> tuple[float, float]:
    low, high = np.percentile(values, [(100 - _INSIDE) / 2, (100 + _INSIDE) / 2])
    return float(low) - margin, float(high) + margin


def _draw_tracks(axes: Axes, tracks: Sequence[Track]) -> None:
    for index, track in enumerate(tracks):
        drawn = track if index == 0 else laid_over(track, tracks[0]) or track
        axes.plot(*drawn.positions[:, :2].T, color=f'C{index + 1}', label=track.name,
                  linestyle='-' if index == 0 else '--')


def top_view(cloud: PointCloud, tracks: Sequence[Track]) -> Figure:
    """The cloud from above, coloured by height, and the tracks."""
    figure = Figure(figsize=(9, 6.5), layout='constrained')
    axes = figure.subplots()
    xyz = cloud.xyz[::max(1, len(cloud.xyz) // _TOP_POINTS)]
    xyz = xyz[np.argsort(xyz[:, 2])]
    low, high = np.percentile(xyz[:, 2], [2, 98])
    shown = axes.scatter(xyz[:, 0], xyz[:, 1], c=xyz[:, 2], s=0.4, linewidths=0, vmin=low,
                         vmax=max(high, low + 0.1), cmap='viridis', rasterized=True)
    if tracks:
        _draw_tracks(axes, tracks)
        axes.legend(fontsize='small')
    figure.colorbar(shown, label='height, m', shrink=0.8)
    axes.set(xlabel='x, m', ylabel='y, m', xlim=_edges(xyz[:, 0]), ylim=_edges(xyz[:, 1]))
    axes.set_aspect('equal')
    axes.set_facecolor('0.97')
    axes.grid(alpha=0.3)
    return figure


def trajectory(tracks: Sequence[Track]) -> Figure:
    """The tracks from above, and their height over the distance."""
    figure = Figure(figsize=(9, 3.8), layout='constrained')
    above, height = figure.subplots(1, 2)
    _draw_tracks(above, tracks)
    for index, track in enumerate(tracks):
        drawn = track if index == 0 else laid_over(track, tracks[0]) or track
        steps = np.linalg.norm(np.diff(drawn.positions, axis=0), axis=1)
        height.plot(np.concatenate([[0], np.cumsum(steps)]), drawn.positions[:, 2],
                    color=f'C{index + 1}', linestyle='-' if index == 0 else '--')
    above.set(xlabel='x, m', ylabel='y, m', title='From above')
    above.set_aspect('equal', adjustable='datalim')
    height.set(xlabel='distance along the track, m', ylabel='z, m', title='Height')
    above.legend(fontsize='small')
    for axes in (above, height):
        axes.grid(alpha=0.4)
    return figure


def obstacles(scan: Any) -> Figure:
    """A LaserScan from above, ahead is up: measured red, free green, unknown grey."""
    figure = Figure(figsize=(5, 5), layout='constrained')
    axes = figure.add_subplot(projection='polar', theta_offset=math.pi / 2)
    ranges = np.asarray(scan.ranges, np.float64)
    angles = scan.angle_min + scan.angle_increment * np.arange(len(ranges))
    colours = np.full((len(ranges), 4), (0.5, 0.5, 0.5, 0.4))
    reach = np.full(len(ranges), scan.range_max / 2)
    colours[np.isposinf(ranges)], reach[np.isposinf(ranges)] = (0.1, 0.7, 0.2, 0.4), scan.range_max
    measured = np.isfinite(ranges) | np.isneginf(ranges)
    reach[measured] = np.where(np.isneginf(ranges), scan.range_min, ranges)[measured]
    colours[measured] = (0.85, 0.1, 0.1, 0.8)
    axes.bar(angles, reach, width=abs(scan.angle_increment), color=colours, linewidth=0)
    axes.set_ylim(0, scan.range_max)
    axes.set_title('Red up to an obstacle (m), green free, grey unknown')
    return figure


def nearest_over_time(nearest: Sequence[tuple[int, float]]) -> Figure:
    """Range to the nearest obstacle; gaps where it is not known or all is free."""
    figure = Figure(figsize=(9, 2.8), layout='constrained')
    axes = figure.subplots()
    values = np.array([value for _, value in nearest])
    values[~np.isfinite(values)] = np.nan
    axes.plot(_seconds([stamp for stamp, _ in nearest]), values, marker='.')
    axes.set(xlabel='s', ylabel='m', ylim=(0, None), title='Nearest obstacle')
    axes.grid(alpha=0.4)
    return figure
