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

"""The localiser's options, declared once: defaults, ranges, units and words."""

from __future__ import annotations

from dataclasses import dataclass

from nccs_pose.options import check_options, option


@dataclass(frozen=True)
class LocaliserOptions:
    """What can be set of the estimator.

    :raises OptionError: for a value outside its range.
    """

    reach: float = option(
        5.0, unit='m', low=0.5, high=50.0,
        doc='How far from the mirror floor lines are looked for.')
    threshold: str = option(
        'chromaticity', choices=('chromaticity', 'hsv'), live=True,
        doc='How line-coloured pixels are found: relative to their surroundings, or by fixed '
            'hue, saturation and value as in the paper.')
    noise_gate: float = option(
        4.5, low=1.0, high=20.0, live=True,
        doc="Threshold of the colour mask in standard deviations of the image's noise.")
    least_contrast: float = option(
        0.05, low=0.0, high=1.0, live=True,
        doc='Smallest contrast of the first colour mask, as a fraction of the image brightness.')
    window: int = option(
        31, unit='px', low=5, high=301, live=True,
        doc='Width of the surroundings that a line-coloured pixel is compared with; a few times '
            'the widest tape.')
    stations: int = option(
        75, low=5, high=1000, live=True,
        doc='Points measured on each line, spread evenly along what is seen of it (75 as in the '
            'paper), in whole groups of neighbours; fewer where they would stand closer than '
            '2 px.')
    blur: float = option(
        0.7, unit='px', low=0.2, high=5.0, live=True,
        doc='Blur of an edge in the image, standard deviation: a start, each image says its own.')
    band: float = option(
        12.0, unit='px', low=3.0, high=100.0, live=True,
        doc='How far beside its predicted curve a line is searched while tracking.')
    least_explained: float = option(
        0.5, low=0.05, high=1.0, live=True,
        doc='Smallest fraction of the predicted line pixels that must be found to track.')
    largest_misfit: float = option(
        0.5, unit='px', low=0.05, high=20.0, live=True,
        doc='Largest root mean square by which whole stretches of lines may lie off before the '
            'pose is withheld: a rig or a map that does not fit.')
    ambiguity_ratio: float = option(
        0.85, low=0.1, high=1.0, live=True,
        doc='A second pose that scores more than this fraction of the best makes it ambiguous.')
    height_sigma: float = option(
        0.001, unit='m', low=0.0, high=0.1, live=True,
        doc="How well the mirror's height over the floor is known; it is estimated in every "
            'frame within that. 0 holds it.')
    tilt_sigma: float = option(
        0.0, unit='rad', low=0.0, high=0.1, live=True,
        doc='How flat the floor is: roll and pitch are estimated in every frame within that. '
            '0 holds them.')
    calibration_sigma: float = option(
        0.0, unit='px', low=0.0, high=10.0, live=True,
        doc='What the calibration may shift the whole image by; it widens the covariance, since '
            'no number of pixels averages it out.')
    innovation_gate: float = option(
        6.0, low=2.0, high=50.0, live=True,
        doc='Largest disagreement of the image with the predicted pose, in standard deviations, '
            'before the image is searched as if the robot had been carried away.')
    coast_time: float = option(
        2.0, unit='s', low=0.0, high=60.0, live=True,
        doc='How long odometry alone may carry the pose on.')
    coast_sigma: float = option(
        0.25, unit='m', low=0.01, high=10.0, live=True,
        doc='Largest standard deviation of a pose carried on by odometry alone; of its yaw as '
            'many rad.')
    check_every: int = option(
        10, low=1, high=1000, live=True,
        doc='While tracking, every so many frames the whole image is checked for a better pose.')
    clock_jump: float = option(
        1.0, unit='s', low=0.01, high=3600.0,
        doc='A stamp that goes back further than this is a new start; less is disorder.')

    def __post_init__(self) -> None:
        check_options(self)
