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

"""Lays the pose expected of an image on it, and now and then looks for a better one."""

from __future__ import annotations

from nccs_pose.estimation.aligner import Aligner
from nccs_pose.estimation.alignment import Alignment
from nccs_pose.estimation.elsewhere import Elsewhere, leaves_room
from nccs_pose.estimation.frame import Frame
from nccs_pose.estimation.judge import Found, is_expected, Judge
from nccs_pose.estimation.ledger import Refused
from nccs_pose.estimation.line_history import LineHistory
from nccs_pose.estimation.motion import Prediction
from nccs_pose.estimation.options import LocaliserOptions
from nccs_pose.estimation.search import Searcher
from nccs_pose.estimation.shift_solve import Prior
from nccs_pose.estimation.verdict import is_suspect
from nccs_pose.geometry.lines import LineMap
from nccs_pose.vision.colour import LineColour


class Follower:
    """Follows a robot from image to image, for one rig and map."""

    def __init__(
        self, aligner: Aligner, searcher: Searcher, judge: Judge, line_map: LineMap,
        options: LocaliserOptions,
    ) -> None:
        self._aligner = aligner
        self._searcher = searcher
        self._judge = judge
        self._elsewhere = Elsewhere(aligner, searcher, line_map, options)
        self._options = options
        # Whatever was followed before has not been held against a whole image by these.
        self._frames_since_check = options.check_every

    def begin(self) -> None:
        """Start anew, from a pose that the search of a whole image has shown."""
        self._frames_since_check = 0

    def follow(
        self, frame: Frame, prediction: Prediction, colours: tuple[LineColour, ...],
        history: LineHistory,
    ) -> Found | Refused:
        """Lay a predicted pose on an image; refused where the whole must be searched.

        :param prediction: that of the frame, or a pose that was given.
        :param history: what images have said of the lines before.
        """
        alignment = self._laid(frame, prediction, colours, history)
        if isinstance(alignment, Refused):
            return alignment
        self._frames_since_check += 1
        if (self._frames_since_check < self._options.check_every
                and not (is_suspect(alignment) or prediction.is_vague or alignment.missing)
                and len(alignment.lines) > 1):
            return Found(alignment, float('nan'), alignment.explained)
        return self._checked(frame, alignment, prediction)

    def _laid(
        self, frame: Frame, prediction: Prediction, colours: tuple[LineColour, ...],
        history: LineHistory,
    ) -> Alignment | Refused:
        """Lay a predicted pose on an image: in its place or, if it does not hold, beside it."""
        prior = Prior(prediction.pose, prediction.information)
        refused = Refused()
        for reach in (0.0, self._options.band):
            alignment = self._aligner.align(
                frame.image, prediction.pose, colours, reach=reach, prior=prior)
            frame.watch.lap('measure')
            if alignment is None or not is_expected(
                    alignment, prediction, self._options.innovation_gate):
                continue
            against = self._judge.objection(frame.image, alignment, history, expected=True)
            if against is None:
                return alignment
            refused = Refused(against, alignment)
        return refused

    def _checked(
        self, frame: Frame, alignment: Alignment, prediction: Prediction,
    ) -> Found | Refused:
        """Hold a pose that lies on an image where it is expected against all of the image."""
        masks = self._searcher.masks(frame.image)
        claimed = self._searcher.on_lines(alignment.pose, masks)
        frame.watch.lap('detect')
        if is_suspect(alignment) or prediction.is_vague or leaves_room(alignment, claimed):
            segments = self._searcher.strips(masks)
            frame.watch.lap('detect')
            elsewhere = self._elsewhere.refused(frame.image, alignment, prediction, segments)
            frame.watch.lap('associate')
            if elsewhere is not None:
                # The next image is looked at as a whole as well.
                return elsewhere
        self._frames_since_check = 0
        return Found(alignment, claimed, alignment.explained)
