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

"""Small systems with a symmetric, positive definite matrix: LAPACK without numpy's ceremony."""

from __future__ import annotations

from nccs_pose.geometry.pose import Array
import numpy as np
from scipy.linalg.lapack import dposv


def definite_solution(matrix: Array, right: Array) -> Array:
    """Solution (P,) or (P, K) of a system (P, P) by Cholesky's factors.

    :raises numpy.linalg.LinAlgError: where the matrix is not positive definite.
    """
    _, found, failed = dposv(matrix, right)
    if failed:
        raise np.linalg.LinAlgError('the matrix is not positive definite')
    return np.asarray(found)
