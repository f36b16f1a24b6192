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

"""The statuses in /diagnostics, and what each of their values means.

The reference page prints them; no ROS is needed to read this module.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Value:
    """A value of a status.

    :ivar key: as it is published; `*` stands for a name of its own.
    :ivar unit: of a number; empty for words, counts and fractions.
    """

    key: str
    doc: str
    unit: str = ''


@dataclass(frozen=True)
class Status:
    """A status of the node.

    :ivar part: its name behind the node's.
    :ivar doc: what its level and its message say.
    """

    part: str
    doc: str
    values: tuple[Value, ...]


NODE_STATES = (
    ('stopped', 'The node is not active; `lifecycle` says what it is, `reason` what failed, if '
     'anything did. Only these three and `age_s` are published.'),
    ('withheld', 'The node is active and gives no pose, whatever the image says: it is paused, or '
     'a camera_info contradicts the rig (`camera_info_check`). The same values as when stopped.'),
    ('silent', 'No image has come for `silence_warning`; the other values are of the last one.'),
)
"""States that are not the estimator's; of these and of its own `state` holds one."""

STATUSES = (
    Status('pose', 'OK while tracking; ERROR when lost, withheld or after a transition that '
           'failed; else WARN, also while another publisher of the pose topic exists.', (
               Value('lifecycle', 'State of the managed node: unconfigured, inactive, active, '
                     'finalized.'),
               Value('state', 'One of the states below.'),
               Value('reason', 'Why it is this state, in words.'),
               Value('age_s', "Time since the stamp of the last pose given, by the node's clock; "
                     'nan without any.', 's'),
               Value('odometry_lag_s', 'Of the last sample of odometry behind the last image; nan '
                     'without any.', 's'),
               Value('lines_used', 'Lines of the map that the pose rests on; 0 where it rests on '
                     'no image, as while coasting.'),
               Value('points_used', 'Pixels that it rests on; 0 likewise.'),
               Value('residual_px', 'How far these pixels lie beside the predicted edges, root '
                     'mean square; nan where nothing was measured, as while coasting.', 'px'),
               Value('expected_px', "What residual_px would be by the image's noise alone; far "
                     'above it, the rig or the map does not fit; nan likewise.', 'px'),
               Value('explained', 'Fraction of the predicted, visible line pixels that were '
                     'found, 0 to 1 (`least_explained` is asked for); nan likewise.'),
               Value('claimed', 'Fraction of the line-like pixels in the image that the pose '
                     'explains, 0 to 1; low among things of the colour of the lines; nan where '
                     'nothing was looked for.'),
               Value('ambiguity', 'Score of the second best pose over that of the best, 0 to 1; '
                     'above `ambiguity_ratio` it is ambiguous; nan where nothing was measured.'),
               Value('unobserved', 'Directions that the lines in view do not fix, in words.'),
               Value('candidates', 'Poses that may be right, the best first: (x, y, yaw) and '
                     'score, the fraction of line-like pixels explained.'),
               Value('sigma_x_m', 'Standard deviation of x; only with a pose.', 'm'),
               Value('sigma_y_m', 'Of y.', 'm'),
               Value('sigma_yaw_rad', 'Of yaw.', 'rad'))),
    Status('images', 'While active. WARN when none come, when the middleware lost some, or when '
           'messages were refused or exceptions met since the last report. Counts are since the '
           'node started.', (
               Value('topic', 'Full name of the topic.'),
               Value('publishers', 'Publishers of it that match at present.'),
               Value('frames_received', 'Images that arrived.'),
               Value('frames_answered', 'Of these, images for which a pose was given.'),
               Value('frames_dropped_busy', 'Images that a newer one replaced while the node was '
                     'busy.'),
               Value('frames_lost_by_middleware', 'Images that were lost on the way.'),
               Value('clock_resets', 'How often the stamps jumped back by more than `clock_jump`: '
                     'the tracker started anew.'),
               Value('refused', 'Messages that were refused, of all topics.'),
               Value('refused.*', 'Of these, by the cause (below).'),
               Value('errors', 'Exceptions in the node: mistakes of its own. It lives on.'),
               Value('error.*', 'Of these, by the function.'),
               Value('last_refusal', 'What the last refusal said.'),
               Value('last_error', 'What the last exception said.'))),
    Status('time', 'While active; always OK. Cost of the last image.', (
        Value('decode_ms', 'Of the message to an image.', 'ms'),
        Value('predict_ms', 'Checks, and the pose expected by odometry.', 'ms'),
        Value('detect_ms', 'Line-like pixels and strips.', 'ms'),
        Value('associate_ms', 'The search for poses that fit them.', 'ms'),
        Value('measure_ms', 'The edges beside the predicted lines, and the pose by them.', 'ms'),
        Value('refine_ms', 'Covariance and quality.', 'ms'),
        Value('total_ms', 'From predict to refine.', 'ms'),
        Value('arrival_to_answer_ms', 'From the arrival of the message to its pose, all '
              'included.', 'ms'))),
    Status('calibration', 'While configured. WARN when suspect.', (
        Value('condition', '`unknown`: seen from too few places; `good`: the residuals are '
              'noise, or poses hardly change by what is in them; `suspect`: they say that the rig '
              'has moved, or never was as its file says.'),
        Value('frames', 'Places that the images judged by were taken from.'),
        Value('statistic', 'How far the residuals of all places pull at the rig together, '
              'squared, in units of chance; nan while unknown.'),
        Value('limit', 'What chance makes statistic exceed once in 10000 times; nan '
              'likewise.'),
        Value('pose_error_m', 'By how much poses would move under the rig that the residuals ask '
              'for; with statistic above limit and this above 5 mm it is suspect; nan likewise.',
              'm'))),
)
