"""The pose estimator's node with the networks for simulation."""

import cv2
import numpy as np
import pytest
import rclpy
from rclpy.context import Context

from drocap_ros.bringup import bringup, free_domain
from drocap_ros.config import DrocapConfig
from drocap_ros.nodes.pose_estimator import PoseEstimatorNode
from drocap_ros.perception.tracking.pose_estimator_config import PoseEstimatorConfig
from drocap_ros.ros.diagnostics import Key, node_of, of, values_of
from drocap_ros.ros.topics import TOPICS

MISSED = of(Key.MISSED, "image/compressed")


def test_networks_for_simulation_are_named_on_diagnostics():
    with free_domain() as domain_id:
        context = Context()
        rclpy.init(args=[], context=context, domain_id=domain_id)
        node = PoseEstimatorNode(
            PoseEstimatorConfig(models_dir="simulation"), context=context, use_global_arguments=False
        )
        try:
            assert "for simulation only" in node.details[Key.NETWORKS]
        finally:
            node.close()
            node.destroy_node()
            context.try_shutdown()


@pytest.mark.parametrize(("max_load_level", "sheds"), [(3, True), (0, False)])
def test_estimator_sheds_load_while_images_queue_unless_configured_otherwise(tmp_path, max_load_level, sheds):
    for i in range(8):
        cv2.imwrite(str(tmp_path / f"{i}.jpg"), np.full((90, 120, 3), 20 * i, np.uint8))
    config = DrocapConfig().replace("image_ingest", source=str(tmp_path), loop=True, folder_rate_hz=240.0)
    config = config.replace("pose_estimator", models_dir="simulation", max_load_level=max_load_level)
    values = {}

    def take(message):
        values.update({node_of(status)[1]: values_of(status) for status in message.status})

    def count(key):
        return int(values.get("pose_estimator", {}).get(key, 0))

    with bringup(config, ["image_ingest", "pose_estimator"], processes=True) as graph:
        graph.node.create_subscription(TOPICS["/diagnostics"].message, "/diagnostics", take, TOPICS["/diagnostics"].qos)
        graph.wait_until(lambda: count(MISSED) > 0 and count(Key.IMAGES) > 20, 30, "more images than it can process")
        graph.spin_for(2.0)
        assert (count(Key.IMAGES_SHED) > 0) is sheds
