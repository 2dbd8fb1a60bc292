"""The windowed core that the live nodes and the offline command share.

:class:`SlidingWindowInitializer` turns one image's keypoints at a time into a pose (causal, bounded memory);
:func:`adjust_window` refines the poses of a window.  Both speak px in, metres in camera axes out.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace

import numpy as np

from drocap_ros.errors import InputError
from drocap_ros.geometry.alignment import to_torso_frame, torso_frame
from drocap_ros.geometry.rotations import matrix_from_quaternion, quaternion_from_matrix, slerp
from drocap_ros.reconstruction.lifted.lifter import Lifter
from drocap_ros.reconstruction.live.lifted_initializer import LiftedStart
from drocap_ros.reconstruction.live.stream_order import Arrival, StreamOrder
from drocap_ros.reconstruction.metrics import limb_lengths
from drocap_ros.reconstruction.paper.bundle_adjustment import bundle_adjust
from drocap_ros.reconstruction.paper.dictionary import REFERENCE_STATURE_M, Dictionary, load_dictionary
from drocap_ros.reconstruction.paper.expectation import GaussianJoints
from drocap_ros.reconstruction.paper.normalize import MIN_JOINTS, NormalizedTracks, check_uncertainty, normalize_tracks
from drocap_ros.reconstruction.paper.pose_covariance import packed_covariance, pose_covariance
from drocap_ros.reconstruction.paper.reprojection import Projection, frames_first, frames_last
from drocap_ros.reconstruction.paper.single_view import sparse_from_dense
from drocap_ros.reconstruction.paper.sparse_fit import fit_sparse
from drocap_ros.reconstruction.paper.viewpoint_search import DenseFit, fit_dense, image_scale, viewpoint_starts
from drocap_ros.reconstruction.reconstruction_config import BundleAdjusterConfig, InitializerConfig
from drocap_ros.reconstruction.threads import blas_threads
from drocap_ros.skeleton import BODY_15

#: Images over which the live start from the dictionary remembers the person's size.
MEMORY = 120

#: Least standard deviations of an adjusted pose, in units of the 2D joints: across the image, along the ray.
ACROSS_STD, DEPTH_STD = 0.02, 0.22

#: Standard deviation of 2D joints about a start from the dictionary, in their unit.
START_STD = 0.1

#: Windows of fewer frames hold no second view worth adjusting to.
MIN_WINDOW = 4


@dataclass(frozen=True)
class InitialPose:
    """Pose of one image.

    joints3d : (15, 3) m, camera axes, pelvis at the origin; NaN when the image shows too little
    covariance : (15, 6) m^2, xx xy xz yy yz zz
    confidence : (15,) in [0, 1], 0 where the joint was not seen and the model filled it in
    """

    stamp_ns: int
    joints3d: np.ndarray
    covariance: np.ndarray
    confidence: np.ndarray
    reprojection_rms_px: float

    @property
    def rotation(self) -> np.ndarray:
        """(3, 3) torso -> camera; NaN when the image shows too little."""
        return torso_frame(self.joints3d) if np.isfinite(self.joints3d).all() else np.full((3, 3), np.nan)


@dataclass(frozen=True)
class AdjustedWindow:
    """Poses of a window: joints3d (F, 15, 3) m and covariance (F, 15, 6) m^2 in camera axes, pelvis at the origin."""

    stamp_ns: np.ndarray
    joints3d: np.ndarray
    covariance: np.ndarray
    confidence: np.ndarray
    reprojection_rms_px: np.ndarray
    iterations: int
    cost: float
    stop_reason: str
    cost_terms: dict[str, float]


class SlidingWindowInitializer:
    """Single-view initialization as the images come: warm-started, causal, bounded memory.

    ``config.live_start`` "lifter": the learned lifter sees the last ``past_s`` (:mod:`lifted_start`).  "dictionary":
    the hypotheses of the last image stay alive: their summed costs decide, so one ambiguous image does not flip
    the body.

    ``arrival`` says what the last image was to the stream (:mod:`stream_order`): duplicates, late images and stray
    stamps are dropped; another subject or a jump of time starts anew; a gap forgets all but the person's size.
    """

    def __init__(self, config: InitializerConfig | None = None, dictionary: Dictionary | None = None) -> None:
        self.config = config or InitializerConfig()
        # The start is warm and alone: two alternations take it where a batch from scratch needs six.
        self._refining = replace(self.config, sparse_rounds=min(self.config.sparse_rounds, 2))
        self.dictionary = dictionary or load_dictionary(self.config.dictionary or None)
        self._lifted: LiftedStart | None = None
        if self.config.live_start == "lifter":
            lifter = Lifter.load(self.config.lifter or None)
            self._lifted = LiftedStart(lifter, self.config.past_s, self.config.assumed_height_m)
        self._order = StreamOrder(self.config.late_s, self.config.gap_s)
        self.arrival = Arrival.STARTED
        self._forget_person()

    def reset(self) -> None:
        """Forget the stream and the subject."""
        self._order.reset()
        self._forget_person()

    def _forget_person(self) -> None:
        if self._lifted is not None:
            self._lifted.forget_person()
        self._spread: deque[tuple[float, int]] = deque(maxlen=MEMORY)
        self._metre_px: deque[float] = deque(maxlen=MEMORY)
        self._unit_px = 1.0
        self._forget_motion()

    def _forget_motion(self) -> None:
        if self._lifted is not None:
            self._lifted.forget_motion()
        self._alive: DenseFit | None = None
        self._total = np.zeros(0)

    def push(
        self,
        stamp_ns: int,
        keypoints: np.ndarray,
        confidence: np.ndarray | None = None,
        covariance: np.ndarray | None = None,
        track_id: int = 1,
    ) -> InitialPose | None:
        """Pose of the next image, or None when the image is dropped; ``arrival`` says why.

        Parameters
        ----------
        keypoints : (15, 2) px, NaN where not seen
        confidence : (15,) in [0, 1], or None
        covariance : (15, 3) px^2; None, or NaN at every joint, when it is not known
        track_id : the subject's

        Raises
        ------
        InputError
            When an array has a wrong shape or an impossible value.
        """
        confidence = np.isfinite(keypoints).all(-1).astype(float) if confidence is None else confidence
        _check_image(keypoints, confidence, covariance)
        if covariance is not None and np.isnan(covariance).all():
            covariance = None
        self.arrival = self._order.accept(stamp_ns, track_id)
        if self.arrival.dropped:
            return None
        if self.arrival.anew:
            self._forget_person()
        elif self.arrival is Arrival.GAP:
            self._forget_motion()
        seen = np.isfinite(keypoints).all(-1) & (np.nan_to_num(confidence) > 0.0)
        extent = np.ptp(keypoints[seen], axis=0).max() if seen.any() else 0.0
        if seen.sum() < MIN_JOINTS or not extent > 1e-3:
            return _unknown(stamp_ns)
        if self._lifted is not None:
            return self._lift(self._lifted, stamp_ns, keypoints, confidence, covariance, seen)
        n = self._normalize(keypoints, confidence, covariance, seen)
        information = n.information
        scale = self._scale(n, information)
        with blas_threads(1):
            dense = self._fit(n.w, information, scale)
            best = self._decide(dense)
            self._metre_px.append(float(dense.coefficients[best, 0]) * n.scale_px)
            return self._result(stamp_ns, n, information, dense, best, np.where(seen, np.nan_to_num(confidence), 0.0))

    def _lift(
        self,
        start: LiftedStart,
        stamp_ns: int,
        keypoints: np.ndarray,
        confidence: np.ndarray,
        covariance: np.ndarray | None,
        seen: np.ndarray,
    ) -> InitialPose:
        check_uncertainty(confidence, covariance, seen)
        belief = np.where(seen, np.nan_to_num(confidence), 0.0)
        points = np.where(seen[:, None], keypoints, np.nan)
        joints, std, metres = start.push(stamp_ns, points, belief)
        gap = joints[seen, :2] - keypoints[seen]
        spread = np.zeros((len(BODY_15), 6))
        spread[:, [0, 3, 5]] = std[:, [0, 0, 1]] ** 2
        return InitialPose(
            stamp_ns=stamp_ns,
            joints3d=(joints - joints[BODY_15.index("pelvis")]) * metres,
            covariance=spread * metres**2,
            confidence=belief,
            reprojection_rms_px=float(np.sqrt(np.mean(np.sum(gap**2, axis=-1)))),
        )

    def _normalize(
        self, keypoints: np.ndarray, confidence: np.ndarray, covariance: np.ndarray | None, seen: np.ndarray
    ) -> NormalizedTracks:
        points = keypoints[seen] - keypoints[seen].mean(0)
        self._spread.append((float(np.sum(points**2)), 2 * int(seen.sum())))
        total, count = np.sum(np.array(self._spread), axis=0)
        unit = float(np.sqrt(total / count))
        n = normalize_tracks(
            keypoints[None], confidence[None], None if covariance is None else covariance[None], scale_px=unit
        )
        if self._alive is not None:
            # The unit has moved a little: the hypotheses of the last image follow it.
            f = self._unit_px / unit
            a = self._alive
            self._alive = DenseFit(a.rotation, a.coefficients * f, a.translation * f, a.camera_shape * f, a.cost)
        self._unit_px = unit
        return n

    def _scale(self, n: NormalizedTracks, information: np.ndarray) -> float:
        if not self._metre_px:
            return image_scale(n.w, information, self.dictionary)
        return float(np.median(self._metre_px)) / n.scale_px

    def _fit(self, w: np.ndarray, information: np.ndarray, scale: float) -> DenseFit:
        c = self.config
        rotation = viewpoint_starts(w, information, c.azimuth_starts, np.deg2rad(c.elevation_start_deg))[:, 0]
        size = min(c.start_components, len(self.dictionary.components))
        coefficients = np.zeros((len(rotation), 1 + size))
        coefficients[:, 0] = scale
        if self._alive is not None:
            rotation = np.concatenate([self._alive.rotation, rotation])
            coefficients = np.concatenate([self._alive.coefficients, coefficients])
        count = len(rotation)
        return fit_dense(
            np.repeat(w, count, axis=0), np.repeat(information, count, axis=0), rotation, coefficients,
            self.dictionary, c, scale=scale, scale_std=c.scale_std * (3.0 if len(self._metre_px) < 5 else 1.0),
            iterations=c.start_iterations,
        )  # fmt: skip

    def _decide(self, dense: DenseFit) -> int:
        """Add this image's costs to those of the hypotheses that led here; keep the best few."""
        total = dense.cost
        if self._alive is not None:
            change = dense.camera_shape[:, None] - self._alive.camera_shape[None]
            total = total + np.min(self._total[None] + self.config.switch_cost * np.sum(change**2, axis=(2, 3)), axis=1)
        order = np.argsort(total, kind="stable")
        keep: list[int] = []
        for i in order:
            apart = [np.sum((dense.camera_shape[i] - dense.camera_shape[j]) ** 2) > 0.05 for j in keep]
            if all(apart):
                keep.append(int(i))
            if len(keep) == self.config.azimuth_starts:
                break
        self._alive = DenseFit(*(value[keep] for value in vars(dense).values()))
        self._total = total[keep] - total[keep[0]]
        return keep[0]

    def _result(
        self,
        stamp_ns: int,
        n: NormalizedTracks,
        information: np.ndarray,
        dense: DenseFit,
        best: int,
        confidence: np.ndarray,
    ) -> InitialPose:
        one = slice(best, best + 1)
        projection = Projection(n.w, information)
        fit = fit_sparse(
            projection, dense.rotation[one], sparse_from_dense(dense.coefficients[one], self.dictionary),
            self.dictionary, self._refining,
        )  # fmt: skip
        camera = fit.shape @ np.swapaxes(fit.rotation, 1, 2)
        metres = self.config.assumed_height_m / REFERENCE_STATURE_M / float(np.median(self._metre_px)) * n.scale_px
        gap = camera_residual(projection, camera)
        covariance = pose_covariance(information, fit.rotation, dense.coefficients[one], self.dictionary, self.config)
        rms = np.sqrt(np.mean(np.sum(gap[0, confidence > 0.0] ** 2, axis=-1))) * n.scale_px
        return InitialPose(
            stamp_ns=stamp_ns,
            joints3d=(camera[0] - camera[0, BODY_15.index("pelvis")]) * metres,
            covariance=packed_covariance(covariance[0]) * metres**2,
            confidence=confidence,
            reprojection_rms_px=float(rms),
        )


