"""Parameters of the recorder and of the player of sessions."""

from __future__ import annotations

from dataclasses import dataclass

from drocap_ros.parameters import Parameters, param


@dataclass(frozen=True)
class SessionRecorderConfig(Parameters):
    """Folder, chunks, queue and limits of a session."""

    session_dir: str = param("", "folder to create; it must not exist, or be empty; empty = a new one named by date")
    if_taken: str = param(
        "refuse",
        "when session_dir is not empty: refuse, or take the next free name of the form session_dir_2",
        choices=("refuse", "next"),
    )
    chunk_s: float = param(0.5, "time between writes of a chunk to the disk", unit="s", minimum=0.05, maximum=10)
    chunk_kib: int = param(1024, "size at which a chunk is written earlier", unit="KiB", minimum=16, maximum=65536)
    compression: str = param("zstd", "of the chunks", choices=("none", "lz4", "zstd"))
    queue_mib: int = param(
        128, "limit of the queue to the disk; above it images are dropped first", unit="MiB", minimum=1, maximum=4096
    )
    free_mib: int = param(
        256, "free space on the disk below which the recording ends", unit="MiB", minimum=0, maximum=1_000_000
    )
    split_mib: int = param(
        2048, "size after which a new file starts; 0 = never", unit="MiB", minimum=0, maximum=1_000_000
    )
    split_s: float = param(600.0, "time after which a new file starts; 0 = never", unit="s", minimum=0, maximum=86_400)
    sync: bool = param(True, "force each chunk to the disk, so that a power cut loses at most the last one")


@dataclass(frozen=True)
class SessionPlayerConfig(Parameters):
    """Session, topics and speed of a replay."""

    session: str = param("", "session folder, .mcap, .bag or rosbag2 folder")
    rate: float = param(1.0, "times the speed of the recording", minimum=0.01, maximum=100)
    start_s: float = param(0.0, "time in the recording at which the replay starts", unit="s", minimum=0)
    delay_s: float = param(0.0, "before the first message, for subscribers to come", unit="s", minimum=0, maximum=3600)
    loop: bool = param(False, "start again at the end, until stopped")
    topics: str = param("", "names, or their ends, separated by spaces; empty = all but /diagnostics and /clock")
    clock: bool = param(True, "publish the recording's time on /clock")
