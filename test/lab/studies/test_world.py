"""The study of the motion in the world, and its error measures on motions whose errors are known."""

from __future__ import annotations

import csv
from dataclasses import astuple, replace
from pathlib import Path

import numpy as np
import pytest
from walking import make_walk, write_mocap

from drocap_ros.cli import main
from drocap_ros.evaluation.tables import WORLD_HEAD, world_cells
from drocap_ros.simulation.simulated_person import simulate_person
from drocap_ros.skeleton import BODY_15
from lab.commands import build_parser
from lab.studies.protocol import Sequence
from lab.studies.world import measure_world, world_means, world_study
from lab.studies.world_protocol import (
    FOCAL_PX,
    FPS,
    IMAGE_SIZE,
    TELEMETRY,
    WorldCase,
    world_sequences,
    world_view,
)


@pytest.mark.parametrize("still", [False, True])
def test_exact_telemetry_is_the_camera_that_took_the_images(still: bool) -> None:
    view = world_view(_sequence(), WorldCase(still=still), seed=3)
    np.testing.assert_array_equal(view.tracks.camera_rotation, view.camera_rotation)
    seen = np.einsum(
        "fij,fpj->fpi", view.camera_rotation, view.truth - view.tracks.camera_position[:, None]
    )  # the pinhole camera, written once more
    px = FOCAL_PX * seen[..., :2] / seen[..., 2:] + np.array(IMAGE_SIZE) / 2
    gap = np.abs(px - view.tracks.keypoints).max(-1)
    assert np.median(gap) < 6.0
    assert (gap > 15.0).mean() == pytest.approx(0.02 * (1 - (15 / 80) ** 2), abs=0.01)
    bearing = view.tracks.camera_position[:, :2] - view.truth[:, 0, :2]
    turned = np.degrees(np.ptp(np.unwrap(np.arctan2(*bearing.T[::-1]))))
    assert turned < 15.0 if still else turned > 150.0


@pytest.mark.parametrize("level", ["rtk", "gps"])
def test_telemetry_errs_as_stated(level: str) -> None:
    errors = TELEMETRY[level]
    true, reported = (world_view(_sequence(), WorldCase(name), seed=5).tracks for name in ("exact", level))
    turn = np.einsum("fij,fkj->fik", reported.camera_rotation, true.camera_rotation)
    angle = np.degrees(np.arccos(np.clip((np.trace(turn, axis1=1, axis2=2) - 1) / 2, -1, 1)))
    late = 19.0 * errors.late_s
    assert np.median(angle) == pytest.approx(np.sqrt(3) * errors.misalignment_deg, abs=late + 3 * errors.attitude_deg)
    shift = np.linalg.norm(reported.camera_position - true.camera_position, axis=1)
    assert 0.2 * errors.position_m < shift.mean() < 4 * errors.position_m + 2.5 * errors.late_s


def test_an_orbit_turns_back_as_often_as_stated() -> None:
    standing = Sequence("statue", np.tile(1000.0 * simulate_person(np.zeros(1), "walk", 1, 1.75, BODY_15), (480, 1, 1)))
    position = world_view(standing, WorldCase(reverse_s=5.0)).camera_position
    rate = np.degrees(np.diff(np.unwrap(np.arctan2(position[:, 1], position[:, 0])))) * FPS
    np.testing.assert_allclose(np.abs(rate).max(), 19.0, rtol=0.01)
    turns = np.flatnonzero(np.sign(rate[1:]) != np.sign(rate[:-1])) / FPS
    np.testing.assert_allclose(turns, [2.5, 7.5, 12.5, 17.5], atol=2 / FPS)


