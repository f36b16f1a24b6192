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

"""What the localiser sees, for tuning: colour mask, points, predicted lines, pose, state."""

from __future__ import annotations

from nccs_pose.estimation.estimate import Estimate
from nccs_pose.estimation.options import LocaliserOptions
from nccs_pose.evaluation.overlay import draw_overlay, KEY
from nccs_pose.geometry.lines import LineMap
from nccs_pose.geometry.rig import Rig
from nccs_pose.vision.segment import chromatic_mask, hsv_mask
import numpy as np
from numpy.typing import NDArray

MASK_COLOUR = np.array([255, 255, 0], dtype=np.uint8)
"""BGR; no tape is cyan."""


def draw_debug_image(
    image: NDArray[np.uint8], rig: Rig, line_map: LineMap, estimate: Estimate,
    options: LocaliserOptions,
) -> NDArray[np.uint8]:
    """Draw over an image (H, W, 3), and write below; line-coloured pixels are tinted cyan."""
    tinted = image.copy()
    for colour in dict.fromkeys(line.colour for line in line_map):
        if options.threshold == 'hsv':
            mask = hsv_mask(image, colour)
        else:
            mask = chromatic_mask(
                image, colour, options.noise_gate, options.least_contrast, options.window)
        chosen = mask > 0
        tinted[chosen] = tinted[chosen] // 2 + MASK_COLOUR // 2
    return draw_overlay(
        tinted, rig, line_map, estimate, key=f'cyan: counts as line-coloured   {KEY}')
