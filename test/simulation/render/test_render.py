"""The renderer: geometry, occlusion, light, and refused arguments."""

import numpy as np
import pytest

from drocap_ros.errors import InputError
from drocap_ros.simulation.pinhole import pinhole_matrix, project, to_camera
from drocap_ros.simulation.render.body import body, cones, dress, ellipsoids, joined, rasterize
from drocap_ros.simulation.render.renderer import Renderer, draw
from drocap_ros.simulation.render.scenery import make_scenery
from drocap_ros.simulation.simulated_person import ACTIONS, simulate_person
from drocap_ros.skeleton import BODY_15
from lab.simulation.orbit import look_at, orbit_camera

MATRIX = pinhole_matrix(1280, 720, 60)
LIGHT = np.array([0.0, -1.0, 0.0])


def orbit(action="mixed", seed=0, count=1, radius_m=6.0, height_m=2.5, start_deg=0.0):
    t = 1.3 + 2.1 * np.arange(count)
    joints = simulate_person(t, action, seed)
    rotation, position = orbit_camera(t, joints[:, 0], radius_m, height_m, 25.0, start_deg)
    return joints, rotation, position


def person_mask(joints, rotation, position, matrix=MATRIX, size=(1280, 720), seed=0):
    """Pixels that differ between the image and the same one with the person far behind the camera."""
    with_person = Renderer(matrix, *size, seed).render(joints, rotation, position).astype(int)
    moved = joints.copy()
    moved[:, :2] += 1e4 * (position - joints[0])[:2]  # no body, no shadow
    without = Renderer(matrix, *size, seed).render(moved, rotation, position).astype(int)
    return np.abs(with_person - without).sum(axis=2) > 0


def sphere(centre, radius):
    return ellipsoids(np.array([centre]), np.eye(3)[None], np.full((1, 3), radius))


def test_spheres_at_the_joints_are_drawn_at_their_projections():
    joints, rotation, position = orbit(count=6)
    px = project(joints, rotation, position, MATRIX)
    local = to_camera(joints, rotation, position)
    for frame in range(len(joints)):
        for point, at in zip(local[frame], px[frame], strict=True):
            layer = rasterize(sphere(point, 0.03), MATRIX, 1280, 720, LIGHT)
            rows, columns = np.nonzero(layer.surface >= 0)
            centre = np.array([columns.mean() + layer.x, rows.mean() + layer.y])
            assert np.abs(centre - at).max() < 0.3


def test_limbs_are_drawn_about_the_line_between_their_joints():
    joints, rotation, position = orbit("walk", count=4)
    px = project(joints, rotation, position, MATRIX)
    local = to_camera(joints, rotation, position)
    parent, child = BODY_15.bones.T
    for frame in range(len(joints)):
        for a, b in zip(parent, child, strict=True):
            limb = cones(local[frame, [a]], local[frame, [b]], np.array([0.04]), np.array([0.04]))
            layer = rasterize(limb, MATRIX, 1280, 720, LIGHT)
            rows, columns = np.nonzero(layer.surface >= 0)
            seen = np.stack([columns + layer.x, rows + layer.y], axis=1) - px[frame, a]
            axis = px[frame, b] - px[frame, a]
            length = np.linalg.norm(axis)
            if length < 15:  # seen along its axis: no line
                continue
            along, across = seen @ axis / length, seen @ np.array([-axis[1], axis[0]]) / length
            middle = (along > 0.3 * length) & (along < 0.7 * length)
            assert abs(across[middle].mean()) < 1.0


@pytest.mark.parametrize("size", [(1280, 720), (640, 480), (321, 241)])
def test_body_covers_its_joints_at_every_image_size(size):
    matrix = pinhole_matrix(*size, 60)
    for radius in (3.0, 6.0):  # near persons are drawn at half the resolution
        joints, rotation, position = orbit(count=3, radius_m=radius)
        px = np.round(project(joints, rotation, position, matrix)).astype(int)
        for frame in range(len(joints)):
            mask = person_mask(joints[frame], rotation[frame], position[frame], matrix, size)
            inside = (px[frame] >= 0).all(axis=1) & (px[frame] < size).all(axis=1)
            assert inside.sum() >= 12
            x, y = px[frame][inside].T
            assert mask[y, x].all()


def test_near_person_at_half_resolution_has_the_same_outline():
    joints, rotation, position = (v[0] for v in orbit(radius_m=2.6))
    surfaces, _ = body(joints, dress(0))
    ends = to_camera(surfaces.ends, rotation[None].repeat(len(surfaces.ends), 0), position[None])
    _, box = draw(make_scenery(0), dress(0), MATRIX, (1280, 720), joints, rotation, position)
    assert np.prod(box[2:] - box[:2]) > 150_000
    turned = surfaces._replace(
        a=rotation @ surfaces.a @ rotation.T,
        b=(surfaces.b + surfaces.a @ position) @ rotation.T,
        c=surfaces.c + 2 * surfaces.b @ position + np.einsum("i,nij,j->n", position, surfaces.a, position),
        axis=surfaces.axis @ rotation.T,
        low=surfaces.low - surfaces.axis @ position,
        high=surfaces.high - surfaces.axis @ position,
        ends=ends,
    )
    rows, columns = np.nonzero((layer := rasterize(turned, MATRIX, 1280, 720, LIGHT)).surface >= 0)
    full = np.array([columns.min(), rows.min(), columns.max() + 1, rows.max() + 1]) + [layer.x, layer.y] * 2
    assert np.abs(full - box).max() <= 2


