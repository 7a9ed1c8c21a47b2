"""Fits the network of `sphstereo_ros.core.surroundings` to scenes with exact range.

    python -m sphstereo_ros.bench.surroundings render FOLDER
    python -m sphstereo_ros.bench.surroundings fit OUT.onnx FOLDER... [--minutes M]

`render` makes scenes for it alone: of seeds that are neither tuned on nor reported, four frames
each. `fit` needs torch and onnx (extra `fit`); the package itself does without.
"""
from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from sphstereo_ros.core.frames import Reference
from sphstereo_ros.core.judgement import Found
from sphstereo_ros.core.reliability import Look, network, percentiles
from sphstereo_ros.core.surroundings import CHANNELS, inputs, interior
from sphstereo_ros.core.warp import PolarGrid
from sphstereo_ros.scenes.sequence import (
    TruthFrame,
    load_sequence,
    render_sequence,
    save_sequence,
    true_pose,
)

from .accuracy import as_frame
from .reliability import LEAST, MOST, PERCENTILES, Watched, disturbed

Floats = NDArray[np.floating]
Parameters = dict[str, Any]  # name of a layer → weight and bias
Node = TypeVar('Node')

_SEEDS = range(11, 41)
_RENDERED = (1, 7, 10, 11)  # frames of a sequence
# Windows by how many frames a sequence has: current frame, and the references' places.
_WINDOWS = {4: ((3, (2, 1, 0)), (3, (2, 1))), 12: ((11, (10, 7, 1)), (8, (7, 4))),
            14: ((11, (10, 7, 1)), (8, (7, 4)))}
# Weights of what is 10 to 100 m away, and of what is near but was found far.
_RARE, _TOO_FAR = 2.0, 2.0
_WIDTHS = (16, 32, 48, 64)  # channels at half size, a quarter, …
_LAST = 32
LAYERS = {  # name: inputs, outputs, size of the kernel, step
    'enter': (CHANNELS, _WIDTHS[0], 3, 1),
    'down1': (_WIDTHS[0], _WIDTHS[1], 3, 2), 'stay1': (_WIDTHS[1], _WIDTHS[1], 3, 1),
    'down2': (_WIDTHS[1], _WIDTHS[2], 3, 2), 'stay2': (_WIDTHS[2], _WIDTHS[2], 3, 1),
    'down3': (_WIDTHS[2], _WIDTHS[3], 3, 2), 'stay3': (_WIDTHS[3], _WIDTHS[3], 3, 1),
    'up2': (_WIDTHS[3], _WIDTHS[2], 1, 1), 'join2': (_WIDTHS[2], _WIDTHS[2], 3, 1),
    'up1': (_WIDTHS[2], _WIDTHS[1], 1, 1), 'join1': (_WIDTHS[1], _WIDTHS[1], 3, 1),
    'up0': (_WIDTHS[1], _WIDTHS[0], 1, 1), 'join0': (_WIDTHS[0], _LAST, 3, 1),
    'tell': (_LAST, 4 * len(PERCENTILES), 1, 1)}
_LEAK, _BEGIN = 0.1, -2.3  # logarithm of the error that it starts from
_ROWS, _BATCH, _RATE = 128, 4, 3e-3


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
    jobs: list[tuple[str, int, float | None, str | None]] = []
    for seed in _SEEDS:
        spacing = float(np.random.default_rng(seed).choice([.28, .28, .2, .4]))
        nuisance = {3: 'low_light', 4: 'exposure'}.get(seed % 5)
        jobs.append(('street', seed, spacing, nuisance))
        jobs += [('takeoff', seed, None, None)] * (seed % 3 == 0)
        jobs += [('corridor', seed, None, None)] * (seed % 5 == 0)
    for name, seed, step, nuisance in tqdm(jobs, unit='scene'):
        target = folder / f'{name}_{seed}'
        if target.exists():
            continue
        height = 960 if name == 'street' and seed % 3 else 480
        sequence = render_sequence(name, seed, 14, height, spacing=step, nuisance=nuisance)
        frames: list[TruthFrame] = [sequence[k] for k in _RENDERED]
        save_sequence(frames, target.with_suffix('.part'), name)
        target.with_suffix('.part').rename(target)


def begun(generator: Any) -> Parameters:
    """Weights to start from (He et al. 2015)."""
    import torch
    made = {}
    for name, (inside, outside, size, _) in LAYERS.items():
        spread = 0.01 if name == 'tell' else np.sqrt(2 / (inside * size**2))
        weight = spread * torch.randn(outside, inside, size, size, generator=generator)
        made[f'{name}.weight'] = weight.requires_grad_()
        bias = torch.full((outside,), _BEGIN if name == 'tell' else 0.0)
        made[f'{name}.bias'] = bias.requires_grad_()
    return made


def walk(x: Node, layer: Callable[[str, Node], Node], bent: Callable[[Node], Node],
         joined: Callable[[Node, Node], Node]) -> Node:
    """Walk the network's graph from x to what comes out, each step done by the caller's means.

    layer : by its name in LAYERS; bent : the activation; joined : (coarse, fine) → fine plus
    coarse at twice the size
    """
    levels = [bent(layer('enter', x))]
    for n in (1, 2, 3):
        levels.append(bent(layer(f'stay{n}', bent(layer(f'down{n}', levels[-1])))))
    y = levels[3]
    for n in (2, 1):
        y = bent(layer(f'join{n}', joined(layer(f'up{n}', y), levels[n])))
    y = bent(joined(layer('up0', y), levels[0]))
    return layer('tell', bent(layer('join0', y)))


