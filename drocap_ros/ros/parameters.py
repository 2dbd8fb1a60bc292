"""ROS parameters declared from a component's dataclass: same names, defaults, ranges and descriptions."""

from __future__ import annotations

import dataclasses
import sys
from typing import TypeVar

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.exceptions import InvalidParameterTypeException, InvalidParameterValueException
from rclpy.node import Node

from drocap_ros.errors import ParameterError
from drocap_ros.parameters import Parameters

P = TypeVar("P", bound=Parameters)


def declare_parameters(node: Node, defaults: P) -> P:
    """Declare every field of ``defaults`` on the node and return the values after ROS's overrides.

    Raises
    ------
    ParameterError
        When an override has the wrong type or lies outside its range.
    """
    values = {}
    for spec in dataclasses.fields(defaults):
        default = getattr(defaults, spec.name)
        try:
            values[spec.name] = node.declare_parameter(spec.name, default, _descriptor(spec, default)).value
        except (InvalidParameterTypeException, InvalidParameterValueException) as error:
            raise ParameterError(f"{node.get_name()}.{spec.name}: {error}; correct the parameter file") from None
    return type(defaults).from_mapping(values, node.get_name())


def _descriptor(spec: dataclasses.Field, default: object) -> ParameterDescriptor:
    meta = spec.metadata
    unit = f" [{meta['unit']}]" if meta.get("unit") else ""
    choices = f"one of {', '.join(meta['choices'])}" if meta.get("choices") else ""
    descriptor = ParameterDescriptor(
        description=meta["description"] + unit, additional_constraints=choices, read_only=True
    )
    low, high = meta.get("minimum"), meta.get("maximum")
    if low is None and high is None:
        return descriptor
    if isinstance(default, float):
        big = sys.float_info.max
        bounds = FloatingPointRange(
            from_value=float(-big if low is None else low), to_value=float(big if high is None else high)
        )
        descriptor.floating_point_range = [bounds]
    elif isinstance(default, int) and not isinstance(default, bool):
        whole = IntegerRange(
            from_value=int(-(2**63) if low is None else low), to_value=int(2**63 - 1 if high is None else high)
        )
        descriptor.integer_range = [whole]
    return descriptor
