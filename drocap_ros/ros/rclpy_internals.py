"""Everything that goes beyond rclpy's public API, and why: the one module to look at for another ROS distribution.

| what | why the public API does not do |
|---|---|
| ``rclpy.experimental.EventsExecutor`` | a message costs a node 0.17 ms instead of the 0.72 ms of the public executor,\
 which :func:`node_executor` takes where the experimental one is missing |
| ``rclpy_implementation.Service`` | a service of a node answers one request after the other, in the executor's thread |
| ``LifecycleNodeMixin._service_change_state`` | a transition that the state does not allow ends the node |
| ``Node._parameter_overrides`` | overrides of parameters that nobody declares are not listed |
"""

from __future__ import annotations

import inspect
import logging
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from typing import TypeAlias

from lifecycle_msgs.srv import ChangeState
from rclpy.context import Context
from rclpy.executors import Executor, SingleThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation as _rclpy
from rclpy.lifecycle import LifecycleNodeMixin
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.task import Future
from rclpy.type_support import check_for_type_support

from drocap_ros.recording.session import Message
from drocap_ros.srv import OrbitCommand

try:
    from rclpy.experimental import EventsExecutor
except ImportError:  # a distribution without it
    EventsExecutor = SingleThreadedExecutor

logger = logging.getLogger(__name__)

#: rclpy's information about a message: numbers by name.
MessageInfo: TypeAlias = Mapping[str, int]
#: Whom a service answers: a caller of this process by its future, another one by rclpy's identifier.
AnswerKey: TypeAlias = Future | _rclpy.rmw_request_id_t


def node_executor(context: Context | None = None) -> Executor:
    """Executor of one node; handlers of signals stay as they are, but for those of the default context."""
    executor: Executor = EventsExecutor(context=context)
    return executor


def taking_info(callback: Callable[..., None]) -> Callable[..., None]:
    """Callback of message and info for either executor: rclpy 7.1's EventsExecutor passes both as one tuple."""

    def take(message: Message, info: MessageInfo | None = None) -> None:
        callback(*(message if info is None else (message, info)))

    # rclpy chooses the kind of callback by the number of its parameters.
    kind = inspect.Parameter.POSITIONAL_ONLY
    parameters = [inspect.Parameter(name, kind) for name in ("message", "info")]
    take.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    return take


def overridden_parameters(node: Node) -> Iterable[str]:
    """Names of the parameters that a parameter file or the command line gives to a node."""
    names: Iterable[str] = node._parameter_overrides.keys()
    return names


def answer_impossible_transitions(node: LifecycleNodeMixin, report: Callable[[str], None]) -> None:
    """Answer a request for a transition that the state does not allow, with False, and report it in words."""
    service = node._service_change_state
    change = service.callback

    def guarded(request: ChangeState.Request, response: ChangeState.Response) -> ChangeState.Response:
        try:
            return change(request, response)
        except Exception as error:  # noqa: BLE001 -- rclpy has no type of its own for it
            report(f"transition {request.transition.label or request.transition.id}: {error}")
            response.success = False
            return response

    service.callback = guarded


def end_state_machine(node: LifecycleNodeMixin) -> None:
    """Let the state machine of a destroyed node go: its publisher would keep the DDS participant."""
    node._state_machine = None


class PolledService:
    """Server of one service; requests wait until the thread that decides takes them all, and answers them later."""

    def __init__(self, node: Node, service_type: type[OrbitCommand], name: str, qos: QoSProfile) -> None:
        check_for_type_support(service_type)
        self._calls: deque[tuple[Message, AnswerKey]] = deque()
        self._request_type = service_type.Request
        with node.handle:
            self._handle = _rclpy.Service(node.handle, service_type, name, qos.get_c_qos_profile())

    def call(self, request: Message) -> Future:
        """The answer to a request of this process, which does not pass the middleware."""
        future = Future()
        self._calls.append((request, future))
        return future

    def take(self) -> tuple[Message, AnswerKey] | None:
        """The next request with the key for its answer; None when no request waits."""
        if self._calls:
            return self._calls.popleft()
        try:
            with self._handle:
                request, header = self._handle.service_take_request(self._request_type)
        except _rclpy.RCLError as error:  # bytes that are no request
            logger.warning("dropped a request: %s", error)
            return None
        return None if header is None else (request, header.request_id)

    def answer(self, key: AnswerKey, response: Message) -> None:
        """Send the response to a request; a client that has gone is no error."""
        if isinstance(key, Future):
            key.set_result(response)
            return
        try:
            with self._handle:
                self._handle.service_send_response(response, key)
        except _rclpy.RCLError as error:
            logger.warning("a response was not sent: %s", error)

    def close(self) -> None:
        """Withdraw the service."""
        self._handle.destroy_when_not_in_use()
