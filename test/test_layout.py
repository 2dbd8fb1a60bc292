"""The rooms of the package: sizes, layers, imports of ROS.  ARCHITECTURE.md describes them."""

from __future__ import annotations

import ast
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

#: Bottom to top; a room imports rooms of its own layer or below.
LAYERS = (
    ("errors", "revision", "parameters", "skeleton", "joint_maps", "leg_sides", "geometry", "keypoints", "observation",
     "tracks", "motion", "mocap", "clip"),
    ("perception", "flight", "reconstruction", "recording", "simulation"),
    ("api", "config", "pipeline", "live_replay", "training", "evaluation", "export", "report", "view"),
    ("ros",),
    ("nodes", "bringup"),
    ("cli",),
)  # fmt: skip
ROS_ROOMS = {"ros", "nodes", "bringup"}
ROS_PACKAGES = ("rclpy", "drocap_ros.msg", "drocap_ros.srv")
MAX_MODULES = 17
MAX_LINES = 350


class Package:
    """Modules of `root/drocap_ros` by dotted name, and what each imports, inside functions included."""

    def __init__(self, root: Path) -> None:
        self.root = root / "drocap_ros"
        self.files: dict[str, Path] = {}
        for path in sorted(self.root.rglob("*.py")):
            parts = path.relative_to(root).with_suffix("").parts
            self.files[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
        self.imports = {name: self._imports(path) for name, path in self.files.items()}

    def _imports(self, path: Path) -> set[str]:
        found: set[str] = set()
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                found |= {alias.name for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.module:
                names = {f"{node.module}.{alias.name}" for alias in node.names}
                # A name of a room is a module or something that the module `node.module` defines.
                found |= {name if name in self.files or node.module == "drocap_ros" else node.module for name in names}
        return found

    def edges(self) -> dict[str, set[str]]:
        """Module -> modules of the package that it imports."""
        return {name: {to for to in found if to in self.files and to != name} for name, found in self.imports.items()}


def room(module: str) -> str:
    """`drocap_ros.flight.orbit.safety` -> `flight`; the package's own `__init__` counts as errors, at the bottom."""
    return module.split(".")[1] if "." in module else "errors"


def large_files(package: Package) -> list[str]:
    lines = {path: len(path.read_text(encoding="utf-8").splitlines()) for path in package.files.values()}
    return [f"{path.relative_to(package.root)}: {n} lines" for path, n in lines.items() if n > MAX_LINES]


def large_folders(package: Package) -> list[str]:
    folders = [package.root, *(path for path in package.root.rglob("*") if path.is_dir())]
    sizes = {folder: sum(p.name != "__init__.py" for p in folder.glob("*.py")) for folder in folders}
    return [f"{folder.name}: {n} modules" for folder, n in sizes.items() if n > MAX_MODULES]


def rooms_without_docstring(package: Package) -> list[str]:
    inits = [path for path in package.files.values() if path.name == "__init__.py"]
    missing = [path for path in inits if not ast.get_docstring(ast.parse(path.read_text(encoding="utf-8")))]
    folders = {path.parent for path in package.files.values()} - {path.parent for path in inits}
    return [str(path.relative_to(package.root)) for path in (*missing, *folders)]


def circles(package: Package) -> list[str]:
    """An import circle between files, and one between top rooms."""
    files = package.edges()
    rooms: dict[str, set[str]] = {}
    for name, targets in files.items():
        rooms.setdefault(room(name), set()).update(room(to) for to in targets if room(to) != room(name))
    return [found for graph in (files, rooms) if (found := _circle(graph))]


def _circle(graph: dict[str, set[str]]) -> str:
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        return " -> ".join(error.args[1])
    return ""


def arrows_upwards(package: Package) -> list[str]:
    level = {name: i for i, names in enumerate(LAYERS) for name in names}
    unknown = [f"{room(name)}: no layer" for name in package.files if room(name) not in level]
    return unknown or [
        f"{name} -> {to}" for name, targets in package.edges().items() for to in targets
        if level[room(to)] > level[room(name)]
    ]  # fmt: skip


def ros_outside_its_rooms(package: Package) -> list[str]:
    return [
        f"{name}: {target}" for name, targets in package.imports.items() if room(name) not in ROS_ROOMS
        for target in targets if target.startswith(ROS_PACKAGES)
    ]  # fmt: skip


RULES = [large_files, large_folders, rooms_without_docstring, circles, arrows_upwards, ros_outside_its_rooms]


@pytest.fixture(scope="module")
def package(root):
    return Package(root)


@pytest.mark.parametrize("rule", RULES)
def test_package_keeps_rule(package, rule):
    found = rule(package)
    assert not found, "\n".join(found)


@pytest.mark.parametrize(
    ("rule", "files"),
    [
        (large_files, {"errors.py": "x = 1\n" * (MAX_LINES + 1)}),
        (large_folders, {f"flight/m{i}.py": "" for i in range(MAX_MODULES + 1)}),
        (rooms_without_docstring, {"flight/__init__.py": "import math\n"}),
        (rooms_without_docstring, {"flight/orbit/safety.py": ""}),
        (circles, {"tracks.py": "import drocap_ros.motion\n", "motion.py": "from drocap_ros.tracks import Tracks\n"}),
        (circles, {
            "flight/a.py": "from drocap_ros.simulation import b\n", "simulation/b.py": "",
            "simulation/c.py": "def f():\n    from drocap_ros.flight.d import g\n", "flight/d.py": "",
        }),
        (arrows_upwards, {"flight/a.py": "from drocap_ros import pipeline\n", "pipeline.py": ""}),
        (arrows_upwards, {"attic.py": ""}),
        (ros_outside_its_rooms, {"cli/orbit.py": "def run():\n    from drocap_ros.msg import OrbitStatus\n"}),
        (ros_outside_its_rooms, {"flight/link.py": "import rclpy.node\n"}),
    ],
)  # fmt: skip
def test_rule_finds_violation(tmp_path, rule, files):
    for name, text in files.items():
        path = tmp_path / "drocap_ros" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    assert rule(Package(tmp_path))


def test_test_folders_mirror_the_rooms(root):
    folders = {p.parent.relative_to(root / "test") for p in (root / "test").rglob("test_*.py")}
    extra = {str(f) for f in folders if f.parts and f.parts[0] != "system" and not (root / "drocap_ros" / f).is_dir()}
    assert extra == set()
