"""A motion in the viewer: what is drawn, and where Rerun shows or saves it."""

from __future__ import annotations

import contextlib
import ctypes
import functools
import math
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING
from urllib.parse import quote

import numpy as np

from drocap_ros.errors import InputError
from drocap_ros.motion import Motion, upright_camera_rotation, upright_joints
from drocap_ros.skeleton import COLOURS, JointSet, side_of

if TYPE_CHECKING:
    import rerun
    import rerun.blueprint as rrb


INSTALL = "pip install 'rerun-sdk>=0.39,<0.40'"


def new_recording(name: str) -> rerun.RecordingStream:
    """An empty named recording."""
    recording: rerun.RecordingStream = _rerun().RecordingStream("drocap", recording_id=name)
    recording.set_log_tick_enabled(False)
    recording.set_log_time_enabled(False)
    return recording


def has_screen() -> bool:
    """Whether a window can be opened here."""
    return any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY"))


def to_file(recording: rerun.RecordingStream, path: Path, layout: rrb.Blueprint) -> None:
    """Write the recording to a file from now on."""
    recording.save(path, default_blueprint=layout)


def to_window(recording: rerun.RecordingStream, layout: rrb.Blueprint, memory_limit: str) -> None:
    """Send the recording to the desktop viewer, started if necessary."""
    try:
        recording.spawn(memory_limit=memory_limit, default_blueprint=layout)
    except RuntimeError as error:
        raise InputError(f"expected the Rerun viewer to start, it did not ({error}); use --web or --save") from None


@contextlib.contextmanager
def to_browser(
    recording: rerun.RecordingStream,
    layout: rrb.Blueprint,
    host: str,
    port: int,
    memory_limit: str,
) -> Iterator[str]:
    """Serve the recording and a web viewer on two ports, ``port`` and the next, while the context lasts.

    Gives the page's address.  The server is Rerun's program, not its library: the library serves the images of a
    person to the whole network.

    host : address to serve on; 127.0.0.1 = this machine alone
    """
    _check_free(host, port, port + 1)
    command = [_program(), "--serve-web", "--bind", host, "--port", str(port + 1)]
    command += ["--web-viewer-port", str(port), "--server-memory-limit", memory_limit]
    server = subprocess.Popen(
        command,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,  # Ctrl-C is for this process
        preexec_fn=_end_with_parent(),
    )
    try:
        local = "127.0.0.1" if host == "0.0.0.0" else host
        for number in (port, port + 1):
            _wait_for(server, local, number)
        source = f"rerun+http://{local}:{port + 1}/proxy"
        recording.connect_grpc(source, default_blueprint=layout)
        yield f"http://{local}:{port}/?url={quote(source, safe='')}"
    finally:
        recording.disconnect()
        server.terminate()
        server.wait()


def _program() -> str:
    import rerun_cli

    return str(Path(rerun_cli.__file__).with_name("rerun"))


def _end_with_parent() -> Callable[[], object] | None:
    """First call of the child: it ends with a killed parent (PR_SET_PDEATHSIG) and frees the ports."""
    if sys.platform != "linux":
        return None
    # Looked up here: between fork and exec the child must only call.
    return functools.partial(ctypes.CDLL(None).prctl, 1, int(signal.SIGTERM))


def _check_free(host: str, *ports: int) -> None:
    for port in ports:
        with socket.socket() as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind((host, port))
            except OSError as error:
                raise InputError(
                    f"--host, --port: expected to serve on {host}:{port}, cannot ({error.strerror}); choose another"
                ) from None


def _wait_for(server: subprocess.Popen[bytes], host: str, port: int) -> None:
    # Start of the web server at most; a judgement.
    end = time.monotonic() + 20.0
    while server.poll() is None and time.monotonic() < end:
        with contextlib.suppress(OSError), socket.create_connection((host, port), timeout=1.0):
            return
        time.sleep(0.05)
    raise InputError(f"--host, --port: expected Rerun's server on {host}:{port}, it did not start; choose another port")


