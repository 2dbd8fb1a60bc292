"""An articulated person that walks, boxes, kicks and squats.

Every action is written as smooth controls (path of the root, trunk angles, goals of wrists and ankles); two-bone
inverse kinematics turns the goals into joints, so that all bone lengths are constant.
World: ENU, m, z up, the ground at z = 0.  Body: x forward, y left, z up.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from drocap_ros.errors import InputError
from drocap_ros.geometry.alignment import directions
from drocap_ros.skeleton import BODY_15, BODY_17, JointSet

#: From the ankle to the tip of the big toe, share of the stature.
FOOT_LENGTH = 0.115
#: Height of a standing toe's tip above the ground.
TOE_HEIGHT_M = 0.02
#: Turn of a standing foot to its own side, rad.
_TOE_OUT = 0.12
#: Height of the ankle above its place in stance, in lengths of the foot, from which and up to which the foot goes over
#: from the ground's direction to that of the shank.
_LEAVES = 0.6
_FREE = 1.3  # lengths of the foot; a judgement, as the lower bound


def add_toes(joints: np.ndarray, heading: np.ndarray, stature_m: float) -> np.ndarray:
    """Joints (F, 17, 3) m of ``BODY_17`` from those of ``BODY_15``.

    The bone from ankle to toe has one length.  Near the ground the toe keeps its height, however high the ankle is;
    the foot of a lifted leg is perpendicular to the shank.

    joints : (F, 15, 3) m, z up, the ground at z = 0
    heading : (F, 2) rad, of the right and the left foot, about the vertical
    """
    length = FOOT_LENGTH * stature_m
    toes = []
    for side, letter in enumerate("rl"):
        ankle, knee = (joints[:, BODY_15.index(letter + name)] for name in ("ankle", "knee"))
        yaw = heading[:, side] + (_TOE_OUT if letter == "l" else -_TOE_OUT)
        ahead = np.stack([np.cos(yaw), np.sin(yaw), np.zeros_like(yaw)], axis=1)
        drop = np.clip((ankle[:, 2] - TOE_HEIGHT_M) / length, 0.0, 0.95)
        ground = np.sqrt(1 - drop**2)[:, None] * ahead - drop[:, None] * (0.0, 0.0, 1.0)
        shank = directions(ankle - knee)
        free = directions(ahead - np.sum(ahead * shank, axis=1, keepdims=True) * shank)
        lifted = np.clip((ankle[:, 2] / length - _LEAVES) / (_FREE - _LEAVES), 0.0, 1.0)
        share = (lifted**2 * (3 - 2 * lifted))[:, None]
        way = directions((1 - share) * ground + share * free)
        # No toe enters the ground.
        lowest = (TOE_HEIGHT_M - ankle[:, 2]) / length
        low = way[:, 2] < lowest
        flat = directions(way * (1, 1, 0)) * np.sqrt(np.maximum(1 - np.minimum(lowest, 0.0) ** 2, 0.0))[:, None]
        way[low] = (flat + np.minimum(lowest, 0.0)[:, None] * (0.0, 0.0, 1.0))[low]
        toes.append(ankle + length * way)
    return np.concatenate([joints, np.stack(toes, axis=1)], axis=1)


_SINGLE = ("walk", "boxing", "kicking", "squats")
#: Motions of the person; "mixed" repeats the last four in turn.
ACTIONS = ("mixed", "stand", *_SINGLE)

#: Bone lengths as shares of the stature (means of adults; hips and shoulders from the midline).
_LEG = {"hip": 0.055, "thigh": 0.245, "shank": 0.246, "foot": 0.045}
_TRUNK = {"trunk": 0.37, "head": 0.055, "shoulder_side": 0.115, "shoulder_drop": 0.075}
_SHARES = {**_LEG, **_TRUNK, "upper_arm": 0.172, "forearm": 0.157}

#: Time step in s of the path: at walking speed less than 2 cm.
_PATH_STEP_S = 0.01
#: Length of each action of "mixed".
_MIXED_SEGMENT_S = 5.0
#: Share of a stride during which a foot stands, as in walking.
_STANCE = 0.6


@dataclass(frozen=True)
class _Style:
    """Parameters of one person and take."""

    size: dict[str, float]
    speed_m_s: float
    stride_hz: float
    turn_rad_s: float
    wander_rad: tuple[float, float]
    wander_hz: tuple[float, float]
    wander_phase: tuple[float, float]
    heading_rad: float
    punch_hz: float
    kick_hz: float
    squat_hz: float
    phase: float


def _style(seed: int, stature_m: float) -> _Style:
    rng = np.random.default_rng(seed)
    size = {name: share * stature_m * (1 + 0.03 * rng.uniform(-1, 1)) for name, share in _SHARES.items()}
    return _Style(
        size=size,
        speed_m_s=0.58 * stature_m * rng.uniform(0.9, 1.1),
        stride_hz=rng.uniform(0.85, 0.98),
        turn_rad_s=rng.choice([-1, 1]) * rng.uniform(0.15, 0.3),
        wander_rad=(rng.uniform(0.3, 0.6), rng.uniform(0.1, 0.25)),
        wander_hz=(rng.uniform(0.06, 0.1), rng.uniform(0.15, 0.25)),
        wander_phase=(rng.uniform(0, 6.28), rng.uniform(0, 6.28)),
        heading_rad=rng.uniform(-np.pi, np.pi),
        punch_hz=rng.uniform(0.55, 0.75),
        kick_hz=rng.uniform(0.32, 0.4),
        squat_hz=rng.uniform(0.33, 0.42),
        phase=rng.uniform(0, 1),
    )


def simulate_person(
    t: np.ndarray, action: str = "mixed", seed: int = 0, stature_m: float = 1.75, joint_set: JointSet = BODY_15
) -> np.ndarray:
    """Joints of a moving person.

    t : (F,) s, at least 0, in any order; the pose at an instant does not depend on the other instants
    action : one of ``ACTIONS``
    seed : of the person's proportions and of the take
    stature_m : height of the person
    joint_set : ``BODY_15`` or ``BODY_17``
    returns : (F, P, 3) m, order of ``joint_set``, world ENU
    """
    if action not in ACTIONS:
        raise InputError(f"action: expected one of {', '.join(ACTIONS)}, got {action!r}")
    t = np.asarray(t, dtype=np.float64)
    if t.ndim != 1 or not np.isfinite(t).all() or np.any(t < 0) or np.any(t > 36_000):
        raise InputError("t: expected (F,) seconds from 0 to 36000; give times from the start of the take")
    style = _style(seed, stature_m)
    if t.size == 0:
        return np.empty((0, len(joint_set), 3))
    weight = action_weights(t, action)
    root, yaw = _walk_path(t, action, style)
    joints = _assemble(_Moment(t, yaw, weight, style), root, action)
    if joint_set is not BODY_17:
        return joints
    return add_toes(joints, np.stack([_foot_heading(t, side, style) for side in (-1, 1)], axis=1), stature_m)


def action_weights(t: np.ndarray, action: str) -> np.ndarray:
    """(F, 4) in [0, 1], weights of walk, boxing, kicking and squats at each instant."""
    weight = np.zeros((t.size, len(_SINGLE)))
    if action in _SINGLE:
        weight[:, _SINGLE.index(action)] = 1.0
    elif action == "mixed":
        cycle = t % (_MIXED_SEGMENT_S * len(_SINGLE))
        for i in range(len(_SINGLE)):
            weight[:, i] = _plateau(
                (cycle - i * _MIXED_SEGMENT_S) % (_MIXED_SEGMENT_S * len(_SINGLE)), 0.0, _MIXED_SEGMENT_S, 0.8
            )
    return weight


def _smooth(u: np.ndarray) -> np.ndarray:
    """Quintic step from 0 to 1 over u in [0, 1]: continuous in acceleration."""
    u = np.clip(u, 0.0, 1.0)
    return np.asarray(u**3 * (10 - 15 * u + 6 * u**2))


def _plateau(x: np.ndarray, start: float, end: float, ramp: float) -> np.ndarray:
    """1 between start and end, 0 outside, with smooth ramps inside."""
    return np.asarray(_smooth((x - start) / ramp) * _smooth((end - x) / ramp))


def _heading(t: np.ndarray, style: _Style) -> np.ndarray:
    yaw = style.heading_rad + style.turn_rad_s * t
    for amplitude, rate, phase in zip(style.wander_rad, style.wander_hz, style.wander_phase, strict=True):
        yaw = yaw + amplitude * np.sin(2 * np.pi * rate * t + phase)
    return yaw


def _walk_speed(t: np.ndarray, action: str, style: _Style) -> np.ndarray:
    weight = action_weights(t, action)
    return np.asarray(style.speed_m_s * (weight[:, 0] + 0.15 * weight[:, 1]) * _smooth(t / 1.0))


def _grid_path(seconds: float, action: str, style: _Style) -> tuple[np.ndarray, np.ndarray]:
    """Path of the root on a fixed time grid, independent of the requested instants."""
    grid = np.arange(0.0, seconds + 4.0, _PATH_STEP_S)
    yaw, speed = _heading(grid, style), _walk_speed(grid, action, style)
    velocity = speed[:, None] * np.stack([np.cos(yaw), np.sin(yaw)], axis=1)
    steps = 0.5 * (velocity[1:] + velocity[:-1]) * _PATH_STEP_S
    return grid, np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)])


def _walk_path(t: np.ndarray, action: str, style: _Style) -> tuple[np.ndarray, np.ndarray]:
    """Ground point under the pelvis (F, 2) m and heading (F,) rad."""
    grid, path = _grid_path(float(t.max()), action, style)
    return np.stack([np.interp(t, grid, path[:, i]) for i in range(2)], axis=1), _heading(t, style)


def _steps(t: np.ndarray, side: int, style: _Style) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Number of the stride (F,), its phase in [0, 1) and the swing phase of a foot, 0 while it stands."""
    stride = style.stride_hz * t + style.phase + (0.5 if side > 0 else 0.0)
    part = stride % 1.0
    return np.floor(stride), part, np.clip((part - _STANCE) / (1 - _STANCE), 0.0, 1.0)


