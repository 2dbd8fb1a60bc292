"""Builds and installations: colcon, colcon --symlink-install, pip with and without ROS."""

import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path
from xml.etree import ElementTree

import pytest

import drocap_ros

ROOT = Path(__file__).resolve().parents[2]
PREFIX = Path(sys.prefix)
PARTS = (
    "CMakeLists.txt", "package.xml", "setup.py", "pyproject.toml", "README.md",
    "drocap_ros", "msg", "srv", "config", "launch", "resource",
)  # fmt: skip
NODES = sorted(path.stem for path in (ROOT / "drocap_ros" / "nodes").glob("[a-z]*.py"))

pytestmark = pytest.mark.skipif(
    not (PREFIX / "bin" / "colcon").exists(), reason="not in the environment that `make setup` makes"
)


def environment(**values):
    clean = {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "AMENT_PREFIX_PATH", "CMAKE_PREFIX_PATH")}
    fast_build = {"CFLAGS": "-O0", "CXXFLAGS": "-O0"}
    return {**clean, **fast_build, "PATH": f"{PREFIX / 'bin'}{os.pathsep}{os.environ['PATH']}", **values}


def run(*command, cwd, env):
    done = subprocess.run(list(map(str, command)), cwd=cwd, env=env, capture_output=True, text=True, timeout=900)
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]
    return done.stdout


def test_the_manifest_of_ros_has_the_version_of_the_package():
    manifest = ElementTree.parse(ROOT / "package.xml")
    assert manifest.findtext("version") == drocap_ros.__version__


@pytest.fixture
def source(tmp_path):
    """A copy of the sources: the build leaves no file in the checkout."""
    return copied_to(tmp_path)


@pytest.fixture(scope="module")
def workspace(tmp_path_factory):
    folder = tmp_path_factory.mktemp("workspace")
    copied_to(folder)
    return folder


def copied_to(workspace):
    folder = workspace / "src" / "drocap_ros"
    folder.mkdir(parents=True)
    for name in PARTS:
        path = ROOT / name
        if path.is_dir():
            shutil.copytree(path, folder / name, ignore=shutil.ignore_patterns("__pycache__", ".*"))
        else:
            shutil.copy(path, folder)
    git(folder, "init", "--quiet")
    git(folder, "add", ".")
    git(folder, "-c", "user.name=a", "-c", "user.email=a@b", "commit", "--quiet", "--message", "all")
    return folder


def git(folder, *words):
    done = subprocess.run(["git", "-C", folder, *words], check=True, capture_output=True, text=True)
    return done.stdout.strip()


def assert_colcon_installs(workspace, *option):
    """Build, and import every node of the installation; the second build of a workspace reuses compiled messages."""
    for left in ("install", "build/drocap_ros/ament_cmake_python/drocap_ros/drocap_ros"):
        shutil.rmtree(workspace / left, ignore_errors=True)
    ros = environment(AMENT_PREFIX_PATH=str(PREFIX), CMAKE_PREFIX_PATH=str(PREFIX))
    build = ["colcon", "build", *option, "--cmake-args", f"-DPython3_EXECUTABLE={sys.executable}"]
    run(*build, "-DBUILD_TESTING=OFF", "-GNinja", cwd=workspace, env=ros)
    imports = "; ".join(f"import drocap_ros.nodes.{name}" for name in NODES)
    ask = "from drocap_ros.revision import git_revision as r; print(r())"
    check = (
        f"import drocap_ros.msg as m; m.Pose2D(); print(m.__file__); {imports}; print(drocap_ros.nodes.__file__); {ask}"
    )
    shell = f". install/setup.sh && python3 -c '{check}' && ls install/drocap_ros/lib/drocap_ros"
    lines = run("bash", "-c", shell, cwd=workspace, env=ros).split()
    # The workspace's own copy, not the one of the environment.
    install = str(workspace / "install")
    assert lines[0].startswith(install)
    assert lines[1].startswith(install)
    assert lines[2] == git(workspace / "src" / "drocap_ros", "rev-parse", "HEAD")
    assert set(lines[3:]) == {"drocap", *NODES}
    assert (workspace / "install" / "drocap_ros" / "share" / "drocap_ros" / "launch" / "drocap.launch.py").exists()
    run(
        "bash", "-c", ". install/setup.sh && install/drocap_ros/lib/drocap_ros/drocap --version", cwd=workspace, env=ros
    )


