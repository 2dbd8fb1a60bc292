"""The one error that explains what fixed points contradict, by simulated telemetry that has it."""

from __future__ import annotations

import numpy as np
import pytest
from fixed_points import MATRIX, Scene, orbit, points_of, seen

from drocap_ros.background import Background
from drocap_ros.camera_path import CameraErrors, CameraPath
from drocap_ros.geometry.rotations import exp_so3
from drocap_ros.reconstruction.camera.fusion import Fusion, fuse_telemetry, with_causes
from drocap_ros.reconstruction.world.telemetry_words import telemetry_words

FPS = 12.0
FRAMES = 90
#: Frames before and behind those that are seen, for reports of another time.
SPARE = 3


@pytest.fixture(scope="module")
def flight() -> Scene:
    return seen(*orbit(FRAMES + 2 * SPARE, FPS), points_of(np.random.default_rng(2), 160), FPS)


def found(flight: Scene, turned_deg: tuple[float, float, float], late: tuple[int, int], wander_m: float) -> dict:
    """The windows' calibration of reports that are turned (pitch, north, roll), late by frames, and wander."""
    part = slice(SPARE, SPARE + FRAMES)
    inside = (flight.frame >= part.start) & (flight.frame < part.stop)
    noise = np.random.default_rng(3).normal(0.0, 0.3, (int(inside.sum()), 2))
    pitch, north, roll = np.deg2rad(turned_deg)
    rotation = exp_so3(np.array([pitch, 0.0, roll])) @ flight.rotation @ exp_so3(np.array([0.0, 0.0, north]))
    time = np.arange(FRAMES)[:, None] / FPS
    wander = wander_m * np.sin(time * [0.11, 0.15, 0.08] + [0.0, 1.0, 2.0])
    attitude, position = (slice(part.start - frames, part.stop - frames) for frames in late)
    stamp_ns = np.round(np.arange(FRAMES) * 1e9 / FPS).astype(np.int64)
    camera = CameraPath(stamp_ns, rotation[attitude], flight.position[position] + wander, MATRIX)
    background = Background(
        (flight.frame[inside] - part.start).astype(np.int32),
        flight.track[inside].astype(np.int64),
        (flight.point[inside] + noise).astype(np.float32),
    )
    fused = fuse_telemetry(camera, background)
    assert isinstance(fused, Fusion)
    measured = with_causes(fused, CameraErrors()).measured
    assert measured is not None
    return measured


@pytest.mark.parametrize(
    ("turned_deg", "late", "wander_m", "cause", "size"),
    [
        ((0.0, 3.0, 0.0), (0, 0), 0.0, "gimbal yaw", 3.0),
        ((0.0, -8.0, 0.0), (0, 0), 0.1, "gimbal yaw", 8.0),
        ((3.0, 0.0, 0.0), (0, 0), 0.0, "gimbal pitch", 3.0),
        ((0.0, 0.0, 2.0), (0, 0), 0.1, "gimbal roll", 2.0),
        ((0.0, 0.0, 0.0), (2, 0), 0.0, "attitude's stamps", 167.0),
        ((0.0, 0.0, 0.0), (0, 2), 0.0, "position's stamps", 167.0),
        ((0.0, 0.0, 0.0), (2, 2), 0.0, "all stamps", 167.0),
        ((0.0, 0.0, 0.0), (-3, -3), 0.0, "all stamps", 250.0),
    ],
)
def test_one_error_is_named_with_its_size(
    flight: Scene,
    turned_deg: tuple[float, float, float],
    late: tuple[int, int],
    wander_m: float,
    cause: str,
    size: float,
) -> None:
    causes = found(flight, turned_deg, late, wander_m)["causes"]
    assert [entry["cause"] for entry in causes] == [cause]
    assert abs(causes[0]["size"]) == pytest.approx(size, rel=0.1)
    assert causes[0]["std"] < 0.15 * size
    assert causes[0]["explains"] > 0.8


@pytest.mark.parametrize("wander_m", [0.0, 0.5, 1.5])
def test_true_reports_and_those_of_a_receiver_that_wanders_have_no_such_cause(flight: Scene, wander_m: float) -> None:
    assert found(flight, (0.0, 0.0, 0.0), (0, 0), wander_m)["causes"] == []


def test_corrections_by_a_cause_have_the_signs_of_the_others(flight: Scene) -> None:
    turned, late = found(flight, (0.0, 3.0, 0.0), (0, 0), 0.0), found(flight, (0.0, 0.0, 0.0), (2, 2), 0.0)
    assert turned["causes"][0]["size"] * turned["misalignment_deg"][1] > 0.0
    assert late["causes"][0]["size"] * late["attitude_latency_s"] > 0.0


def test_causes_stand_in_the_words() -> None:
    window = {
        "misalignment_deg": [0.0, 4.0, 0.0], "misalignment_std_deg": [0.1, 0.1, 0.1],
        "attitude_latency_s": 0.0, "attitude_latency_std_s": 0.01,
        "position_latency_s": 0.09, "position_latency_std_s": 0.01,
        "scale": 1.0, "scale_std": 0.01, "contact_share": 0.5,
    }  # fmt: skip
    yaw = {"cause": "gimbal yaw", "size": 7.6, "std": 0.14, "unit": "deg", "explains": 0.94}
    stamps = {"cause": "all stamps", "size": 166.0, "std": 5.2, "unit": "ms", "explains": 0.93}
    one = telemetry_words({"calibration": [{**window, "causes": [yaw]}]})
    assert one.startswith("Gimbal yaw corrected by 7.6 +- 0.1 deg explains 94 % of what the points contradict; scale")
    both = telemetry_words({"calibration": [{**window, "causes": [yaw, stamps]}]})
    assert "7.6 +- 0.1 deg or all stamps corrected by 166 +- 5 ms explains 94 %" in both
    assert "the points cannot distinguish them" in both
