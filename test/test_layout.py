"""The rooms of product and laboratory: budgets, layers, circles, imports of ROS.  ARCHITECTURE.md describes them."""

from __future__ import annotations

import ast
import re
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

#: Bottom to top; a room imports rooms of its own layer or below.
LAYERS = (
    ("errors", "revision", "parameters", "skeleton", "leg_sides", "camera_path", "geometry", "keypoints",
     "stamps", "background", "tracks", "corrections", "motion", "clip", "contacts", "file_kind"),
    ("perception", "flight", "reconstruction", "recording", "simulation"),
    ("open_images", "api", "config", "pipeline", "people", "live_replay", "evaluation", "export", "report",
     "view"),
    ("app",),
    ("ros",),
    ("nodes", "bringup"),
    ("station",),
    ("cli",),
)  # fmt: skip
ROS_ROOMS = {"ros", "nodes", "bringup"}
ROS_PACKAGES = ("rclpy", "drocap_ros.msg", "drocap_ros.srv")
MAX_LINES = 450
#: Most lines of Python per room, in thousands: what there was, up to the next 50.  A feature pays for its lines by what
#: it makes needless; who raises a budget writes the reason beside the number.
BUDGETS = {
    ("errors", "revision", "parameters", "skeleton", "leg_sides", "camera_path", "geometry", "keypoints",
     "stamps", "background", "tracks", "corrections", "motion", "clip", "contacts", "file_kind", "open_images",
     "api", "config", "pipeline", "people", "live_replay"): 4.63,  # points of the scene; corrections (0.38); lenses
    ("perception",): 6.67,  # points of the scene; one followed live, everybody; names of pictures (0.06)
    ("reconstruction",): 12.54,  # one engine, one camera; paths by points, live windows; lenses of joined views (0.09)
    ("flight",): 9.28,  # a process that holds after the bridge's death; preflight, of the machine too; heights
    ("recording",): 6.77,  # keypoints of any order (0.45) and spelling, persons whose numbers change (0.2), GPX, GPMF,
    # several in a log; damaged recordings, packed messages, journals, lenses of others (0.1)
    ("simulation",): 2.93,  # reports err as recorded ones
    ("evaluation",): 1.11,  # truth from C3D, TRC and BVH by the names of other programs (0.38), one of several bodies
    ("export", "report", "view"): 4.78,  # OpenSim, USD and FBX (0.17), an avatar's bones live (0.29), several persons
    ("app",): 1.42,  # the page of clips, corrections and exports
    ("station",): 0.75,  # one page in a browser for the flight
    ("ros", "nodes", "bringup"): 5.10,  # lockstep, processes of their own; networks beside optical flow, shared images
    ("cli",): 5.13,  # batch, preflight and top stayed whole; lenses by a chessboard (0.06), networks watched (0.05)
    ("lab", "benchmarks"): 12.23,  # flights that are drawn (0.35), mutants (0.17), heights (0.08), recordings (0.5)
}  # fmt: skip
#: Names of autopilots and of their settings; `ardupilotmega` is a dialect of MAVLink.
AUTOPILOT_WORD = re.compile(
    r"(?i:px4|ardupilot(?!mega)|arducopter)|\b(?:COM|EK3|EKF2|FS|GF|GUID|LOIT|MPC|PSC|SYSID|WPNAV|SR\d)_[A-Z0-9_]+"
)


class Package:
    """Modules of `root/NAME` by dotted name, and what each imports, inside functions included."""

    def __init__(self, root: Path, name: str = "drocap_ros") -> None:
        self.root = root / name
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

    def folder(self, module: str) -> str:
        """Folder of a module, dotted; a module of the top folder stands for itself."""
        parent = self.files[module].parent
        return module if parent == self.root else ".".join(parent.relative_to(self.root.parent).parts)

    def edges(self) -> dict[str, set[str]]:
        """Module -> modules of the package that it imports."""
        return {name: {to for to in found if to in self.files and to != name} for name, found in self.imports.items()}


def room(module: str) -> str:
    """`drocap_ros.flight.orbit.safety` -> `flight`; the package's own `__init__` counts as errors, at the bottom."""
    return module.split(".")[1] if "." in module else "errors"


def large_files(package: Package) -> list[str]:
    lines = {path: len(path.read_text(encoding="utf-8").splitlines()) for path in package.files.values()}
    return [f"{path.relative_to(package.root)}: {n} lines" for path, n in lines.items() if n > MAX_LINES]


def rooms_without_docstring(package: Package) -> list[str]:
    inits = [path for path in package.files.values() if path.name == "__init__.py"]
    missing = [path for path in inits if not ast.get_docstring(ast.parse(path.read_text(encoding="utf-8")))]
    folders = {path.parent for path in package.files.values()} - {path.parent for path in inits}
    return [str(path.relative_to(package.root)) for path in (*missing, *folders)]


