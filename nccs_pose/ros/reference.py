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

"""The reference page docs/reference.md, made from the declarations of topics and parameters.

`python -m nccs_pose.ros.reference` writes it; with `--check` it only says whether it is up to
date. No ROS is needed.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
import dataclasses
from pathlib import Path
import sys
from typing import Any

from nccs_pose.estimation.estimate import State
from nccs_pose.estimation.options import LocaliserOptions
from nccs_pose.files.resources import share_directory
from nccs_pose.files.text_files import write_text
from nccs_pose.node_options import NodeOptions
from nccs_pose.ros.camera_options import CameraOptions
from nccs_pose.ros.interface import (
    CAUSES,
    Endpoint,
    INPUTS,
    OUTPUTS,
    SERVICES,
    STAND_IN_OUTPUTS,
    TF_MODES,
)
from nccs_pose.ros.launch_arguments import launch_arguments
from nccs_pose.ros.statuses import NODE_STATES, STATUSES

HEAD = """\
# Reference of the node `localiser`

Made by `python -m nccs_pose.ros.reference` from the declarations in the code; do not edit.

All names are relative (to the namespace) or private (`~`, to the node) and can be remapped.
The quality of service of every topic below is overridden by the parameters
`qos_overrides.<full topic>.<publisher or subscription>.<reliability, depth, history>`, for
example `qos_overrides./localiser/debug_image.publisher.reliability`; that of `/tf` is tf2_ros's
own.
"""

LIFECYCLE = """\
The node is a managed one (`ros2 lifecycle`), and starts by itself unless `autostart` is false.
A transition that fails leaves the reason in `/diagnostics` and in the log.
"""

LIVE = """\
*Live* parameters may change while the node runs; a change that does not fit is refused with the
reason and changes nothing. All others are read-only.
"""

TRANSFORMS = """\
While odom -> base_link at the image's stamp is missing nothing is broadcast; after 1 s it is
counted as `tf_missing`. Transforms are stamped with the image's stamp plus `transform_tolerance`.
`tf2_ros` must be installed; without it a `tf_mode` other than `none` fails the configuration.
"""


DIAGNOSTICS = """\
Each status is named `<full name of the node>: <part>`. Values without a unit are counts,
fractions or words; what is not known is nan.
"""

STAND_IN = """\
Streams a simulated robot that drives a figure of eight, live. Its parameters are read-only.
"""

LAUNCH = """\
`ros2 launch nccs_pose <file> <argument>:=<value>`; `<share>` is the share directory of the
package.
"""


def page() -> str:
    """The whole page as Markdown."""
    parts = [
        HEAD, '## Subscribed topics\n', _endpoints(INPUTS), '## Published topics\n',
        _endpoints(OUTPUTS), '## Services\n', _services(), '## Lifecycle\n', LIFECYCLE,
        '## Transforms\n',
        _left([['`tf_mode`', 'somebody else broadcasts', 'this node broadcasts'], *TF_MODES]),
        TRANSFORMS, '## Diagnostics\n', DIAGNOSTICS, *_statuses(), '### States\n', _states(),
        '### Causes of a refusal\n', _left([['cause', 'what was refused'], *CAUSES]),
        '## Parameters\n', LIVE, '### Node\n', _options(NodeOptions), '### Estimator\n',
        _options(LocaliserOptions), '## The node `stand_in_camera`\n', STAND_IN,
        _endpoints(STAND_IN_OUTPUTS), _options(CameraOptions), '## Launch files\n', LAUNCH,
        *_launch_files()]
    return '\n'.join(parts)


def _endpoints(endpoints: Sequence[Endpoint]) -> str:
    rows = [['name', 'type', 'quality of service', 'meaning']]
    rows += [[f'`{e.name}`', f'`{e.type}`',
              f'{"reliable" if e.reliable else "best effort"}, keep last {e.depth}', e.doc]
             for e in endpoints]
    return _left(rows)


def _services() -> str:
    rows = [['name', 'type', 'meaning']]
    rows += [[f'`{e.name}`', f'`{e.type}`', e.doc] for e in SERVICES]
    return _left(rows)


def _statuses() -> list[str]:
    parts = []
    for status in STATUSES:
        rows = [['value', 'unit', 'meaning']]
        rows += [[f'`{value.key}`', value.unit, value.doc] for value in status.values]
        parts += [f'### `localiser: {status.part}`\n', f'{status.doc}\n', _left(rows)]
    return parts


def _states() -> str:
    rows = [['state', 'when'], *([f'`{state.value}`', state.meaning] for state in State)]
    return _left([*rows, *([f'`{state}`', meaning] for state, meaning in NODE_STATES)])


def _launch_files() -> list[str]:
    parts = []
    for file in sorted((share_directory() / 'launch').glob('*.launch.py')):
        about, arguments = launch_arguments(file)
        rows = [['argument', 'default', 'meaning']]
        rows += [[f'`{a.name}`', f'`{a.default}`' if a.default else '', a.doc]
                 for a in arguments]
        parts += [f'### `{file.name}`\n', f'{about}\n', _left(rows)]
    return parts


def _options(group: type) -> str:
    rows = [['parameter', 'default', 'unit', 'allowed', 'live', 'meaning']]
    for field in dataclasses.fields(group):
        words = field.metadata
        rows.append([
            f'`{field.name}`', f'`{_literal(field.default)}`', words['unit'], _allowed(words),
            'live' if words['live'] else '', words['doc']])
    return _left(rows)


def _literal(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    return f"'{value}'" if isinstance(value, str) else f'{value!r}'


def _allowed(words: Any) -> str:
    if words['choices']:
        return ', '.join(f'`{choice}`' for choice in words['choices'])
    low, high = words['low'], words['high']
    if low is None and high is None:
        return ''
    if high is None:
        return f'>= {low:g}'
    return f'<= {high:g}' if low is None else f'{low:g} to {high:g}'


def _left(rows: Sequence[Sequence[str]]) -> str:
    """A Markdown table of words: every column to the left, whatever its width."""
    lines = ['| ' + ' | '.join(row) + ' |' for row in rows]
    return '\n'.join([lines[0], '|' + ':--|' * len(rows[0]), *lines[1:]]) + '\n'


def main(argv: Sequence[str] | None = None) -> int:
    """Write docs/reference.md, or check it."""
    parser = argparse.ArgumentParser(prog='reference', description=__doc__)
    parser.add_argument('--check', action='store_true', help='only check; exit code 1 if stale')
    parser.add_argument('--output', type=Path, default=share_directory() / 'docs/reference.md')
    options = parser.parse_args(argv)
    if not options.check:
        write_text(options.output, page())
        return 0
    fresh = options.output.is_file() and options.output.read_text(encoding='utf-8') == page()
    print(f'{options.output} is {"up to date" if fresh else "stale: run me without --check"}')
    return 0 if fresh else 1


if __name__ == '__main__':
    sys.exit(main())
