# Copyright 2026 The nccs_pose authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

from glob import glob

from setuptools import find_packages, setup

NAME = 'nccs_pose'

setup(
    name=NAME,
    version='0.1.0',
    packages=find_packages(include=[NAME, NAME + '.*']),
    data_files=[
        ('share/ament_index/resource_index/packages', ['resource/' + NAME]),
        ('share/' + NAME, ['package.xml']),
        ('share/' + NAME + '/config', glob('config/*')),
        ('share/' + NAME + '/bags/room', glob('bags/room/*')),
        ('share/' + NAME + '/launch', glob('launch/*.launch.py')),
    ],
    python_requires='>=3.10',
    # Only what apt's Python packages also name by this name: Debian's cv2 carries no metadata, so
    # a requirement on a PyPI OpenCV would be unmet there for ever. rclpy is never named: its
    # wheels would mix with an installed ROS. requirements*.txt hold the whole list for pip.
    install_requires=['numpy', 'scipy', 'PyYAML'],
    extras_require={
        'pip': ['opencv-python-headless', 'rosbags', 'matplotlib', 'joblib'],
        'test': ['pytest'],  # without it `colcon test` runs nothing, and says OK
    },
    zip_safe=True,
    maintainer='The nccs_pose authors',
    maintainer_email='nccs-pose@users.noreply.github.com',
    description='Planar localisation from the floor lines that a catadioptric camera sees.',
    license='Apache-2.0',
    entry_points={
        'console_scripts': [
            'demo = nccs_pose.ros.programs:demo',
            'localiser = nccs_pose.ros.programs:localiser',
            'nccs-pose = nccs_pose.cli:main',
            'play = nccs_pose.ros.programs:play',
            'stand_in_camera = nccs_pose.ros.programs:stand_in_camera',
            'stream_benchmark = nccs_pose.ros.programs:stream_benchmark',
        ],
    },
)
