# SPDX-License-Identifier: Apache-2.0
"""The managed node around a stream component: lifecycle, parameters, diagnostics, reset, time jumps."""

from __future__ import annotations

import traceback
from collections.abc import Callable
from threading import Timer
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from lifecycle_msgs.srv import ChangeState
from rcl_interfaces.msg import SetParametersResult
from rclpy.clock import Clock, ClockType, JumpThreshold, TimeJump
from rclpy.duration import Duration
from rclpy.exceptions import NameValidationException, ParameterException
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.parameter import Parameter
from std_srvs.srv import Trigger

from flowing_puppet_ros.errors import InputError, PuppetError
from flowing_puppet_ros.node.diagnostics import Diagnostics, NodeStatus
from flowing_puppet_ros.node.factory import RosMessageFactory
from flowing_puppet_ros.node.parameters import apply_changes, convert_to_floats, declare
from flowing_puppet_ros.node.session import Session
from flowing_puppet_ros.process.memory import return_start_memory
from flowing_puppet_ros.stream.component import Component
from flowing_puppet_ros.stream.components.registry import COMPONENTS, FIXED_SETTINGS, node_settings

SLOW_START_S = 10.0
_SLOW_START = "still loads models and compiles kernels, which takes minutes at the first start after an installation"
SUCCESS, FAILURE = TransitionCallbackReturn.SUCCESS, TransitionCallbackReturn.FAILURE
_UNUSABLE = (PuppetError, ParameterException, NameValidationException, RuntimeError, ValueError)
"""Errors of components and rclpy for unusable parameters, names and policies."""


