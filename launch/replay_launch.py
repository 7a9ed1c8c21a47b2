"""A recording through the stages, each a process of its own."""
from __future__ import annotations

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch.actions import (
    DeclareLaunchArgument,
    EmitEvent,
    IncludeLaunchDescription,
    OpaqueFunction,
    RegisterEventHandler,
)
from launch.event_handlers import OnProcessExit
from launch.events import Shutdown
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from launch import LaunchDescription

PACKAGE = 'sphstereo_ros'


def actions(context):
    def argument(name):
        return LaunchConfiguration(name).perform(context)

    share = Path(get_package_share_directory(PACKAGE))
    stages = IncludeLaunchDescription(
        PythonLaunchDescriptionSource(str(share / 'launch' / 'pipeline_launch.py')),
        launch_arguments={'params_file': argument('params_file'), 'use_sim_time': 'true',
                          'namespace': argument('namespace'),
                          'obstacles': argument('obstacles'),
                          'camera_frame': argument('camera_frame')}.items())
    replay = Node(
        package=PACKAGE, executable='bag_replay', name='bag_replay', output='screen',
        namespace=argument('namespace'),
        parameters=[{'replay.bag': argument('bag'), 'replay.rate': float(argument('rate')),
                     'replay.loop': argument('loop').lower() == 'true', 'replay.wait': 30.0}])
    ended = RegisterEventHandler(OnProcessExit(
        target_action=replay, on_exit=[EmitEvent(event=Shutdown(reason='the recording ended'))]))
    return [stages, replay, ended]


def generate_launch_description():
    default = Path(get_package_share_directory(PACKAGE)) / 'config' / 'default.yaml'
    return LaunchDescription([
        DeclareLaunchArgument('bag', description='bag, video or folder of frames'),
        DeclareLaunchArgument('rate', default_value='1.0', description='of real time'),
        DeclareLaunchArgument('loop', default_value='false', description='begin again at the end'),
        DeclareLaunchArgument('params_file', default_value=str(default),
                              description='parameter files of all nodes, separated by commas'),
        DeclareLaunchArgument('namespace', default_value='', description='of all topics'),
        DeclareLaunchArgument('obstacles', default_value='true',
                              description='false leaves obstacle_detection out'),
        DeclareLaunchArgument('camera_frame', default_value='camera_optical',
                              description='frame_id of the images'),
        OpaqueFunction(function=actions)])
