"""Fits the network of `sphstereo_ros.core.match_judge` to scenes with exact range.

    python -m sphstereo_ros.bench.match_judge render FOLDER
    python -m sphstereo_ros.bench.match_judge fit OUT.onnx FOLDER...

`render` makes scenes for it alone: of seeds that are neither tuned on nor reported, four small
frames each; those of `sphstereo_ros.bench.surroundings` serve as well. `fit` needs torch and onnx
(extra `fit`).
"""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from sphstereo_ros.core.config import resolve
from sphstereo_ros.core.match_judge import BLOCK, CHANNELS, ROUND, inputs
from sphstereo_ros.core.matching import block_matcher, stereo_grid
from sphstereo_ros.core.reliability import LEAST
from sphstereo_ros.core.warp import aligned_pair
from sphstereo_ros.replay.parameter_files import load_values
from sphstereo_ros.scenes.sequence import TruthFrame, load_sequence, true_pose

from .accuracy import as_frame
from .processes import shipped
from .reliability import MOST, PERCENTILES, disturbed, true_on_grid
from .surroundings import render_way
from .unet import Design, Parameters, percentile_loss, render_or_fit

_SEEDS = range(2000, 2203)
_SCENES = ('street', 'street', 'takeoff', 'takeoff', 'street', 'corridor')  # how often each
_SPACINGS = (0.28, 0.28, 0.2, 0.4)
_NUISANCES = {3: 'low_light', 4: 'exposure'}  # of eight
# Pairs of a sequence (current frame, reference), and the rows that they are matched at.
_PAIRS = ((3, 2), (3, 1), (2, 1))
_HEIGHTS = (480, 384)
_TOO_FAR = 2.0  # weight of what is near, but was found far
_BEGIN = -2.3  # logarithm of the error that it starts from
_ROWS, _BATCH = 160, 4

_TOLD = len(PERCENTILES)
# Four times four pixels at half size are told of by one of the network's.
DESIGN = Design(CHANNELS, (24, 32, 48, 64, 64), 32, [_BEGIN] * (16 * _TOLD) + [1.0] * 16
                + [_BEGIN] * (16 * _TOLD), step=2)


@dataclass(frozen=True)
class Patch:
    """What the network sees of a pair, and the truth, on its polar grid.

    x : float16 (CHANNELS, rows, columns); found, true : float16 (4 rows, 4 columns), parallax,
    negative where nothing was found; weight : the same, 0 where the truth is unknown
    """

    x: NDArray[np.float16]
    found: NDArray[np.float16]
    true: NDArray[np.float16]
    weight: NDArray[np.float16]


