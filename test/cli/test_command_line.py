"""The parser of the whole command line."""

import os
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from drocap_ros.cli import COMMANDS, main
from drocap_ros.cli.options import ros_namespace
from drocap_ros.tracks import save_tracks
from lab.simulation.capture import simulate_capture

ROOT = Path(__file__).resolve().parents[2]
HEAVY = ("numpy", "scipy", "cv2", "rclpy", "onnxruntime", "matplotlib", "torch")


def test_help_imports_no_heavy_library():
    code = "import sys; from drocap_ros.cli import build_parser; build_parser(); print(*sys.modules)"
    modules = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    assert not set(HEAVY) & set(modules)


def test_parameters_of_all_components_import_no_mavlink():
    """Its dialect is a module of 2.3 MB: half a second of every process where nothing writes bytecode."""
    code = "import sys, drocap_ros.config, drocap_ros.cli.reconstruct; print(*sys.modules)"
    modules = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    assert "drocap_ros.flight.autopilot" in modules
    assert not [name for name in modules if name.startswith("pymavlink")]


def test_help_lists_every_command(capsys):
    with pytest.raises(SystemExit) as done:
        main(["--help"])
    assert done.value.code == 0
    lines = capsys.readouterr().out.splitlines()
    for group, names in COMMANDS.items():
        at = lines.index(f"{group}:")
        listed = [line.split()[0] for line in lines[at + 1 : at + 1 + len(names)]]
        assert listed == [name.removesuffix(".command").rsplit(".")[-1] for name in names]


@pytest.mark.parametrize(
    ("words", "line"),
    [
        ("nothing", "argument COMMAND: invalid choice: 'nothing'"),
        ("reconstuct a.mp4", "did you mean reconstruct?"),
        ("track a.mp4 --overlayed", "did you mean --overlay?"),
        ("reconstruct a.mp4 --method papr", "did you mean paper?"),
        ("export m.npz", "the following arguments are required: --to; see drocap export --help"),
        ("export m.npz --to xyz", "invalid choice: 'xyz'"),
        ("track a.mp4 --wrong", "unrecognized arguments: --wrong; see drocap track --help"),
        ("batch a --out b --jobs two", "--jobs: invalid int value: 'two'; see drocap batch --help"),
        ("evaluate table m --wrong", "unrecognized arguments: --wrong; see drocap evaluate table --help"),
        ("demo --seed -1", "--seed: expected an integer from 0 to 4294967295, got -1"),
        ("demo --seed 0.5", "--seed: expected an integer"),
        ("demo --seed 4294967296", "--seed: expected an integer"),
        ("demo --seed -1", "--seed: expected an integer"),
    ],
)
def test_wrong_option_gives_one_line(words, line, capsys):
    assert main(words.split()) == 2
    (said,) = capsys.readouterr().err.splitlines()
    assert said.startswith("drocap: ")
    assert line in said


def test_a_misspelt_parameter_gets_its_name(tmp_path, capsys):
    config = tmp_path / "c.yaml"
    config.write_text("image_ingest: {widht_px: 640}\n")
    assert main(["reconstruct", "a.mp4", "--config", str(config)]) == 2
    assert "did you mean width_px?" in capsys.readouterr().err


@pytest.fixture
def bash(tmp_path, root):
    """Proposals of bash for a line, by what ``drocap --completion bash`` prints."""
    pytest.importorskip("argcomplete", reason="argcomplete is not installed")
    program = tmp_path / "drocap"
    program.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m drocap_ros.cli "$@"\n')
    program.chmod(0o755)
    env = {**os.environ, "PYTHONPATH": f"{root}:{os.environ.get('PYTHONPATH', '')}"}
    env["PATH"] = f"{tmp_path}:{os.environ['PATH']}"

    def propose(line):
        words = line.split(" ")
        script = f"""
            eval "$(drocap --completion bash)"
            COMP_LINE='{line}' COMP_POINT={len(line)} COMP_TYPE=9
            COMP_WORDS=({line}) COMP_CWORD={len(words) - 1}
            $(complete -p drocap | sed 's/.*-F \\([^ ]*\\).*/\\1/') drocap '{words[-1]}' '{words[-2]}'
            echo "${{COMPREPLY[@]}}"
        """
        done = subprocess.run(["bash", "-c", script], capture_output=True, text=True, env=env, timeout=120)
        return done.stdout.split()

    return propose


@pytest.mark.parametrize(
    ("line", "proposals"),
    [
        ("drocap rec", {"record", "reconstruct", "recover"}),
        ("drocap reconstruct --meth", {"--method"}),
        ("drocap export m.npz --to c", {"c3d", "csv", "csv-angles"}),
    ],
)
def test_the_tab_key_completes_commands_options_and_values(bash, line, proposals):
    assert set(bash(line)) == proposals


@pytest.mark.parametrize("shell", ["zsh", "fish"])
def test_other_shells_get_their_own_words(shell, capsys):
    pytest.importorskip("argcomplete", reason="argcomplete is not installed")
    with pytest.raises(SystemExit, match="0"):
        main(["--completion", shell])
    assert "drocap" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "after"),
    [
        (["info", ""], "drocap info"),
        (["reconstruct", "a.npz", "--out", ""], "--out"),
        (["export", "m.npz", "--to", "bvh", "--out="], "--out="),
    ],
)
def test_empty_word_is_no_path(words, after, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(words) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert f"expected a value after {after}, got an empty one" in line
    assert not list(tmp_path.iterdir())


def test_name_with_a_line_break_gives_one_line(tmp_path, capsys):
    assert main(["info", str(tmp_path / "a\nb.npz")]) == 2
    assert capsys.readouterr().err.count("\n") == 1


@pytest.mark.parametrize(("text", "namespace"), [("/", "/"), ("drone2", "/drone2"), ("/a/b_1", "/a/b_1")])
def test_a_namespace_has_its_leading_slash(text, namespace):
    assert ros_namespace(text) == namespace


@pytest.mark.parametrize(
    ("redirection", "status", "words"),
    [(">/dev/full", 1, "drocap: expected space on the disk, found none"), (">&-", 0, ""), ("2>&-", 0, "")],
)
def test_a_full_or_closed_output_is_no_unexpected_error(tmp_path, redirection, status, words):
    save_tracks(tmp_path / "t.npz", simulate_capture(1.0, 15.0, seed=1).tracks)
    command = f"{shlex.quote(sys.executable)} -m drocap_ros.cli info t.npz {redirection}"
    done = subprocess.run(
        command, shell=True, cwd=tmp_path, capture_output=True, text=True, env={**os.environ, "PYTHONPATH": str(ROOT)}
    )
    assert (done.returncode, done.stderr[: len(words)], done.stderr.count("\n")) == (status, words, len(words) > 0)
