"""ROS parameters of the nodes: declared from a component's dataclass, and read from all nodes of a running graph."""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Callable, Mapping
from typing import TypeVar

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.exceptions import InvalidParameterTypeException, InvalidParameterValueException
from rclpy.node import Node
from rclpy.parameter import parameter_value_to_python
from rclpy.parameter_client import AsyncParameterClient
from rclpy.task import Future

from drocap_ros.config import section_types
from drocap_ros.errors import ParameterError
from drocap_ros.parameters import Parameters, Values
from drocap_ros.ros.rclpy_internals import overridden_parameters

P = TypeVar("P", bound=Parameters)

#: Parameters of :class:`~drocap_ros.ros.lifecycle.ManagedComponent`.
_DECLARED_LATER = ("autostart", "graph_running")


def declare_parameters(node: Node, defaults: P) -> P:
    """Declare every field of ``defaults`` on the node and return the values after ROS's overrides."""
    known = {*_DECLARED_LATER, *(spec.name for spec in dataclasses.fields(defaults))}
    for name in sorted(set(overridden_parameters(node)) - known):  # ROS ignores unknown ones
        if not node.has_parameter(name) and not name.startswith("qos_overrides."):
            type(defaults).from_mapping({name: None}, node.get_name())
    values = {}
    for spec in dataclasses.fields(defaults):
        default = getattr(defaults, spec.name)
        try:
            values[spec.name] = node.declare_parameter(spec.name, default, _descriptor(spec, default)).value
        except (InvalidParameterTypeException, InvalidParameterValueException) as error:
            raise ParameterError(f"{node.get_name()}.{spec.name}: {error}; correct the parameter file") from None
    return type(defaults).from_mapping(values, node.get_name())


def parameter_help(component: str) -> str:
    """One line for each parameter of a component: name, default, unit, description."""
    lines = []
    for spec in dataclasses.fields(section_types()[component]):
        unit = f" {spec.metadata['unit']}" if spec.metadata.get("unit") else ""
        lines.append(f"  {spec.name} ({spec.default!r}{unit}): {spec.metadata['description']}")
    return "\n".join(lines)


def _descriptor(spec: dataclasses.Field, default: object) -> ParameterDescriptor:
    meta = spec.metadata
    unit = f" [{meta['unit']}]" if meta.get("unit") else ""
    choices = f"one of {', '.join(meta['choices'])}" if meta.get("choices") else ""
    descriptor = ParameterDescriptor(
        description=meta["description"] + unit, additional_constraints=choices, read_only=True
    )
    bounds = meta.get("minimum"), meta.get("maximum")
    if bounds == (None, None) or isinstance(default, bool):
        return descriptor
    if isinstance(default, float):
        low, high = _filled(bounds, -sys.float_info.max, sys.float_info.max)
        descriptor.floating_point_range = [FloatingPointRange(from_value=float(low), to_value=float(high))]
    elif isinstance(default, int):
        low, high = _filled(bounds, -(2**63), 2**63 - 1)
        descriptor.integer_range = [IntegerRange(from_value=int(low), to_value=int(high))]
    return descriptor


def _filled(bounds: tuple[float | None, float | None], least: float, most: float) -> tuple[float, float]:
    """Bounds of which none is open; whole numbers stay whole."""
    low, high = bounds
    return least if low is None else low, most if high is None else high


class ParameterSurvey:
    """Requests the parameters of every component of the graph in the background.

    node : the node that asks
    beside : nodes of its process by name, which are read without a service
    done : called with all parameters so far, by node, whenever a node has answered
    """

    def __init__(self, node: Node, beside: Mapping[str, Node], done: Callable[[dict[str, Values]], None]) -> None:
        self._node = node
        self._beside = beside
        self._done = done
        self._types = section_types()
        self._clients: dict[str, AsyncParameterClient] = {}
        self._asked: set[str] = set()
        self._sections: dict[str, Values] = {}

    def ask_new_nodes(self) -> None:
        """Ask the nodes that appeared since the last call; returns at once."""
        for name, near in self._beside.items():
            if name in self._types and name not in self._asked:
                self._asked.add(name)
                self._take(name, {key: near.get_parameter(key).value for key in self._names(name)})
        for name, namespace in self._node.get_node_names_and_namespaces():
            if namespace == self._node.get_namespace() and name in self._types and name not in self._asked:
                self._ask(name, f"{namespace.rstrip('/')}/{name}")

    def _ask(self, name: str, full_name: str) -> None:
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

    def _take(self, name: str, values: Values) -> None:
        self._sections[name] = {key: value for key, value in values.items() if value is not None}
        self._done(dict(self._sections))
