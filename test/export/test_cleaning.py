"""The filter and the locked feet of an export: what they keep, what they change, what they say."""

import dataclasses

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d

from drocap_ros.cli import main
from drocap_ros.errors import InputError
from drocap_ros.export import export
from drocap_ros.export.take import lock_feet, smooth, take_of
from drocap_ros.motion import save_motion
from drocap_ros.skeleton import BODY_15

KNEES_AND_ANKLES = [BODY_15.index(side + name) for side in "rl" for name in ("knee", "ankle")]


def swinging(walker, hz, rate_hz=120.0, frames=240):
    """A clip whose joints swing by 10 mm along x at one frequency."""
    times = np.arange(frames) / rate_hz
    positions = np.zeros((frames, 15, 3))
    positions[..., 0] = 0.01 * np.sin(2.0 * np.pi * hz * times)[:, None]
    return dataclasses.replace(take_of(walker), positions=positions, times_s=times, rate_hz=rate_hz)


@pytest.mark.parametrize(("hz", "gain", "within"), [(1.0, 1.0, 0.01), (6.0, np.sqrt(0.5), 0.01), (24.0, 0.0, 0.01)])
def test_filter_has_the_stated_cut_off_and_no_phase(walker, hz, gain, within):
    clip = swinging(walker, hz)
    out = smooth(clip, 6.0)
    middle = slice(60, 180)
    off = out.positions[middle, 0, 0] - gain * clip.positions[middle, 0, 0]
    assert np.abs(off).max() < within * 0.01
    assert np.all(out.positions[..., 1:] == 0.0)


def test_filter_keeps_gaps_and_states_the_change(with_gaps):
    clip = take_of(with_gaps)
    out = smooth(clip, 5.0)
    np.testing.assert_array_equal(np.isnan(out.positions), np.isnan(clip.positions))
    moved = 1000.0 * np.linalg.norm(out.positions - clip.positions, axis=2)
    assert f"on average, at most {np.nanmax(moved):.1f} mm" in out.notes[-1]
    assert "zero phase" in out.notes[-1]


def test_locked_feet_keep_their_place_and_the_bones_their_lengths(walker):
    rng = np.random.default_rng(4)
    clip = take_of(walker)
    truth = clip.positions
    wander = np.cumsum(rng.normal(0, 0.004, (len(truth), 1, 3)), axis=0)
    noisy = dataclasses.replace(clip, positions=truth + wander)
    out = lock_feet(noisy)
    for name in ("rankle", "lankle"):
        ankle = BODY_15.index(name)
        still = np.linalg.norm(np.diff(truth[:, ankle], axis=0), axis=1) * 24.0 < 0.05
        inner = still[1:-1] & still[:-2] & still[2:]
        assert inner.sum() > 5
        speeds = [
            np.linalg.norm(np.diff(x.positions[:, ankle], axis=0), axis=1)[1:-1][inner].mean() * 24.0
            for x in (noisy, out)
        ]
        assert speeds[0] > 0.1
        assert speeds[1] < 0.35 * speeds[0]
    others = [joint for joint in range(15) if joint not in KNEES_AND_ANKLES]
    np.testing.assert_array_equal(out.positions[:, others], noisy.positions[:, others])
    for side in "rl":
        hip, knee, ankle = (BODY_15.index(side + name) for name in ("hip", "knee", "ankle"))
        for a, b in ((hip, knee), (knee, ankle)):
            lengths = [np.linalg.norm(x.positions[:, a] - x.positions[:, b], axis=1) for x in (noisy, out)]
            np.testing.assert_allclose(lengths[0], lengths[1], atol=1e-6)
    # The correction of the ankles sets in and ends gradually.
    ankles = [BODY_15.index("rankle"), BODY_15.index("lankle")]
    step = np.linalg.norm(np.diff((out.positions - noisy.positions)[:, ankles], axis=0), axis=2)
    assert step.max() < 0.02
    assert "feet locked in" in out.notes[-1]
    assert "mm" in out.notes[-1]


