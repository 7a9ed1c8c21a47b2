from __future__ import annotations

import dataclasses
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sphstereo_ros.core.config import PARAMETERS, Config, Parameter, ParameterError, resolve

NUMBERS = [p for p in PARAMETERS.values() if p.kind in (int, float)]
CHOSEN = [p for p in PARAMETERS.values() if p.choices]
BY_NAME = {'ids': lambda p: p.name}


def given_as(parameter: Parameter, value: object) -> object:
    if parameter.name == 'baseline.direction':
        return [value] * 3
    return [value] if parameter.is_array else value


def default_of(parameter: Parameter) -> object:
    """The default as a parameter file gives it: lists, not tuples."""
    return list(parameter.default) if parameter.is_array else parameter.default


def another(parameter: Parameter) -> object:
    """A legal value that is not the default."""
    fitting = {bool: (False, True), str: ('x',), int: (1, 2, 32, 21), float: (0.01, 0.02, 0.4)}
    candidates = parameter.choices or fitting[parameter.kind] + tuple(
        parameter.kind(b) for b in (parameter.low, parameter.high) if math.isfinite(b))
    odd = {'stereo.block_size': (21,), 'stereo.num_disparities': (32,)}
    return next((value for value in odd.get(parameter.name, candidates)
                 if given_as(parameter, value) != default_of(parameter)
                 and (isinstance(value, str) or parameter.low <= value <= parameter.high)),
                parameter.default)


def test_nothing_given_is_all_defaults():
    assert resolve({}) == Config()


@pytest.mark.parametrize('parameter', PARAMETERS.values(), **BY_NAME)
def test_every_default_passes_its_own_check(parameter):
    value = parameter.checked(parameter.default)
    assert value == parameter.default
    assert type(value) is type(parameter.default)
    assert resolve({parameter.name: default_of(parameter)}) == Config()


@pytest.mark.parametrize('parameter', PARAMETERS.values(), **BY_NAME)
def test_every_parameter_says_what_it_means_and_no_default_is_an_empty_list(parameter):
    assert parameter.meaning
    assert parameter.default != ()
    assert parameter.low < parameter.high


@pytest.mark.parametrize('parameter', PARAMETERS.values(), **BY_NAME)
def test_a_value_reaches_its_own_field_and_no_other(parameter):
    other = another(parameter)
    together = {'baseline.length': 0.3} if parameter.name == 'pairing.baselines' else {}
    before = resolve(together)
    after = resolve({**together, parameter.name: given_as(parameter, other)})
    changed = {f'{g.name}.{f.name}': getattr(getattr(after, g.name), f.name)
               for g in dataclasses.fields(Config)
               for f in dataclasses.fields(getattr(after, g.name))
               if getattr(getattr(after, g.name), f.name)
               != getattr(getattr(before, g.name), f.name)}
    if len(parameter.choices) == 1:
        assert changed == {}
    else:
        assert list(changed.values()) == [tuple(given_as(parameter, other))
                                          if parameter.is_array else other]


@pytest.mark.parametrize('parameter', NUMBERS, **BY_NAME)
def test_bounds_belong_and_what_is_beyond_does_not(parameter):
    step = 1 if parameter.kind is int else 1e-6
    for bound, beyond in ((parameter.low, -step), (parameter.high, step)):
        if not math.isfinite(bound):
            continue
        at = parameter.kind(bound)
        assert parameter.checked(given_as(parameter, at)) == (
            tuple(given_as(parameter, at)) if parameter.is_array else at)
        outside = at + beyond * max(1, abs(at))
        with pytest.raises(ParameterError, match=f'^{parameter.name}: .* is outside'):
            parameter.checked(given_as(parameter, outside))


@pytest.mark.parametrize('parameter', [p for p in NUMBERS if p.kind is float], **BY_NAME)
def test_no_number_is_not_finite(parameter):
    for value in (math.nan, math.inf, -math.inf):
        with pytest.raises(ParameterError, match='is outside'):
            resolve({parameter.name: given_as(parameter, value)})


