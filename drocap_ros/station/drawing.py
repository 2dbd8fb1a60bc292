"""What the station draws: keypoints over the picture, the plan, the body in 3D.  Functions of arrays; text is SVG."""

from __future__ import annotations

import numpy as np

from drocap_ros.app.skeleton_svg import skeleton_svg
from drocap_ros.keypoints import PoseObservation
from drocap_ros.skeleton import JointSet

#: Points of a bone of the 3D body.
_BONE_POINTS = 8
#: Half width of the plan beyond what it shows, as a share of it, and least half width, m.
_MARGIN, _LEAST_M = 1.15, 8.0


def keypoints_svg(observation: PoseObservation) -> str:
    """Bones and joints over an image, in its pixels."""
    joints, width = observation.joints, max(observation.image_size)
    return skeleton_svg(joints.joints, joints.bones.tolist(), observation.keypoints, width / 300)


def bearing_svg(image_size: tuple[int, int], bearing_deg: float, speed_deg_s: float) -> str:
    """At the lower edge of an image: from where the camera looks at the subject, and where the orbit leads it."""
    if not np.isfinite(bearing_deg):
        return ""
    width, height = image_size
    size = height / 22
    # Counter-clockwise from above the camera moves to its right.
    way = "→" if speed_deg_s > 0.5 else "←" if speed_deg_s < -0.5 else "·"
    text = f"{way} from {bearing_deg:03.0f}° {way}"
    return (
        f'<text x="{width / 2:.0f}" y="{height - size:.0f}" font-size="{size:.0f}" text-anchor="middle" fill="white"'
        f' stroke="black" stroke-width="{size / 9:.1f}" paint-order="stroke" font-family="sans-serif">{text}</text>'
    )


def bearing_deg(subject: np.ndarray, vehicle: np.ndarray) -> float:
    """Compass bearing of the vehicle from the subject, both (3,) m ENU, 0 = north, 90 = east; NaN = unknown."""
    east, north = (vehicle - subject)[:2]
    return float(np.degrees(np.arctan2(east, north)) % 360.0)


def plan_svg(
    subject: np.ndarray,
    vehicle: np.ndarray,
    heading: np.ndarray,
    fence: np.ndarray | None,
    radii: tuple[float, float],
) -> str:
    """Subject, vehicle and fence from above, north up.

    subject, vehicle : (3,) m ENU, NaN = unknown
    heading : (2,) direction of the nose
    fence : (2,) centre, None = no orbit has begun: the fence of one that would begin now is dashed
    radii : m, of the fence, of the present orbit (NaN = unknown)
    """
    fence_m, orbit_m = radii
    centre = fence if fence is not None else subject[:2]
    if not np.isfinite(centre).all():
        centre = vehicle[:2] if np.isfinite(vehicle).all() else np.zeros(2)
    away = vehicle[:2] - centre
    half = _MARGIN * max(fence_m, float(np.abs(away).max()) if np.isfinite(away).all() else 0.0, _LEAST_M)

    def place(point: np.ndarray) -> tuple[float, float]:
        return float(point[0] - centre[0]), float(centre[1] - point[1])

    parts = [
        f'<svg viewBox="{-half:.2f} {-half:.2f} {2 * half:.2f} {2 * half:.2f}" role="img" aria-label="plan, north up"'
        f' style="width:100%;max-height:60vh" fill="none" stroke-width="{half / 150:.3f}">',
        f'<text y="{-0.9 * half:.2f}" font-size="{half / 10:.2f}" text-anchor="middle" fill="currentColor">N</text>',
        f'<circle r="{fence_m:.2f}" stroke="#c0392b"'
        + (f' stroke-dasharray="{half / 30:.2f}"/>' if fence is None else "/>"),
        _scale_bar(half),
    ]
    if np.isfinite(subject).all():
        x, y = place(subject)
        if np.isfinite(orbit_m):
            parts.append(f'<circle cx="{x:.2f}" cy="{y:.2f}" r="{orbit_m:.2f}" stroke="#2471a3"/>')
        parts.append(f'<circle cx="{x:.2f}" cy="{y:.2f}" r="{half / 40:.2f}" fill="#2e9e57"/>')
    if np.isfinite(vehicle).all():
        x, y = place(vehicle)
        turn = float(np.degrees(np.arctan2(heading[0], heading[1]))) if np.isfinite(heading).all() else 0.0
        size = half / 22
        parts.append(
            f'<path transform="translate({x:.2f} {y:.2f}) rotate({turn:.0f}) scale({size:.2f})"'
            ' d="M0 -1.4 L1 1 L0 0.5 L-1 1 Z" fill="#e67e22"/>'
        )
    return "".join((*parts, "</svg>"))


def _scale_bar(half: float) -> str:
    """A line of a round length at the lower left."""
    length = 10.0 ** np.floor(np.log10(half))
    x, y = -0.95 * half, 0.92 * half
    return (
        f'<path d="M{x:.2f} {y:.2f} h{length:.2f}" stroke="currentColor"/><text x="{x:.2f}" y="{y - half / 40:.2f}"'
        f' font-size="{half / 14:.2f}" fill="currentColor">{length:g} m</text>'
    )


def body_points(joints3d: np.ndarray, joints: JointSet) -> np.ndarray:
    """(N, 3) m along the bones of a pose (P, 3) m whose ends are known."""
    share = np.linspace(0.0, 1.0, _BONE_POINTS)[:, None]
    parent, child = joints3d[joints.bones[:, 0]], joints3d[joints.bones[:, 1]]
    points = ((1.0 - share) * parent[:, None] + share * child[:, None]).reshape(-1, 3)
    return np.asarray(points[np.isfinite(points).all(axis=1)])
