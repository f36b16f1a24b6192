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

from dataclasses import dataclass, replace
from functools import cached_property

from nccs_pose.errors import VisionError
from nccs_pose.geometry.pose import Array
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
# A learned contrast further than this from its class is no longer that colour.
_DRIFT_COSINE = 0.5
# A contrast is learned when its mean is this many times its standard error.
_EVIDENT = 4.0
# Blur that an image can have, px, and how far one image may change it.
_BLUR_RANGE = (0.35, 3.0)
_BLUR_STEP = 0.3


@dataclass(frozen=True, eq=False)
class LineColour:
    """The contrast between tape and floor, and the colours by which the floor itself varies.

    :ivar name: colour class, a key of :data:`CONTRASTS`.
    :ivar contrast: tape minus floor (3,) in B, G, R, grey levels.
    :ivar clutter: covariance (3, 3) of what is no tape: noise, texture, shade; grey levels^2.
    :ivar blur: standard deviation of an edge's blur by lens, motion and pixel, px.
    """

    name: str
    contrast: Array
    clutter: Array
    blur: float

    @classmethod
    def nominal(cls, name: str, blur: float) -> LineColour:
        """The class's own contrast, before any image is seen.

        :raises VisionError: if the class is unknown.
        """
        if name not in CONTRASTS:
            raise VisionError(f'colour {name!r} is not one of {", ".join(CONTRASTS)}')
        direction = np.array(CONTRASTS[name])
        # A coloured tape is told by chromaticity: brightness is what the floor varies in.
        grey = np.full((3, 3), 20.0**2) if abs(direction.sum()) < 1e-9 else np.zeros((3, 3))
        return cls(name, 60.0 * direction / np.linalg.norm(direction), grey + 4.0 * np.eye(3),
                   blur)

    @cached_property
    def discriminant(self) -> Array:
        """Fisher's weights (3,) on B, G, R, scaled so that the tape's contrast is 1."""
        weights = np.linalg.solve(self.clutter, self.contrast)
        return weights / float(weights @ self.contrast)

    def learn(self, height: Array, power: Array, floor: Array, used: Array) -> LineColour:
        """Take over the contrast seen at N stations and the variation of the floor beside them.

        A pose that is wrong shows floor where it expects tape; what it would teach is refused.

        :param height: contrast per station (N, 3).
        :param power: its information per unit of noise (N,).
        :param floor: samples beside the tape less their mean (N, K, 3).
        :param used: 1 where a sample counts (N, K).
        """
        along = height @ self.discriminant
        mean = float(power @ along) / float(power.sum())
        # Those of mere noise that happen to be positive would pass for a faint tape.
        if mean < _EVIDENT * float(np.linalg.norm(power * (along - mean))) / float(power.sum()):
            return self
        good = along > 0.3 * max(float(np.median(along)), 0.0)
        if good.sum() < 10:
            return self
        contrast = (power[good, None] * height[good]).sum(axis=0) / power[good].sum()
        nominal = np.array(CONTRASTS[self.name])
        cosine = contrast @ nominal / (np.linalg.norm(contrast) * np.linalg.norm(nominal) + 1e-9)
        if cosine < _DRIFT_COSINE or np.linalg.norm(contrast) < 3.0:
            return self
        rows = floor[good]
        clutter = np.einsum('nkc,nkd->cd', rows, rows) / max(used[good].sum(), 1.0)
        # One grey level of rounding keeps a noise-free image from a singular covariance.
        clutter += 0.1 * np.eye(3)
        return replace(self, contrast=contrast, clutter=clutter)

    def sharpen(self, values: Array, height: Array, soften: Array) -> LineColour:
        """Take over the blur seen at N stations.

        A profile that is softer than its template leaves a residual along dT/d(blur), in
        proportion to its contrast; all stations together tell how much.

        :param values: samples (N, K, 3).
        :param height: contrast per station (N, 3).
        :param soften: dT/d(blur) (N, K), orthogonal to floor and template.
        """
        along = np.maximum(height @ self.discriminant, 0.0)
        left = np.einsum('nk,nkc,c->n', soften, values, self.discriminant)
        power = (along**2 * (soften * soften).sum(axis=1)).sum()
        if power < 1e-9:
            return self
        step = float(np.clip((along * left).sum() / power, -_BLUR_STEP, _BLUR_STEP))
        return replace(self, blur=float(np.clip(self.blur + step, *_BLUR_RANGE)))
