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

"""How a tape looks: its contrast to the floor and its edges' blur, learned as they are seen."""

from __future__ import annotations

from dataclasses import dataclass
import math

from nccs_pose.errors import VisionError
from nccs_pose.geometry.pose import Array
from nccs_pose.geometry.small_matrices import solve_symmetric
from nccs_pose.vision.median import upper_median
import numpy as np

# Signs of the contrast (tape minus floor) in B, G, R of each class that a map may name.
CONTRASTS: dict[str, tuple[float, float, float]] = {
    'green': (-0.5, 1.0, -0.5),
    'red': (-0.5, -0.5, 1.0),
    'blue': (1.0, -0.5, -0.5),
    'yellow': (-1.0, 0.5, 0.5),
    'magenta': (0.5, -1.0, 0.5),
    'cyan': (0.5, 0.5, -1.0),
    'white': (1.0, 1.0, 1.0),
    'black': (-1.0, -1.0, -1.0),
}
# The contrast of a tape that no image has shown yet, grey levels: so faint that what is asked for
# in parts of it binds only once one has.
_UNSEEN = 10.0
# Nor has any shown how the floor varies: in its brightness, and in every channel by itself.
_SHADE = 20.0
_NOISE = 2.0
# A learned contrast further than this from its class, or fainter (grey levels), is not that
# colour.
_DRIFT_COSINE = 0.5
_LEAST_CONTRAST = 3.0
# A contrast is learned when its mean is this many times its standard error.
_EVIDENT = 4.0
# It is learned from stations that show this part of the usual one, and from no fewer than these.
_LEAST_SHARE = 0.3
_LEAST_STATIONS = 10
# Blur that an image can have, px, and how far one image may change it.
_BLUR_RANGE = (0.25, 3.0)
_BLUR_STEP = 0.5
# One grey level of rounding keeps a noise-free image from a singular covariance.
_ROUNDING = 0.1 * np.eye(3)


@dataclass(frozen=True, eq=False)
class LineColour:
    """The contrast between tape and floor, and the colours by which the floor itself varies.

    :ivar name: colour class, a key of :data:`CONTRASTS`.
    :ivar contrast: tape minus floor (3,) in B, G, R, grey levels.
    :ivar clutter: covariance (3, 3) of what is no tape: noise, texture, shade; grey levels^2.
    :ivar blur: standard deviation of an edge's blur by lens, motion and pixel, px.
    :ivar discriminant: Fisher's weights (3,) on B, G, R, scaled so that the contrast is 1.
    """

    name: str
    contrast: Array
    clutter: Array
    blur: float
    discriminant: Array

    @classmethod
    def of(cls, name: str, contrast: Array, clutter: Array, blur: float) -> LineColour:
        """A contrast (3,) that is told from clutter (3, 3)."""
        weights = solve_symmetric(clutter, contrast)
        return cls(name, contrast, clutter, blur, weights / float(weights.dot(contrast)))

    @classmethod
    def nominal(cls, name: str, blur: float) -> LineColour:
        """The class's own contrast, before any image is seen.

        :raises VisionError: if the class is unknown.
        """
        if name not in CONTRASTS:
            raise VisionError(f'colour {name!r} is not one of {", ".join(CONTRASTS)}')
        direction = np.array(CONTRASTS[name])
        # A coloured tape is told by chromaticity: brightness is what the floor varies in.
        grey = np.full((3, 3), _SHADE**2) if _is_coloured(name) else np.zeros((3, 3))
        contrast = _UNSEEN * direction / np.linalg.norm(direction)
        return cls.of(name, contrast, grey + _NOISE**2 * np.eye(3), blur)

    def learn(self, height: Array, power: Array, clutter: Array, floor: Array) -> LineColour:
        """Take over the contrast seen at N stations and the variation that is no tape's.

        A pose that is wrong shows floor where it expects tape; what it would teach is refused.

        :param height: contrast per station (3, N).
        :param power: its information per unit of noise (N,).
        :param clutter: covariance of what no profile explains (3, 3, N), grey levels^2.
        :param floor: the floor's colour (3,), grey levels.
        """
        along = self.discriminant.dot(height)
        total = float(power.sum())
        mean = float(power.dot(along)) / total
        # Those of mere noise that happen to be positive would pass for a faint tape.
        scatter = power * (along - mean)
        if mean < _EVIDENT * math.sqrt(float(scatter.dot(scatter))) / total:
            return self
        good = (along > _LEAST_SHARE * max(upper_median(along), 0.0)).astype(float)
        count = float(good.sum())
        if count < _LEAST_STATIONS:
            return self
        weight = power * good
        return self.taught(
            height.dot(weight) / power.dot(good),
            clutter.reshape(9, -1).dot(good).reshape(3, 3) / count, floor)

    def taught(self, contrast: Array, clutter: Array, floor: Array) -> LineColour:
        """Take over a contrast (3,) to a floor's colour (3,), unless it is not of this class.

        :param clutter: covariance of the floor (3, 3), grey levels^2.
        """
        if self._unlike(contrast, floor) or float(contrast.dot(contrast)) < _LEAST_CONTRAST**2:
            return self
        return LineColour.of(self.name, contrast, clutter + _ROUNDING, self.blur)

    def _unlike(self, contrast: Array, floor: Array) -> bool:
        """Whether a contrast (3,) to a floor's colour (3,) is another class's.

        Relative to the floor, which takes out exposure and white balance; and for a coloured tape
        less the brightness, which tells nothing of its hue.
        """
        relative = [c / max(f, 1.0) for c, f in zip(contrast.tolist(), floor.tolist())]
        nominal = CONTRASTS[self.name]
        if _is_coloured(self.name):
            brightness = sum(relative) / 3.0
            relative = [value - brightness for value in relative]
        size = math.hypot(*relative) * math.hypot(*nominal)
        return sum(r * n for r, n in zip(relative, nominal)) < _DRIFT_COSINE * size or size == 0.0

    def sharpen(self, height: Array, left: Array, power: Array, unit: float) -> LineColour:
        """Take over the blur seen at N stations.

        A profile that is softer than its template leaves a residual along dT/d(blur), in
        proportion to its contrast; all stations together tell how much.

        :param height: contrast per station (N,), negative where there is none.
        :param left: product of the stations' profile with dT/d(blur), the template itself taken
            out of it (N,).
        :param power: of that with itself (N,).
        :param unit: what the derivative has been multiplied by, px.
        """
        height = np.maximum(height, 0.0)
        total = float((height * height).dot(power))
        if total < 1e-9:
            return self
        step = min(max(unit * float(height.dot(left)) / total, -_BLUR_STEP), _BLUR_STEP)
        least, most = _BLUR_RANGE
        return LineColour(
            self.name, self.contrast, self.clutter, min(max(self.blur + step, least), most),
            self.discriminant)


def _is_coloured(name: str) -> bool:
    """Whether a class has a hue, which brightness tells nothing of."""
    return abs(sum(CONTRASTS[name])) < 1e-9
