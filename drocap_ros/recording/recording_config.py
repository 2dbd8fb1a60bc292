"""Parameters of the session recorder."""

from __future__ import annotations

from dataclasses import dataclass

from drocap_ros.parameters import Parameters, param


@dataclass(frozen=True)
class SessionRecorderConfig(Parameters):
    """Where and how a session is written."""

    session_dir: str = param("", "folder to create; it must not exist, or be empty; empty = a new one named by date")
    if_taken: str = param(
        "refuse",
        "when something lies in session_dir already: refuse, or take the next free name of the kind session_dir_2",
        choices=("refuse", "next"),
    )
    chunk_s: float = param(
        0.5, "time after which what has come is written and flushed", unit="s", minimum=0.05, maximum=10
    )
    chunk_kib: int = param(1024, "size after which a chunk is written earlier", unit="KiB", minimum=16, maximum=65536)
    compression: str = param("zstd", "of the chunks", choices=("none", "lz4", "zstd"))
    queue_mib: int = param(
        128, "what waits for the disk at most; then pictures are dropped first", unit="MiB", minimum=1, maximum=4096
    )
    free_mib: int = param(
        256, "space that stays free on the disk; below it the recording ends", unit="MiB", minimum=0, maximum=1_000_000
    )
    split_mib: int = param(
        2048, "size after which a new file is begun; 0 = never", unit="MiB", minimum=0, maximum=1_000_000
    )
    split_s: float = param(
        600.0, "time after which a new file is begun; 0 = never", unit="s", minimum=0, maximum=86_400
    )
    sync: bool = param(True, "force each flush to the disk itself, so that a power cut loses at most the last chunk")


@dataclass(frozen=True)
class SessionPlayerConfig(Parameters):
    """What of a session is published again, and how fast."""

    session: str = param("", "session folder, .mcap, .bag or rosbag2 folder")
    rate: float = param(1.0, "times the speed of the recording", minimum=0.01, maximum=100)
    start_s: float = param(0.0, "how far into the recording to begin", unit="s", minimum=0)
    loop: bool = param(False, "begin again at the end, until stopped")
    topics: str = param("", "names, or their ends, separated by spaces; empty = all but /diagnostics and /clock")
    clock: bool = param(True, "publish the recording's time on /clock")
