"""The documents agree with the code and with each other."""

import os
import re
import runpy
import subprocess

import pytest

from drocap_ros.cli import build_parser


def pages(root):
    return [*root.glob("*.md"), *(root / "docs").rglob("*.md")]


def test_table_of_parameters_is_up_to_date(root):
    render = runpy.run_path(str(root / "docs" / "make_parameters.py"))["render"]
    page = (root / "docs" / "parameters.md").read_text()
    assert page == render(), "run `python docs/make_parameters.py`"


def test_readme_names_every_command_and_no_other(root):
    (choices,) = (a.choices for a in build_parser()._subparsers._group_actions)
    # The first column of the table of commands; one cell may hold several.
    table = re.findall(r"^\| (`drocap .*?) \|", (root / "README.md").read_text(), re.MULTILINE)
    named = {name for cell in table for name in re.findall(r"drocap ([a-z-]+)", cell)}
    assert named == set(choices)


def test_readme_has_at_most_150_lines(root):
    assert len((root / "README.md").read_text().splitlines()) <= 150


def test_links_between_pages_lead_to_files(root):
    for page in pages(root):
        for target in re.findall(r"\]\(([^)#]+)\)", page.read_text()):
            if "://" not in target:
                assert (page.parent / target).exists(), f"{page.name}: {target}"


def test_files_that_the_pages_name_exist(root):
    folders = ("drocap_ros", "lab", "test", "benchmarks", "docs", "launch")
    known = [path for folder in folders for path in (root / folder).rglob("*.py")] + list(root.glob("*.py"))
    ends = {"/".join(path.parts[-n:]) for path in known for n in range(1, len(path.parts))}
    for page in pages(root):
        for name in re.findall(r"`(?:\.\./)*((?:[\w.]+/)*\w+\.py)`", page.read_text()):
            placeholder = re.search(r"\b[A-Z]{3,}\b", name.replace("_", " "))  # NAME.py
            assert placeholder or name in ends, f"{page.name}: {name}"


def test_every_topic_of_the_graph_is_in_the_readme(root):
    pytest.importorskip("drocap_ros.msg", reason="the messages are not built: `make setup` builds them")
    pytest.importorskip("rclpy", reason="no ROS here")
    from drocap_ros.ros.topics import TOPICS

    text = (root / "README.md").read_text()
    for topic in TOPICS:
        assert f"`{topic}`" in text


def measured_rows(text):
    """Rows of tables with at least three cells that hold a measured number, one with a decimal point."""
    rows = (re.sub(r"[ *`]", "", line) for line in text.splitlines() if line.startswith("|"))
    return {row for row in rows if len(re.findall(r"\|[-+]?\d+\.\d", row)) >= 3}


def test_a_measured_row_stands_in_one_page_only(root):
    first = {}
    for page in pages(root):
        for row in measured_rows(page.read_text()):
            assert row not in first, f"{page.name} and {first[row]}: {row}"
            first[row] = page.name


def test_every_page_of_figures_names_its_command_date_revision_and_machine(root):
    found = [page for page in (root / "docs" / "figures").glob("*.md") if page.name != "README.md"]
    assert found
    index = (root / "docs" / "figures" / "README.md").read_text()
    for page in found:
        head = page.read_text().splitlines()[2]
        script = re.match(r"`python (benchmarks/\w+\.py)[^`]*`, \d{4}-\d\d-\d\d, revision \w+.*, \d+ ", head)
        assert script, f"{page.name}: {head}"
        assert (root / script[1]).exists()
        assert f"({page.name})" in index, f"{page.name} is missing in docs/figures/README.md"


def test_make_takes_a_python_that_pyenv_has_but_does_not_select(root, tmp_path):
    """A shim as pyenv's: it refuses to run unless its version is named."""
    shim = tmp_path / "python3.12"
    shim.write_text('#!/bin/sh\n[ "$PYENV_VERSION" = 3.12 ] && echo found || exit 127\n')
    shim.chmod(0o755)
    (tmp_path / "makefile").write_text(f"include {root}/Makefile\nwhich:\n\t@$(PYTHON)\n")
    command = ["make", "-s", "-C", str(root), "-f", str(tmp_path / "makefile"), "which", "PYTHON=python3.12"]
    env = {"PATH": f"{tmp_path}:{os.environ['PATH']}"}
    done = subprocess.run(command, capture_output=True, text=True, env=env)
    assert done.stdout.strip() == "found", done.stderr


def test_image_installs_what_the_page_says(root):
    """The steps of `docs/install.md` for apt's ROS are those of the `Dockerfile`."""
    page = (root / "docs" / "install.md").read_text()
    image = (root / "Dockerfile").read_text().replace("${ROS_DISTRO}", "jazzy")
    packages = r"\b(?:ros-jazzy-[a-z0-9-]+|python3-[a-z]+)"
    from_apt = re.search(r"^sudo apt install((?:.*\\\n)*.*)", page, re.MULTILINE)[1]
    missing = set(re.findall(packages, from_apt)) - set(re.findall(packages, image)) - {"ros-jazzy-ros-base"}
    assert missing == set()
    from_pip = re.search(r"^pip install (onnxruntime .*)", page, re.MULTILINE)[1]
    assert from_pip in image
