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

"""Whether the wheels alone may carry a pose on, where an image gives none."""

from __future__ import annotations

from nccs_pose.estimation.alignment import Alignment, leaves_open
from nccs_pose.estimation.motion import Prediction
from nccs_pose.estimation.options import LocaliserOptions
from nccs_pose.estimation.search import Searcher
from nccs_pose.estimation.sights import Sight
from nccs_pose.estimation.verdict import lines_used
import numpy as np

# An image shows another place than expected if the expected pose explains less than this part of
# the strips, and those that it leaves are more pixels than this for each of the image's width.
_LEAST_CLAIMED = 0.5
_FOREIGN = 0.25
# It shows the expected place if that explains this part of them, however few there are.
_OWN = 0.85


def may_coast(prediction: Prediction, seconds: float, options: LocaliserOptions) -> bool:
    """Whether a prediction is still good enough to be given for a pose.

    :param seconds: since an image gave a pose.
    """
    covariance = prediction.covariance
    variance = max(float(np.linalg.eigvalsh(covariance[:2, :2])[-1]), covariance[2, 2])
    return bool(prediction.by_odometry and seconds <= options.coast_time
                and variance <= options.coast_sigma**2)


def shows_another_place(sight: Sight, prediction: Prediction, searcher: Searcher) -> bool:
    """Whether what is seen in an image speaks for another place than the one expected."""
    _, claimed = searcher.score(prediction.pose, sight.segments)
    foreign = (1.0 - claimed) * sum(strip.weight for strip in sight.segments)
    return claimed < _LEAST_CLAIMED and foreign > _FOREIGN * sight.image.shape[1]


def shows_this_place(
    sight: Sight, prediction: Prediction, alignment: Alignment | None, searcher: Searcher,
    options: LocaliserOptions,
) -> bool:
    """Whether an image agrees with the expected pose, though it hides too much of its lines.

    :param alignment: the pose that was laid on it and refused; None if none lies there.
    """
    if alignment is None or alignment.explained >= options.least_explained:
        return False
    if lines_used(alignment) < 2 or leaves_open(alignment.refinement):
        return False
    return searcher.score(prediction.pose, sight.segments)[1] >= _OWN
