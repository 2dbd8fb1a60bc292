"""The shipped network, made by training in the laboratory: 143 features of a frame in, four outputs out."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from drocap_ros.errors import InputError
from drocap_ros.reconstruction.common.spread import Spread
from drocap_ros.reconstruction.lifted.lifter_input import BONES, FEATURES, LIFTER_FPS, mirrored, normalise
from drocap_ros.reconstruction.lifted.network import Errors, LiftedMotion, LifterInput
from drocap_ros.skeleton import BODY_17

if TYPE_CHECKING:
    from onnxruntime import InferenceSession

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
