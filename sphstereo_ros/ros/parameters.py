"""Parameters of nodes: declared from, and checked by, what `core.config` states once."""
from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any

import yaml

from sphstereo_ros.core.config import PARAMETERS, Config, Parameter, ParameterError, resolve

# Which of the package's parameters each node declares, by the beginnings of their names.
NODE_PARAMETERS: dict[str, tuple[str, ...]] = {
    'frame_pairing': ('camera.', 'baseline.', 'pairing.', 'calibration.', 'pose.', 'alignment.',
                      'stereo.working_height', 'points.colour'),
    'pose_stabilisation': ('pose.', 'camera.mask', 'pairing.', 'baseline.source',
                           'calibration.each_pair'),
    'motion_alignment': ('alignment.', 'camera.mask', 'pairing.', 'baseline.source',
                         'calibration.each_pair'),
    'spherical_stereo': ('stereo.', 'range.', 'points.', 'camera.', 'baseline.relative_sigma',
                         'pairing.'),
    'obstacle_detection': ('obstacles.', 'camera.', 'range.'),
    'pipeline': ('camera.', 'baseline.', 'pairing.', 'pose.', 'alignment.', 'calibration.',
                 'stereo.', 'range.', 'points.', 'obstacles.'),
    'mapping': ('mapping.', 'camera.', 'baseline.', 'pairing.'),
    'bag_replay': ('replay.',),
}
# Names that ROS itself declares on a node.
ROS_NAMES = ('use_sim_time', 'start_type_description_service')
ROS_PREFIX = 'qos_overrides.'


def names_of(node: str) -> tuple[str, ...]:
    """Names of the parameters that the node of that name declares."""
    return tuple(name for name in PARAMETERS if name.startswith(NODE_PARAMETERS[node]))


def given_overrides(node: Any, words: Sequence[str] = ()) -> dict[str, object]:
    """Overrides that reach `node`, without those of ROS itself.

    `[]` has no type and arrives as None; lists arrive as lists. `words` is the command line:
    rcl lets a file win over `-p` where both have different types (2 and 0.5) or the file comes
    later, so what `-p` says is taken from there.
    """
    given = {name: plain(parameter.value)
             for name, parameter in node._parameter_overrides.items()
             if name not in ROS_NAMES and not name.startswith(ROS_PREFIX)}
    told = dict(_assignments(words, node.get_name()))
    return {name: told.get(name, value) for name, value in given.items()}


def _assignments(words: Sequence[str], node: str) -> Iterator[tuple[str, object]]:
    """Names and values of `-p [node:]name:=value` among the ROS arguments."""
    of_ros = False
    for word, following in zip(words, [*words[1:], ''], strict=False):
        if word in ('--ros-args', '--'):
            of_ros = word == '--ros-args'
        elif of_ros and word in ('-p', '--param'):
            name, _, text = following.partition(':=')
            target, _, name = name.rpartition(':')
            if target in ('', node):
                yield name, _parsed(name, text)


def _parsed(name: str, text: str) -> object:
    value: object = yaml.safe_load(text)
    if isinstance(value, str) and name in PARAMETERS and PARAMETERS[name].kind is float:
        try:
            return float(value)  # YAML 1.1 takes 1e-3 for a word
        except ValueError:
            return value
    return value


def plain(value: Any) -> object:
    """A parameter's value with arrays as lists."""
    return list(value) if hasattr(value, '__iter__') and not isinstance(value, str) else value


def descriptor(spec: Parameter) -> Any:
    """rcl_interfaces/ParameterDescriptor of a parameter: meaning, unit, bounds."""
    from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor

    out = ParameterDescriptor(description=_sentence(spec), read_only=not spec.runtime)
    if spec.choices:
        out.additional_constraints = f'one of {", ".join(spec.choices)}'
    finite = math.isfinite(spec.low) and math.isfinite(spec.high)
    if finite and not spec.is_array:  # ranges bind scalars only
        if spec.kind is float:
            out.floating_point_range = [FloatingPointRange(from_value=spec.low,
                                                           to_value=spec.high)]
        elif spec.kind is int:
            out.integer_range = [IntegerRange(from_value=int(spec.low), to_value=int(spec.high),
                                              step=1)]
    elif math.isfinite(spec.low) or math.isfinite(spec.high):
        out.additional_constraints = _bounds(spec)
    return out


def _sentence(spec: Parameter) -> str:
    return f'{spec.meaning} [{spec.unit}]' if spec.unit else spec.meaning


def _bounds(spec: Parameter) -> str:
    if spec.choices:
        return ', '.join(spec.choices)
    low, high = math.isfinite(spec.low), math.isfinite(spec.high)
    if low and high:
        return f'{spec.low:g} … {spec.high:g}'
    return f'≥ {spec.low:g}' if low else f'≤ {spec.high:g}' if high else ''


class NodeParameters:
    """The package's parameters on one node.

    Attributes
    ----------
    config : Config
        the values that hold now
    on_change : called with the new Config after a change at run time

    """

    def __init__(self, node: Any, names: Iterable[str], words: Sequence[str] = ()) -> None:
        """Declare `names` on `node`, which was started by the command line `words`.

        Raises
        ------
        ParameterError
            where an override's name is unknown to the whole package, or its value is refused

        """
        self.on_change: Callable[[Config], None] = lambda config: None
        self._node = node
        self._given = given_overrides(node, words)
        self.config = resolve(self._given)
        checked = {name: PARAMETERS[name].checked(value) for name, value in self._given.items()}
        for name in names:
            spec = PARAMETERS[name]
            value = checked.get(name, spec.default)
            node.declare_parameter(name, list(value) if isinstance(value, tuple) else value,
                                   descriptor(spec), ignore_override=True)
        node.add_on_set_parameters_callback(self._check)
        node.add_post_set_parameters_callback(self._apply)

    def _with(self, changes: Iterable[Any]) -> dict[str, object]:
        """What is given once `changes` hold."""
        new = {change.name: plain(change.value) for change in changes
               if change.name in PARAMETERS}
        given = {**self._given, **new}
        name = 'pairing.intervals'
        # At run time a node goes back to a default by setting it: that is not giving one.
        if name not in new and given.get(name) == list(PARAMETERS[name].default):  # type: ignore[arg-type]
            del given[name]
        return given

    def _check(self, changes: list[Any]) -> Any:
        from rcl_interfaces.msg import SetParametersResult

        try:
            resolve(self._with(changes))
        except ParameterError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _apply(self, changes: list[Any]) -> None:
        given = self._with(changes)
        config = resolve(given)
        self._given = given
        if config != self.config:
            self.config = config
            self.on_change(config)


def documentation_table(parameters: Mapping[str, Parameter] = PARAMETERS) -> str:
    """Markdown table of all parameters."""
    rows = ['| name | type | default | unit | bounds | at run time | meaning |',
            '|---|---|---|---|---|---|---|']
    for spec in parameters.values():
        kind = spec.kind.__name__ + ('[]' if spec.is_array else '')
        default = list(spec.default) if isinstance(spec.default, tuple) else spec.default
        shown = str(default).lower() if spec.kind is bool else str(default)
        rows.append(f'| `{spec.name}` | {kind} | {shown} | {spec.unit} | {_bounds(spec)} '
                    f'| {"yes" if spec.runtime else "no"} | {spec.meaning} |')
    return '\n'.join(rows) + '\n'


if __name__ == '__main__':
    print(documentation_table(), end='')
