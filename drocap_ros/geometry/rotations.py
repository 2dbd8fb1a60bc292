"""Rotation matrices, rotation vectors and quaternions (xyzw, Hamilton), covariances as ellipsoids, pinholes.

All are batched over leading axes.
"""

from __future__ import annotations

import math

import numpy as np

LENGTH_ERROR = 0.1  # of a quaternion's length, from which it is none: far above rounding in a message


def hat(v: np.ndarray) -> np.ndarray:
    """Cross-product matrix (..., 3, 3) of vectors (..., 3): ``hat(v) @ u == cross(v, u)``."""
    out = np.zeros((*v.shape[:-1], 3, 3), dtype=v.dtype)
    out[..., 0, 1], out[..., 0, 2], out[..., 1, 2] = -v[..., 2], v[..., 1], -v[..., 0]
    out[..., 1, 0], out[..., 2, 0], out[..., 2, 1] = v[..., 2], -v[..., 1], v[..., 0]
    return out


def exp_so3(v: np.ndarray) -> np.ndarray:
    """Rotation matrices (..., 3, 3) of rotation vectors (..., 3) in rad, by Rodrigues' formula."""
    angle2 = np.sum(v * v, axis=-1)[..., None, None]
    angle = np.sqrt(angle2)
    small = angle < 1e-4
    safe = np.where(small, 1.0, angle)
    a = np.where(small, 1.0 - angle2 / 6.0, np.sin(safe) / safe)
    b = np.where(small, 0.5 - angle2 / 24.0, (1.0 - np.cos(safe)) / safe**2)
    k = hat(v)
    return np.asarray(np.eye(3, dtype=v.dtype) + a * k + b * (k @ k))


def log_so3(r: np.ndarray) -> np.ndarray:
    """Rotation vectors (..., 3) in rad of rotation matrices (..., 3, 3); the inverse of :func:`exp_so3` below pi."""
    q = quaternion_from_matrix(r)
    sine = np.linalg.norm(q[..., :3], axis=-1, keepdims=True)
    half = np.arctan2(sine, q[..., 3:])
    angle = 2.0 * np.where(half > 0.5 * np.pi, half - np.pi, half)
    return np.asarray(np.where(sine < 1e-12, 2.0, angle / np.maximum(sine, 1e-12)) * q[..., :3])


def left_jacobian(v: np.ndarray) -> np.ndarray:
    """(..., 3, 3) with ``exp_so3(v + d) = exp_so3(left_jacobian(v) @ d) @ exp_so3(v)`` for small ``d``."""
    angle2 = np.sum(v * v, axis=-1)[..., None, None]
    angle = np.sqrt(angle2)
    small = angle < 1e-4
    safe = np.where(small, 1.0, angle)
    a = np.where(small, 0.5 - angle2 / 24.0, (1.0 - np.cos(safe)) / safe**2)
    b = np.where(small, 1.0 / 6.0 - angle2 / 120.0, (safe - np.sin(safe)) / safe**3)
    k = hat(v)
    return np.asarray(np.eye(3, dtype=v.dtype) + a * k + b * (k @ k))


def project_to_so3(m: np.ndarray) -> np.ndarray:
    """Closest rotation (..., 3, 3), in Frobenius norm, to each matrix (..., 3, 3)."""
    u, _, vt = np.linalg.svd(m)
    u = np.ascontiguousarray(u)
    u[..., :, 2] *= np.sign(np.linalg.det(u @ vt))[..., None]
    return np.asarray(u @ vt)


def complete_rotation(rows: np.ndarray) -> np.ndarray:
    """Rotation (..., 3, 3) whose first two rows are closest to ``rows`` (..., 2, 3), in Frobenius norm.

    This is the projection on the Stiefel manifold V(2, 3), the third row being the cross product.
    """
    u, _, vt = np.linalg.svd(rows, full_matrices=False)
    first = u @ vt
    return np.concatenate([first, np.cross(first[..., :1, :], first[..., 1:, :])], axis=-2)


