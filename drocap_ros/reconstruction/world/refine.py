"""From poses that telemetry has placed in the world to poses that are adjusted together with the camera."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from drocap_ros.camera_path import CameraPath
from drocap_ros.contacts import ANKLES
from drocap_ros.geometry.rotations import exp_so3, pack_covariance
from drocap_ros.keypoints import Keypoints2D
from drocap_ros.reconstruction.common.refusal import Refusal, Why
from drocap_ros.reconstruction.common.windows import Faded
from drocap_ros.reconstruction.lifted.adjustment import span_lengths
from drocap_ros.reconstruction.world.camera_telemetry import CameraTelemetry
from drocap_ros.reconstruction.world.even_capture import (
    LEAST_FRAMES,
    CaptureWindow,
    EvenCapture,
    at_all_slots,
    capture_windows,
    even_capture,
)
from drocap_ros.reconstruction.world.telemetry_checks import (
    frozen,
    jump_m,
    other_time,
    resting_feet_move,
    stops,
    turned_at_once,
)
from drocap_ros.reconstruction.world.world_adjustment import WorldSolution, adjust_in_world
from drocap_ros.reconstruction.world.world_model import (
    ATTITUDE_LATENCY,
    CALIBRATED,
    CAMERA,
    GLOBALS,
    MEASURED,
    MISALIGNMENT,
    POSITION_LATENCY,
    SCALE,
    Doubt,
    Findings,
    PlacedPoses,
    WorldConfig,
    WorldInput,
    WorldState,
)

#: Frames whose solution a live window takes over from the one before: two hold place and speed.
_HELD = 2


class Beside(NamedTuple):
    """Other cameras' views of the same body at all slots of the even grid, in the same world.

    doubt : of the first view
    lengths : (18,) m of the body, of the spans; None = those of the poses to start from
    """

    views: tuple[WorldInput, ...] = ()
    doubt: Doubt = Doubt()
    lengths: np.ndarray | None = None

    def window(self, rows: slice, lengths: np.ndarray, origin: np.ndarray) -> tuple[WorldInput, ...]:
        """The views at some slots, about an origin (3,) m."""
        return tuple(_at_slots(view, rows, lengths, origin) for view in self.views)


def _at_slots(view: WorldInput, rows: slice, lengths: np.ndarray, origin: np.ndarray) -> WorldInput:
    path = view.telemetry
    return replace(
        view,
        keypoints=view.keypoints[rows],
        weight=view.weight[rows],
        depth=view.depth[rows],
        depth_sigma=view.depth_sigma[rows],
        seen=None if view.seen is None else view.seen[rows],
        still=None if view.still is None else view.still[rows],
        telemetry=CameraTelemetry(path.rotation[rows], path.position[rows] - origin, path.fps),
        lengths=lengths,
    )


@dataclass(frozen=True)
class RefinedWorld:
    """Poses and camera after the adjustment.

    joints : (F, 17, 3) m; rotation : (F, 3, 3) world -> camera; position : (F, 3) m
    metric : whether the scale was measured
    place : (F, 6) m^2 of the mean place of all joints, the same in a window; xx, xy, xz, yy, yz, zz; NaN = unknown
    covariance : (F, 17, 6) m^2 of the joints, about that place and with it
    calibration : JSON-compatible, of every window: errors of the telemetry and their standard deviations
    found : of the last window; before : that window, for the next one
    further : (V, F, 6) of V further views, corrections of the camera's position (m) and rotation (rad, camera axes)
    lens : (1 + V,) of every view, logarithm of the focal length over that of its matrix, mean of the windows
    """

    joints: np.ndarray
    rotation: np.ndarray
    position: np.ndarray
    metric: bool
    place: np.ndarray
    covariance: np.ndarray
    calibration: list[dict[str, object]]
    found: Findings
    before: Before
    further: np.ndarray
    lens: np.ndarray


class Before(NamedTuple):
    """The solution of the window before, of N frames.

    stamp_ns : (N,); joints : (N, 17, 3) m in the world; wander : (N, 6) slow errors of the reported camera
    shared : (GLOBALS,)
    """

    stamp_ns: np.ndarray
    joints: np.ndarray
    wander: np.ndarray
    shared: np.ndarray


def refinable(camera: CameraPath) -> bool:
    """Whether the camera's matrix is known, its rotations and positions in all images, and there are twelve of them."""
    return camera.matrix is not None and len(camera.stamp_ns) >= LEAST_FRAMES and bool(camera.known.all())


