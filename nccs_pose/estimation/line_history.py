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

"""What the images before have said of the map's lines."""

from __future__ import annotations

from dataclasses import dataclass, replace

from nccs_pose.estimation.alignment import Alignment
from nccs_pose.estimation.misplaced import plainly_in_place
from nccs_pose.estimation.verdict import lines_used

WEAK = 0.5
"""A line of which a pose rests on less than this part is looked for beside its place."""
BEYOND_DOUBT = 4
"""A line that was once seen beside its place is doubted until it is seen in it, or the pose rests
on so many other lines that any of them that was elsewhere would show."""
# Thinner than this, px, a line is drowned by compression, and what is left of the floor around it
# looks like it.
_SURE_WIDTH = 0.5


@dataclass(frozen=True)
class LineHistory:
    """The lines, by their index in the map.

    :ivar doubted: seen beside their place and not in it since.
    :ivar shown: those that the poses since the last search rest on, most of each.
    :ivar proven: those seen plainly in their places, so many at once that any that was elsewhere
        would have shown.
    """

    doubted: frozenset[int] = frozenset()
    shown: frozenset[int] = frozenset()
    proven: frozenset[int] = frozenset()

    def contradicts(self, line: int) -> bool:
        """Whether a line beside its place speaks against the poses before as well.

        It does for the second time, or where no pose has rested on it.
        """
        return line in self.doubted or line not in self.shown

    def doubting(self, line: int) -> LineHistory:
        """After an image that shows a line beside its place."""
        return replace(self, doubted=self.doubted | {line})

    def after(self, alignment: Alignment, *, searched: bool) -> LineHistory:
        """After an image that gave a pose.

        A line that is seen in its place is doubted no longer; nor is one out of view, since what
        looked like it belongs to another place.

        :param searched: whether the whole image was searched for it.
        """
        shown = frozenset(
            k for k, part in enumerate(alignment.support.tolist()) if part >= WEAK)
        doubted = frozenset(k for k in self.doubted if alignment.support[k] < WEAK)
        if lines_used(alignment) > BEYOND_DOUBT:
            doubted = frozenset()
        # Most images show no line that is not proven yet.
        proven = self.proven if shown <= self.proven else self.proven | _proven(alignment)
        return LineHistory(doubted, shown if searched else self.shown | shown, proven)

    def unasked(self, alignment: Alignment) -> frozenset[int]:
        """Lines of which an image can say nothing new: proven ones that it shows too thin."""
        return frozenset(k for k in self.proven if alignment.width[k] < _SURE_WIDTH)


def _proven(alignment: Alignment) -> frozenset[int]:
    """Lines that one image proves; none where it shows too few in their places."""
    width = alignment.width
    plain = frozenset(k for k in plainly_in_place(alignment) if width[k] >= _SURE_WIDTH)
    return plain if len({int(alignment.whole[k]) for k in plain}) >= BEYOND_DOUBT else frozenset()
