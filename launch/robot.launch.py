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

"""Template for a real robot: the localiser beside a running camera driver."""

from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

from launch import LaunchDescription


def generate_launch_description() -> LaunchDescription:
    share = FindPackageShare('nccs_pose')
    return LaunchDescription([
        DeclareLaunchArgument(
            'params_file', default_value=PathJoinSubstitution([share, 'config', 'robot.yaml']),
            description='Parameters of the localiser: your copy of config/robot.yaml.'),
        DeclareLaunchArgument(
            'namespace', default_value='', description='Of the robot, for several robots.'),
        DeclareLaunchArgument(
            'image', default_value='camera/image_raw', description="The camera's image topic."),
        DeclareLaunchArgument(
            'camera_info', default_value='camera/camera_info',
            description="The camera's camera_info topic."),
        DeclareLaunchArgument(
            'odom', default_value='odom', description='Topic of the wheel odometry.'),
        Node(
            package='nccs_pose', executable='localiser', output='screen',
            namespace=LaunchConfiguration('namespace'),
            parameters=[LaunchConfiguration('params_file')],
            remappings=[
                ('image', LaunchConfiguration('image')),
                ('image/compressed', [LaunchConfiguration('image'), '/compressed']),
                ('camera_info', LaunchConfiguration('camera_info')),
                ('odom', LaunchConfiguration('odom')),
            ]),
    ])