class ComponentNode[C: Component[Any]](LifecycleNode):
    """A managed node: configuring loads the models and compiles what they need, activating opens the inputs.

    With the parameter `autostart` it activates itself at once; otherwise a lifecycle manager does. Parameters may be
    changed in every state: a running component adopts them or, if it cannot, is replaced by a new one.
    """

    session: Session[C] | None = None

    def __init__(self, component: str, node_name: str | None = None, **options: Any) -> None:
        """Declare the parameters and start; InputError if that cannot work.

        `component` is a name in COMPONENTS, and the node's unless `node_name` is given; `options` are those of
        rclpy.node.Node (namespace, parameter_overrides, ...).
        """
        super().__init__(node_name or component, **options)
        self.problem = ""
        self._component = component
        self._settings = declare(self, COMPONENTS[component].settings_type, COMPONENTS[component].fixed)
        self._node_settings = declare(self, node_settings(component), FIXED_SETTINGS)
        self._diagnostics = Diagnostics(self.get_fully_qualified_name(), component)
        self._steady_clock = Clock(clock_type=ClockType.STEADY_TIME)
        self._last_report = self._steady_clock.now()
        self._publisher = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self.create_timer(1.0, self._report, clock=self._steady_clock)
        self.create_service(Trigger, "~/reset", self._on_reset_request)
        backward = JumpThreshold(min_forward=None, min_backward=Duration(nanoseconds=-1), on_clock_change=False)
        # The handle keeps the callback registered.
        self._jump_handle = self.get_clock().create_jump_callback(backward, post_callback=self._on_time_jump)
        self.add_pre_set_parameters_callback(self._convert_parameters)
        self.add_on_set_parameters_callback(self._check)
        self.add_post_set_parameters_callback(self._apply)
        self._answer_every_transition()
        if self._node_settings.autostart:
            for transition in (self.trigger_configure, self.trigger_activate):
                if transition() != SUCCESS:
                    raise InputError(self.problem)

    @property
    def state(self) -> str:
        """The lifecycle state: unconfigured, inactive, active, finalized, or a transition between them."""
        return str(self._state_machine.current_state[1])

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Load the component and open its outputs."""
        return self._attempt(self._open)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Open the inputs."""
        return self._attempt(self._activate)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Close the inputs; keep the models, forget the people."""
        if self.session is not None:
            self.session.deactivate()
        return SUCCESS

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Release the component."""
        self._close()
        return SUCCESS

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Release the component for good."""
        self._close()
        return SUCCESS

    def on_error(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Release the component; the node may be configured again."""
        self._close()
        return SUCCESS

    def destroy_node(self) -> None:
        """Let the running task end, then destroy the node."""
        self._close()
        super().destroy_node()

    def _attempt(self, step: Callable[[], None]) -> TransitionCallbackReturn:
        """Run a step of the lifecycle; if it fails, report the problem in one sentence and undo the step."""
        self.problem = ""
        try:
            step()
        except _UNUSABLE as error:
            self._give_up(" ".join(str(error).split()))
            return FAILURE
        except Exception as error:
            # rclpy would not report it.
            where = traceback.extract_tb(error.__traceback__)[-1]
            self._give_up(f"{type(error).__name__}: {error} ({where.filename}:{where.lineno})")
            return TransitionCallbackReturn.ERROR
        return SUCCESS

    def _give_up(self, problem: str) -> None:
        self.problem = problem
        self._diagnostics.record_problem(problem)
        if not self._node_settings.autostart:
            self.get_logger().error(f"the node cannot work: {problem}")
        if self.session is not None:
            self.session.deactivate()

    def _open(self) -> None:
        """Make the component with the current settings and connect it to the topics."""
        kind: Any = COMPONENTS[self._component]
        component: C = kind(self._settings, RosMessageFactory())
        component.node = self.get_fully_qualified_name()
        still_starting = Timer(SLOW_START_S, lambda: self.get_logger().info(_SLOW_START))
        still_starting.start()
        try:
            component.warm_up()
        finally:
            still_starting.cancel()
        return_start_memory()
        settings = self._node_settings
        self.session = Session(self, component, settings.queue, self._diagnostics, settings.image_transport)

    def _activate(self) -> None:
        if self.session is None:
            raise InputError(self.problem or "the node is not configured")
        self.session.activate()

    def _close(self) -> None:
        session, self.session = self.session, None
        if session is not None:
            session.close()

    def _convert_parameters(self, parameters: list[Parameter]) -> list[Parameter]:
        return convert_to_floats((type(self._settings), type(self._node_settings)), parameters)

    def _check(self, parameters: list[Parameter]) -> SetParametersResult:
        """Return whether a change is possible, without making it."""
        try:
            apply_changes(self._settings, parameters)
            apply_changes(self._node_settings, parameters)
        except InputError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _apply(self, parameters: list[Parameter]) -> None:
        """Apply a checked change."""
        before, self._settings = self._settings, apply_changes(self._settings, parameters)
        self._node_settings = apply_changes(self._node_settings, parameters)
        if self.session is None:
            return
        self.session.worker.limit = max(self._node_settings.queue, self.session.component.min_queue)
        self.session.image_transport = self._node_settings.image_transport
        after = self._settings.values()
        different = {name for name, value in before.values().items() if value != after[name]}
        if not different:
            return
        component, settings = self.session.component, self._settings
        if different <= component.hot_settings:
            self.session.worker.call(lambda: component.reconfigure(settings))
        else:
            self._restart(", ".join(sorted(different)))

    def _restart(self, names: str) -> None:
        """Replace the running component by one with the changed settings."""
        active = self.state == "active"
        self.get_logger().info(f"{names} changed: loading the models and restarting")
        self._close()
        if self._attempt(self._open) == SUCCESS and active:
            self._attempt(self._activate)

    def _report(self) -> None:
        now = self._steady_clock.now()
        seconds, self._last_report = (now - self._last_report).nanoseconds * 1e-9, now
        status = NodeStatus(self.state, self.problem)
        if (session := self.session) is not None:
            publishers = {topic: self.count_publishers(topic) for topic in session.topics}
            counters, dropped = dict(session.component.counters), session.worker.dropped + session.component.dropped
            status = NodeStatus(self.state, self.problem, counters, dropped, publishers)
        report = self._diagnostics.report(self.get_clock().now().to_msg(), max(seconds, 1e-3), status)
        self._publisher.publish(report)

    def _on_reset_request(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        response.success = self.session is not None
        response.message = "the next message starts a new recording" if self.session else f"the node is {self.state}"
        self._reset()
        return response

    def _on_time_jump(self, jump: TimeJump) -> None:
        """Restart, unless the messages jumped back before the clock and the component has restarted already."""
        session = self.session
        if session is None or (session.stamped and not session.is_ahead_of(self.get_clock().now().nanoseconds)):
            return
        self.get_logger().warning("the time jumped back: restarting")
        self._reset()

    def _reset(self) -> None:
        if self.session is not None:
            self._diagnostics.resets += 1
            self.session.reset()

    def _answer_every_transition(self) -> None:
        """Answer transitions that the state does not allow with a failure; rclpy would raise and never answer."""
        service = self._service_change_state
        change = service.callback

        def answer(request: ChangeState.Request, response: ChangeState.Response) -> ChangeState.Response:
            try:
                return change(request, response)
            except RuntimeError as error:
                self.get_logger().warning(f"no such transition from {self.state}: {' '.join(str(error).split())}")
                response.success = False
                return response

        service.callback = answer


def make_node(name: str) -> ComponentNode[Any]:
    """Return the node that runs the component of this name."""
    return ComponentNode(name)
