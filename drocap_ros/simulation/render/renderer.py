"""Images of a simulated person from any camera: a body of quadric surfaces in a scenery."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from drocap_ros.errors import InputError
from drocap_ros.perception.sources.image_files import encode_jpeg
from drocap_ros.simulation.render.body import Layer, Look, Quadrics, body, dress, rasterize
from drocap_ros.simulation.render.scenery import Scenery, draw_background, draw_shadow, make_scenery
from drocap_ros.skeleton import BODY_15, BODY_17

#: Largest width and height, px.
_MOST_PX = 8192


class Renderer:
    """A camera in a scenery; the same seed gives the same scenery and clothes, hence the same images.

    camera_matrix : (3, 3) px without skew, pixel centres at whole numbers
    width, height : px of the images
    seed : of the scenery and of the look of the person
    """

    def __init__(self, camera_matrix: np.ndarray, width: int, height: int, seed: int = 0) -> None:
        matrix = np.asarray(camera_matrix, float)
        if matrix.shape != (3, 3) or not np.isfinite(matrix).all() or min(matrix[0, 0], matrix[1, 1]) <= 0:
            raise InputError(f"camera_matrix: expected (3, 3), finite, positive focal lengths, got {matrix.tolist()}")
        if not (1 <= width <= _MOST_PX and 1 <= height <= _MOST_PX):
            raise InputError(f"width, height: expected 1 to {_MOST_PX} px, got {width} and {height}; choose a size")
        self.camera_matrix, self.width, self.height = matrix, int(width), int(height)
        self.scene = make_scenery(seed)
        self.look = dress(seed)

    def render(self, joints3d: np.ndarray, rotation: np.ndarray, position: np.ndarray) -> np.ndarray:
        """(H, W, 3) uint8 BGR.

        joints3d : (17, 3) m, world ENU, order of ``BODY_17``; (15, 3) without toes, which the feet then assume
        rotation : (3, 3) world -> camera (x right, y down, z forward)
        position : (3,) m, of the camera, world ENU
        """
        arrays = {
            "joints3d": (joints3d, (len(BODY_17 if np.shape(joints3d) == (len(BODY_17), 3) else BODY_15), 3)),
            "rotation": (rotation, (3, 3)),
            "position": (position, (3,)),
        }
        for name, (array, shape) in arrays.items():
            if np.shape(array) != shape or not np.isfinite(array).all():
                raise InputError(
                    f"{name}: expected {shape} of finite numbers, got {np.shape(array)}; correct its source"
                )
        joints, rotation, position = (np.asarray(values, float) for values in (joints3d, rotation, position))
        size = (self.width, self.height)
        image, _ = draw(self.scene, self.look, self.camera_matrix, size, joints, rotation, position)
        return image

    def jpeg(self, quality: int, joints3d: np.ndarray, rotation: np.ndarray, position: np.ndarray) -> bytes:
        """The image of :meth:`render` as a JPEG file of this quality."""
        return encode_jpeg(self.render(joints3d, rotation, position), quality)


def draw(
    scene: Scenery,
    look: Look,
    matrix: np.ndarray,
    size: tuple[int, int],
    joints: np.ndarray,
    rotation: np.ndarray,
    position: np.ndarray,
) -> tuple[np.ndarray, np.ndarray | None]:
    """Image (H, W, 3) uint8 BGR, and the box (4,) px x_min y_min x_max y_max of the visible person, or None.

    The arguments are those of :class:`Renderer`, unvalidated; size is width and height px.
    """
    image, boxes = draw_people(scene, [(joints, look)], matrix, size, rotation, position)
    return image, boxes[0]


def draw_people(
    scene: Scenery,
    people: Sequence[tuple[np.ndarray, Look]],
    matrix: np.ndarray,
    size: tuple[int, int],
    rotation: np.ndarray,
    position: np.ndarray,
) -> tuple[np.ndarray, list[np.ndarray | None]]:
    """Image of several persons, each joints (15, 3) m and a look, and their boxes as in :func:`draw`.

    Nearer persons cover farther ones; the boxes show each person as if it were alone.
    """
    import cv2

    bodies = [body(joints, look) for joints, look in people]
    image = _draw_surroundings(scene, [surfaces for surfaces, _ in bodies], matrix, size, rotation, position)
    boxes: list[np.ndarray | None] = [None] * len(people)
    distance = [float(np.linalg.norm(joints[0] - position)) for joints, _ in people]
    for i in sorted(range(len(people)), key=lambda i: -distance[i]):
        (surfaces, parts), look = bodies[i], people[i][1]
        visible = _in_camera(surfaces, rotation, position)
        colours = np.array([look.colours[part] for part in parts], np.float32)
        # A person with a larger box, in px, is drawn at half the resolution, for speed.
        factor = 2 if _person_px(visible, matrix, *size) > 150_000 else 1
        shrunk = (_scaled(matrix, 1 / factor), -(-size[0] // factor), -(-size[1] // factor))
        layer = rasterize(visible, *shrunk, rotation @ scene.sun)
        if layer is None:
            continue
        mask, painted = _shaded(layer, colours, scene.sunlight)
        if factor > 1:
            double = (mask.shape[1] * factor, mask.shape[0] * factor)
            mask = np.where(cv2.resize(mask, double, interpolation=cv2.INTER_LINEAR) > 127, np.uint8(255), np.uint8(0))
            painted = cv2.resize(painted, double, interpolation=cv2.INTER_LINEAR)
        boxes[i] = _overlay_person(image, mask, painted, layer.x * factor, layer.y * factor)
    return image, boxes


def _draw_surroundings(
    scene: Scenery,
    bodies: list[Quadrics],
    matrix: np.ndarray,
    size: tuple[int, int],
    rotation: np.ndarray,
    position: np.ndarray,
) -> np.ndarray:
    """Image (H, W, 3) of the scenery with the shadows of bodies, of larger images at half the resolution."""
    import cv2

    width, height = size
    # Larger images, in px, have a background of half the resolution, for speed; haze and blur hide it.
    coarse = 2 if width * height > 300_000 else 1
    small = _scaled(matrix, 1 / coarse)
    reduced = (-(-width // coarse), -(-height // coarse))
    image = draw_background(scene, small, *reduced, rotation, position)
    for surfaces in bodies:
        draw_shadow(scene, image, surfaces.ends, surfaces.reach, small, rotation, position)
    if coarse > 1:
        image = cv2.resize(image, (reduced[0] * coarse, reduced[1] * coarse), interpolation=cv2.INTER_LINEAR)
        image = np.ascontiguousarray(image[:height, :width])
    return image


def _scaled(matrix: np.ndarray, scale: float) -> np.ndarray:
    """Camera matrix of the scaled image; pixel centres stay at whole numbers."""
    shrunk = matrix * scale
    shrunk[:2, 2] = (matrix[:2, 2] + 0.5) * scale - 0.5
    shrunk[2] = matrix[2]
    return shrunk


def _in_camera(q: Quadrics, rotation: np.ndarray, position: np.ndarray) -> Quadrics:
    """Surfaces of the world in the camera's frame."""
    # x_world = R' x_camera + position
    a = rotation @ q.a @ rotation.T
    moved = q.b + q.a @ position
    c = q.c + 2 * q.b @ position + np.einsum("i,nij,j->n", position, q.a, position)
    shift = q.axis @ position
    axis, ends = q.axis @ rotation.T, (q.ends - position) @ rotation.T
    return Quadrics(a, moved @ rotation.T, c, axis, q.low - shift, q.high - shift, ends, q.reach)


