"""A warm stage meets its first frames without compiling anything."""
from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

# Runs in a process of its own, with an empty cache: argv is stage, parameters (a dict).
SCRIPT = '''
import sys
import numpy as np
from numba.core import event
from room import forward
from sphstereo_ros.core.alignment import Aligner
from sphstereo_ros.core.config import resolve
from sphstereo_ros.core.frames import (AlignedWindow, Drop, PairedWindow, Reference, RelativePose,
                                       StabilisedWindow)
from sphstereo_ros.core.stabilisation import Stabiliser
from sphstereo_ros.core.stereo import SphericalStereo

made = {'stabiliser': (Stabiliser, PairedWindow), 'aligner': (Aligner, StabilisedWindow),
        'stereo': (SphericalStereo, AlignedWindow)}
stage, window = made[sys.argv[1]]
frames = forward(4, 0.28, 240)
pose = RelativePose(np.eye(3), np.array([0.0, 0.0, -0.28]))
step = stage(resolve(eval(sys.argv[2])))
step.warm_up()

class Listener(event.Listener):
    def on_start(self, e):
        print('compiled', e.data['dispatcher'].py_func.__name__)
    def on_end(self, e):
        pass

event.register('numba:compile', Listener())
far = RelativePose(np.eye(3), 2 * pose.position)
windows = [window(current, (Reference(reference, pose),))
           for reference, current in zip(frames, frames[1:])]
if sys.argv[1] == 'stereo':
    windows.append(window(frames[3], (Reference(frames[2], pose), Reference(frames[1], far))))
for one in windows:
    result = step.process(one)
    print('dropped', result) if isinstance(result, Drop) else print('done')
'''


@pytest.mark.parametrize(('stage', 'parameters'), [
    ('stabiliser', {}), ('aligner', {}), ('aligner', {'alignment.method': 'paper'}),
    *(('stereo', {'stereo.matcher': m}) for m in (
        'joint', 'joint_fast', 'hybrid', 'flow', 'bm', 'bm_judged'))],
    ids=lambda p: p if isinstance(p, str) else '-'.join(p.values()) or 'default')
def test_nothing_is_compiled_after_the_warm_up(stage: str, parameters: dict[str, str],
                                               tmp_path: Path) -> None:
    here = Path(__file__).resolve().parent
    done = subprocess.run(
        [sys.executable, '-c', SCRIPT, stage, repr(parameters)], stdout=subprocess.PIPE,
        check=True, timeout=120,
        env={**os.environ, 'NUMBA_CACHE_DIR': str(tmp_path), 'PYTHONPATH': str(here)})
    assert done.stdout.decode().split('\n') == ['done'] * (4 if stage == 'stereo' else 3) + ['']
