"""Listening to a simulated autopilot in simulated time: what is measured, and that nothing moves."""

import dataclasses

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from station_files import station_settings

from drocap_ros.flight.autopilot import autopilot_of
from drocap_ros.flight.autopilot.autopilot import Level
from drocap_ros.flight.bridge_config import MavlinkBridgeConfig
from drocap_ros.flight.conditions import ConditionCode
from drocap_ros.flight.preflight.measure import Listening, all_findings, is_ready, version_text
from drocap_ros.flight.preflight.setup_checks import Setup
from drocap_ros.simulation.pinhole import pinhole_matrix
from drocap_ros.simulation.vehicle.copter import SimulatedCopter
from drocap_ros.simulation.vehicle.copter_reports import CopterSetup
from drocap_ros.simulation.vehicle.loopback import Channel, LoopbackTransport

FENCE = {
    "ardupilot": {"FENCE_ENABLE": 1.0, "FENCE_TYPE": 3.0, "FENCE_RADIUS": 60.0, "FENCE_ALT_MAX": 50.0},
    "px4": {"GF_ACTION": 2, "GF_MAX_HOR_DIST": 60.0, "GF_MAX_VER_DIST": 50.0, "COM_RC_OVERRIDE": 3},
}
SETUP = Setup(pinhole_matrix(1280, 720, 60.0), (1280, 720), "calibrated", True, "/dev/video0", 1.7, "models")
CONFIG = MavlinkBridgeConfig(commands_enabled=True, mode_change_allowed=True, size_error=0.04)
BOTH = pytest.mark.parametrize("autopilot", ["ardupilot", "px4"])


class Scene:
    """A copter on the ground, and the listener; time is simulated."""

    def __init__(self, autopilot, config=CONFIG, seconds=6.0, before=lambda scene: None, **settings):
        self.t = 0.0
        self.down, self.up = Channel(lambda: self.t, 1), Channel(lambda: self.t, 2)
        self.copter = SimulatedCopter(
            LoopbackTransport(self.up, self.down), np.zeros(3), 0.0, CopterSetup(autopilot, mode="LOITER", seed=3)
        )
        self.copter.armed, self.copter.landed_state = False, 1
        self.copter.settings.update({**FENCE[autopilot], **settings})
        self.port = LoopbackTransport(self.down, self.up)
        listening = Listening(
            config, seconds, clock_ns=lambda: int((self.t + 1e9) * 1e9), monotonic_s=lambda: self.t,
            transport=self.port,
        )  # fmt: skip
        with pytest.raises(AssertionError):  # whoever asks
            listening.link.send_motion(listening.link.mav.set_position_target_local_ned_encode(0, 1, 1, 1, *[0] * 12))
        before(self)
        while not listening.done:
            self.t += 0.01
            self.step()
            listening.turn(0.0)
        self.measured = listening.measured()
        self.findings = {f.code: f for f in all_findings(config, SETUP, self.measured)}

    def step(self):
        self.copter.fly(self.t)

    def missing(self):
        return {code for code, finding in self.findings.items() if finding.level == Level.MISSING}


def test_a_ground_station_on_the_link_is_named():
    def station(scene):
        link = LoopbackTransport(scene.up, scene.down)
        mav = mavlink.MAVLink(None, srcSystem=255, srcComponent=190)
        scene.step_before = scene.step

        def step():
            scene.step_before()
            link.write(mavlink.MAVLink_heartbeat_message(mavlink.MAV_TYPE_GCS, 8, 0, 0, 4, 3).pack(mav))

        scene.step = step

    assert "others" not in Scene("px4").findings
    found = Scene("px4", before=station).findings["others"]
    assert found.found == "ground station 255/190"
    assert found.level == Level.OK


def _packet(system, component):
    mav = mavlink.MAVLink(None, srcSystem=system, srcComponent=component)
    return mavlink.MAVLink_heartbeat_message(mavlink.MAV_TYPE_GCS, 8, 0, 0, 4, 3).pack(mav)


