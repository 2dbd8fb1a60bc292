"""The default method (``--method ba``): a learned lifter, depth signs over time, and limbs of constant length.

1. The lifter predicts joints and their expected errors (:mod:`lifter`).
2. Bones of constant length have a known reach in depth; the lifter's depths over the whole window give its sign
   (:mod:`depth_signs`).
3. Joints, bone lengths and zoom are adjusted together (:mod:`adjustment`).
4. The lifter runs again with the bone lengths, and steps 2 and 3 start from its second prediction.

With the person's size from an earlier window the first prediction and the first adjustment are left out: half the time.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace

import numpy as np

from drocap_ros.keypoints import Keypoints2D
from drocap_ros.reconstruction.common.poses import Evidence, Spread
from drocap_ros.reconstruction.common.windows import LIFTER_FPS, even_slots, spread, spread_keypoints
from drocap_ros.reconstruction.lifted.body_size import (
    YARDSTICK,
    YARDSTICK_MM,
    BodySize,
    EvenView,
    apply_size,
    magnification,
    measure_size,
)
from drocap_ros.reconstruction.lifted.lifted_config import LiftedConfig
from drocap_ros.reconstruction.lifted.lifter import Lifter
from drocap_ros.reconstruction.lifted.window_solver import Cancelled, solve_signs_and_adjust


def prepare(config: LiftedConfig) -> None:
    """Load libraries and network before the first window."""
    import_libraries()
    Lifter.load(config.lifter or None)


def import_libraries() -> None:
    """Import the slow libraries that the solvers import on first use."""
    import scipy.linalg.lapack
    import scipy.ndimage  # noqa: F401


@dataclass(frozen=True)
class WindowSolution:
    """Result of a window.

    joints : (F, 17, 3) in camera axes and the unit of the keypoints; x and y in the image, depth in the scale of the
        pelvis
    sigma : (F, 17, 2) expected absolute error of x, y (each) and of depth, in the same unit: the lifter's and, for
        keypoints without a covariance, their noise that lasts for some frames
    spread : of the poses about their pelvis
    still : (F, 2) the lifter's probability that the right and the left foot rest in the world
    body : the size for the next window
    steps : of the first and of the final adjustment
    seconds : wall-clock of "initial" (the lifter) and of "ba" (the rest)
    """

    joints: np.ndarray
    sigma: np.ndarray
    spread: Spread
    still: np.ndarray
    body: BodySize
    cost_terms: dict[str, float]
    steps: tuple[int, int]
    stop_reason: str
    seconds: dict[str, float]


def solve_window(  # noqa: PLR0913 - what is known of camera, body and depth is known separately
    stamp_ns: np.ndarray,
    keypoints: Keypoints2D,
    focal: float | None,
    config: LiftedConfig,
    known: BodySize | None = None,
    cancelled: Cancelled | None = None,
    rotation: np.ndarray | None = None,
    evidence: Evidence | None = None,
) -> WindowSolution:
    """:func:`solve_even_window` for frames at any increasing times ``stamp_ns`` (F,).

    Missing frames are inserted without a seen joint, so that time is even.
    """
    slot, fps = even_slots(stamp_ns)
    if slot[-1] + 1 == len(slot):
        return solve_even_window(keypoints, fps, focal, config, known, cancelled, rotation, evidence)
    if known is not None:
        known = replace(known, unit_per_mm=np.interp(np.arange(slot[-1] + 1), slot, known.unit_per_mm))
    turn = None if rotation is None else spread(rotation, slot, np.nan)
    others = None if evidence is None else evidence.map(lambda values: spread(values, slot, np.nan))
    r = solve_even_window(spread_keypoints(keypoints, slot), fps, focal, config, known, cancelled, turn, others)
    body = replace(r.body, unit_per_mm=r.body.unit_per_mm[slot])
    return replace(r, joints=r.joints[slot], sigma=r.sigma[slot], still=r.still[slot], body=body)


def solve_even_window(  # noqa: PLR0913 - what is known of camera, body and depth is known separately
    keypoints: Keypoints2D,
    fps: float = LIFTER_FPS,
    focal: float | None = None,
    config: LiftedConfig | None = None,
    known: BodySize | None = None,
    cancelled: Cancelled | None = None,
    rotation: np.ndarray | None = None,
    evidence: Evidence | None = None,
) -> WindowSolution:
    """Poses of one window of evenly spaced frames.

    keypoints : of ``BODY_17``, any unit, y down; without a covariance the noise is estimated from the sequence
    fps : frames per second
    focal : focal length in the keypoints' unit; None = unknown, the camera is taken as distant
    config : the defaults if None
    known : size from an earlier window, for a warm start
    cancelled : called before every step of the adjustments but the first; True ends them
    rotation : (F, 3, 3) world (z up) -> camera, NaN where unknown; None = unknown
    evidence : poses of these frames by another method, BODY_17 in camera axes; None = there are none
    """
    config = config or LiftedConfig()
    lifter = Lifter.load(config.lifter or None)
    begin = time.perf_counter()
    view = EvenView(keypoints, fps, focal, rotation, evidence)
    sized = measure_size(view, config, lifter, cancelled) if known is None else apply_size(known, view, config, lifter)
    mm, zoom = sized.mm, sized.zoom

    clock = time.perf_counter()
    found = solve_signs_and_adjust(
        sized.model, sized.flat, sized.lifted, sized.lengths, config.iterations, cancelled, evidence
    )
    size = (zoom / mm)[:, None, None]
    joints = found.joints.copy()
    if focal is not None:
        joints[..., :2] /= magnification(joints[..., 2] - joints[:, :1, 2], focal * mm / zoom)
    joints *= size
    joints[..., :2] += sized.centre[:, None]
    end = time.perf_counter()
    adjusting = sized.seconds + end - clock
    sigma = sized.lifted.sigma * size
    if keypoints.covariance is None:
        sigma[..., 0] = np.hypot(sigma[..., 0], lifter.errors.lasting * sized.model.lasting_noise_mm * size[..., 0])
    yardstick = YARDSTICK_MM / max(float(found.lengths[YARDSTICK].sum()), 1e-12)
    return WindowSolution(
        joints=joints,
        sigma=sigma,
        spread=lifter.errors.adjusted,
        still=sized.lifted.still,
        body=BodySize(found.lengths * yardstick, zoom * found.zoom / (mm * yardstick)),
        cost_terms=found.cost_terms,
        steps=(sized.iterations, found.iterations),
        stop_reason=found.stop_reason,
        seconds={"initial": end - begin - adjusting, "ba": adjusting},
    )
