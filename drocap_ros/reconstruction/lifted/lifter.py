"""The lifter: 2D joints of a sequence to 3D joints, by a small temporal network in onnxruntime."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from drocap_ros.errors import InputError
from drocap_ros.geometry.rotations import exp_so3, log_so3
from drocap_ros.reconstruction.lifted.lifter_input import BONES, FEATURES, LIFTER_FPS, mirrored, normalise
from drocap_ros.skeleton import BODY_17

SHIPPED = Path(__file__).parents[2] / "data" / "lifter_cmu.onnx"

_JOINTS = len(BODY_17)
#: Names of the outputs, and their shapes behind (windows, frames).
_OUTPUTS = {"joints": (_JOINTS, 3), "log_sigma": (_JOINTS, 2), "deeper": (len(BONES),), "still": (2,)}
#: Frames of one window and overlap of neighbouring windows; about the length of the training windows.
_WINDOW, _OVERLAP = 240, 80
#: Frame rates, in units of LIFTER_FPS, of the network's training.
_SLOWEST, _FASTEST = 0.7, 1.4
#: Weights that give the end of the least-squares line through five values: 1 mm better than the last one alone.
_LINE = np.array([-0.2, 0.0, 0.2, 0.4, 0.6])


@dataclass(frozen=True)
class LiftedMotion:
    """Result of the lifter.

    joints : (F, 17, 3) in the camera frame (x right, y down, z forward) and the unit of the keypoints; x and y
        in the image, outliers and gaps corrected; depth relative to the pelvis
    sigma : (F, 17, 2) expected absolute error of x, y (each) and of depth, in the same unit
    deeper : (F, 16) probability that the child of bone j - 1 (joint j) lies behind its parent
    still : (F, 2) probability that the right and the left foot move slower than 0.1 m/s in the world
    """

    joints: np.ndarray
    sigma: np.ndarray
    deeper: np.ndarray
    still: np.ndarray

    def map(self, change: Callable[[np.ndarray], np.ndarray]) -> LiftedMotion:
        """The result with the same change of every array."""
        return LiftedMotion(*(change(getattr(self, field.name)) for field in fields(self)))


@dataclass(frozen=True)
class LifterInput:
    """Evenly spaced frames as the lifter takes them.

    keypoints : (F, 17, 2) of ``BODY_17``, any unit, y down; NaN where not seen
    confidence : (F, 17) in [0, 1]; None = all seen joints alike
    lengths : (16,) of the bones (joint j to its parent at j - 1) in the keypoints' unit, where known
    covariance : (F, 17, 3) xx, xy, yy of the keypoints in their unit squared, where known
    rotation : (F, 3, 3) world (z up) -> camera (x right, y down, z forward), where known
    focal : focal length in the keypoints' unit, infinite for a distant camera; None = unknown
    """

    keypoints: np.ndarray
    confidence: np.ndarray | None = None
    lengths: np.ndarray | None = None
    covariance: np.ndarray | None = None
    rotation: np.ndarray | None = None
    focal: float | None = None

    def __len__(self) -> int:
        return len(self.keypoints)

    def __getitem__(self, frames: slice) -> LifterInput:
        """Some of the frames."""
        return self._over_time(lambda values: values[frames])

    def _over_time(self, change: Callable[[np.ndarray], np.ndarray]) -> LifterInput:
        def maybe(values: np.ndarray | None) -> np.ndarray | None:
            return None if values is None else change(values)

        return replace(
            self,
            keypoints=change(self.keypoints),
            confidence=maybe(self.confidence),
            covariance=maybe(self.covariance),
            rotation=maybe(self.rotation),
        )

    def spread(self, factor: int) -> LifterInput:
        """``factor - 1`` frames without a seen joint after each frame but the last; the camera turns evenly."""

        def apart(values: np.ndarray) -> np.ndarray:
            out = np.full(((len(values) - 1) * factor + 1, *values.shape[1:]), np.nan)
            out[::factor] = values
            return out

        out = self._over_time(apart)
        if self.rotation is None:
            return out
        before, after = self.rotation[:-1], self.rotation[1:]
        turn = log_so3(after @ np.swapaxes(before, -1, -2))
        share = np.arange(factor).reshape(1, -1, 1) / factor
        dense = exp_so3(share * turn[:, None]) @ before[:, None]
        return replace(out, rotation=np.concatenate([dense.reshape(-1, 3, 3), self.rotation[-1:]]))


class Lifter:
    """A trained lifter; ``Lifter.load()`` gives the shipped one."""

    def __init__(self, session: Any) -> None:
        self._session = session

    @staticmethod
    def load(path: str | Path | None = None) -> Lifter:
        """Open an ONNX file made by ``python -m lab train-lifter`` (default: the shipped one).

        Raises
        ------
        InputError
            When the file is no such network.
        """
        file = Path(path or SHIPPED)
        if not file.is_file():
            raise InputError(f"{file}: no such file; expected an .onnx made by python -m lab train-lifter")
        return _load(str(file.resolve()), file.stat().st_mtime_ns)

    @property
    def origin(self) -> dict[str, str]:
        """The network's metadata: data, command, samples seen."""
        return dict(self._session.get_modelmeta().custom_metadata_map)

    def lift(self, seen: LifterInput, fps: float = LIFTER_FPS) -> LiftedMotion:
        """Lift a sequence of evenly spaced frames at 1 to 1000 frames per second.

        Raises
        ------
        InputError
            On other shapes, or when no joint is ever seen.
        """
        seen = _checked(seen, fps)
        pace = fps / LIFTER_FPS
        if pace > _FASTEST:
            return self._lift_fast(seen, round(pace))
        if pace < _SLOWEST and len(seen) > 1:
            factor = round(1 / pace)
            return self._lift_long(seen.spread(factor)).map(lambda values: values[::factor])
        return self._lift_long(seen)

    def lift_last(self, seen: LifterInput, fps: float = LIFTER_FPS) -> LiftedMotion:
        """The newest frame of a short sequence: input as of :meth:`lift`, F = 1 in the result.

        The pose is the end of the straight line through the network's last five.
        """
        seen = _checked(seen, fps)
        pace = fps / LIFTER_FPS
        if pace > _FASTEST:
            stride = round(pace)
            seen = seen[(len(seen) - 1) % stride :: stride]
        elif pace < _SLOWEST and len(seen) > 1:
            seen = seen.spread(round(1 / pace))
        seen = seen[-_WINDOW:]
        if not np.isfinite(seen.keypoints).any():
            raise InputError("keypoints: expected a seen joint among the last frames, got none; check the detector")
        lifted = self._lift_window(seen, begin=1 - len(seen) % 2)
        joints = lifted.joints
        if len(joints) >= len(_LINE):
            joints = np.tensordot(_LINE, joints[-len(_LINE) :], axes=1)[None]
        return replace(lifted.map(lambda values: values[-1:]), joints=joints[-1:])

    def _lift_fast(self, seen: LifterInput, stride: int) -> LiftedMotion:
        """Every ``stride``-th frame is a separate sequence: no frame is interpolated."""
        parts = [self._lift_long(seen[phase::stride]) for phase in range(min(stride, len(seen)))]
        out = parts[0].map(lambda values: np.empty((len(seen), *values.shape[1:])))
        for phase, part in enumerate(parts):
            for field in fields(part):
                getattr(out, field.name)[phase::stride] = getattr(part, field.name)
        return out

    def _lift_long(self, seen: LifterInput) -> LiftedMotion:
        """Windows that overlap and fade into each other: linear time, bounded memory."""
        frames = len(seen)
        if frames <= _WINDOW:
            return self._lift_window(seen)
        total = np.zeros(frames)
        out: LiftedMotion | None = None
        hop = _WINDOW - _OVERLAP
        for begin in range(0, max(frames - _OVERLAP, 1), hop):
            window = slice(begin, min(begin + _WINDOW, frames))
            there = np.arange(window.start, window.stop)
            fade = np.minimum(1.0, (there - begin + 1) / (_OVERLAP + 1)) if begin else np.ones(len(there))
            if window.stop < frames:
                fade = np.minimum(fade, (window.stop - there) / (_OVERLAP + 1))
            part = self._lift_window(seen[window])
            out = out or part.map(lambda values: np.zeros((frames, *values.shape[1:])))
            for field in fields(part):
                values = getattr(part, field.name)
                getattr(out, field.name)[window] += fade.reshape(-1, *(1,) * (values.ndim - 1)) * values
            total[window] += fade
        assert out is not None
        return out.map(lambda values: values / total.reshape(-1, *(1,) * (values.ndim - 1)))

    def _lift_window(self, seen: LifterInput, begin: int = 0) -> LiftedMotion:
        """One window, averaged over its mirror image.

        The network takes pairs of frames; with ``begin`` 1 the first frame has no partner, of an even number the last
        one neither.
        """
        confidence = np.ones(seen.keypoints.shape[:2]) if seen.confidence is None else seen.confidence
        features, centre, scale = normalise(
            seen.keypoints, confidence, seen.lengths, seen.covariance, seen.rotation, seen.focal
        )
        frames = slice(begin, begin + len(features))
        variants = np.zeros((2, frames.stop + frames.stop % 2, FEATURES), np.float32)
        variants[0, frames] = features
        variants[1, frames] = mirrored(features)
        outputs = self._session.run(list(_OUTPUTS), {"features": variants})
        joints, log_sigma, deeper, still = (values[:, frames].astype(np.float64) for values in outputs)
        place = 0.5 * (joints[0] + joints[1][:, BODY_17.mirror] * np.array([-1, 1, 1])) * scale
        place[..., :2] += centre[:, None]
        place[..., 2] -= place[:, :1, 2]
        sigma = 0.5 * scale * (np.exp(log_sigma[0]) + np.exp(log_sigma[1][:, BODY_17.mirror]))
        return LiftedMotion(
            place,
            sigma,
            _logistic(0.5 * (deeper[0] + deeper[1][:, BODY_17.mirror[1:] - 1])),
            _logistic(0.5 * (still[0] + still[1][:, ::-1])),
        )


