"""Environments of another ROS: one line that names the variable, status 2."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("rclpy")
ROOT = Path(__file__).resolve().parents[2]


def run(folder, *words, **variables):
    environment = {**os.environ, **variables}
    command = [sys.executable, "-c", f"import sys; sys.path.insert(0, {str(ROOT)!r}); from drocap_ros.cli import main;"
               " sys.exit(main(sys.argv[1:]))", *words]  # fmt: skip
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, timeout=120)


@pytest.mark.parametrize("words", [["demo", "--seconds", "2", "--out", "out"], ["top", "--once"]])
@pytest.mark.parametrize("middleware", ["rmw_cyclonedds_cpp", "rmw_zenoh_cpp"])
def test_a_middleware_that_is_missing_is_named(tmp_path, words, middleware):
    done = run(tmp_path, *words, RMW_IMPLEMENTATION=middleware)
    assert done.returncode == 2
    assert f"got {middleware}; unset RMW_IMPLEMENTATION" in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("content", ["import no_such_library_of_another_python", "from rclpy import _other_python"])
def test_another_ros_on_the_path_is_named(tmp_path, content):
    (tmp_path / "other" / "rclpy").mkdir(parents=True)
    (tmp_path / "other" / "rclpy" / "__init__.py").write_text(content)
    done = run(tmp_path, "demo", "--seconds", "2", "--out", "out", PYTHONPATH=str(tmp_path / "other"))
    assert done.returncode == 2
    assert done.stderr.startswith("drocap: PYTHONPATH: expected ROS 2 of this Python, found another one in")
    assert len(done.stderr.strip().splitlines()) == 1
