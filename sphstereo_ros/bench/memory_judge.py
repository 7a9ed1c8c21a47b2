"""Fits the network of `sphstereo_ros.core.memory_judge` to scenes with exact range.

    python -m sphstereo_ros.bench.memory_judge render FOLDER
    python -m sphstereo_ros.bench.memory_judge fit OUT.onnx FOLDER... [--patches DIR]

FOLDER holds a rendered sequence of 14 frames. `fit` needs torch and onnx (extra `fit`); the
package itself does without.
"""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from sphstereo_ros.core.config import resolve
from sphstereo_ros.core.frames import AlignedWindow, Image8, Reference
from sphstereo_ros.core.inverse_range import NOTHING
from sphstereo_ros.core.memory_judge import (
    BLOCK,
    CHANNELS,
    GREYS,
    LEVEL,
    PRESENT,
    SIGMAS,
    THERE,
    VIEW,
    Opinions,
    inputs,
    interior,
    pixel_of,
)
from sphstereo_ros.core.range_memory import RangeMemory
from sphstereo_ros.core.reliability import LEAST
from sphstereo_ros.core.stereo import SphericalStereo
from sphstereo_ros.core.warp import Map
from sphstereo_ros.scenes.sequence import TruthFrame, load_sequence, render_sequence, true_pose

from .accuracy import as_frame
from .reliability import MOST, PERCENTILES, disturbed
from .scoring import FREE
from .surroundings import save_scene
from .unet import Design, Parameters, known_truth, percentile_loss, render_or_fit

_FRAMES = 14
# What is rendered beside the tuning seeds.
_JOBS = (('street', 12, None), ('street', 13, None), ('takeoff', 14, None),
         ('street', 16, 'traffic'), ('street', 17, None), ('street', 18, 'occlusion'),
         ('street', 19, None), ('street', 22, None), ('street', 24, 'low_light'),
         ('takeoff', 26, None),
         *(('street', seed, None) for seed in (401, 403, 404, 406, 407, 409, 410, 412, 413, 416,
                                               431, 433, 434, 441, 442, 444, 450, 451, 453, 454,
                                               455, 456, 458, 459, 461, 462, 463, 464, 467, 470,
                                               472, 473, 476, 478, 479, 482, 484, 487)),
         *(('street', seed, 'traffic') for seed in (405, 408, 432, 443, 452, 457, 460, 465, 471,
                                                    474, 477, 480, 481, 486, 488)),
         *(('takeoff', seed, None) for seed in (411, 466, 475, 489)),
         ('street', 417, 'occlusion'), ('street', 421, 'wall'))
_HEIGHT = 960
# Frames back of the references, the first frame that is measured, those that are kept, and whether
# at half the size.
_WINDOWS = (((1, 4, 7, 10), 4, (7, 10, 12, 13), False), ((1,), 3, (6,), False),
            ((1, 4, 7, 10), 6, (11, 13), True))
# Weights of what is 10 to 100 m away, of what of it is over 30 m away, and of what is near but was
# found far.
_RARE, _RARER, _TOO_FAR = 2.0, 1.5, 2.0
_WIDTHS, _LAST = (32, 64, 96, 128, 128), 32
_BEGIN = -2.3  # logarithm of the error that it starts from
_ROWS, _COLUMNS, _BATCH, _RATE = 160, 240, 4, 1e-3  # with 1.5e-3 it diverged, once
_TRUE = 0.02  # share of a sample of which the truth has to be known
# Of what is chosen: the logarithm of its error counts up to _WRONG; so much more where it is
# farther than the truth by more than such a logarithm; how much all that counts; and how much that
# the better ones are likelier (cross entropy; by such a difference it is e times better). By what
# is to be expected alone, nothing would be learnt of a choice that is never taken.
_WRONG, _FARTHER, _WORSE, _CHOICE = 0.5, 0.35, 0.3, 4.0
_BETTER, _DIFFERENCE = 0.4, 0.05
_POSES, _POSE = 0.3, 0.05  # share of samples of which poses are unsure, and by how much
# Shares of samples without a floor or walls, and with such that are not where they seem to be, and
# by how much.
_NO_SURFACE, _SURFACES, _SURFACE = 0.15, 0.2, 0.2
_SURFACE_FOUND = 3  # of `Patch.found`, the floor, and the wall after it

