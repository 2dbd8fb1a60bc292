import pytest

pytest.importorskip("rclpy", reason="no ROS here: `make setup` brings it")
pytest.importorskip("drocap_ros.msg", reason="the messages are not built: `make setup` builds them")

from captured_flight import FLIGHT, flight_config

from drocap_ros.bringup import bringup


@pytest.fixture(scope="module")
def captured(tmp_path_factory):
    """Session of a simulated capture of four seconds; of the module, so that a repeated test flies it again."""
    folder = tmp_path_factory.mktemp("flight") / "session"
    with bringup(flight_config(folder, folder.parent), FLIGHT, processes=True) as graph:
        graph.wait_finished("session_player", timeout_s=60)
    return folder
