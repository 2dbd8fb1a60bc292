"""What tracks say of the joints of the body: keypoints, and evidence of their depth."""

from __future__ import annotations

import numpy as np

from drocap_ros.errors import InputError
from drocap_ros.keypoints import Keypoints2D
from drocap_ros.reconstruction.common.poses import Evidence
from drocap_ros.reconstruction.paper.normalize import MIN_JOINTS
from drocap_ros.skeleton import BODY_15, BODY_17, TABLES, JointSet, body_set, joint_map, joint_set_of
from drocap_ros.tracks import Tracks


def body_keypoints(tracks: Tracks, joints: JointSet = BODY_17) -> Keypoints2D:
    """Keypoints in the order of ``joints``, a body set; those that the tracks lack are NaN.

    Names of the body sets, COCO, COCO-WholeBody, Halpe, MPII and Human3.6M are known (:mod:`drocap_ros.skeleton`).
    """
    source, place = joint_set_of(tracks.joints)
    have = place >= 0
    names = tuple(np.array(source.joints)[have])
    given = sum(set(parts) <= set(names) for parts in TABLES[source.name].values())
    if given < MIN_JOINTS:
        raise InputError(
            f"joints: expected at least {MIN_JOINTS} of {', '.join(BODY_15.joints)}, or names of"
            f" {', '.join(list(TABLES)[3:])}, got {given} of them; rename the joints"
        )
    shape = (len(tracks), len(source))
    keypoints, confidence, covariance = np.full((*shape, 2), np.nan), np.zeros(shape), np.full((*shape, 3), np.nan)
    keypoints[:, have] = tracks.keypoints[:, place[have]]
    keypoints[np.isnan(keypoints).any(-1)] = np.nan
    if tracks.covariance is not None:
        covariance[:, have] = tracks.covariance[:, place[have]]
    seen = np.isfinite(keypoints).all(-1)
    confidence[:, have] = tracks.confidence[:, place[have]] if tracks.confidence is not None else seen[:, have]
    if not body_set(source):
        high, low = (np.where(seen[..., None], keypoints, end) for end in (-np.inf, np.inf))
        extent = np.where(seen.any(1), (high.max(1) - low.min(1)).max(1), 0.0)
        keypoints, covariance, confidence = joint_map(source.name).apply(keypoints, covariance, confidence, extent)
    elif tracks.confidence is None and tracks.covariance is None:
        return Keypoints2D(keypoints, None, None).with_joints(len(joints))
    found = Keypoints2D(keypoints, confidence, covariance if tracks.covariance is not None else None)
    return found.with_joints(len(joints))


def body_evidence(tracks: Tracks, count: int) -> Evidence | None:
    """The tracks' 3D estimates for the first ``count`` joints of the body; None where there are none."""
    if tracks.evidence is None:
        return None
    source, place = joint_set_of(tracks.joints)
    sigma = np.full(tracks.keypoints.shape[:2], np.nan) if tracks.evidence_sigma is None else tracks.evidence_sigma
    values = np.concatenate([tracks.evidence, sigma[..., None]], axis=-1)
    given = np.where((place >= 0)[:, None], values[:, np.maximum(place, 0)], np.nan)
    weights = joint_map(source.name).weights
    known = ~((weights != 0) & ~np.isfinite(given[:, None, :, 0])).any(axis=-1, keepdims=True)
    mapped = np.where(known, weights @ np.nan_to_num(given), np.nan)
    mapped[..., 3] = np.where(mapped[..., 3] > 0, mapped[..., 3], np.nan)
    body = np.full((len(tracks), count, 4), np.nan)
    body[:, : min(count, mapped.shape[1])] = mapped[:, :count]
    return Evidence(body[..., :3], body[..., 3])
