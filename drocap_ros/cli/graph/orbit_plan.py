"""``drocap orbit plan``: a picture of the flight that a plan would have chosen for a recorded session, and why."""

from __future__ import annotations

import itertools
import math
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from drocap_ros.errors import InputError
from drocap_ros.stamps import NS

if TYPE_CHECKING:
    from drocap_ros.flight.bridge_config import MavlinkBridgeConfig
    from drocap_ros.flight.orbit.planner import OrbitState
    from drocap_ros.flight.orbit.view_plan import ViewForecast
    from drocap_ros.flight.orbit_goal import Wish

_STEP_S = 0.1
_LEAST_S = 5.0  # of poses, for a picture worth drawing
_EVERY_S = 2.0  # between forecasts: a third of a second of work each


class _Recorded(NamedTuple):
    """Refined poses in ``map``: times (F,) s, joints (F, 17, 3) m; bearing of the camera at first, rad."""

    time_s: np.ndarray
    joints: np.ndarray
    bearing: float


class _Flight(NamedTuple):
    """A flight beside the person: positions (T, 3) m, bearings (T,) rad, expected errors (T,) mm; NaN = no forecast."""

    position: np.ndarray
    bearing: np.ndarray
    expected_mm: np.ndarray


def preview(session: Path, out: Path, config: MavlinkBridgeConfig) -> str:
    """Draw the picture; returns a line about it."""
    from drocap_ros.cli.atomic_output import check_output_file, output_file

    check_output_file(out)
    recorded = _read(session)
    forecasts = _forecasts(recorded)
    steady, planned, wishes = _fly(recorded, forecasts, config)
    with output_file(out, inputs=[session]) as file:
        _draw(file, recorded, (steady, planned), wishes)
    before, after = (float(np.nanmean(flight.expected_mm)) for flight in (steady, planned))
    return (
        f"{out}: {recorded.time_s[-1]:.0f} s, joints within {after:.0f} mm are expected of the plan, {before:.0f} mm "
        f"of the steady orbit; {len(wishes)} choices"
    )


def _read(session: Path) -> _Recorded:
    from drocap_ros.recording.open_session import open_session
    from drocap_ros.recording.pose_messages import float_array
    from drocap_ros.recording.session import POSE3D_WINDOW, header_stamp_ns
    from drocap_ros.skeleton import BODY_17

    poses: dict[int, np.ndarray] = {}
    first = math.nan
    with open_session(session) as recording:
        topic = recording.choose_topic(POSE3D_WINDOW).name
        for _, window in recording.messages((topic,)):
            for pose in window.poses if window.header.frame_id == "map" else ():
                if pose.skeleton == BODY_17.name:
                    poses[header_stamp_ns(pose)] = float_array(pose.joints, (len(BODY_17), 3), "joints")
                    turn = pose.camera_orientation
                    # The camera's forward axis in `map`, turned round.
                    ahead = 2 * (turn.x * turn.z - turn.y * turn.w), 2 * (turn.y * turn.z + turn.x * turn.w)
                    first = math.atan2(-ahead[1], -ahead[0]) if math.isnan(first) else first
    stamps = np.array(sorted(poses), dtype=np.int64)
    if len(stamps) < 2 or stamps[-1] - stamps[0] < _LEAST_S * NS:
        found = f"{(stamps[-1] - stamps[0]) / NS:.1f} s" if len(stamps) else "none"
        raise InputError(
            f"{session}: expected {_LEAST_S:g} s of refined poses in map ({topic}), found {found}; record a flight "
            "with telemetry"
        )
    return _Recorded((stamps - stamps[0]) / NS, np.stack([poses[stamp] for stamp in stamps.tolist()]), first)


def _forecasts(recorded: _Recorded) -> list[tuple[float, ViewForecast]]:
    """Forecasts with their times, from the poses until then."""
    from drocap_ros.reconstruction.lifted.lifter import Lifter
    from drocap_ros.reconstruction.live.view_forecast import ViewForecaster

    forecaster, found = ViewForecaster(Lifter.load()), []
    for now_s in np.arange(_EVERY_S, recorded.time_s[-1], _EVERY_S).tolist():
        past = recorded.time_s <= now_s
        views = forecaster.forecast(np.round(recorded.time_s[past] * NS).astype(np.int64), recorded.joints[past])
        found += [(now_s, views)] if views is not None else []
    if not found:
        raise InputError("expected poses of two seconds without a gap, found none; record a longer flight")
    return found


