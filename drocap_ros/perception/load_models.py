"""Loading of a detector and a 2D pose model from a folder of networks."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from drocap_ros.errors import InputError
from drocap_ros.perception.detection.detector import Detector
from drocap_ros.perception.models.runtime import SUFFIXES, Model, network_files, open_model
from drocap_ros.perception.models.spec import ModelSpec, read_spec
from drocap_ros.perception.pose.body_pose import FeetModel
from drocap_ros.perception.pose.pose_model import PoseModel
from drocap_ros.perception.tracking.pose_estimator_config import PoseEstimatorConfig

T = TypeVar("T", Detector, PoseModel)

_WHAT = {"detector": "person detector", "pose": "2D pose model"}
#: Name parts in the order of preference of ``auto``; other names come last.
_ORDER = {
    "detector": ("rtmdet", "yolox", "yolo", "rtmo"),
    "pose": ("rtmpose", "tinypose", "vitpose", "hrnet", "hourglass", "movenet", "yolo", "rtmo"),
}

#: Name of the shipped networks, in place of a folder.  They are trained on rendered images only, so nothing falls back
#: to them.
SIMULATION = "simulation"
_SHIPPED = Path(__file__).parents[1] / "data" / "simulation_models"

_FETCH = "run `drocap models fetch` or name a folder with --models or DROCAP_MODELS"


def models_folder(given: str | Path | None = None) -> Path:
    """Folder of models: the given one, else ``DROCAP_MODELS``, else the user's own, the target of ``fetch``.

    ``simulation`` in place of a folder names the shipped networks for rendered images.
    """
    if named := given or os.environ.get("DROCAP_MODELS"):
        return _SHIPPED if str(named) == SIMULATION else Path(named)
    data = os.environ.get("XDG_DATA_HOME") or Path.home() / ".local" / "share"
    return Path(data) / "drocap_ros" / "models"


def limited_use(model: Model) -> str:
    """Notice in the metadata of a model with limited use, else an empty string."""
    if purpose := model.metadata.get("only_for", ""):
        return model.metadata.get("notice") or f"for {purpose} only"
    return ""


def load_detector(models_dir: str | Path, config: PoseEstimatorConfig) -> Detector:
    """The configured person detector of a folder, or the preferred one with ``auto``."""
    return _load(Path(models_dir), "detector", config.detector, config, Detector)


def load_pose_model(models_dir: str | Path, config: PoseEstimatorConfig) -> PoseModel:
    """As :func:`load_detector`, for the 2D pose model."""
    return _load(Path(models_dir), "pose", config.pose_model, config, PoseModel)


def load_feet_model(models_dir: str | Path, config: PoseEstimatorConfig) -> FeetModel | None:
    """The configured second model for feet; None without one."""
    if not config.feet_model:
        return None
    return FeetModel(_load(Path(models_dir), "pose", config.feet_model, config, PoseModel))


def _load(folder: Path, task: str, name: str, config: PoseEstimatorConfig, build: Callable[[Model, ModelSpec], T]) -> T:
    what = _WHAT[task]
    if not folder.is_dir():
        raise InputError(f"{folder}: expected a folder with a {what} (.onnx), found no such folder; {_FETCH}")
    if name != "auto":
        path = _named(folder, name)
        model, spec = _read(path, config)
        if spec.task not in (task, "both"):
            raise InputError(f"{path}: expected a {what}, found a {spec.task} model ({spec.layout}); name another")
        return build(model, spec)
    paths = sorted(network_files(folder), key=lambda path: _rank(path, _ORDER[task]))
    why = ""
    for path in paths:
        try:
            model, spec = _read(path, config)
        except InputError as error:
            why = why or f" ({error})"
            continue
        if spec.task in (task, "both"):
            return build(model, spec)
    found = ", ".join(sorted(path.name for path in paths)) or "no .onnx file"
    raise InputError(f"{folder}: expected a {what} (.onnx), found {found}{why}; {_FETCH}")


def _named(folder: Path, name: str) -> Path:
    """The network of a name, with or without its suffix; ONNX before TensorFlow Lite."""
    files = [folder / name, *(folder / f"{name}{suffix}" for suffix in SUFFIXES)]
    return next((file for file in files if file.is_file() and file.suffix in SUFFIXES), files[1])


def _read(path: Path, config: PoseEstimatorConfig) -> tuple[Model, ModelSpec]:
    model = open_model(path, config.threads, config.provider)
    return model, read_spec(model)


def _rank(path: Path, order: tuple[str, ...]) -> tuple[int, str]:
    name = path.name.lower()
    return next((i for i, part in enumerate(order) if part in name), len(order)), name