def patch_of(current: TruthFrame, reference: TruthFrame, height: int,
             rng: np.random.Generator) -> Patch:
    """A pair, matched at `height` rows."""
    stereo = resolve(load_values([shipped('config/live.yaml')])).stereo
    pose, grid = disturbed(true_pose(reference, current), rng), stereo_grid(height)
    there, here, axes = aligned_pair(as_frame(reference, height).image,
                                     as_frame(current, height).image, pose, grid)
    found = block_matcher(stereo.num_disparities, stereo.block_size)(here, there)
    rows, columns = (n.ravel() for n in np.indices(grid.shape))
    rho = true_on_grid(current, grid, axes, rows, columns).reshape(grid.shape)
    theta = grid.theta()[None]
    moved = np.arctan2(np.sin(theta), np.cos(theta) + rho * pose.baseline)
    true = (theta - moved) / grid.pixel
    weight = np.isfinite(true) * np.maximum(np.sin(theta), 0.02)
    weight *= np.where((rho > 0.1) & (found.pixels < true / 1.5), _TOO_FAR, 1)
    x = inputs(here, there, found)[0, :, ROUND:ROUND + grid.shape[0] // 4, :grid.shape[1] // 4]
    return Patch(x.astype(np.float16), np.maximum(found.pixels, -1).astype(np.float16),
                 np.maximum(np.nan_to_num(true), 0).astype(np.float16),
                 weight.astype(np.float16))


def patches_of(folder: Path, rng: np.random.Generator) -> list[Patch]:
    """Patches of all pairs of a sequence, each at one of the heights."""
    sequence = load_sequence(folder)
    return [patch_of(sequence[a], sequence[b], int(rng.choice(_HEIGHTS)), rng)
            for a, b in _PAIRS if max(a, b) < len(sequence)]


def _varied(patch: Patch, rng: np.random.Generator) -> tuple[Any, ...]:
    """A part of a patch, at half size one pixel of four, in another light or mirrored."""
    import torch
    height = min(_ROWS, patch.x.shape[1] // BLOCK * BLOCK)
    first = int(rng.integers(0, patch.x.shape[1] - height + 1))
    beyond = -patch.x.shape[2] % BLOCK
    part = np.pad(patch.x[:, first:first + height], ((0, 0), (0, 0), (0, beyond)), 'edge')
    x = torch.from_numpy(part.astype(np.float32))[None]
    rows = slice(4 * first, 4 * (first + height))
    one_of_four = np.s_[int(rng.integers(2))::2, int(rng.integers(2))::2]
    found, true, weight = (torch.from_numpy(np.pad(m[rows][one_of_four].astype(np.float32), (
        (0, 0), (0, 2 * beyond))))[None, None] for m in (patch.found, patch.true, patch.weight))
    gain, offset = float(np.exp(rng.normal(0, 0.25))), float(rng.normal(0, 0.3))
    x[:, 8:12] = (x[:, 8:12] * gain + offset).clamp(-2, 2)
    x[:, 12:16] = torch.log(2 + gain * (torch.exp(x[:, 12:16] + 2) - 2)) - 2
    x[:, 19] *= gain
    if rng.random() < 0.15:
        x[:, 8:12] *= -1
    if rng.random() < 0.5:
        x, found, true, weight = (torch.flip(m, [2]) for m in (x, found, true, weight))
        for at in (0, 4, 8, 12):
            x[:, at:at + 4] = x[:, at:at + 4][:, [2, 3, 0, 1]]
    return x, found, true, weight


def loss(out: Any, found: Any, true: Any, weight: Any) -> Any:
    """Of the percentiles of each pixel at half size, of what was found and of what is completed,
    and of that itself.
    """
    import torch
    from torch.nn import functional
    told = functional.pixel_shuffle(out, 4)
    completed = told[:, _TOLD:_TOLD + 1]

    def of(parallax: Any, percentiles: Any, weight: Any) -> Any:
        error = (true - parallax) / parallax.clamp(min=1)
        return percentile_loss(percentiles, error, weight, LEAST, MOST, PERCENTILES)
    off = (torch.log(0.5 + true) - completed).abs()
    return (of(found, told[:, :_TOLD], weight * (found >= 0))
            + of(torch.exp(completed.detach()) - 0.5, told[:, _TOLD + 1:], weight)
            + (weight * off).sum() / weight.sum())


def fit(patches: Sequence[Patch], steps: int, rng: np.random.Generator,
        start: dict[str, NDArray[np.float32]] | None = None,
        bfloat16: bool = False) -> Parameters:
    """Weights after so many steps, as of `Design.fitted`."""
    return DESIGN.fitted(lambda: _varied(patches[int(rng.integers(len(patches)))], rng), loss,
                         steps, _BATCH, start, bfloat16=bfloat16)


def render(folder: Path) -> None:
    """The scenes that the network is fitted to."""
    for seed in tqdm(_SEEDS, unit='scene'):
        rng = np.random.default_rng(seed)
        name, spacing, nuisance = str(rng.choice(_SCENES)), None, None
        if name == 'street':
            spacing = float(rng.choice(_SPACINGS))
            nuisance = _NUISANCES.get(int(rng.integers(8)))
        render_way(folder, name, seed, max(_HEIGHTS), spacing, nuisance)


def main() -> None:
    """Render, or fit and save."""
    render_or_fit(__doc__, 8000, render, DESIGN, Patch, patches_of, fit)


if __name__ == '__main__':
    main()