def refine_in_world(
    camera: CameraPath,
    keypoints: Keypoints2D,
    poses: PlacedPoses,
    config: WorldConfig | None = None,
    known: Findings | None = None,
    before: Before | None = None,
    beside: Beside | None = None,
) -> RefinedWorld | Refusal:
    """Adjust poses and a :func:`refinable` camera; a refusal where the telemetry cannot be true.

    ``known`` : findings of earlier windows; ``before`` : the last of them, which a live window continues.
    ``beside`` : other cameras' views of the same body.
    """
    beside = beside or Beside()
    config = config or WorldConfig()
    (rotation, position), matrix, stamp_ns = camera.pose, camera.matrix, camera.stamp_ns
    assert matrix is not None
    # The scale turns about the origin: near the camera's path, or the held person.
    origin = position.mean(axis=0) if before is None else _held_pelvis(before, int(stamp_ns[0]))
    config = config if before is None else replace(config, ground_m=0.0)  # the windows before know the floor
    if config.ground_m:
        origin[2] = 0.0  # of the ground, whose height no scale changes
    capture = even_capture(camera, keypoints, poses, origin)
    windows = capture_windows(capture, config.feet)
    if config.checks and (refusal := _impossible(capture, windows)):
        return refusal
    body = (poses.joints - origin) / poses.factor
    start, held = _start(stamp_ns, body, origin, 1.0 / poses.factor, before, config.errors.wander_s)
    facts, faded = _Facts(), Faded(len(capture.body))
    for window, data, found in _adjusted(capture, windows, _Scene(matrix, config, start, held, known, beside)):
        telemetry = data.telemetry
        views = enumerate(data.views)
        faded.add(
            window.rows,
            window.fade,
            joints=found.joints,
            cameras=np.stack([_correction(found.state.of_view(n), v.telemetry) for n, v in views], axis=1),
            wander=found.state.camera[:, :CAMERA],
            place=np.broadcast_to(found.place, (len(found.joints), 3, 3)),
            covariance=found.covariance + found.place,
        )
        facts.add(window, found, telemetry, config.stature_std)
        last = found
    if config.checks and (refusal := facts.refusal()):
        return refusal
    joints, cameras, wander, place, covariance = (v[capture.slot] for v in faded.mean().values())
    joints += origin
    own, *further = np.moveaxis(cameras, 1, 0)
    return RefinedWorld(
        joints=joints,
        rotation=exp_so3(own[:, 3:]) @ rotation,
        position=position + own[:, :3],
        metric=facts.metric,
        place=pack_covariance(place),
        covariance=pack_covariance(covariance),
        calibration=facts.calibration,
        found=last.findings,
        before=Before(stamp_ns, joints, wander, last.state.globals[:GLOBALS]),
        further=np.array(further).reshape(-1, len(joints), CAMERA),
        lens=np.mean(facts.lens, axis=0),
    )


def _impossible(capture: EvenCapture, windows: list[CaptureWindow]) -> Refusal | None:
    """What no true telemetry shows before any adjustment: in the path of a part, or in the feet of a window."""
    turn, path, fps, still = capture.turn, capture.path, capture.fps, capture.still
    for part in capture.parts:
        if refusal := frozen(turn[part], path[part], fps) or turned_at_once(turn[part], fps):
            return refusal
    poses = capture.body * capture.factor
    for rows in (window.rows for window in windows if window.tells):
        if refusal := other_time(poses[rows], turn[rows], path[rows], fps):
            return refusal
        if still is not None and (refusal := resting_feet_move(poses[rows], still[rows], fps)):
            return refusal
    return None


class _Scene(NamedTuple):
    """What the windows of a recording have in common: camera (3, 3) px, start, what is known before, other views."""

    matrix: np.ndarray
    config: WorldConfig
    start: Before
    held: int
    known: Findings | None
    beside: Beside


def _adjusted(
    capture: EvenCapture, windows: list[CaptureWindow], scene: _Scene
) -> Iterator[tuple[CaptureWindow, WorldInput, WorldSolution]]:
    """Every window adjusted; the findings of one part are known in the next."""
    joints, wander = (at_all_slots(values, capture.slot) for values in (scene.start.joints, scene.start.wander))
    lengths = np.median(span_lengths(capture.body), axis=0) if scene.beside.lengths is None else scene.beside.lengths
    prior = gathered = scene.known
    for window in windows:
        rows = window.rows
        if window.begins:
            prior = gathered
        telemetry = CameraTelemetry(capture.turn[rows], capture.path[rows], capture.fps)
        data = WorldInput(
            keypoints=capture.points[rows],
            weight=capture.weight[rows],
            depth=capture.depth[rows],
            depth_sigma=capture.depth_sigma[rows],
            lengths=lengths,
            telemetry=telemetry,
            camera_matrix=scene.matrix,
            config=scene.config,
            seen=capture.seen[rows],
            known=prior,
            still=None if capture.still is None else capture.still[rows],
            further=scene.beside.window(rows, lengths, capture.origin),
            doubt=scene.beside.doubt,
        )
        state = WorldState(joints[rows], wander[rows], scene.start.shared)
        found = adjust_in_world(data, state, scene.held if rows.start == 0 else 0)
        gathered = (gathered or Findings.unknown()).later(found.findings, 1.0, 0.0)
        yield window, data, found


