"""From a folder of ONNX files to a detector and a 2D pose model."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from drocap_ros.errors import InputError
from drocap_ros.perception.detection import Detector
from drocap_ros.perception.models.runtime import OnnxModel
from drocap_ros.perception.models.spec import ModelSpec, read_spec
from drocap_ros.perception.perception_config import PoseEstimatorConfig
from drocap_ros.perception.pose import PoseModel

T = TypeVar("T", Detector, PoseModel)

#: Name parts, best first: with ``auto`` a folder's models are tried in this order, others after them.
DETECTOR_ORDER = ("rtmdet", "yolox", "yolo", "rtmo")
POSE_ORDER = ("rtmpose", "tinypose", "vitpose", "hrnet", "hourglass", "movenet", "yolo", "rtmo")

#: Named in place of a folder: the networks that ship with this package.  They were trained on its own renders and
#: know no real person, so nothing falls back to them: they have to be asked for.
SIMULATION = "simulation"
_SHIPPED = Path(__file__).parents[1] / "data" / "simulation_models"

_FETCH = "run `drocap models fetch` or name a folder with --models or DROCAP_MODELS"


def models_folder(given: str | Path | None = None) -> Path:
    """The folder of models: the one given, else ``DROCAP_MODELS``, else the user's own, where ``fetch`` puts them.

    ``simulation`` in place of a folder names the networks for rendered pictures that ship with the package.
    """
    if named := given or os.environ.get("DROCAP_MODELS"):
        return _SHIPPED if str(named) == SIMULATION else Path(named)
    data = os.environ.get("XDG_DATA_HOME") or Path.home() / ".local" / "share"
    return Path(data) / "drocap_ros" / "models"


def limited_use(model: OnnxModel) -> str:
    """What a model says of itself where it is not for any picture, else nothing."""
    if purpose := model.metadata.get("only_for", ""):
        return model.metadata.get("notice") or f"for {purpose} only"
    return ""


def load_detector(models_dir: str | Path, config: PoseEstimatorConfig) -> Detector:
    """The configured person detector of a folder, or the best with ``auto``.

    Raises
    ------
    InputError
        When the folder has none, or the named one cannot be used.
    """

    def build(model: OnnxModel, spec: ModelSpec) -> Detector:
        return Detector(model, spec, config.nms_iou)

    return _load(Path(models_dir), config.detector, "detector", DETECTOR_ORDER, config, build)


def load_pose_model(models_dir: str | Path, config: PoseEstimatorConfig) -> PoseModel:
    """The configured 2D pose model of a folder, or the best with ``auto``.

    Raises
    ------
    InputError
        When the folder has none, or the named one cannot be used.
    """

    def build(model: OnnxModel, spec: ModelSpec) -> PoseModel:
        return PoseModel(model, spec, config.box_padding)

    return _load(Path(models_dir), config.pose_model, "pose", POSE_ORDER, config, build)


def _load(
    folder: Path,
    name: str,
    task: str,
    order: tuple[str, ...],
    config: PoseEstimatorConfig,
    build: Callable[[OnnxModel, ModelSpec], T],
) -> T:
    what = "person detector" if task == "detector" else "2D pose model"
    if not folder.is_dir():
        raise InputError(f"{folder}: expected a folder with a {what} (.onnx), found no such folder; {_FETCH}")
    if name != "auto":
        path = folder / (name if name.endswith(".onnx") else f"{name}.onnx")
        model = OnnxModel(path, config.threads, config.provider)
        spec = read_spec(model)
        if spec.task not in (task, "both"):
            raise InputError(f"{path}: expected a {what}, found a {spec.task} model ({spec.layout}); name another")
        return build(model, spec)
    refused: list[str] = []
    for path in sorted(folder.glob("*.onnx"), key=lambda p: _rank(p, order)):
        try:
            model = OnnxModel(path, config.threads, config.provider)
            spec = read_spec(model)
        except InputError as error:
            refused.append(str(error))
            continue
        if spec.task in (task, "both"):
            return build(model, spec)
    found = ", ".join(p.name for p in sorted(folder.glob("*.onnx"))) or "no .onnx file"
    why = f" ({refused[0]})" if refused else ""
    raise InputError(f"{folder}: expected a {what} (.onnx), found {found}{why}; {_FETCH}")


def _rank(path: Path, order: tuple[str, ...]) -> tuple[int, str]:
    name = path.name.lower()
    return next((i for i, part in enumerate(order) if part in name), len(order)), name