def _rerun() -> ModuleType:
    try:
        import rerun
    except ImportError as error:
        raise InputError(f"expected the Rerun viewer, found none ({error}); run `{INSTALL}`") from None
    return rerun


#: Horizontal field of view where the calibration is unknown: a typical drone camera.
NOMINAL_FOV_DEG = 70.0


def nominal_camera_matrix(width: float, height: float) -> np.ndarray:
    """(3, 3) px of an image of unknown calibration."""
    focal = 0.5 * width / np.tan(np.deg2rad(0.5 * NOMINAL_FOV_DEG))
    return np.array([[focal, 0.0, 0.5 * width], [0.0, focal, 0.5 * height], [0.0, 0.0, 1.0]])


def place_cameras(
    joints: np.ndarray, keypoints: np.ndarray, rotation: np.ndarray, camera_matrix: np.ndarray
) -> np.ndarray:
    """Camera positions (F, 3) m from which bodies project to the size and place of their keypoints.

    Scaled orthographic projection, so exact only for a far camera; NaN where fewer than two joints are seen.

    joints : (F, P, 3) m in the world, NaN unknown
    keypoints : (F, P, 2) px, NaN not seen
    rotation : (F, 3, 3) world -> optical
    camera_matrix : (3, 3) px
    """
    seen = (np.isfinite(joints).all(-1) & np.isfinite(keypoints).all(-1))[..., None]
    count = seen.sum(1, keepdims=True)
    enough = count[:, 0, 0] >= 2
    axes = np.where(seen, np.einsum("fij,fpj->fpi", rotation, np.nan_to_num(joints)), 0.0)
    image = np.where(seen, np.nan_to_num(keypoints), 0.0)
    middle = axes.sum(1, keepdims=True) / np.maximum(count, 1)
    place = image.sum(1, keepdims=True) / np.maximum(count, 1)
    spread_m = np.sqrt((((axes - middle)[..., :2] * seen) ** 2).sum((1, 2)))
    spread_px = np.sqrt((((image - place) * seen) ** 2).sum((1, 2)))
    focal = 0.5 * (camera_matrix[0, 0] + camera_matrix[1, 1])
    enough &= (spread_px > 1e-6) & (spread_m > 1e-6)
    range_m = focal * spread_m / np.where(enough, spread_px, 1.0)
    lateral = (place[:, 0] - camera_matrix[:2, 2]) * (range_m / focal)[:, None]
    body = np.concatenate([lateral, range_m[:, None]], 1)  # the body's centre in optical axes
    position = np.einsum("fji,fj->fi", rotation, middle[:, 0] - body)
    return np.where(enough[:, None], position, np.nan)


#: The timeline: exposure time of the image.
TIMELINE = "image"
WORLD = "world"
CAMERA = "world/camera"
IMAGE = "world/camera/image"
CAMERA_PATH = "world/camera_path"

SUBJECT = "world/subject"
#: Groups of curves, one view each.
PLOTS = ("reprojection_px", "confidence")

_WIDTH_M = 0.012


