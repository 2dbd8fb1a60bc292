"""The exceptions of drocap_ros and their exit statuses."""

from __future__ import annotations


class DrocapError(Exception):
    """Root of the errors that drocap_ros raises; a command ends with status 1."""

    exit_status = 1


class InputError(DrocapError):
    """An input, option, message or parameter cannot be used; a command ends with status 2.

    The text is one line: the expectation, the finding, the remedy.
    """

    exit_status = 2


class ParameterError(InputError):
    """A parameter is unknown, of the wrong type, or outside its range."""


class NodeError(DrocapError):
    """A node of the running graph failed."""


def first_line(error: BaseException) -> str:
    """The first line of an error's text, else its type."""
    return (str(error).strip().splitlines() or [type(error).__name__])[0]