@pytest.mark.parametrize(
    ("packet", "who", "level"),
    [
        (_packet(255, 190), "255/190", Level.OK),
        (_packet(1, 154), "1/154", Level.OK),
        (_packet(1, 1), "1/1", Level.WARNING),
        (b"hello", "no MAVLink", Level.OK),
    ],
)
def test_every_address_beside_the_autopilots_is_named(packet, who, level):
    own, foreign = ("10.0.0.2", 14550), ("10.0.0.7", 5000)

    def speak(scene):
        read, port = scene.port.read, scene.port

        def read_either(wait_s):
            port.sender = foreign if round(scene.t * 100) % 7 == 0 else own
            return packet if port.sender is foreign else read(wait_s)

        port.read, port.port = read_either, lambda: (-1, own)

    found = Scene("px4", before=speak).findings["others"]
    assert f"10.0.0.7:5000 ({who})" in found.found
    assert "10.0.0.2" not in found.found
    assert found.level == level
    assert bool(found.remedy) == (level == Level.WARNING)


@BOTH
def test_a_vehicle_with_everything_set_is_ready_on_the_ground(autopilot):
    scene = Scene(autopilot)
    assert is_ready(scene.findings.values()), scene.missing()
    warnings = {code for code, finding in scene.findings.items() if finding.level == Level.WARNING}
    assert warnings <= {"rate_heartbeat"}
    lacking = {check.name.lower() for check in autopilot_of(autopilot).checks if not check.always}
    assert not lacking & scene.findings.keys()
    assert scene.findings["rate_attitude_quaternion"].values["real_hz"] == pytest.approx(50, rel=0.05)
    assert scene.findings["round_trip"].values["median_s"] == pytest.approx(0.02, abs=0.01)
    assert scene.findings["clock_offset"].values["spread_s"] < 0.01
    assert "on the ground, not armed" in scene.findings["phase"].found


@BOTH
def test_with_the_file_that_the_ground_station_loads_nothing_is_missing_and_nothing_warns(autopilot):
    loaded = station_settings(autopilot)
    judged = set(autopilot_of(autopilot).preflight_names) - {autopilot_of(autopilot).mount_type_setting}
    assert judged == loaded.keys()

    def load(scene):
        mount = scene.copter.settings.get("MNT1_TYPE")
        scene.copter.settings = loaded if mount is None else {**loaded, "MNT1_TYPE": mount}

    scene = Scene(autopilot, before=load)
    found = {code: finding for code, finding in scene.findings.items() if finding.level >= Level.WARNING}
    assert found == {}, found
    assert {name.lower() for name in judged} & scene.findings.keys()
    assert ("one who walks" in scene.findings["autopilot"].found) == (autopilot == "px4")
    assert scene.findings["fence"].found == "60 m wide, 30 m high"


@BOTH
def test_a_link_that_loses_packets_is_named(autopilot):
    def lose(share):
        return lambda scene: setattr(scene.down, "loss", share)

    scene = Scene(autopilot, before=lose(0.5))
    assert "packet_loss" in scene.missing()
    assert scene.findings["packet_loss"].values["lost"] == pytest.approx(0.5, abs=0.2)
    assert Scene(autopilot).findings["packet_loss"].values["lost"] == pytest.approx(0.0, abs=0.02)


@BOTH
def test_nothing_but_requests_for_telemetry_is_sent(autopilot):
    allowed = {"HEARTBEAT", "TIMESYNC", "COMMAND_LONG", "PARAM_REQUEST_READ"}
    scene = Scene(autopilot)
    assert set(scene.copter.received) <= allowed
    assert scene.copter.mode_log == [(0.0, "LOITER", "start")]
    assert scene.copter.accepted_setpoints == 0


@pytest.mark.parametrize(
    ("autopilot", "settings", "code", "words"),
    [
        ("ardupilot", {"GUID_TIMEOUT": 3.0}, "guid_timeout", "set GUID_TIMEOUT to 0.5 on the autopilot"),
        ("px4", {"COM_OF_LOSS_T": 1.0}, "com_of_loss_t", "set COM_OF_LOSS_T to 0.5 on the autopilot"),
        ("px4", {"COM_OBL_RC_ACT": 7}, "com_obl_rc_act", "set COM_OBL_RC_ACT to 5 on the autopilot"),
    ],
)
def test_a_setting_that_forbids_motion_is_missing_with_its_value(autopilot, settings, code, words):
    scene = Scene(autopilot, **settings)
    assert scene.missing() == {code}
    finding = scene.findings[code]
    assert finding.remedy.startswith(words)
    assert finding.found.split()[0] == f"{next(iter(settings.values())):g}"


