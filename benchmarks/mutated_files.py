"""Mutated copies of a file of every format, each through its reader: a result, or one line and status 2.

Kinds whose file comes from ../shared/cases or ../shared/media need that folder.
"""

from __future__ import annotations

import contextlib
import io
import random
import resource
import shutil
import signal
import struct
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from figures import ROOT

sys.path[:0] = [str(ROOT), str(ROOT / "test" / "helpers")]
_SHARED = ROOT.parent / "shared"
_LONGEST_S = 10.0


def mutations(kind: str, count: str, seed: str, folder: str) -> dict[str, Any]:
    """Numbers of copies used, refused and at fault, longest time and memory; faulty copies are kept."""
    from djmd_clips import damaged_boxes
    from telemetry_logs import mutated

    make, use = KINDS[kind]
    whole = make(Path(folder))
    rng = random.Random(f"{seed} {kind}")
    path = Path(folder) / f"mutated.{kind.split('_')[-1]}"
    base_mib = _peak_mib()
    refused = used = 0
    worst_s, faults = 0.0, []
    signal.signal(signal.SIGALRM, _too_long)
    for i in range(int(count)):
        # Every other copy of a video has a box that lies; else damage would mostly hit its images.
        path.write_bytes(damaged_boxes(whole, rng) if path.suffix == ".mp4" and i % 2 else mutated(whole, rng))
        begin = time.monotonic()
        signal.setitimer(signal.ITIMER_REAL, _LONGEST_S)
        try:
            status, words = _used(use, path)
        except BaseException as error:  # noqa: BLE001 - every end counts, the alarm's too
            status, words = 1, f"{type(error).__name__}: {error}"
        finally:
            signal.setitimer(signal.ITIMER_REAL, 0.0)
        worst_s = max(worst_s, time.monotonic() - begin)
        used, refused = used + (status == 0), refused + (status == 2)
        if status not in (0, 2) or "Traceback" in words or (status == 2 and len(words.strip().splitlines()) > 1):
            faults.append(f"{i}: {words.strip()[:200]}")
            shutil.copy(path, Path(tempfile.gettempdir()) / f"drocap_fault_{i}.{kind}")
    return {
        "copies": int(count), "used": used, "refused": refused, "faults": len(faults), "examples": faults[:5],
        "worst_s": round(worst_s, 2), "peak_mib": round(_peak_mib()), "base_mib": round(base_mib),
    }  # fmt: skip


def _peak_mib() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def _too_long(*_: object) -> None:
    raise TimeoutError(f"longer than {_LONGEST_S:g} s")


def _used(use: Callable[[Path], int | None], path: Path) -> tuple[int, str]:
    """Exit status for the file, and the text on stderr."""
    from drocap_ros.errors import InputError

    said = io.StringIO()
    with contextlib.redirect_stderr(said), contextlib.redirect_stdout(io.StringIO()):
        try:
            return use(path) or 0, said.getvalue()
        except InputError as error:
            return 2, f"{error}\n"


# -- readers -----------------------------------------------------------------------------------------------


def _info(path: Path) -> int:
    from drocap_ros.cli import main as drocap

    return drocap(["info", str(path)])


def _poses(path: Path) -> int | None:
    from drocap_ros.config import DrocapConfig
    from drocap_ros.pipeline import read_input

    status = _info(path)
    return status or (read_input(path, DrocapConfig(), None) and None)


def _log(path: Path) -> None:
    from drocap_ros.recording.telemetry.log import camera_poses
    from drocap_ros.recording.telemetry.read import read_telemetry

    log = read_telemetry(path)
    camera_poses(log.track, log.track.stamp_ns[:100])


def _video_log(path: Path) -> int | None:
    return _info(path) or _log(path)


def _images(path: Path) -> int | None:
    from drocap_ros.open_images import open_images

    status = _info(path)
    if status == 0:
        with open_images(path) as images:
            for _ in images.frames:
                pass
    return status


def _truth(path: Path) -> None:
    from drocap_ros.evaluation.compare import load_truth

    load_truth(path)


def _keypoints(path: Path) -> None:
    from drocap_ros.recording.keypoints.files import read_keypoints

    read_keypoints(path)


# -- whole files -------------------------------------------------------------------------------------------