class _Facts:
    """What the windows of a recording say about its telemetry."""

    def __init__(self) -> None:
        self.calibration: list[dict[str, object]] = []
        self.lens: list[list[float]] = []
        self.metric = True
        self._cost, self._contact = 0.0, 1.0

    def add(self, window: CaptureWindow, found: WorldSolution, telemetry: CameraTelemetry, stature_std: float) -> None:
        contact = float(found.contact[:, : len(ANKLES)].mean())
        self.calibration.append(_calibration(found, contact, stature_std, telemetry))
        self.lens.append(found.state.lens.tolist())
        self.metric &= bool(found.std[SCALE] < MEASURED * found.state.globals[SCALE])
        self._cost = max(self._cost, found.cost_terms["telemetry"] / len(found.joints))
        # Frames per second below which a step of a foot ends between two frames: contacts are not seen.
        if window.tells and telemetry.fps >= 8.0:
            self._contact = min(self._contact, contact / window.ankles_seen)

    def refusal(self) -> Refusal | None:
        # No camera's flight explains a cost of the telemetry of 100 per frame.
        if not self._cost <= 100.0:
            return Refusal(Why.POSITION_JUMPS)
        # Least share of the time with a foot in contact: jogging has 0.2, a yaw off by 40 degrees less than 0.01.
        return Refusal(Why.NO_FOOT_RESTS) if self._contact < 0.03 else None


def _held_pelvis(before: Before, stamp_ns: int) -> np.ndarray:
    """(3,) m of the first held frame."""
    at = min(int(np.searchsorted(before.stamp_ns, stamp_ns)), len(before.stamp_ns) - 1)
    pelvis: np.ndarray = before.joints[at, 0]
    return pelvis


def _start(
    stamp_ns: np.ndarray,
    body: np.ndarray,
    origin: np.ndarray,
    scale: float,
    before: Before | None,
    wander_s: np.ndarray,
) -> tuple[Before, int]:
    """The point to start from, joints in m of the body about ``origin``, and the number of held frames.

    Frames of the window before start from its solution, and the first ones keep it: the path goes on without a step.
    """
    wander, shared = np.zeros((len(body), CAMERA)), np.zeros(GLOBALS)
    shared[SCALE] = scale
    common = np.isin(stamp_ns, () if before is None else before.stamp_ns)
    if before is None or not common[:_HELD].all():
        return Before(stamp_ns, body, wander, shared), 0
    theirs = np.searchsorted(before.stamp_ns, stamp_ns[common])
    shared[CALIBRATED] = before.shared[CALIBRATED]
    joints, last = body.copy(), int(np.flatnonzero(common)[-1])
    joints[common] = (before.joints[theirs] - origin) * shared[SCALE]
    joints[last + 1 :] += joints[last, 0] - body[last, 0]
    passed_s = float(stamp_ns[-1] - before.stamp_ns[-1]) * 1e-9
    # The errors' steps from frame to frame have no pull to zero: without this they would drift on an endless stream.
    wander[common] = before.wander[theirs] * np.exp(-passed_s / wander_s)
    wander[last + 1 :] = wander[last]
    return Before(stamp_ns, joints, wander, shared), _HELD


def _correction(state: WorldState, telemetry: CameraTelemetry) -> np.ndarray:
    """(F, 6) corrections of the reported position (m) and rotation (rad, camera axes)."""
    shared = state.globals
    _, place = state.path(telemetry)
    position = place - telemetry.position + state.camera[:, :3]
    turned = shared[MISALIGNMENT] + state.camera[:, 3:] + telemetry.turn_rate * shared[ATTITUDE_LATENCY]
    return np.concatenate([position, turned], axis=1)


def _calibration(
    found: WorldSolution, contact: float, stature_std: float, telemetry: CameraTelemetry
) -> dict[str, object]:
    """JSON-compatible: errors of the telemetry and their standard deviations; share of the time with contact."""
    shared, std = found.state.globals, found.std
    rotation, position, fps = telemetry.rotation, telemetry.position, telemetry.fps
    still_s = [(stop.stop - stop.start) / fps for stop in stops(rotation, position, fps)]
    return {
        "scale": 1.0 / float(shared[SCALE]),
        "scale_std": float(std[SCALE] / shared[SCALE]),
        "stature_std": stature_std,
        "misalignment_deg": np.degrees(found.turned).tolist(),
        "misalignment_std_deg": np.degrees(found.turned_std).tolist(),
        "attitude_latency_s": -float(shared[ATTITUDE_LATENCY]),
        "attitude_latency_std_s": float(std[ATTITUDE_LATENCY]),
        "position_latency_s": -float(shared[POSITION_LATENCY]),
        "position_latency_std_s": float(std[POSITION_LATENCY]),
        "ground_spread_m": None if np.isnan(found.ground_spread) else found.ground_spread,
        "contact_share": contact,
        "camera_moves": bool(np.ptp(position, axis=0).max() > 0),
        "camera_stops_s": max(still_s, default=0.0),
        "camera_jumps_m": jump_m(position, fps),
        "iterations": found.iterations,
        "stop_reason": found.stop_reason,
        "place_covariance_m2": None if np.isnan(found.place).any() else pack_covariance(found.place).tolist(),
    }