def _stance_middle(number: np.ndarray, side: int, style: _Style) -> np.ndarray:
    """(F,) s, middle of the stance of a stride."""
    return np.maximum((number + _STANCE / 2 - style.phase - (0.5 if side > 0 else 0.0)) / style.stride_hz, 0.0)


def _foot_heading(t: np.ndarray, side: int, style: _Style) -> np.ndarray:
    """(F,) rad: constant while the foot stands, turned in the swing."""
    count, _, swing = _steps(t, side, style)
    now, then = (_heading(_stance_middle(number, side, style), style) for number in (count, count + 1))
    return np.asarray(now + _smooth(swing) * (then - now))


def _footprints(t: np.ndarray, side: int, action: str, style: _Style) -> tuple[np.ndarray, np.ndarray]:
    """Ankle goal (F, 3) m of the stepping leg and its swing phase (F,), 0 while it stands."""
    grid, path = _grid_path(float(t.max()), action, style)
    count, part, swing = _steps(t, side, style)

    def place(number: np.ndarray) -> np.ndarray:
        middle = _stance_middle(number, side, style)
        yaw = _heading(middle, style)
        across = side * 0.9 * style.size["hip"] * np.stack([-np.sin(yaw), np.cos(yaw)], axis=1)
        return np.stack([np.interp(middle, grid, path[:, i]) for i in range(2)], axis=1) + across

    ground = place(count) + _smooth(swing)[:, None] * (place(count + 1) - place(count))
    walking = np.clip(_walk_speed(t, action, style) / style.speed_m_s, 0.0, 1.0)
    # The foot rolls over the toes at the end of stance, then swings.
    roll = _smooth((part - 0.42) / 0.25) * _smooth((1.0 - part) / 0.25)
    lift = (0.07 * np.sin(np.pi * swing) ** 2 + 0.11 * roll) * walking
    return np.concatenate([ground, (style.size["foot"] + lift)[:, None]], axis=1), swing