def _check_image(keypoints: np.ndarray, confidence: np.ndarray, covariance: np.ndarray | None) -> None:
    p = len(BODY_15)
    if keypoints.shape != (p, 2) or np.isinf(keypoints).any():
        raise InputError(f"keypoints: expected ({p}, 2) finite px or NaN, got {keypoints.shape}; use the body15 joints")
    if confidence.shape != (p,):
        raise InputError(f"confidence: expected shape ({p},), got {confidence.shape}; give one per joint")
    if covariance is not None and covariance.shape != (p, 3):
        raise InputError(f"covariance: expected shape ({p}, 3), got {covariance.shape}; give xx, xy, yy per joint")


def _unknown(stamp_ns: int) -> InitialPose:
    p = len(BODY_15)
    return InitialPose(stamp_ns, np.full((p, 3), np.nan), np.full((p, 6), np.nan), np.zeros(p), float("nan"))


def adjust_window(
    stamp_ns: np.ndarray,
    keypoints: np.ndarray,
    confidence: np.ndarray | None,
    covariance: np.ndarray | None,
    initial_joints: np.ndarray,
    config: BundleAdjusterConfig | None = None,
) -> AdjustedWindow:
    """Bundle adjustment of one window.

    Parameters
    ----------
    stamp_ns : (F,) increasing
    keypoints, confidence, covariance : (F, 15, 2) px, (F, 15) or None, (F, 15, 3) px^2 or None
    initial_joints : (F, 15, 3) m, camera axes; frames of NaN are filled in from their neighbours
    config : weights and limits

    Raises
    ------
    InputError
        When the arrays do not fit, show no person, or no frame has a start.
    """
    config = config or BundleAdjusterConfig()
    frames = len(keypoints)
    if initial_joints.shape != (frames, len(BODY_15), 3) or len(stamp_ns) != frames:
        raise InputError(
            f"initial_joints: expected shape {(frames, len(BODY_15), 3)} and {frames} stamps, got"
            f" {initial_joints.shape} and {len(stamp_ns)}; give one pose and stamp per image"
        )
    start = fill_frames(stamp_ns, initial_joints)
    n = normalize_tracks(keypoints, confidence, covariance)
    projection = Projection(n.w, n.information)
    scale = _scale_to_image(start, projection)
    # What lies far from where the start has it is taken for an outlier, as the start's own E-step does.
    expected = n.w + camera_residual(projection, start * scale)
    _, information = GaussianJoints(n.w, n.information).expect(expected, START_STD)
    projection = Projection(n.w, information)
    seen = n.weights > 0.0
    if frames < MIN_WINDOW:
        joints, iterations, terms, stop = start * scale, 0, dict[str, float](), "too short"
    else:
        with blas_threads(config.threads):
            result = bundle_adjust(n.w, start * scale, config=config, information=information)
        joints, iterations = result.camera_shape, result.iterations
        terms, stop = result.cost_terms, result.stop_reason
    gap = camera_residual(projection, joints)
    square = np.where(seen, np.sum(gap**2, axis=-1), 0.0)
    rms = np.sqrt(square.sum(1) / np.maximum(seen.sum(1), 1)) * n.scale_px
    joints = joints - joints[:, BODY_15.index("pelvis")][:, None]
    # The scale of a monocular result is the start's: keep the mean limb length.
    metres = float(limb_lengths(start).mean() / limb_lengths(joints).mean())
    return AdjustedWindow(
        stamp_ns=np.asarray(stamp_ns, dtype=np.int64),
        joints3d=joints * metres,
        covariance=window_covariance(gap, seen) * metres**2,
        confidence=n.weights,
        reprojection_rms_px=np.where(seen.any(1), rms, np.nan),
        iterations=iterations,
        cost=float(sum(terms.values())),
        stop_reason=stop,
        cost_terms=terms,
    )