def _person_px(visible: Quadrics, matrix: np.ndarray, width: int, height: int) -> float:
    """Approximate number of pixels of the person's box."""
    depth = np.maximum(visible.ends[..., 2], 0.2)
    px = visible.ends[..., :2] / depth[..., None] * np.diag(matrix)[:2] + matrix[:2, 2]
    px = np.clip(px.reshape(-1, 2), 0, [width, height])
    return float(np.prod(np.ptp(px, axis=0)))


def _shaded(layer: Layer, colours: np.ndarray, sunlight: float) -> tuple[np.ndarray, np.ndarray]:
    """Mask (h, w) uint8 0 or 255 and colours (h, w, 3) uint8 of a layer."""
    import cv2

    direct = np.maximum(layer.light, 0)
    bright = np.float32(0.62 - 0.25 * sunlight) + np.float32(0.12) * layer.light + np.float32(1.15 * sunlight) * direct
    mask = (layer.surface >= 0).view(np.uint8) * np.uint8(255)
    table = np.concatenate([colours, np.zeros((1, 3), np.float32)])  # -1 = no surface indexes the last
    painted = np.take(table, layer.surface, axis=0, mode="wrap")
    painted *= bright[..., None]
    return mask, cv2.convertScaleAbs(painted)


def _overlay_person(image: np.ndarray, mask: np.ndarray, painted: np.ndarray, x: int, y: int) -> np.ndarray | None:
    """Draw the person over the image with slightly blurred edges; returns its box (4,) px or None."""
    import cv2

    height, width = image.shape[:2]
    mask, painted = mask[: height - y, : width - x], painted[: height - y, : width - x]
    columns, rows = np.flatnonzero(mask.any(axis=0)), np.flatnonzero(mask.any(axis=1))
    if not columns.size:
        return None
    part = image[y : y + mask.shape[0], x : x + mask.shape[1]]
    cv2.copyTo(painted, mask, part)
    y0, x0 = max(y - 1, 0), max(x - 1, 0)
    edge = image[y0 : y + mask.shape[0] + 1, x0 : x + mask.shape[1] + 1]
    edge[:] = cv2.GaussianBlur(edge, (3, 3), 0.7)
    return np.array([x + columns[0], y + rows[0], x + columns[-1] + 1, y + rows[-1] + 1], float)