def test_feet_are_locked_after_a_time_without_the_person_too(walker):
    clip = take_of(walker)
    wander = np.cumsum(np.random.default_rng(4).normal(0, 0.004, (len(clip.positions), 1, 3)), axis=0)
    whole = dataclasses.replace(clip, positions=clip.positions + wander)
    positions = whole.positions.copy()
    positions[:3] = np.nan
    late = lock_feet(dataclasses.replace(whole, positions=positions)).positions
    np.testing.assert_allclose(late[-20:], lock_feet(whole).positions[-20:], atol=1e-9)


def test_feet_are_found_at_rest_where_images_were_dropped(walker):
    """24 images per second, later every third of them: by the median step the feet would be three times as fast."""
    clip = take_of(walker)
    wander = np.cumsum(np.random.default_rng(4).normal(0, 0.004, (len(clip.positions), 1, 3)), axis=0)
    kept = np.r_[0:14, 14:48:3]
    uneven = dataclasses.replace(clip, positions=(clip.positions + wander)[kept], times_s=clip.times_s[kept])
    out = lock_feet(uneven)
    assert "feet locked in 4 rests" in out.notes[-1]
    np.testing.assert_allclose(out.times_s, np.arange(len(out.times_s)) / 24.0, atol=1e-6)


def test_knee_of_an_almost_straight_leg_does_not_jump(walker):
    """A leg bent by 5 degrees whose ankle wanders along it: a knee that followed fully would move ten times as far."""
    clip = take_of(walker)
    positions = clip.positions.copy()
    wander = gaussian_filter1d(np.random.default_rng(5).normal(0, 0.02, len(positions)), 2.0)
    for side in "rl":
        hip, knee, ankle = (BODY_15.index(side + name) for name in ("hip", "knee", "ankle"))
        positions[:, [hip, knee, ankle]] = positions[:1, [hip]] + [(0, 0, 0), (0.0, 0.018, -0.42), (0, 0, -0.84)]
        # The leg keeps its bones: hip and knee rise and fall with the ankle.
        positions[:, [hip, knee, ankle], 2] += wander[:, None]
    out = lock_feet(dataclasses.replace(clip, positions=positions))
    for side in "rl":
        knee, ankle = BODY_15.index(side + "knee"), BODY_15.index(side + "ankle")
        moved = out.positions - positions
        assert np.abs(moved[:, ankle]).max() > 0.001
        assert np.linalg.norm(np.diff(moved[:, knee], axis=0), axis=1).max() < 1.2 * np.abs(wander).max()
        # It stays on its side.
        line = out.positions[:, knee] - 0.5 * (out.positions[:, BODY_15.index(side + "hip")] + out.positions[:, ankle])
        assert np.all(line[:, 1] > 0.0)


def test_both_are_off_by_default_and_printed_when_chosen(walker, tmp_path, capsys):
    save_motion(tmp_path / "motion.npz", walker)
    assert main(["export", str(tmp_path), "--to", "csv"]) == 0
    assert "smoothed" not in (plain := capsys.readouterr().out)
    assert "locked" not in plain
    assert main(["export", str(tmp_path), "--to", "csv", "--smooth", "--lock-feet"]) == 0
    printed = capsys.readouterr().out
    assert "order 4, 6 Hz): joints moved by" in printed
    assert "feet locked in" in printed
    assert main(["export", str(tmp_path), "--to", "csv", "--smooth", "50"]) == 2
    assert "between 0 and 9.63, got 50" in capsys.readouterr().err


def test_what_cannot_be_cleaned_is_refused(walker, in_camera, tmp_path):
    with pytest.raises(InputError, match="root that moves through the world"):
        export(in_camera, tmp_path / "a.csv", "csv", lock_feet=True)
    for cut_off in (0.0, -1.0, np.nan, np.inf):
        with pytest.raises(InputError, match="between 0 and"):
            smooth(take_of(walker), cut_off)
    few = swinging(walker, 1.0, frames=6)
    with pytest.raises(InputError, match="more than 9 frames"):
        smooth(few, 6.0)