_NEVER, _UNKNOWN = -1e4, 2.3  # a logit; logarithm of sigma over inverse range
_OFF, _RARELY = 0.1, -2.0  # share of the inverse range by which it is off, and a logit to begin
# How many times it counts that what is near by is told FREE times too far, and whether it is, and
# by how much the logarithm of how far is near by varies.
_DANGER, _HIDES, _NEAR_BY = 10.0, 3.0, 0.7
_SKY = 0.05  # px of parallax of the longest baseline: with less nothing is there

_OF_ERROR, _CHOSEN = 2, 8
DESIGN = Design(CHANNELS, _WIDTHS, _LAST,
                [_BEGIN] * (4 * _OF_ERROR) + [0.0] * (4 * _CHOSEN) + [_RARELY] * 12,
                deep=True)


@dataclass(frozen=True)
class Patch:
    """What the network sees of a frame and should tell.

    x : float16 (CHANNELS, rows, columns); found, true : float16 (7, 2 rows, 2 columns) and (2
    rows, 2 columns), logarithms of how many times as large as measured the inverse range is that
    was remembered, that both are as one, that was passed over, of floor and wall, of what is
    beside it, farther and nearer, and the true one, a pixel of the longest baseline's parallax
    added to each; what moves and is measured too near is taken to be there; weight : the same, 0
    where the truth is unknown
    """

    x: NDArray[np.float16]
    found: NDArray[np.float16]
    true: NDArray[np.float16]
    weight: NDArray[np.float16]


def patch_of(truth: TruthFrame, view: Image8, opinions: Opinions, direction: NDArray[np.float64],
             baselines: tuple[float, float]) -> Patch:
    """What the network sees, and should tell, of a frame of even height; m."""
    height = len(view)
    pixel = pixel_of(height, baselines[1])
    x = interior(inputs(view, opinions, direction, baselines), height)[0]
    measured, true = opinions.measured[0], _true(truth)

    def against(rho: Map, where: Any = True) -> Map:
        found = np.log((np.maximum(rho, 0) + pixel) / (np.maximum(measured, 0) + pixel))
        return np.asarray(np.where(where, found, 0), np.float32)
    found = [against(rho, sigma < NOTHING)
             for rho, sigma, *_ in (opinions.before, opinions.fused)]
    found += [against(opinions.wider[3]), *(
        against(rho, rho > 0) for rho in (opinions.floor, opinions.wall[0]))]
    found += [against(opinions.beside[n], opinions.beside[n + 1] > 0) for n in (0, 3)]
    wanted = against(np.nan_to_num(true))
    weight = np.isfinite(true) * _areas(height)
    if truth.moving is not None:  # what moves seems near or far by its speed; near is safe
        wanted[truth.moving & (wanted < 0)] = 0
    weight *= np.where((true > 0.01) & (true < 0.1), _RARE, 1)
    weight *= np.where((true > 0.01) & (true < 1 / 30), _RARER, 1)
    weight *= np.where((true > 0.1) & (wanted > np.log(1.5)), _TOO_FAR, 1)
    return Patch(x.astype(np.float16), np.stack(found).astype(np.float16),
                 wanted.astype(np.float16), weight.astype(np.float16))


def _true(truth: TruthFrame) -> Map:
    """Inverse range, 1/m; NaN where it is unknown."""
    return np.asarray(1 / np.maximum(truth.range, 1e-3), np.float32)


def _areas(height: int) -> Map:
    latitude = np.pi * (0.5 - (np.arange(height) + 0.5) / height)
    return np.repeat(np.cos(latitude)[:, None], 2 * height, 1).astype(np.float32)


class _Kept(RangeMemory):
    """Keeps what there is to choose from, in place of a judgement."""

    truth: TruthFrame
    patch: Patch | None = None

    def _judged(self, view: Image8, opinions: Opinions, direction: NDArray[np.float64],
                baselines: tuple[float, float]) -> tuple[Map, Map]:
        self.patch = patch_of(self.truth, view, opinions, direction, baselines)
        return opinions.fused[:2]


