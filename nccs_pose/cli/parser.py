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
"""The commands and their arguments; a command's module is imported only when it is called."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import import_module
from typing import Any


@dataclass(frozen=True)
class Command:
    """One word after `nccs-pose`.

    :ivar module: defines `add_arguments(parser)` and `run(args) -> int`.
    :ivar summary: what it does, in one line.
    :ivar example: how it is called.
    """

    name: str
    module: str
    summary: str
    example: str

    def load(self) -> Any:
        """Import the command's module."""
        return import_module(self.module)


_ROOM = '--rig config/room_rig.yaml --map config/room_map.yaml'
COMMANDS = (
    Command('replay', 'nccs_pose.cli.replay',
            'run the localiser over a bag, without ROS, and evaluate it',
            f'nccs-pose replay bags/room {_ROOM} --output out/poses.tum --plots out'),
    Command('evaluate', 'nccs_pose.cli.evaluate',
            'compare a trajectory with the true one',
            'nccs-pose evaluate out/poses.tum truth.tum --plots out'),
    Command('render', 'nccs_pose.cli.render',
            'simulate a drive and write it as a bag, with its rig and map',
            'nccs-pose render out/arena --frames 50'),
    Command('calibrate', 'nccs_pose.cli.calibrate',
            'refine a rough rig from the lines that a driven bag shows',
            'nccs-pose calibrate bags/room --rig rough.yaml --map config/room_map.yaml '
            '--output out/rig.yaml'),
    Command('check', 'nccs_pose.cli.check',
            'tell whether a rig is still true to a bag',
            f'nccs-pose check bags/room {_ROOM}'),
    Command('experiment', 'nccs_pose.cli.experiment',
            "repeat the paper's experiments",
            'nccs-pose experiment pixel-noise --trials 50 --output out/experiments'),
    Command('benchmark', 'nccs_pose.cli.benchmark',
            'measure speed, against the published estimator',
            'nccs-pose benchmark --output out/benchmark.json'),
    Command('stages', 'nccs_pose.cli.stages',
            'measure what tracking and searching cost, against one HSV threshold',
            'nccs-pose stages'),
    Command('starts', 'nccs_pose.cli.starts',
            'tell what one image alone says of the pose, map by map, and what it costs',
            'nccs-pose starts --map config/soccer_map.yaml --option reach=9.0'),
    Command('precision', 'nccs_pose.cli.precision',
            "measure the errors against the image's own bound and the paper's sampling",
            'nccs-pose precision --output out'),
    Command('coverage', 'nccs_pose.cli.coverage',
            'tell whether the covariance is true, by scenario',
            "nccs-pose coverage 'ideal 640' --trials 30"),
    Command('faults', 'nccs_pose.cli.faults',
            'play every named fault through the localiser and count what it makes of it',
            'nccs-pose faults --output out'),
)


@dataclass(frozen=True)
class Call:
    """A command with its parsed arguments."""

    command: Command
    arguments: argparse.Namespace

    def run(self) -> int:
        """Do it; returns the exit code."""
        return self.command.load().run(self.arguments)


def find_command(argv: Sequence[str]) -> Command | None:
    """The command that the arguments name, if any."""
    word = next((argument for argument in argv if not argument.startswith('-')), None)
    return next((command for command in COMMANDS if command.name == word), None)


def parse(argv: Sequence[str]) -> Call:
    """Parse the arguments; only the chosen command's own module is imported.

    :raises SystemExit: as argparse does, after printing help (0) or usage (2).
    """
    chosen = find_command(argv)
    parser = argparse.ArgumentParser(
        prog='nccs-pose', usage='nccs-pose COMMAND ...',
        description='Planar localisation from the floor lines that a catadioptric camera sees.\n\n'
                    'commands:\n' + '\n'.join(f'  {c.name:12}{c.summary}' for c in COMMANDS),
        epilog=f'example: {COMMANDS[0].example}\n\n'
               'Every command explains itself with --help. Exit codes: 0 ok, 1 the result is bad, '
               '2 wrong usage or input.',
        formatter_class=argparse.RawDescriptionHelpFormatter)
    words = parser.add_subparsers(dest='command', metavar='COMMAND', help=argparse.SUPPRESS)
    for command in COMMANDS:
        word = words.add_parser(
            command.name, prog=f'nccs-pose {command.name}',
            description=f'{command.summary[0].upper()}{command.summary[1:]}.',
            epilog=f'example: {command.example}',
            formatter_class=argparse.RawDescriptionHelpFormatter)
        if command is chosen:
            command.load().add_arguments(word)
    arguments = parser.parse_args(argv)
    if chosen is None:
        parser.error('name a command: ' + ', '.join(command.name for command in COMMANDS))
    return Call(chosen, arguments)
