"""Which views of a person would be reconstructed how well: the last poses, seen by simulated cameras and lifted again.

The deviation of a joint in a view has two parts: that by which the adjustment's normal equations weigh the view, the
lifter's own expected error, and how far the lifted poses are from those that were projected.  The second one shows
what no local covariance does: signs of depth that a view gets wrong, as of the thighs of one who squats, from behind.
Limbs that hide joints are simulated as in :mod:`drocap_ros.simulation.keypoint_errors`.
"""

from __future__ import annotations

import math

import numpy as np

from drocap_ros.flight.orbit.view_plan import ViewForecast
from drocap_ros.geometry.alignment import apply_similarity, similarity
from drocap_ros.geometry.bones import bone_lengths
from drocap_ros.reconstruction.lifted.even_frames import even_slots
from drocap_ros.reconstruction.lifted.lifter import Lifter
from drocap_ros.reconstruction.lifted.network import LifterInput
from drocap_ros.simulation.keypoint_errors import occlusion
from drocap_ros.simulation.orbit_camera import look_at, project, to_camera
from drocap_ros.skeleton import BODY_17, indices
from drocap_ros.stamps import NS

#: Views: every 45 degrees about the person from his left on, from the lowest and the highest useful orbit (2.0 and
#: 5.2 m high at 6 m).
BEARINGS_DEG = np.arange(0.0, 360.0, 45.0)
ELEVATIONS_DEG = np.array([10.0, 35.0])
_PAST_S = 6.0  # two squats; older poses say less about the next ones
_LEAST_S = 1.5  # of poses, which hold a step of walking
_DISTANCE_M = 6.0  # of the usual orbit: perspective changes little with it
_FOCAL = 1000.0  # px; any would do
_NOISE = 0.008  # of the person's height in the image: deviation of a usual detector's joint,
_HIDDEN = 2.2  # times that of a joint that is hidden, as simulated detectors have it
_MEMORY_S = 10.0  # of the average: what is done for longer is a movement of its own
_SIDES = indices(BODY_17.joints, ("rhip", "lhip", "rshoulder", "lshoulder"))


class ViewForecaster:
    """Forecasts by one window of poses after the other, averaged in the person's own frame: people repeat movements.

    Poses of a few seconds from one side are a poor witness of the other views; those of a sweep are a better one.
    """

    def __init__(self, lifter: Lifter) -> None:
        self._lifter = lifter
        self.reset()

    def reset(self) -> None:
        """Forget the person."""
        self._mean: np.ndarray | None = None
        self._stamp_ns = 0

    def forecast(self, stamp_ns: np.ndarray, joints: np.ndarray) -> ViewForecast | None:
        """Forecast from poses (F, 17, 3) m, z up, at increasing times (F,); None = too few to see a movement."""
        recent = (stamp_ns >= stamp_ns[-1] - round(_PAST_S * NS)) & np.isfinite(joints).all(axis=(1, 2))
        if np.count_nonzero(recent) < 8 or np.ptp(stamp_ns[recent]) < _LEAST_S * NS:
            return None
        slots, fps = even_slots(stamp_ns[recent])
        even = np.arange(slots[-1] + 1)
        flat = joints[recent].reshape(len(slots), -1)
        body = np.stack([np.interp(even, slots, values) for values in flat.T], axis=-1).reshape(len(even), -1, 3)
        facing, turn = facing_deg(body, fps)
        views = [(facing + bearing, elevation) for elevation in ELEVATIONS_DEG for bearing in BEARINGS_DEG]
        new = np.log([_expected_error(body, np.radians(view), fps, self._lifter) for view in views])
        share = 1.0 - math.exp(-max(int(stamp_ns[-1]) - self._stamp_ns, 0) / (_MEMORY_S * NS))
        self._mean = new if self._mean is None else self._mean + share * (new - self._mean)
        self._stamp_ns = int(stamp_ns[-1])
        bearing, elevation = np.array(views).T
        return ViewForecast(np.mod(bearing, 360.0), elevation, np.exp(self._mean), turn)


def _expected_error(body: np.ndarray, view: np.ndarray, fps: float, lifter: Lifter) -> float:
    """RMS error (m) of the joints of poses (F, 17, 3) in the view (bearing and elevation, rad) of a still camera."""
    bearing, elevation = view
    middle = body.mean(axis=(0, 1))
    flat = np.cos(elevation)
    away = _DISTANCE_M * np.array([flat * np.cos(bearing), flat * np.sin(bearing), np.sin(elevation)])
    position = np.tile(middle + away, (len(body), 1))
    rotation = look_at(position, np.tile(middle, (len(body), 1)))
    px = project(body, rotation, position, np.diag([_FOCAL, _FOCAL, 1.0]))
    seen = to_camera(body, rotation, position)
    hidden = occlusion(px, seen[..., 2], _FOCAL)
    height = np.ptp(px[..., 1], axis=1)[:, None]
    variance = np.square(_NOISE * height * np.where(hidden, _HIDDEN, 1.0))
    unit = _FOCAL / float(seen[:, 0, 2].mean())
    lengths = np.median(bone_lengths(body), axis=0) * unit
    covariance = np.stack([variance, np.zeros_like(variance), variance], axis=-1)
    lifted = lifter.lift(LifterInput(px, None, lengths, covariance, rotation, _FOCAL), fps)
    found = lifted.joints / unit
    found[..., :2] *= (seen[:, :1, 2:] + found[..., 2:]) / _FOCAL * unit
    gap = apply_similarity(found, *similarity(found, seen)) - seen  # of the whole body's lean and size telemetry knows
    own = lifted.sigma[..., [0, 0, 1]] / unit
    return float(np.sqrt((np.square(gap) + np.square(own)).sum(axis=-1).mean()))


def facing_deg(body: np.ndarray, fps: float) -> tuple[float, float]:
    """Where the left sides of hips and shoulders of poses (F, 17, 3) point at last, deg, and how fast they turn, deg/s.

    Both are those of a straight line through all poses: one who moves his arms twists his trunk to and fro.
    """
    sides = body[:, _SIDES, :2]
    across = sides[:, [1, 3]].sum(axis=1) - sides[:, [0, 2]].sum(axis=1)
    angle = np.degrees(np.unwrap(np.arctan2(across[:, 1], across[:, 0])))
    time = (np.arange(len(angle)) - len(angle) + 1) / fps
    turn, last = np.polyfit(time, angle, 1)
    return float(last), float(turn)
