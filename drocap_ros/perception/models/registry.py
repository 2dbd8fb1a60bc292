"""Registry of known models: publisher, licence, download and checksum."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from drocap_ros.perception.models.wheel import Package

_MMPOSE = "https://download.openmmlab.com/mmpose/v1/projects"
_SDK = f"{_MMPOSE}/rtmposev1/onnx_sdk"


@dataclass(frozen=True)
class KnownModel:
    """One model of the registry.

    name : on the command line
    task : "detector" or "pose"
    file : name in the models folder
    size_mb : of the file
    licence : of the weights, as their publisher states it
    training_data : data sets of the training; their terms may restrict commercial use
    home : publisher
    url : the file or a ZIP archive with it; empty = no download
    member : end of the file's path in the archive; empty = the download is the file itself
    sha256 : of the file; empty = no download
    package : wheel whose ``member`` it is, a network of TensorFlow Lite; its sum is pinned
    """

    name: str
    task: str
    file: str
    size_mb: float
    licence: str
    training_data: str
    home: str
    url: str = ""
    member: str = ""
    sha256: str = ""
    package: Package | None = None

    @property
    def offered(self) -> bool:
        """Whether it can be downloaded."""
        return bool(self.url or self.package)


#: The last release whose wheel holds networks; its newer ones download them from another place.
_MEDIAPIPE = Package(
    "mediapipe==0.10.21",
    "05dc4a9e593655a79558d05d6227d31018c2537a4bd3362b51e230cf22aecfe3",
    ("--platform", "manylinux_2_28_x86_64", "--python-version", "3.11"),
)
_MODULES = "mediapipe/modules"

#: Publishers state no checksums for these files.  These SHA-256 sums are pinned by independent projects for the same
#: official downloads (one project for rtmdet-nano, several for the others).
KNOWN_MODELS: tuple[KnownModel, ...] = (
    KnownModel(
        "rtmdet-nano", "detector", "rtmdet-nano-person.onnx", 4.0, "Apache-2.0", "COCO, Objects365 (persons)",
        "OpenMMLab", f"{_MMPOSE}/rtmpose/rtmpose-cpu.zip", "rtmdet-nano/end2end.onnx",
        "b8585adb6d1352796f6e86337e09c3459b830645a7e7192d9381670bea2facbd",
    ),
    KnownModel(
        "yolox-nano", "detector", "yolox_nano.onnx", 3.7, "Apache-2.0", "COCO", "Megvii",
        "https://github.com/Megvii-BaseDetection/YOLOX/releases/download/0.1.1rc0/yolox_nano.onnx", "",
        "c789161ed43c8269fcd4e67c67eeeb4e80c622da2eb296a20bc6007bd18a0b7d",
    ),
    KnownModel(
        "yolox-tiny", "detector", "yolox-tiny-humanart.onnx", 20.0, "Apache-2.0", "COCO, HumanArt", "OpenMMLab",
        f"{_SDK}/yolox_tiny_8xb8-300e_humanart-6f3252f9.zip", "end2end.onnx",
        "ceb11c07298f95c50d7c5abeb906d03340c85f23aa79e3e66966e7fb6c307250",
    ),
    KnownModel(
        "yolox-m", "detector", "yolox-m-humanart.onnx", 97.0, "Apache-2.0", "COCO, HumanArt", "OpenMMLab",
        f"{_SDK}/yolox_m_8xb8-300e_humanart-c2c7a14a.zip", "end2end.onnx",
        "3dea6513388889f0fff4b77bf7a26013600321b9eb9ceb0e9a400a82572f5f23",
    ),
    KnownModel(
        "rtmpose-s", "pose", "rtmpose-s-body7.onnx", 21.0, "Apache-2.0", "seven public sets (body7)", "OpenMMLab",
        f"{_SDK}/rtmpose-s_simcc-body7_pt-body7_420e-256x192-acd4a1ef_20230504.zip", "end2end.onnx",
        "9aeb635b83f86aea45cf45d85798f7eba1a162de8e0d721c44e54fe5eebaf47d",
    ),
    KnownModel(
        "rtmpose-m", "pose", "rtmpose-m-body7.onnx", 52.0, "Apache-2.0", "seven public sets (body7)", "OpenMMLab",
        f"{_SDK}/rtmpose-m_simcc-body7_pt-body7_420e-256x192-e48f03d0_20230504.zip", "end2end.onnx",
        "5c0a4bf67953e6d2ac43ce15e77dc9d5d354ae18430a47d2c5963a7bc5683e3c",
    ),
    KnownModel(
        "tinypose", "pose", "tinypose_256x192.onnx", 2.8, "Apache-2.0", "COCO, AI Challenger", "PaddleDetection",
    ),
    KnownModel(
        "movenet-lightning", "pose", "movenet_lightning_int8.onnx", 2.9, "Apache-2.0", "COCO, Active (Google)",
        "Google",
    ),
    KnownModel(
        "blazepose-detector", "detector", "blazepose-detector.tflite", 3.0, "Apache-2.0", "Google's pictures",
        "PyPI, mediapipe 0.10.21", member=f"{_MODULES}/pose_detection/pose_detection.tflite",
        sha256="9ba9dd3d42efaaba86b4ff0122b06f29c4122e756b329d89dca1e297fd8f866c", package=_MEDIAPIPE,
    ),
    KnownModel(
        "blazepose-full", "pose", "blazepose-full.tflite", 6.4, "Apache-2.0", "Google's pictures",
        "PyPI, mediapipe 0.10.21", member=f"{_MODULES}/pose_landmark/pose_landmark_full.tflite",
        sha256="e9a5c5cb17f736fafd4c2ec1da3b3d331d6edbe8a0d32395855aeb2cdfd64b9f", package=_MEDIAPIPE,
    ),
)  # fmt: skip

#: Models of ``fetch`` without names.
DEFAULT_FETCH = ("rtmdet-nano", "rtmpose-s")


def known_model(name: str) -> KnownModel | None:
    """Registry entry by its name or file name."""
    return next((m for m in KNOWN_MODELS if name in (m.name, m.file, Path(m.file).stem, f"{m.name}.onnx")), None)
