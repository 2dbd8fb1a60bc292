import subprocess

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


@pytest.fixture
def small_disk(tmp_path):
    """A disk of 8 MB, where this machine lets us make one."""
    place = tmp_path / "disk"
    place.mkdir()
    made = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=8m", "none", str(place)], capture_output=True)
    if made.returncode != 0:
        pytest.skip("no permission to mount a tmpfs here")
    yield place
    subprocess.run(["umount", "-l", str(place)], check=True)
