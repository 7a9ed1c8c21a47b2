"""Fits the network of `sphstereo_ros.core.reliability` to scenes with exact range.

    python -m sphstereo_ros.bench.reliability OUT.npz FOLDER... [--without NAME]

FOLDER holds a rendered sequence (`sphstereo scene`) of a tuning seed. What the network sees of
pixels of its windows, and how far the measurement errs there, are the samples. The outputs are
percentiles of the error's logarithm (quantile regression, Koenker and Bassett 1978).
"""
from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from sphstereo_ros.core.config import resolve
from sphstereo_ros.core.frames import Frame, Reference, RelativePose
from sphstereo_ros.core.joint import JointMatcher, Measurement
from sphstereo_ros.core.judgement import Found, Judged
from sphstereo_ros.core.matching import matcher
from sphstereo_ros.core.refinement import JointRefinement
from sphstereo_ros.core.reliability import LEAK, LEAST, LOOKS, Look, look, looks_at
from sphstereo_ros.core.rotations import exp
from sphstereo_ros.core.warp import PolarGrid
from sphstereo_ros.scenes.sequence import TruthFrame, load_sequence, true_pose

from .accuracy import as_frame

Floats = NDArray[np.floating]

HIDDEN = (24, 16)
# Windows that are sampled: current frame, frames back.
_WINDOWS = ((11, (1, 4, 10)), (10, (1, 4, 10)), (11, (1,)), (8, (1, 4)), (5, (1, 2, 5)),
            (3, (1,)), (11, (2, 8)))
_PIXELS = 60000  # of a window, even over the sphere
_ROTATION, _DIRECTION = np.radians(0.003), np.radians(0.02)  # how far poses are off, as a rule
PERCENTILES = (0.683, 0.954, 0.98)  # of the error twice, and of what it is too far
MOST = 5.0  # of the unit: what an error counts for at most
_RARE = 2.0  # weight of what is 10 to 100 m away
_STEPS, _BATCH, _RATE = 12000, 4096, 3e-3


@dataclass(frozen=True)
class Samples:
    """looks (N, LOOKS), error (N,): true less measured inverse range in units, weight (N,)."""

    looks: Floats
    error: Floats
    weight: Floats


def true_on_grid(truth: TruthFrame, grid: PolarGrid, axes: NDArray[np.float64],
                 rows: NDArray[np.int64], columns: NDArray[np.int64], *,
                 moving: bool = False) -> Floats:
    """True inverse range (N,), 1/m, of pixels of a polar grid; NaN where it is unknown or moves.

    axes : (3, 3) of the grid, optical frame of `truth`
    moving : what moves has its range, too
    """
    theta, azimuth = grid.theta()[columns], grid.azimuth()[rows]
    sine = np.sin(theta)
    x, y, z = axes @ [np.cos(azimuth) * sine, np.sin(azimuth) * sine, np.cos(theta)]
    height, width = truth.range.shape
    v = np.clip(((0.5 + np.arcsin(np.clip(y, -1, 1)) / np.pi) * height).astype(np.intp), 0,
                height - 1)
    u = ((np.arctan2(x, z) / (2 * np.pi) + 0.5) * width).astype(np.intp) % width
    true = (1 / np.maximum(truth.range, 1e-3)).astype(np.float32)
    if truth.moving is not None and not moving:
        true[truth.moving] = np.nan
    return np.asarray(true[v, u])


