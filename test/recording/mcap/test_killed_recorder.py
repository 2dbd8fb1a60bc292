"""A recorder that is killed, in real time."""

import numpy as np
import pytest
from killed_recording import check_recovered, killed_session


@pytest.mark.parametrize("delay_s", np.random.default_rng(7).uniform(0.05, 2.5, 4).round(3))
def test_process_killed_at_a_random_moment_loses_at_most_the_last_chunk(tmp_path, delay_s):
    folder = tmp_path / "s"
    begun_ns, killed_ns = killed_session(folder, float(delay_s))
    check_recovered(folder, begun_ns, killed_ns)
