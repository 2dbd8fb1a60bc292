"""Parameters of the node ``visualizer``."""

from __future__ import annotations

from dataclasses import dataclass

from drocap_ros.parameters import Parameters, param


@dataclass(frozen=True)
class VisualizerConfig(Parameters):
    """Markers, TF frames and topics that the visualizer publishes."""

    marker_rate_hz: float = param(
        15.0,
        "greatest rate of the body's 3D markers; TF has every pose; 0 = no limit",
        unit="Hz",
        minimum=0,
        maximum=1000,
    )
    path_points: int = param(600, "points kept of the camera's path", minimum=2, maximum=100_000)
    path_period_s: float = param(0.2, "time between two points of the path", unit="s", minimum=0.01, maximum=60)
    frame_prefix: str = param("", "prefix of the body's TF frames, e.g. drone2/ with two drones")
    human_topics: bool = param(False, "publish the subject by REP 155: /humans/bodies topics, frames body_<id>")