class Watched(JointMatcher):
    """Shows what it found of a window to `watch`, in place of a judgement."""

    def __init__(self, truth: TruthFrame) -> None:
        super().__init__('joint', matcher(resolve({}).stereo))
        self._truth = truth
        self.unit = 1.0  # m: of the nearest baseline, of which ranges and baselines count here

    def measure(self, current: Frame, references: Sequence[Reference]) -> Measurement:
        """As `JointMatcher.measure`; poses are metric."""
        self.unit = references[0].pose.baseline
        return super().measure(current, references)

    def watch(self, found: Found, seen: Look, grid: PolarGrid, axes: NDArray[np.float64],
              baselines: Sequence[float]) -> None:
        """Keep what is needed of it."""
        raise NotImplementedError

    def _judged(self, found: Found, refinement: JointRefinement) -> Judged:
        seen = look(found.view, found.refined, found.other, found.matched, found.parallax)
        self.watch(found, seen, refinement.grid, refinement.axes, refinement.baselines)
        nothing = np.zeros_like(found.refined.rho)
        return Judged(found.refined.rho, found.other, nothing, nothing.astype(np.int8))

    def true(self, grid: PolarGrid, axes: NDArray[np.float64], rows: NDArray[np.int64],
             columns: NDArray[np.int64], *, moving: bool = False) -> Floats:
        """Inverse range, per `unit`; NaN where it is unknown, or moves unless `moving`."""
        return self.unit * true_on_grid(self._truth, grid, axes, rows, columns, moving=moving)


class _Sampled(Watched):
    """Keeps what there is to see of pixels, and how far their measurement errs."""

    def __init__(self, truth: TruthFrame, rng: np.random.Generator) -> None:
        super().__init__(truth)
        self._rng = rng
        self.samples: Samples | None = None

    def watch(self, found: Found, seen: Look, grid: PolarGrid, axes: NDArray[np.float64],
              baselines: Sequence[float]) -> None:
        rows, columns = self._pixels(grid)
        true = self.true(grid, axes, rows, columns)
        looks, unit = looks_at(seen, grid, baselines, rows, columns)
        rho = found.refined.rho[rows, columns]
        error, weight = (true - rho) / unit, np.ones_like(unit)
        weight[(true > 0.01 * self.unit) & (true < 0.1 * self.unit)] = _RARE
        known = np.isfinite(true)
        self.samples = Samples(looks[known], error[known], weight[known])

    def _pixels(self, grid: PolarGrid) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Even over the sphere, not in the margins."""
        theta = np.arccos(self._rng.uniform(-1, 1, _PIXELS))
        column = np.clip((theta / grid.pixel).astype(np.int64), 0, grid.height - 1)
        row = self._rng.integers(0, 2 * grid.height, _PIXELS)
        return row + grid.wrap, column + grid.margin


def disturbed(pose: RelativePose, rng: np.random.Generator) -> RelativePose:
    """The pose, as far off as an estimate is."""
    return RelativePose(exp(rng.normal(0, _ROTATION, 3)) @ pose.rotation,
                        exp(rng.normal(0, _DIRECTION, 3)) @ pose.position)


def samples_of(folder: Path, rng: np.random.Generator) -> list[Samples]:
    """Samples of all windows of a rendered sequence."""
    sequence = load_sequence(folder)
    found = []
    for current, intervals in _WINDOWS:
        if current >= len(sequence):
            continue
        truth = sequence[current]
        references = [(sequence[current - k], k) for k in intervals]
        sampled = _Sampled(truth, rng)
        sampled.measure(as_frame(truth, 0), [
            Reference(as_frame(frame, 0), disturbed(true_pose(frame, truth), rng))
            for frame, _ in references])
        assert sampled.samples is not None
        found.append(sampled.samples)
    return found


class Fit:
    """A network while it is fitted, by Adam (Kingma and Ba 2014)."""

    def __init__(self, looks: Floats, rng: np.random.Generator, steps: int = _STEPS) -> None:
        self._steps = steps
        sizes = (LOOKS, *HIDDEN, len(PERCENTILES))
        self.weights = [rng.normal(0, np.sqrt(2 / a), (a, b)).astype(np.float32)
                        for a, b in pairwise(sizes)]
        self.biases = [np.zeros(b, np.float32) for b in sizes[1:]]
        self.weights[-1] *= np.float32(0.1)
        self.biases[-1] += np.float32(np.log(0.1))
        self.mean = looks.mean(0)
        self.spread = looks.std(0) + np.float32(1e-6)
        parts = self.weights + self.biases
        self._first = [np.zeros_like(p) for p in parts]
        self._second = [np.zeros_like(p) for p in parts]

    def layers(self, looks: Floats) -> list[Floats]:
        """What each layer gives, the input (standardised) first."""
        found = [(looks - self.mean) / self.spread]
        for n, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            out = found[-1] @ weight + bias
            found.append(np.maximum(out, np.float32(LEAK) * out) if n < 2 else out)
        return found

    def step(self, looks: Floats, wanted: Floats, weight: Floats, number: int) -> None:
        """One step down the gradient of the percentiles' loss."""
        layers = self.layers(looks)
        percentiles = np.array(PERCENTILES, np.float32)
        slope = np.where(wanted > layers[-1], -percentiles, 1 - percentiles)
        slope = (slope * weight[:, None] / np.float32(len(looks))).astype(np.float32)
        by_weight, by_bias = [], []
        for n in (2, 1, 0):
            by_weight.append(layers[n].T @ slope)
            by_bias.append(slope.sum(0))
            bend = np.where(layers[n] > 0, np.float32(1), np.float32(LEAK))
            slope = (slope @ self.weights[n].T) * bend
        self._descend(by_weight[::-1] + by_bias[::-1], number)

    def _descend(self, gradients: list[Floats], number: int) -> None:
        slower = 0.5 * (1 + np.cos(np.pi * number / self._steps))
        rate = _RATE * min(1, (number + 1) / 200) * slower
        parts = self.weights + self.biases
        for part, gradient, first, second in zip(parts, gradients, self._first, self._second,
                                                 strict=True):
            first += np.float32(0.1) * (gradient - first)
            second += np.float32(0.001) * (gradient * gradient - second)
            steady = first / np.float32(1 - 0.9**(number + 1))
            size = np.sqrt(second / np.float32(1 - 0.999**(number + 1))) + np.float32(1e-8)
            part -= np.float32(rate) * steady / size

    def save(self, path: Path) -> None:
        """As `core.reliability.network` reads it: standardisation goes into the first layer."""
        weights, biases = list(self.weights), list(self.biases)
        biases[0] = biases[0] - (self.mean / self.spread) @ weights[0]
        weights[0] = weights[0] / self.spread[:, None]
        named: dict[str, Any] = {f'weight{n}': w.astype(np.float32)
                                 for n, w in enumerate(weights)}
        named |= {f'bias{n}': b.astype(np.float32) for n, b in enumerate(biases)}
        np.savez(path, **named)