def matrix_from_quaternion(q: np.ndarray) -> np.ndarray:
    """Rotation matrices (..., 3, 3) of quaternions (..., 4), x y z w; they are normalized first."""
    single = q.ndim == 1  # NumPy takes five times as long as Python for a few numbers
    x, y, z, w = normalized(*q.tolist()) if single else np.moveaxis(unit(q), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.array(rows, q.dtype) if single else np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def quaternion_from_matrix(r: np.ndarray) -> np.ndarray:
    """Unit quaternions (..., 4), x y z w, of rotation matrices (..., 3, 3); the largest component is positive."""
    xx, yy, zz = r[..., 0, 0], r[..., 1, 1], r[..., 2, 2]
    # Rows of 4 q q^T, one per component; the row of the largest component avoids a division by a small number.
    rows = np.stack(
        [
            np.stack([1 + xx - yy - zz, r[..., 0, 1] + r[..., 1, 0], r[..., 0, 2] + r[..., 2, 0],
                      r[..., 2, 1] - r[..., 1, 2]], -1),
            np.stack([r[..., 0, 1] + r[..., 1, 0], 1 - xx + yy - zz, r[..., 1, 2] + r[..., 2, 1],
                      r[..., 0, 2] - r[..., 2, 0]], -1),
            np.stack([r[..., 0, 2] + r[..., 2, 0], r[..., 1, 2] + r[..., 2, 1], 1 - xx - yy + zz,
                      r[..., 1, 0] - r[..., 0, 1]], -1),
            np.stack([r[..., 2, 1] - r[..., 1, 2], r[..., 0, 2] - r[..., 2, 0], r[..., 1, 0] - r[..., 0, 1],
                      1 + xx + yy + zz], -1),
        ],
        axis=-2,
    )  # fmt: skip
    best = np.argmax(np.diagonal(rows, axis1=-2, axis2=-1), axis=-1)[..., None, None]
    q = np.take_along_axis(rows, np.broadcast_to(best, (*rows.shape[:-2], 1, 4)), axis=-2)[..., 0, :]
    return unit(q)


def unit(q: np.ndarray) -> np.ndarray:
    """Vectors (..., N) of length 1."""
    return np.asarray(q / np.linalg.norm(q, axis=-1, keepdims=True))


def normalized(x: float, y: float, z: float, w: float) -> tuple[float, float, float, float]:
    """One quaternion of length 1, to the bits of :func:`unit`; NaN where it has no length."""
    length = _length(x, y, z, w) or math.nan
    return x / length, y / length, z / length, w / length


def _length(x: float, y: float, z: float, w: float) -> float:
    return math.sqrt(x * x + y * y + z * z + w * w)


def unit_quaternions(q: np.ndarray) -> np.ndarray:
    """Normalized quaternions (N, 4); NaN where the length differs from 1 by more than a tenth."""
    length = np.linalg.norm(q, axis=1, keepdims=True)
    return np.where(np.abs(length - 1.0) < LENGTH_ERROR, q / np.where(length > 0, length, 1.0), np.nan)


def slerp(q0: np.ndarray, q1: np.ndarray, s: np.ndarray | float) -> np.ndarray:
    """Spherical interpolation (..., 4) from ``q0`` (s = 0) to ``q1`` (s = 1) along the shorter arc; x y z w."""
    if q0.ndim == q1.ndim == 1 and isinstance(s, float):
        return _slerp_one(q0.tolist(), q1.tolist(), s)
    q0, q1 = unit(q0), unit(q1)
    dot = np.sum(q0 * q1, axis=-1, keepdims=True)
    q1 = np.where(dot < 0, -q1, q1)
    s = np.asarray(s, dtype=float)[..., None]
    # atan2 of the chord is precise for nearly equal quaternions; arccos is not.
    angle = 2.0 * np.arctan2(
        np.linalg.norm(q1 - q0, axis=-1, keepdims=True), np.linalg.norm(q1 + q0, axis=-1, keepdims=True)
    )
    small = angle < 1e-6
    sine = np.where(small, 1.0, np.sin(angle))
    a = np.where(small, 1.0 - s, np.sin((1.0 - s) * angle) / sine)
    b = np.where(small, s, np.sin(s * angle) / sine)
    out = a * q0 + b * q1
    return unit(out)


def _slerp_one(first: list[float], last: list[float], s: float) -> np.ndarray:
    """The same of two quaternions, to the same bits: NumPy's angles, and Python's numbers."""
    a, b = normalized(*first), normalized(*last)
    if a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3] < 0:
        b = (-b[0], -b[1], -b[2], -b[3])
    angle = 2.0 * np.arctan2(
        _length(b[0] - a[0], b[1] - a[1], b[2] - a[2], b[3] - a[3]),
        _length(b[0] + a[0], b[1] + a[1], b[2] + a[2], b[3] + a[3]),
    )
    if angle < 1e-6:
        u, v = 1.0 - s, s
    else:
        sines = np.sin(((1.0 - s) * angle, s * angle, angle)).tolist()
        u, v = sines[0] / sines[2], sines[1] / sines[2]
    return np.array(normalized(*(u * p + v * q for p, q in zip(a, b, strict=True))))