def test_outline_of_a_sphere_is_exact_to_a_pixel():
    centre, radius = np.array([0.4, -0.3, 5.0]), 0.5
    layer = rasterize(sphere(centre, radius), MATRIX, 1280, 720, LIGHT)
    v, u = np.mgrid[:720, :1280]
    rays = np.stack([(u - MATRIX[0, 2]) / MATRIX[0, 0], (v - MATRIX[1, 2]) / MATRIX[1, 1], np.ones_like(u)], -1)
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    truth = np.linalg.norm(centre - (rays @ centre)[..., None] * rays, axis=-1) < radius
    found = np.zeros_like(truth)
    height, width = layer.surface.shape
    found[layer.y : layer.y + height, layer.x : layer.x + width] = layer.surface >= 0
    assert (found != truth).sum() < 0.002 * truth.sum()


def test_nearer_surface_hides_the_farther_one_in_any_order():
    near, far = sphere([0.0, 0.0, 4.0], 0.2), sphere([0.05, 0.0, 5.0], 0.4)
    for pair, front in ((joined([near, far]), 0), (joined([far, near]), 1)):
        layer = rasterize(pair, MATRIX, 1280, 720, LIGHT)
        middle = layer.surface[round(MATRIX[1, 2]) - layer.y, round(MATRIX[0, 2]) - layer.x]
        assert middle == front
        assert set(np.unique(layer.surface)) == {-1, 0, 1}


def test_limb_hides_part_of_another_and_ends_at_its_joints():
    cross = cones(
        np.array([[-1.0, 0, 5], [0, -1.0, 4.5]]),
        np.array([[1.0, 0, 5], [0, 1.0, 4.5]]),
        np.full(2, 0.1),
        np.full(2, 0.1),
    )
    layer = rasterize(cross, MATRIX, 1280, 720, LIGHT)
    row, column = round(MATRIX[1, 2]) - layer.y, round(MATRIX[0, 2]) - layer.x
    assert layer.surface[row, column] == 1
    wide = np.flatnonzero((layer.surface == 0).any(axis=0))
    assert wide[-1] - wide[0] + 1 == pytest.approx(2 * MATRIX[0, 0] / 4.9, abs=3)  # its front is 4.9 m away


def test_side_towards_the_sun_is_lit():
    layer = rasterize(sphere([0.0, 0.0, 5.0], 0.5), MATRIX, 1280, 720, np.array([0.0, -1.0, 0.0]))
    half = layer.light.shape[0] // 2
    assert layer.light[:half].sum() > 0 > layer.light[half:].sum()
    assert layer.light.max() <= 1.001


def test_front_and_back_of_the_head_differ():
    """The face and the chest have other colours than hair and back."""
    joints = simulate_person(np.array([0.0]), "stand", 3)
    ahead = np.cross(joints[0, BODY_15.index("lhip")] - joints[0, BODY_15.index("rhip")], [0, 0, 1.0])
    ahead /= np.linalg.norm(ahead)
    look, scene = dress(3), make_scenery(3)
    seen = {}
    for name, sign in (("front", 1), ("back", -1)):
        position = joints[0, 0] + sign * 4 * ahead + np.array([0, 0, 0.6])
        rotation = look_at(position[None], joints[:, 0])[0]
        image, _ = draw(scene, look, MATRIX, (1280, 720), joints[0], rotation, position)
        x, y = np.round(project(joints, rotation[None], position[None], MATRIX)[0, BODY_15.index("head")]).astype(int)
        seen[name] = image[y - 6 : y + 18, x - 8 : x + 9].reshape(-1, 3).mean(axis=0)
    assert np.abs(seen["front"] - seen["back"]).max() > 30


def test_toes_point_forward_and_the_body_stays_above_the_ground():
    for action in ACTIONS:
        for frame in simulate_person(np.arange(0, 12, 0.7), action, 2):
            surfaces, parts = body(frame, dress(1))
            shoes = [i for i, part in enumerate(parts) if part == "shoes"]
            assert len(shoes) == 2
            assert surfaces.ends[..., 2].min() > 0.0
            ahead = np.cross(frame[BODY_15.index("lhip")] - frame[BODY_15.index("rhip")], [0, 0, 1.0])
            for i, side in zip(shoes, "lr", strict=True):
                sole = surfaces.ends[i, 0] - frame[BODY_15.index(side + "ankle")]
                assert sole @ ahead > 0


