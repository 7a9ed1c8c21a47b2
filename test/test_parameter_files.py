from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sphstereo_ros.core.config import PARAMETERS, Config, ParameterError
from sphstereo_ros.replay.parameter_files import load_config


@pytest.fixture
def load(tmp_path):
    def from_text(text, *overrides):
        path = tmp_path / 'parameters.yaml'
        path.write_text(text)
        return load_config([path], overrides)
    return from_text


def test_nothing_given():
    assert load_config() == Config()


def test_nested_and_dotted_names(load):
    config = load("""
/**:
  ros__parameters:
    baseline: {length: 0.28}
    stereo.matcher: bm
    stereo:
      num_disparities: 64
    pairing.intervals: [1, 4]
    camera.mount: {x: 1, yaw: -1e-3}
""")
    assert config.baseline.length == 0.28
    assert (config.stereo.matcher, config.stereo.num_disparities) == ('bm', 64)
    assert config.pairing.intervals == (1, 4)
    assert (config.camera.mount_x, config.camera.mount_yaw) == (1.0, -0.001)


@pytest.mark.parametrize('node', ['spherical_stereo', '/spherical_stereo', '/uav/spherical_stereo',
                                  '/**/spherical_stereo', 'pipeline'])
def test_entry_of_a_node_wins_over_all(load, node):
    assert load(f"""
{node}:
  ros__parameters: {{stereo.matcher: sgbm}}
/**:
  ros__parameters: {{stereo.matcher: bm}}
""").stereo.matcher == 'sgbm'


def test_namespaces_may_be_nested(load):
    assert load("""
uav:
  front:
    spherical_stereo:
      ros__parameters: {stereo.matcher: sgbm}
""").stereo.matcher == 'sgbm'


def test_a_node_takes_only_what_it_declares(load):
    assert load("""
frame_pairing:
  ros__parameters: {stereo.matcher: sgbm, baseline.length: 0.5}
""") == load_config(overrides=['baseline.length:=0.5'])


def test_nodes_that_contradict_each_other_are_refused(load):
    with pytest.raises(ParameterError, match=r'camera\.mask is .*a\.png.* but .*b\.png'):
        load("""
pose_stabilisation:
  ros__parameters: {camera.mask: a.png}
motion_alignment:
  ros__parameters: {camera.mask: b.png}
""")


def test_nodes_of_others_and_names_of_ros_are_left_alone(load):
    assert load("""
camera_driver:
  ros__parameters: {exposure: 3, gain: [1, 2]}
/**:
  ros__parameters:
    use_sim_time: true
    qos_overrides: {/points: {publisher: {depth: 1}}}
bag_replay:
  ros__parameters: {replay.rate: 0.5}
""").replay.rate == 0.5


def test_override_wins_over_the_file(load):
    text = '/**:\n  ros__parameters: {baseline.length: 0.28, stereo.matcher: bm}\n'
    config = load(text, 'stereo.matcher:=sgbm', 'pairing.intervals:=[1, 2]', 'use_sim_time:=true')
    assert (config.stereo.matcher, config.baseline.length) == ('sgbm', 0.28)
    assert config.pairing.intervals == (1, 2)


def test_later_file_wins(tmp_path):
    for name, value in (('a', 0.1), ('b', 0.2)):
        (tmp_path / name).write_text(f'/**: {{ros__parameters: {{baseline.length: {value}}}}}')
    assert load_config([tmp_path / 'a', tmp_path / 'b']).baseline.length == 0.2


@pytest.mark.parametrize(('text', 'reason'), [
    ('/**: {ros__parameters: {baseline.lenght: 1.0}}', 'baseline.lenght: no node'),
    ('frame_pairing: {ros__parameters: {baseline.lenght: 1.0}}', 'baseline.lenght: no node'),
    ('/**: {ros__parameters: {baseline.length: -1.0}}', 'outside'),
    ('/**: {ros__parameters: {baseline.length: far}}', 'needs float'),
    ('/**: {ros__parameters: {baseline.length: null}}', 'needs float'),
    ('/**: {ros__parameters: {baseline.length: .nan}}', 'outside'),
    ('/**: {ros__parameters: {pairing.intervals: []}}', 'non-empty list'),
    ('/**: {ros__parameters: [1, 2]}', 'no table'),
    ('/**: 3', 'no node with ros__parameters'),
    ('- 1', 'no ROS 2 parameter file'),
    ('a: [', 'while parsing'),
    ('a: !!python/object:os.system {}', 'could not determine a constructor')])
def test_bad_files_are_refused_in_one_line(load, text, reason):
    with pytest.raises(ParameterError, match=reason) as refused:
        load(text)
    assert '\n' not in str(refused.value)


@pytest.mark.parametrize('override', ['baseline.length', ':=3', 'a.b:=1', 'baseline.length:=[',
                                      'baseline.length:='])
def test_bad_overrides_are_refused(override):
    with pytest.raises(ParameterError) as refused:
        load_config(overrides=[override])
    assert '\n' not in str(refused.value)


def test_file_that_is_not_there(tmp_path):
    with pytest.raises(ParameterError, match='No such file'):
        load_config([tmp_path / 'none.yaml'])


def test_empty_file_gives_the_defaults(load):
    assert load('') == Config()


@given(st.sampled_from([p for p in PARAMETERS.values() if p.kind is float and not p.is_array
                        and p.name != 'range.min']), st.floats(0.0, 1.0))
def test_floats_survive_the_way_through_text(spec, share):
    low, high = max(spec.low, -1e6), min(spec.high, 1e6)
    value = min(max(low + share * (high - low), low), high)
    if spec.name == 'range.max':
        value = max(value, 1.0)
    config = load_config(overrides=[f'{spec.name}:={value!r}'])
    group, _, item = spec.name.partition('.')
    found = [v for name, v in vars(getattr(config, group)).items()
             if type(config).__dataclass_fields__[group].default.__dataclass_fields__[name]
             .metadata['parameter'].name == spec.name]
    assert found == [value], item


@given(st.text(max_size=40), st.text(max_size=40))
def test_any_text_as_override_is_taken_or_refused(name, value):
    try:
        config = load_config(overrides=[f'{name}:={value}'])
    except ParameterError:
        return
    assert isinstance(config, Config)
