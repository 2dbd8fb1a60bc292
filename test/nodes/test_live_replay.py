"""The live graph and its offline replay."""

import os
import subprocess
import sys

import numpy as np
import pytest

from drocap_ros.config import DrocapConfig
from drocap_ros.errors import InputError
from drocap_ros.live_replay import reconstruct_live, recorded_config
from drocap_ros.pipeline import reconstruct_input
from drocap_ros.reconstruction.common.config import BundleAdjusterConfig
from drocap_ros.recording.open_session import open_session


def test_the_offline_replay_equals_the_live_graph_bit_for_bit(captured):
    with open_session(captured) as session:
        config = recorded_config(session)
        assert config.bundle_adjuster == BundleAdjusterConfig(limb_iterations=3, period_s=0.5)
        motion, tracks, agreement = reconstruct_live(session, config)
        assert session.warnings == []
    assert agreement.initial == [60, 60]
    assert agreement.windows[0] >= 5
    assert agreement.windows[0] == agreement.windows[1]
    assert len(tracks) == len(motion.joints3d) == 60
    # The comparison notices other parameters.
    with open_session(captured) as session:
        other = config.replace("bundle_adjuster", limb_iterations=2)
        _, _, agreement = reconstruct_live(session, other)
    assert agreement.initial == [60, 60]
    assert agreement.windows[1] < agreement.windows[0]


THREADS = """
import sys, numpy as np
from drocap_ros.config import DrocapConfig
from drocap_ros.pipeline import reconstruct_input
for method in ("live", "ba"):
    motion, _ = reconstruct_input(sys.argv[1], method=method, config=DrocapConfig())
    np.save(f"{sys.argv[2]}_{method}.npy", motion.joints3d)
"""


def test_one_thread_and_two_give_the_same_arrays(captured, tmp_path):
    running = []
    for threads in ("1", "2"):
        env = {**os.environ, "OMP_NUM_THREADS": threads, "OPENBLAS_NUM_THREADS": threads}
        command = [sys.executable, "-c", THREADS, str(captured), str(tmp_path / threads)]
        running.append(subprocess.Popen(command, env=env))
    assert [process.wait() for process in running] == [0, 0]
    for method in ("live", "ba"):
        one, two = (np.load(tmp_path / f"{threads}_{method}.npy") for threads in ("1", "2"))
        assert np.isfinite(one).all()
        assert np.array_equal(one, two)


def test_the_command_takes_the_recorded_parameters(captured):
    motion, _ = reconstruct_input(captured, method="live", config=DrocapConfig())
    assert motion.meta["parameters"]["adjuster"]["limb_iterations"] == 3
    assert "60 of 60 initial poses" in motion.meta["live_agreement"]
    with pytest.raises(InputError, match="expected a recording with pose2d"):
        reconstruct_input(captured.parent / "none.mp4", method="live", config=DrocapConfig())
