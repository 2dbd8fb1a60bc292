"""The lifter: 2D joints of a sequence of any length and frame rate to 3D joints, by a network in onnxruntime."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields, replace
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from drocap_ros.errors import InputError, first_line
from drocap_ros.reconstruction.lifted.network import Errors, FeatureNetwork, LiftedMotion, LifterInput, Network
from drocap_ros.skeleton import BODY_17, indices

if TYPE_CHECKING:
    from onnxruntime import InferenceSession

SHIPPED = Path(__file__).parents[2] / "data" / "lifter_cmu.onnx"

_JOINTS = len(BODY_17)
_ANKLES, _TOES = indices(BODY_17.joints, ("rankle", "lankle")), indices(BODY_17.joints, ("rtoe", "ltoe"))
#: Kinds of network by the name of their only input.
NETWORKS: dict[str, Callable[[InferenceSession, str], Network]] = {"features": FeatureNetwork}
#: Weights that give the end of the least-squares line through five values: 1 mm better than the last one alone.
_LINE = np.array([-0.2, 0.0, 0.2, 0.4, 0.6])


class Lifter:
    """A trained lifter; ``Lifter.load()`` gives the shipped one."""

    def __init__(self, network: Network) -> None:
        self.network = network

    @staticmethod
    def load(path: str | Path | None = None, *, quick: bool = False) -> Lifter:
        """Open an ONNX file made by ``python -m lab train-lifter`` (default: the shipped one).

        quick : its twin ``NAME_quick.onnx``, where there is one: by products of integers, in less than half of the
            time; a joint of a newest frame comes to lie 2 mm aside
        """
        file = Path(path or SHIPPED)
        if not file.is_file():
            raise InputError(f"{file}: no such file; expected an .onnx made by python -m lab train-lifter")
        twin = file.with_stem(f"{file.stem}_quick")
        file = twin if quick and twin.is_file() else file
        return _load(str(file.resolve()), file.stat().st_mtime_ns)

    @property
    def origin(self) -> dict[str, str]:
        """The network's metadata: data, command, samples seen."""
        return self.network.origin

    @property
    def fps(self) -> float:
        """Frame rate of the network; others are resampled."""
        return self.network.fps

    @property
    def errors(self) -> Errors:
        """Measured errors of the network's poses."""
        return self.network.errors

    def interleaved(self, fps: float) -> int:
        """Number of sequences as which the frames of a fast video are lifted."""
        return max(round(fps / self.network.fps), 1)

    def _pace(self, fps: float | None) -> float:
        fps = self.network.fps if fps is None else fps
        if not 1 <= fps <= 1000:
            raise InputError(f"fps: expected 1 to 1000 frames per second, got {fps!r}; check the time stamps")
        return fps / self.network.fps

    def lift(self, seen: LifterInput, fps: float | None = None) -> LiftedMotion:
        """Lift a sequence of evenly spaced frames at 1 to 1000 frames per second."""
        pace = self._pace(fps)
        seen = _checked(seen)
        if pace > self.network.fastest:
            return self._lift_fast(seen, round(pace))
        if pace < self.network.slowest and len(seen) > 1:
            factor = round(1 / pace)
            return self._lift_long(seen.spread(factor)).map(lambda values: values[::factor])
        return self._lift_long(seen)

    def lift_toes_apart(self, seen: LifterInput, fps: float | None = None) -> LiftedMotion:
        """As :meth:`lift`; the body is that without the toes, and the toes stand on its ankles.

        For toes that a 2D network drew: they are not where MoCap's are, which the network learned from.
        """
        every = self.lift(seen, fps)
        if not np.isfinite(seen.keypoints[:, _TOES]).any():
            return every
        keypoints = np.array(seen.keypoints, dtype=np.float64)
        keypoints[:, _TOES] = np.nan
        body = self.lift(replace(seen, keypoints=keypoints), fps)
        joints, sigma = body.joints.copy(), body.sigma.copy()
        joints[:, _TOES] = joints[:, _ANKLES] + every.joints[:, _TOES] - every.joints[:, _ANKLES]
        sigma[:, _TOES] = every.sigma[:, _TOES]
        return replace(every, joints=joints, sigma=sigma)

    def lift_last(self, seen: LifterInput, fps: float | None = None) -> LiftedMotion:
        """The newest frame of a short sequence: input as of :meth:`lift`, F = 1 in the result.

        The pose is the end of the straight line through the network's last five.
        """
        pace = self._pace(fps)
        seen = _checked(seen)
        if pace > self.network.fastest:
            stride = round(pace)
            seen = seen[(len(seen) - 1) % stride :: stride]
        elif pace < self.network.slowest and len(seen) > 1:
            seen = seen.spread(round(1 / pace))
        seen = seen[-self.network.window :]
        if not np.isfinite(seen.keypoints).any():
            raise InputError("keypoints: expected a seen joint among the last frames, got none; check the detector")
        lifted = self.network.lift(seen, newest=True)
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
        frames, length, overlap = len(seen), self.network.window, self.network.overlap
        if frames <= length:
            return self.network.lift(seen)
        total = np.zeros(frames)
        out: LiftedMotion | None = None
        for begin in range(0, max(frames - overlap, 1), length - overlap):
            window = slice(begin, min(begin + length, frames))
            there = np.arange(window.start, window.stop)
            fade = np.minimum(1.0, (there - begin + 1) / (overlap + 1)) if begin else np.ones(len(there))
            if window.stop < frames:
                fade = np.minimum(fade, (window.stop - there) / (overlap + 1))
            part = self.network.lift(seen[window])
            out = out or part.map(lambda values: np.zeros((frames, *values.shape[1:])))
            for field in fields(part):
                values = getattr(part, field.name)
                getattr(out, field.name)[window] += fade.reshape(-1, *(1,) * (values.ndim - 1)) * values
            total[window] += fade
        assert out is not None
        return out.map(lambda values: values / total.reshape(-1, *(1,) * (values.ndim - 1)))