def _rotation(yaw: np.ndarray, pitch: np.ndarray, roll: np.ndarray) -> np.ndarray:
    """(F, 3, 3) body -> world: roll about x, then pitch forward about y, then yaw about z."""
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_euler("ZYX", np.stack([yaw, pitch, roll], axis=1)).as_matrix())


def _apply(rotation: np.ndarray, vector: np.ndarray) -> np.ndarray:
    vectors = np.broadcast_to(vector, (*vector.shape[:-2], len(rotation), 3))
    return np.asarray(np.einsum("fij,...fj->...fi", rotation, vectors))


def two_bone(
    start: np.ndarray, goal: np.ndarray, pole: np.ndarray, first_m: float, second_m: float
) -> tuple[np.ndarray, np.ndarray]:
    """Middle and end joint (F, 3) of a two-bone limb that reaches for ``goal`` and bends towards ``pole``.

    A goal out of reach is moved along the line from the start, so both bones keep their lengths exactly.
    """
    away = goal - start
    distance = np.linalg.norm(away, axis=1, keepdims=True)
    direction = away / np.maximum(distance, 1e-9)
    reach = np.clip(distance, 0.3 * (first_m + second_m), 0.998 * (first_m + second_m))
    along = (first_m**2 - second_m**2 + reach**2) / (2 * reach)
    height = np.sqrt(np.maximum(first_m**2 - along**2, 0.0))
    side = directions(pole - np.sum(pole * direction, axis=1, keepdims=True) * direction)
    return start + along * direction + height * side, start + reach * direction


