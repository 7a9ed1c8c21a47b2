"""The methods that the benchmarks set side by side: parameters by name."""
from __future__ import annotations

from collections.abc import Mapping

from sphstereo_ros.replay.parameter_files import load_values

from .processes import shipped

MATCHERS = ('flow', 'flow_fast', 'bm', 'sgbm')
# Methods that are parameter files: the paper's, and what a small computer runs live.
FILES = {'paper': 'config/paper.yaml', 'live': 'config/live.yaml'}
METHODS = ('default', *MATCHERS, *FILES)


def parameters(method: str) -> Mapping[str, object]:
    """The parameters of one of METHODS, over the defaults."""
    if method in FILES:
        return load_values([shipped(FILES[method])])
    return {} if method == 'default' else {'stereo.matcher': method}
