"""A camera fixed to the body: an orbit that would lose the person is refused."""

import dataclasses
import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from drocap_ros.flight.autopilot.ardupilot import ARDUPILOT
from drocap_ros.flight.autopilot.px4 import PX4
from drocap_ros.flight.bridge_config import MavlinkBridgeConfig, goal_of
from drocap_ros.flight.conditions import ConditionCode
from drocap_ros.flight.orbit.controller import OrbitController
from drocap_ros.flight.orbit.states import Command, State
from drocap_ros.flight.subject.framing import Framing, View, framing_margin, nearest_framed
from drocap_ros.flight.vehicle import VehicleState, camera_rotation
from drocap_ros.simulation.pinhole import pinhole_matrix, project
from drocap_ros.simulation.vehicle.mount import tilted_camera
from lab.flights.orbit_loop import LoopSettings, OrbitLoop, with_config

SIZE = (1280, 720)
MATRIX = pinhole_matrix(*SIZE, 60.0)
CONFIG = MavlinkBridgeConfig(mount="fixed", camera_pitch_deg=-11.0)


def framing(config=CONFIG, wind_m_s2=0.0):
    """Framing that has watched a hover in this wind."""
    watched = Framing(config)
    watched.matrix, watched.size = MATRIX, SIZE
    lean = Rotation.from_euler("y", math.atan2(wind_m_s2, 9.81)).as_quat()  # nose east, wind from the east
    hover = VehicleState(1, orientation_xyzw=lean)
    for _ in range(400):
        watched.watch(hover, np.zeros(3), 0.05)
    return watched


@pytest.mark.parametrize(("ahead", "left", "pitch"), [(0.1, 0.05, -0.25), (-0.2, 0.15, -0.8), (0.0, -0.1, 0.0)])
def test_margin_equals_the_projection_of_the_person(ahead, left, pitch):
    body = Rotation.from_euler("ZYX", [0, ahead, -left]).as_quat()
    rotation = camera_rotation(tilted_camera(body, pitch))
    corners = np.array([[6.0, y, z] for y in (-0.3, 0.3) for z in (0.0, 1.8)])
    px = project(corners[None], rotation[None], np.array([[0.0, 0.0, 2.5]]), MATRIX)[0]
    expected = min(px.min(), (np.array(SIZE) - px).min()) / SIZE[1]
    margin = framing_margin(View(MATRIX, SIZE, pitch), 6.0, 2.5, 1.7, np.array([ahead]), np.array([left]))
    assert margin[0] == pytest.approx(expected, abs=1e-9)


def test_a_person_behind_the_camera_is_outside():
    behind = framing_margin(View(MATRIX, SIZE, 1.5), 1.0, 2.5, 1.7, np.array([0.0]), np.array([0.0]))
    assert behind[0] == -1.0


@pytest.mark.parametrize(("pitch", "height_m"), [(-0.2, 2.5), (0.1, 1.2), (-0.5, 5.0)])
def test_at_the_nearest_framed_distance_the_person_touches_the_border(pitch, height_m):
    view, level = View(MATRIX, SIZE, pitch), np.zeros(1)
    nearest = nearest_framed(view, height_m, 1.7)
    assert framing_margin(view, nearest, height_m, 1.7, level, level)[0] == pytest.approx(0.0, abs=1e-6)


def test_a_camera_that_looks_above_the_ground_frames_nobody():
    assert nearest_framed(View(MATRIX, SIZE, 0.6), 2.5, 1.7) == math.inf


def test_the_radius_grows_with_the_speed_of_one_who_walks_and_for_a_fixed_camera_only():
    watched = framing()
    slow, fast = (watched.least_radius(goal_of(CONFIG), speed, PX4.gives_way_s) for speed in (0.6, 1.4))
    assert watched.least_radius(goal_of(CONFIG), 0.2, PX4.gives_way_s) == 0.0
    assert slow < 6.0 < fast
    assert watched.least_radius(goal_of(CONFIG), 1.4, ARDUPILOT.gives_way_s) < fast
    assert watched.least_radius(goal_of(CONFIG), 50.0, PX4.gives_way_s) == CONFIG.max_distance_m
    assert Framing(MavlinkBridgeConfig()).least_radius(goal_of(CONFIG), 1.4, PX4.gives_way_s) == 0.0


def test_px4_keeps_one_who_walks_in_the_picture_of_a_fixed_camera_and_says_how_far_away():
    """He came nearer at 6 m until feet and knees were cut off, was lost, and the orbit ended after 15 s."""
    settings = LoopSettings(autopilot="px4", mount="fixed", action="walk", seed=2, seconds=27)
    loop = OrbitLoop(with_config(settings, body_height_m=settings.stature_m, size_error=0.04))
    loop.start()
    said = []
    loop.run(26.0, lambda flown: said.append(flown.status.condition) if flown.status else None)
    assert loop.controller.safety.state == State.ORBITING
    assert any("instead of 6.0: there the fixed camera keeps" in str(condition) for condition in said)


