"""The functions of ``drocap_ros`` for scripts and notebooks (``docs/api.md``)."""

from __future__ import annotations

import math
from pathlib import Path

from drocap_ros.clip import Clip, Progress
from drocap_ros.config import DrocapConfig, load_config
from drocap_ros.corrections import Corrections, load_corrections
from drocap_ros.evaluation import compare as comparison
from drocap_ros.evaluation.compare import MotionErrors
from drocap_ros.motion import Motion, load_motion
from drocap_ros.perception.tracking.pose_estimator_config import parse_subject
from drocap_ros.pipeline import Selection, reconstruct_input, selected_tracks, with_corrections
from drocap_ros.reconstruction.reconstruct import reconstruct as reconstruct_tracks
from drocap_ros.recording.video_telemetry import Telemetry
from drocap_ros.tracks import Tracks


def reconstruct(  # noqa: PLR0913 - the options of the command
    source: str | Path | Tracks,
    *,
    method: str = "ba",
    models: str | Path | None = None,
    config: DrocapConfig | str | Path | None = None,
    telemetry: Telemetry | str | Path | None = None,
    start_s: float = 0.0,
    end_s: float = math.inf,
    subject: int | str = "",
    redetect: bool = False,
    corrections: str | Path | None = None,
    progress: Progress | None = None,
) -> Motion:
    """3D motion of the person in a video, image folder, recording, tracks file, or in tracks.

    The same arrays as ``drocap reconstruct`` with the options of the same names.

    method : "ba", "paper", "paper-no-articulation", "initial", "mf-nnm", or "live" for a recording of the live graph
    models : folder of ONNX files; None = ``DROCAP_MODELS`` or the user's own
    config : parameters, or their YAML file
    telemetry : log beside a video, or "none", also for tracks; default: the DJI track inside the video, or the
        subtitles of its name beside it
    start_s, end_s : part of the source, seconds from its first image
    subject : number of a person as ``drocap track --list`` numbers them, "largest", "centre", or a box
        "x_min,y_min,x_max,y_max" px in the first image; empty = as configured
    redetect : estimate the 2D poses of a recording from its images, although it holds recorded ones
    corrections : YAML file of what is corrected by hand (:mod:`drocap_ros.corrections`)
    progress : called with a stage and its completed share; a negative share = unknown
    """
    settings = config if isinstance(config, DrocapConfig) else load_config(config or None)
    person, rule = parse_subject(str(subject))
    log = Telemetry(Path(telemetry)) if isinstance(telemetry, str | Path) else telemetry or Telemetry()
    by_hand = load_corrections(corrections) if corrections else Corrections()
    selection = Selection(Clip(start_s, end_s), person, redetect, corrections=by_hand)
    if isinstance(source, Tracks):
        return reconstruct_tracks(
            with_corrections(None, selected_tracks(source, log, selection), settings, None, None, selection),
            method=method,
            initializer=settings.initializer,
            adjuster=settings.bundle_adjuster,
            progress=progress,
        )
    motion, _ = reconstruct_input(
        source,
        method=method,
        config=settings.replace("pose_estimator", **rule),
        models=None if models is None else Path(models),
        progress=progress,
        telemetry=log,
        selection=selection,
    )
    return motion


def compare(motion: Motion | str | Path, truth: Motion | str | Path) -> MotionErrors:
    """Errors of a motion against its truth: ``drocap evaluate compare``.

    motion : a motion, its file or folder
    truth : a motion, or a file of a motion or of MoCap, or a folder with ``truth.npz`` or ``motion.npz``
    """
    found = motion if isinstance(motion, Motion) else load_motion(motion)
    return comparison.compare(found, *comparison.load_truth(truth))