def circles(package: Package) -> list[str]:
    """Import circles between files, between folders at every depth, and between rooms.

    A folder is its own modules, without its subfolders; each module of the top folder is a room of its own.
    """
    files = package.edges()
    graphs = [files]
    for place in (package.folder, room):
        graph: dict[str, set[str]] = {}
        for name, targets in files.items():
            graph.setdefault(place(name), set()).update(place(to) for to in targets if place(to) != place(name))
        graphs.append(graph)
    return [found for graph in graphs if (found := _circle(graph))]


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


def laboratory_in_the_product(package: Package) -> list[str]:
    return [
        f"{name}: {target}" for name, targets in package.imports.items() for target in targets
        if target.split(".")[0] in ("lab", "benchmarks")
    ]  # fmt: skip


def reconstruction_in_recording(package: Package) -> list[str]:
    """Files are read without the methods; what both need stands below them."""
    return [
        f"{name}: {target}" for name, targets in package.imports.items() if room(name) == "recording"
        for target in targets if target.startswith("drocap_ros.reconstruction")
    ]  # fmt: skip


def autopilots_outside_their_room(package: Package) -> list[str]:
    """Words of an autopilot in the flight room, comments included: what differs is a field of its object."""
    found = []
    for name, path in package.files.items():
        if room(name) == "flight" and "autopilot" not in name.split(".")[2:3]:
            words = set(AUTOPILOT_WORD.findall(path.read_text(encoding="utf-8")))
            found += [f"{name}: {', '.join(sorted(words))}"] if words else []
    return found


RULES = [
    large_files, rooms_without_docstring, circles, arrows_upwards, ros_outside_its_rooms, laboratory_in_the_product,
    reconstruction_in_recording, autopilots_outside_their_room,
]  # fmt: skip


@pytest.fixture(scope="module")
def package(root):
    return Package(root)


@pytest.mark.parametrize("rule", RULES)
def test_package_keeps_rule(package, rule):
    found = rule(package)
    assert not found, "\n".join(found)


@pytest.mark.parametrize("rule", [large_files, rooms_without_docstring])
def test_laboratory_keeps_rule(root, rule):
    found = rule(Package(root, "lab"))
    assert not found, "\n".join(found)


@pytest.mark.parametrize("rooms", BUDGETS, ids=lambda rooms: rooms[0])
def test_room_keeps_its_budget(root, rooms):
    """Its lines are at most those of the table; where they fall far below, the table follows."""
    lines = 0
    for name in rooms:
        top = root / ("" if name in ("lab", "benchmarks") else "drocap_ros")
        paths = [top / f"{name}.py", *(top / name).rglob("*.py")]
        lines += sum(len(path.read_text(encoding="utf-8").splitlines()) for path in paths if path.is_file())
    assert lines <= 1000 * BUDGETS[rooms]


def test_every_room_has_a_budget():
    assert {name for rooms in BUDGETS for name in rooms} >= {name for names in LAYERS for name in names}


@pytest.mark.parametrize(
    ("rule", "files"),
    [
        (large_files, {"errors.py": "x = 1\n" * (MAX_LINES + 1)}),
        (rooms_without_docstring, {"flight/__init__.py": "import math\n"}),
        (rooms_without_docstring, {"flight/orbit/safety.py": ""}),
        (circles, {"tracks.py": "import drocap_ros.motion\n", "motion.py": "from drocap_ros.tracks import Tracks\n"}),
        (circles, {
            "flight/a.py": "from drocap_ros.simulation import b\n", "simulation/b.py": "",
            "simulation/c.py": "def f():\n    from drocap_ros.flight.d import g\n", "flight/d.py": "",
        }),
        (circles, {
            "flight/__init__.py": "", "flight/orbit/a.py": "from drocap_ros.flight import b\n", "flight/b.py": "",
            "flight/c.py": "from drocap_ros.flight.orbit.d import e\n", "flight/orbit/d.py": "",
        }),
        (laboratory_in_the_product, {"cli/train.py": "def run():\n    from lab.training import lifter\n"}),
        (reconstruction_in_recording, {"recording/a.py": "from drocap_ros.reconstruction.world import contacts\n"}),
        (autopilots_outside_their_room, {"flight/orbit/a.py": "# PX4 grants it\n"}),
        (autopilots_outside_their_room, {"flight/link.py": 'NAME = "GUID_TIMEOUT"\n', "flight/autopilot/a.py": ""}),
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
    extra = {
        str(f) for f in folders
        if f.parts and f.parts[0] != "system" and not (root / "drocap_ros" / f).is_dir() and not (root / f).is_dir()
    }  # fmt: skip
    assert extra == set()
