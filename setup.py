"""Installs with pip (any Linux) and with colcon (ament_python)."""
from glob import glob

from setuptools import find_packages, setup

NAME = 'sphstereo_ros'
NODES = ('frame_pairing', 'pose_stabilisation', 'motion_alignment', 'spherical_stereo',
         'obstacle_detection', 'mapping', 'pipeline', 'bag_replay')

setup(
    name=NAME,
    version='0.1.0',
    packages=find_packages(exclude=['test', 'test.*']),
    package_data={NAME: ['core/*.npz', 'core/*.onnx', 'ros/*.xml', 'report/web/*', 'py.typed']},
    data_files=[
        ('share/ament_index/resource_index/packages', [f'resource/{NAME}']),
        (f'share/{NAME}', ['package.xml']),
        (f'share/{NAME}/launch', glob('launch/*_launch.py')),
        (f'share/{NAME}/config', glob('config/*')),
    ],
    python_requires='>=3.10',
    install_requires=['numpy>=1.26', 'opencv-python-headless>=4.6', 'numba>=0.58', 'PyYAML',
                      'tqdm', 'rosbags>=0.10', 'mcap>=1.1', 'zstandard', 'lz4'],
    extras_require={
        'ros': ['ros-jazzy-rclpy', 'ros-jazzy-common-interfaces', 'ros-jazzy-rmw-fastrtps-cpp'],
        'scenes': ['trimesh', 'embreex', 'scipy'],
        'plots': ['matplotlib'],
        'report': ['jinja2', 'matplotlib'],
        'view': ['rerun-sdk>=0.24'],
        'map': ['small-gicp>=1.0', 'trimesh', 'pypcd4', 'laspy'],
        'dask': ['distributed'],
        'mavlink': ['pymavlink', 'pyserial'],
        'fit': ['torch', 'onnx'],
        'test': ['pytest', 'hypothesis', 'mcap-ros2-support', 'pymavlink', 'pyserial',
                 'small-gicp>=1.0', 'trimesh', 'pypcd4', 'laspy', 'evo', 'distributed'],
        'dev': ['ruff', 'mypy', 'types-PyYAML', 'pytest-cov'],
    },
    zip_safe=False,
    maintainer='sphstereo_ros maintainers',
    maintainer_email='maintainers@example.com',
    description='Depth in every direction from one 360-degree camera, as ROS 2 nodes',
    license='Apache-2.0',
    license_files=['LICENSE', 'NOTICE'],
    entry_points={
        'console_scripts': ['sphstereo = sphstereo_ros.cli:main']
        + [f'{node} = {NAME}.cli.nodes:{node}' for node in NODES],
    },
)