def _halved(frame: TruthFrame) -> TruthFrame:
    moving = None if frame.moving is None else frame.moving[::2, ::2]
    small = cv2.resize(frame.image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    return replace(frame, image=np.asarray(small, np.uint8), range=frame.range[::2, ::2],
                   moving=moving)


def patches_of(folder: Path, rng: np.random.Generator) -> list[Patch]:
    """Patches of frames of a rendered sequence."""
    found = []
    for intervals, first, kept, half in _WINDOWS:
        sequence = [_halved(f) for f in load_sequence(folder)] if half else load_sequence(folder)
        stereo = SphericalStereo(resolve({}))
        memory = _Kept(stereo.config.stereo.memory)
        stereo.remember_in(memory)
        for current in range(first, max(kept) + 1):
            truth = memory.truth = sequence[current]
            stereo.process(AlignedWindow(as_frame(truth, 0), tuple(
                Reference(as_frame(sequence[current - k], 0),
                          disturbed(true_pose(sequence[current - k], truth), rng))
                for k in intervals if k <= current)))
            if current in kept and memory.patch is not None:
                found.append(memory.patch)
    return found


def render(folder: Path) -> None:
    """Scenes beside those of the tuning seeds."""
    for name, seed, nuisance in tqdm(_JOBS, unit='scene'):
        if not (target := folder / f'{name}_{seed}').exists():
            sequence = render_sequence(name, seed, _FRAMES, _HEIGHT, nuisance=nuisance)
            save_scene([sequence[k] for k in range(_FRAMES)], target, name)


def loss(out: Any, x: Any, found: Any, true: Any, weight: Any) -> Any:
    """Of the percentiles of what is chosen, of how probably it is off and only sky is there, and
    of the choice.
    """
    import torch
    from torch.nn import functional
    told = functional.pixel_shuffle(out, 2)
    level = functional.pixel_shuffle(x[:, LEVEL:LEVEL + 4], 2)
    each = torch.cat([torch.zeros_like(true), found], 1)
    nearer = true - each
    wrong = nearer.abs().clamp(max=_WRONG) + _WORSE * (nearer > _FARTHER)
    absent, doubt = ~_there(x), told[:, _OF_ERROR + _CHOSEN:]
    choices, better = (m.masked_fill(absent, _NEVER) for m in (
        told[:, _OF_ERROR:_OF_ERROR + _CHOSEN], -wrong / _DIFFERENCE))
    chosen = _CHOICE * torch.softmax(choices, 1) * wrong - _BETTER * torch.softmax(
        better, 1) * torch.log_softmax(choices, 1)
    likeliest = torch.exp(level + each.gather(1, choices.argmax(1, keepdim=True))) - 1
    pixels = torch.exp(level + true) - 1
    off = (pixels - likeliest) / likeliest.clamp(min=1)
    danger = (pixels > torch.exp(x[:, -1:, :1, :1])) & (pixels > FREE * likeliest)
    doubted = functional.binary_cross_entropy_with_logits(
        doubt, torch.cat([off.abs() > _OFF, pixels < _SKY, danger], 1).float(),
        torch.cat([torch.ones_like(doubt[:, :2]),
                   _HIDES * (1 + (_DANGER - 1) * danger.float())], 1),
        reduction='none').sum(1, keepdim=True)
    return (percentile_loss(told[:, :_OF_ERROR], off.abs(), weight, LEAST, MOST,
                            PERCENTILES[:_OF_ERROR])
            + (weight * (chosen.sum(1, keepdim=True) + doubted)).sum() / weight.sum())


def _there(x: Any) -> Any:
    """Which of what there is to choose from there is, (N, _CHOSEN, 2 rows, 2 columns)."""
    import torch
    from torch.nn import functional
    remembered, *others = (functional.pixel_shuffle(x[:, n:n + 4], 2) > 0 for n in PRESENT)
    known = functional.pixel_shuffle(x[:, SIGMAS[2]:SIGMAS[2] + 4], 2) < _UNKNOWN
    always = torch.ones_like(known)
    return torch.cat([always, remembered, known, always, *others], 1)


def _varied(patch: Patch, rng: np.random.Generator) -> tuple[Any, ...]:
    """A part of a patch, in another light, with less sure poses, or mirrored."""
    import torch
    x, maps = _part(patch, rng)
    contrast = float(np.exp(rng.normal(0, 0.25)))
    x[:, VIEW:VIEW + 4] = (x[:, VIEW:VIEW + 4] * contrast + float(rng.normal(0, 0.3))).clamp(-2, 2)
    for at in GREYS:
        x[:, at:at + 4] = (x[:, at:at + 4] * contrast).clamp(-2, 2)
    if rng.random() < _POSES:
        share = _POSE * float(rng.random())
        for at in SIGMAS:
            x[:, at:at + 4] = 0.5 * torch.log(torch.exp(2 * x[:, at:at + 4]) + share**2)
    x[:, -1] += _NEAR_BY * float(rng.uniform(-1, 1))
    for n in range(2):
        _vary_surface(x[:, THERE + 8 * n:THERE + 8 * n + 8], maps[0][:, _SURFACE_FOUND + n], rng)
    if rng.random() < 0.5:
        x, *maps = (torch.flip(m, [3]) for m in (x, *maps))
        for at in range(0, CHANNELS // 4 * 4, 4):
            x[:, at:at + 4] = x[:, at:at + 4][:, [1, 0, 3, 2]]
    return x, x, *maps


def _vary_surface(x: Any, found: Any, rng: np.random.Generator) -> None:
    """Of floor or wall, its inputs and where it was found: without it, or elsewhere."""
    there, seen = x[:, :4] > 0, x[:, 4:]
    drawn = rng.random()
    if drawn < _NO_SURFACE:
        x[:], found[:] = 0, 0
    elif drawn < _NO_SURFACE + _SURFACES:
        off = float(rng.normal(0, _SURFACE))
        seen[there] = (seen[there] + off).clamp(-2, 2)
        found[_on_pixels(there)] += off


def _on_pixels(four: Any) -> Any:
    """(1, 4, rows, columns) as (1, 2 rows, 2 columns)."""
    from torch.nn import functional
    return functional.pixel_shuffle(four.float(), 2)[:, 0] > 0


def _part(patch: Patch, rng: np.random.Generator) -> tuple[Any, list[Any]]:
    """Inputs, and what was found, truth and weight, of a part of a patch."""
    import torch
    rows, columns = (min(n, size // BLOCK * BLOCK) for n, size in zip(
        (_ROWS, _COLUMNS), patch.x.shape[1:], strict=True))
    top, left = (int(rng.integers(0, size - n + 1)) for n, size in zip(
        (rows, columns), patch.x.shape[1:], strict=True))
    at = np.s_[..., 2 * top:2 * (top + rows), 2 * left:2 * (left + columns)]
    x = patch.x[:, top:top + rows, left:left + columns].astype(np.float32)
    maps = [torch.from_numpy(np.atleast_3d(m[at].astype(np.float32).T).T[None])
            for m in (patch.found, patch.true, patch.weight)]
    return torch.from_numpy(x)[None], maps


def _drawn(patches: Sequence[Patch], rng: np.random.Generator) -> tuple[Any, ...]:
    while True:
        sample = _varied(patches[int(rng.integers(len(patches)))], rng)
        if float(sample[4].mean()) > _TRUE:
            return sample


def fit(patches: Sequence[Patch], steps: int, rng: np.random.Generator,
        start: dict[str, NDArray[np.float32]] | None = None,
        bfloat16: bool = False) -> Parameters:
    """Weights after so many steps, as of `Design.fitted`.

    Raises ValueError where of no patch enough of the truth is known.
    """
    known = known_truth(patches, _TRUE)
    return DESIGN.fitted(lambda: _drawn(known, rng), loss, steps, _BATCH, start, _RATE, bfloat16)


def main() -> None:
    """Render, or fit and save."""
    render_or_fit(__doc__, 6000, render, DESIGN, Patch, patches_of, fit)


if __name__ == '__main__':
    main()