def test_the_orbit_is_refused_that_loses_the_person():
    flat = dataclasses.replace(CONFIG, camera_pitch_deg=4.0)
    refusal = framing(flat).refusal(goal_of(flat))
    assert refusal.code == ConditionCode.PERSON_LEAVES_PICTURE
    assert framing(CONFIG).refusal(goal_of(flat)) is None
    assert framing(flat).refusal(goal_of(flat, radius_m=18.0)) is None


def test_wind_allows_slower_orbits_only():
    config = dataclasses.replace(CONFIG, camera_pitch_deg=-15.0)  # aimed for an orbit that leans little
    goal = goal_of(config)
    assert framing(config).refusal(goal) is None
    refusal = framing(config, wind_m_s2=0.7).refusal(goal)
    assert refusal.code == ConditionCode.PERSON_LEAVES_PICTURE
    assert framing(config, wind_m_s2=0.7).refusal(goal_of(config, angular_speed_deg_s=2.0)) is None


def test_only_a_fixed_camera_is_checked():
    for mount in ("auto", "gimbal", "servo"):
        config = dataclasses.replace(CONFIG, mount=mount, camera_pitch_deg=30.0)
        assert framing(config).refusal(goal_of(config)) is None
    blank = Framing(dataclasses.replace(CONFIG, camera_pitch_deg=30.0))
    assert blank.refusal(goal_of(CONFIG)) is None  # no calibration yet: another condition says so


@pytest.mark.parametrize("commanded", [False, True])
def test_a_mount_that_does_not_follow_is_checked_at_the_pitch_that_it_reports(commanded):
    config = MavlinkBridgeConfig(gimbal_control=commanded)
    mount, low, high = Framing(config), goal_of(config), goal_of(config, height_m=6.0)
    mount.matrix, mount.size = MATRIX, SIZE
    down = Rotation.from_euler("y", math.radians(14)).as_quat()
    mount.watch(VehicleState(1, gimbal_orientation_xyzw=down), np.zeros(3), 0.05)
    assert (mount.refusal(high) is None) == commanded
    mount.follows = False  # a refusal of the autopilot
    assert mount.refusal(low) is None
    refusal = mount.refusal(high)
    assert refusal.code == ConditionCode.PERSON_LEAVES_PICTURE
    aimed = Rotation.from_euler("y", math.radians(40)).as_quat()
    mount.watch(VehicleState(1, gimbal_orientation_xyzw=aimed), np.zeros(3), 0.05)
    assert mount.refusal(high) is None
    mount.watch(VehicleState(1), np.zeros(3), 0.05)  # another condition says that its pitch is unknown
    assert mount.refusal(low) is None


def test_an_adjustment_that_takes_the_person_out_of_a_still_mounts_picture_is_refused():
    loop = OrbitLoop(LoopSettings(seconds=6, seed=1))
    loop.start()
    loop.run(4.5)
    loop.command(Command.ADJUST, height_m=8.0)
    loop.run(4.7)
    _, answer = loop.answers[-1]
    assert (answer.accepted, answer.condition.code) == (False, ConditionCode.PERSON_LEAVES_PICTURE)
    assert loop.controller.safety.state == State.ORBITING


def test_a_slow_change_of_the_camera_counts_once_it_adds_up_to_more_than_three_percent():
    framed = Framing(CONFIG)
    steps = [framed.calibrate(MATRIX * np.array([[scale], [scale], [1.0]])) for scale in (1.0, 1.02, 1.04, 1.06, 1.0)]
    changed = ConditionCode.CAMERA_CHANGED
    assert [step and step.code for step in steps] == [None, None, changed, None, changed]
    assert framed.calibrate(MATRIX + np.array([[0, 0, 60.0], [0, 0, 0], [0, 0, 0]])).code == changed


def test_a_zoom_ends_the_orbit_and_a_new_start_flies_by_the_new_camera():
    loop = OrbitLoop(LoopSettings(seed=1, seconds=18))
    loop.start()
    loop.run(8.0)
    assert loop.controller.safety.state == State.ORBITING
    loop.matrix = pinhole_matrix(*SIZE, 50.0)
    loop.controller.on_camera(loop.matrix)
    loop.run(8.1)
    assert (loop.status.state, loop.status.condition.code) == (State.HOLDING, ConditionCode.CAMERA_CHANGED)
    loop.run(12.0)
    assert loop.status.state == State.HOLDING
    loop.command(Command.ENGAGE)
    loop.run(18.0)
    assert loop.status.state == State.ORBITING
    assert loop.rows[-1].distance_m == pytest.approx(loop.settings.config.radius_m, abs=1.0)


def test_a_missing_camera_info_is_named_until_it_arrives():
    loop = OrbitLoop(LoopSettings(seed=1))
    loop.controller = OrbitController(loop.link, loop.settings.config, loop.watchdog)
    loop.start()
    loop.run(4.5)
    _, answer = loop.answers[-1]
    assert not answer.accepted
    assert loop.status.condition.code == answer.condition.code == ConditionCode.NO_CAMERA_INFO
    loop.controller.on_camera(loop.matrix)
    loop.run(7.0)
    assert loop.status.condition.code == ConditionCode.ALL_CLEAR