@pytest.mark.parametrize(
    ("autopilot", "settings", "level"),
    [
        ("ardupilot", {"GUID_OPTIONS": 77.0}, Level.OK),
        ("ardupilot", {"GUID_OPTIONS": 16.0}, Level.MISSING),
        ("ardupilot", {"GUID_OPTIONS": 32.0}, Level.MISSING),
        ("ardupilot", {"GUID_OPTIONS": 128.0}, Level.WARNING),
        ("ardupilot", {"WPNAV_ACCEL": 250.0}, Level.OK),
        ("ardupilot", {"WPNAV_ACCEL": 100.0}, Level.WARNING),
        ("ardupilot", {"WP_ACC": 1.0}, Level.WARNING),
        ("ardupilot", {"FS_THR_ENABLE": 0.0}, Level.WARNING),
        ("ardupilot", {"FS_OPTIONS": 16.0}, Level.OK),
        ("ardupilot", {"FS_OPTIONS": 20.0}, Level.WARNING),
        ("px4", {"MPC_XY_VEL_MAX": 12.0}, Level.OK),
        ("px4", {"MPC_XY_VEL_MAX": 4.0}, Level.WARNING),
        ("px4", {"MPC_XY_VEL_MAX": 1.5}, Level.MISSING),
        ("px4", {"COM_RCL_EXCEPT": 3}, Level.OK),
        ("px4", {"COM_RCL_EXCEPT": 4}, Level.WARNING),
        ("px4", {"NAV_RCL_ACT": 2}, Level.OK),
        ("px4", {"NAV_RCL_ACT": 6}, Level.WARNING),
    ],
)
def test_a_setting_that_changes_how_setpoints_are_flown_or_a_pilot_is_lost_is_named(autopilot, settings, level):
    scene = Scene(autopilot, seconds=2.0, **settings)
    ((name, value),) = settings.items()
    finding = scene.findings[name.lower()]
    assert (finding.level, finding.values["value"]) == (level, value)
    assert (name in finding.remedy) == (level > Level.OK)


def test_a_time_out_that_is_not_reported_is_missing():
    scene = Scene("ardupilot", before=lambda scene: scene.copter.settings.clear())
    assert scene.missing() == {"guid_timeout"}
    assert scene.findings["guid_timeout"].found == "not reported"
    assert scene.findings["fence"].level == Level.WARNING


@pytest.mark.parametrize(
    ("autopilot", "settings", "words"),
    [
        ("ardupilot", {"FENCE_ENABLE": 0.0}, "off"),
        ("ardupilot", {"FENCE_RADIUS": 30.0}, "30 m wide, 50 m high"),
        ("ardupilot", {"FENCE_ACTION": 0.0}, "reports only"),
        ("ardupilot", {"FENCE_TYPE": 1.0}, "unlimited wide, 50 m high"),
        ("ardupilot", {"FENCE_ALT_MAX": 15.0}, "60 m wide, 15 m high"),
        ("px4", {"GF_ACTION": 0}, "off"),
        ("px4", {"GF_ACTION": 1}, "warns only"),
        ("px4", {"GF_ACTION": 4}, "stops the motors"),
        ("px4", {"GF_MAX_HOR_DIST": 0.0}, "unlimited wide, 50 m high"),
    ],
)
def test_the_autopilots_fence_is_compared_with_ours(autopilot, settings, words):
    fence = Scene(autopilot, **settings).findings["fence"]
    assert (fence.level, fence.found) == (Level.WARNING, words)
    assert "set " in fence.remedy


@BOTH
def test_low_rates_are_missing_where_a_condition_depends_on_them(autopilot):
    scene = Scene(autopilot, before=lambda scene: setattr(scene.copter, "max_rate_hz", 4.0))
    assert scene.missing() == {"rate_attitude_quaternion", "rate_local_position_ned"}
    assert scene.findings["rate_attitude_quaternion"].values["real_hz"] == pytest.approx(4, abs=0.5)
    assert "port of its own" in scene.findings["rate_local_position_ned"].remedy


