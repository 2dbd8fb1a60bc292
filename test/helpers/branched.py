"""Tests that share the beginning of a simulated flight."""

from __future__ import annotations

import functools
import traceback
from collections.abc import Callable
from typing import Any

import pytest

from lab.flights.branches import branch


def branched(test: Callable[..., None]) -> Callable[..., None]:
    """The test in a copy of this process, where it may change a flight with which other tests begin too."""

    @functools.wraps(test)
    def run(*args: Any, **kwargs: Any) -> None:
        failure = branch(functools.partial(_failure, test, args, kwargs))
        if failure:
            pytest.fail(failure, pytrace=False)

    return run


def _failure(test: Callable[..., None], args: tuple[Any, ...], kwargs: dict[str, Any]) -> str:
    try:
        test(*args, **kwargs)
    except BaseException:  # noqa: BLE001 - the parent fails with it
        return traceback.format_exc()
    return ""
