"""Fixtures that every room's tests may use."""

from __future__ import annotations

from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]

#: Fixtures that several rooms' tests share; ``pythonpath`` in pyproject.toml names their folder.
pytest_plugins = ["fixtures_export", "fixtures_recording", "fixtures_reconstruction", "fixtures_report"]

#: Where nodes run, ports are listened to or time is measured, and what of it only computes.
CLOCKED = (
    "nodes", "ros", "system", "view", "cli/test_live_cli.py", "cli/test_preflight_command.py",
    "flight/mavlink/test_link.py", "flight/mavlink/test_signing.py", "flight/mavlink/test_gimbal.py",
    "perception/sources/test_live_sources.py",
    "perception/models/test_fetch.py", "recording/mcap/test_bounded_queue.py",
    "recording/mcap/test_recover.py", "recording/mcap/test_session_writer.py",
    "recording/telemetry/test_flight_to_tracks.py",
)  # fmt: skip
COMPUTING = ("system/test_packaging.py", "system/test_simulated_demo.py")
#: Those of them that count messages or frames while the graph is busy: beside another test they fail now and then.
ALONE = (
    "nodes/test_bundle_adjuster.py", "nodes/test_live_replay.py", "system/test_bringup.py",
    "system/test_live_faults.py", "system/test_orbit", "view",
)  # fmt: skip
#: Files that take longest begin, so that none of them ends alone.
LONG = (
    "system/test_simulated_demo.py", "system/test_packaging.py", "simulation/closed_loop/test_pilot_wins.py",
    "reconstruction/live/test_world_windows.py", "cli/batch/test_batch_command.py", "system/test_demo.py",
    "cli/test_preflight_command.py", "cli/test_live_cli.py",
)  # fmt: skip


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark what waits for clocks and what has to run alone; long files first."""

    def file(item: pytest.Item) -> str:
        return item.path.relative_to(ROOT / "test").as_posix()

    for item in items:
        if file(item).startswith(CLOCKED) and file(item) not in COMPUTING:
            item.add_marker("alone" if file(item).startswith(ALONE) else "clock")
    items.sort(key=lambda item: file(item) not in LONG)


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> None:
    """Let a repeated test prepare its module again: the flight that it looks at was disturbed too."""
    if getattr(item, "execution_count", 1) > 1:
        for definitions in item._fixtureinfo.name2fixturedefs.values():  # type: ignore[attr-defined]
            for definition in definitions:
                if definition.scope == "module":
                    definition.finish(item._request)  # type: ignore[attr-defined]


@pytest.fixture(scope="session")
def root() -> Path:
    """Root of the repository."""
    return ROOT


@pytest.fixture(scope="session")
def shared() -> Path:
    """Folder of real recordings, MoCap and weights beside the checkout; the test is skipped where it is absent."""
    folder = ROOT.parent / "shared"
    if not (folder / "media").is_dir():
        pytest.skip("no ../shared beside the checkout: real recordings, MoCap and model weights are not here")
    return folder