def test_one_gap_in_the_telemetry_is_a_warning_and_lists_its_length():
    class Gap(Scene):
        def step(self):
            self.down.cut = 4.5 < self.t < 4.8
            super().step()

    finding = Gap("ardupilot").findings["rate_attitude_quaternion"]
    assert finding.level == Level.WARNING
    assert 0.29 < finding.values["longest_gap_s"] < 0.35
    assert f"longest gap {finding.values['longest_gap_s']:.2f} s" in finding.found


def test_a_link_that_only_receives_has_no_round_trip():
    def one_way(scene):
        scene.up.cut = True
        for number in (31, 32, 33, 24, 1, 193, 245):  # streams that a ground station has asked for
            scene.copter._period_s[number] = 0.02

    scene = Scene("ardupilot", before=one_way)
    assert {"round_trip", "guid_timeout"} <= scene.missing()
    assert "TX" in scene.findings["round_trip"].remedy
    assert "signing_key_file" in scene.findings["round_trip"].remedy


def test_a_slow_uplink_is_a_long_round_trip():
    scene = Scene("ardupilot", before=lambda scene: setattr(scene.up, "delay_s", 0.7))
    assert "round_trip" in scene.missing()


def test_late_telemetry_is_seen_by_its_stamps():
    class Late(Scene):  # a queue that fills after the clocks are synchronized
        def step(self):
            self.down.delay_s = 0.01 if self.t < 2.0 else 0.3
            super().step()

    scene = Late("ardupilot")
    assert "telemetry_delay" in scene.missing()
    assert scene.findings["telemetry_delay"].values["p99_s"] == pytest.approx(0.3, abs=0.06)


@BOTH
def test_health_of_the_vehicle(autopilot):
    def ill(scene):
        scene.copter.gps_lost_s, scene.copter.ekf_failed_s = 0.0, 0.0
        scene.copter.battery = 12

    scene = Scene(autopilot, before=ill, seconds=10.0)
    assert {"satellites", "estimator", "battery"} <= scene.missing()
    assert scene.findings["battery"].found.startswith("12 %")


def test_an_origin_that_is_not_where_the_vehicle_stands_is_named():
    found = Scene("px4", dataclasses.replace(CONFIG, ground_height_m=-2.8)).findings["ground_height_m"]
    assert found.level == Level.WARNING
    assert found.values["stands_m"] == pytest.approx(0.0, abs=0.4)
    assert Scene("px4").findings["ground_height_m"].level == Level.OK


def test_a_battery_monitor_without_a_charge_is_named():
    scene = Scene("ardupilot", before=lambda scene: setattr(scene.copter, "battery", -1))
    assert "battery" in scene.missing()
    assert scene.findings["battery"].found == "15.8 V, no charge"
    assert "BATT_MONITOR" in scene.findings["battery"].remedy


@pytest.mark.parametrize(
    ("gimbal", "values", "settings", "level", "words"),
    [
        (True, {}, {}, Level.OK, "gimbal, angles at 20."),
        (True, {}, {"MNT1_TYPE": 1.0}, Level.OK, "servo, angles at 20."),
        (True, {"mount": "gimbal"}, {"MNT1_TYPE": 1.0}, Level.WARNING, "MNT1_TYPE 1"),
        (True, {"mount": "servo"}, {"MNT1_TYPE": 6.0}, Level.WARNING, "MNT1_TYPE 6"),
        (True, {"mount": "fixed"}, {}, Level.WARNING, "fixed"),
        (False, {}, {}, Level.MISSING, "no mount reports its angles"),
        (False, {"mount": "gimbal"}, {}, Level.MISSING, "no mount reports its angles"),
        (False, {"mount": "fixed", "camera_pitch_deg": -15.0}, {}, Level.OK, "fixed, -15 deg against the body"),
        (False, {"mount": "fixed", "gimbal_control": True}, {}, Level.WARNING, "fixed"),
    ],
)
def test_the_mount_is_compared_with_what_is_configured(gimbal, values, settings, level, words):
    config = dataclasses.replace(CONFIG, **values)
    scene = Scene("ardupilot", config, before=lambda scene: setattr(scene.copter, "gimbal", gimbal), **settings)
    mount = scene.findings["mount"]
    assert mount.level == level
    assert words in mount.found


