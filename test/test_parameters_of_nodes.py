"""Parameters of running nodes: descriptors, refusals with a reason, changes at run time."""
from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip('rclpy')

import rclpy
from nav_msgs.msg import Odometry
from nav_msgs.msg import Path as PathMessage
from rcl_interfaces.srv import DescribeParameters, SetParametersAtomically
from rclpy.parameter import Parameter
from ros_graph import Graph, graph, mono8, odometry
from sensor_msgs.msg import Image

from sphstereo_ros.core.config import PARAMETERS, ParameterError
from sphstereo_ros.ros.images import read_mask
from sphstereo_ros.ros.parameters import (
    NODE_PARAMETERS,
    NodeParameters,
    documentation_table,
    names_of,
)

PLAIN = ('import sys; from sphstereo_ros.nodes.frame_pairing import main; '
         'sys.exit(main(["node", "{}"]))')


@pytest.fixture
def ros(tmp_path: Path) -> Iterator[Graph]:
    with graph(tmp_path) as made:
        yield made


@pytest.fixture
def make_node() -> Iterator[Any]:
    """Makes nodes in this process from words of a command line."""
    context = rclpy.Context()
    rclpy.init(context=context, domain_id=99)
    nodes: list[Any] = []

    def make(*words: str) -> Any:
        arguments = ['--ros-args', *(w for word in words for w in ('-p', word))]
        nodes.append(rclpy.create_node('node', context=context, cli_args=arguments,
                                       start_parameter_services=False))
        return nodes[-1]
    yield make
    for node in nodes:
        node.destroy_node()
    rclpy.shutdown(context=context)


def changes(node: Any, **values: object) -> Any:
    return node.set_parameters_atomically(
        [Parameter(name.replace('__', '.'), value=value) for name, value in values.items()])


def test_overrides_reach_the_config(make_node: Any) -> None:
    node = make_node('baseline.length:=1', 'pairing.intervals:=[1, 4]', 'points.colour:=true',
                     'camera.mount.x:=0.5', 'use_sim_time:=true')
    config = NodeParameters(node, names_of('pipeline')).config
    assert config.baseline.length == 1.0
    assert config.pairing.intervals == (1, 4)
    assert config.points.colour
    assert node.get_parameter('baseline.length').value == 1.0
    assert list(node.get_parameter('pairing.intervals').value) == [1, 4]
    assert node.get_parameter('stereo.num_disparities').value == 96


@pytest.mark.parametrize(('words', 'reason'), [
    (['baseline.lenght:=1.0'], r'baseline\.lenght: no node of this package'),
    (['baseline.length:=-1.0'], r'baseline\.length: -1.0 is outside'),
    (['baseline.length:=.nan'], r'baseline\.length'),
    (['baseline.length:=long'], r'baseline\.length: needs float'),
    (['pairing.intervals:=[]'], r'pairing\.intervals: needs a non-empty list'),
    (['pairing.intervals:=[0]'], r'pairing\.intervals: 0 is outside'),
    (['pairing.intervals:=[1]', 'pairing.baselines:=[1.0]', 'baseline.length:=0.3'],
     r'give one of them'),
    (['stereo.matcher:=magic'], r'stereo\.matcher'),
    (['range.min:=5.0', 'range.max:=4.0'], r'range\.min'),
])
def test_overrides_are_refused_with_a_reason(make_node: Any, words: list[str],
                                             reason: str) -> None:
    node = make_node(*words)
    with pytest.raises(ParameterError, match=reason):
        NodeParameters(node, names_of('frame_pairing'))


def test_names_of_other_nodes_are_no_error(make_node: Any) -> None:
    node = make_node('stereo.num_disparities:=64', 'replay.rate:=0.5')
    parameters = NodeParameters(node, names_of('frame_pairing'))
    assert not node.has_parameter('stereo.num_disparities')
    assert parameters.config.stereo.num_disparities == 64


