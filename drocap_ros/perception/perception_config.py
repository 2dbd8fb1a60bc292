"""Parameters of image ingest and of the pose estimator."""

from __future__ import annotations

from dataclasses import dataclass

from drocap_ros.parameters import Parameters, param


@dataclass(frozen=True)
class ImageIngestConfig(Parameters):
    """Where images come from and how they are published."""

    source: str = param("", "video file, image folder, /dev/videoN, rtsp://, udp://, or topic:NAME of an image topic")
    loop: bool = param(False, "start a file again at its end (stamps go on increasing)")
    realtime: bool = param(True, "publish a file at the pace of its stamps; false: as fast as it decodes")
    max_rate_hz: float = param(0.0, "skip images beyond this rate; 0 = every image", unit="Hz", minimum=0, maximum=1000)
    folder_rate_hz: float = param(
        30.0, "rate given to an image folder whose file names are no stamps", unit="Hz", minimum=0.01, maximum=1000
    )
    jpeg_quality: int = param(90, "quality of the published JPEG", minimum=1, maximum=100)
    width_px: int = param(0, "asked of a V4L2 camera; 0 = its default", unit="px", minimum=0, maximum=16384)
    height_px: int = param(0, "asked of a V4L2 camera; 0 = its default", unit="px", minimum=0, maximum=16384)
    rate_hz: float = param(0.0, "asked of a V4L2 camera; 0 = its default", unit="Hz", minimum=0, maximum=1000)
    stall_timeout_s: float = param(
        1.5, "a live source without an image for this long is reported as stalled", unit="s", minimum=0.1, maximum=60
    )
    reconnect_max_s: float = param(
        10.0, "longest pause between attempts to reach a live source again", unit="s", minimum=0.1, maximum=600
    )
    calibration_file: str = param("", "camera calibration YAML (camera_calibration format); empty: none")
    horizontal_fov_deg: float = param(
        0.0, "horizontal field of view when there is no calibration; 0 = unknown", unit="deg", minimum=0, maximum=170
    )
    frame_id: str = param("camera_optical", "optical frame of the images")


@dataclass(frozen=True)
class PoseEstimatorConfig(Parameters):
    """Models, thresholds and the choice of the subject."""

    models_dir: str = param(
        "",
        "folder of ONNX models, or simulation = those for rendered pictures that ship with the package;"
        " empty = DROCAP_MODELS, else the user's own",
    )
    detector: str = param("auto", "detector: file name in the models folder, or auto")
    pose_model: str = param("auto", "2D pose model: file name in the models folder, or auto")
    provider: str = param(
        "auto", "execution provider of onnxruntime; auto = CUDA where offered, else CPU",
        choices=("auto", "cpu", "cuda", "tensorrt", "openvino", "coreml"),
    )  # fmt: skip
    threads: int = param(1, "threads of one model run on the CPU", minimum=1, maximum=256)
    detection_threshold: float = param(0.35, "least score that makes a new subject", minimum=0.01, maximum=1)
    low_threshold: float = param(
        0.2, "least score that continues a subject near its prediction", minimum=0.01, maximum=1
    )
    nms_iou: float = param(0.6, "overlap above which two boxes are one person", minimum=0.05, maximum=1)
    keypoint_threshold: float = param(
        0.10, "keypoints below this confidence are reported as not seen (NaN)", minimum=0, maximum=1
    )
    box_padding: float = param(1.25, "side of the pose crop over that of the box", minimum=1, maximum=3)
    subject: str = param(
        "largest", "who is followed: the largest, the one nearest the centre, a given box, or the drone's own roi",
        choices=("largest", "centre", "box", "roi"),
    )  # fmt: skip
    subject_box: str = param("", "for subject = box: x_min,y_min,x_max,y_max in the first image, px")
    on_loss: str = param(
        "wait",
        "after the subject is lost for good: wait for a choice, or follow the next person under a new track_id",
        choices=("wait", "next"),
    )
    confirm_frames: int = param(
        3, "images in which a new person is seen before it is the subject", minimum=1, maximum=100
    )
    coast_s: float = param(
        1.0, "time without a sure detection over which the box is predicted", unit="s", minimum=0, maximum=10
    )
    forget_s: float = param(
        20.0, "time after which a lost subject is not taken up again", unit="s", minimum=0.1, maximum=3600
    )
    give_up_s: float = param(
        3.0, "for on_loss = next: time a subject lost in mid-picture is waited for", unit="s", minimum=0, maximum=3600
    )
    detect_every_s: float = param(
        0.1,
        "longest time between detections of a subject whom the pose network sees clearly and alone; 0 = every image",
        unit="s", minimum=0, maximum=10,
    )  # fmt: skip
    max_hurry: int = param(
        3,
        "of a node that is too slow: images in sequence, after one that the networks see, whose keypoints are carried"
        " on by optical flow; 0 = full work always, images are dropped instead",
        minimum=0, maximum=10,
    )  # fmt: skip
    full_frame_every_s: float = param(
        1.0,
        "interval of detection over the whole image while the subject is in view",
        unit="s",
        minimum=0.05,
        maximum=3600,
    )
    appearance_threshold: float = param(
        0.92,
        "least similarity of colours (Bhattacharyya, 0 to 1) to take a lost subject up again",
        minimum=0,
        maximum=1,
    )
