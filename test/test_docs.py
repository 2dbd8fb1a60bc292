"""The documentation says what the code does."""

import re
import runpy

from drocap_ros.cli import build_parser


def test_the_table_of_parameters_is_up_to_date(root):
    render = runpy.run_path(str(root / "docs" / "make_parameters.py"))["render"]
    page = (root / "docs" / "parameters.md").read_text()
    assert page == render(), "run `python docs/make_parameters.py`"


def test_the_readme_names_every_command_and_no_other(root):
    (choices,) = (a.choices for a in build_parser()._subparsers._group_actions)
    # The first column of the table of commands; one cell may hold several.
    table = re.findall(r"^\| (`drocap .*?) \|", (root / "README.md").read_text(), re.MULTILINE)
    named = {name for cell in table for name in re.findall(r"drocap ([a-z-]+)", cell)}
    assert named == set(choices)


def test_links_between_pages_lead_somewhere(root):
    for page in [*root.glob("*.md"), *(root / "docs").glob("*.md")]:
        for target in re.findall(r"\]\(([^)#]+)\)", page.read_text()):
            if "://" not in target:
                assert (page.parent / target).exists(), f"{page.name}: {target}"


def test_every_topic_of_the_graph_is_in_the_readme(root):
    import pytest

    pytest.importorskip("drocap_ros.msg", reason="the messages are not built: `make setup` builds them")
    pytest.importorskip("rclpy", reason="no ROS here")
    from drocap_ros.ros.topics import TOPICS

    text = (root / "README.md").read_text()
    for topic in TOPICS:
        assert f"`{topic}`" in text
