import pytest

pytest.importorskip("rclpy", reason="no ROS here: `make setup` brings it")
pytest.importorskip("drocap_ros.msg", reason="the messages are not built: `make setup` builds them")