def test_every_parameter_belongs_to_a_node() -> None:
    declared = {name for node in NODE_PARAMETERS for name in names_of(node)}
    assert declared == set(PARAMETERS)


def test_changes_at_run_time_are_checked_as_a_whole(make_node: Any) -> None:
    node = make_node('baseline.length:=0.3')
    parameters = NodeParameters(node, names_of('pipeline'))
    told = []
    parameters.on_change = told.append
    refused = changes(node, range__min=200.0)
    assert not refused.successful
    assert 'range.min' in refused.reason
    assert not changes(node, stereo__num_disparities=100).successful
    assert not changes(node, stereo__working_height=480).successful
    assert told == []
    assert changes(node, range__min=200.0, range__max=500.0).successful
    assert [c.range.minimum for c in told] == [200.0]
    assert parameters.config.baseline.length == 0.3
    assert changes(node, range__min=200.0).successful
    assert len(told) == 1


def test_intervals_and_baselines_replace_each_other_at_run_time(make_node: Any) -> None:
    node = make_node('baseline.length:=0.3', 'pairing.intervals:=[4]')
    parameters = NodeParameters(node, names_of('frame_pairing'))
    assert 'not both' in changes(node, pairing__baselines=[1.0]).reason
    assert changes(node, pairing__intervals=[1, 4, 7, 10]).successful
    assert changes(node, pairing__baselines=[1.0]).successful
    assert parameters.config.pairing.baselines == (1.0,)
    assert 'not both' in changes(node, pairing__intervals=[2]).reason
    assert changes(node, pairing__baselines=[0.0]).successful
    assert changes(node, pairing__intervals=[2]).successful
    assert parameters.config.pairing.intervals == (2,)


def test_descriptors_tell_type_bounds_and_meaning(ros: Graph) -> None:
    ros.start('spherical_stereo')
    names = ['range.min', 'stereo.block_size', 'stereo.matcher', 'stereo.working_height']
    answer = ros.client.call(DescribeParameters, '/spherical_stereo/describe_parameters',
                             DescribeParameters.Request(names=names))
    minimum, block, matcher, height = answer.descriptors
    assert (minimum.type, minimum.description) == (3, 'nearer is −Inf [m]')
    assert (minimum.floating_point_range[0].from_value,
            minimum.floating_point_range[0].to_value) == (0.0, 1000.0)
    assert (block.type, block.integer_range[0].to_value) == (2, 51)
    assert matcher.additional_constraints == 'one of ' + ', '.join(
        PARAMETERS['stereo.matcher'].choices)
    assert height.read_only
    assert not minimum.read_only


def test_a_running_node_takes_a_new_baseline(ros: Graph) -> None:
    client = ros.client
    ros.start('frame_pairing', 'baseline.length:=0.3')
    client.subscribe(PathMessage, 'pairs')
    client.linked('pairs')
    image = client.heard(Image, 'image', 'frame_pairing')
    grey = np.zeros((8, 16), np.uint8)
    for stamp in (1, 2):
        image.publish(mono8(stamp, grey))
    assert client.stamped('pairs', 2).poses[0].pose.position.z == -0.3
    name = '/frame_pairing/set_parameters_atomically'
    length = Parameter('baseline.length', value=-2.0).to_parameter_msg()
    answer = client.call(SetParametersAtomically, name,
                         SetParametersAtomically.Request(parameters=[length]))
    assert not answer.result.successful
    length.value.double_value = 0.7
    answer = client.call(SetParametersAtomically, name,
                         SetParametersAtomically.Request(parameters=[length]))
    assert answer.result.successful
    image.publish(mono8(3, grey))
    assert client.stamped('pairs', 3).poses[0].pose.position.z == -0.7


