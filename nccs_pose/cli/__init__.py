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
"""The command line `nccs-pose`: parse, call a command, say in one sentence what went wrong.

Exit codes: 0 it worked; 1 it ran, and the result is bad (e.g. no frame was answered); 2 the
input or the usage is wrong; 130 interrupted.
"""

from __future__ import annotations

from collections.abc import Sequence
import io
import os
import sys

from nccs_pose.cli.parser import find_command, parse
from nccs_pose.errors import NccsPoseError
from nccs_pose.missing_package import missing_package

__all__ = ['main']


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command.

    :param argv: arguments without the program's name; the process's own if not given.
    :returns: the exit code.
    """
    argv = list(sys.argv[1:] if argv is None else argv)
    command = find_command(argv)
    name = f'nccs-pose {command.name}' if command else 'nccs-pose'
    if isinstance(sys.stdout, io.TextIOWrapper):
        # A character that the terminal, or UTF-8, does not know must not end finished work.
        sys.stdout.reconfigure(errors='backslashreplace')
    try:
        code = parse(argv).run()
        # What is still buffered meets a closed pipe here, not while Python ends.
        if sys.stdout is not None:  # as where it was closed
            sys.stdout.flush()
        return code
    except SystemExit as stop:  # argparse, after it has printed help or usage
        return stop.code if isinstance(stop.code, int) else 2
    except NccsPoseError as error:
        print(f'{name}: {" ".join(str(error).split())}', file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print(f'{name}: interrupted.', file=sys.stderr)
        return 130
    except BrokenPipeError:  # e.g. `nccs-pose ... | head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except OSError as error:
        what = f'{error.filename}: ' if error.filename else ''
        print(f'{name}: {what}{error.strerror or error}.', file=sys.stderr)
        return 2
    except MemoryError:
        print(f'{name}: this machine has too little memory for it.', file=sys.stderr)
        return 2
    except ModuleNotFoundError as error:
        print(f'{name}: {missing_package(error)}', file=sys.stderr)
        return 2
