"""Codes of conditions: the same in Python and in the messages, each with a sentence."""

import enum
import re
import string

import pytest

from drocap_ros.flight.conditions import Condition, ConditionCode, condition
from drocap_ros.flight.orbit.states import Command, CommandAnswer, State


def constants(definition, prefix=""):
    """Constants of a message definition whose names start with the prefix, by their names without it."""
    found = re.findall(r"^\w+ ([A-Z0-9_]+) *= *(\d+)", definition.read_text(), re.MULTILINE)
    return {name.removeprefix(prefix): int(value) for name, value in found if name.startswith(prefix)}


def members(enumeration: type[enum.IntEnum]):
    return {member.name: member.value for member in enumeration}


def test_constants_of_the_messages_equal_the_enums(root):
    status, request = root / "msg" / "OrbitStatus.msg", root / "srv" / "OrbitCommand.srv"
    assert constants(status, "CONDITION_") == members(ConditionCode)
    others = {name: value for name, value in constants(status).items() if not name.startswith("CONDITION_")}
    assert others == {**members(State), "NO_COMMAND": 255}
    assert constants(request) == members(Command)


def test_every_code_has_a_different_sentence():
    assert len({code.sentence for code in ConditionCode}) == len(ConditionCode)


@pytest.mark.parametrize("code", ConditionCode)
def test_a_sentence_contains_the_measured_values(code):
    fields = [(name, form) for _, name, form, _ in string.Formatter().parse(code.sentence) if name]
    values = {name: 4.25 if form else "word" for name, form in fields if name != "ago"}
    text = str(Condition(code, {**values, "age_s": 4.25}))
    assert "{" not in text
    assert all(("4.2" in text or "4 " in text) if form else "word" in text for name, form in fields if name != "ago")


def test_a_condition_names_its_cause():
    cause = condition(ConditionCode.NO_SUBJECT)
    fault = condition(ConditionCode.HOLD_MODE_MISSING, cause=cause)
    assert str(fault).startswith(f"{cause}; ")
    assert str(CommandAnswer(False, fault)) == f"refused: {fault}"


def test_an_age_before_the_first_message_reads_never():
    assert str(condition(ConditionCode.LINK_SILENT, age_s=float("inf"))).endswith("last message: never")
    assert str(condition(ConditionCode.LINK_SILENT, age_s=0.31)).endswith("last message: 0.3 s ago")