def test_points_of_the_scene_are_fixed() -> None:
    """Two rays of one track meet: the true camera sees every point, but some that slide, where it is."""
    view = world_view(_sequence(), WorldCase("none", background=True), seed=1)
    points = view.tracks.background
    assert points is not None
    assert view.tracks.camera_rotation is None
    alive = np.bincount(points.frame, minlength=len(view.truth))
    assert (alive > 100).all()
    assert (alive <= 150).all()
    ray = np.column_stack([(points.point - np.array(IMAGE_SIZE) / 2) / FOCAL_PX, np.ones(len(points))])
    ray = np.einsum("nij,ni->nj", view.camera_rotation[points.frame], ray)
    missed = []
    for track in np.unique(points.track):
        rows = points.track == track
        if rows.sum() < 24:
            continue
        across = np.eye(3) - ray[rows, :, None] * ray[rows, None] / np.square(ray[rows]).sum(1)[:, None, None]
        place = view.camera_position[points.frame[rows]]
        point = np.linalg.solve(across.sum(0), np.einsum("nij,nj->i", across, place))
        seen = np.einsum("nij,nj->ni", view.camera_rotation[points.frame[rows]], point - place)
        px = FOCAL_PX * seen[:, :2] / seen[:, 2:] + np.array(IMAGE_SIZE) / 2
        missed.append(np.linalg.norm(px - points.point[rows], axis=1).mean())
    assert np.median(missed) < 0.7
    assert (np.array(missed) > 3.0).mean() < 0.1


def test_command_prints_and_writes_every_measure(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_mocap(tmp_path, "long", X=_walker(300))
    write_mocap(tmp_path, "short", frames=150)
    out = tmp_path / "out"
    words = ["world", str(tmp_path), "--telemetry", "rtk", "--quiet"]
    assert main([*words, "--out", str(out)], parser=build_parser()) == 0
    text = capsys.readouterr().out
    assert text == (out / "world.md").read_text(encoding="utf-8")
    assert "1 sequences, rtk telemetry, orbit" in text
    with (out / "world.csv").open(encoding="utf-8") as file:
        (line,) = csv.DictReader(file)
    assert 0 < float(line["w_mm"]) < 1500
    assert (line["frames"], line["frame"]) == ("240", "world")
    assert main([*words, "--every", "0"], parser=build_parser()) == 2
    assert main([*words, "--reverse", "0.5"], parser=build_parser()) == 2
    assert main(["world", str(tmp_path / "absent")], parser=build_parser()) == 2
    assert main([*words, "--telemetry", "perfect"], parser=build_parser()) == 2


def test_a_sequence_whose_telemetry_is_refused_has_no_errors_in_the_world() -> None:
    time_s = np.arange(200) / FPS
    skater = simulate_person(time_s, "walk", 1, 1.75, BODY_15)
    skater[..., :2] -= skater[:, :1, :2]
    skater[..., 0] += 1.5 * time_s[:, None]
    row = measure_world(Sequence("skater", 1000.0 * skater), WorldCase(), seed=0, method="ba")
    assert row.frame == "camera"
    assert [cell == "-" for cell in world_cells(row.errors)] == [
        head not in {"PA-MPJPE mm", "scale %"} for head in WORLD_HEAD
    ]
    other = replace(row, frame="world", errors=replace(row.errors, w_mm=80.0))
    assert world_means([row, other]).w_mm == 80.0


def test_a_sequence_has_the_same_seed_with_every_choice(tmp_path: Path) -> None:
    for name in "abcdefg":
        write_mocap(tmp_path, name, frames=250)
    seeds = {sequence.name: seed for seed, sequence in world_sequences(tmp_path)}
    assert len(set(seeds.values())) == 7
    assert [seeds[name] for name in "adg"] == [0, 1, 2]  # of the published figures
    for every in (2, 3):
        assert {sequence.name: seed for seed, sequence in world_sequences(tmp_path, every)}.items() <= seeds.items()


def test_study_is_the_same_every_time(tmp_path: Path) -> None:
    write_mocap(tmp_path, "a", X=_walker(260))
    one, two = (astuple(world_study(world_sequences(tmp_path), WorldCase("gps"), seed=4)[0].errors) for _ in range(2))
    np.testing.assert_array_equal(one, two)


def _walker(frames: int) -> np.ndarray:
    """(F, 15, 3) mm at 30 fps: a person whose telemetry is accepted."""
    return (1000.0 * simulate_person(np.arange(frames) / 30.0, "walk", 1, 1.75, BODY_15)).astype(np.float32)


def _sequence() -> Sequence:
    walk = make_walk(240)
    return Sequence("walk", 1000.0 * walk.in_camera @ walk.camera)