def _fly(
    recorded: _Recorded, forecasts: list[tuple[float, ViewForecast]], config: MavlinkBridgeConfig
) -> tuple[_Flight, _Flight, list[tuple[float, Wish]]]:
    """The steady and the planned flight from the camera's first bearing on, and the wishes with their times."""
    from drocap_ros.flight.autopilot import autopilot_of
    from drocap_ros.flight.autopilot.autopilot import greatest_speed
    from drocap_ros.flight.orbit.view_plan import choose_view, fly_plan, reach_of
    from drocap_ros.flight.orbit_goal import goal_of

    goal, autopilot = goal_of(config), autopilot_of("ardupilot")
    fastest = greatest_speed(autopilot, config.max_control_timeout_s, autopilot.coast.steady * config.max_coast_m)
    reach = reach_of(config, goal, goal.radius_m, fastest)
    time = np.arange(0.0, recorded.time_s[-1], _STEP_S)
    person = recorded.joints.mean(axis=1)
    subject = np.stack([np.interp(time, recorded.time_s, values) for values in person.T], axis=-1)
    subject[:, 2] = 0.0
    wishes: list[tuple[float, Wish]] = []
    waiting = list(forecasts)

    def wish(frame: int, state: OrbitState) -> Wish | None:
        former = wishes[-1][1] if wishes else None
        while waiting and waiting[0][0] <= time[frame]:
            now_s, views = waiting.pop(0)
            wished = choose_view(views, (state.phase, state.height.value), reach, former, now_s)
            if former is None or wished[:2] != former[:2]:
                wishes.append((now_s, wished))
            former = wished
        return former

    begin = subject[0] + goal.radius_m * np.array([math.cos(recorded.bearing), math.sin(recorded.bearing), 0.0])
    begin[2] = goal.height_m
    paths = [fly_plan(config, goal, subject, _STEP_S, fastest, chosen, begin) for chosen in (lambda *_: None, wish)]
    flights = [_Flight(*path, _expected_mm(time, path, forecasts, goal.radius_m)) for path in paths]
    return flights[0], flights[1], wishes


def _expected_mm(
    time: np.ndarray, path: tuple[np.ndarray, np.ndarray], forecasts: list[tuple[float, ViewForecast]], radius_m: float
) -> np.ndarray:
    """(T,) mm, by the last forecast; NaN before the first."""
    found = np.full(len(time), np.nan)
    ends = [begin for begin, _ in forecasts[1:]] + [math.inf]
    for (begin, views), end in zip(forecasts, ends, strict=True):
        at = (time >= begin) & (time < end)
        found[at] = 1e3 * views.expected_m(np.degrees(path[1][at]), path[0][at, 2], radius_m)
    return found


def _draw(file: Path, recorded: _Recorded, flights: tuple[_Flight, _Flight], wishes: list[tuple[float, Wish]]) -> None:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    steady, planned = flights
    time = np.arange(len(planned.bearing)) * _STEP_S
    figure = Figure(figsize=(11, 7), layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.add_gridspec(3, 2, width_ratios=(1.1, 1.0), height_ratios=(1.0, 1.0, 0.8))
    above, height, error, why = (
        figure.add_subplot(grid[place]) for place in ((slice(None), 0), (0, 1), (1, 1), (2, 1))
    )
    above.plot(*steady.position[:, :2].T, color="0.7", lw=1, label="steady orbit")
    points = above.scatter(planned.position[:, 0], planned.position[:, 1], s=6, c=time, cmap="viridis", label="plan")
    above.plot(*recorded.joints.mean(axis=1)[:, :2].T, color="tab:red", lw=1.5, label="person")
    for number, (at_s, _) in enumerate(wishes, 1):
        x, y, _ = planned.position[round(at_s / _STEP_S)].tolist()
        above.annotate(str(number), (x, y), weight="bold")
    above.set(title="from above", xlabel="east, m", ylabel="north, m", aspect="equal")
    above.legend(loc="upper right")
    figure.colorbar(points, ax=above, label="time, s", shrink=0.6)
    for flight, style, name in ((steady, "0.6", "steady orbit"), (planned, "tab:blue", "plan")):
        height.plot(time, flight.position[:, 2], color=style, label=name)
        error.plot(time, flight.expected_mm, color=style, label=name)
    height.set(ylabel="height, m", ylim=(0.0, None))
    error.set(ylabel="expected deviation\nof the joints, mm", xlabel="time, s", ylim=(0.0, None))
    error.legend()
    why.axis("off")
    lines = [
        f"{number}  {at_s:.0f} s, {wish.height_m:.1f} m: {wish.why}" for number, (at_s, wish) in enumerate(wishes, 1)
    ]
    shown = [*itertools.islice(lines, 9), *(["..."] if len(lines) > 9 else [])]
    why.text(0.0, 1.0, "\n".join(shown), va="top", fontsize=7)
    figure.savefig(file, dpi=110)
