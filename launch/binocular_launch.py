"""The four stages for two cameras, one above the other, and where both are."""
from __future__ import annotations

import math
from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch.actions import DeclareLaunchArgument, IncludeLaunchDescription, OpaqueFunction
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from launch import LaunchDescription
from sphstereo_ros.replay.parameter_files import load_config

PACKAGE = 'sphstereo_ros'


def transform(parent, child, **numbers):
    words = [word for name, value in numbers.items() for word in (f'--{name}', repr(float(value)))]
    return Node(package='tf2_ros', executable='static_transform_publisher',
                name=f'{child}_transform',
                arguments=[*words, '--frame-id', parent, '--child-frame-id', child])


def actions(context):
    def argument(name):
        return LaunchConfiguration(name).perform(context)

    # The top camera as the parameters have it: what is estimated from pictures is not known here.
    config = load_config([Path(file) for file in argument('params_file').split(',')])
    camera, baseline = config.camera, config.baseline
    per = baseline.length / math.hypot(*baseline.direction)
    x, y, z = (per * value for value in baseline.direction)
    stages = IncludeLaunchDescription(
        PythonLaunchDescriptionSource(str(
            Path(get_package_share_directory(PACKAGE)) / 'launch' / 'pipeline_launch.py')),
        launch_arguments={'params_file': argument('params_file'),
                          'namespace': argument('namespace'),
                          'camera_frame': argument('bottom_frame'),
                          'use_sim_time': argument('use_sim_time')}.items())
    return [
        stages,
        transform('camera_link', 'top_camera_link', x=x, y=y, z=z, roll=camera.top_roll,
                  pitch=camera.top_pitch, yaw=camera.top_yaw),
        transform('top_camera_link', argument('top_frame'), roll=-math.pi / 2, yaw=-math.pi / 2)]


def generate_launch_description():
    default = Path(get_package_share_directory(PACKAGE)) / 'config' / 'binocular.yaml'
    return LaunchDescription([
        DeclareLaunchArgument('params_file', default_value=str(default),
                              description='parameter files of all nodes, separated by commas; of '
                              'sphstereo calibrate last'),
        DeclareLaunchArgument('namespace', default_value='', description='of all topics'),
        DeclareLaunchArgument('bottom_frame', default_value='camera_optical',
                              description="frame_id of the bottom camera's images"),
        DeclareLaunchArgument('top_frame', default_value='top_camera_optical',
                              description="frame_id of the top camera's images"),
        DeclareLaunchArgument('use_sim_time', default_value='false',
                              description='true where /clock is published'),
        OpaqueFunction(function=actions)])
