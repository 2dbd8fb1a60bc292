"""The lifter: 2D joints of a sequence to 3D joints, by a small temporal network in onnxruntime."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from drocap_ros.errors import InputError
from drocap_ros.reconstruction.lifted.lifter_input import FEATURES, LIFTER_FPS, normalise
from drocap_ros.skeleton import BODY_15

SHIPPED = Path(__file__).parents[2] / "data" / "lifter_cmu.onnx"

_JOINTS = len(BODY_15)
#: Where the parts of the features begin: confidences, bone lengths, depth ranges.
_PARTS = np.cumsum([2 * _JOINTS, _JOINTS, _JOINTS - 1])
#: Frames of one window and overlap of neighbouring windows; about the length of the training windows.
_WINDOW, _OVERLAP = 240, 80
#: Frame rates, in units of LIFTER_FPS, of the network's training.
_SLOWEST, _FASTEST = 0.7, 1.4
#: Weights that give the end of the least-squares line through five values: 1 mm better than the last one alone.
_LINE = np.array([-0.2, 0.0, 0.2, 0.4, 0.6])


@dataclass(frozen=True)
class LiftedMotion:
    """Result of the lifter.

    joints : (F, 15, 3) in the camera frame (x right, y down, z forward) and the unit of the keypoints; x and y
        in the image, outliers and gaps corrected; depth relative to the pelvis
    sigma : (F, 15, 2) expected absolute error of x, y (each) and of depth, in the same unit
    """

    joints: np.ndarray
    sigma: np.ndarray


class Lifter:
    """A trained lifter; ``Lifter.load()`` gives the shipped one."""

    def __init__(self, session: Any) -> None:
        self._session = session

    @staticmethod
    def load(path: str | Path | None = None) -> Lifter:
        """Open an ONNX file made by ``drocap train-lifter`` (default: the shipped one).

        Raises
        ------
        InputError
            When the file is no such network.
        """
        return _load(str(path or SHIPPED))

    @property
    def origin(self) -> dict[str, str]:
        """The network's metadata: data, command, samples seen."""
        return dict(self._session.get_modelmeta().custom_metadata_map)

    def lift(
        self,
        keypoints: np.ndarray,
        confidence: np.ndarray | None = None,
        fps: float = LIFTER_FPS,
        lengths: np.ndarray | None = None,
    ) -> LiftedMotion:
        """Lift a sequence of evenly spaced frames.

        Parameters
        ----------
        keypoints : (F, 15, 2) of ``BODY_15``, any unit, y down; NaN where not seen
        confidence : (F, 15) in [0, 1]; None = all seen joints alike
        fps : frames per second, 1 to 1000
        lengths : (14,) of the bones (joint j to its parent at j - 1) in the keypoints' unit, where known

        Raises
        ------
        InputError
            On other shapes, or when no joint is ever seen.
        """
        keypoints, confidence = _checked(keypoints, confidence, fps)
        pace = fps / LIFTER_FPS
        if pace > _FASTEST:
            return self._lift_fast(keypoints, confidence, lengths, round(pace))
        if pace < _SLOWEST and len(keypoints) > 1:
            return self._lift_slow(keypoints, confidence, lengths, round(1 / pace))
        return self._lift_long(keypoints, confidence, lengths)

    def lift_last(
        self,
        keypoints: np.ndarray,
        confidence: np.ndarray | None = None,
        fps: float = LIFTER_FPS,
        lengths: np.ndarray | None = None,
    ) -> LiftedMotion:
        """The newest frame of a short sequence, in half the time: arguments as of :meth:`lift`, F = 1 in the result.

        Of the two ways of pairing frames it uses the one in which the last frame has no partner.  The pose is the end
        of the straight line through the network's last five.
        """
        keypoints, confidence = _checked(keypoints, confidence, fps)
        pace = fps / LIFTER_FPS
        if pace > _FASTEST:
            keypoints, confidence = (values[::-1][:: round(pace)][::-1] for values in (keypoints, confidence))
        elif pace < _SLOWEST and len(keypoints) > 1:
            factor = round(1 / pace)
            keypoints, confidence = _between(keypoints, factor), _between(confidence, factor)
        keypoints, confidence = keypoints[-_WINDOW:], confidence[-_WINDOW:]
        if not np.isfinite(keypoints).any():
            raise InputError("keypoints: expected a seen joint among the last frames, got none; check the detector")
        joints, sigma = self._lift_window(keypoints, confidence, lengths, shifts=(1 - len(keypoints) % 2,))
        if len(joints) >= len(_LINE):
            joints = np.tensordot(_LINE, joints[-len(_LINE) :], axes=1)[None]
        return LiftedMotion(joints[-1:], sigma[-1:])

    def _lift_fast(
        self, keypoints: np.ndarray, confidence: np.ndarray, lengths: np.ndarray | None, stride: int
    ) -> LiftedMotion:
        """Every ``stride``-th frame is a separate sequence: no frame is interpolated."""
        joints = np.empty((*keypoints.shape[:2], 3))
        sigma = np.empty((*keypoints.shape[:2], 2))
        for phase in range(min(stride, len(keypoints))):
            part = self._lift_long(keypoints[phase::stride], confidence[phase::stride], lengths)
            joints[phase::stride], sigma[phase::stride] = part.joints, part.sigma
        return LiftedMotion(joints, sigma)

    def _lift_slow(
        self, keypoints: np.ndarray, confidence: np.ndarray, lengths: np.ndarray | None, factor: int
    ) -> LiftedMotion:
        """Lifts with interpolated frames between the real ones, and returns the real ones."""
        dense = _between(keypoints, factor)
        result = self._lift_long(dense, _between(confidence, factor), lengths)
        return LiftedMotion(result.joints[::factor], result.sigma[::factor])

    def _lift_long(self, keypoints: np.ndarray, confidence: np.ndarray, lengths: np.ndarray | None) -> LiftedMotion:
        """Windows that overlap and fade into each other: linear time, bounded memory."""
        frames = len(keypoints)
        joints = np.zeros((frames, _JOINTS, 3))
        sigma = np.zeros((frames, _JOINTS, 2))
        total = np.zeros(frames)
        hop = _WINDOW - _OVERLAP
        for begin in range(0, max(frames - _OVERLAP, 1), hop):
            window = slice(begin, min(begin + _WINDOW, frames))
            there = np.arange(window.start, window.stop)
            fade = np.minimum(1.0, (there - begin + 1) / (_OVERLAP + 1)) if begin else np.ones(len(there))
            if window.stop < frames:
                fade = np.minimum(fade, (window.stop - there) / (_OVERLAP + 1))
            part_joints, part_sigma = self._lift_window(keypoints[window], confidence[window], lengths)
            joints[window] += fade[:, None, None] * part_joints
            sigma[window] += fade[:, None, None] * part_sigma
            total[window] += fade
        return LiftedMotion(joints / total[:, None, None], sigma / total[:, None, None])

    def _lift_window(
        self,
        keypoints: np.ndarray,
        confidence: np.ndarray,
        lengths: np.ndarray | None,
        shifts: tuple[int, ...] = (0, 1),
    ) -> tuple[np.ndarray, np.ndarray]:
        """One window, averaged over its mirror image and over the ways of pairing frames."""
        features, centre, scale = normalise(keypoints, confidence, lengths)
        frames = len(features)
        length = frames + 2 - frames % 2
        count = len(shifts)
        variants = np.zeros((2 * count, length, FEATURES), np.float32)
        mirrored = _mirrored(features)
        for i, shift in enumerate(shifts):
            variants[i, shift : shift + frames] = features
            variants[count + i, shift : shift + frames] = mirrored
        joints, log_sigma = self._session.run(None, {"features": variants})
        joints[count:] = joints[count:, :, BODY_15.mirror] * np.array([-1, 1, 1], np.float32)
        log_sigma[count:] = log_sigma[count:, :, BODY_15.mirror]
        each = list(enumerate((*shifts, *shifts)))
        mean = np.mean([joints[k, s : s + frames] for k, s in each], axis=0, dtype=np.float64)
        spread = np.mean([np.exp(log_sigma[k, s : s + frames]) for k, s in each], axis=0, dtype=np.float64)
        mean *= scale
        mean[..., :2] += centre[:, None]
        mean[..., 2] -= mean[:, :1, 2]
        return mean, spread * scale