def camera_residual(projection: Projection, joints: np.ndarray) -> np.ndarray:
    """Distance (F, P, 2) of the projected poses (F, P, 3), in camera axes, from the keypoints."""
    flat = frames_last(joints[..., :2])
    return frames_first(flat + projection.translation(flat)[:, None] - projection.w)


def window_covariance(gap: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """(F, P, 6) in squared units of the 2D joints, from the window's residuals (F, P, 2).

    Across the image it is the mean square of the residuals; along the ray :data:`DEPTH_STD` comes on top, which is
    what the depths of adjusted poses err on CMU training sequences at 25 deg/s (80 mm RMS, 7 mm across).  Unseen
    joints are known half as well.
    """
    square = np.where(seen, 0.5 * np.sum(gap**2, axis=-1), 0.0)
    across = square.sum() / max(int(seen.sum()), 1) + ACROSS_STD**2
    doubt = np.where(seen, 1.0, 4.0)
    out = np.zeros((*gap.shape[:2], 6))
    out[..., 0] = out[..., 3] = doubt * across
    out[..., 5] = doubt * (9.0 * across + DEPTH_STD**2)
    return out


def fill_frames(stamp_ns: np.ndarray, joints: np.ndarray) -> np.ndarray:
    """Poses (F, P, 3) with frames of NaN interpolated in time from their neighbours.

    Raises
    ------
    InputError
        When no frame has a pose.
    """
    known = np.isfinite(joints).all(axis=(1, 2))
    if known.all():
        return joints
    if not known.any():
        raise InputError("initial_joints: expected a pose in at least one frame, got NaN in all; check the start")
    t = (stamp_ns - stamp_ns[0]).astype(np.float64)
    count = int(np.count_nonzero(known))
    before = np.clip(np.searchsorted(t[known], t, side="right") - 1, 0, count - 1)
    after = np.minimum(before + 1, count - 1)
    t0, t1 = t[known][before], t[known][after]
    s = np.clip((t - t0) / np.where(t1 > t0, t1 - t0, 1.0), 0.0, 1.0)
    # Body and orientation by themselves: joints moved along straight lines would shrink a turning body.
    shape, rotation = to_torso_frame(joints[known])
    q = quaternion_from_matrix(rotation)
    turned = matrix_from_quaternion(slerp(q[before], q[after], s))
    bent = (1.0 - s)[:, None, None] * shape[before] + s[:, None, None] * shape[after]
    return np.where(known[:, None, None], joints, bent @ np.swapaxes(turned, 1, 2))


def _scale_to_image(start: np.ndarray, projection: Projection) -> float:
    """Factor from metres to the unit of the 2D joints, least squares over the window."""
    flat = start[..., :2]
    weight, target = frames_first(projection.information)[..., :1], frames_first(projection.w)
    mean = np.sum(weight * flat, axis=1, keepdims=True) / np.maximum(weight.sum(1, keepdims=True), 1e-12)
    centre = np.sum(weight * target, axis=1, keepdims=True) / np.maximum(weight.sum(1, keepdims=True), 1e-12)
    x, y = flat - mean, target - centre
    spread = float(np.sum(weight * x * x))
    fitted = float(np.sum(weight * x * y)) / spread if spread > 0.0 else 0.0
    # A start that disagrees with the image altogether still has its size.
    return fitted if fitted > 0.0 else float(np.sqrt(np.sum(weight * y * y) / max(spread, 1e-12)))