def forward(parts: Parameters, x: Any) -> Any:
    """Outputs (N, 4 · percentiles, rows, columns) of x (N, CHANNELS, rows, columns)."""
    from torch.nn import functional

    def layer(name: str, x: Any) -> Any:
        size, step = LAYERS[name][2:]
        return functional.conv2d(x, parts[f'{name}.weight'], parts[f'{name}.bias'], step,
                                 size // 2)

    def bent(x: Any) -> Any:
        return functional.leaky_relu(x, _LEAK)

    def joined(coarse: Any, fine: Any) -> Any:
        return fine + functional.interpolate(coarse, scale_factor=2, mode='nearest')
    return walk(x, layer, bent, joined)


def loss(out: Any, error: Any, weight: Any) -> Any:
    """Of the percentiles (quantile regression, Koenker and Bassett 1978), summed over them."""
    import torch
    from torch.nn import functional
    sizes = torch.cat([error.abs(), error.abs(), error.clamp(min=0)], 1)
    difference = torch.log(LEAST + sizes.clamp(max=MOST)) - functional.pixel_shuffle(out, 2)
    share = torch.tensor(PERCENTILES).view(1, -1, 1, 1)
    each = torch.maximum(share * difference, (share - 1) * difference)
    return (each * weight).sum() / weight.sum()


def _varied(patch: Patch, rng: np.random.Generator) -> tuple[Any, Any, Any]:
    """A part of a patch, in another light or mirrored."""
    import torch
    rows, columns = (n // 8 * 8 for n in patch.x.shape[1:])
    height = min(_ROWS, rows)
    first = int(rng.integers(0, rows - height + 1))
    x = torch.from_numpy(patch.x[:, first:first + height, :columns].astype(np.float32))[None]
    error, weight = (torch.from_numpy(np.ascontiguousarray(
        m[2 * first:2 * (first + height), :2 * columns]))[None, None]
        for m in (patch.error, patch.weight))
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


def fit(patches: Sequence[Patch], minutes: float, rng: np.random.Generator) -> Parameters:
    """Weights fitted for so long, by Adam (Kingma and Ba 2014)."""
    import torch
    parts = begun(torch.Generator().manual_seed(0))
    adam = torch.optim.Adam(parts.values(), _RATE)
    begin, number = time.monotonic(), 0
    with tqdm(unit='step') as progress:
        while (done := (time.monotonic() - begin) / (60 * minutes)) < 1:
            slower = 0.5 * (1 + np.cos(np.pi * done)) + 0.002
            adam.param_groups[0]['lr'] = _RATE * min(1, (number + 1) / 100) * slower
            adam.zero_grad()
            total = 0.0
            for _ in range(_BATCH):
                x, error, weight = _varied(patches[int(rng.integers(len(patches)))], rng)
                x = x.contiguous(memory_format=torch.channels_last)  # four times as fast
                part = loss(forward(parts, x), error, weight) / _BATCH
                part.backward()
                total += part.item()
            torch.nn.utils.clip_grad_norm_(parts.values(), 1.0)
            adam.step()
            number += 1
            progress.set_postfix(loss=round(total, 3))
            progress.update()
    return parts


def as_onnx(weights: dict[str, NDArray[np.float32]]) -> bytes:
    """The network as OpenCV reads it."""
    import onnx
    from onnx import helper, numpy_helper
    nodes, kept = [], [numpy_helper.from_array(np.array([1, 1, 2, 2], np.float32), 'twice'),
                       numpy_helper.from_array(np.array([], np.float32), 'all')]

    def node(kind: str, inputs: list[str], out: str, **options: Any) -> str:
        nodes.append(helper.make_node(kind, inputs, [out], **options))
        return out

    def layer(name: str, x: str) -> str:
        size, step = LAYERS[name][2:]
        kept.extend(numpy_helper.from_array(weights[f'{name}.{part}'], f'{name}.{part}')
                    for part in ('weight', 'bias'))
        return node('Conv', [x, f'{name}.weight', f'{name}.bias'], name, kernel_shape=[size] * 2,
                    strides=[step] * 2, pads=[size // 2] * 4)

    def bent(x: str) -> str:
        return node('LeakyRelu', [x], f'{x}.bent', alpha=_LEAK)

    def joined(coarse: str, fine: str) -> str:
        larger = node('Resize', [coarse, 'all', 'twice'], f'{coarse}.larger', mode='nearest',
                      coordinate_transformation_mode='asymmetric', nearest_mode='floor')
        return node('Add', [fine, larger], f'{coarse}.sum')
    out = walk('x', layer, bent, joined)
    kind = onnx.TensorProto.FLOAT
    graph = helper.make_graph(
        nodes, 'surroundings', [helper.make_tensor_value_info('x', kind, [1, CHANNELS, 64, 64])],
        [helper.make_tensor_value_info(out, kind, [1, LAYERS[out][1], 64, 64])], kept)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid('', 12)])
    model.ir_version = 7
    onnx.checker.check_model(model)
    return bytes(model.SerializeToString())


def main() -> None:
    """Render, or fit and save."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else '')
    commands = parser.add_subparsers(dest='command', required=True)
    commands.add_parser('render').add_argument('folder', type=Path)
    fitting = commands.add_parser('fit')
    fitting.add_argument('out', type=Path)
    fitting.add_argument('folders', type=Path, nargs='+')
    fitting.add_argument('--minutes', type=float, default=30)
    args = parser.parse_args()
    if args.command == 'render':
        render(args.folder)
        return
    rng = np.random.default_rng(0)
    patches = [p for f in tqdm(args.folders, unit='folder') for p in patches_of(f, rng)]
    parts = fit(patches, args.minutes, rng)
    args.out.write_bytes(as_onnx({name: p.detach().numpy() for name, p in parts.items()}))


if __name__ == '__main__':
    main()
