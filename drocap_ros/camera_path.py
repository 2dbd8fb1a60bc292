"""What is known of the camera of some images: its path, its errors and their source; "nothing" is a value, too.

Telemetry, the picture's fixed points, another person in the same images and the live graph all end in a
:class:`CameraPath`; every step of a reconstruction reads it.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from enum import Enum, auto

import numpy as np


class Teller(Enum):
    """Source of what is known of a camera."""

    NOTHING = auto()
    REPORTS = auto()  # as they are
    POINTS_AND_REPORTS = auto()  # reports corrected by fixed points
    PICTURE = auto()  # fixed points alone
    PERSON = auto()  # the adjustment with another person in the same images


class Kind(Enum):
    """What a camera does by its picture; the value is a sentence's part for people."""

    MOVES = "a camera that moves"
    STANDS = "a camera that stands still"
    TURNS = "a camera that turns in its place"
    ZOOMS = "a camera that zooms: give a clip without a zoom"
    FEW_POINTS = "too few fixed points: no texture, blur or water"
    NOTHING_FIXED = "no points that stand still together: a crowd, leaves or water fill the picture"
    CUT = "a cut in the clip: give one scene (--start, --end)"

    @property
    def known(self) -> bool:
        """Whether the camera has a path."""
        return self in (Kind.MOVES, Kind.STANDS, Kind.TURNS)


class UpSource(Enum):
    """Source of the direction of up."""

    GROUND = "the plane of the ground's points under the feet"
    FEET = "the plane of resting feet"
    BODY = "the body's direction while it stands and walks"
    TOLD = "the attitude that was told"
    LINES = "something vertical that was marked"


@dataclass(frozen=True)
class CameraErrors:
    """Errors that are expected of a camera's path, as standard deviations, and what it can do.

    tilt_deg, yaw_deg : constant ones, about the gimbal's axes: gimbals know the horizon, not north
    latency_s : of attitude and position, which have most of it in common
    position_wander_m, attitude_wander_deg : slow ones, which are forgotten in position_wander_s, attitude_wander_s
    acceleration_m_s2 : ordinary one of the camera, infinity = any
    """

    tilt_deg: float = 0.3
    yaw_deg: float = 2.0
    latency_s: float = 0.1
    position_wander_m: float = 0.05
    position_wander_s: float = 60.0
    attitude_wander_deg: float = 0.1
    attitude_wander_s: float = 10.0
    acceleration_m_s2: float = 3.0

    @property
    def latency_covariance(self) -> np.ndarray:
        """(2, 2) s^2 of attitude and position: one log holds both, so they have most of it in common."""
        return np.asarray(self.latency_s**2 * (0.2 * np.eye(2) + 0.8))

    @property
    def wander_s(self) -> np.ndarray:
        """(6,) time constants of the slow errors of position and attitude."""
        return np.repeat([self.position_wander_s, self.attitude_wander_s], 3)


@dataclass(frozen=True)
class PictureFacts:
    """What fixed points tell of a camera, beside its path; positions in the path's unit.

    kind : what it does; the other fields count where that is known
    focal_std : of the logarithm of the focal length, 0 = it was given
    points : (J, 4) fixed points, x y z w
    residual_px : median of the points' residuals; covered : share of the frames with enough points
    position_std, turn_std_deg : of the path's change from knot to knot (an eighth of a second)
    drift : (F, 2) standard deviations of position and turn (rad) after the best similarity; None = unknown
    up, up_std_deg : source of up and its deviation; None = there is none yet
    told : (3,) up in the path's axes, by an attitude that was told; told_std_deg : its deviation; None = nobody did
    lines : (N, 3) normals of the planes of the camera and something vertical, in the path's axes
    scale_std : of the logarithm of the path's metres, NaN = the camera keeps its place
    feet_tell : resting feet measured them
    """

    kind: Kind
    focal_std: float = 0.0
    points: np.ndarray = field(default_factory=lambda: np.zeros((0, 4)))
    residual_px: float = float("nan")
    covered: float = 0.0
    position_std: float = float("nan")
    turn_std_deg: float = float("nan")
    drift: np.ndarray | None = None
    told: np.ndarray | None = None
    told_std_deg: float = float("nan")
    lines: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))
    up: UpSource | None = None
    up_std_deg: float = float("nan")
    scale_std: float = float("nan")
    feet_tell: bool = False

    def meta(self, matrix: np.ndarray | None) -> dict[str, object]:
        """JSON-compatible: where the world comes from; matrix (3, 3) px of the camera."""
        found: dict[str, object] = {"kind": self.kind.name.lower(), "words": self.kind.value}
        if not self.kind.known or matrix is None:
            return found
        focal = 0.5 * float(matrix[0, 0] + matrix[1, 1])
        found |= {
            "residual_px": _number(self.residual_px),
            "covered": self.covered,
            "focal_px": focal,
            "focal_std_px": _number(focal * self.focal_std),
        }
        if self.up is not None:
            found |= {
                "up": self.up.name.lower(),
                "up_words": self.up.value,
                "up_std_deg": self.up_std_deg,
                "scale_std": _number(self.scale_std),
            }
        return found


