"""Fast DDS profiles of a graph's processes."""

import xml.etree.ElementTree as ET

import pytest
import rclpy

from drocap_ros.ros.processes import PROFILE_VARIABLE, RANGE_VARIABLE, middleware

pytestmark = pytest.mark.skipif(
    not rclpy.get_rmw_implementation_identifier().startswith("rmw_fastrtps"), reason="another middleware"
)
NAME = "{http://www.eprosima.com}"


@pytest.fixture(autouse=True)
def _no_profile_of_the_user(monkeypatch):
    monkeypatch.delenv(PROFILE_VARIABLE, raising=False)
    monkeypatch.delenv(RANGE_VARIABLE, raising=False)


def transports(environment):
    """Transport types that the profile defines and uses, with the addresses that they are restricted to."""
    root = ET.parse(environment[PROFILE_VARIABLE]).getroot()
    kinds = {d.findtext(f"{NAME}transport_id"): d for d in root.iter(f"{NAME}transport_descriptor")}
    used = [t.text for t in root.find(f".//{NAME}userTransports")]
    assert sorted(used) == sorted(kinds)
    return {d.findtext(f"{NAME}type"): [a.text for a in d.iter(f"{NAME}address")] for d in kinds.values()}


def test_processes_use_udp_on_every_interface():
    environment = middleware()
    assert transports(environment) == {"UDPv4": []}
    assert RANGE_VARIABLE not in environment


def test_localhost_range_stays_on_this_machine_without_shared_memory(monkeypatch):
    monkeypatch.setenv(RANGE_VARIABLE, "LOCALHOST")
    environment = middleware()
    assert transports(environment) == {"UDPv4": ["127.0.0.1"]}
    assert environment[RANGE_VARIABLE] == "SYSTEM_DEFAULT"


def test_the_two_profiles_differ_in_the_addresses_only(monkeypatch):
    texts = []
    for value in ("SUBNET", "LOCALHOST"):
        monkeypatch.setenv(RANGE_VARIABLE, value)
        root = ET.parse(middleware()[PROFILE_VARIABLE]).getroot()
        for descriptor in root.iter(f"{NAME}transport_descriptor"):
            for addresses in descriptor.findall(f"{NAME}interfaceWhiteList"):
                descriptor.remove(addresses)
        texts.append(" ".join(ET.tostring(root, encoding="unicode").split()))
    assert texts[0] == texts[1]


def test_profile_of_the_user_is_left_alone(monkeypatch):
    monkeypatch.setenv(PROFILE_VARIABLE, "/home/me/fastdds.xml")
    monkeypatch.setenv(RANGE_VARIABLE, "LOCALHOST")
    assert middleware() == {}
