"""Parameters of all nodes of a running graph."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

from rclpy.node import Node
from rclpy.parameter import parameter_value_to_python
from rclpy.parameter_client import AsyncParameterClient
from rclpy.task import Future

from drocap_ros.config import section_types


class ParameterSurvey:
    """Requests the parameters of every component of the graph in the background.

    done : called with all parameters so far, by node, whenever a node has answered
    """

    def __init__(self, node: Node, done: Callable[[dict[str, dict[str, Any]]], None]) -> None:
        self._node = node
        self._done = done
        self._types = section_types()
        self._clients: dict[str, AsyncParameterClient] = {}
        self._asked: set[str] = set()
        self._sections: dict[str, dict[str, Any]] = {}

    def ask_new_nodes(self) -> None:
        """Ask the nodes that appeared since the last call; returns at once."""
        for name, namespace in self._node.get_node_names_and_namespaces():
            if namespace == self._node.get_namespace() and name in self._types and name not in self._asked:
                self._ask(name, f"{namespace.rstrip('/')}/{name}")

    def _ask(self, name: str, full_name: str) -> None:
        if name == self._node.get_name():
            self._asked.add(name)
            self._take(name, {p: self._node.get_parameter(p).value for p in self._names(name)})
            return
        client = self._clients.setdefault(name, AsyncParameterClient(self._node, full_name))
        if not client.services_are_ready():
            return
        self._asked.add(name)
        names = self._names(name)

        def answered(future: Future) -> None:
            response = future.result()
            if response is not None and len(response.values) == len(names):
                values = map(parameter_value_to_python, response.values)
                self._take(name, dict(zip(names, values, strict=True)))

        client.get_parameters(names, callback=answered)

    def _names(self, name: str) -> list[str]:
        return [spec.name for spec in dataclasses.fields(self._types[name])]

    def _take(self, name: str, values: dict[str, Any]) -> None:
        self._sections[name] = {key: value for key, value in values.items() if value is not None}
        self._done(dict(self._sections))
