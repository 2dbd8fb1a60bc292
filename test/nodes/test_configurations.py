"""The files under ``config/``: configurations, the RViz file and the Foxglove layout fit the graph."""

import json
import re

import pytest
import yaml

from drocap_ros.config import load_config, section_types
from drocap_ros.ros.diagnostics import Key
from drocap_ros.ros.topics import NODES, TOPICS

COMPANIONS = ("px4_companion", "ardupilot_companion")
ALL = (*COMPANIONS, "ground_station")
#: Parameters that a file for real hardware must set, whatever the defaults are.
EXPECTED = {
    "image_ingest": {"source", "horizontal_fov_deg", "stall_timeout_s"},
    "pose_estimator": {"models_dir", "threads", "subject", "on_loss"},
    "initializer": {"assumed_height_m"},
    "bundle_adjuster": {"window_s", "period_s"},
    "mavlink_bridge": {
        "url", "system_id", "component_id", "attitude_hz", "commands_enabled", "mode_change_allowed", "radius_m",
        "height_m", "angular_speed_deg_s", "min_distance_m", "max_distance_m", "max_speed_m_s",
        "max_acceleration_m_s2", "fence_radius_m", "min_height_m", "max_height_m", "min_battery_fraction",
        "body_height_m", "max_control_timeout_s", "gimbal_control",
    },
    "visualizer": {"marker_rate_hz", "path_points", "frame_prefix", "human_topics"},
    "session_recorder": {"session_dir", "free_mib", "split_s"},
}  # fmt: skip


def topic_of(name):
    """Name in the table of a viewer's topic."""
    return name if name in TOPICS else name.removeprefix("/drocap/")


@pytest.mark.parametrize("name", [*ALL, "video_file"])
def test_configuration_holds_existing_parameters_only(root, name):
    path = root / "config" / f"{name}.yaml"
    config = load_config(path)
    types = section_types()
    for key, body in yaml.safe_load(path.read_text()).items():
        component = key.rsplit("/", 1)[-1]
        assert set(body["ros__parameters"]) <= set(types[component].__dataclass_fields__)
        for parameter, value in body["ros__parameters"].items():
            assert getattr(config.section(component), parameter) == value


@pytest.mark.parametrize("name", ALL)
def test_configuration_for_hardware_is_complete_and_permits_no_motion(root, name):
    text = (root / "config" / f"{name}.yaml").read_text()
    sections = {key.rsplit("/", 1)[-1]: body["ros__parameters"] for key, body in yaml.safe_load(text).items()}
    for component, parameters in EXPECTED.items():
        assert parameters <= set(sections[component]), component
    bridge = sections["mavlink_bridge"]
    assert bridge["commands_enabled"] is False
    assert bridge["mode_change_allowed"] is False
    assert bridge["system_id"] != 255
    # Only a companion has the system id of its vehicle.
    assert (bridge["system_id"] == 1) == (name in COMPANIONS)
    for line in text.splitlines():
        if line.startswith("    ") and "ros__parameters" not in line:
            assert "#" in line, f"{line}: not explained"


def topics_in(value):
    """Topics that a Foxglove layout names, with the path behind them."""
    if isinstance(value, dict):
        for key, inner in value.items():
            if key in ("topicPath", "topicToRender", "imageTopic", "value") and isinstance(inner, str):
                yield inner
            if key in ("topics", "annotations"):
                yield from inner
            yield from topics_in(inner)
    elif isinstance(value, list):
        for inner in value:
            yield from topics_in(inner)


def test_foxglove_layout_names_existing_topics_and_fields(root):
    layout = json.loads((root / "config" / "foxglove_layout.json").read_text())
    paths = set(topics_in(layout["configById"]))
    assert {topic_of(path.split(".")[0]) for path in paths} <= set(TOPICS)
    shown = {topic_of(path.split(".")[0]) for path in paths}
    assert {"markers/latest", "markers/keypoints", "image/compressed", "orbit/status", "/diagnostics"} <= shown
    for path in paths - {path for path in paths if path.startswith("/diagnostics.")}:
        topic, _, field = path.partition(".")
        assert not field or hasattr(TOPICS[topic_of(topic)].message(), field), path
    plotted = [path for path in paths if path.startswith("/diagnostics.")]
    assert len(plotted) == 6
    for path in plotted:
        node, key = re.fullmatch(
            r'/diagnostics\.status\[:\]\{name=="drocap/(\w+)"\}\.values\[:\]\{key=="([^"]+)"\}\.value', path
        ).groups()
        assert node in NODES
        assert key in (Key.LATENCY_P95, Key.RATE)


def panels_of(place):
    if isinstance(place, str):
        return [place]
    assert place["direction"] in ("row", "column")
    assert 0 < place["splitPercentage"] < 100
    return panels_of(place["first"]) + panels_of(place["second"])


def test_foxglove_layout_places_each_panel_once(root):
    layout = json.loads((root / "config" / "foxglove_layout.json").read_text())
    assert set(layout) == {"configById", "globalVariables", "userNodes", "playbackConfig", "layout"}
    placed = panels_of(layout["layout"])
    for tab in layout["configById"]["Tab!below"]["tabs"]:
        placed += panels_of(tab["layout"])
    assert sorted(placed) == sorted(layout["configById"])
    known = {"3D", "Image", "Plot", "Table", "DiagnosticSummary", "RawMessages", "Tab"}
    assert {panel.split("!")[0] for panel in placed} == known


def test_rviz_file_shows_topics_of_the_graph(root):
    displays = yaml.safe_load((root / "config" / "drocap.rviz").read_text())["Visualization Manager"]["Displays"]
    shown = {}
    for display in displays:
        for key in ("Topic", "Camera Info Topic"):
            if key in display:
                name = topic_of(display[key]["Value"])
                assert name in TOPICS
                shown[name] = display["Class"]
    assert shown["markers/latest"] == shown["markers/initial"] == "rviz_default_plugins/MarkerArray"
    assert {"image/compressed", "camera_info", "markers/camera_path"} <= set(shown)