def fit(samples: Sequence[Samples], rng: np.random.Generator, steps: int = _STEPS) -> Fit:
    """A network fitted to all samples."""
    looks = np.concatenate([s.looks for s in samples])
    error = np.concatenate([s.error for s in samples])
    weight = np.concatenate([s.weight for s in samples])
    sizes = np.stack([np.abs(error), np.abs(error), np.maximum(error, 0)], 1)
    wanted = np.log(LEAST + np.minimum(sizes, MOST)).astype(np.float32)
    found = Fit(looks, rng, steps)
    for number in tqdm(range(steps), unit='step'):
        chosen = rng.integers(0, len(looks), _BATCH)
        found.step(looks[chosen], wanted[chosen], weight[chosen], number)
    return found


def main() -> None:
    """Fit and save."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else '')
    parser.add_argument('out', type=Path)
    parser.add_argument('folders', type=Path, nargs='+')
    parser.add_argument('--without', nargs='*', default=(), metavar='NAME',
                        help='folders that are left out, to be tested on')
    args = parser.parse_args()
    rng = np.random.default_rng(0)
    folders = [f for f in args.folders if f.name not in args.without]
    samples = [s for f in tqdm(folders, unit='folder') for s in samples_of(f, rng)]
    fit(samples, rng).save(args.out)


if __name__ == '__main__':
    main()