def _checked(seen: LifterInput) -> LifterInput:
    keypoints = np.asarray(seen.keypoints, dtype=np.float64)
    if keypoints.ndim != 3 or keypoints.shape[1:] != (_JOINTS, 2) or len(keypoints) == 0:
        raise InputError(
            f"keypoints: expected (F, {_JOINTS}, 2) with F >= 1, got {keypoints.shape}; map the joints first"
        )
    keypoints = np.where(np.isfinite(keypoints).all(axis=-1, keepdims=True), keypoints, np.nan)
    if not np.isfinite(keypoints).any():
        raise InputError("keypoints: expected at least one seen joint, got none; check the detector's output")
    for name, values, shape in (
        ("confidence", seen.confidence, keypoints.shape[:2]),
        ("covariance", seen.covariance, (*keypoints.shape[:2], 3)),
        ("rotation", seen.rotation, (len(keypoints), 3, 3)),
        ("lengths", seen.lengths, (_JOINTS - 1,)),
    ):
        if values is not None and np.shape(values) != shape:
            raise InputError(f"{name}: expected {shape}, got {np.shape(values)}; one row per frame and joint")
    confidence = None if seen.confidence is None else np.clip(np.nan_to_num(seen.confidence), 0.0, 1.0)
    return replace(seen, keypoints=keypoints, confidence=confidence)


@lru_cache(maxsize=4)
def _load(path: str, written_ns: int) -> Lifter:  # noqa: ARG001 - a part of the cache's key
    """The file as it was written then."""
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    options.inter_op_num_threads = 1
    options.log_severity_level = 3
    try:
        session = onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])
        inputs = session.get_inputs()
        kind = NETWORKS.get(inputs[0].name if len(inputs) == 1 else "", FeatureNetwork)
        return Lifter(kind(session, path))
    except InputError:
        raise
    except Exception as error:  # noqa: BLE001 - of no common class
        raise InputError(f"{path}: expected an ONNX network; {first_line(error)[:120]}") from None
