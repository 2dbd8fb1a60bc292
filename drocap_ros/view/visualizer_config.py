"""Parameters of the node ``visualizer``, and the rate limit of what is drawn."""

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
    frame_prefix: str = param(
        "",
        "prefix of the body's TF frames, e.g. drone_2/ with two drones; for REP 155 empty = the namespace",
    )
    human_topics: bool = param(False, "publish the subject by REP 155: /humans/bodies topics, frames body_<id>")


class RateLimit:
    """Thins a stream to a rate; a jump back in time restarts it.  Rate 0 keeps all messages."""

    def __init__(self, rate_hz: float) -> None:
        # Stamps may be early by a tenth: images at 30 Hz limited to 10 Hz are every third in spite of jitter.
        self._least_ns = round(0.9 * 1e9 / rate_hz) if rate_hz > 0 else 0
        self._last_ns: int | None = None

    def due(self, stamp_ns: int) -> bool:
        """Whether the message of this stamp is kept."""
        if self._last_ns is not None and 0 <= stamp_ns - self._last_ns < self._least_ns:
            return False
        self._last_ns = stamp_ns
        return True
