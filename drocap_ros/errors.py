"""The exceptions of drocap_ros and their exit statuses."""

from __future__ import annotations

from collections.abc import Iterable


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


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """A question that ends an error's text, ``; did you mean KNOWN?``, or nothing where no known word is alike."""
    from difflib import get_close_matches

    # Least likeness of words: one letter of four is wrong.  At difflib's own 0.6 `--wrong` is like `--config`.
    near = get_close_matches(word, list(known), 1, 0.75)
    return f"; did you mean {near[0]}?" if near else ""