class _Moment:
    """What the person does at each of F instants; arrays (F,).

    walk, box, kick, squat : weights of the actions
    stride : phase of the stride, rad; squat_depth : 0 standing to 1
    punch : side -> reach of the fist; kicks : side -> shares to which the leg is lifted and stretched
    """

    def __init__(self, t: np.ndarray, yaw: np.ndarray, weight: np.ndarray, style: _Style) -> None:
        self.t, self.yaw, self.style = t, yaw, style
        self.walk, self.box, self.kick, self.squat = weight.T
        self.stride = 2 * np.pi * (style.stride_hz * t + style.phase)
        self.squat_depth = self.squat * 0.5 * (1 - np.cos(2 * np.pi * style.squat_hz * t))
        self.punch = {
            side: self.box * _pulse(style.punch_hz * t + (0.5 if side < 0 else 0.0), 0.1, 0.5) for side in (1, -1)
        }
        self.kicks = {side: _kick_phase(style.kick_hz * t + 0.1, side, self.kick) for side in (1, -1)}
        self.ahead = np.stack([np.cos(yaw), np.sin(yaw)], axis=1)
        self.left = np.stack([-self.ahead[:, 1], self.ahead[:, 0]], axis=1)

    def pelvis(self, root: np.ndarray) -> np.ndarray:
        """(F, 3) m above the ground points (F, 2)."""
        s, style = self.style.size, self.style
        leg = s["thigh"] + s["shank"]
        kick_any = self.kicks[1][0] + self.kicks[-1][0]
        bent = 0.965 - 0.025 * self.walk - 0.05 * self.box - 0.02 * kick_any - 0.40 * self.squat_depth
        height = s["foot"] + leg * bent
        height = height + leg * 0.015 * self.walk * np.cos(2 * self.stride)
        sway = 0.02 * self.walk * np.sin(self.stride)
        sway = sway + 0.035 * self.box * np.sin(2 * np.pi * 0.5 * style.punch_hz * self.t)
        back = -0.16 * self.squat_depth
        ground = root + back[:, None] * self.ahead + sway[:, None] * self.left
        return np.concatenate([ground, height[:, None]], axis=1)

    def frames(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(F, 3, 3) body -> world of hips, trunk and head."""
        t, yaw, kicks, cosine = self.t, self.yaw, self.kicks, np.cos(self.stride)
        twist = 0.45 * (self.punch[-1] - self.punch[1]) - 0.12 * self.walk * cosine
        twist = twist + 0.2 * (kicks[1][1] - kicks[-1][1])
        turned = yaw - 0.4 * twist + 0.05 * np.sin(0.7 * t)
        hips = _rotation(turned, 0.25 * self.squat_depth, 0.03 * self.walk * cosine)
        lean = 0.06 * self.walk + 0.18 * self.box + 0.75 * self.squat_depth - 0.28 * (kicks[1][1] + kicks[-1][1])
        roll = 0.04 * np.sin(1.1 * t + 6.28 * self.style.phase) - 0.03 * self.walk * cosine
        nod = 0.3 * lean + 0.1 + 0.08 * np.sin(0.9 * t)
        head = _rotation(yaw + 0.5 * twist + 0.3 * np.sin(0.5 * t), nod, 0.0 * t)
        return hips, _rotation(yaw + twist, lean, roll), head


def _assemble(moment: _Moment, root: np.ndarray, action: str) -> np.ndarray:
    s, yaw, zero = moment.style.size, moment.yaw, 0.0 * moment.t
    pelvis, (hips, trunk, head) = moment.pelvis(root), moment.frames()
    joints = np.empty((len(yaw), len(BODY_15), 3))
    neck = pelvis + _apply(trunk, np.array([[0.0, 0.0, s["trunk"]]]))
    joints[:, BODY_15.index("pelvis")] = pelvis
    joints[:, BODY_15.index("neck")] = neck
    joints[:, BODY_15.index("head")] = neck + _apply(head, np.array([[0.0, 0.0, s["head"]]]))
    for side, letter in ((1, "l"), (-1, "r")):
        hip = pelvis + _apply(hips, np.array([[0.0, side * s["hip"], 0.0]]))
        ankle = _ankle_goal(moment, side, hip, action)
        knee_pole = _apply(_rotation(yaw, zero, zero), np.array([[1.0, side * 0.15, 0.0]])) + np.array([0, 0, 0.1])
        knee, ankle = two_bone(hip, ankle, knee_pole, s["thigh"], s["shank"])
        shoulder = neck + _apply(trunk, np.array([[0.0, side * s["shoulder_side"], -s["shoulder_drop"]]]))
        wrist_goal = shoulder + _apply(trunk, _wrist_goal(moment, side))
        elbow_pole = _apply(trunk, np.array([[-0.6, side * 0.6, -0.6]]))
        elbow, wrist = two_bone(shoulder, wrist_goal, elbow_pole, s["upper_arm"], s["forearm"])
        limbs = {"hip": hip, "knee": knee, "ankle": ankle, "shoulder": shoulder, "elbow": elbow, "wrist": wrist}
        for name, value in limbs.items():
            joints[:, BODY_15.index(letter + name)] = value
    return joints


def _pulse(phase: np.ndarray, start: float, end: float) -> np.ndarray:
    """Smooth bump between two phases of a cycle."""
    part = phase % 1.0
    middle = 0.5 * (start + end)
    return _plateau(part, start, end, middle - start)


def _kick_phase(phase: np.ndarray, side: int, weight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Shares to which the leg is lifted and stretched; the legs alternate."""
    turn = (phase * 0.5 + (0.5 if side > 0 else 0.0)) % 1.0 * 2.0
    lifted = weight * _plateau(turn, 0.05, 0.75, 0.25)
    stretched = weight * _plateau(turn, 0.25, 0.58, 0.165)
    return lifted, stretched


def _ankle_goal(moment: _Moment, side: int, hip: np.ndarray, action: str) -> np.ndarray:
    goal, _ = _footprints(moment.t, side, action, moment.style)
    # A boxer's stance: left foot before the right; a wider stance for squats.
    goal[:, :2] += (0.16 * side * moment.box)[:, None] * moment.ahead
    goal[:, :2] += (side * (0.06 * moment.box + 0.05 * moment.squat_depth))[:, None] * moment.left
    leg = moment.style.size["thigh"] + moment.style.size["shank"]
    ahead = np.pad(moment.ahead, ((0, 0), (0, 1)))
    chamber = hip + 0.35 * leg * ahead - np.array([0, 0, 0.42 * leg])
    stretched = hip + 0.93 * leg * ahead + np.array([0, 0, 0.12 * leg])
    lifted, extended = (k[:, None] for k in moment.kicks[side])
    return np.asarray(goal + lifted * (chamber - goal) + extended * (stretched - chamber))


def _wrist_goal(moment: _Moment, side: int) -> np.ndarray:
    """(F, 3) m, from the shoulder in the trunk frame."""
    arm = moment.style.size["upper_arm"] + moment.style.size["forearm"]
    swing = side * 0.5 * np.cos(moment.stride)  # against the leg of the same side
    one = np.ones_like(moment.stride)

    def along(x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
        return arm * np.stack([x * one, y * one, z * one], axis=1)

    hang = along(0.1 * one, 0.12 * side * one, -0.95 * one)
    walking = along(np.sin(swing) * 0.85 + 0.18, 0.12 * side * one, -0.88 * np.cos(swing))
    reach, depth = moment.punch[side], moment.squat_depth
    guard = along(0.45 + 0.52 * reach, -side * (0.22 - 0.08 * reach), 0.12 - 0.02 * reach)
    balance = along(0.3 * one, 0.45 * side * one, -0.45 * one)
    forward = along(0.1 + 0.8 * depth, 0.12 * side * one, -0.95 + 0.95 * depth)
    walk, box, kick, squat = moment.walk, moment.box, moment.kick, moment.squat
    rest = np.clip(1 - walk - box - kick - squat, 0.0, 1.0)
    parts = ((rest, hang), (walk, walking), (box, guard), (kick, balance), (squat, forward))
    return np.asarray(np.sum([w[:, None] * goal for w, goal in parts], axis=0))
