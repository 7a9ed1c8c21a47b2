"""Fits the network of `sphstereo_ros.core.surroundings` to scenes with exact range.

    python -m sphstereo_ros.bench.surroundings render FOLDER
    python -m sphstereo_ros.bench.surroundings fit OUT.onnx FOLDER... [--patches DIR]

`render` makes scenes for it alone: of seeds that are neither tuned on nor reported, five frames
each, or one pair of two cameras; and hollows. `fit` needs torch and onnx (extra `fit`); the
package itself does without.
"""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from sphstereo_ros.core.alternatives import Alternatives, alternatives
from sphstereo_ros.core.frames import Reference
from sphstereo_ros.core.judgement import Found, Judged
from sphstereo_ros.core.refinement import JointRefinement
from sphstereo_ros.core.reliability import LEAST, Look, network, percentiles
from sphstereo_ros.core.surroundings import (
    ABOVE,
    ADDED,
    AROUND,
    BLOCK,
    CHANNELS,
    GREY,
    SHARES,
    inputs,
    interior,
)
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
from .hollows import hollow
from .reliability import MOST, PERCENTILES, Watched, disturbed
from .unet import Design, Parameters, known_truth, percentile_loss, render_or_fit

_SEEDS, _PAIR_SEEDS, _SLOW_SEEDS, _HARD_SEEDS, _SMALL_SEEDS, _HOLLOW_SEEDS, _HARDER_SEEDS = (
    range(11, 61), range(61, 81), range(82, 98), range(121, 141), range(141, 185),
    range(221, 341), range(341, 373))
_SLOW = (0.05, 0.1, 0.07)  # m from frame to frame; odd and even seeds differ, as heights go by 3
_HARD = ('repetition', 'wall', 'traffic', 'occlusion')
_HEIGHTS = (160, 240, 320, 384, 480)  # of small ones
_LIGHTS = (None, None, 'rolling_exposure', 'exposure', 'low_light', None)
_RENDERED = (1, 4, 7, 10, 11)  # frames of a sequence
_STEP = 0.28  # m from frame to frame, of hollows
# Windows by how many frames a sequence has: current frame, and the references' places.
_LONG = ((11, (10, 7, 4, 1)), (11, (10, 7, 4)), (8, (7, 4)), (5, (4,)))
_WINDOWS = {2: ((0, (1,)),),
            4: ((3, (2, 1, 0)), (3, (2, 1)), (3, (2,))),  # rendered without the fourth frame
            5: ((4, (3, 2, 1, 0)), (4, (3, 2, 1)), (4, (3, 2)), (4, (3,))),
            12: _LONG, 14: _LONG}
_TURNED = 4.0  # degrees about each axis at most, of a pair's top camera
# Weights of what is 10 to 100 m away, of what of it is over 30 m away, and of what is near but was
# found far.
_RARE, _RARER, _TOO_FAR = 2.0, 2.0, 2.0
_WIDTHS = (64, 64, 64, 96, 96, 96)  # channels at half size, a quarter, …
_LAST = 64
_BEGIN = -2.3  # logarithm of the error that it starts from
_APART = -0.3  # logarithm by which the second of its own ranges starts from another than the first
_ROWS, _COLUMNS, _BATCH, _RATE = 192, 256, 3, 1e-3
_TRUE = 0.02  # share of a sample of which the truth has to be known
_LARGE, _OFTEN = 600, 0.5  # rows at half size of a patch that is drawn so often at least

# Of what is chosen: the logarithm of its error counts up to _WRONG; so much more where it is
# farther than the truth by more than such a logarithm; and how much all that counts.
_WRONG, _FARTHER, _WORSE, _CHOICE = 0.5, 0.35, 0.3, 4.0

_OTHER = 0.05  # of the network's own two, that which errs more counts so much

_OF_ERROR, _OWNS, _CHOSEN = len(PERCENTILES), 2, 3 + len(SHARES)
_OWN, _LIKELIEST, _CHOICES = _OF_ERROR, _OF_ERROR + _OWNS, 2 * _OF_ERROR + _OWNS  # outputs
DESIGN = Design(CHANNELS, _WIDTHS, _LAST,
                [_BEGIN] * (4 * _OF_ERROR) + [0.0] * 4 + [_APART] * 4
                + [_BEGIN] * (4 * _OF_ERROR) + [2.0] * 4 + [0.0] * (4 * (_CHOSEN - 1)),
                deep=True)


@dataclass(frozen=True)
class Patch:
    """What the network sees of a window and should tell, of its polar grid without margins beyond.

    x : float16 (CHANNELS, rows, columns); error : float16 (2 rows, 2 columns), true less measured
    inverse range in units; true : the same shape, logarithm of the shortest baseline's parallax
    and ADDED; weight : the same, 0 where the truth is unknown, or moves and is found too near;
    ratio : of the shortest baseline to the longest
    """

    x: NDArray[np.float16]
    error: NDArray[np.float16]
    true: NDArray[np.float16]
    weight: NDArray[np.float16]
    ratio: float


