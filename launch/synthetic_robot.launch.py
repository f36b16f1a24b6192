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

"""Localise a simulated robot, live: stand-in camera, localiser, RViz."""

from launch.actions import DeclareLaunchArgument
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

from launch import LaunchDescription


def generate_launch_description() -> LaunchDescription:
    share = FindPackageShare('nccs_pose')
    return LaunchDescription([
        DeclareLaunchArgument('rate', default_value='5.0', description='Images a second.'),
        DeclareLaunchArgument('speed', default_value='0.35', description='Of the robot, m/s.'),
        DeclareLaunchArgument(
            'tf_mode', default_value='map_to_base', description='none or map_to_base.'),
        DeclareLaunchArgument('rviz', default_value='true', description='Start RViz.'),
        Node(
            package='nccs_pose', executable='stand_in_camera', output='screen',
            parameters=[{
                'rate': ParameterValue(LaunchConfiguration('rate'), value_type=float),
                'speed': ParameterValue(LaunchConfiguration('speed'), value_type=float),
            }]),
        Node(
            package='nccs_pose', executable='localiser', output='screen',
            parameters=[
                PathJoinSubstitution([share, 'config', 'arena.yaml']),
                {'tf_mode': LaunchConfiguration('tf_mode')},
            ]),
        Node(
            package='rviz2', executable='rviz2',
            arguments=['-d', PathJoinSubstitution([share, 'config', 'localiser.rviz'])],
            condition=IfCondition(LaunchConfiguration('rviz'))),
    ])