def quaternion_multiply(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Product (..., 4) x y z w: first ``b``, then ``a``."""
    # By components: np.cross takes ten times as long for one quaternion, and NumPy's numbers five times as Python's.
    single = a.ndim == b.ndim == 1
    ax, ay, az, aw = a.tolist() if single else np.moveaxis(a, -1, 0)
    bx, by, bz, bw = b.tolist() if single else np.moveaxis(b, -1, 0)
    parts = [
        aw * bx + bw * ax + (ay * bz - az * by),
        aw * by + bw * ay + (az * bx - ax * bz),
        aw * bz + bw * az + (ax * by - ay * bx),
        aw * bw - (ax * bx + ay * by + az * bz),
    ]
    return np.array(parts, np.result_type(a, b)) if single else np.stack(parts, axis=-1)


def unpack_covariance(packed: np.ndarray) -> np.ndarray:
    """Symmetric matrices (..., 3, 3) of xx xy xz yy yz zz (..., 6)."""
    return packed[..., [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(*packed.shape[:-1], 3, 3)


def pack_covariance(matrix: np.ndarray) -> np.ndarray:
    """Elements xx xy xz yy yz zz (..., 6) of symmetric matrices (..., 3, 3)."""
    packed: np.ndarray = matrix[..., [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]
    return packed


def ellipsoids(covariance: np.ndarray, sigmas: float) -> tuple[np.ndarray, np.ndarray]:
    """Orientation (N, 4) x y z w and half axes (N, 3) m of the ellipsoids of covariances (N, 3, 3) m^2."""
    variances, axes = np.linalg.eigh(covariance)
    axes[np.linalg.det(axes) < 0, :, 0] *= -1.0  # a rotation, not a reflection
    # Least squared half axis: smaller ones are invisible.
    return quaternion_from_matrix(axes), sigmas * np.sqrt(np.maximum(variances, 1e-8))


#: Focal length of a lens of which nothing is known, share of the image's longer side: ``assumed_focal`` says why.
ASSUMED_FOCAL = 0.85


#: Ratio of the focal lengths up to which a matrix is one of a lens: anamorphic ones squeeze by two.
MOST_ASPECT = 4.0


def pixels_are_usual(matrix: np.ndarray) -> bool:
    """Whether the focal lengths of a matrix (3, 3) belong to one lens."""
    fx, fy = np.diagonal(matrix)[:2].tolist()
    return bool(0.0 < max(fx, fy) <= MOST_ASPECT * min(fx, fy))


def centred_camera(size: tuple[int, int], focal_px: float) -> np.ndarray:
    """Camera matrix (3, 3) px of images of ``size`` (width, height); pixel 0 has its centre at 0, as in OpenCV."""
    matrix = np.diag([focal_px, focal_px, 1.0])
    matrix[:2, 2] = (np.array(size) - 1) / 2
    return matrix


def assumed_camera(size: tuple[int, int]) -> np.ndarray:
    """Camera matrix (3, 3) px of images of ``size`` (width, height) of which nothing is known."""
    return centred_camera(size, ASSUMED_FOCAL * max(size))


def towards(ray: np.ndarray) -> np.ndarray:
    """(F, 3, 3) least turns that bring rays (F, 2), x and y at depth 1, to the axis."""
    length = np.linalg.norm(ray, axis=-1)
    angle = np.arctan(length) / np.maximum(length, 1e-12)
    return exp_so3(np.stack([ray[:, 1] * angle, -ray[:, 0] * angle, np.zeros(len(ray))], axis=-1))
