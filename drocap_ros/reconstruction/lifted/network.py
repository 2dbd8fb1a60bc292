"""What a lifting network is to the rest of the package: the interface of :class:`Network`, its input and its result.

Another network is one file with a class of this interface and an entry in ``NETWORKS`` (:mod:`lifter`).  Features,
outputs and frame pairs are private to the class; :mod:`feature_network` is the shipped one's.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Protocol

import numpy as np

from drocap_ros.errors import InputError
from drocap_ros.geometry.rotations import exp_so3, log_so3
from drocap_ros.reconstruction.common.poses import Spread
from drocap_ros.reconstruction.common.windows import LIFTER_FPS
from drocap_ros.reconstruction.lifted.lifter_input import BONES, FEATURES, mirrored, normalise
from drocap_ros.skeleton import BODY_17

if TYPE_CHECKING:
    from onnxruntime import InferenceSession


@dataclass(frozen=True)
class LiftedMotion:
    """Result of the lifter.

    joints : (F, 17, 3) in the camera frame (x right, y down, z forward) and the unit of the keypoints; x and y
        in the image, outliers and gaps corrected; depth relative to the pelvis
    sigma : (F, 17, 2) expected absolute error of x, y (each) and of depth, in the same unit
    still : (F, 2) probability that the right and the left foot move slower than 0.1 m/s in the world
    """

    joints: np.ndarray
    sigma: np.ndarray
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


@dataclass(frozen=True)
class Errors:
    """True errors of a network's poses, measured on sequences that it was not trained on.

    adjusted : of poses about their pelvis, after the adjustment of a window
    newest : standard deviation over the expected absolute error, across and along the ray, of the newest image of a
        stream as lifted
    lasting : share of the keypoints' lasting noise in the errors across the ray, for keypoints without a covariance
    """

    adjusted: Spread
    newest: tuple[float, float]
    lasting: float


class Network(Protocol):
    """Lifts one window at the network's own frame rate.

    fps : frame rate of the training; slowest, fastest : other rates, in units of it, that are taken as they are
    window, overlap : most frames of one call, about those of a training window, and what neighbouring windows share
    """

    fps: float
    slowest: float
    fastest: float
    window: int
    overlap: int
    errors: Errors

    @property
    def origin(self) -> dict[str, str]:
        """Metadata: data, command, samples seen."""
        ...

    def lift(self, seen: LifterInput, *, newest: bool = False) -> LiftedMotion:
        """Joints of a window with confidences; with ``newest`` only the last frames have to be at their best.

        Some of the first frames may then be left out.
        """
        ...


_JOINTS = len(BODY_17)
#: Names of the outputs, and their shapes behind (windows, frames).
_OUTPUTS = {"joints": (_JOINTS, 3), "log_sigma": (_JOINTS, 2), "deeper": (len(BONES),), "still": (2,)}
#: ``deeper``, whether a bone's child lies behind its parent, only guides the training.
_USED = ["joints", "log_sigma", "still"]


class FeatureNetwork:
    """:class:`~drocap_ros.reconstruction.lifted.network.Network` of the features of :mod:`lifter_input`.

    Frame rates and windows are those of its training; the errors are measured on the HDM05 sequences of mocap/train,
    which are not among its training data.
    """

    fps, slowest, fastest = LIFTER_FPS, 0.7, 1.4
    window, overlap = 240, 80
    errors = Errors(adjusted=Spread(1.3, 1.2, size=0.024, lean=0.07), newest=(1.45, 2.2), lasting=1.2)

    def __init__(self, session: InferenceSession, path: str) -> None:
        """From an onnxruntime session; an ``InputError`` names the file where the network is another."""
        self._session = session
        inputs = [(i.name, i.shape[-1]) for i in session.get_inputs()]
        outputs: dict[str, tuple[int, ...]] = {o.name: () for o in session.get_outputs()}
        if inputs == [("features", FEATURES)] and list(outputs) == list(_OUTPUTS):
            found = session.run(None, {"features": np.zeros((1, 2, FEATURES), np.float32)})
            outputs = {name: values.shape[2:] for name, values in zip(outputs, found, strict=True)}
        if outputs != _OUTPUTS:
            raise InputError(
                f"{path}: expected a lifter (features {FEATURES} -> {_OUTPUTS}), got {inputs} -> {outputs};"
                " train one by python -m lab train-lifter"
            )

    @property
    def origin(self) -> dict[str, str]:
        """The network's metadata: data, command, samples seen."""
        return dict(self._session.get_modelmeta().custom_metadata_map)

    def lift(self, seen: LifterInput, *, newest: bool = False) -> LiftedMotion:
        """One window, averaged over its mirror image.

        The network takes pairs of frames; with ``newest`` the last frame has a partner, else the first one has.
        """
        confidence = np.ones(seen.keypoints.shape[:2]) if seen.confidence is None else seen.confidence
        features, centre, scale = normalise(
            seen.keypoints, confidence, seen.lengths, seen.covariance, seen.rotation, seen.focal
        )
        begin = 1 - len(features) % 2 if newest else 0
        frames = slice(begin, begin + len(features))
        variants = np.zeros((2, frames.stop + frames.stop % 2, FEATURES), np.float32)
        variants[0, frames] = features
        variants[1, frames] = mirrored(features)
        outputs = self._session.run(_USED, {"features": variants})
        joints, log_sigma, still = (values[:, frames].astype(np.float64) for values in outputs)
        place = 0.5 * (joints[0] + joints[1][:, BODY_17.mirror] * np.array([-1, 1, 1])) * scale
        place[..., :2] += centre[:, None]
        place[..., 2] -= place[:, :1, 2]
        sigma = 0.5 * scale * (np.exp(log_sigma[0]) + np.exp(log_sigma[1][:, BODY_17.mirror]))
        logit = 0.5 * (still[0] + still[1][:, ::-1])
        return LiftedMotion(place, sigma, still=1.0 / (1.0 + np.exp(-logit)))
