"""A service whose requests a thread of the node takes, instead of the executor."""

from __future__ import annotations

import logging
from collections import deque
from typing import Any

from rclpy.impl.implementation_singleton import rclpy_implementation as _rclpy
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.type_support import check_for_type_support

logger = logging.getLogger(__name__)


class PolledService:
    """Server of one service; requests wait until :meth:`take`.

    The thread that decides takes all waiting requests together and answers them later.  rclpy 7.1's EventsExecutor
    calls one request after the other and supports no coroutines.

    answered : number of answers so far
    """

    def __init__(self, node: Node, service_type: Any, name: str, qos: QoSProfile) -> None:
        check_for_type_support(service_type)
        self.answered = 0
        self._waiting: deque[tuple[Any, Any]] = deque()
        self._received = 0
        self._request_type = service_type.Request
        with node.handle:
            self._handle = _rclpy.Service(node.handle, service_type, name, qos.get_c_qos_profile())

    def fetch(self) -> int:
        """Take the requests that have arrived from the middleware; returns how many there have been so far."""
        while (found := self._next()) is not None:
            self._waiting.append(found)
        return self._received

    def take(self) -> tuple[Any, Any] | None:
        """The next request with the header for its answer; None when no request waits."""
        return self._waiting.popleft() if self._waiting else self._next()

    def _next(self) -> tuple[Any, Any] | None:
        try:
            with self._handle:
                request, header = self._handle.service_take_request(self._request_type)
        except _rclpy.RCLError as error:  # bytes that are no request
            logger.warning("dropped a request: %s", error)
            return None
        if header is None:
            return None
        self._received += 1
        return request, header

    def answer(self, header: Any, response: Any) -> None:
        """Send the response to a request; a client that has gone is no error."""
        self.answered += 1
        try:
            with self._handle:
                self._handle.service_send_response(response, header.request_id)
        except _rclpy.RCLError as error:
            logger.warning("a response was not sent: %s", error)

    def close(self) -> None:
        """Withdraw the service."""
        self._handle.destroy_when_not_in_use()
