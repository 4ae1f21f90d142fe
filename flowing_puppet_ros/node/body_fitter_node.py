# SPDX-License-Identifier: Apache-2.0
"""The body fitter's node: its component on topics, and the action `fit_body` on the same worker."""

from __future__ import annotations

from functools import partial
from typing import Any

from flowing_puppet_msgs.action import FitBody
from rclpy.action import ActionServer, CancelResponse
from rclpy.action.server import ServerGoalHandle

from flowing_puppet_ros.errors import PuppetError
from flowing_puppet_ros.node.component_node import ComponentNode
from flowing_puppet_ros.stream.body_fitter import BodyFitterComponent


class _Cancelled(Exception):
    """Nobody wants the result any more."""


class BodyFitterNode(ComponentNode[BodyFitterComponent]):
    """Fits the clouds on `points`, and the cloud of a `fit_body` goal between them."""

    def __init__(self, name: str) -> None:
        """Open the topics and the action."""
        super().__init__(name)
        self.component.search_in_background()
        self._action = ActionServer(
            self,
            FitBody,
            "fit_body",
            _abort,
            # The worker executes a goal when its fit is done: a goal that waits or is fitted holds up no callback.
            handle_accepted_callback=lambda goal: self.worker.call(partial(self._serve, goal)),
            cancel_callback=lambda _: CancelResponse.ACCEPT,
        )

    def destroy_node(self) -> None:
        """Close the action with the node."""
        self._action.destroy()
        super().destroy_node()

    def _serve(self, goal: ServerGoalHandle) -> None:
        """Fit the goal's cloud and end the goal (on the worker thread)."""
        try:
            bodies = self._fit(goal)
        except _Cancelled:
            if self.context.ok():
                goal.execute(_cancel)
        except PuppetError as error:
            goal.execute(partial(_abort, message=str(error)))
        except Exception as error:
            goal.execute(partial(_abort, message=f"{type(error).__name__}: {error}"))
            raise
        else:
            goal.execute(partial(_succeed, bodies=bodies))

    def _fit(self, goal: ServerGoalHandle) -> Any:
        """Return the BodyArray of the goal's cloud and publish feedback; _Cancelled when the fit is to end."""

        def progress(fraction: float) -> None:
            if goal.is_cancel_requested or not self.context.ok():
                raise _Cancelled
            goal.publish_feedback(FitBody.Feedback(stage="fit", progress=float(fraction)))

        progress(0.0)
        request = goal.request
        initial = request.initial if request.initial.bodies else None
        return self.component.fit(request.cloud, initial, int(request.seed), progress)[0]


def _succeed(goal: ServerGoalHandle, bodies: Any) -> FitBody.Result:
    goal.succeed()
    return FitBody.Result(bodies=bodies)


def _cancel(goal: ServerGoalHandle) -> FitBody.Result:
    goal.canceled()
    return FitBody.Result(message="cancelled")


def _abort(goal: ServerGoalHandle, message: str = "") -> FitBody.Result:
    goal.abort()
    return FitBody.Result(message=message)


def make_node(name: str) -> BodyFitterNode:
    """Return the body fitter's node."""
    return BodyFitterNode(name)
