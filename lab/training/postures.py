"""People who go from posture to posture: they bend, crouch, kneel, crawl, sit and lie down, and get up again.

Everyday MoCap shows people on their feet.  A posture is a vector of angles by which recorded bones are turned, so that
the recorded motion goes on within it.  Arrays are (B, T, ...): B windows of T frames; angles in rad, z up.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.ndimage import uniform_filter1d

from drocap_ros.skeleton import BODY_17

_J = {name: i for i, name in enumerate(BODY_17.joints)}
#: About the axis of the hips (to the right), that to the front, that upwards; flexion of a limb is positive.
ANGLES = (
    "pitch", "roll", "bend", "lean", "twist", "neck",
    "rhip", "rhip_out", "rhip_turn", "rknee", "rankle", "rshoulder", "rshoulder_out", "rarm_turn", "relbow",
    "lhip", "lhip_out", "lhip_turn", "lknee", "lankle", "lshoulder", "lshoulder_out", "larm_turn", "lelbow",
)  # fmt: skip
#: Drawn, too: angles of thigh and upper arm to the vertical, which give those of hip and shoulder.
_DRAWN = (*ANGLES, "rthigh", "rarm", "lthigh", "larm")
_A = {name: i for i, name in enumerate(_DRAWN)}
_RIGHT = np.array([i for name, i in _A.items() if name[0] == "r" and name != "roll"])
_LEFT = np.array([_A["l" + _DRAWN[i][1:]] for i in _RIGHT])
_THIGHS = np.array([_A["rthigh"], _A["lthigh"]])
_ARMS = np.array([_A[side + part] for side in "rl" for part in ("shoulder", "shoulder_out", "arm_turn", "elbow")])
#: All but pitch and roll.
_POSE = np.arange(2, len(ANGLES))
_ABOVE_PELVIS = np.arange(_J["neck"], _J["rwrist"] + 1)
#: Height of the people who lie.
_LYING_LEVEL = 3


class Kind(NamedTuple):
    """Postures of one height (0 on the feet, 3 on the floor): ranges of angles; a limb's are of both sides.

    A name with ``1:`` or ``2:`` before it is of one side; ``ankle`` is what brings the foot flat where it is not given.
    With ``seat`` the pelvis is on the floor, and no foot is lower.
    """

    level: int
    ranges: dict[str, tuple[float, float]]
    seat: bool = False


_ARMS_FREE = {"shoulder": (-0.4, 0.9), "shoulder_out": (-0.1, 0.7), "arm_turn": (-1.0, 0.3), "elbow": (0.0, 1.3)}
_ARMS_CROSSED = {"shoulder": (0.0, 0.8), "shoulder_out": (-0.1, 0.4), "arm_turn": (-1.7, -0.7), "elbow": (1.2, 2.3)}
_ARMS_DOWN = {"arm": (-0.4, 0.4), "shoulder_out": (-0.1, 0.5), "elbow": (-0.1, 0.4)}
_KNEELING = {"knee": (1.3, 2.0), "ankle": (-1.2, 0.6)}
_LYING = {
    "bend": (-0.2, 0.3), "lean": (-0.3, 0.3), "twist": (-0.3, 0.3), "neck": (-0.3, 0.5), "hip": (-0.1, 1.0),
    "hip_out": (-0.1, 0.4), "hip_turn": (-0.2, 0.6), "knee": (0.0, 1.6), "ankle": (-0.8, 0.3), "shoulder": (0.0, 2.8),
    "shoulder_out": (0.0, 1.3), "arm_turn": (-1.3, 0.5), "elbow": (0.0, 1.9),
}  # fmt: skip
KINDS = (
    Kind(0, {}),
    Kind(0, {"pitch": (-0.2, 0.2), "bend": (-0.2, 0.3), "twist": (-0.6, 0.6), **_ARMS_FREE}),
    Kind(0, {"pitch": (-0.2, 0.2), "bend": (-0.2, 0.3), "twist": (-0.4, 0.4), **_ARMS_CROSSED}),
    # Bent, crouching, on one knee, on a chair, also with crossed arms.
    Kind(1, {"pitch": (-1.1, -0.1), "bend": (0.2, 1.2), "lean": (-0.3, 0.3), "thigh": (-0.2, 0.7), "knee": (0.0, 1.2),
             "1:arm": (-0.3, 0.9), "2:arm": (-0.8, 0.8), "elbow": (0.0, 0.6)}),
    Kind(1, {"pitch": (-0.7, 0.2), "bend": (0.0, 0.9), "twist": (-0.3, 0.3), "thigh": (0.7, 2.0),
             "hip_out": (-0.3, 0.4), "hip_turn": (-0.2, 1.2), "knee": (1.3, 2.4), "1:arm": (-0.3, 1.2),
             "2:shoulder": (-0.3, 1.6), "arm_turn": (-0.9, 0.2), "elbow": (0.0, 1.4)}),
    Kind(1, {"pitch": (-0.5, 0.2), "bend": (-0.1, 0.8), "1:thigh": (1.1, 1.8), "1:knee": (1.2, 2.0),
             "2:thigh": (-0.3, 0.6), "2:knee": (1.3, 2.1), "2:ankle": (-0.9, 0.6), "hip_out": (-0.2, 0.3),
             "hip_turn": (-0.2, 0.7), "1:shoulder": (0.0, 1.4), "2:shoulder": (-0.3, 1.2), "elbow": (0.0, 1.0)}),
    Kind(1, {"pitch": (-0.3, 0.4), "bend": (-0.1, 0.7), "thigh": (1.2, 1.7), "hip_out": (-0.2, 0.3),
             "hip_turn": (-0.2, 0.6), "knee": (0.9, 1.9), **_ARMS_FREE}),
    Kind(1, {"pitch": (-0.3, 0.4), "bend": (-0.1, 0.7), "thigh": (1.2, 1.7), "hip_out": (-0.2, 0.3),
             "hip_turn": (-0.2, 0.4), "knee": (1.1, 1.9), **_ARMS_CROSSED}),
    # Deep down with a hand on the floor or near it, on both feet or with one foot far ahead.
    Kind(1, {"pitch": (-1.0, 0.1), "roll": (-0.1, 0.4), "bend": (0.0, 0.9), "lean": (-0.2, 0.6), "twist": (-0.5, 0.5),
             "thigh": (1.0, 2.3), "hip_out": (-0.4, 0.5), "hip_turn": (-0.2, 1.5), "knee": (1.6, 2.6),
             "1:arm": (-0.7, 0.6), "1:shoulder_out": (0.0, 0.8), "2:arm": (-0.6, 1.5), "elbow": (0.0, 0.7)}),
    Kind(1, {"pitch": (-1.0, 0.0), "bend": (0.1, 1.1), "lean": (-0.3, 0.5), "twist": (-0.5, 0.5), "1:thigh": (0.9, 2.2),
             "1:knee": (1.1, 2.5), "2:thigh": (-0.1, 1.4), "2:knee": (0.8, 2.5), "2:ankle": (-0.9, 0.6),
             "hip_out": (-0.3, 0.4), "hip_turn": (-0.2, 1.1), "1:arm": (-0.5, 0.8), "2:arm": (-0.6, 1.0),
             "elbow": (0.0, 0.6)}),
    # On all fours, with a hand and a foot or knee on the floor, kneeling, sitting, sitting aside.
    Kind(2, {"pitch": (-1.7, -1.0), "bend": (-0.2, 0.5), "lean": (-0.3, 0.3), "twist": (-0.4, 0.4), "neck": (-0.8, 0.3),
             "thigh": (-0.5, 0.5), **_KNEELING, **_ARMS_DOWN}),
    Kind(2, {"pitch": (-1.6, -0.8), "bend": (0.0, 0.6), "twist": (-0.4, 0.4), "1:thigh": (-0.4, 1.4),
             "1:knee": (0.0, 1.8), "2:thigh": (-0.6, 0.6), "2:knee": (0.3, 1.9), "ankle": (-0.5, 0.6), **_ARMS_DOWN,
             "2:arm": (-0.8, 1.5)}),
    Kind(2, {"pitch": (-0.4, 0.3), "bend": (-0.1, 0.7), "thigh": (-0.2, 1.2), "hip_out": (-0.1, 0.4),
             "hip_turn": (-0.2, 0.6), **_KNEELING, **_ARMS_FREE}),
    Kind(2, {"pitch": (-0.2, 0.7), "bend": (-0.1, 0.8), "twist": (-0.3, 0.3), "thigh": (1.45, 2.3),
             "hip_out": (-0.2, 0.5), "hip_turn": (-0.4, 1.1), "knee": (0.0, 2.2), "ankle": (-0.7, 0.3),
             "1:arm": (-1.0, 1.0), "2:arm": (-0.8, 1.5), "shoulder_out": (0.0, 0.7), "arm_turn": (-0.9, 0.3),
             "elbow": (0.0, 1.2)}, seat=True),
    Kind(2, {"pitch": (-0.4, 0.6), "roll": (0.1, 0.9), "bend": (-0.1, 0.6), "lean": (-0.6, 0.1), "twist": (-0.5, 0.5),
             "thigh": (1.2, 2.0), "hip_turn": (-0.5, 0.5), "knee": (0.5, 2.2), "ankle": (-1.0, 0.3),
             "1:arm": (-0.6, 0.6), "1:shoulder_out": (0.2, 1.0), "2:shoulder": (-0.3, 1.4), "elbow": (0.0, 0.8)}),
    # Sitting and leaning back on the hands, knees up or legs stretched out.
    Kind(2, {"pitch": (-0.1, 1.0), "roll": (-0.1, 0.1), "bend": (-0.1, 0.7), "lean": (-0.2, 0.2), "twist": (-0.3, 0.3),
             "1:thigh": (1.6, 2.7), "2:thigh": (1.5, 2.7), "1:knee": (1.0, 2.4), "2:knee": (0.3, 2.4),
             "hip_out": (-0.4, 0.4), "hip_turn": (-0.2, 1.1), "1:arm": (-0.9, 0.1), "2:arm": (-0.9, 0.4),
             "shoulder_out": (0.0, 0.7), "elbow": (0.0, 0.7)}, seat=True),
    # On the belly, on the back, on a side, on the hands.
    Kind(3, {**_LYING, "pitch": (-1.7, -1.4), "roll": (-0.2, 0.2), "neck": (-0.6, 0.2), "thigh": (-1.8, -1.45),
             "1:shoulder": (-0.2, 0.3), "2:shoulder": (2.2, 3.1), "elbow": (0.0, 0.6)}),
    Kind(3, {**_LYING, "pitch": (1.3, 1.7), "roll": (-0.2, 0.2), "thigh": (1.5, 2.6), "knee": (0.0, 2.2)}, seat=True),
    Kind(3, {**_LYING, "pitch": (-0.3, 0.3), "roll": (1.3, 1.8), "lean": (-0.2, 0.1), "1:hip_out": (-0.15, 0.05),
             "1:shoulder_out": (-0.3, 0.0), "2:hip_out": (-0.2, 0.3), "2:shoulder_out": (0.0, 0.7)}),
    Kind(3, {"pitch": (-1.55, -1.1), "bend": (-0.3, 0.3), "hip": (-0.2, 0.3), "knee": (0.0, 0.3),
             "ankle": (-0.2, 0.6), **_ARMS_DOWN}),
)  # fmt: skip
#: Angles that change their sign in the mirror.
_MIRRORED = np.array([_A[name] for name in ("roll", "lean", "twist")])
_HOLD_FRAMES = (2.0, 80.0)
_CHANGE_FRAMES = (12.0, 50.0)
_WAYPOINTS = 7
#: Shares of the mass, at the joints; the toes are of the feet.
_MASS = np.array([14, 5, 7, 3, 5, 7, 3, 22, 8, 8, 3, 2, 8, 3, 2, 0, 0], np.float32)
_MASS /= _MASS.sum()
#: How near a part of the body is to the floor on which it stands; width of a foot or hand, and what a seat adds.
_TOUCH_M, _SUPPORT_M, _SEAT_M = 0.08, 0.06, 0.25
_HIPS = np.array([_J[name] for name in ("pelvis", "rhip", "lhip")])
#: Heights of the centre of mass of people who lie, and of people who sit upright; turns that find the balance.
_LIES_M, _SITS_M = 0.35, 0.5
_TURNS = 4


def _ranges() -> tuple[np.ndarray, np.ndarray]:
    """(K, 28) lowest and highest angles of the kinds; an ankle, thigh or arm that is not given is NaN."""
    low = np.zeros((len(KINDS), len(_DRAWN)))
    low[:, [_A[side + part] for side in "rl" for part in ("ankle", "thigh", "arm")]] = np.nan
    high = low.copy()
    for k, kind in enumerate(KINDS):
        # Ranges of one side overrule those of both.
        for name, (least, most) in sorted(kind.ranges.items(), key=lambda item: item[0][:2] in ("1:", "2:")):
            sides = {"1:": "r", "2:": "l"}.get(name[:2])
            part = name[2:] if sides else name
            for column in [part] if part in _A else [side + part for side in sides or "rl"]:
                low[k, _A[column]], high[k, _A[column]] = least, most
    return low, high


_LOW, _HIGH = _ranges()
_LEVELS = np.array([kind.level for kind in KINDS])
_OF_LEVEL = [np.flatnonzero(level == _LEVELS) for level in range(_LYING_LEVEL + 1)]


def _draw_angles(rng: np.random.Generator, kinds: np.ndarray) -> np.ndarray:
    """(B, K, 28) angles of postures of the kinds (B, K)."""
    low, high = _LOW[kinds], _HIGH[kinds]
    angle: np.ndarray = low + rng.random(low.shape) * (high - low)
    # Both sides are drawn alike where the kind's own ranges are the same.
    same = (rng.random(kinds.shape) < 0.5)[..., None] & ~(low[..., _RIGHT] != low[..., _LEFT])
    angle[..., _LEFT] = np.where(same, angle[..., _RIGHT] * rng.uniform(0.85, 1.15, same.shape), angle[..., _LEFT])
    # Many arms stay near the recorded ones, and many people who lie are stretched out.
    angle[..., _ARMS] *= rng.random((*kinds.shape, 1))
    rest = np.where(rng.random(kinds.shape) < 0.6, rng.uniform(0, 0.4, kinds.shape), 1.0)
    rest = np.where(_LEVELS[kinds] == _LYING_LEVEL, rest, 1.0)[..., None]
    angle[..., _POSE] *= rest
    level = np.copysign(np.pi / 2, angle[..., _THIGHS])
    angle[..., _THIGHS] = level + rest * (angle[..., _THIGHS] - level)
    seat = np.array([kind.seat for kind in KINDS])[kinds]
    for side in "rl":
        hip, knee, ankle, shoulder = (angle[..., _A[side + part]] for part in ("hip", "knee", "ankle", "shoulder"))
        thigh, arm = angle[..., _A[side + "thigh"]], angle[..., _A[side + "arm"]]
        hip[:] = np.where(np.isnan(thigh), hip, thigh - angle[..., _A["pitch"]])
        shoulder[:] = np.where(np.isnan(arm), shoulder, arm - angle[..., _A["pitch"]] + angle[..., _A["bend"]])
        knee[:] = np.where(seat, np.clip(knee, 0, np.maximum(2 * thigh - np.pi, 0)), knee)
        flat = np.clip(knee - hip - angle[..., _A["pitch"]], -0.8, 0.6) * (kinds > 0)
        ankle[:] = np.where(np.isnan(ankle), flat, ankle)
    mirror = (rng.random(kinds.shape) < 0.5)[..., None]
    right, left = angle[..., _RIGHT].copy(), angle[..., _LEFT].copy()
    angle[..., _RIGHT], angle[..., _LEFT] = np.where(mirror, left, right), np.where(mirror, right, left)
    angle[..., _MIRRORED] *= np.where(mirror, -1.0, 1.0)
    return angle


def draw_postures(rng: np.random.Generator, windows: int, frames: int) -> np.ndarray:
    """(B, T, 24) float32 angles, in the order of ``ANGLES``, of people who go from posture to posture."""
    level = rng.integers(0, _LYING_LEVEL + 1, windows)
    kinds = np.empty((windows, _WAYPOINTS), np.int64)
    for k in range(_WAYPOINTS):
        for height, of_level in enumerate(_OF_LEVEL):
            here = level == height
            kinds[here, k] = rng.choice(of_level, here.sum())
        level = np.clip(level + rng.choice([-1, 0, 1], windows, p=[0.36, 0.18, 0.46]), 0, _LYING_LEVEL)
    angle = _draw_angles(rng, kinds)[..., : len(ANGLES)]

    lasts = rng.uniform(*_CHANGE_FRAMES, (windows, _WAYPOINTS - 1))
    # Most postures are passed through.
    least, most = _HOLD_FRAMES
    hold = (least + (most - least) * rng.random(lasts.shape) ** 2) * np.where(
        _LEVELS[kinds[:, :-1]] == _LYING_LEVEL, 2.0, 1.0
    )
    begin = np.cumsum(lasts + hold, axis=1) - lasts
    begin -= rng.uniform(0, 1, (windows, 1)) * np.maximum(begin[:, -1:] - 0.5 * frames, 0)
    # The parts of the body do not move all at once.
    begin = begin[..., None] + rng.uniform(-8, 8, (windows, _WAYPOINTS - 1, len(ANGLES)))
    part = np.clip((np.arange(frames)[:, None, None] - begin[:, None]) / lasts[:, None, :, None], 0, 1)
    change = np.diff(angle, axis=1)
    curve = np.einsum("bkj,btkj->btj", change, part * part * (3 - 2 * part))
    swept: np.ndarray = (angle[:, None, 0] + curve).astype(np.float32)
    return swept


def turn(vector: np.ndarray, rotvec: np.ndarray) -> np.ndarray:
    """Rodrigues' rotation of vectors (..., 3) by rotation vectors that broadcast to them."""
    angle = np.sqrt(np.square(rotvec).sum(axis=-1, keepdims=True)) + 1e-9
    axis = rotvec / angle
    cosine, sine = np.cos(angle), np.sin(angle)
    ax, ay, az = axis[..., 0], axis[..., 1], axis[..., 2]
    vx, vy, vz = vector[..., 0], vector[..., 1], vector[..., 2]
    cross = np.stack([ay * vz - az * vy, az * vx - ax * vz, ax * vy - ay * vx], axis=-1)
    along = (axis * vector).sum(axis=-1, keepdims=True)
    turned: np.ndarray = vector * cosine + cross * sine + axis * along * (1 - cosine)
    return turned


