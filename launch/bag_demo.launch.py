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

"""Localise the robot of a bag: localiser, player, RViz."""

from launch.actions import DeclareLaunchArgument
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

from launch import LaunchDescription


def generate_launch_description() -> LaunchDescription:
    share = FindPackageShare('nccs_pose')
    return LaunchDescription([
        DeclareLaunchArgument(
            'bag', default_value=PathJoinSubstitution([share, 'bags', 'room']),
            description='Bag to play.'),
        DeclareLaunchArgument(
            'params_file', default_value=PathJoinSubstitution([share, 'config', 'room.yaml']),
            description='Parameters of the localiser.'),
        DeclareLaunchArgument('rate', default_value='1.0', description='Speed factor.'),
        DeclareLaunchArgument('rviz', default_value='true', description='Start RViz.'),
        Node(
            package='nccs_pose', executable='localiser', output='screen',
            parameters=[LaunchConfiguration('params_file'), {'use_sim_time': True}],
            remappings=[
                ('image', '/camera/image_raw'),
                ('image/compressed', '/camera/image_raw/compressed'),
                ('camera_info', '/camera/camera_info'),
            ]),
        Node(
            package='nccs_pose', executable='play', output='screen',
            arguments=[
                LaunchConfiguration('bag'), '--clock', '--rate', LaunchConfiguration('rate'),
                '--wait-for', '/camera/image_raw/compressed',
            ]),
        Node(
            package='rviz2', executable='rviz2',
            arguments=['-d', PathJoinSubstitution([share, 'config', 'localiser.rviz'])],
            condition=IfCondition(LaunchConfiguration('rviz'))),
    ])
