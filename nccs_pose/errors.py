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

"""The project's exceptions: one family, one member per room."""

from __future__ import annotations


class NccsPoseError(Exception):
    """Base of every error that the project raises on purpose; its text is one sentence."""


class OptionError(NccsPoseError):
    """An option outside its type or range."""


class GeometryError(NccsPoseError):
    """A mirror, camera, line or transform that cannot exist."""


class VisionError(NccsPoseError):
    """An image that cannot be read or measured."""


class EstimationError(NccsPoseError):
    """A pose problem that has no answer as it was put."""


class FrameRefusedError(EstimationError):
    """A frame that the localiser must not use.

    :ivar cause: one snake_case word for counters and diagnostics.
    """

    def __init__(self, cause: str, message: str) -> None:
        super().__init__(message)
        self.cause = cause


class CalibrationError(NccsPoseError):
    """Measurements from which the rig cannot be calibrated."""


class SimulationError(NccsPoseError):
    """A scene or motion that cannot be rendered."""


class FileError(NccsPoseError):
    """A file that cannot be read or written, or that says something it must not."""