def test_colcon_installs_messages_nodes_and_launch_file(workspace):
    assert_colcon_installs(workspace)


def test_wheel_contains_interfaces_libraries_and_data(workspace, tmp_path):
    # Both builds run the same CMakeLists.txt: this one links what colcon compiled.  `make setup` compiles by pip.
    compiled = environment(DROCAP_BUILD_DIR=str(workspace / "build" / "drocap_ros"))
    run(
        sys.executable, "-m", "pip", "wheel", workspace / "src" / "drocap_ros", "--no-deps", "--no-build-isolation",
        "-w", tmp_path / "wheels", cwd=tmp_path, env=compiled,
    )  # fmt: skip
    (wheel,) = (tmp_path / "wheels").glob("*.whl")
    assert "none-any" not in wheel.name
    archive = zipfile.ZipFile(wheel)
    revision = git(workspace / "src" / "drocap_ros", "rev-parse", "HEAD")
    assert archive.read("drocap_ros/git_revision.txt").decode() == revision
    names = archive.namelist()
    for wanted in (
        "drocap_ros/msg/_pose2_d.py",
        "drocap_ros/srv/_orbit_command.py",
        "drocap_ros/nodes/initializer.py",
        "drocap_ros/data/dictionary_cmu.npz",
        "drocap_ros/data/simulation_models/person_pose.onnx",
        "drocap_ros/py.typed",
    ):
        assert wanted in names
    assert any(name.endswith("/lib/libdrocap_ros__rosidl_typesupport_c.so") for name in names)
    assert any(name.endswith("/share/drocap_ros/msg/Pose2D.msg") for name in names)


def test_colcon_links_the_modules_of_the_sources(workspace):
    assert_colcon_installs(workspace, "--symlink-install")


def test_package_without_ros_imports_all_but_nodes_and_messages(source, tmp_path):
    (source / "setup.py").open("a").write("# a change that is not committed\n")
    base = Path(sys.base_prefix) / "bin" / "python3"
    run(base, "-m", "venv", "--without-pip", "bare", cwd=tmp_path, env=environment())
    site = str(PREFIX / "lib" / f"python{sys.version_info[0]}.{sys.version_info[1]}" / "site-packages")
    bare = environment(PYTHONPATH=site)
    python = tmp_path / "bare" / "bin" / "python"
    run(
        python, "-m", "pip", "install", source, "--no-deps", "--no-build-isolation", "--target", "target",
        cwd=tmp_path, env=bare,
    )  # fmt: skip
    assert not (tmp_path / "target" / "drocap_ros" / "msg").exists()
    check = """
import sys, pkgutil, importlib
sys.path.insert(0, "target")
for ros in ("rclpy", "std_msgs", "sensor_msgs", "geometry_msgs", "rcl_interfaces", "diagnostic_msgs"):
    sys.modules[ros] = None
import drocap_ros
drocap_ros.__path__ = drocap_ros.__path__[:1]
for module in pkgutil.walk_packages(drocap_ros.__path__, "drocap_ros."):
    needs_ros = module.name.startswith(("drocap_ros.nodes", "drocap_ros.ros", "drocap_ros.bringup"))
    if not needs_ros and "__main__" not in module.name:
        importlib.import_module(module.name)
print(drocap_ros.__file__)
from drocap_ros.revision import git_revision
print(git_revision())
from drocap_ros.cli import main
assert main(["live", "--config", "target/none.yaml"]) == 2
"""
    where, revision = run(python, "-c", check, cwd=tmp_path, env=bare).splitlines()
    assert "target" in where
    assert revision == git(source, "rev-parse", "HEAD") + "+"