def _between(values: np.ndarray, factor: int) -> np.ndarray:
    """(F, ...) with ``factor - 1`` interpolated frames between neighbours; the real ones are unchanged."""
    share = (np.arange(factor) / factor).reshape(1, -1, *(1,) * (values.ndim - 1))
    dense = values[:-1, None] * (1 - share) + values[1:, None] * share
    dense = np.concatenate([dense.reshape(-1, *values.shape[1:]), values[-1:]])
    dense[::factor] = values
    return dense


def _mirrored(features: np.ndarray) -> np.ndarray:
    """Features (F, 73) of the scene seen in a mirror: x negated, left and right exchanged."""
    xy, weight, length, reach = np.split(features, _PARTS, axis=1)
    xy = xy.reshape(-1, _JOINTS, 2)[:, BODY_15.mirror] * np.array([-1, 1], np.float32)
    bones = BODY_15.mirror[1:] - 1
    return np.concatenate(
        [xy.reshape(len(features), -1), weight[:, BODY_15.mirror], length[:, bones], reach[:, bones]], axis=1
    )


def _checked(keypoints: np.ndarray, confidence: np.ndarray | None, fps: float) -> tuple[np.ndarray, np.ndarray]:
    keypoints = np.asarray(keypoints, dtype=np.float64)
    if keypoints.ndim != 3 or keypoints.shape[1:] != (_JOINTS, 2) or len(keypoints) == 0:
        raise InputError(
            f"keypoints: expected (F, {_JOINTS}, 2) with F >= 1, got {keypoints.shape}; map the joints first"
        )
    if not 1 <= fps <= 1000:
        raise InputError(f"fps: expected 1 to 1000 frames per second, got {fps!r}; check the time stamps")
    keypoints = np.where(np.isfinite(keypoints).all(axis=-1, keepdims=True), keypoints, np.nan)
    if not np.isfinite(keypoints).any():
        raise InputError("keypoints: expected at least one seen joint, got none; check the detector's output")
    if confidence is None:
        return keypoints, np.ones(keypoints.shape[:2])
    confidence = np.asarray(confidence, dtype=np.float64)
    if confidence.shape != keypoints.shape[:2]:
        raise InputError(f"confidence: expected {keypoints.shape[:2]}, got {confidence.shape}; one per keypoint")
    return keypoints, np.clip(np.nan_to_num(confidence), 0.0, 1.0)


@lru_cache(maxsize=4)
def _load(path: str) -> Lifter:
    import onnxruntime

    if not Path(path).is_file():
        raise InputError(f"{path}: no such file; expected an .onnx made by drocap train-lifter")
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    options.inter_op_num_threads = 1
    options.log_severity_level = 3
    try:
        session = onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])
    except Exception as error:
        # onnxruntime documents no common exception class.
        raise InputError(f"{path}: expected an ONNX network; {str(error).splitlines()[0][:120]}") from None
    inputs = [(i.name, i.shape[-1]) for i in session.get_inputs()]
    outputs = [o.name for o in session.get_outputs()]
    if inputs != [("features", FEATURES)] or outputs != ["joints", "log_sigma"]:
        raise InputError(f"{path}: expected a lifter (features -> joints, log_sigma), got {inputs} -> {outputs}")
    return Lifter(session)
