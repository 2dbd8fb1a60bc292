"""The table of methods and the choices of the commands."""

from __future__ import annotations

from drocap_ros.cli import evaluate, reconstruct
from drocap_ros.reconstruction.methods import METHODS


def test_commands_offer_every_method() -> None:
    assert set(reconstruct.METHODS) == {*METHODS, "live"}
    assert set(evaluate.METHODS) == set(METHODS)
