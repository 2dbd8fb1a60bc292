import dataclasses

import numpy as np
import pytest

from drocap_ros.background import Background, FixedPoints, PointHistory, of_images
from drocap_ros.clip import Clip
from drocap_ros.errors import InputError
from drocap_ros.skeleton import BODY_15
from drocap_ros.tracks import Tracks, load_tracks, save_tracks

FRAMES = 6
#: Point 7 is seen in the images 0 to 5, point 9 in 2 and 3.
ROWS = Background(
    np.array([0, 1, 2, 2, 3, 3, 4, 5], np.int32),
    np.array([7, 7, 7, 9, 7, 9, 7, 7], np.int64),
    np.arange(16, dtype=np.float32).reshape(8, 2),
)


def tracks(background=ROWS):
    return Tracks(
        keypoints=np.random.default_rng(0).uniform(0, 500, (FRAMES, 15, 2)),
        joints=BODY_15.joints,
        stamp_ns=np.arange(FRAMES) * 40_000_000,
        image_size=(640, 480),
        background=background,
    )


def seen(background):
    return {
        (int(f), int(t)): tuple(p)
        for f, t, p in zip(background.frame, background.track, background.point.tolist(), strict=True)
    }


def test_file_round_trip(tmp_path):
    save_tracks(tmp_path / "t.npz", tracks())
    back = load_tracks(tmp_path / "t.npz").background
    for field in dataclasses.fields(Background):
        np.testing.assert_array_equal(getattr(back, field.name), getattr(ROWS, field.name))
        assert getattr(back, field.name).dtype == getattr(ROWS, field.name).dtype


def test_file_without_background_has_none(tmp_path):
    save_tracks(tmp_path / "t.npz", tracks(None))
    assert load_tracks(tmp_path / "t.npz").background is None


def test_part_of_a_recording_keeps_its_observations():
    part = Clip(0.075, 0.125).cut(tracks()).background
    assert seen(part) == {(f - 2, t): p for (f, t), p in seen(ROWS).items() if f in (2, 3)}


def test_reversed_recording_keeps_its_observations():
    whole = tracks()
    back = dataclasses.replace(
        whole, keypoints=whole.keypoints[::-1], background=ROWS.of_frames(np.arange(FRAMES)[::-1])
    ).background
    assert seen(back) == {(FRAMES - 1 - f, t): p for (f, t), p in seen(ROWS).items()}


def test_indices_may_be_stored_as_float(tmp_path):
    save_tracks(tmp_path / "t.npz", tracks())
    arrays = dict(np.load(tmp_path / "t.npz"))
    np.savez(tmp_path / "t.npz", **{**arrays, "background_frame": arrays["background_frame"].astype(float)})
    assert seen(load_tracks(tmp_path / "t.npz").background) == seen(ROWS)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"background_frame": np.full(8, FRAMES)}, f"expected indices of {FRAMES} images from 0 on, got 6 to 6"),
        ({"background_frame": np.full(8, -1)}, "from 0 on, got -1 to -1"),
        ({"background_frame": np.full(8, 2**40)}, "number them from 0"),
        ({"background_frame": np.full(8, 0.5)}, "expected integers, got fractions"),
        ({"background_track": np.zeros(7, np.int64)}, "one row per observation"),
        ({"background_track": np.array(["a"] * 8)}, "expected numbers"),
        ({"background_track": np.full(8, np.nan)}, "fractions or NaN"),
        ({"background_point": np.full((8, 2), np.nan)}, "leave lost points out"),
        ({"background_point": np.full((8, 2), 1e300)}, "leave lost points out"),
        ({"background_point": np.zeros((8, 3))}, r"expected px as float \(8, 2\)"),
        ({"background_frame": np.zeros((8, 1), int)}, r"expected integers \(8,\)"),
        ({"background_frame": np.array(3)}, "one row per observation"),
        ({"background_track": None}, "missing background_track"),
    ],
)
def test_bad_file_is_refused_in_one_line(tmp_path, change, words):
    save_tracks(tmp_path / "t.npz", tracks())
    arrays = {k: v for k, v in {**np.load(tmp_path / "t.npz"), **change}.items() if v is not None}
    np.savez(tmp_path / "t.npz", **arrays)
    with pytest.raises(InputError, match=words) as refused:
        load_tracks(tmp_path / "t.npz")
    assert "\n" not in str(refused.value)


def test_estimates_of_other_tools_in_a_tracks_file_are_accepted(tmp_path):
    save_tracks(tmp_path / "t.npz", tracks())
    more = {"evidence": np.zeros((FRAMES, 15, 3)), "evidence_sigma": np.ones((FRAMES, 15))}
    np.savez(tmp_path / "t.npz", **np.load(tmp_path / "t.npz"), **more)
    assert len(load_tracks(tmp_path / "t.npz")) == FRAMES


def images_of(counts):
    return [None if n is None else FixedPoints(np.arange(n), np.full((n, 2), 5.0, np.float32)) for n in counts]


def test_points_of_images_are_rows_of_their_frames():
    background = of_images(images_of([2, None, 0, 3]))
    assert background.frame.tolist() == [0, 0, 3, 3, 3]
    assert background.track.tolist() == [0, 1, 0, 1, 2]
    assert background.point.shape == (5, 2)
    assert of_images(images_of([None, None])) is None
    assert len(of_images(images_of([0, 0]))) == 0


@pytest.mark.parametrize(("most", "frames"), [(120, range(12)), (119, range(0, 12, 2)), (31, range(0, 12, 4))])
def test_a_long_recording_keeps_the_points_of_some_images(most, frames):
    background = of_images(images_of([10] * 12), most)
    assert sorted(set(background.frame.tolist())) == list(frames)
    assert len(background) == 10 * len(frames) <= most


def test_a_history_keeps_the_last_seconds_of_a_stream_and_starts_anew_with_a_loop():
    history = PointHistory(keep_s=1.0)
    points = FixedPoints(np.array([7, 9]), np.zeros((2, 2), np.float32))
    for stamp in range(10):
        history.add(stamp * 250_000_000, points)
    assert history.newest_ns == 2_250_000_000
    window = np.arange(10) * 250_000_000
    kept = history.along(window)
    # Those of the last second alone, so that an endless stream takes no more memory.
    assert sorted(set(kept.frame.tolist())) == [5, 6, 7, 8, 9]
    assert history.along(window[:4]) is None
    history.add(0, points)
    assert history.newest_ns == 0
    assert set(history.along(window).frame.tolist()) == {0}
