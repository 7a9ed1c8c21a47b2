"""Every shipped configuration passes the check; launch files start what they should."""
from __future__ import annotations

import runpy
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import yaml

from sphstereo_ros.core import rotations
from sphstereo_ros.core.config import PARAMETERS, Config
from sphstereo_ros.mavlink.transports import parse_url
from sphstereo_ros.replay.parameter_files import load_config, read_file

ROOT = Path(__file__).resolve().parent.parent
CONFIGS = sorted((ROOT / 'config').glob('*.yaml'))
STAGES = ['frame_pairing', 'pose_stabilisation', 'motion_alignment', 'spherical_stereo',
          'obstacle_detection']


def test_there_are_configs() -> None:
    assert [c.stem for c in CONFIGS] == ['ardupilot', 'binocular', 'binocular_live', 'default',
                                         'live', 'live_checked', 'mavros', 'paper', 'px4']


@pytest.mark.parametrize('file', CONFIGS, ids=lambda f: f.stem)
def test_config_passes_the_check(file: Path) -> None:
    assert read_file(file)
    assert (load_config([file]) == Config()) == (file.stem == 'default')


@pytest.mark.parametrize('file', [f for f in CONFIGS if f.stem != 'paper'], ids=lambda f: f.stem)
def test_config_leaves_the_baseline_open(file: Path) -> None:
    given = read_file(file)
    for name in ('baseline.length', 'pairing.baselines'):
        assert given.get(name, 0.0) == 0.0


def test_the_default_leaves_the_references_open() -> None:
    assert load_config([ROOT / 'config' / 'default.yaml'],
                       ['pairing.baselines:=[1.0]', 'baseline.length:=0.3']
                       ).pairing.baselines == (1.0,)


def test_some_configs_name_their_references() -> None:
    for name, intervals in (('paper', (1,)), ('live', (1,)), ('live_checked', (1, 3))):
        assert load_config([ROOT / 'config' / f'{name}.yaml']).pairing.intervals == intervals


@pytest.mark.parametrize('name', ['ardupilot', 'mavros', 'px4'])
def test_configs_for_autopilots_change_obstacles_alone(name: str) -> None:
    given = read_file(ROOT / 'config' / f'{name}.yaml')
    assert all(parameter.startswith('obstacles.') for parameter in given)
    url = load_config([ROOT / 'config' / f'{name}.yaml']).mavlink.url
    assert (url == '') == (name == 'mavros')
    if url:
        assert parse_url(url).kind == 'serial'


def test_mavros_is_told_the_frame() -> None:
    content = yaml.safe_load((ROOT / 'config' / 'mavros.yaml').read_text())
    assert content['/mavros/obstacle']['ros__parameters'] == {'mav_frame': 'BODY_FRD'}


def test_default_config_states_the_defaults() -> None:
    for name, value in read_file(ROOT / 'config' / 'default.yaml').items():
        assert value == PARAMETERS[name].default
    assert load_config([ROOT / 'config' / 'paper.yaml']).alignment.method == 'paper'
    assert load_config([ROOT / 'config' / 'live.yaml']).stereo.working_height == 480


class Recorded:
    """Stands for any class of launch: remembers what it was made with."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        self.args, self.kwargs = args, kwargs


class Value(Recorded):
    """A LaunchConfiguration: performs to the context's value of its name."""

    def perform(self, context: dict[str, str]) -> str:
        return context[self.args[0]]


@pytest.fixture
def launch_modules(monkeypatch: pytest.MonkeyPatch) -> None:
    """The launch API as far as the launch files use it: it cannot be installed everywhere."""
    names: dict[str, dict[str, Any]] = {
        'launch': {'LaunchDescription': Recorded},
        'launch.actions': dict.fromkeys(
            ('DeclareLaunchArgument', 'EmitEvent', 'IncludeLaunchDescription', 'OpaqueFunction',
             'RegisterEventHandler'), Recorded),
        'launch.event_handlers': {'OnProcessExit': Recorded},
        'launch.events': {'Shutdown': Recorded},
        'launch.launch_description_sources': {'PythonLaunchDescriptionSource': Recorded},
        'launch.substitutions': {'LaunchConfiguration': Value},
        'launch_ros': {}, 'launch_ros.actions': {'Node': type('Node', (Recorded,), {})},
        'ament_index_python': {},
        'ament_index_python.packages': {'get_package_share_directory': lambda _: str(ROOT)},
    }
    for name, content in names.items():
        module = ModuleType(name)
        module.__dict__.update(content)
        monkeypatch.setitem(sys.modules, name, module)


