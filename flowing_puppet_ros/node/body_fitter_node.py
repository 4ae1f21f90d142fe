# SPDX-License-Identifier: Apache-2.0
"""The body fitter's node: its component on topics, and the action `fit_body` on the same worker."""

from __future__ import annotations

import threading
from dataclasses import dataclass, field
from typing import Any

from flowing_puppet_msgs.action import FitBody
from rclpy.action import ActionServer, CancelResponse
from rclpy.action.server import ServerGoalHandle
from rclpy.callback_groups import ReentrantCallbackGroup

from flowing_puppet_ros.errors import PuppetError
from flowing_puppet_ros.node.component_node import ComponentNode
from flowing_puppet_ros.stream.body_fitter import BodyFitterComponent


class _Cancelled(Exception):
    """The client does not want the result any more."""


@dataclass
class _Job:
    """What the worker leaves for the action: the bodies or the error, then `done`."""

    bodies: Any = None
    error: Exception | None = None
    done: threading.Event = field(default_factory=threading.Event)


class BodyFitterNode(ComponentNode[BodyFitterComponent]):
    """Fits the clouds on `points`, and the cloud of a `fit_body` goal between them."""

    def __init__(self, name: str) -> None:
        """Open the topics and the action."""
        super().__init__(name)
        self._action = ActionServer(
            self,
            FitBody,
            "fit_body",
            self._execute,
            # A goal waits for its fit without keeping the other callbacks from running.
            callback_group=ReentrantCallbackGroup(),
            cancel_callback=lambda _: CancelResponse.ACCEPT,
        )

    def destroy_node(self) -> None:
        """Close the action with the node."""
        self._action.destroy()
        super().destroy_node()

    def _execute(self, goal: ServerGoalHandle) -> FitBody.Result:
        job = _Job()
        self.worker.call(lambda: self._fit(goal, job))
        job.done.wait()
        result = FitBody.Result()
        if job.error is None:
            result.bodies = job.bodies
            goal.succeed()
        elif isinstance(job.error, _Cancelled):
            result.message = "cancelled"
            goal.canceled()
        else:
            result.message = str(job.error)
            goal.abort()
        return result

    def _fit(self, goal: ServerGoalHandle, job: _Job) -> None:
        """Fit the goal's cloud and publish feedback (on the worker thread)."""

        def progress(fraction: float) -> None:
            if goal.is_cancel_requested:
                raise _Cancelled
            goal.publish_feedback(FitBody.Feedback(stage="fit", progress=float(fraction)))

        request = goal.request
        try:
            progress(0.0)
            initial = request.initial if request.initial.bodies else None
            job.bodies, _ = self.component.fit(request.cloud, initial, int(request.seed), progress)
        except (PuppetError, _Cancelled) as error:
            job.error = error
        except Exception as error:
            job.error = error
            raise
        finally:
            job.done.set()


def make_node(name: str) -> BodyFitterNode:
    """Return the body fitter's node."""
    return BodyFitterNode(name)
