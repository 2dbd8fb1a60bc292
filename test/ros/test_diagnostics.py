"""Keys of ``/diagnostics`` and their words."""

import re

import pytest

from drocap_ros.ros import diagnostics
from drocap_ros.ros.diagnostics import Key

KEYS = {name: value for name, value in vars(Key).items() if name.isupper()}


def test_every_key_is_an_identifier_and_none_is_used_twice():
    assert len(set(KEYS.values())) == len(KEYS)
    assert all(re.fullmatch(r"[a-z][a-z0-9_]*", value) for value in KEYS.values())


def test_every_text_belongs_to_a_key():
    assert set(diagnostics._WORDS) <= set(KEYS.values())


@pytest.mark.parametrize(
    ("key", "text"),
    [
        (Key.MESSAGES_REFUSED, "messages refused"),
        (Key.EXPOSURES, "exposures"),
        (diagnostics.of(Key.STREAM_EVENT, "time_jump"), "stream event, time jump"),
        (diagnostics.of(Key.MISSED, "/drocap/image/compressed"), "passed over, drocap/image/compressed"),
        ("key_of_another_version", "key of another version"),
    ],
)
def test_words_are_made_from_the_key(key, text):
    assert diagnostics.words(key) == text