def _logistic(logit: np.ndarray) -> np.ndarray:
    probability: np.ndarray = np.asarray(1.0 / (1.0 + np.exp(-logit)))
    return probability


def _checked(seen: LifterInput, fps: float) -> LifterInput:
    keypoints = np.asarray(seen.keypoints, dtype=np.float64)
    if keypoints.ndim != 3 or keypoints.shape[1:] != (_JOINTS, 2) or len(keypoints) == 0:
        raise InputError(
            f"keypoints: expected (F, {_JOINTS}, 2) with F >= 1, got {keypoints.shape}; map the joints first"
        )
    if not 1 <= fps <= 1000:
        raise InputError(f"fps: expected 1 to 1000 frames per second, got {fps!r}; check the time stamps")
    keypoints = np.where(np.isfinite(keypoints).all(axis=-1, keepdims=True), keypoints, np.nan)
    if not np.isfinite(keypoints).any():
        raise InputError("keypoints: expected at least one seen joint, got none; check the detector's output")
    for name, values, shape in (
        ("confidence", seen.confidence, keypoints.shape[:2]),
        ("covariance", seen.covariance, (*keypoints.shape[:2], 3)),
        ("rotation", seen.rotation, (len(keypoints), 3, 3)),
        ("lengths", seen.lengths, (len(BONES),)),
    ):
        if values is not None and np.shape(values) != shape:
            raise InputError(f"{name}: expected {shape}, got {np.shape(values)}; one row per frame and joint")
    confidence = None if seen.confidence is None else np.clip(np.nan_to_num(seen.confidence), 0.0, 1.0)
    return replace(seen, keypoints=keypoints, confidence=confidence)


@lru_cache(maxsize=4)
def _load(path: str, written_ns: int) -> Lifter:
    """The file as it was written then."""
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    options.inter_op_num_threads = 1
    options.log_severity_level = 3
    try:
        session = onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])
        inputs = [(i.name, i.shape[-1]) for i in session.get_inputs()]
        outputs = {o.name: () for o in session.get_outputs()}
        if inputs == [("features", FEATURES)] and list(outputs) == list(_OUTPUTS):
            found = session.run(None, {"features": np.zeros((1, 2, FEATURES), np.float32)})
            outputs = {name: values.shape[2:] for name, values in zip(outputs, found, strict=True)}
    except Exception as error:
        # onnxruntime documents no common exception class.
        raise InputError(f"{path}: expected an ONNX network; {str(error).splitlines()[0][:120]}") from None
    if outputs != _OUTPUTS:
        raise InputError(
            f"{path}: expected a lifter (features {FEATURES} -> {_OUTPUTS}), got {inputs} -> {outputs};"
            " train one by python -m lab train-lifter"
        )
    return Lifter(session)