def _flight() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times (N,) s, angles (N, 3) rad and places (N, 3)."""
    t = np.arange(0, 8, 0.05).round(3)
    angles = np.stack([0.1 * np.sin(t), 0.05 * np.cos(t), 0.4 * t - 1], axis=1)
    return t, angles, np.stack([47 + 1e-5 * np.sin(t), 8 + 1e-5 * np.cos(t), 500 + 0.5 * t], axis=1)


def _srt(_: Path) -> bytes:
    from telemetry_logs import dji_subtitle, srt_text

    t, angles, geodetic = _flight()
    lines = [dji_subtitle(i, g, a) for i, (g, a) in enumerate(zip(geodetic, angles, strict=True))]
    return srt_text(t, lines).encode()


def _airdata(folder: Path) -> bytes:
    from airdata_tables import write_airdata

    return write_airdata(folder / "whole.csv", [(1.0, 7.0)]).read_bytes()


def _dataflash(folder: Path) -> bytes:
    from dataflash import write_dataflash

    t, angles, geodetic = _flight()
    return write_dataflash(folder / "whole.bin", t, angles, geodetic, angles).read_bytes()


def _djmd(folder: Path) -> bytes:
    from djmd_clips import whole_clip

    return whole_clip(folder / "whole.mp4").read_bytes()


def _capture() -> Any:
    from recorded import START_NS

    from lab.simulation.capture import simulate_capture

    return simulate_capture(4, 30, seed=2, start_ns=START_NS)


def _tracks(folder: Path) -> bytes:
    from drocap_ros.tracks import save_tracks

    save_tracks(folder / "whole.npz", _capture().tracks)
    return (folder / "whole.npz").read_bytes()


def _session(folder: Path) -> bytes:
    from recorded import Messages, write_poses

    from drocap_ros.recording.mcap.session_config import SessionRecorderConfig

    config = SessionRecorderConfig(chunk_kib=16)
    return write_poses(folder / "s", Messages(), _capture().tracks, config).read_bytes()


def _bag(folder: Path) -> bytes:
    """A rosbag1 file of compressed images without its index."""
    from recorded import START_NS, random_image
    from rosbags.rosbag1 import Writer
    from rosbags.typesys import Stores, get_typestore

    from drocap_ros.perception.sources.image_files import encode_jpeg

    store = get_typestore(Stores.ROS1_NOETIC)
    image, header, time_type = (
        store.types[f"{name}"]
        for name in ("sensor_msgs/msg/CompressedImage", "std_msgs/msg/Header", "builtin_interfaces/msg/Time")
    )
    with Writer(folder / "whole.bag") as writer:
        connection = writer.add_connection("/camera", image.__msgtype__, typestore=store)
        for i in range(6):
            stamp = START_NS + i * 10**8
            data = np.frombuffer(encode_jpeg(random_image(i)), np.uint8)
            stamped = header(seq=i, stamp=time_type(stamp // 10**9, stamp % 10**9), frame_id="camera")
            message = image(header=stamped, format="jpeg", data=data)
            writer.write(connection, stamp, bytes(store.serialize_ros1(message, image.__msgtype__)))
    whole = bytearray((folder / "whole.bag").read_bytes())
    at = whole.index(b"index_pos=") + 10
    place = struct.unpack("<Q", whole[at : at + 8])[0]
    whole[at : at + 8] = bytes(8)
    return bytes(whole[:place])


def _exported(form: str) -> Callable[[Path], bytes]:
    def make(folder: Path) -> bytes:
        from drocap_ros.export import export
        from drocap_ros.reconstruction.reconstruct import reconstruct

        motion = reconstruct(_capture().tracks, method="initial")
        export(motion, folder / f"whole.{form}")
        return (folder / f"whole.{form}").read_bytes()

    return make


def _of_shared(name: str, most: int | None = None) -> Callable[[Path], bytes]:
    return lambda _: (_SHARED / name).read_bytes()[:most]


_CASES = "cases/keypoint_files_of_other_tools"
#: Name, of which the part behind "_" is the ending -> a whole file and its reader.
KINDS: dict[str, tuple[Callable[[Path], bytes], Callable[[Path], int | None]]] = {
    "mcap": (_session, _poses),
    "npz": (_tracks, _poses),
    "tlog": (_of_shared("media/arduplane_vtol_sitl.tlog", 200_000), _log),
    "srt": (_srt, _log),
    "bin": (_dataflash, _log),
    "ulg": (_of_shared("media/px4_sample_small.ulg", 300_000), _log),
    "csv": (_airdata, _log),
    "mp4": (_djmd, _video_log),
    "subtitles_mp4": (_of_shared("cases/subtitles_inside_mp4/embedded.mp4"), _video_log),
    "video_mp4": (_of_shared("cases/trimmed_edit_list/trimmed.mp4"), _images),
    "record_csv": (_of_shared("cases/flight_log_csv/flightrecord.csv"), _log),
    "semicolon_csv": (_of_shared("cases/flight_log_csv/airdata_semicolon.csv"), _log),
    "unindexed_bag": (_bag, _images),
    "foxglove_mcap": (_of_shared("cases/video_messages_mcap/foxglove_json.mcap"), _images),
    "packets_mcap": (_of_shared("cases/video_messages_mcap/ffmpeg_packet/ffmpeg_packet.mcap"), _images),
    "alphapose_json": (_of_shared(f"{_CASES}/alphapose-results.json"), _keypoints),
    "deeplabcut_csv": (_of_shared(f"{_CASES}/walkDLC_own.csv"), _keypoints),
    "c3d": (_exported("c3d"), _truth),
    "trc": (_exported("trc"), _truth),
    "bvh": (_exported("bvh"), _truth),
}
