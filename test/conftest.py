"""Fixtures that every room's tests may use."""

from __future__ import annotations

import os
import signal
import subprocess
from collections.abc import Generator
from pathlib import Path

import pytest
from other_programs import MARK, Moment, moment, used_by_others

from drocap_ros.errors import NodeError

ROOT = Path(__file__).resolve().parents[1]

#: Fixtures that several rooms' tests share; ``pythonpath`` in pyproject.toml names their folder.
pytest_plugins = ["fixtures_export", "fixtures_recording", "fixtures_reconstruction", "fixtures_report"]

#: Where nodes run, ports are listened to or time is measured, and what of it only computes.
CLOCKED = (
    "nodes", "ros", "station", "system", "view", "cli/test_live_cli.py", "cli/test_preflight_command.py",
    "app/test_app_in_browser.py",
    "lab/commands/test_train_lifter.py", "flight/mavlink/test_guardian.py", "flight/mavlink/test_link.py",
    "flight/mavlink/test_signing.py", "perception/sources/test_live_sources.py", "perception/models/test_fetch.py",
    "recording/mcap/test_bounded_queue.py", "recording/mcap/test_killed_recorder.py",
    "recording/mcap/test_session_writer.py", "recording/telemetry/test_flight_to_tracks.py",
)  # fmt: skip
COMPUTING = (
    "system/test_packaging.py", "system/test_simulated_demo.py", "ros/test_conversions.py", "ros/test_diagnostics.py",
    "ros/test_markers.py",
)  # fmt: skip
#: Those of them that count messages or frames while the graph is busy: many tests beside them disturb them.
COUNTING = (
    "nodes/test_bundle_adjuster.py", "nodes/test_live_replay.py", "ros/test_slow_stages.py", "system/test_bringup.py",
    "station/test_page_in_browser.py", "system/test_live_faults.py", "system/test_orbit", "view",
)  # fmt: skip
#: Files that take longest begin, so that none of them ends alone.
LONG = (
    "system/test_simulated_demo.py", "system/test_packaging.py", "lab/flights/test_pilot_wins.py",
    "reconstruction/live/test_world_windows.py", "cli/test_batch_command.py", "system/test_demo.py",
    "cli/test_preflight_command.py", "cli/test_live_cli.py",
)  # fmt: skip
#: Marker expressions of `make test`, and the group of files that each runs.
PARTS = {"not clock and not counting": "", "clock": "clock", "counting": "counting"}


def file_of(path: Path) -> str:
    """Path inside this folder."""
    return path.relative_to(ROOT / "test").as_posix()


def group(file: str) -> str:
    """Marker of a file's tests; "" for those that only compute."""
    if not file.startswith(CLOCKED) or file in COMPUTING:
        return ""
    return "counting" if file.startswith(COUNTING) else "clock"


#: Processors that other programs use, as a share of all, from which a failed test of nodes or time says nothing.
BUSY = 0.25
BEGUN = pytest.StashKey[Moment]()
#: Errors of an expectation that a slow machine may miss.
LATE = (AssertionError, NodeError, TimeoutError, subprocess.TimeoutExpired, pytest.fail.Exception)


def pytest_configure() -> None:
    """Mark the processes of this run; let tests interrupt those in a shell's background job, which ignores SIGINT."""
    os.environ.setdefault(MARK, str(os.getpid()))
    if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Import no file of another part: each worker would take ten seconds for them."""
    part = PARTS.get(config.getoption("markexpr"))
    if part is None or collection_path.suffix != ".py":
        return None
    return group(file_of(collection_path)) != part or None


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark what waits for clocks and what counts messages; long files first."""
    for item in items:
        if part := group(file_of(item.path)):
            item.add_marker(part)
    items.sort(key=lambda item: file_of(item.path) not in LONG)


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> None:
    """Let a repeated test prepare its module again: the flight that it looks at was disturbed too."""
    if group(file_of(item.path)):
        item.stash[BEGUN] = moment()
    if getattr(item, "execution_count", 1) > 1:
        for definitions in item._fixtureinfo.name2fixturedefs.values():  # type: ignore[attr-defined]
            for definition in definitions:
                if definition.scope == "module":
                    definition.finish(item._request)  # type: ignore[attr-defined]


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(
    item: pytest.Item, call: pytest.CallInfo[None]
) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """A failed test of nodes or time is skipped where other programs used much of the machine meanwhile.

    Other errors than those of an expectation or a wait are mistakes, however busy the machine is.
    """
    report: pytest.TestReport = yield
    late = call.excinfo is not None and isinstance(call.excinfo.value, LATE)
    if report.failed and late and BEGUN in item.stash:
        used, all_of = used_by_others(item.stash[BEGUN]), len(os.sched_getaffinity(0))
        if used >= BUSY * all_of:
            failure = str(report.longrepr).strip().splitlines()[-1:]
            reason = f"too slow here: other programs used {used:.1f} of {all_of} processors meanwhile"
            report.outcome = "skipped"
            report.longrepr = (str(item.path), item.location[1] or 0, f"{reason}; {' '.join(failure)}")
    return report


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
