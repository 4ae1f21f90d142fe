# SPDX-License-Identifier: Apache-2.0
"""The body fitter's node: its component on topics, and the action `fit_body` on the same worker."""

from __future__ import annotations

from functools import partial
from typing import Any

from flowing_puppet_msgs.action import FitBody
from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.action.server import ServerGoalHandle

from flowing_puppet_ros.errors import PuppetError
from flowing_puppet_ros.node.component_node import ComponentNode
from flowing_puppet_ros.node.session import Session
from flowing_puppet_ros.stream.components.body_fitter import BodyFitterComponent


class _Cancelled(Exception):
    """Raised in a fit whose result is not wanted any more."""


class BodyFitterNode(ComponentNode[BodyFitterComponent]):
    """Fits the clouds on `points`, and the cloud of a `fit_body` goal between them while it is active."""

    _action: ActionServer | None = None

    def _open(self) -> None:
        super()._open()
        self._action = ActionServer(
            self,
            FitBody,
            "fit_body",
            _abort,
            goal_callback=lambda _: GoalResponse.ACCEPT if self._active_session() else GoalResponse.REJECT,
            # The worker executes a goal when its fit is done, so that a waiting goal blocks no callback.
            handle_accepted_callback=self._accept,
            cancel_callback=lambda _: CancelResponse.ACCEPT,
        )

    def _close(self) -> None:
        """Close the session first, so that no goal is being fitted when the action is destroyed."""
        super()._close()
        action, self._action = self._action, None
        if action is not None:
            action.destroy()

    def _active_session(self) -> Session[BodyFitterComponent] | None:
        """Return the session if it is active."""
        return self.session if self.session is not None and self.session.active else None

    def _accept(self, goal: ServerGoalHandle) -> None:
        session = self._active_session()
        if session is None:
            goal.execute(partial(_abort, message=f"the node is {self.state}"))
        else:
            session.worker.call(partial(self._serve, session, goal))

    def _serve(self, session: Session[BodyFitterComponent], goal: ServerGoalHandle) -> None:
        """Fit the goal's cloud and end the goal (on the worker thread)."""
        try:
            bodies = self._fit(session, goal)
        except _Cancelled:
            if self.context.ok() and self._action is not None:
                goal.execute(_cancel if goal.is_cancel_requested else partial(_abort, message="the node went inactive"))
        except PuppetError as error:
            goal.execute(partial(_abort, message=str(error)))
        except Exception as error:
            goal.execute(partial(_abort, message=f"{type(error).__name__}: {error}"))
            raise
        else:
            goal.execute(partial(_succeed, bodies=bodies))

    def _fit(self, session: Session[BodyFitterComponent], goal: ServerGoalHandle) -> Any:
        """Return the BodyArray of the goal's cloud and publish feedback; _Cancelled if the fit must end."""

        def progress(fraction: float) -> None:
            if goal.is_cancel_requested or not session.active or not self.context.ok():
                raise _Cancelled
            goal.publish_feedback(FitBody.Feedback(stage="fit", progress=float(fraction)))

        progress(0.0)
        request = goal.request
        initial = request.initial if request.initial.bodies else None
        return session.component.fit(request.cloud, initial, int(request.seed), progress)[0]


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