@pytest.mark.parametrize('parameter', PARAMETERS.values(), **BY_NAME)
def test_only_its_own_type_passes(parameter):
    """A bool is no number, a whole number is a float, a float is no whole number."""
    samples = {bool: True, int: 1, float: 0.5, str: 'flow'}
    wrong = [value for kind, value in samples.items()
             if kind is not parameter.kind and (kind, parameter.kind) != (int, float)]
    wrong += [None, {}, [], [0.5, 'x'], [[0.5]], b'x']
    if parameter.is_array:
        wrong = [*wrong, *([value] for value in wrong), samples[parameter.kind]]
    else:
        wrong.append([samples[parameter.kind]])
    for value in wrong:
        with pytest.raises(ParameterError, match=f'^{parameter.name}: needs '):
            parameter.checked(value)


def test_a_whole_number_becomes_a_float_where_one_is_needed():
    assert type(resolve({'baseline.length': 2}).baseline.length) is float


@pytest.mark.parametrize('parameter', CHOSEN, **BY_NAME)
def test_only_the_choices_pass(parameter):
    for choice in parameter.choices:
        assert parameter.checked(choice) == choice
    for wrong in ('', parameter.choices[0].upper(), parameter.choices[0] + ' '):
        with pytest.raises(ParameterError, match='is none of'):
            parameter.checked(wrong)


@given(st.text().filter(lambda name: name not in PARAMETERS))
def test_unknown_names_are_refused(name):
    with pytest.raises(ParameterError, match='no node of this package'):
        resolve({name: 1})


def test_lists_arrive_as_tuples():
    assert resolve({'pairing.intervals': [1, 5]}).pairing.intervals == (1, 5)
    config = resolve({'pairing.baselines': [1, 0.5], 'baseline.length': 0.1})
    assert config.pairing.baselines == (1.0, 0.5)
    assert all(isinstance(b, float) for b in config.pairing.baselines)
    for wrong in ([1, True], [1, 2.0], [0], [1, 'a'], 'abc', 3):
        with pytest.raises(ParameterError, match=r'^pairing\.intervals'):
            resolve({'pairing.intervals': wrong})


@pytest.mark.parametrize(('values', 'reason'), [
    ({'pairing.intervals': [1], 'pairing.baselines': [0.5], 'baseline.length': 0.3}, 'not both'),
    ({'pairing.baselines': [0.0, 0.5], 'baseline.length': 0.3}, 'cannot stand beside'),
    ({'pairing.baselines': [0.5]}, 'tells no metres'),
    ({'pairing.baselines': [0.5], 'baseline.source': 'speed', 'baseline.length': 0.3},
     'tells no metres'),
    ({'stereo.num_disparities': 100}, 'multiple of 16'),
    ({'stereo.block_size': 14}, 'odd'),
    ({'range.min': 5.0, 'range.max': 5.0}, 'less than range.max'),
    ({'range.min': 121.0}, 'less than range.max'),
    ({'baseline.direction': [0.0, 0.0, 0.0]}, 'is no direction'),
    ({'baseline.direction': [0.0, 1.0]}, 'is no direction'),
])
def test_values_that_exclude_each_other(values, reason):
    with pytest.raises(ParameterError, match=reason):
        resolve(values)


@pytest.mark.parametrize('values', [
    {'pairing.intervals': [1, 5], 'pairing.baselines': [0.0]},  # 0 = unused
    {'pairing.baselines': [0.5], 'baseline.length': 0.3},
    {'pairing.baselines': [0.5], 'baseline.source': 'speed', 'baseline.speed': 3.0},
    {'pairing.baselines': [0.5], 'baseline.source': 'odometry'},
    {'range.min': 4.9, 'range.max': 5.0}])
def test_values_that_go_together(values):
    assert resolve(values) != Config()


def test_groups_cannot_be_changed_after_the_check():
    config = resolve({})
    with pytest.raises(dataclasses.FrozenInstanceError):
        config.range.minimum = -1.0  # type: ignore[misc]
