"""ROS 2 parameter files and `-p name:=value`, for commands that run without ROS."""
from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml

from sphstereo_ros.core.config import Config, ParameterError, resolve
from sphstereo_ros.ros.parameters import NODE_PARAMETERS, ROS_NAMES, ROS_PREFIX, names_of

_KEY = 'ros__parameters'
_EVERY_NODE = ('*', '**')


class _Loader(yaml.SafeLoader):
    """Reads 1e-3 as a number, as ROS and YAML 1.2 do; YAML 1.1 wants 1.0e-3."""


_Loader.add_implicit_resolver('tag:yaml.org,2002:float',
                              re.compile(r'^[-+]?\d+(\.\d*)?[eE][-+]?\d+$'), list('-+0123456789'))


def load_values(files: Sequence[Path] = (), overrides: Sequence[str] = ()) -> dict[str, object]:
    """Parameters of files (later ones win) and of `name:=value` overrides (which always win).

    Those of ROS itself are left out.

    Raises
    ------
    ParameterError
        where a file or an override cannot be read

    """
    given: dict[str, object] = {}
    for file in files:
        given.update(read_file(file))
    for text in overrides:
        name, value = _override(text)
        given[name] = value
    return {name: value for name, value in given.items() if not _of_ros(name)}


def load_config(files: Sequence[Path] = (), overrides: Sequence[str] = ()) -> Config:
    """The Config of parameter files and overrides.

    Raises
    ------
    ParameterError
        as `load_values`, or where a parameter is unknown to all nodes, or refused

    """
    return resolve(load_values(files, overrides))


def _of_ros(name: str) -> bool:
    return name in ROS_NAMES or name.startswith(ROS_PREFIX)


def _override(text: str) -> tuple[str, object]:
    name, assigned, value = text.partition(':=')
    if not assigned or not name:
        raise ParameterError(f'-p {text}: needs NAME:=VALUE')
    try:
        return name, yaml.load(value, _Loader)
    except (yaml.YAMLError, ValueError) as error:
        raise ParameterError(f'-p {text}: {_one_line(error)}') from error


def read_file(path: Path) -> dict[str, object]:
    """Parameters that a ROS 2 parameter file gives to the nodes of this package.

    An entry for one node gives it what it declares, and wins over `/**`. Entries for nodes of
    other packages are left alone.

    Raises
    ------
    ParameterError
        where the file is none, or gives two nodes different values of one parameter

    """
    try:
        content = yaml.load(path.read_text(encoding='utf-8'), _Loader)
    except OSError as error:
        raise ParameterError(f'{path}: {error.strerror}') from error
    except (yaml.YAMLError, ValueError) as error:
        raise ParameterError(f'{path}: {_one_line(error)}') from error
    if content is None:
        return {}
    if not isinstance(content, Mapping):
        raise ParameterError(f'{path}: is no ROS 2 parameter file')
    shared: dict[str, object] = {}
    special: dict[str, tuple[str, object]] = {}
    for node, values in _entries(content, path):
        if node in _EVERY_NODE:
            shared.update(values)
            continue
        own = names_of(node)
        resolve({n: v for n, v in values.items() if not _of_ros(n)})  # an unknown name is refused
        for name, value in values.items():
            if name not in own:
                continue
            other, before = special.get(name, (node, value))
            if other != node and before != value:
                raise ParameterError(f'{path}: {name} is {before!r} for {other} but {value!r} '
                                     f'for {node}')
            special[name] = node, value
    return {**shared, **{name: value for name, (_, value) in special.items()}}


def _one_line(error: Exception) -> str:
    return ' '.join(str(error).split())[:200]


def _entries(content: Mapping[Any, Any], path: Path) -> Iterator[tuple[str, dict[str, object]]]:
    """(name of the node without its namespace, parameters) of nodes that concern this package."""
    for key, value in content.items():
        if not isinstance(value, Mapping):
            raise ParameterError(f'{path}: {key}: is no node with {_KEY}')
        node = str(key).rsplit('/', 1)[-1]
        if _KEY in value:
            parameters = value[_KEY] or {}
            if not isinstance(parameters, Mapping):
                raise ParameterError(f'{path}: {key}: {_KEY} is no table of names and values')
            if node in _EVERY_NODE or node in NODE_PARAMETERS:
                yield node, dict(_flat(parameters))
        else:  # a namespace
            yield from _entries(value, path)


def _flat(values: Mapping[Any, Any], prefix: str = '') -> Iterator[tuple[str, object]]:
    for key, value in values.items():
        name = f'{prefix}{key}'
        if isinstance(value, Mapping):
            yield from _flat(value, f'{name}.')
        else:
            yield name, value
