import pytest

pytest.importorskip("rclpy", reason="no ROS here: `make setup` brings it")
pytest.importorskip("drocap_ros.msg", reason="the messages are not built: `make setup` builds them")


@pytest.fixture
def context():
    """A context of ROS in a domain of its own."""
    import rclpy
    from rclpy.context import Context

    from drocap_ros.bringup import free_domain

    with free_domain() as domain_id:
        context = Context()
        rclpy.init(args=[], context=context, domain_id=domain_id)
        yield context
        context.try_shutdown()