class Scene:
    """A Rerun recording of one capture.

    Stamps are integer nanoseconds of the image; positions are m in axes with z up; NaN = unknown, not drawn.
    """

    def __init__(self, recording: rerun.RecordingStream) -> None:
        import rerun

        self._rr = rerun
        self.recording = recording
        self._curves: set[str] = set()
        self._log(WORLD, rerun.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)

    def at(self, stamp_ns: int) -> None:
        """Set the stamp of all that follows."""
        self.recording.set_time(TIMELINE, timestamp=np.datetime64(int(stamp_ns), "ns"))

    def pose(self, joints_of: JointSet, joints: np.ndarray) -> None:
        """Joints (P, 3) m and bones."""
        rr = self._rr
        known = np.isfinite(joints).all(1)
        colours = _joint_colours(joints_of, 200)
        names = [name for name, k in zip(joints_of.joints, known, strict=True) if k]
        self._log(
            f"{SUBJECT}/joints",
            rr.Points3D(joints[known], colors=colours[known], radii=1.4 * _WIDTH_M, labels=names, show_labels=False),
        )
        bones = joints_of.bones[known[joints_of.bones].all(1)]
        self._log(f"{SUBJECT}/bones", rr.LineStrips3D(joints[bones], colors=colours[bones[:, 1]], radii=_WIDTH_M))

    def keypoints(self, joints_of: JointSet, keypoints: np.ndarray) -> None:
        """Keypoints (P, 2) px over the image."""
        rr = self._rr
        seen = np.isfinite(keypoints).all(1)
        colours = _joint_colours(joints_of, 255)
        bones = joints_of.bones[seen[joints_of.bones].all(1)]
        self._log(
            f"{IMAGE}/keypoints", rr.Points2D(keypoints[seen], colors=colours[seen], radii=rr.Radius.ui_points(4))
        )
        self._log(
            f"{IMAGE}/bones",
            rr.LineStrips2D(keypoints[bones], colors=colours[bones[:, 1]], radii=rr.Radius.ui_points(1.5)),
        )

    def image(self, bgr: np.ndarray) -> None:
        """An image (H, W, 3) uint8 BGR."""
        self._log(IMAGE, self._rr.Image(bgr, color_model="BGR").compress(jpeg_quality=80))

    def calibration(self, camera_matrix: np.ndarray, size: tuple[int, int]) -> None:
        """Camera matrix (3, 3) px of the following images of a size (width, height)."""
        pinhole = self._rr.Pinhole(
            image_from_camera=camera_matrix, resolution=size, image_plane_distance=1.0, color=COLOURS["path"]
        )
        self._log(IMAGE, pinhole)

    def camera(self, position: np.ndarray, rotation: np.ndarray) -> None:
        """Position (3,) m of the camera and its rotation (3, 3), world -> optical."""
        self._log(CAMERA, self._rr.Transform3D(translation=position, mat3x3=rotation.T))

    def camera_path(self, positions: np.ndarray) -> None:
        """Path (N, 3) m of the camera so far."""
        self._log(CAMERA_PATH, self._rr.LineStrips3D([positions], colors=COLOURS["path"], radii=0.01))

    def plot(self, name: str, value: float) -> None:
        """One value of a curve ``group/name``; NaN is not drawn."""
        if not np.isfinite(value):
            return
        last = name.rsplit("/", 1)[-1]
        if name not in self._curves:
            self._curves.add(name)
            self._log(f"plots/{name}", self._rr.SeriesLines(names=last, colors=COLOURS["left"]), static=True)
        self._log(f"plots/{name}", self._rr.Scalars(value))

    def _log(self, path: str, entity: rerun.AsComponents, static: bool = False) -> None:
        self._rr.log(path, entity, static=static, recording=self.recording)


def _joint_colours(joints_of: JointSet, opacity: int) -> np.ndarray:
    rows = [(*COLOURS[side_of(joint, joints_of.joints)], opacity) for joint in joints_of.joints]
    return np.array(rows, np.uint8)


