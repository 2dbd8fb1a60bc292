"""How well the demo's flight and reconstruction agree with the simulated truth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from drocap_ros.evaluation.metrics import pa_mpjpe, scale_error
from drocap_ros.flight.orbit.states import State
from drocap_ros.recording.session import COMPRESSED_IMAGE, POSE2D, POSE3D, Session, header_stamp_ns
from drocap_ros.simulation.flight_simulator.truth import FlightTruth, OrbitQuality, orbit_quality

ORBIT_STATUS = "drocap_ros/msg/OrbitStatus"
#: After the start of an orbit: radius, height and angular speed are still being reached.
RAMP_S = 6.0


@dataclass(frozen=True)
class LivePoses:
    """Poses of ``pose3d/latest`` against the truth: mean error, m; scale error; frame_id of the last one."""

    count: int
    error_m: float
    scale_error: float
    frame: str


@dataclass(frozen=True)
class FlightVerdict:
    """Comparison of the recorded flight with the truth.

    exposures, pictures, poses, seen : exposed in the simulation; recorded; with a Pose2D; with the subject in it
    orbit : quality after the ramp; None where nothing is left after it
    """

    exposures: int
    pictures: int
    poses: int
    seen: int
    orbit: OrbitQuality | None
    live: LivePoses | None


def judge_flight(session: Session, truth: FlightTruth, radius_m: float) -> FlightVerdict:
    """Compare a recorded session with the truth of its flight."""
    pictures = [t.count for t in session.info.topics if t.type_name == COMPRESSED_IMAGE]
    poses = [bool(m.track_id) for _, m in session.messages(_names(session, POSE2D, "pose2d"))]
    statuses = [
        (header_stamp_ns(m), State(m.state)) for _, m in session.messages(_names(session, ORBIT_STATUS, "orbit/status"))
    ]
    settled = settled_orbit(truth.stamp_ns, statuses)
    return FlightVerdict(
        exposures=len(truth.stamp_ns),
        pictures=sum(pictures),
        poses=len(poses),
        seen=sum(poses),
        orbit=orbit_quality(truth, settled, radius_m) if int(settled.sum()) > 1 else None,
        live=_live(session, truth),
    )


def settled_orbit(stamp_ns: np.ndarray, statuses: list[tuple[int, State]]) -> np.ndarray:
    """(F,) bool, instants at which the bridge had been orbiting for longer than the ramp.

    ``statuses`` : increasing stamps with the state at each
    """
    settled = np.zeros(len(stamp_ns), bool)
    since: int | None = None
    for now_ns, state in [*statuses, (np.iinfo(np.int64).max, State.IDLE)]:
        if state == State.ORBITING:
            since = now_ns if since is None else since
        elif since is not None:
            last = min(now_ns, statuses[-1][0])
            settled |= (stamp_ns >= since + RAMP_S * 1e9) & (stamp_ns < last)
            since = None
    return settled


def _live(session: Session, truth: FlightTruth) -> LivePoses | None:
    estimates, places, frame = [], [], ""
    at = {int(stamp): i for i, stamp in enumerate(truth.stamp_ns)}
    for _, message in session.messages(_names(session, POSE3D, "pose3d/latest")):
        joints = np.asarray(message.joints, dtype=np.float64).reshape(-1, 3)
        place = at.get(header_stamp_ns(message))
        if place is not None and np.isfinite(joints).all() and len(joints) == truth.joints3d.shape[1]:
            estimates.append(joints)
            places.append(place)
            frame = str(message.header.frame_id)
    if not estimates:
        return None
    estimate, true = np.array(estimates), truth.joints3d[places]
    return LivePoses(len(places), float(pa_mpjpe(estimate, true).mean()), scale_error(estimate, true), frame)


def _names(session: Session, type_name: str, end: str) -> list[str]:
    return [t.name for t in session.topics_of(type_name) if t.name.endswith("/" + end)] or ["/none"]
