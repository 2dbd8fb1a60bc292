import pytest
from recorded import START_NS, Messages, write_poses

from drocap_ros.simulation.capture import simulate_capture


@pytest.fixture(scope="session")
def messages():
    return Messages()


@pytest.fixture(scope="session")
def capture():
    return simulate_capture(4, 30, seed=2, start_ns=START_NS)


@pytest.fixture
def pose_session(tmp_path, messages, capture):
    write_poses(tmp_path / "session", messages, capture.tracks)
    return tmp_path / "session"
