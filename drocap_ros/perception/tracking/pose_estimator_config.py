"""Parameters of the pose estimator."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from drocap_ros.errors import ParameterError
from drocap_ros.parameters import Parameters, param


@dataclass(frozen=True)
class PoseEstimatorConfig(Parameters):
    """Models, thresholds and the choice of the subject."""

    models_dir: str = param(
        "",
        "folder of ONNX models, or simulation = the shipped ones for rendered images; empty = DROCAP_MODELS, else the"
        " user's own folder",
    )
    detector: str = param("auto", "detector: file name in the models folder, or auto")
    pose_model: str = param("auto", "2D pose model: file name in the models folder, or auto")
    feet_model: str = param(
        "",
        "second 2D pose model for toes, heels and depth of the body that the first one finds: file name in the models"
        " folder, as blazepose-full; empty = none",
    )
    provider: str = param(
        "auto",
        "execution provider of onnxruntime; auto = CUDA where offered, else CPU",
        choices=("auto", "cpu", "cuda", "tensorrt", "openvino", "coreml"),
    )
    threads: int = param(1, "threads of one model run on the CPU", minimum=1, maximum=256)
    detection_threshold: float = param(0.35, "least score that spawns a track", minimum=0.01, maximum=1)
    low_threshold: float = param(0.2, "least score that continues a track near its prediction", minimum=0.01, maximum=1)
    keypoint_threshold: float = param(
        0.10, "keypoints below this confidence are reported as not seen (NaN)", minimum=0, maximum=1
    )
    subject: str = param(
        "largest",
        "initial subject: the largest person, the one nearest the centre, a given box, or the drone's roi",
        choices=("largest", "centre", "box", "roi"),
    )
    subject_box: str = param("", "for subject = box: x_min,y_min,x_max,y_max in the first image, px")
    on_loss: str = param(
        "wait",
        "after the subject is lost for good: wait for a choice, or follow the next person under a new track_id",
        choices=("wait", "next"),
    )
    confirm_frames: int = param(
        3, "images in which a new person is detected before it can be the subject", minimum=1, maximum=100
    )
    coast_s: float = param(
        1.0, "time without a confirmed detection over which the box is predicted", unit="s", minimum=0, maximum=10
    )
    detect_every_s: float = param(
        0.1,
        "longest time between detections of an isolated subject with high pose confidence; 0 = every image",
        unit="s",
        minimum=0,
        maximum=10,
    )
    max_load_level: int = param(
        3,
        "highest level of load shedding: images in sequence whose keypoints are propagated by optical flow; from 3 on"
        " none waits for slow networks; 0 = full work always, images are dropped instead",
        minimum=0,
        maximum=10,
    )


def parse_box(text: str) -> np.ndarray:
    """(4,) x_min y_min x_max y_max from "x,y,x,y"."""
    try:
        box = np.array([float(v) for v in text.split(",")])
    except ValueError:
        box = np.empty(0)
    if box.shape != (4,) or not np.isfinite(box).all() or (box[2:] <= box[:2]).any():
        raise ParameterError(f"subject_box: expected x_min,y_min,x_max,y_max px, got {text!r}; correct it")
    return box


def parse_subject(text: str) -> tuple[int | None, dict[str, str]]:
    """A person's number or None, and parameters, of "3", "largest", "centre", a box of :func:`parse_box`, or ""."""
    if text.isdecimal():
        return int(text), {}
    if not text or text in ("largest", "centre"):
        return None, {"subject": text} if text else {}
    if "," not in text:
        raise ParameterError(f"subject: expected a person's number, largest, centre or a box, got {text!r}; correct it")
    parse_box(text)
    return None, {"subject": "box", "subject_box": text}


#: Four numbers below it are persons, not a box: nobody within so few px is recognised.
_LEAST_BOX_PX = 30


def parse_people(text: str) -> tuple[int, ...]:
    """Numbers of several persons, as "1,3"; empty for every other choice of :func:`parse_subject`."""
    words = text.split(",")
    if len(words) < 2 or not all(word.strip().isdecimal() for word in words):
        return ()
    numbers = tuple(map(int, words))
    if len(numbers) == 4 and max(numbers) >= _LEAST_BOX_PX:
        return ()
    if min(numbers) < 1 or len(set(numbers)) < len(numbers):
        raise ParameterError(f"subject: expected different numbers of persons, from 1 on, got {text!r}; correct it")
    return numbers
