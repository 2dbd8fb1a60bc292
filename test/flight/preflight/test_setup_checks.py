"""Checks that need no vehicle: picture, camera, limits, body."""

import dataclasses
import re

import numpy as np
import pytest

from drocap_ros.flight.autopilot.autopilot import Level
from drocap_ros.flight.bridge_config import MavlinkBridgeConfig
from drocap_ros.flight.preflight.setup_checks import Setup, best_pitch_deg, person_in_picture, setup_findings
from drocap_ros.flight.vehicle import VehicleState
from drocap_ros.simulation.pinhole import pinhole_matrix, project
from lab.simulation.orbit import look_at

MATRIX = pinhole_matrix(1280, 720, 60.0)
SETUP = Setup(MATRIX, (1280, 720), "calibrated", True, "/dev/video0", 1.7, "models")
CONFIG = MavlinkBridgeConfig(commands_enabled=True, size_error=0.04)
FIXED = dataclasses.replace(CONFIG, mount="fixed")


def findings(config=CONFIG, setup=SETUP):
    return {finding.code: finding for finding in setup_findings(config, setup)}


def test_a_good_setup_has_no_findings():
    assert {finding.level for finding in findings().values()} == {Level.OK}


def test_rows_of_the_person_are_those_of_the_projection():
    eye, middle = np.array([[-6.0, 0, 2.5]]), np.array([[0.0, 0, 0.85]])
    rotation = look_at(eye, middle)
    rows = project(np.array([[[0.0, 0, 1.7], [0, 0, 0]]]), rotation, eye, MATRIX)[0, :, 1]
    pitch = np.degrees(np.arctan2(2.5 - 0.85, 6.0))
    assert person_in_picture(CONFIG, MATRIX, pitch)[:2] == pytest.approx(tuple(rows), abs=0.01)


def test_the_best_pitch_has_the_person_in_the_middle():
    fit = person_in_picture(CONFIG, MATRIX, best_pitch_deg(CONFIG))
    assert (fit.head_px + fit.feet_px) / 2 == pytest.approx(360, abs=3)


def test_a_level_fixed_camera_loses_the_feet_and_the_remedy_is_its_tilt():
    narrow = SETUP._replace(camera_matrix=pinhole_matrix(1280, 720, 55.0))
    picture = findings(FIXED, narrow)["picture"]
    assert picture.level == Level.MISSING
    tilt = re.match(r"tilt the camera to (-\d+) deg", picture.remedy)
    tilted = dataclasses.replace(FIXED, camera_pitch_deg=float(tilt[1]))
    assert findings(tilted, narrow)["picture"].level == Level.WARNING  # of wind
    assert "wind" in findings(tilted, narrow)["picture"].remedy
    assert findings(tilted, SETUP._replace(camera_matrix=pinhole_matrix(1280, 720, 80.0)))["picture"].level == Level.OK


@pytest.mark.parametrize(("autopilot", "said"), [("ardupilot", False), ("px4", True)])
def test_a_fixed_camera_states_the_radius_about_one_who_walks(autopilot, said):
    aimed = dataclasses.replace(FIXED, camera_pitch_deg=-best_pitch_deg(FIXED))
    vehicle = VehicleState(1, autopilot=autopilot)
    remedy = next(f.remedy for f in setup_findings(aimed, SETUP, vehicle) if f.code == "picture")
    assert ("about one who walks at 1.4 m/s the orbit is flown at 6.5 m" in remedy) == said


def test_a_person_too_large_or_too_small_for_the_picture():
    close = dataclasses.replace(CONFIG, radius_m=3.5, angular_speed_deg_s=10.0)
    long_lens = SETUP._replace(camera_matrix=pinhole_matrix(1280, 720, 25.0))
    picture = findings(close, long_lens)["picture"]
    assert picture.level == Level.MISSING
    assert "fly at least 14 m away" in picture.remedy
    small = Setup(pinhole_matrix(320, 240, 90.0), (320, 240), "", True, "/dev/video0", 1.7, "models")
    assert findings(CONFIG, small)["picture"].level == Level.MISSING
    assert findings(CONFIG, small)["picture"].values["height_px"] == pytest.approx(43, abs=2)


@pytest.mark.parametrize(
    ("setup", "code", "level", "words"),
    [
        ({"camera_matrix": None, "camera_words": "none"}, "camera", Level.MISSING, "calibration_file"),
        ({"calibrated": False}, "camera", Level.WARNING, "calibrate"),
        ({"source": "rtsp://drone/video"}, "camera_latency", Level.WARNING, "1.9 deg aside"),
        ({"source": ""}, "perception", Level.MISSING, "image_ingest.source"),
        ({"models": "", "models_remedy": "fetch them"}, "perception", Level.MISSING, "fetch them"),
        ({"assumed_height_m": 1.8}, "body_height", Level.WARNING, "assumed_height_m (1.8)"),
    ],
)
def test_what_is_missing_around_the_bridge(setup, code, level, words):
    finding = findings(setup=SETUP._replace(**setup))[code]
    assert finding.level == level
    assert words in finding.remedy


def test_a_stated_latency_of_the_camera_is_the_remedy_of_late_stamps():
    stream = SETUP._replace(source="rtsp://drone/video")
    assert "camera_latency_s" in findings(setup=stream)["camera_latency"].remedy
    stated = findings(dataclasses.replace(CONFIG, camera_latency_s=0.2), stream)["camera_latency"]
    assert (stated.level, stated.found[:5]) == (Level.OK, "0.2 s")


@pytest.mark.parametrize(
    ("values", "code", "level", "words"),
    [
        ({"commands_enabled": False}, "commands_enabled", Level.MISSING, "set commands_enabled to true"),
        ({"size_error": 0.08}, "body_height", Level.WARNING, "measure the person"),
        ({"fence_radius_m": 9.0}, "limits", Level.WARNING, "widen fence_radius_m"),
        ({"max_speed_m_s": 2.5}, "limits", Level.WARNING, "raise max_speed_m_s"),
        ({"blind_hold_s": 1.0}, "limits", Level.WARNING, "raise blind_hold_s"),
    ],
)
def test_what_is_missing_in_the_bridges_parameters(values, code, level, words):
    finding = findings(dataclasses.replace(CONFIG, **values))[code]
    assert finding.level == level
    assert words in finding.remedy
