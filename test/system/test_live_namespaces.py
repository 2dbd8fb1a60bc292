"""Two drones on one machine, in one DDS domain."""

from contextlib import ExitStack

import numpy as np
from captured_flight import captured_config

from drocap_ros.bringup import bringup, free_domain
from drocap_ros.recording.open_session import open_session

NODES = ["session_player", "initializer", "bundle_adjuster", "visualizer", "session_recorder"]
DRONES = ("drone1", "drone10")  # one name begins with the other


def test_graphs_in_two_namespaces_receive_their_own_messages_only(tmp_path, monkeypatch):
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    with free_domain() as domain, ExitStack() as stack:
        graphs = []
        for seed, drone in enumerate(DRONES):
            config = captured_config(tmp_path, 5.0, rate_hz=4.0, seed=seed)  # two graphs: a busy machine keeps up
            config = config.replace("session_recorder", session_dir=str(tmp_path / drone))
            place = {"namespace": f"/{drone}", "domain_id": domain}
            graphs.append(stack.enter_context(bringup(config, NODES, processes=True, **place)))
        for graph in graphs:
            graph.wait_finished("session_player", timeout_s=60)
            graph.spin_for(1.5)  # one more status of each node
    keypoints = []
    for drone in DRONES:
        with open_session(tmp_path / drone) as session:
            topics = {t.name: t.count for t in session.info.topics if t.count}
            keypoints.append([np.array(m.keypoints) for _, m in session.messages((f"/{drone}/pose2d",))])
            names = {s.name for _, m in session.messages(("/diagnostics",)) for s in m.status}
        assert all(name.startswith(f"/{drone}/") for name in topics if name != "/diagnostics"), topics
        assert topics[f"/{drone}/pose3d/initial"] == topics[f"/{drone}/pose2d"] == 20
        assert topics[f"/{drone}/tf"] > 5  # the drawing comes last and passes over poses where a machine is busy
        assert names >= {f"{drone}/{node}" for node in NODES}
        assert all(name.startswith(f"{drone}/") for name in names)
    assert not np.array_equal(keypoints[0], keypoints[1], equal_nan=True)
