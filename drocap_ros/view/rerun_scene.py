"""Rerun entities of a capture, from arrays, and their arrangement in the viewer."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from drocap_ros.geometry.ellipsoids import ellipsoids, unpack_covariance
from drocap_ros.skeleton import SIDE_COLOURS, JointSet, side_of

if TYPE_CHECKING:
    import rerun
    import rerun.blueprint as rrb

#: The timeline: exposure time of the image.
TIMELINE = "image"
WORLD = "world"
CAMERA = "world/camera"
IMAGE = "world/camera/image"
CAMERA_PATH = "world/camera_path"

#: The stages of a pose differ in opacity and width.
_OPACITY = {"initial": 90, "latest": 255, "refined": 200}
_WIDTH_M = {"initial": 0.008, "latest": 0.018, "refined": 0.012}
_UNCERTAIN = (200, 150, 20, 40)
_CURVES = {"initial": (150, 150, 150), "latest": (191, 56, 43), "mean": (36, 112, 163)}
_PATH = (51, 179, 77)
_BOX = (255, 220, 0)
_BACKGROUND = (238, 240, 243)
#: Half axes of the ellipsoids in standard deviations, as in the markers.
_SIGMAS = 2.0


def subject_path(stage: str) -> str:
    """Entity of the subject's pose of a stage."""
    return f"world/subject/{stage}"


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

    def pose(self, stage: str, joints_of: JointSet, joints: np.ndarray, covariance: np.ndarray | None = None) -> None:
        """Joints (P, 3) m, bones, and with a covariance (P, 6) m^2 ellipsoids of two standard deviations."""
        rr, path = self._rr, subject_path(stage)
        known = np.isfinite(joints).all(1)
        colours = _joint_colours(joints_of, _OPACITY[stage])
        width_m = _WIDTH_M[stage]
        names = [name for name, k in zip(joints_of.joints, known, strict=True) if k]
        self._log(
            f"{path}/joints",
            rr.Points3D(joints[known], colors=colours[known], radii=1.4 * width_m, labels=names, show_labels=False),
        )
        bones = joints_of.bones[known[joints_of.bones].all(1)]
        self._log(f"{path}/bones", rr.LineStrips3D(joints[bones], colors=colours[bones[:, 1]], radii=width_m))
        if covariance is not None:
            self._uncertainty(path, joints, covariance)

    def _uncertainty(self, path: str, joints: np.ndarray, covariance: np.ndarray) -> None:
        rr = self._rr
        use = np.isfinite(joints).all(1) & np.isfinite(covariance).all(1)
        xyzw, half_axes = ellipsoids(unpack_covariance(covariance[use].astype(float)), _SIGMAS)
        drawn = rr.Ellipsoids3D(
            centers=joints[use],
            half_sizes=half_axes,
            quaternions=xyzw,
            colors=_UNCERTAIN,
            fill_mode=rr.components.FillMode.MajorWireframe,
            line_radii=0.0015,
        )
        self._log(f"{path}/uncertainty", drawn)

    def no_subject(self, *stages: str) -> None:
        """Clear the subject's poses of these stages."""
        for stage in stages:
            self._log(subject_path(stage), self._rr.Clear(recursive=True))

    def keypoints(self, joints_of: JointSet, keypoints: np.ndarray, box: np.ndarray | None = None) -> None:
        """Keypoints (P, 2) px over the image, and the subject's box x_min y_min x_max y_max px."""
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
        if box is not None and np.isfinite(box).all():
            self._log(f"{IMAGE}/box", rr.Boxes2D(array=box[None], array_format=rr.Box2DFormat.XYXY, colors=_BOX))

    def no_keypoints(self) -> None:
        """Clear keypoints and box."""
        for name in ("keypoints", "bones", "box"):
            self._log(f"{IMAGE}/{name}", self._rr.Clear(recursive=False))

    def jpeg(self, data: bytes, media_type: str = "image/jpeg") -> None:
        """An encoded image."""
        self._log(IMAGE, self._rr.EncodedImage(contents=data, media_type=media_type))

    def image(self, bgr: np.ndarray) -> None:
        """An image (H, W, 3) uint8 BGR."""
        self._log(IMAGE, self._rr.Image(bgr, color_model="BGR").compress(jpeg_quality=80))

    def calibration(self, camera_matrix: np.ndarray, size: tuple[int, int]) -> None:
        """Camera matrix (3, 3) px of the following images of a size (width, height)."""
        pinhole = self._rr.Pinhole(
            image_from_camera=camera_matrix, resolution=size, image_plane_distance=1.0, color=_PATH
        )
        self._log(IMAGE, pinhole)

    def camera(self, position: np.ndarray, rotation: np.ndarray) -> None:
        """Position (3,) m of the camera and its rotation (3, 3), world -> optical."""
        self._log(CAMERA, self._rr.Transform3D(translation=position, mat3x3=rotation.T))

    def camera_path(self, positions: np.ndarray) -> None:
        """Path (N, 3) m of the camera so far."""
        self._log(CAMERA_PATH, self._rr.LineStrips3D([positions], colors=_PATH, radii=0.01))

    def plot(self, name: str, value: float) -> None:
        """One value of a curve ``group/name``; NaN is not drawn."""
        if not np.isfinite(value):
            return
        last = name.rsplit("/", 1)[-1]
        if name not in self._curves:
            self._curves.add(name)
            self._log(f"plots/{name}", self._rr.SeriesLines(names=last, colors=_CURVES.get(last)), static=True)
        self._log(f"plots/{name}", self._rr.Scalars(value))

    def log_text(self, source: str, text: str, level: str = "INFO") -> None:
        """A line of the log."""
        self._log(f"log/{source}", self._rr.TextLog(text, level=level))

    def _log(self, path: str, entity: rerun.AsComponents, static: bool = False) -> None:
        self._rr.log(path, entity, static=static, recording=self.recording)


def _joint_colours(joints_of: JointSet, opacity: int) -> np.ndarray:
    rows = [(*SIDE_COLOURS[side_of(joint, joints_of.joints)], opacity) for joint in joints_of.joints]
    return np.array(rows, np.uint8)


def layout(views: tuple[str, ...], *, follow: bool = False) -> rrb.Blueprint:
    """The body in its world beside the image with its keypoints, above curves and the log.

    Parameters
    ----------
    views : groups of curves, one view each; "log" for the messages of the nodes
    follow : show the newest image instead of the first, and hide refined poses
    """
    import rerun.blueprint as rrb

    contents = [f"+ /{WORLD}/**"]
    if follow:  # two seconds old, it would be a second body
        contents.append(f"- /{subject_path('refined')}/**")
    below = [
        rrb.TextLogView(origin="log", name="log")
        if name == "log"
        else rrb.TimeSeriesView(origin=f"plots/{name}", name=name.replace("_", " "))
        for name in views
    ]
    return rrb.Blueprint(
        rrb.Vertical(
            rrb.Horizontal(
                rrb.Spatial3DView(
                    origin=WORLD, contents=contents, name="3D", background=rrb.Background(color=_BACKGROUND)
                ),
                rrb.Spatial2DView(origin=IMAGE, name="image"),
                column_shares=[3, 2],
            ),
            rrb.Horizontal(*below),
            row_shares=[3, 1],
        ),
        rrb.TimePanel(state="collapsed", timeline="image", play_state="following" if follow else None),
        rrb.SelectionPanel(state="collapsed"),
        rrb.BlueprintPanel(state="collapsed"),
    )
