"""Study of the live method: published poses beside the offline result."""

from __future__ import annotations

import numpy as np
import pytest

from drocap_ros.errors import InputError
from drocap_ros.reconstruction.common.config import BundleAdjusterConfig, InitializerConfig
from drocap_ros.simulation.simulated_person import simulate_person
from drocap_ros.skeleton import BODY_15, BODY_17
from lab.studies.live_study import live_study, simulate_live, standardized_error
from lab.studies.live_study_table import live_markdown
from lab.studies.live_world import live_world_markdown, live_world_study
from lab.studies.protocol import orbit_view
from lab.studies.world_protocol import WorldCase


def walk_mm(seconds: float) -> np.ndarray:
    return 1000.0 * simulate_person(np.arange(round(24 * seconds)) / 24.0, action="walk", seed=0)


@pytest.fixture(scope="module")
def mocap(tmp_path_factory):
    folder = tmp_path_factory.mktemp("mocap")
    np.savez(folder / "walk.npz", X=walk_mm(6.0).astype(np.float32), fps=24.0, joints=np.array(BODY_15.joints))
    return folder


def test_the_study_has_a_row_per_sequence_and_refuses_what_it_cannot_use(mocap):
    (row,) = rows = live_study(mocap)
    assert row.sequence == "walk"
    assert float(row.refined_mm) < float(row.latest_mm) < 80.0
    assert "refined over offline" in live_markdown(rows, 0.5)
    for wrong in ({"delay_s": -1.0}, {"speed_deg_s": 1000.0}, {"limit": 0}):
        with pytest.raises(InputError, match="expected"):
            live_study(mocap, **wrong)


def test_a_solution_counts_from_its_arrival():
    view = orbit_view(walk_mm(5.0), 25.0)
    never = simulate_live(view, 10.0, InitializerConfig(), BundleAdjusterConfig())
    np.testing.assert_array_equal(never.latest, never.initial)
    assert np.isnan(never.refined).all()
    soon = simulate_live(view, 0.5, InitializerConfig(), BundleAdjusterConfig())
    # The first window ends after a third of a second, at the ninth image; its solution arrives half a second later.
    np.testing.assert_array_equal(soon.latest[:20], soon.initial[:20])
    assert not np.array_equal(soon.latest[20:24], soon.initial[20:24])
    # The last two seconds have no refined pose of that age.
    np.testing.assert_array_equal(np.isfinite(soon.refined).all(axis=(1, 2)), np.arange(120) < 120 - 48)
    assert np.isfinite(soon.refined_std_m[:72]).all()


def test_the_standardized_error_of_a_known_error_is_known():
    rng = np.random.default_rng(0)
    truth = walk_mm(8.0)
    truth -= truth[:, :1]
    std_m = rng.uniform(0.01, 0.05, truth.shape)
    estimate = 0.001 * truth + rng.normal(0.0, std_m)
    assert standardized_error(estimate, 0.5 * std_m, truth) == pytest.approx(2.0, rel=0.05)


def test_live_poses_of_unseen_people_are_near_the_offline_ones(shared, tmp_path):
    for name in ("cmu_61_01_daz", "cmu_61_07_daz"):
        (tmp_path / f"{name}.npz").symlink_to(shared.resolve() / "mocap" / "dev" / f"{name}.npz")
    rows = live_study(tmp_path, noisy=True)
    refined, offline, latest = (
        np.mean([getattr(r, n) for r in rows]) for n in ("refined_mm", "offline_mm", "latest_mm")
    )
    assert refined <= 1.15 * offline
    assert latest < 45.0
    for row in rows:
        # The lifter's deviations are right on HDM05's people; these figures err less.
        assert 0.6 <= row.refined_std <= 1.5
        assert 0.7 <= row.initial_std <= 1.5


def test_live_poses_in_map_are_measured_beside_the_offline_ones(tmp_path):
    """With exact telemetry the refined poses in ``map`` are nearly as good as offline; the latest ones err more."""
    truth = simulate_person(np.arange(24 * 17) / 24.0, "walk", 0, 1.75, BODY_17)
    np.savez(
        tmp_path / "walk.npz", X=(1000.0 * truth[:, : len(BODY_15)]).astype(np.float32), fps=24.0,
        joints=np.array(BODY_15.joints),
    )  # fmt: skip
    (row,) = live_world_study(tmp_path, WorldCase("exact"))
    assert 2.0 < row.first_s < 12.0
    assert row.share > 0.9
    assert row.refined.w_mm < 1.3 * row.offline.w_mm + 30.0
    assert row.refined.foot_m_s < 0.2
    assert row.refined.wa_mm < row.latest.wa_mm < 250.0
    text = live_world_markdown([row], WorldCase("exact"))
    assert "walk, latest" in text
    assert f"after {row.first_s:.1f} s" in text
