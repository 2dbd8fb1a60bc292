"""Rerun entities of a capture, from arrays, and their arrangement in the viewer."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

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

SUBJECT = "world/subject"
#: Groups of curves, one view each.
PLOTS = ("reprojection_px", "confidence")

_OPACITY = 200
_WIDTH_M = 0.012
_CURVE = (36, 112, 163)
_PATH = (51, 179, 77)
_BACKGROUND = (238, 240, 243)


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
        colours = _joint_colours(joints_of, _OPACITY)
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
            self._log(f"plots/{name}", self._rr.SeriesLines(names=last, colors=_CURVE), static=True)
        self._log(f"plots/{name}", self._rr.Scalars(value))

    def _log(self, path: str, entity: rerun.AsComponents, static: bool = False) -> None:
        self._rr.log(path, entity, static=static, recording=self.recording)


def _joint_colours(joints_of: JointSet, opacity: int) -> np.ndarray:
    rows = [(*SIDE_COLOURS[side_of(joint, joints_of.joints)], opacity) for joint in joints_of.joints]
    return np.array(rows, np.uint8)


def layout() -> rrb.Blueprint:
    """The body in its world beside the image with its keypoints, above curves."""
    import rerun.blueprint as rrb

    below = [rrb.TimeSeriesView(origin=f"plots/{name}", name=name.replace("_", " ")) for name in PLOTS]
    return rrb.Blueprint(
        rrb.Vertical(
            rrb.Horizontal(
                rrb.Spatial3DView(origin=WORLD, name="3D", background=rrb.Background(color=_BACKGROUND)),
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
