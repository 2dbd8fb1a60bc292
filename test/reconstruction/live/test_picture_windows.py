"""Live windows without telemetry: in ``odom`` by fixed points, lost and begun anew with a word."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from types import SimpleNamespace

import numpy as np
import pytest
from telemetry_stream import FPS, Orbit, orbit

from drocap_ros.background import Background
from drocap_ros.evaluation.compare import world_errors
from drocap_ros.geometry.alignment import apply_similarity, similarity
from drocap_ros.geometry.rotations import unpack_covariance
from drocap_ros.reconstruction.common.config import BundleAdjusterConfig
from drocap_ros.reconstruction.live.adjuster import LiveAdjuster
from drocap_ros.reconstruction.live.core import LiveCore, Step, live_results
from drocap_ros.reconstruction.live.initializer import LiveInitializer
from drocap_ros.reconstruction.live.window import AdjustedWindow, Effort, TelemetryUse
from drocap_ros.skeleton import BODY_17

S = 10**9


def windows(
    true: Orbit, points_at: Callable[[np.ndarray], Background | None], effort: Effort | None = None
) -> list[AdjustedWindow]:
    """The windows of a stream with a calibration and without any pose of the camera."""
    config = BundleAdjusterConfig()
    core = LiveCore(config)
    core.cameras.add_matrix(int(true.stamp_ns[0]), true.matrix)
    core.points = SimpleNamespace(along=points_at, newest_ns=0)  # type: ignore[assignment]
    live = LiveInitializer(), core, LiveAdjuster(config)
    results = live_results(true.observations, *live, effort_at=lambda _: effort or Effort())
    return [result[1] for result in results if not isinstance(result, Step)]


@lru_cache(maxsize=1)
def flown() -> Orbit:
    return orbit(9.0)


def camera_of(w: AdjustedWindow) -> tuple[np.ndarray, np.ndarray]:
    assert w.in_map is not None
    return w.in_map.rotation, w.in_map.position


def test_windows_are_in_a_world_of_the_picture_with_its_up_and_metres() -> None:
    true = flown()
    found = windows(true, true.points_at)
    there = [w for w in found if w.in_map is not None]
    assert {w.telemetry for w in found} == {TelemetryUse.NONE}
    assert (there[0].stamp_ns[-1] - true.stamp_ns[0]) * 1e-9 < 4.0
    assert there == found[-len(there) :]
    for w in there:
        place = np.searchsorted(true.stamp_ns, w.stamp_ns)
        rotation, _ = camera_of(w)
        errors = world_errors(w.joints3d.astype(float), true.truth[place], FPS)
        # The vertical, seen by the camera, against the true one.
        tilt = np.degrees(np.arccos(np.clip(np.sum(rotation[..., 2] * true.rotation[place][..., 2], axis=1), -1, 1)))
        assert tilt.max() < 3.0
        assert errors.wa_mm < 100.0
        assert abs(errors.scale) < 0.08
        std = np.sqrt(np.trace(unpack_covariance(w.covariance[:, 0]), axis1=1, axis2=2) / 3)
        assert (errors.wa_mm < 3000.0 * std).all()
        assert (std < 0.6).all()
    for before, after in itertools.pairwise(there):
        _, at, here = np.intersect1d(before.stamp_ns, after.stamp_ns, return_indices=True)
        step = np.linalg.norm(camera_of(before)[1][at] - camera_of(after)[1][here], axis=1)
        assert step.max() < 0.1
        assert "path 1" in after.picture


@pytest.mark.parametrize("stride", [2, 4])
@pytest.mark.parametrize("speed_deg_s", [25.0, 0.0])
def test_a_path_goes_on_in_windows_that_share_no_image(speed_deg_s: float, stride: int) -> None:
    true = orbit(7.0, speed_deg_s=speed_deg_s)
    found = windows(true, true.points_at, Effort(stride))
    there = [w for w in found if w.in_map is not None]
    assert len(there) >= 3
    assert there == found[-len(there) :]
    shared = [np.isin(b.stamp_ns, a.stamp_ns).sum() for a, b in itertools.pairwise(there)]
    assert stride == 3 or 0 in shared  # a window begins 24 images after the one before
    for before, after in itertools.pairwise(there):
        assert after.picture.startswith("path 1,")
        assert after.lost == 0
        first_ns, *_, last_ns = before.stamp_ns
        at_ns = after.stamp_ns[(after.stamp_ns >= first_ns) & (after.stamp_ns <= last_ns)]
        place = [
            np.stack([np.interp(at_ns, w.stamp_ns, column) for column in camera_of(w)[1].T], axis=1)
            for w in (before, after)
        ]
        assert np.linalg.norm(place[0] - place[1], axis=1).max() < 0.1


@pytest.mark.parametrize(("smaller", "leaning_deg"), [(0.8, 0.0), (1.0, 20.0)])
def test_a_path_takes_over_the_metres_and_the_up_of_later_windows(smaller: float, leaning_deg: float) -> None:
    true = orbit(11.0)
    c, s = smaller * np.cos(np.deg2rad(leaning_deg)), smaller * np.sin(np.deg2rad(leaning_deg))
    seen = list(true.observations)
    for i, o in enumerate(seen[: round(4.5 * FPS)]):
        offset = o.keypoints - np.nanmean(o.keypoints, axis=0)
        changed = (o.keypoints - offset + offset @ np.array([[c, s], [-s, c]])).astype(np.float32)
        seen[i] = replace(o, keypoints=changed)
    there = [w for w in windows(replace(true, observations=seen), true.points_at) if w.in_map is not None]
    factors, tilts_deg = [], []
    for w in there:
        place = np.searchsorted(true.stamp_ns, w.stamp_ns)
        rotation, position = camera_of(w)
        ways = [np.linalg.norm(path - path.mean(axis=0)) for path in (position, true.position[place])]
        factors.append(ways[0] / ways[1])
        tilts_deg.append(np.degrees(np.arccos(np.clip(rotation[-1, :, 2] @ true.rotation[place[-1], :, 2], -1, 1))))
        assert "path 1," in w.picture
    assert factors[0] > 1.15 or smaller == 1.0  # a person that seems farther away
    assert tilts_deg[0] > 10.0 or leaning_deg == 0.0
    assert abs(factors[-1] - 1.0) < 0.08
    assert tilts_deg[-1] < 1.0
    assert abs(there[-1].joints3d[:, :, 2].min()) < 0.2  # the floor stays


def test_a_path_that_a_cut_ends_is_told_and_the_person_goes_on_from_it_to_the_next_one() -> None:
    true, other = flown(), orbit(9.0, seed=3)
    cut_ns = int(true.stamp_ns[0]) + 5 * S
    cut = int(np.searchsorted(true.stamp_ns, cut_ns))
    scenes = true.background, other.background
    parts = [scene.of_frames(np.arange(len(true.stamp_ns))[use]) for scene, use in
             zip(scenes, (slice(0, cut), slice(cut, None)), strict=True)]  # fmt: skip
    both = Background(
        np.concatenate([parts[0].frame, parts[1].frame + cut]).astype(np.int32),
        np.concatenate([parts[0].track, parts[1].track + 10**6]),
        np.concatenate([parts[0].point, parts[1].point]),
    )
    stream = replace(true, observations=[*true.observations[:cut], *other.observations[cut:]])
    found = windows(stream, lambda stamps: both.of_frames(np.searchsorted(stream.stamp_ns, stamps)))
    paths = [0 if w.in_map is None else w.in_map.path for w in found]
    assert set(paths) == {0, 1, 2}
    assert paths == sorted(paths[: paths.index(2)], key=lambda path: path > 1) + [2] * paths.count(2)
    lost = [w for w in found if w.lost]
    assert len(lost) == 1
    assert "path 1 lost: a cut" in lost[0].picture
    last, first = found[max(i for i, p in enumerate(paths) if p == 1)], found[paths.index(2)]
    assert first.stamp_ns[0] >= cut_ns
    seconds = (first.stamp_ns[0] - last.stamp_ns[-1]) * 1e-9
    assert np.linalg.norm(first.joints3d[0, 0] - last.joints3d[-1, 0]) < 0.2 + 2.0 * seconds
    assert abs(turned_deg(across(last.joints3d[-1]), across(first.joints3d[0]))) < 30.0


def across(body: np.ndarray) -> np.ndarray:
    """From the right shoulder to the left one, (2,)."""
    left, right = (BODY_17.index(name) for name in ("lshoulder", "rshoulder"))
    return body[left, :2] - body[right, :2]


def turned_deg(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.degrees(np.arctan2(a[0] * b[1] - a[1] * b[0], a @ b)))


def test_a_path_behind_a_pause_of_the_points_begins_where_the_person_has_gone_meanwhile() -> None:
    true = orbit(10.5)
    image, hidden = true.background.frame, slice(round(5.0 * FPS), round(7.0 * FPS))
    seen = (image < hidden.start) | (image >= hidden.stop)
    track = true.background.track + 10**6 * (image >= hidden.stop)  # nothing is known again
    points = Background(image[seen], track[seen], true.background.point[seen])
    found = windows(true, lambda stamps: points.of_frames(np.searchsorted(true.stamp_ns, stamps)), Effort(2))
    there = [w for w in found if w.in_map is not None]
    paths = [w.in_map.path for w in there if w.in_map is not None]
    assert sorted(set(paths)) == [1, 2]
    last, first = there[paths.index(2) - 1], there[paths.index(2)]
    assert last.stamp_ns[-1] < true.stamp_ns[hidden.start] < true.stamp_ns[hidden.stop] <= first.stamp_ns[0]
    before, after = (true.truth[np.searchsorted(true.stamp_ns, w.stamp_ns)] for w in (last, first))
    fit = similarity(last.joints3d.astype(float).reshape(-1, 3), before.reshape(-1, 3), with_scale=False)
    body = apply_similarity(first.joints3d[0].astype(float), *fit)
    # The camera has turned by 52 degrees and gone over 5 m.
    assert np.linalg.norm(body[0] - after[0, 0]) < 0.7 * np.linalg.norm(before[-1, 0] - after[0, 0])
    assert abs(turned_deg(across(body), across(after[0]))) < 20.0


def test_points_that_a_busy_machine_follows_in_every_second_image_give_the_path_too() -> None:
    true = flown()
    seldom = true.background.frame % 2 == 0
    some = Background(true.background.frame[seldom], true.background.track[seldom], true.background.point[seldom])
    brief = replace(true, observations=true.observations[: round(6.0 * FPS)])
    there = [
        w for w in windows(brief, lambda stamps: some.of_frames(np.searchsorted(true.stamp_ns, stamps)))
        if w.in_map is not None
    ]  # fmt: skip
    assert len(there) >= 2
    place = np.searchsorted(true.stamp_ns, there[-1].stamp_ns)
    assert world_errors(there[-1].joints3d.astype(float), true.truth[place], FPS / 2).wa_mm < 100.0


def test_without_texture_there_is_no_path_and_the_poses_stay_with_the_camera() -> None:
    true = flown()
    brief = replace(true, observations=true.observations[: round(5.0 * FPS)])
    few = Background(*(values[true.background.track % 40 == 0] for values in
                       (true.background.frame, true.background.track, true.background.point)))  # fmt: skip
    found = windows(brief, lambda stamps: few.of_frames(np.searchsorted(true.stamp_ns, stamps)))
    assert all(w.in_map is None for w in found)
    assert "too few fixed points" in found[-1].picture
    assert np.abs(found[-1].joints3d[:, 0]).max() < 1e-9