@dataclass(frozen=True)
class CameraPath:
    """The camera at F images; what is not known is None.

    stamp_ns : (F,)
    rotation : (F, 3, 3) world -> camera (x right, y down, z forward), NaN where unknown
    position : (F, 3) m in the world (z up), NaN where unknown
    matrix : (3, 3) px; lens : where it comes from, "given", "assumed", "picture" or "unknown"
    errors : that an adjustment with the body has to find; None = up is not sure enough for one
    covariance : (F, 6, 6) of position (m) and rotation (rad, camera axes) beyond these
    scale_std : of the logarithm of the path's metres; None = they are the world's
    metric, scale_source : of its metres
    corrected : fixed points have corrected the path; points_tell_up : they have measured its pitch
    measured : JSON-compatible, what they told of the reports
    picture : what they told where there are no reports; words : about it, for ``meta["camera"]``
    feet : (F, 3) m, the lower ankle of the person with whom the camera was found; up_std_deg : deviation of up
    refused : why there are no reports, as words
    """

    stamp_ns: np.ndarray
    rotation: np.ndarray | None = None
    position: np.ndarray | None = None
    matrix: np.ndarray | None = None
    lens: str = "unknown"
    teller: Teller = Teller.NOTHING
    errors: CameraErrors | None = None
    covariance: np.ndarray | None = None
    scale_std: float | None = None
    metric: bool = True
    scale_source: str = "telemetry"
    corrected: bool = False
    points_tell_up: bool = False
    measured: dict[str, object] | None = None
    picture: PictureFacts | None = None
    words: dict[str, object] | None = None
    feet: np.ndarray | None = None
    up_std_deg: float = 0.0
    refused: str = ""

    @property
    def known(self) -> np.ndarray:
        """(F,) bool, whether rotation and position are."""
        if self.rotation is None or self.position is None:
            return np.zeros(len(self.stamp_ns), bool)
        return np.asarray(np.isfinite(self.position).all(axis=1) & np.isfinite(self.rotation).all(axis=(1, 2)))

    @property
    def focal_px(self) -> float | None:
        """Focal length."""
        return None if self.matrix is None else 0.5 * float(self.matrix[0, 0] + self.matrix[1, 1])

    @property
    def upright(self) -> bool:
        """Whether up is sure enough for a method to see the rotation: one that is not bends bodies."""
        # Deviation (deg) of up below which a method sees it.  Ground under the feet has 0.5, feet alone 3: with such an
        # up the knees of a still camera's video were bent by 8 degrees more than without.
        return self.errors is not None and self.up_std_deg < 2.0

    @property
    def stands_on_points(self) -> bool:
        """Whether z = 0 is a plane of fixed points, the ground about the person."""
        return self.teller is Teller.PICTURE and self.picture is not None and self.picture.up is UpSource.GROUND

    @property
    def pose(self) -> tuple[np.ndarray, np.ndarray]:
        """Rotation and position of a camera that has both."""
        assert self.rotation is not None
        assert self.position is not None
        return self.rotation, self.position

    @property
    def of_reports(self) -> bool:
        """Whether its source is telemetry: the world is that of the Earth."""
        return self.teller in (Teller.REPORTS, Teller.POINTS_AND_REPORTS)

    def of_images(self, use: np.ndarray | slice) -> CameraPath:
        """The camera at some of the images."""
        names = ("stamp_ns", "rotation", "position", "covariance", "feet")
        return replace(self, **{name: value[use] for name in names if (value := getattr(self, name)) is not None})

    def moved(self, rotation: np.ndarray, position: np.ndarray | None) -> CameraPath:
        """The camera with another path (F, 3, 3), (F, 3)."""
        return replace(self, rotation=rotation, position=position)


def _number(value: float) -> float | None:
    """A number for JSON, which knows no NaN."""
    return value if np.isfinite(value) else None