@pytest.mark.parametrize(
    ("pitch_deg", "gimbal_control", "level", "remedy"),
    [
        (-14.0, False, Level.OK, ""),
        (0.0, False, Level.WARNING, "set gimbal_control to true, or point the mount to -15 deg"),
        (-60.0, False, Level.MISSING, "set gimbal_control to true, or point the mount to -15 deg"),
        (-60.0, True, Level.OK, ""),
    ],
)
def test_the_pitch_of_a_mount_that_the_bridge_does_not_turn_is_compared_with_the_orbit(
    pitch_deg, gimbal_control, level, remedy
):
    config = dataclasses.replace(CONFIG, gimbal_control=gimbal_control)
    picture = Scene("ardupilot", config, before=lambda scene: scene.copter.mount.command(pitch_deg)).findings["picture"]
    assert picture.level == level
    assert picture.remedy.startswith(remedy)
    assert ("mount aims at the person" if gimbal_control else f"mount at {pitch_deg:.0f} deg") in picture.found


def test_px4_needs_the_permission_to_change_the_mode():
    config = dataclasses.replace(CONFIG, mode_change_allowed=False)
    assert Scene("px4", config).missing() == {"engage"}
    assert Scene("ardupilot", config).missing() == set()


def test_silence_and_noise_are_told_apart():
    silent = Scene("ardupilot", before=lambda scene: setattr(scene.down, "cut", True), seconds=2.0)
    assert not silent.measured.heard
    assert silent.missing() == {"link"}
    assert silent.findings["link"].found.startswith("nothing on ")

    class Noise(Scene):
        def step(self):
            self.down.write(bytes(np.random.default_rng(int(self.t * 1e3)).integers(0, 256, 60, dtype=np.uint8)))

    noise = Noise("ardupilot", seconds=2.0)
    assert noise.findings["link"].found.endswith(f"are no MAVLink on {CONFIG.url}")
    assert "baud rate" in noise.findings["link"].remedy


def test_every_condition_of_the_vehicle_that_fails_is_named():
    scene = Scene("ardupilot", before=lambda scene: setattr(scene.copter, "frozen", True))
    named = {code for finding in scene.findings.values() if finding.level > Level.OK for code in finding.conditions}
    assert ConditionCode.POSITION_FROZEN in named
    assert not is_ready(scene.findings.values())


@BOTH
def test_on_the_ground_what_waits_for_the_air_is_named_and_nothing_is_missing(autopilot):
    scene = Scene(autopilot, seconds=2.0)
    waiting = {code for code, finding in scene.findings.items() if finding.level == Level.WAITS}
    assert waiting == {"phase", "subject", "place"} | ({"estimator_flight"} if autopilot == "px4" else set())
    assert is_ready(scene.findings.values())

    def take_off(scene):
        scene.copter.armed, scene.copter.landed_state = True, 2

    flying = Scene(autopilot, before=take_off, seconds=2.0)
    assert not [finding for finding in flying.findings.values() if finding.level == Level.WAITS]
    assert flying.missing() == set()


def test_the_flag_of_rest_counts_as_soon_as_the_vehicle_is_armed():
    scene = Scene("px4", before=lambda scene: setattr(scene.copter, "armed", True), seconds=2.0)
    assert scene.missing() == {"estimator"}


def test_a_critical_state_forbids_a_start():
    def critical(scene):
        beat = scene.copter._heartbeat()
        beat.system_status = mavlink.MAV_STATE_CRITICAL
        scene.copter._heartbeat = lambda: beat

    scene = Scene("ardupilot", before=critical)
    assert scene.missing() == {"condition_autopilot_critical"}


def test_a_ground_station_that_poses_as_an_autopilot_is_no_second_vehicle():
    def station(scene):
        mav = mavlink.MAVLink(None, srcSystem=255, srcComponent=190)
        beat = mav.heartbeat_encode(mavlink.MAV_TYPE_GCS, mavlink.MAV_AUTOPILOT_GENERIC, 0, 0, 4)
        scene.down.write(beat.pack(mav))

    assert "vehicles" not in Scene("ardupilot", before=station).findings


def test_tries_for_the_version_are_kept_for_an_autopilot_that_starts_late():
    silent = Scene("ardupilot", before=lambda scene: setattr(scene.down, "cut", True), seconds=3.0)
    assert "COMMAND_LONG" not in silent.copter.received


def test_version_of_the_firmware():
    assert version_text(0x04060200 | 255) == "4.6.2"
    assert version_text(0x04070000) == "4.7.0-dev"
