"""What pip, colcon and rosdep read agrees with the code."""
from __future__ import annotations

import builtins
import importlib
import os
import re
import runpy
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import Any

import pytest

import sphstereo_ros
from sphstereo_ros.cli import nodes
from sphstereo_ros.ros.parameters import NODE_PARAMETERS

ROOT = Path(__file__).resolve().parent.parent


@pytest.fixture
def setup(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """What setup.py gives to setuptools."""
    setuptools = pytest.importorskip('setuptools')
    given: dict[str, Any] = {}
    monkeypatch.setattr(setuptools, 'setup', lambda **fields: given.update(fields))
    monkeypatch.chdir(ROOT)
    runpy.run_path('setup.py')
    return given


def test_one_version_everywhere(setup: dict[str, Any]) -> None:
    package = ElementTree.parse(ROOT / 'package.xml').getroot()
    assert package.findtext('version') == setup['version'] == sphstereo_ros.__version__
    assert package.findtext('name') == setup['name'] == 'sphstereo_ros'
    assert package.findtext('license') == setup['license'] == 'Apache-2.0'


def test_every_node_is_a_command(setup: dict[str, Any]) -> None:
    commands = dict(re.split(r'\s*=\s*', entry) for entry in
                    setup['entry_points']['console_scripts'])
    assert commands.keys() == {*NODE_PARAMETERS, 'sphstereo'}
    for target in commands.values():
        module, _, name = target.partition(':')
        assert callable(getattr(importlib.import_module(module), name))


@pytest.mark.parametrize('name', sorted(NODE_PARAMETERS))
def test_a_node_without_ros_says_so_in_one_line(name: str, monkeypatch: pytest.MonkeyPatch,
                                                capsys: pytest.CaptureFixture[str]) -> None:
    real = builtins.__import__

    def no_ros(module: str, *args: Any, **kwargs: Any) -> Any:
        if module.split('.')[0] == 'rclpy':
            raise ModuleNotFoundError(f"No module named '{module}'", name=module)
        return real(module, *args, **kwargs)
    for module in [m for m in sys.modules if m.startswith(('sphstereo_ros.nodes',
                                                           'sphstereo_ros.ros.shell',
                                                           'sphstereo_ros.ros.qos',
                                                           'sphstereo_ros.ros.stage'))]:
        monkeypatch.delitem(sys.modules, module)
    monkeypatch.setattr(builtins, '__import__', no_ros)
    assert getattr(nodes, name)() == 2
    out, err = capsys.readouterr()
    assert not out
    assert err.startswith(f'{name}: needs ROS 2, and there is no rclpy')
    assert err.count('\n') == 1


def test_a_broken_package_is_no_missing_ros(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, 'sphstereo_ros.nodes.pipeline', None)
    with pytest.raises(ModuleNotFoundError, match=r'sphstereo_ros\.nodes\.pipeline'):
        nodes.pipeline()


def test_shipped_files_are_installed(setup: dict[str, Any]) -> None:
    files = {Path(folder, Path(file).name) for folder, listed in setup['data_files']
             for file in listed}
    share = Path('share/sphstereo_ros')
    assert {share / 'package.xml', share / 'config/live.yaml', share / 'launch/replay_launch.py',
            Path('share/ament_index/resource_index/packages/sphstereo_ros')} <= files
    assert len([f for f in files if f.parent == share / 'config']) == len(
        list((ROOT / 'config').iterdir()))
    assert all(Path(file).is_file() for _, listed in setup['data_files'] for file in listed)
    assert (ROOT / 'resource/sphstereo_ros').stat().st_size == 0
    assert 'pytest' in setup['extras_require']['test']  # else colcon runs no tests
    assert not any(p.startswith('test') for p in setup['packages'])
    profiles = list((ROOT / 'sphstereo_ros/ros').glob('*.xml'))
    assert profiles
    web = [file for file in (ROOT / 'sphstereo_ros/report/web').iterdir() if file.is_file()]
    assert 'three.min.js' in {file.name for file in web}
    assert {*profiles, *web} <= {
        match for pattern in setup['package_data']['sphstereo_ros']
        for match in (ROOT / 'sphstereo_ros').glob(pattern)}


def test_scripts_go_where_ros2_run_looks() -> None:
    text = (ROOT / 'setup.cfg').read_text()
    assert re.findall(r'(\w+) ?= ?(\S+)', text) == [
        ('script_dir', '$base/lib/sphstereo_ros'), ('install_scripts', '$base/lib/sphstereo_ros')]


def test_imported_ros_packages_are_dependencies() -> None:
    package = ElementTree.parse(ROOT / 'package.xml').getroot()
    declared = {node.text for node in package.iter('exec_depend')}
    text = '\n'.join(path.read_text() for folder in ('sphstereo_ros', 'launch')
                     for path in (ROOT / folder).rglob('*.py'))
    used = set(re.findall(r"'(\w+_msgs|\w+_interfaces)/msg/", text))
    used |= set(re.findall(r'^ *(?:from|import) (rclpy|launch_ros|launch|\w+_msgs|\w+_interfaces|'
                           r'ament_index_python)\b', text, re.MULTILINE))
    assert {'rclpy', 'sensor_msgs', 'launch_ros'} <= used
    assert used - {'px4_msgs'} <= declared  # that one comes with a workspace of PX4's


def test_pins_name_every_dependency_once(setup: dict[str, Any]) -> None:
    pins = [line for line in (ROOT / 'requirements/constraints.txt').read_text().splitlines()
            if not line.startswith('#')]
    for line in pins:
        assert re.fullmatch(r"[a-z0-9-]+==[\w.]+(; python_version (>=|<) '3\.11')?", line), line
    names = [line.split('==')[0] for line in pins if '< ' not in line]
    assert len(names) == len(set(names))
    wanted = [*setup['install_requires'], *(r for extra in setup['extras_require'].values()
                                            for r in extra)]
    assert {re.split(r'[<>=]', r)[0].lower() for r in wanted} <= set(names)


@pytest.mark.parametrize('given', [None, '3'])
def test_blas_has_one_thread_unless_told(given):
    environment = {k: v for k, v in os.environ.items() if k != 'OPENBLAS_NUM_THREADS'}
    if given:
        environment['OPENBLAS_NUM_THREADS'] = given
    code = ('import sphstereo_ros, os, sys; assert "numpy" not in sys.modules; '
            'print(os.environ["OPENBLAS_NUM_THREADS"])')
    told = subprocess.run([sys.executable, '-c', code], env=environment, capture_output=True,
                          text=True, check=True)
    assert told.stdout.strip() == (given or '1')
