"""Fixtures of the reconstruction tests."""

from __future__ import annotations

import pytest
from walking import Walk, make_walk

from drocap_ros.reconstruction.paper.dictionary import Dictionary, load_dictionary


@pytest.fixture(scope="session")
def walk() -> Walk:
    return make_walk(120)


@pytest.fixture(scope="session")
def dictionary() -> Dictionary:
    return load_dictionary()
