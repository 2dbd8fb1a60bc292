"""Motion capture files: one take per ``.npz``, read as joints of ``BODY_17`` or ``BODY_15``."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from drocap_ros.errors import InputError
from drocap_ros.skeleton import BODY_15, JointSet, in_body_order
from drocap_ros.tracks import read_npz


def load_mocap(
    path: Path, required: tuple[str, ...] = BODY_15.joints, joints: JointSet = BODY_15
) -> tuple[np.ndarray, float]:
    """Joints (T, P, 3) mm, world z up, and frames per second of one MoCap ``.npz``.

    Toes are further joints of ``X``, or the array ``toes`` (T, 2, 3) with their names in ``toe_joints``.  Where
    ``toe_kind`` is "ball", the array holds the balls of the feet, which are no joints of the body.

    Parameters
    ----------
    required : joints that the file must hold; others that it lacks are NaN
    joints : ``BODY_15`` or ``BODY_17``, those of the result
    """
    a = read_npz(path, ("X", "fps", "joints"))
    try:
        x, names = _named_joints(a)
        fps = a["fps"]
        if fps.size != 1 or fps.dtype.kind not in "iuf" or not 1.0 <= float(fps.item()) <= 1000.0:
            raise InputError(f"fps: expected a number from 1 to 1000, got {fps}")
        body = in_body_order(x, names, required)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    return body[:, : len(joints)], float(fps.item())


def _named_joints(a: dict[str, np.ndarray]) -> tuple[np.ndarray, list[str]]:
    """Joints (T, P, 3) mm of a file with its toes, and their names (P)."""
    x, names = a["X"], [str(j) for j in a["joints"]]
    if x.ndim != 3 or x.shape[1:] != (a["joints"].size, 3) or len(x) == 0:
        raise InputError(f"X: expected (T, {a['joints'].size}, 3), got {x.shape}")
    if "toes" in a and str(a.get("toe_kind", "tip")) == "tip":
        toes = [str(j) for j in np.atleast_1d(a.get("toe_joints", ("rtoe", "ltoe")))]
        if a["toes"].shape != (len(x), len(toes), 3):
            raise InputError(f"toes: expected {(len(x), len(toes), 3)}, got {a['toes'].shape}")
        x, names = np.concatenate([x, a["toes"]], axis=1), [*names, *toes]
    x = x.astype(np.float64)
    if not np.isfinite(x).all():
        raise InputError("X, toes: expected finite millimetres, got NaN or infinity; fill the gaps in")
    return x, names
