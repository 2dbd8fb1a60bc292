"""A service whose requests a thread of the node takes, instead of the executor."""

from __future__ import annotations

import logging
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
    """

    def __init__(self, node: Node, service_type: Any, name: str, qos: QoSProfile) -> None:
        check_for_type_support(service_type)
        self._request_type = service_type.Request
        with node.handle:
            self._handle = _rclpy.Service(node.handle, service_type, name, qos.get_c_qos_profile())

    def take(self) -> tuple[Any, Any] | None:
        """The next request with the header for its answer; None when no request waits."""
        try:
            with self._handle:
                request, header = self._handle.service_take_request(self._request_type)
        except _rclpy.RCLError as error:  # bytes that are no request
            logger.warning("dropped a request: %s", error)
            return None
        return None if header is None else (request, header)

    def answer(self, header: Any, response: Any) -> None:
        """Send the response to a request; a client that has gone is no error."""
        try:
            with self._handle:
                self._handle.service_send_response(response, header.request_id)
        except _rclpy.RCLError as error:
            logger.warning("a response was not sent: %s", error)

    def close(self) -> None:
        """Withdraw the service."""
        self._handle.destroy_when_not_in_use()