def _axes(bone: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Unit vectors (B, T, 1, 3) of a standing person: to the right along the hips, to the front, upwards."""
    up = np.broadcast_to(np.array([0.0, 0.0, 1.0], np.float32), bone[:, :, :1].shape)
    right = bone[:, :, _J["rhip"]] - bone[:, :, _J["lhip"]]
    right = (right * np.array([1.0, 1.0, 0.0], np.float32))[:, :, None]
    right = right / (np.linalg.norm(right, axis=-1, keepdims=True) + 1e-6)
    return right, np.cross(up, right), up


def bend(bone: np.ndarray, angles: np.ndarray) -> np.ndarray:
    """Bones (B, T, 17, 3) of a body in a posture (B, T, 24), the pelvis as it was; pitch and roll are not applied."""
    right, front, up = _axes(bone)
    bone = bone.copy()

    def angle(name: str) -> np.ndarray:
        return angles[:, :, _A[name], None, None]

    def apply(joints: list[int] | np.ndarray, rotvec: np.ndarray) -> None:
        bone[:, :, joints] = turn(bone[:, :, joints], rotvec)

    # From the ends inwards: a limb turns as a whole with what it hangs on.
    for side, out in (("r", -1.0), ("l", 1.0)):
        knee, ankle, toe, elbow, wrist = (_J[side + part] for part in ("knee", "ankle", "toe", "elbow", "wrist"))
        apply([toe], angle(side + "ankle") * right)
        apply([ankle, toe], -angle(side + "knee") * right)
        leg = [knee, ankle, toe]
        apply(leg, angle(side + "hip") * right)
        apply(leg, out * angle(side + "hip_out") * front)
        apply(leg, out * angle(side + "hip_turn") * up)
        apply([wrist], angle(side + "elbow") * right)
        apply([wrist], out * angle(side + "arm_turn") * up)
        apply([elbow, wrist], angle(side + "shoulder") * right + out * angle(side + "shoulder_out") * front)
    apply([_J["head"]], -angle("neck") * right)
    apply(_ABOVE_PELVIS, -angle("bend") * right + angle("lean") * front + angle("twist") * up)
    return bone


def tilt(body: np.ndarray, angles: np.ndarray) -> np.ndarray:
    """Bodies (B, T, 17, 3) pitched and rolled by their postures (B, T, 24) about the pelvis."""
    right, front, _ = _axes(body)
    rotvec = angles[:, :, _A["pitch"], None, None] * right + angles[:, :, _A["roll"], None, None] * front
    return turn(body, rotvec)


def balance(body: np.ndarray) -> np.ndarray:
    """Bodies (B, T, 17, 3) turned about a level axis until the centre of mass is over what touches the floor.

    People on their feet, knees or hands hold themselves; those on the floor sink towards the side that hangs.
    """
    for _ in range(_TURNS):
        height = body[..., 2] - np.nanmin(body[..., 2], axis=-1, keepdims=True)
        touch = np.nan_to_num(np.exp(-np.square(height / _TOUCH_M)))
        touch /= touch.sum(axis=-1, keepdims=True)
        place = np.nan_to_num(body[..., :2])
        support = np.einsum("btp,btpi->bti", touch, place)
        spread = np.sqrt(np.einsum("btp,btpi->bt", touch, np.square(place - support[:, :, None])))
        over = np.einsum("p,btpi->bti", _MASS, place) - support
        far = np.linalg.norm(over, axis=-1) + 1e-6
        above = np.einsum("p,btp->bt", _MASS, np.nan_to_num(height))
        sinks = np.maximum(far - _SUPPORT_M - spread, 0)
        falls = np.maximum(far - _SUPPORT_M - spread - _SEAT_M * touch[..., _HIPS].sum(axis=-1), 0)
        lies = np.clip((_SITS_M - above) / (_SITS_M - _LIES_M), 0, 1)
        size = ((1 - lies) * np.minimum(falls / _SITS_M, 0.3) - lies * np.minimum(sinks, 0.15)) / far
        rotvec = np.stack([over[..., 1] * size, -over[..., 0] * size, np.zeros_like(far)], axis=-1)
        body = turn(body, uniform_filter1d(rotvec, 13, axis=1, mode="nearest")[:, :, None].astype(np.float32))
    return body
