"""The real bridge process, stopped, killed and restarted in flight; ``benchmarks/flight_faults.py processes`` flies the
whole table with its bounds."""

import os
import signal
import sys
from pathlib import Path

import numpy as np

from drocap_ros.flight.conditions import ConditionCode
from drocap_ros.flight.orbit.states import State
from lab.flights.fault_causes import TIMEOUT
from lab.flights.orbit_loop import LoopSettings

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "benchmarks"))

from flight_processes import SCHEDULING_S, scene


def test_stopped_or_killed_bridge_never_resumes_its_orbit():
    # The orbit before the fault must not end by itself on a machine that runs other tests beside this one.
    with scene("ardupilot", max_state_age_s=0.5, watchdog_s=0.5) as flying:
        flying.orbit(4.0)
        copter = flying.drone.copter
        assert np.linalg.norm(copter.body.velocity) > 0.8
        os.kill(flying.bridge, signal.SIGSTOP)
        place, first = copter.body.position.copy(), len(flying.drone.rows)
        speed = max(np.linalg.norm(copter.body.velocity), np.linalg.norm(copter.target.velocity))
        flying.listen(1.5)
        os.kill(flying.bridge, signal.SIGCONT)
        flying.wait(State.HOLDING, 5.0)
        assert flying.statuses[-1].condition == ConditionCode.CONTROL_LOOP_STALLED
        flying.listen(1.0)
        assert flying.statuses[-1].state == int(State.HOLDING)
        assert copter.motion_until_s < flying.drone.t - 1.5  # by the autopilot's own time-out, and never again
        os.kill(flying.bridge, signal.SIGKILL)
        flying.listen(0.3)
        taken = copter.accepted_setpoints
        with flying.new_bridge():
            flying.wait(State.READY)
            flying.listen(1.0)
        assert {m.state for m in flying.statuses} <= {int(State.IDLE), int(State.READY)}
        assert copter.accepted_setpoints == taken
        assert copter.mode in ("GUIDED", "BRAKE")
        # Half a second of flight and the stop, as for any death of the process.
        farthest = max(np.linalg.norm((row[1] - place)[:2]) for row in flying.drone.rows[first:])
        assert farthest < TIMEOUT.bounds(LoopSettings(), speed).excursion_m + SCHEDULING_S * speed
