"""The parser of the whole command line."""

import subprocess
import sys

import pytest

HEAVY = ("numpy", "scipy", "cv2", "rclpy", "onnxruntime", "matplotlib", "torch")


def test_help_imports_no_heavy_library():
    code = "import sys; from drocap_ros.cli import build_parser; build_parser(); print(*sys.modules)"
    modules = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    assert not set(HEAVY) & set(modules)


def test_help_lists_every_command(capsys):
    from drocap_ros.cli import COMMANDS, main

    with pytest.raises(SystemExit) as done:
        main(["--help"])
    assert done.value.code == 0
    assert len([line for line in capsys.readouterr().out.splitlines() if line.startswith("    ")]) >= len(COMMANDS)
