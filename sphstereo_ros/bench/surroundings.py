"""Fits the network of `sphstereo_ros.core.surroundings` to scenes with exact range.

    python -m sphstereo_ros.bench.surroundings render FOLDER
    python -m sphstereo_ros.bench.surroundings fit OUT.onnx FOLDER...

`render` makes scenes for it alone: of seeds that are neither tuned on nor reported, four frames
each, or one pair of two cameras. `fit` needs torch and onnx (extra `fit`); the package itself does
without.
"""
from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from sphstereo_ros.core.frames import Reference
from sphstereo_ros.core.judgement import Found
from sphstereo_ros.core.reliability import LEAST, Look, network, percentiles
from sphstereo_ros.core.surroundings import BLOCK, CHANNELS, inputs, interior
from sphstereo_ros.core.warp import PolarGrid
from sphstereo_ros.scenes.binocular import TopCamera, render_binocular, save_binocular
from sphstereo_ros.scenes.sequence import (
    TruthFrame,
    load_sequence,
    render_sequence,
    save_sequence,
    true_pose,
)

from .accuracy import as_frame
from .reliability import MOST, PERCENTILES, Watched, disturbed
from .unet import Design, Parameters, fit_arguments, percentile_loss, save_fit

_SEEDS, _PAIR_SEEDS = range(11, 61), range(61, 81)
_RENDERED = (1, 7, 10, 11)  # frames of a sequence
# Windows by how many frames a sequence has: current frame, and the references' places.
_WINDOWS = {2: ((0, (1,)),), 4: ((3, (2, 1, 0)), (3, (2, 1)), (3, (2,))),
            12: ((11, (10, 7, 1)), (8, (7, 4)), (5, (4,))),
            14: ((11, (10, 7, 1)), (8, (7, 4)), (5, (4,)))}
_TURNED = 4.0  # degrees about each axis at most, of a pair's top camera
# Weights of what is 10 to 100 m away, and of what is near but was found far.
_RARE, _TOO_FAR = 2.0, 2.0
_WIDTHS = (16, 32, 48, 64, 64, 64)  # channels at half size, a quarter, …
_LAST = 32
_BEGIN = -2.3  # logarithm of the error that it starts from
_ROWS, _BATCH = 192, 3


DESIGN = Design(CHANNELS, _WIDTHS, _LAST, [_BEGIN] * (4 * len(PERCENTILES)))


@dataclass(frozen=True)
class Patch:
    """What the network sees of a window and should tell, of its polar grid without margins beyond.

    x : float16 (CHANNELS, rows, columns); error : float32 (2 rows, 2 columns), true less measured
    inverse range in units; weight : the same shape, 0 where the truth is unknown
    """

    x: NDArray[np.float16]
    error: NDArray[np.float32]
    weight: NDArray[np.float32]


class _Kept(Watched):
    """Keeps a window's patch."""

    patch: Patch | None = None

    def watch(self, found: Found, seen: Look, grid: PolarGrid, axes: NDArray[np.float64],
              baselines: Sequence[float]) -> None:
        rho = found.refined.rho
        told, unit = percentiles(seen, grid, baselines, network())
        x = interior(inputs(found.view, seen, told, unit, grid, baselines), grid.shape)
        true = self.true(grid, axes, *(n.ravel() for n in np.indices(grid.shape)))
        true = true.reshape(grid.shape)
        error = (true - rho) / unit
        weight = np.isfinite(error) * np.maximum(np.sin(grid.theta()), 0.02)[None]
        weight *= np.where((true > 0.01) & (true < 0.1), _RARE, 1)
        weight *= np.where((true > 0.1) & (rho < true / 1.5), _TOO_FAR, 1)
        self.patch = Patch(x[0].astype(np.float16), np.nan_to_num(error).astype(np.float32),
                           weight.astype(np.float32))


def patches_of(folder: Path, rng: np.random.Generator) -> list[Patch]:
    """Patches of all windows of a rendered sequence."""
    sequence = load_sequence(folder)
    found = []
    for current, references in _WINDOWS.get(len(sequence), ()):
        truth = sequence[current]
        kept = _Kept(truth)
        kept.measure(as_frame(truth, 0), [
            Reference(as_frame(sequence[k], 0), disturbed(true_pose(sequence[k], truth), rng))
            for k in references])
        assert kept.patch is not None
        found.append(kept.patch)
    return found


def render(folder: Path) -> None:
    """The scenes that the network is fitted to, beside those of the tuning seeds."""
    _render_ways(folder)
    _render_pairs(folder)


