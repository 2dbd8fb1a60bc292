"""The measuring protocol: camera, noise, sequences."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from walking import make_walk, write_mocap

from lab.studies import protocol


def test_camera_orbits_at_its_speed_and_looks_down() -> None:
    r = protocol.orbit_rotations(241, 36.0)
    np.testing.assert_allclose(r @ np.swapaxes(r, 1, 2), np.broadcast_to(np.eye(3), r.shape), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(r), 1.0)
    np.testing.assert_allclose(r[240], r[0], atol=1e-12)  # 10 s at 36 deg/s
    np.testing.assert_allclose(r[:, 2, 2], -np.sin(0.3))  # the view direction points down
    assert np.all(r[:, 1, 2] < 0.0)  # up in the world is up in the image


def test_clean_view_is_the_projection_of_the_truth() -> None:
    x = 1000.0 * make_walk(30).in_camera
    view = protocol.orbit_view(x, 25.0)
    px = (view.tracks.keypoints - np.array(protocol.IMAGE_SIZE) / 2.0) / protocol.PX_PER_MM
    np.testing.assert_allclose(px, view.truth[..., :2], atol=1e-9)
    np.testing.assert_allclose(view.truth @ view.rotation, x - x[:, :1], atol=1e-9)


def test_noise_has_its_stated_size_and_is_seeded() -> None:
    x = 1000.0 * make_walk(400).in_camera
    clean, noisy = protocol.orbit_view(x, 10.0), protocol.orbit_view(x, 10.0, noisy=True)
    gap = (noisy.tracks.keypoints - clean.tracks.keypoints) / protocol.PX_PER_MM
    gross = np.abs(gap).max(-1) > 60.0
    assert gross.mean() == pytest.approx(0.05 * (1.0 - 0.2**2), abs=0.01)
    assert np.abs(gap).max() <= 300.0
    assert gap[~gross].std() == pytest.approx(10.0, rel=0.1)
    again = protocol.orbit_view(x, 10.0, noisy=True)
    np.testing.assert_array_equal(again.tracks.keypoints, noisy.tracks.keypoints)


def test_short_sequences_are_left_out_and_long_ones_cut(tmp_path: Path) -> None:
    write_mocap(tmp_path, "long", frames=400)
    write_mocap(tmp_path, "short", frames=100)
    found = protocol.protocol_sequences(tmp_path)
    assert [s.name for s in found] == ["long"]
    assert found[0].x.shape == (240, 15, 3)


def test_development_set_has_23_sequences(shared: Path) -> None:
    assert len(protocol.protocol_sequences(shared / "mocap" / "dev")) == 23
