"""Parameters of the session player."""

from __future__ import annotations

from dataclasses import dataclass

from drocap_ros.parameters import Parameters, param


@dataclass(frozen=True)
class SessionPlayerConfig(Parameters):
    """Session, topics and speed of a replay."""

    session: str = param("", "session folder, .mcap, .bag or rosbag2 folder")
    rate: float = param(1.0, "times the speed of the recording", minimum=0.01, maximum=100)
    start_s: float = param(0.0, "time in the recording at which the replay starts", unit="s", minimum=0)
    delay_s: float = param(
        0.0,
        "before the first message: subscribers that run already find the player meanwhile",
        unit="s",
        minimum=0,
        maximum=3600,
    )
    loop: bool = param(False, "start again at the end, until stopped")
    topics: str = param("", "names, or their ends, separated by spaces; empty = all but /diagnostics and /clock")
    clock: bool = param(True, "publish the recording's time on /clock")