class _Kept(Watched):
    """Keeps a window's patch."""

    patch: Patch | None = None
    _others: Alternatives

    def _judged(self, found: Found, refinement: JointRefinement) -> Judged:
        self._others = alternatives(found.refined.rho, found.other, refinement)
        return super()._judged(found, refinement)

    def watch(self, found: Found, seen: Look, grid: PolarGrid, axes: NDArray[np.float64],
              baselines: Sequence[float]) -> None:
        rho = found.refined.rho
        told, unit = percentiles(seen, grid, baselines, network())
        x = interior(inputs(found.view, seen, self._others, told, unit, grid, baselines),
                     grid.shape)
        still, true = (self.true(grid, axes, *(n.ravel() for n in np.indices(grid.shape)),
                                 moving=moving).reshape(grid.shape) for moving in (False, True))
        # What moves seems near or far by its speed; only what then is dangerous is told.
        true = np.where(true > rho, true, still)
        error = (true - rho) / unit
        sine = np.maximum(np.sin(grid.theta()), 0.02)[None]
        weight = np.isfinite(error) * sine
        near, middle, known = (true > share * self.unit for share in (0.1, 1 / 30, 0.01))
        weight *= np.where(known & ~near, _RARE, 1)
        weight *= np.where(known & ~middle, _RARER, 1)
        weight *= np.where(near & (rho < true / 1.5), _TOO_FAR, 1)
        pixels = np.nan_to_num(true) * sine * min(baselines) / grid.pixel
        self.patch = Patch(x[0].astype(np.float16),
                           np.clip(np.nan_to_num(error), -99, 99).astype(np.float16),
                           np.log(ADDED + pixels).astype(np.float16), weight.astype(np.float16),
                           min(baselines) / max(baselines))


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
    for seed in tqdm(_HOLLOW_SEEDS, unit='hollow'):
        if not (target := folder / f'hollow_{seed}').exists():
            save_scene(hollow(seed, _RENDERED, _STEP), target, 'hollow')