def layout() -> rrb.Blueprint:
    """The body in its world beside the image with its keypoints, above curves."""
    import rerun.blueprint as rrb

    below = [rrb.TimeSeriesView(origin=f"plots/{name}", name=name.replace("_", " ")) for name in PLOTS]
    return rrb.Blueprint(
        rrb.Vertical(
            rrb.Horizontal(
                rrb.Spatial3DView(origin=WORLD, name="3D", background=rrb.Background(color=(238, 240, 243))),
                rrb.Spatial2DView(origin=IMAGE, name="image"),
                column_shares=[3, 2],
            ),
            rrb.Horizontal(*below),
            row_shares=[3, 1],
        ),
        rrb.TimePanel(state="collapsed", timeline="image"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.BlueprintPanel(state="collapsed"),
    )


def draw_motion(
    scene: Scene,
    motion: Motion,
    images: Iterable[tuple[int, np.ndarray]] = (),
    progress: Callable[[str, float], None] = lambda _stage, _done: None,
) -> None:
    """Every frame of a motion at its stamp, and its images: frame and (H, W, 3) uint8 BGR.

    A camera whose position the motion does not hold is placed so that the body projects to its keypoints, with a
    nominal field of view (:func:`drocap_ros.view.motion_view.place_cameras`).
    """
    size, zoom = _image_size(motion), 1.0
    for index, image in images:
        size = (image.shape[1], image.shape[0])
        # A minute of video then gives a file of about 150 MB.
        zoom = min(1.0, 960 / max(size))
        scene.at(int(motion.stamp_ns[index]))
        scene.image(_shrunk(image, zoom))
        progress("images", (index + 1) / len(motion.stamp_ns))
    _draw_frames(scene, motion, motion.keypoints * zoom, (round(size[0] * zoom), round(size[1] * zoom)), progress)


def _draw_frames(
    scene: Scene, motion: Motion, keypoints: np.ndarray, size: tuple[int, int], progress: Callable[[str, float], None]
) -> None:
    joints_of = JointSet("motion", motion.joints, motion.parents)
    joints = upright_joints(motion)
    rotation = upright_camera_rotation(motion)
    positions, matrix = _cameras(motion, joints, keypoints, rotation, size)
    error = motion.reprojection_px
    scene.at(int(motion.stamp_ns[0]))
    scene.calibration(matrix, size)
    known = positions[np.isfinite(positions).all(1)]
    if motion.frame == "world" and len(known) > 1:
        scene.camera_path(known)
    for i, stamp_ns in enumerate(motion.stamp_ns):
        scene.at(int(stamp_ns))
        scene.pose(joints_of, joints[i])
        scene.keypoints(joints_of, keypoints[i])
        if np.isfinite(positions[i]).all():
            scene.camera(positions[i], rotation[i])
        seen = np.isfinite(error[i])
        scene.plot("reprojection_px/mean", float(error[i][seen].mean()) if seen.any() else math.nan)
        scene.plot("confidence/mean", float(np.nan_to_num(motion.confidence[i]).mean()))
        progress("frames", (i + 1) / len(motion.stamp_ns))


def _cameras(
    motion: Motion, joints: np.ndarray, keypoints: np.ndarray, rotation: np.ndarray, size: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray]:
    """Positions (F, 3) m and matrix (3, 3) px of the cameras.

    A motion holds no focal length: with its own positions that one which projects the body to its keypoints.
    """
    matrix = nominal_camera_matrix(*size)
    if motion.camera_position is None or not np.nan_to_num(joints[:, 0]).any():  # the body has no place
        return place_cameras(joints, keypoints, rotation, matrix), matrix
    seen = (joints - motion.camera_position[:, None]) @ np.swapaxes(rotation, 1, 2)
    rays = seen[..., :2] / np.where(seen[..., 2:] > 0.1, seen[..., 2:], np.nan)
    known = np.isfinite(rays + keypoints).all(axis=2, keepdims=True)
    count = np.maximum(known.sum(axis=1, keepdims=True), 1)
    # About their means: an error of the camera's rotation moves all joints of an image alike.
    rays, pixels = (
        np.where(known, v - np.where(known, v, 0.0).sum(1, keepdims=True) / count, 0.0) for v in (rays, keypoints)
    )
    if (focal := float((rays * pixels).sum() / max(np.square(rays).sum(), 1e-12))) > 1.0:
        matrix[[0, 1], [0, 1]] = focal
    return motion.camera_position, matrix


def _image_size(motion: Motion) -> tuple[int, int]:
    """Width and height px of the images; where the motion does not state them, those that hold all keypoints."""
    stated = motion.meta.get("images")
    size = stated.get("size") if isinstance(stated, dict) else None
    if isinstance(size, list) and len(size) == 2 and all(isinstance(n, int) and n > 0 for n in size):
        return size[0], size[1]
    seen = motion.keypoints[np.isfinite(motion.keypoints).all(-1)]
    corner = seen.max(0) if len(seen) else np.array([640.0, 480.0])
    return max(16, math.ceil(float(corner[0]))), max(16, math.ceil(float(corner[1])))


def _shrunk(image: np.ndarray, zoom: float) -> np.ndarray:
    if zoom == 1.0:
        return image
    import cv2

    size = (round(image.shape[1] * zoom), round(image.shape[0] * zoom))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA))
