"""The methods that the benchmarks set side by side: parameters by name."""
from __future__ import annotations

from collections.abc import Mapping

METHODS: dict[str, Mapping[str, object]] = {
    'default': {},
    'flow': {'stereo.matcher': 'flow'},
    'flow_fast': {'stereo.matcher': 'flow_fast'},
    'bm': {'stereo.matcher': 'bm'},
    'sgbm': {'stereo.matcher': 'sgbm'},
    # config/paper.yaml: five-point, window ratios, StereoBM with 96 disparities.
    'paper': {'stereo.matcher': 'bm', 'alignment.method': 'paper'},
    # The matchers and sizes of config/live.yaml.
    'live': {'stereo.matcher': 'bm', 'stereo.working_height': 480, 'stereo.num_disparities': 48,
             'stereo.block_size': 11, 'pose.max_points': 1200, 'pose.working_height': 240,
             'alignment.max_points': 1500, 'alignment.working_height': 320},
}
