"""``drocap view`` as a user runs it; its files are read back with Rerun's own reader."""

import contextlib
import os
import re
import signal
import socket
import subprocess
import sys
import time
import urllib.request
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from captured_flight import FLIGHT, captured_config

from drocap_ros.bringup import bringup
from drocap_ros.config import DrocapConfig
from drocap_ros.live_replay import replay
from drocap_ros.motion import Motion, load_motion, save_motion, upright_joints
from drocap_ros.skeleton import BODY_15
from drocap_ros.view.motion_view import Scene, draw_motion, new_recording, nominal_camera_matrix, place_cameras
from lab.simulation.capture import simulate_capture

pytest.importorskip("rerun", reason="no Rerun viewer here: `make setup` brings it")

ROOT = Path(__file__).resolve().parents[2]


def command(*arguments):
    return [sys.executable, "-m", "drocap_ros.cli", "view", *map(str, arguments)]


def environment(**more):
    hidden = ("DISPLAY", "WAYLAND_DISPLAY")
    kept = {name: value for name, value in os.environ.items() if name not in hidden}
    return {**kept, "PYTHONPATH": str(ROOT), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST", **more}


def view(*arguments, **more):
    return subprocess.run(command(*arguments), env=environment(**more), capture_output=True, text=True, timeout=120)


class Drawn:
    """Entities of an .rrd file: for each path, rows of component name -> values by image stamp."""

    def __init__(self, path):
        from rerun.chunk import RrdReader

        self.rows = {}
        for chunk in RrdReader(str(path)).stream().to_chunks():
            batch = chunk.to_record_batch()
            stamps = batch.column("image").cast("int64").to_pylist() if "image" in batch.schema.names else None
            columns = {n: batch.column(n).to_pylist() for n in batch.schema.names if ":" in n}
            for i in range(batch.num_rows):
                row = {name: values[i] for name, values in columns.items() if values[i] is not None}
                self.rows.setdefault(chunk.entity_path, []).append((stamps[i] if stamps else None, row))

    def stamps(self, path):
        return sorted(stamp for stamp, _ in self.rows.get(path, []) if stamp is not None)

    def values(self, path, component):
        """Stamp -> value of a component."""
        return {stamp: np.array(row[component]) for stamp, row in self.rows[path] if component in row}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A motion of 10 frames in the world, one joint unknown in one, and the video it came from."""
    folder = tmp_path_factory.mktemp("motion")
    capture = simulate_capture(1.0, 10.0, seed=3)
    joints = capture.joints3d_world.copy()
    joints[4, BODY_15.index("rwrist")] = np.nan
    motion = Motion(
        joints3d=joints, joints=BODY_15.joints, parents=BODY_15.parents, stamp_ns=capture.tracks.stamp_ns,
        frame="world", metric=True, scale_source="telemetry", camera_rotation=capture.camera_rotation,
        confidence=np.full(joints.shape[:2], 0.8), keypoints=capture.keypoints_exact,
        reprojection_px=np.full(joints.shape[:2], 3.0),
    )  # fmt: skip
    save_motion(folder / "motion.npz", motion)
    writer = cv2.VideoWriter(str(folder / "walk.mp4"), cv2.VideoWriter_fourcc(*"mp4v"), 10.0, (1280, 720))
    for i in range(10):
        writer.write(np.full((720, 1280, 3), 20 * i, np.uint8))
    writer.release()
    return folder


def test_every_frame_of_a_motion_is_drawn_in_place(folder, tmp_path):
    out = tmp_path / "motion.rrd"
    done = view(folder, "--save", out, "--video", folder / "walk.mp4")
    assert done.returncode == 0, done.stderr
    assert re.search(r"written: .*motion\.rrd \(\d+\.\d MB\)", done.stdout)
    motion, drawn = load_motion(folder / "motion.npz"), Drawn(out)
    stamps = motion.stamp_ns.tolist()
    points = drawn.values("/world/subject/joints", "Points3D:positions")
    assert sorted(points) == stamps
    for i, stamp in enumerate(stamps):
        known = np.isfinite(motion.joints3d[i]).all(1)
        np.testing.assert_allclose(points[stamp], motion.joints3d[i][known], atol=1e-5)
    assert len(points[stamps[4]]) == 14
    bones = drawn.values("/world/subject/bones", "LineStrips3D:strips")
    assert [len(bones[stamp]) for stamp in stamps] == [14, 14, 14, 14, 13, 14, 14, 14, 14, 14]
    assert drawn.stamps("/plots/reprojection_px/mean")[-10:] == stamps
    # The image is 1280 px wide and drawn at 960: the keypoints are scaled by three quarters.
    pixels = drawn.values("/world/camera/image/keypoints", "Points2D:positions")
    np.testing.assert_allclose(pixels[stamps[0]], 0.75 * motion.keypoints[0], rtol=1e-4)
    images = drawn.values("/world/camera/image", "EncodedImage:blob")
    assert len(images) == 10
    jpeg = cv2.imdecode(np.asarray(images[stamps[5]], np.uint8).ravel(), cv2.IMREAD_COLOR)
    assert jpeg.shape == (540, 960, 3)
    assert abs(float(jpeg.mean()) - 100) < 4


def test_camera_of_a_motion_in_the_world_is_drawn_in_its_place(folder, tmp_path):
    capture = simulate_capture(1.0, 10.0, seed=3)
    size = {"images": {"size": list(capture.tracks.image_size)}}
    motion = replace(load_motion(folder / "motion.npz"), camera_position=capture.camera_position, meta=size)
    recording, out = new_recording("test"), tmp_path / "motion.rrd"
    recording.save(out)
    draw_motion(Scene(recording), motion)
    recording.disconnect()
    drawn = Drawn(out)
    places = drawn.values("/world/camera", "Transform3D:translation")
    for stamp, place in zip(motion.stamp_ns.tolist(), motion.camera_position, strict=True):
        np.testing.assert_allclose(places[stamp].ravel(), place, atol=1e-4)
    (matrix,) = drawn.values("/world/camera/image", "Pinhole:image_from_camera").values()
    np.testing.assert_allclose(matrix.reshape(3, 3).T, capture.tracks.camera_matrix, rtol=2e-3)


def test_cameras_are_placed_near_their_true_positions():
    capture = simulate_capture(1.0, 10.0, seed=3)
    matrix = capture.tracks.camera_matrix
    found = place_cameras(capture.joints3d_world, capture.keypoints_exact, capture.camera_rotation, matrix)
    truth = capture.tracks.camera_position
    away = np.linalg.norm(truth - capture.joints3d_world[:, 0], axis=1)
    # The model is orthographic: the remaining error is perspective, a few percent of the distance.
    assert (np.linalg.norm(found - truth, axis=1) < 0.06 * away).all()
    nothing = np.full_like(capture.keypoints_exact, np.nan)
    empty = place_cameras(capture.joints3d_world, nothing, capture.camera_rotation, nominal_camera_matrix(640, 480))
    assert np.isnan(empty).all()


def test_a_session_is_drawn_as_the_live_graph_saw_it(tmp_path):
    config = captured_config(tmp_path, 3.0)
    config = config.replace("bundle_adjuster", period_s=0.5)
    config = config.replace("session_recorder", session_dir=str(tmp_path / "session"))
    with bringup(config, FLIGHT) as graph:
        graph.wait_finished("session_player", timeout_s=60)
        graph.spin_for(2.0)
    done = view(tmp_path / "session", "--save", tmp_path / "session.rrd")
    assert done.returncode == 0, done.stderr
    drawn = Drawn(tmp_path / "session.rrd")
    motion, _ = replay(tmp_path / "session", DrocapConfig())
    points = drawn.values("/world/subject/joints", "Points3D:positions")
    assert sorted(points) == motion.stamp_ns.tolist()
    assert len(points) > 30
    for stamp, expected in zip(motion.stamp_ns.tolist(), upright_joints(motion), strict=True):
        np.testing.assert_allclose(points[stamp], expected, atol=1e-5)


def two_free_ports():
    """A port that is free, and the next one too."""
    while True:
        with socket.socket() as first, socket.socket() as second:
            first.bind(("127.0.0.1", 0))
            port = first.getsockname()[1]
            with contextlib.suppress(OSError, OverflowError):
                second.bind(("127.0.0.1", port + 1))
                return port


def listening(port):
    """Addresses on which this machine listens at a port."""
    found = set()
    for table in ("tcp", "tcp6"):
        for line in Path(f"/proc/net/{table}").read_text().splitlines()[1:]:
            address, number = line.split()[1].split(":")
            if line.split()[3] == "0A" and int(number, 16) == port:
                found.add(socket.inet_ntoa(bytes.fromhex(address)[::-1]) if table == "tcp" else address)
    return found


def test_without_a_screen_a_page_is_served_on_this_machine_alone(folder):
    port = two_free_ports()
    server = subprocess.Popen(
        command(folder, "--port", port), env=environment(), stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )
    try:
        line = server.stdout.readline()
        address = re.search(r"open (http://\S+) in a browser", line)[1]
        page = urllib.request.urlopen(address, timeout=20).read().decode()
        assert "<title>Rerun" in page
        # The source of the page's data.
        assert f"127.0.0.1%3A{port + 1}" in address
        with socket.create_connection(("127.0.0.1", port + 1), timeout=20):
            pass
        # Images of a person stay on this machine.
        for number in (port, port + 1):
            assert listening(number) == {"127.0.0.1"}
    finally:
        server.send_signal(signal.SIGINT)
        rest, _ = server.communicate(timeout=30)
    assert server.returncode == 0, line + rest
    assert not listening(port)


def test_a_killed_command_ends_its_server(folder):
    port = two_free_ports()
    server = subprocess.Popen(command(folder, "--port", port), env=environment(), stdout=subprocess.PIPE, text=True)
    server.stdout.readline()
    assert listening(port)
    server.kill()
    server.communicate(timeout=30)
    end = time.monotonic() + 20
    while listening(port) and time.monotonic() < end:
        time.sleep(0.05)
    assert not listening(port)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ((), "INPUT"),
        (("none.npz",), "none.npz"),
        ((ROOT / "README.md",), "README.md"),
        (("x.npz", "--save", "a.rrd", "--web"), "expected --save or --web"),
        (("x.npz", "--memory", "much"), "--memory: expected an amount like 1GB"),
    ],
)
def test_unusable_inputs_are_refused_in_one_line(arguments, words, tmp_path):
    out = () if "--save" in arguments else ("--save", tmp_path / "out.rrd")
    done = view(*arguments, *out)
    assert done.returncode == 2
    assert words in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1
    assert not (tmp_path / "out.rrd").exists()


def test_without_rerun_one_line_names_the_package_to_install(folder, tmp_path):
    (tmp_path / "rerun.py").write_text("raise ImportError('not here')")
    done = view(folder, "--save", tmp_path / "x.rrd", PYTHONPATH=f"{tmp_path}:{ROOT}")
    assert done.returncode == 2
    assert "pip install 'rerun-sdk" in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1