def test_image_depends_on_the_seed_alone():
    joints, rotation, position = (v[0] for v in orbit())
    first = Renderer(MATRIX, 1280, 720, 5).render(joints, rotation, position)
    again = Renderer(MATRIX, 1280, 720, 5).render(joints, rotation, position)
    other = Renderer(MATRIX, 1280, 720, 6).render(joints, rotation, position)
    assert first.shape == (720, 1280, 3)
    assert first.dtype == np.uint8
    assert (first == again).all()
    assert (first != other).mean() > 0.5


def test_horizon_lies_at_zero_elevation():
    """Sky above, ground below, for a level camera and one that rolls."""
    scene, look = make_scenery(2), dress(2)
    position = np.array([0.0, 0.0, 3.0])
    level = look_at(position[None], np.array([[0.0, 50.0, 3.0]]))[0]
    far = simulate_person(np.array([0.0]), "stand")[0] + np.array([0, -500.0, 0])
    for roll in (0.0, 0.3, -0.4):
        turn = np.array([[np.cos(roll), -np.sin(roll), 0], [np.sin(roll), np.cos(roll), 0], [0, 0, 1]])
        rotation = turn @ level
        image, box = draw(scene, look, MATRIX, (1280, 720), far, rotation, position)
        assert box is None
        v, u = np.mgrid[:720:8, :1280:8]
        rise = np.stack([(u - MATRIX[0, 2]) / MATRIX[0, 0], (v - MATRIX[1, 2]) / MATRIX[1, 1], np.ones(u.shape)], -1)
        rise = rise @ rotation[:, 2]
        sky = np.abs(image[::8, ::8].astype(float) - scene.horizon).max(axis=2)
        ground = scene.near.view(np.uint8).reshape(-1, 4)[:, :3].mean(axis=0)
        assert np.linalg.norm(image[::8, ::8][rise < -0.25].mean(axis=0) - ground) < 30
        assert np.median(sky[np.abs(rise) < 0.01]) < 40


def test_ground_mark_is_found_at_its_projection_from_two_positions():
    """A mark of the ground is found at its own projection from two places."""
    scene = make_scenery(4)
    side, size = len(scene.near), 24.0
    near = np.full((side, side), 0x00808080, np.uint32)
    near[500:524, 300:324] = 0x000000FF  # pure blue (BGRX)
    plain = scene.__class__(**{**scene.__dict__, "near": near, "haze_m": 1e6})
    middle = np.array([[312 - 0.5, 512 - 0.5]]) * size / side + 0.5 * size / side
    spot = np.array([middle[0, 0], middle[0, 1], 0.0])
    far = simulate_person(np.array([0.0]), "stand")[0] + np.array([0, -500.0, 0])
    for offset in ([2.0, -5.0, 3.0], [-4.0, -3.0, 2.0]):
        position = spot + np.array(offset)
        rotation = look_at(position[None], (spot + np.array([0.4, 0.3, 0.0]))[None])[0]
        image, _ = draw(plain, dress(0), MATRIX, (1280, 720), far, rotation, position)
        blue = image[..., 0].astype(int) - image[..., 2] > 60
        at = project(spot[None, None], rotation[None], position[None], MATRIX)[0, 0]
        rows, columns = np.nonzero(blue)
        assert rows.size > 100
        near_it = (np.abs(columns - at[0]) < 120) & (np.abs(rows - at[1]) < 120)
        centre = np.array([columns[near_it].mean(), rows[near_it].mean()])
        assert np.abs(centre - at).max() < 6  # a patch's middle in perspective is not quite the middle of its image


def test_person_at_the_border_outside_behind_or_at_the_lens_is_drawn_as_far_as_visible():
    joints, rotation, position = (v[0] for v in orbit("stand"))
    matrix = MATRIX.copy()
    matrix[0, 2] -= 640  # the person at the left edge
    renderer = Renderer(matrix, 1280, 720, 0)
    renderer.render(joints, rotation, position)
    mask = person_mask(joints, rotation, position, matrix)
    assert mask[:, :100].any()
    sideways = joints + 40 * rotation[0]
    behind = joints + 2 * (position - joints[0])
    for away in (sideways, behind, joints + (position - joints[BODY_15.index("head")])):
        image = renderer.render(away, rotation, position)
        assert image.shape == (720, 1280, 3)
    scene, look = make_scenery(0), dress(0)
    for away in (sideways, behind):
        assert draw(scene, look, MATRIX, (1280, 720), away, rotation, position)[1] is None


def test_invalid_arguments_are_refused_in_one_line():
    joints, rotation, position = (v[0] for v in orbit())
    renderer = Renderer(MATRIX, 64, 48, 0)
    bad = joints.copy()
    bad[3, 1] = np.nan
    for arguments in (
        (bad, rotation, position),
        (joints[:14], rotation, position),
        (joints, rotation[:2], position),
        (joints, rotation, np.array([0.0, np.inf, 1.0])),
    ):
        with pytest.raises(InputError, match=r"expected .* got") as error:
            renderer.render(*arguments)
        assert "\n" not in str(error.value)
    for matrix, width, height in ((-MATRIX, 64, 48), (MATRIX, 0, 48), (MATRIX, 64, 100_000), (MATRIX[:2], 64, 48)):
        with pytest.raises(InputError, match="expected"):
            Renderer(matrix, width, height, 0)
