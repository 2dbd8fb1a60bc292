"""How the middleware is set for the processes of a graph."""

import xml.etree.ElementTree as ET

import pytest
import rclpy

from drocap_ros.ros import fastdds as middleware

VARIABLE, RANGE = middleware.PROFILE_VARIABLE, "ROS_AUTOMATIC_DISCOVERY_RANGE"
FAST_DDS = {"dds": "{http://www.eprosima.com}"}
pytestmark = pytest.mark.skipif(
    not rclpy.get_rmw_implementation_identifier().startswith("rmw_fastrtps"), reason="another middleware"
)


@pytest.fixture(autouse=True)
def _nobodys_own_settings(monkeypatch):
    monkeypatch.delenv(VARIABLE, raising=False)
    monkeypatch.delenv(RANGE, raising=False)


def transports(environment):
    """Transport types that the profile defines and uses."""
    name = "{http://www.eprosima.com}"
    root = ET.parse(environment[VARIABLE]).getroot()
    kinds = {d.findtext(f"{name}transport_id"): d for d in root.iter(f"{name}transport_descriptor")}
    used = [t.text for t in root.find(f".//{name}userTransports")]
    assert sorted(used) == sorted(kinds)
    return {d.findtext(f"{name}type"): [a.text for a in d.iter(f"{name}address")] for d in kinds.values()}


def test_processes_talk_over_udp_and_on_every_interface_that_ros_may_use(tmp_path):
    environment = middleware.settings(tmp_path)
    assert transports(environment) == {"UDPv4": []}
    assert RANGE not in environment


def test_who_is_to_stay_on_this_machine_stays_without_shared_memory(tmp_path, monkeypatch):
    monkeypatch.setenv(RANGE, "LOCALHOST")
    environment = middleware.settings(tmp_path)
    assert transports(environment) == {"UDPv4": ["127.0.0.1"]}
    assert environment[RANGE] == "SYSTEM_DEFAULT"


def test_who_hears_a_camera_driver_has_shared_memory_too(tmp_path):
    assert transports(middleware.settings(tmp_path, shared_memory=True)) == {"UDPv4": [], "SHM": []}


def test_somebodys_own_profile_is_left_alone(tmp_path, monkeypatch):
    monkeypatch.setenv(VARIABLE, "/home/me/fastdds.xml")
    monkeypatch.setenv(RANGE, "LOCALHOST")
    assert middleware.settings(tmp_path, shared_memory=True) == {}
