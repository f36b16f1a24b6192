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

"""Numbers on the command line that must lie in a range; argparse says so where they do not."""

from __future__ import annotations

import argparse
from collections.abc import Callable
import math

WIDEST = 8192
"""Pixels of a simulated image; a rendered frame then takes gigabytes."""


def whole(low: int, high: int | None = None) -> Callable[[str], int]:
    """A whole number from `low` on, up to `high` if given."""
    def parse(text: str) -> int:
        try:
            value = int(text)
        except ValueError:
            value = None
        if value is None or value < low or (high is not None and value > high):
            end = 'on' if high is None else f'to {high}'
            raise argparse.ArgumentTypeError(f'{text!r} is no whole number from {low} {end}')
        return value

    return parse


def number(low: float, high: float, unit: str = '') -> Callable[[str], float]:
    """A number from `low` to `high`."""
    def parse(text: str) -> float:
        value = _number(text)
        if not low <= value <= high:
            end = f'{high:g} {unit}'.strip()
            raise argparse.ArgumentTypeError(f'{text!r} is no number from {low:g} to {end}')
        return value

    return parse


def image_width(low: int) -> Callable[[str], int]:
    """The width of simulated images in pixels, from `low` on; they are 4:3."""
    def parse(text: str) -> int:
        value = whole(low, WIDEST)(text)
        if value % 4:
            raise argparse.ArgumentTypeError(f'{text!r} is no multiple of 4 px')
        return value

    return parse


def positive(text: str) -> float:
    """A number above 0."""
    value = _number(text)
    if not 0.0 < value < math.inf:
        raise argparse.ArgumentTypeError(f'{text!r} must be greater than 0')
    return value


def seconds(text: str) -> float:
    """A time, 0 or longer."""
    value = _number(text)
    if not 0.0 <= value < math.inf:
        raise argparse.ArgumentTypeError(f'{text!r} is no time in seconds, 0 or longer')
    return value


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan
