import subprocess

import numpy as np
import pytest
from recorded import START_NS, Messages, write_poses

from lab.simulation.capture import simulate_capture


@pytest.fixture(scope="session")
def messages():
    return Messages()


@pytest.fixture(scope="session")
def capture():
    return simulate_capture(4, 30, seed=2, start_ns=START_NS)


@pytest.fixture
def invented_flight():
    """Angles (N, 3) rad roll pitch yaw, geodetic (N, 3), mount angles (N, 3), times (N,) s of an invented flight."""
    t = np.arange(0, 8, 0.05)
    angles = np.stack([0.1 * np.sin(t), 0.05 * np.cos(t), 0.4 * t - 1], axis=1)
    geodetic = np.stack([47.0 + 1e-5 * np.sin(t), 8.0 + 1e-5 * np.cos(t), 500 + 0.5 * t], axis=1)
    mount = np.stack([0 * t, -0.5 + 0.1 * np.sin(t), 0.4 * t - 0.9], axis=1)
    return t, angles, geodetic, mount


@pytest.fixture
def pose_session(tmp_path, messages, capture):
    write_poses(tmp_path / "session", messages, capture.tracks)
    return tmp_path / "session"


@pytest.fixture
def small_disk(tmp_path):
    """A disk of 8 MB, where this machine permits one."""
    place = tmp_path / "disk"
    place.mkdir()
    made = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=8m", "none", str(place)], capture_output=True)
    if made.returncode != 0:
        pytest.skip("no permission to mount a tmpfs here")
    yield place
    subprocess.run(["umount", "-l", str(place)], check=True)
