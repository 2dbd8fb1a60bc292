"""Bodies that lean from a camera above them by an error of the lifter: on their feet or not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from drocap_ros.contacts import ANKLES
from drocap_ros.reconstruction import reconstruct as reconstruction
from drocap_ros.reconstruction.balance import balanced
from drocap_ros.reconstruction.common.poses import ImagePoses, MethodInput
from drocap_ros.skeleton import BODY_17
from lab.simulation.capture import SimulationConfig, simulate_capture
from lab.studies.world_scene import PinholePath, followed_points

NECK = BODY_17.index("neck")


def lean_deg(joints: np.ndarray, rotation: np.ndarray) -> float:
    """Mean lean of feet to neck away from the camera."""
    body = joints[:, NECK] - joints[:, ANKLES].mean(axis=1)
    ahead = rotation[:, 2, :2] / np.linalg.norm(rotation[:, 2, :2], axis=1, keepdims=True)
    return float(np.degrees(np.arctan2((body[:, :2] * ahead).sum(axis=1), body[:, 2])).mean())


def test_who_walks_does_not_lean_from_the_camera_whatever_the_lifter_sees(monkeypatch: pytest.MonkeyPatch) -> None:
    """A lifter that leans by 12 degrees at 45 degrees from above, as it does on real pictures."""
    config = SimulationConfig(
        action="walk", height_m=7.0, attitude_error_deg=0.0, position_error_m=0.0, angular_speed_deg_s=25.0
    )
    capture = simulate_capture(12.0, 15.0, 0, config, 0, BODY_17)
    tracks = capture.tracks
    focal = float(tracks.camera_matrix[0, 0])
    path = PinholePath(capture.camera_position, capture.camera_rotation, focal, tracks.image_size)
    tracks = replace(tracks, background=followed_points(path, capture.joints3d_world, 15.0, 0))
    solve = reconstruction.run_method

    def leaning(method: str, data: MethodInput) -> ImagePoses:
        poses = solve(method, data)
        joints = poses.joints_px.copy()
        joints[..., 2] += 0.4 * (joints[..., 1] - joints[:, :1, 1])
        return replace(poses, joints_px=joints)

    def lean() -> float:
        found = reconstruction.reconstruct(tracks)
        assert found.frame == "world"
        return lean_deg(found.joints3d, found.camera_rotation)

    as_it_is = lean()
    monkeypatch.setattr(reconstruction, "run_method", leaning)
    taken_off = lean()
    monkeypatch.setattr(reconstruction, "balanced", lambda poses, *_: poses)
    assert abs(as_it_is) < 1.0
    assert abs(taken_off) < 3.0
    assert abs(lean()) > 8.0


def upside(seconds: float, thigh: np.ndarray, lean: float) -> tuple[ImagePoses, np.ndarray, np.ndarray]:
    """A still body (px) in a level view that leans away; ``thigh`` : (3,) from hip to knee."""
    joints = np.zeros((round(10 * seconds) + 1, len(BODY_17), 3))
    place = dict.fromkeys(BODY_17.joints, np.zeros(3)) | {
        "neck": np.array([0.0, -50.0, 0.0]), "head": np.array([0.0, -70.0, 0.0]),
    }  # fmt: skip
    for side in "rl":
        place |= {f"{side}shoulder": place["neck"], f"{side}wrist": np.array([0.0, 5.0, 0.0])}
        place |= {f"{side}knee": thigh, f"{side}ankle": np.add(thigh, [0.0, 40.0, 0.0])}
    for name, at in place.items():
        joints[:, BODY_17.index(name)] = at - [0.0, 0.0, lean * at[1]]
    rotation = np.tile([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]], (len(joints), 1, 1))
    return ImagePoses.centred(joints), rotation, np.arange(len(joints)) * 100_000_000


@pytest.mark.parametrize(
    ("seconds", "thigh", "changes"),
    [(10.0, [0.0, 40.0, 0.0], True), (3.0, [0.0, 40.0, 0.0], False), (10.0, [0.0, 10.0, -40.0], False)],
    ids=["stands", "too short", "sits"],
)
def test_only_who_is_on_his_feet_for_a_while_is_straightened(seconds: float, thigh: list[float], changes: bool) -> None:
    poses, rotation, stamp_ns = upside(seconds, np.array(thigh), 0.2)
    found = balanced(poses, rotation, stamp_ns)
    np.testing.assert_array_equal(found.joints_px[..., :2], poses.joints_px[..., :2])
    neck = found.joints_px[0, NECK, 2] - found.joints_px[0, ANKLES, 2].mean()
    before = poses.joints_px[0, NECK, 2] - poses.joints_px[0, ANKLES, 2].mean()
    assert (abs(neck) < 0.2 * abs(before)) if changes else neck == before