def _render_ways(folder: Path) -> None:
    jobs: list[tuple[str, int, float | None, str | None]] = []
    for seed in _SEEDS:
        spacing = float(np.random.default_rng(seed).choice([.28, .28, .2, .4]))
        nuisance = {3: 'low_light', 4: 'exposure'}.get(seed % 5)
        jobs.append(('street', seed, spacing, nuisance))
        jobs += [('takeoff', seed, None, None)] * (seed % 3 == 0 or seed > 25)
        jobs += [('corridor', seed, None, None)] * (seed % 5 == 0)
    for seed in _SLOW_SEEDS:
        jobs.append(('street', seed, _SLOW[(seed if seed % 2 else seed // 2) % 3], None))
    for seed in _HARD_SEEDS:
        jobs.append(('street', seed, None, _HARD[seed % 4]))
    for seed in _HARDER_SEEDS:
        jobs.append(('street', seed, None, ('wall', 'traffic')[seed % 2]))
    for name, seed, step, nuisance in tqdm(jobs, unit='scene'):
        height = 960 if name != 'corridor' and seed % 3 else 480
        render_way(folder, name, seed, height, step, nuisance)
    for seed in tqdm(_SMALL_SEEDS, unit='small scene'):
        _render_small(folder, seed)


def _render_small(folder: Path, seed: int) -> None:
    """A way of few rows, as small computers and quick looks have them."""
    name, height = ('street', 'takeoff', 'corridor', 'street')[seed % 4], _HEIGHTS[seed % 5]
    if name == 'street':
        spacing = float(np.random.default_rng(seed).choice([.28, .1, .4]))
        render_way(folder, name, seed, height, spacing, _LIGHTS[seed % 6])
    else:
        render_way(folder, name, seed, height, None, None)


def render_way(folder: Path, name: str, seed: int, height: int, spacing: float | None,
               nuisance: str | None) -> None:
    """Five frames of a way, in a folder of their own, unless they are there."""
    target = folder / f'{name}_{seed}'
    if target.exists():
        return
    sequence = render_sequence(name, seed, 14, height, spacing=spacing, nuisance=nuisance)
    save_scene([sequence[k] for k in _RENDERED], target, name)


def save_scene(frames: list[TruthFrame], target: Path, name: str) -> None:
    """Into a folder that is there only when it is whole."""
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


def candidates(x: Any, error: Any, true: Any, own: Any) -> tuple[Any, Any]:
    """Parallaxes (N, 7, …), px of the shortest baseline, of what may be chosen: what was measured,
    nearest, farthest, and farthest more widely round about, the network's first own, what was
    swept, and its second; and the true.

    own : (N, 2, …) logarithms of the network's own, and ADDED
    """
    import torch
    from torch.nn import functional
    unit = torch.exp(functional.pixel_shuffle(x[:, 5:9], 2)) - float(ADDED)
    pixels = torch.exp(true) - float(ADDED)

    def larger(half: Any) -> Any:
        return functional.interpolate(half, scale_factor=2, mode='nearest')
    shares = [torch.exp(x[:, k:k + 1]) - float(ABOVE) for k in SHARES]
    round_about = [larger(share) * larger(unit[:, :, ::2, ::2]) for share in shares]
    *near_by, swept = round_about
    owns = torch.exp(own) - float(ADDED)
    return torch.cat([pixels - error * unit, *near_by, owns[:, :1], swept, owns[:, 1:]],
                     1), pixels


def loss(out: Any, x: Any, error: Any, true: Any, weight: Any, ratio: float) -> Any:
    """Of the percentiles of each pixel, of what was measured and of what is likeliest, of the
    network's own ranges, and of the choice.

    Of its own, the one that is less wrong counts: so at a rim, where either side may be, one comes
    to tell each (as in multiple choice learning, Guzmán-Rivera et al. 2012).
    """
    import torch
    from torch.nn import functional
    told = functional.pixel_shuffle(out, 2)
    own = told[:, _OWN:_LIKELIEST] + functional.pixel_shuffle(x[:, 5:9], 2)
    found, pixels = candidates(x, error, true, own.detach())
    nearer = torch.log(pixels.clamp(min=ratio)) - torch.log(found.clamp(min=ratio))
    wrong = nearer.abs().clamp(max=_WRONG) + _WORSE * (nearer > _FARTHER)
    choices = told[:, _CHOICES:]
    chosen = (torch.softmax(choices, 1) * wrong).sum(1, keepdim=True)
    likeliest = found.gather(1, choices.argmax(1, keepdim=True))
    off = (pixels - likeliest) / likeliest.clamp(min=ratio)

    def of(percentiles: Any, error: Any) -> Any:
        return percentile_loss(percentiles, error, weight, LEAST, MOST, PERCENTILES)
    owns = (true - own).abs()
    apart = owns.amin(1, keepdim=True) + _OTHER * owns.amax(1, keepdim=True) + _CHOICE * chosen
    return (of(told[:, :_OF_ERROR], error) + of(told[:, _LIKELIEST:_CHOICES], off)
            + (weight * apart).sum() / weight.sum())


def _varied(patch: Patch, rng: np.random.Generator) -> tuple[Any, ...]:
    """A part of a patch, in another light or mirrored."""
    import torch
    x, maps = _part(patch, rng)
    gain, offset = float(np.exp(rng.normal(0, 0.25))), float(rng.normal(0, 0.3))
    x[:, 10:14] = (x[:, 10:14] * gain + offset).clamp(-2, 2)
    x[:, 23] *= gain
    x[:, 14] = torch.log(0.5 + gain * (torch.exp(x[:, 14] + 1) - 0.5).clamp(min=0)) - 1
    grey = [*(at + n for at in GREY for n in range(4)), *AROUND]
    x[:, grey] = torch.log(2 + gain * (torch.exp(x[:, grey] + 2) - 2)) - 2
    if rng.random() < 0.15:
        x[:, 10:14] *= -1
    if rng.random() < 0.5:
        x, *maps = (torch.flip(m, [2]) for m in (x, *maps))
        for at in (0, 5, 10, *GREY):
            x[:, at:at + 4] = x[:, at:at + 4][:, [2, 3, 0, 1]]
    return x, x, *maps, patch.ratio


def _part(patch: Patch, rng: np.random.Generator) -> tuple[Any, list[Any]]:
    """Inputs, and error, truth and weight, of a part of a patch; beyond its end as at the end."""
    import torch
    rows, columns = patch.x.shape[1:]
    height, width = min(_ROWS, rows // BLOCK * BLOCK), min(_COLUMNS, columns)
    top, left = (int(rng.integers(0, n + 1)) for n in (rows - height, columns - width))
    beyond = -width % BLOCK
    part = np.pad(patch.x[:, top:top + height, left:left + width],
                  ((0, 0), (0, 0), (0, beyond)), 'edge')
    at = np.s_[2 * top:2 * (top + height), 2 * left:2 * (left + width)]
    maps = [np.pad(m[at].astype(np.float32), ((0, 0), (0, 2 * beyond)))
            for m in (patch.error, patch.true, patch.weight)]
    return (torch.from_numpy(part.astype(np.float32))[None],
            [torch.from_numpy(m)[None, None] for m in maps])


def _drawn(patches: Sequence[Patch], rng: np.random.Generator) -> tuple[Any, ...]:
    """A sample; large pictures, which show more, are drawn more often."""
    large = [p for p in patches if p.x.shape[1] > _LARGE]
    while True:
        among = large if large and rng.random() < _OFTEN else patches
        sample = _varied(among[int(rng.integers(len(among)))], rng)
        if float(sample[4].mean()) > _TRUE:
            return sample


def fit(patches: Sequence[Patch], steps: int, rng: np.random.Generator,
        start: dict[str, NDArray[np.float32]] | None = None,
        bfloat16: bool = False) -> Parameters:
    """Weights after so many steps, as of `Design.fitted`.

    Raises ValueError where of no patch enough of the truth is known.
    """
    known = known_truth(patches, _TRUE)
    return DESIGN.fitted(lambda: _drawn(known, rng), loss, steps, _BATCH, start, _RATE,
                         bfloat16)


def main() -> None:
    """Render, or fit and save."""
    render_or_fit(__doc__, 6000, render, DESIGN, Patch, patches_of, fit)


if __name__ == '__main__':
    main()
