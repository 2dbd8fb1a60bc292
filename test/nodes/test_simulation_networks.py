"""The pose estimator says on /diagnostics when its networks know rendered persons only."""

import rclpy
from rclpy.context import Context

from drocap_ros.bringup import free_domain
from drocap_ros.nodes.pose_estimator import PoseEstimatorNode
from drocap_ros.perception.pose_estimator_config import PoseEstimatorConfig


def test_networks_for_simulation_are_named_on_diagnostics():
    with free_domain() as domain_id:
        context = Context()
        rclpy.init(args=[], context=context, domain_id=domain_id)
        node = PoseEstimatorNode(
            PoseEstimatorConfig(models_dir="simulation"), context=context, use_global_arguments=False
        )
        try:
            assert "for simulation only" in node.details["networks"]
        finally:
            node.close()
            node.destroy_node()
            context.try_shutdown()
