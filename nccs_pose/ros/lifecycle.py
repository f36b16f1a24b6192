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

"""What rclpy's managed node lacks in Jazzy."""

from __future__ import annotations

from typing import Any

from rclpy.lifecycle import LifecycleNode


def answer_every_request(node: LifecycleNode) -> None:
    """Answer a transition that is not allowed with success = false and go on.

    rclpy lets the error out of spin, which ends the node (rclpy issue 1209).
    """
    service = node._service_change_state
    change_state = service.callback

    def guarded(request: Any, response: Any) -> Any:
        try:
            return change_state(request, response)
        except Exception as error:
            asked = request.transition.label or f'id {request.transition.id}'
            node.get_logger().warning(f'transition {asked} refused: {in_words(error)}')
            response.success = False
            return response

    service.callback = guarded


def in_words(error: BaseException) -> str:
    """An exception as one line."""
    return ' '.join(f'{type(error).__name__}: {error}'.split())