def _render_ways(folder: Path) -> None:
    jobs: list[tuple[str, int, float | None, str | None]] = []
    for seed in _SEEDS:
        spacing = float(np.random.default_rng(seed).choice([.28, .28, .2, .4]))
        nuisance = {3: 'low_light', 4: 'exposure'}.get(seed % 5)
        jobs.append(('street', seed, spacing, nuisance))
        jobs += [('takeoff', seed, None, None)] * (seed % 3 == 0 or seed > 25)
        jobs += [('corridor', seed, None, None)] * (seed % 5 == 0)
    for name, seed, step, nuisance in tqdm(jobs, unit='scene'):
        height = 960 if name != 'corridor' and seed % 3 else 480
        render_way(folder, name, seed, height, step, nuisance)


def render_way(folder: Path, name: str, seed: int, height: int, spacing: float | None,
               nuisance: str | None) -> None:
    """Four frames of a way, in a folder of their own, unless they are there."""
    target = folder / f'{name}_{seed}'
    if target.exists():
        return
    sequence = render_sequence(name, seed, 14, height, spacing=spacing, nuisance=nuisance)
    frames: list[TruthFrame] = [sequence[k] for k in _RENDERED]
    save_sequence(frames, target.with_suffix('.part'), name)
    target.with_suffix('.part').rename(target)


def _render_pairs(folder: Path) -> None:
    for seed in tqdm(_PAIR_SEEDS, unit='pair'):
        name = ('street', 'takeoff', 'street', 'corridor')[seed % 4]
        target = folder / f'pair_{name}_{seed}'
        if target.exists():
            continue
        rng = np.random.default_rng(seed)
        roll, pitch, yaw = np.radians(rng.uniform(-_TURNED, _TURNED, 3)).tolist()
        rig = TopCamera((roll, pitch, yaw), float(rng.uniform(0.2, 0.5)),
                        gain=float(rng.uniform(0.8, 1.2)))
        height = 960 if name != 'corridor' and seed % 3 else 480
        sequence = render_binocular(name, seed, 1, height, rig)
        save_binocular(sequence, target.with_suffix('.part'), name)
        target.with_suffix('.part').rename(target)


def loss(out: Any, error: Any, weight: Any) -> Any:
    """Of the percentiles of each pixel."""
    from torch.nn import functional
    return percentile_loss(functional.pixel_shuffle(out, 2), error, weight, LEAST, MOST,
                           PERCENTILES)


def _varied(patch: Patch, rng: np.random.Generator) -> tuple[Any, Any, Any]:
    """A part of a patch, in another light or mirrored."""
    import torch
    columns = patch.x.shape[2]
    height = min(_ROWS, patch.x.shape[1] // BLOCK * BLOCK)
    first = int(rng.integers(0, patch.x.shape[1] - height + 1))
    beyond = -columns % BLOCK
    part = np.pad(patch.x[:, first:first + height], ((0, 0), (0, 0), (0, beyond)), 'edge')
    x = torch.from_numpy(part.astype(np.float32))[None]
    rows = slice(2 * first, 2 * (first + height))
    error, weight = (torch.from_numpy(np.pad(m[rows].astype(np.float32), (
        (0, 0), (0, 2 * beyond))))[None, None] for m in (patch.error, patch.weight))
    gain, offset = float(np.exp(rng.normal(0, 0.25))), float(rng.normal(0, 0.3))
    x[:, 10:14] = (x[:, 10:14] * gain + offset).clamp(-2, 2)
    x[:, 23] *= gain
    x[:, 14] = torch.log(0.5 + gain * (torch.exp(x[:, 14] + 1) - 0.5).clamp(min=0)) - 1
    if rng.random() < 0.15:
        x[:, 10:14] *= -1
    if rng.random() < 0.5:
        x, error, weight = (torch.flip(m, [2]) for m in (x, error, weight))
        for at in (0, 5, 10):
            x[:, at:at + 4] = x[:, at:at + 4][:, [2, 3, 0, 1]]
    return x, error, weight


def fit(patches: Sequence[Patch], steps: int, rng: np.random.Generator,
        start: dict[str, NDArray[np.float32]] | None = None) -> Parameters:
    """Weights after so many steps, from `start` if there is one."""
    return DESIGN.fitted(lambda: _varied(patches[int(rng.integers(len(patches)))], rng), loss,
                         steps, _BATCH, start)


def main() -> None:
    """Render, or fit and save."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else '')
    commands = parser.add_subparsers(dest='command', required=True)
    commands.add_parser('render').add_argument('folder', type=Path)
    fit_arguments(commands.add_parser('fit'), 6000)
    given = parser.parse_args()
    if given.command == 'render':
        render(given.folder)
    else:
        save_fit(given, DESIGN, patches_of, fit)


if __name__ == '__main__':
    main()