def performed(file: str, **given: str) -> list[Any]:
    """The actions of a launch file for these arguments; its defaults stand for the others."""
    description = runpy.run_path(str(ROOT / 'launch' / file))['generate_launch_description']()
    *declared, opaque = description.args[0]
    defaults = {d.args[0]: d.kwargs['default_value'] for d in declared
                if 'default_value' in d.kwargs}
    assert set(given) <= {d.args[0] for d in declared}
    return list(opaque.kwargs['function']({**defaults, **given}))


def nodes(actions: list[Any]) -> list[dict[str, Any]]:
    return [a.kwargs for a in actions if type(a).__name__ == 'Node']


@pytest.mark.usefixtures('launch_modules')
def test_pipeline_launch(tmp_path: Path) -> None:
    file = tmp_path / 'mount.yaml'
    file.write_text('/**:\n  ros__parameters:\n    camera.mount: {x: 0.5, yaw: 1.25}\n')
    started = nodes(performed('pipeline_launch.py', params_file=str(file), namespace='robot'))
    assert [n['executable'] for n in started] == [*STAGES, *['static_transform_publisher'] * 2]
    for node in started[:5]:
        assert node['package'] == 'sphstereo_ros'
        assert node['parameters'] == [str(file), {'use_sim_time': False}]
        assert node['namespace'] == 'robot'
    mount, optical = (arguments(node) for node in started[5:])
    assert (mount['--x'], mount['--yaw'], mount['--frame-id'],
            mount['--child-frame-id']) == ('0.5', '1.25', 'base_link', 'camera_link')
    turned = rotations.matrix_from_rpy(*(float(optical[f'--{axis}'])
                                         for axis in ('roll', 'pitch', 'yaw')))
    np.testing.assert_allclose(turned, rotations.OPTICAL_FROM_LINK.T, atol=1e-12)
    assert (optical['--frame-id'], optical['--child-frame-id']) == ('camera_link',
                                                                   'camera_optical')


@pytest.mark.usefixtures('launch_modules')
def test_obstacles_may_be_left_out() -> None:
    started = nodes(performed('pipeline_launch.py', params_file=str(CONFIGS[0]),
                              obstacles='false'))
    assert [n['executable'] for n in started[:-2]] == STAGES[:-1]


@pytest.mark.usefixtures('launch_modules')
def test_binocular_launch(tmp_path: Path) -> None:
    file = tmp_path / 'rig.yaml'
    file.write_text('/**:\n  ros__parameters:\n    camera.top: {roll: 0.5}\n'
                    '    baseline: {length: 0.5, direction: [0.0, 3.0, 4.0]}\n')
    default = performed('binocular_launch.py')
    assert Path(dict(default[0].kwargs['launch_arguments'])['params_file']).is_file()
    include, top, optical = performed('binocular_launch.py', params_file=str(file),
                                      top_frame='upper', bottom_frame='lower')
    assert Path(include.args[0].args[0]).is_file()
    given = dict(include.kwargs['launch_arguments'])
    assert (given['params_file'], given['camera_frame']) == (str(file), 'lower')
    link, frame = arguments(top.kwargs), arguments(optical.kwargs)
    assert [float(link[f'--{n}']) for n in ('x', 'y', 'z', 'roll', 'pitch', 'yaw')] == \
        pytest.approx([0.0, 0.3, 0.4, 0.5, 0.0, 0.0])
    assert (link['--frame-id'], link['--child-frame-id']) == ('camera_link', 'top_camera_link')
    assert (frame['--frame-id'], frame['--child-frame-id']) == ('top_camera_link', 'upper')


def arguments(node: dict[str, Any]) -> dict[str, str]:
    words = node['arguments']
    return dict(zip(words[::2], words[1::2], strict=True))


@pytest.mark.usefixtures('launch_modules')
def test_replay_launch() -> None:
    include, replay, ended = performed('replay_launch.py', bag='a.mcap', rate='0.5')
    assert Path(include.args[0].args[0]).is_file()
    given = dict(include.kwargs['launch_arguments'])
    assert (given['use_sim_time'], given['obstacles']) == ('true', 'true')
    parameters, = replay.kwargs['parameters']
    assert (parameters['replay.bag'], parameters['replay.rate']) == ('a.mcap', 0.5)
    assert set(parameters) <= set(PARAMETERS)
    assert ended.args[0].kwargs['target_action'] is replay


def test_launch_files_load_with_the_real_launch() -> None:
    pytest.importorskip('launch_ros')
    for file in (ROOT / 'launch').glob('*_launch.py'):
        assert runpy.run_path(str(file))['generate_launch_description']()
