"""Parameters of what is drawn."""

from __future__ import annotations

from dataclasses import dataclass

from drocap_ros.parameters import Parameters, param


@dataclass(frozen=True)
class VisualizerConfig(Parameters):
    """What the visualizer draws, and under which names."""

    marker_rate_hz: float = param(
        15.0,
        "greatest rate of the body's 3D markers; TF has every pose; 0 = as many",
        unit="Hz",
        minimum=0,
        maximum=1000,
    )
    path_points: int = param(600, "points of the camera's path that are kept", minimum=2, maximum=100_000)
    path_period_s: float = param(0.2, "time between two of them", unit="s", minimum=0.01, maximum=60)
    frame_prefix: str = param("", "before the names of the body's TF frames, to tell two drones apart, e.g. drone2/")
    human_topics: bool = param(False, "publish the subject as REP 155 does: /humans/bodies topics, frames body_<id>")
