"""The methods that the benchmarks set side by side: parameters by name."""
from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from sphstereo_ros.replay.parameter_files import load_values

from .processes import shipped

MATCHERS = ('hybrid', 'flow', 'flow_fast', 'bm', 'bm_judged', 'sgbm')
ONE_REFERENCE: Mapping[str, object] = {'pairing.intervals': [1]}
# Matchers without memory tell the error of one frame; the shipped files with such have the same.
_NO_MEMORY: Mapping[str, object] = {'range.max_relative_sigma': 0.3}


@dataclass(frozen=True)
class Method:
    """Parameters over the defaults.

    true_pose : stages 2 and 3 are replaced by the truth
    remembers : frames before the scored ones matter (else only pairing sees them)
    """

    parameters: Mapping[str, object]
    true_pose: bool = False
    remembers: bool = False


def _file(name: str) -> Mapping[str, object]:
    return load_values([shipped(name)])


# What is compared by default: the paper's method, block matching at its best, one reference, the
# full window, and what a small computer runs live, fast or checked. A matcher's name is the full
# window with it.
COMPARED = ('paper', 'sgbm_true_pose', 'one_reference', 'default', 'live',
            'live_checked')
METHODS = (*COMPARED, *MATCHERS)
# What obstacles are looked for with.
OBSTACLE_METHODS = ('default', 'live', 'live_checked')
# With two cameras.
PAIR_METHODS = ('default', 'bm', 'sgbm', 'flow', 'hybrid', 'live')


def method(name: str, overrides: Mapping[str, object] | None = None) -> Method:
    """One of METHODS; `overrides` are parameters of the method `default` alone."""
    if name == 'paper':
        return Method({**ONE_REFERENCE, **_file('config/paper.yaml')})
    if name == 'sgbm_true_pose':
        return Method({**ONE_REFERENCE, **_NO_MEMORY, 'stereo.matcher': 'sgbm'}, true_pose=True)
    if name == 'one_reference':
        return Method(ONE_REFERENCE, remembers=True)
    if name in {'live', 'live_checked'}:
        return Method(_file(f'config/{name}.yaml'), remembers=True)
    if name in MATCHERS:
        return Method({**_NO_MEMORY, 'stereo.matcher': name}, remembers=True)
    return Method(overrides or {}, remembers=True)