def test_a_running_node_waits_for_odometry(ros: Graph) -> None:
    """The window comes with the odometry that encloses its frame, and has the mount's share."""
    client = ros.client
    ros.start('frame_pairing', 'baseline.source:=odometry', f'camera.mount.yaw:={np.pi / 2}')
    client.subscribe(PathMessage, 'pairs')
    client.linked('pairs')
    motion = client.publisher(Odometry, 'odometry')
    image = client.heard(Image, 'image', 'frame_pairing')
    motion.publish(odometry(10, 0.0))
    for stamp in (10, 20):
        image.publish(mono8(stamp, np.zeros((8, 16), np.uint8)))
    client.dropped('frame_pairing', 'first_frame')
    assert not client.received['pairs']
    motion.publish(odometry(30, 1.0))
    position = client.stamped('pairs', 20).poses[0].pose.position
    # Forward is to the right of a camera that looks left.
    assert (position.x, position.z) == (pytest.approx(-0.5), pytest.approx(0.0))


@pytest.mark.parametrize(('words', 'told'), [
    (['baseline.lenght:=0.3'], 'baseline.lenght: no node of this package has such a parameter'),
    (['camera.mask:=/nowhere.png'], 'camera.mask: cannot read an image from /nowhere.png'),
    (['--params-file /nowhere.yaml'], 'nowhere.yaml'),
    (['use_sim_time:=7'], 'use_sim_time'),
    (['pairing.intervals:=[1, 2.0]'], 'pairing.intervals'),
    (['qos_overrides./frames.subscription.depth:=often'], 'qos_overrides'),
    (['--wrong'], '--wrong'),
])
def test_bad_usage_ends_the_start_with_one_line(ros: Graph, words: list[str], told: str) -> None:
    process = ros.start('spherical_stereo', *words)
    assert process.ended() == 2, process.log
    assert 'Traceback' not in process.log
    line, = [line for line in process.log.splitlines() if '[rcl]' not in line]
    assert line.startswith('spherical_stereo: ')
    assert told in line


@pytest.mark.parametrize('words', [
    ('--params-file {}', 'baseline.length:=0.5'), ('baseline.length:=0.5', '--params-file {}'),
    ('--params-file {}', 'frame_pairing:baseline.length:=5e-1', 'other:baseline.length:=9.0')])
def test_the_command_line_wins_over_files(ros: Graph, tmp_path: Path,
                                          words: tuple[str, ...]) -> None:
    file = tmp_path / 'all.yaml'
    file.write_text('/**:\n  ros__parameters:\n    baseline: {length: 2, source: fixed}\n'
                    '    stereo.num_disparities: 64\n')
    process = ros.start('frame_pairing', *(word.format(file) for word in words))
    ros.client.subscribe(PathMessage, 'pairs')
    ros.client.linked('pairs')
    image = ros.client.heard(Image, 'image', 'frame_pairing')
    for stamp in (1, 2):
        image.publish(mono8(stamp, np.zeros((8, 16), np.uint8)))
    assert ros.client.stamped('pairs', 2).poses[0].pose.position.z == -0.5
    assert process.stop() == 0


def test_help_and_stray_words(ros: Graph) -> None:
    asked, stray = ros.start('frame_pairing', code=PLAIN.format('--help')), ros.start(
        'frame_pairing', code=PLAIN.format('word'))
    assert asked.ended() == 0
    assert asked.log.startswith('usage: frame_pairing ')
    assert stray.ended() == 2
    assert stray.log.startswith('frame_pairing: word: unknown argument\nusage: ')


def test_documentation_table_has_every_parameter() -> None:
    table = documentation_table().splitlines()
    assert len(table) == len(PARAMETERS) + 2
    assert ('| `pairing.intervals` | int[] | [1, 4, 7, 10] |  | 1 … 100 | yes | references, '
            'frames back |') in table
    assert {row.count('|') for row in table} == {8}


def test_mask_file(tmp_path: Path) -> None:
    import cv2
    mask = np.zeros((4, 8), np.uint8)
    mask[1, 2] = 255
    cv2.imwrite(str(tmp_path / 'mask.png'), mask)
    np.testing.assert_array_equal(read_mask(str(tmp_path / 'mask.png')), mask)
    assert read_mask('') is None
    with pytest.raises(ParameterError):
        read_mask(str(tmp_path))
