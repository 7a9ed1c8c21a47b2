"""The stages as separate processes, and where the camera is."""
from __future__ import annotations

import math
from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from launch import LaunchDescription
from sphstereo_ros.replay.parameter_files import load_config

PACKAGE = 'sphstereo_ros'
STAGES = ('frame_pairing', 'pose_stabilisation', 'motion_alignment', 'spherical_stereo')


def transform(parent, child, x=0.0, y=0.0, z=0.0, roll=0.0, pitch=0.0, yaw=0.0):
    numbers = {'x': x, 'y': y, 'z': z, 'roll': roll, 'pitch': pitch, 'yaw': yaw}
    words = [word for name, value in numbers.items() for word in (f'--{name}', repr(float(value)))]
    return Node(package='tf2_ros', executable='static_transform_publisher',
                name=f'{child}_transform',
                arguments=[*words, '--frame-id', parent, '--child-frame-id', child])


def actions(context):
    def argument(name):
        return LaunchConfiguration(name).perform(context)

    files = argument('params_file').split(',')
    sim_time = argument('use_sim_time').lower() == 'true'
    stages = STAGES
    if argument('obstacles').lower() == 'true':
        stages = (*STAGES, 'obstacle_detection')
    if argument('mapping').lower() == 'true':
        stages = (*stages, 'mapping')
    camera = load_config([Path(file) for file in files]).camera
    nodes = [Node(package=PACKAGE, executable=stage, name=stage,
                  namespace=argument('namespace'), output='screen',
                  parameters=[*files, {'use_sim_time': sim_time}]) for stage in stages]
    return [
        *nodes,
        transform('base_link', 'camera_link', camera.mount_x, camera.mount_y, camera.mount_z,
                  camera.mount_roll, camera.mount_pitch, camera.mount_yaw),
        # REP-103: optical axes are x right, y down, z forward.
        transform('camera_link', argument('camera_frame'), roll=-math.pi / 2, yaw=-math.pi / 2)]


def generate_launch_description():
    default = Path(get_package_share_directory(PACKAGE)) / 'config' / 'default.yaml'
    return LaunchDescription([
        DeclareLaunchArgument('params_file', default_value=str(default),
                              description='parameter files of all nodes, separated by commas'),
        DeclareLaunchArgument('namespace', default_value='', description='of all topics'),
        DeclareLaunchArgument('camera_frame', default_value='camera_optical',
                              description='frame_id of the input images'),
        DeclareLaunchArgument('obstacles', default_value='true',
                              description='false leaves obstacle_detection out'),
        DeclareLaunchArgument('mapping', default_value='false',
                              description='true adds mapping'),
        DeclareLaunchArgument('use_sim_time', default_value='false',
                              description='true where /clock is published'),
        OpaqueFunction(function=actions)])
