"""U-nets (Ronneberger et al. 2015) while they are fitted: weights, gradients, and as files.

They need torch and onnx (extra `fit`); the package itself does without.
"""
from __future__ import annotations

import argparse
import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar, cast
from zlib import crc32

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

Parameters = dict[str, Any]  # name of a layer → weight and bias
Node = TypeVar('Node')
Patch = TypeVar('Patch')

_LEAK = 0.1
_RATE = 3e-3
_WARM = 100  # steps until the rate is full


@dataclass(frozen=True)
class Design:
    """Channels at the input, at the first size and at each halving of it, before the end, and of
    the outputs.

    begin : biases of the outputs to start from
    step : 1, or 2 where the first size is half of the input's
    deep : whether there is a second layer at the first size before it is halved
    """

    channels: int
    widths: Sequence[int]
    last: int
    begin: Sequence[float]
    step: int = 1
    deep: bool = False

    @property
    def layers(self) -> dict[str, tuple[int, int, int, int]]:
        """Inputs, outputs, size of the kernel and step of each layer, by name."""
        found = {'enter': (self.channels, self.widths[0], 3, self.step)}
        if self.deep:
            found['stay0'] = (self.widths[0], self.widths[0], 3, 1)
        for n, (fine, coarse) in enumerate(itertools.pairwise(self.widths), 1):
            found[f'down{n}'], found[f'stay{n}'] = (fine, coarse, 3, 2), (coarse, coarse, 3, 1)
            found[f'up{n - 1}'] = (coarse, fine, 1, 1)
            found[f'join{n - 1}'] = (fine, fine if n > 1 else self.last, 3, 1)
        return found | {'tell': (self.last, len(self.begin), 1, 1)}

    def begun(self, generator: Any) -> Parameters:
        """Weights to start from (He et al. 2015); a second layer at first passes on what it gets.
        """
        import torch
        made = {}
        for name, (inside, outside, size, _) in self.layers.items():
            spread = 0.01 if name == 'tell' else np.sqrt(2 / (inside * size**2))
            weight = spread * torch.randn(outside, inside, size, size, generator=generator)
            if name == 'stay0':
                weight = torch.nn.init.dirac_(weight)
            bias = torch.tensor(self.begin) if name == 'tell' else torch.zeros(outside)
            made[f'{name}.weight'] = weight.requires_grad_()
            made[f'{name}.bias'] = bias.float().requires_grad_()
        return made

    def _walk(self, x: Node, layer: Callable[[str, Node], Node], bent: Callable[[Node], Node],
              joined: Callable[[Node, Node], Node]) -> Node:
        """Walk the network's graph from x to what comes out, each step done by the caller's means.

        layer : by its name; bent : the activation; joined : (coarse, fine) → fine plus coarse at
        twice the size
        """
        deepest = len(self.widths) - 1
        levels = [bent(layer('enter', x))]
        if self.deep:
            levels[0] = bent(layer('stay0', levels[0]))
        for n in range(1, deepest + 1):
            levels.append(bent(layer(f'stay{n}', bent(layer(f'down{n}', levels[-1])))))
        y = levels[deepest]
        for n in range(deepest - 1, 0, -1):
            y = bent(layer(f'join{n}', joined(layer(f'up{n}', y), levels[n])))
        y = bent(joined(layer('up0', y), levels[0]))
        return layer('tell', bent(layer('join0', y)))

    def forward(self, parts: Parameters, x: Any) -> Any:
        """Outputs (N, outputs, rows, columns) of x (N, channels, step · rows, step · columns)."""
        from torch.nn import functional
        layers = self.layers

        def layer(name: str, x: Any) -> Any:
            size, step = layers[name][2:]
            return functional.conv2d(x, parts[f'{name}.weight'], parts[f'{name}.bias'], step,
                                     size // 2)

        def bent(x: Any) -> Any:
            return functional.leaky_relu(x, _LEAK)

        def joined(coarse: Any, fine: Any) -> Any:
            return fine + functional.interpolate(coarse, scale_factor=2, mode='nearest')
        return self._walk(x, layer, bent, joined)

    def fitted(self, draw: Callable[[], tuple[Any, ...]], loss: Callable[..., Any], steps: int,
               batch: int, start: dict[str, NDArray[np.float32]] | None = None,
               rate: float = _RATE, bfloat16: bool = False) -> Parameters:
        """Weights after so many steps of Adam (Kingma and Ba 2014), from `start` if there is one.

        draw : gives a sample: x, and what else the loss asks for; `batch` of them make a step
        loss : (outputs, what else was drawn) → how wrong they are
        start : one that saw and told less, or had fewer channels, goes on, too
        rate : of learning; of one that goes on with new outputs, 3e-3 diverged
        bfloat16 : whether convolutions are done in it: twice as fast where the CPU can
        """
        import torch
        parts = self.begun(torch.Generator().manual_seed(0))
        for name, value in (start or {}).items():
            if value.ndim > 1:
                parts[name].data[:, value.shape[1]:] = 0  # what is new changes nothing yet
            parts[name].data[tuple(slice(n) for n in value.shape)] = torch.from_numpy(value.copy())
        adam = torch.optim.Adam(parts.values(), rate)
        progress = tqdm(range(steps), unit='step')
        for number in progress:
            slower = 0.5 * (1 + np.cos(np.pi * number / steps)) + 0.002
            adam.param_groups[0]['lr'] = rate * min(1, (number + 1) / _WARM) * slower
            adam.zero_grad()
            total = 0.0
            for _ in range(batch):
                x, *wanted = draw()
                x = x.contiguous(memory_format=torch.channels_last)  # four times as fast
                with torch.autocast('cpu', torch.bfloat16, enabled=bfloat16):
                    out = self.forward(parts, x)
                part = loss(out.float(), *wanted) / batch
                part.backward()
                total += part.item()
            torch.nn.utils.clip_grad_norm_(parts.values(), 1.0)
            adam.step()
            progress.set_postfix(loss=round(total, 3))
        return parts

    def as_onnx(self, weights: dict[str, NDArray[np.float32]]) -> bytes:
        """The network as OpenCV reads it."""
        import onnx
        from onnx import helper, numpy_helper
        layers = self.layers
        nodes, kept = [], [numpy_helper.from_array(np.array([1, 1, 2, 2], np.float32), 'twice'),
                           numpy_helper.from_array(np.array([], np.float32), 'all')]

        def node(kind: str, inputs: list[str], out: str, **options: Any) -> str:
            nodes.append(helper.make_node(kind, inputs, [out], **options))
            return out

        def layer(name: str, x: str) -> str:
            size, step = layers[name][2:]
            kept.extend(numpy_helper.from_array(weights[f'{name}.{part}'], f'{name}.{part}')
                        for part in ('weight', 'bias'))
            return node('Conv', [x, f'{name}.weight', f'{name}.bias'], name,
                        kernel_shape=[size] * 2, strides=[step] * 2, pads=[size // 2] * 4)

        def bent(x: str) -> str:
            return node('LeakyRelu', [x], f'{x}.bent', alpha=_LEAK)

        def joined(coarse: str, fine: str) -> str:
            larger = node('Resize', [coarse, 'all', 'twice'], f'{coarse}.larger', mode='nearest',
                          coordinate_transformation_mode='asymmetric', nearest_mode='floor')
            return node('Add', [fine, larger], f'{coarse}.sum')
        out = self._walk('x', layer, bent, joined)
        kind = onnx.TensorProto.FLOAT
        graph = helper.make_graph(
            nodes, 'network',
            [helper.make_tensor_value_info('x', kind, [1, self.channels, 64, 64])],
            [helper.make_tensor_value_info(out, kind, [1, len(self.begin), 64, 64])], kept)
        model = helper.make_model(graph, opset_imports=[helper.make_opsetid('', 12)])
        model.ir_version = 7
        onnx.checker.check_model(model)
        return bytes(model.SerializeToString())

    def weights_of(self, model: bytes) -> dict[str, NDArray[np.float32]]:
        """The weights in what `as_onnx` made, by name."""
        import onnx
        from onnx import numpy_helper
        graph = onnx.load_from_string(model).graph
        found = {t.name: numpy_helper.to_array(t) for t in graph.initializer}
        return {name: value for name, value in found.items()
                if name.partition('.')[0] in self.layers}


def plain(parts: Parameters) -> dict[str, NDArray[np.float32]]:
    """Weights as arrays."""
    return {name: part.detach().numpy() for name, part in parts.items()}


def fit_arguments(parser: argparse.ArgumentParser, steps: int) -> None:
    """What every fit by command is told."""
    parser.add_argument('out', type=Path)
    parser.add_argument('folders', type=Path, nargs='+')
    parser.add_argument('--steps', type=int, default=steps)
    parser.add_argument('--start', type=Path, help='network to go on from')
    parser.add_argument('--bfloat16', action='store_true', help='convolve in bfloat16: twice as '
                        'fast where the CPU can')
    parser.add_argument('--patches', type=Path, metavar='DIR', help='keep what was measured here, '
                        'and find it the next time; read as it is needed, not held in memory')


def known_truth(patches: Sequence[Patch], least: float) -> list[Patch]:
    """Those of which so large a share of the truth is known, by their `weight`.

    Raises ValueError where there is none.
    """
    known = [p for p in patches if cast(Any, p).weight.mean(dtype=np.float64) > least]
    if not known:
        raise ValueError('of no patch enough of the truth is known')
    return known


def render_or_fit(about: str | None, steps: int, render: Callable[[Path], None], design: Design,
                  kind: Callable[..., Patch],
                  patches_of: Callable[[Path, np.random.Generator], list[Patch]],
                  fit: Callable[..., Parameters]) -> None:
    """The commands of a network's module: `render FOLDER`, and `fit` as of `save_fit`."""
    parser = argparse.ArgumentParser(description=about.splitlines()[0] if about else '')
    commands = parser.add_subparsers(dest='command', required=True)
    commands.add_parser('render').add_argument('folder', type=Path)
    fit_arguments(commands.add_parser('fit'), steps)
    given = parser.parse_args()
    if given.command == 'render':
        render(given.folder)
    else:
        save_fit(given, design, kind, patches_of, fit)


def save_fit(given: argparse.Namespace, design: Design, kind: Callable[..., Patch],
             patches_of: Callable[[Path, np.random.Generator], list[Patch]],
             fit: Callable[..., Parameters]) -> None:
    """Fit to the patches of all folders, and save: as `fit_arguments` were given.

    kind, patches_of : a dataclass of arrays and numbers, and what gives those of a folder
    fit : (patches, steps, rng, weights to start from or None, whether in bfloat16) → weights
    """
    patches = [p for f in tqdm(given.folders, unit='folder')
               for p in kept_patches(f, given.patches, kind, patches_of)]
    start = design.weights_of(given.start.read_bytes()) if given.start else None
    rng = np.random.default_rng(0)
    given.out.write_bytes(design.as_onnx(plain(fit(
        patches, given.steps, rng, start, given.bfloat16))))


def kept_patches(folder: Path, kept: Path | None, kind: Callable[..., Patch],
                 patches_of: Callable[[Path, np.random.Generator], list[Patch]]) -> list[Patch]:
    """Patches of a rendered sequence; in files of `kept`, if it is given, and of that `kind`."""
    rng = np.random.default_rng(crc32(folder.name.encode()))
    if kept is None:
        return patches_of(folder, rng)
    target, part = kept / folder.name, kept / f'{folder.name}.part'
    if not target.exists():
        part.mkdir(parents=True, exist_ok=True)
        for n, patch in enumerate(patches_of(folder, rng)):
            _to_files(patch, part / str(n))
        part.rename(target)
    return [_from_files(kind, p) for p in sorted(target.iterdir())]


def _to_files(patch: Any, folder: Path) -> None:
    folder.mkdir(exist_ok=True)
    for name, value in vars(patch).items():
        np.save(folder / f'{name}.npy', value)


def _from_files(kind: Callable[..., Patch], folder: Path) -> Patch:
    found = {f.stem: np.load(f, mmap_mode='r') for f in folder.glob('*.npy')}
    return kind(**{name: m if m.ndim else m.item() for name, m in found.items()})


def percentile_loss(told: Any, error: Any, weight: Any, least: float, most: float,
                    percentiles: Sequence[float]) -> Any:
    """Of the logarithms of the error's percentiles, the last of how much it is positive (quantile
    regression, Koenker and Bassett 1978): (N, percentiles, …) against error and weight (N, 1, …).
    """
    import torch
    sizes = torch.cat([error.abs()] * (len(percentiles) - 1) + [error.clamp(min=0)], 1)
    difference = torch.log(least + sizes.clamp(max=most)) - told
    share = torch.tensor(percentiles).view(1, -1, 1, 1)
    each = torch.maximum(share * difference, (share - 1) * difference)
    return (each * weight).sum() / weight.sum()
