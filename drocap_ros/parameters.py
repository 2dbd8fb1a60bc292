"""Typed component parameters, one frozen dataclass per component.

The metadata of :func:`param` is the only source of the YAML loader, the ROS parameter declarations and the table in
``docs/parameters.md``.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeAlias, TypeVar, get_type_hints

from drocap_ros.errors import InputError, ParameterError, did_you_mean

P = TypeVar("P", bound="Parameters")
T = TypeVar("T", bool, int, float, str)
#: Values by name, as YAML and JSON hold them.
Values: TypeAlias = dict[str, Any]


def param(
    default: T,
    description: str,
    unit: str = "",
    minimum: float | None = None,
    maximum: float | None = None,
    *,
    choices: tuple[str, ...] | None = None,
) -> T:
    """Dataclass field of a :class:`Parameters` class; the range is inclusive at both ends."""
    metadata = {
        "description": description,
        "unit": unit,
        "minimum": minimum,
        "maximum": maximum,
        "choices": choices,
    }
    value: T = field(default=default, metadata=metadata)
    return value


@dataclass(frozen=True)
class Parameters:
    """Base of all component parameters: bool, int, float or str fields made with :func:`param`."""

    def __post_init__(self) -> None:
        types = _types(type(self))  # type: ignore[arg-type]  # a class is hashable
        for spec in dataclasses.fields(self):
            value = _checked(spec, types[spec.name], getattr(self, spec.name), type(self).__name__)
            object.__setattr__(self, spec.name, value)

    @classmethod
    def from_mapping(cls: type[P], values: Mapping[str, object], where: str = "") -> P:
        """Build from a mapping; an unknown name is refused."""
        known = {spec.name for spec in dataclasses.fields(cls)}
        unknown = sorted(set(values) - known)
        if unknown:
            raise ParameterError(
                f"{where or cls.__name__}: unknown parameter {unknown[0]!r}; expected one of {', '.join(sorted(known))}"
                + did_you_mean(unknown[0], known)
            )
        return cls(**values)


@functools.cache
def _types(kind: type) -> dict[str, type]:
    return get_type_hints(kind)  # a millisecond of compilation


def _checked(spec: dataclasses.Field, kind: type, value: object, owner: str) -> object:
    name = f"{owner}.{spec.name}"
    if kind is float and isinstance(value, int) and not isinstance(value, bool):
        value = float(value)
    if type(value) is not kind:
        raise ParameterError(f"{name}: expected {kind.__name__}, got {value!r}; correct the value")
    if isinstance(value, int | float):
        _check_range(name, value, spec)
    choices = spec.metadata["choices"]
    if choices and value not in choices:
        raise ParameterError(f"{name}: expected one of {', '.join(choices)}, got {value!r}")
    return value


def _check_range(name: str, value: float, spec: dataclasses.Field) -> None:
    if not math.isfinite(value):
        raise ParameterError(f"{name}: expected a finite number, got {value!r}; correct the value")
    low, high = spec.metadata["minimum"], spec.metadata["maximum"]
    if (low is not None and value < low) or (high is not None and value > high):
        wanted = " ".join(filter(None, (_range_text(low, high), spec.metadata["unit"])))
        raise ParameterError(f"{name}: expected {wanted}, got {value!r}; choose a value in the range")


def _range_text(low: float | None, high: float | None) -> str:
    if low is None:
        return f"at most {high:g}"
    if high is None:
        return f"at least {low:g}"
    return f"{low:g} to {high:g}"


def read_yaml(path: Path, what: str) -> Any:
    """Content of a YAML file; the error names the file, and where it is none."""
    import yaml

    try:
        return yaml.safe_load(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"{path}: expected {what}; {error.strerror or error}") from None
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        place = getattr(error, "problem_mark", None)
        where = f" at line {place.line + 1}" if place else ""
        raise InputError(f"{path}: expected YAML, found something else{where}; correct the file") from None
