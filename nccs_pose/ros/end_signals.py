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

"""The signals that end a program: Ctrl-C, a supervisor, a terminal or connection that closes.

Light on purpose: nothing of ROS is imported here.
"""

from __future__ import annotations

from collections.abc import Callable
import signal
from typing import Any

END_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


def handle_end_signals(handler: Callable[[int, Any], Any] | signal.Handlers) -> None:
    """Handle those that the program was not started to ignore.

    As a shell's background job ignores SIGINT, and what nohup starts SIGHUP.
    """
    for number in END_SIGNALS:
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, handler)
