"""Keypoints of one simulated person in every order, and inputs that are none of it."""

import itertools

import numpy as np

from drocap_ros.recording.keypoints.orders import ORDERS
from drocap_ros.simulation.pinhole import pinhole_matrix, project, to_camera
from drocap_ros.simulation.simulated_person import simulate_person
from drocap_ros.skeleton import BODY_17
from lab.simulation.orbit import orbit_camera

SIZE = (1280, 720)
J = BODY_17.index


def views(action="walk", seed=0, seconds=3.0, height_m=3.0, speed_deg_s=20.0, start_deg=0.0):
    """(F, 17, 3) m of BODY_17 in the world, the same in the camera, and (F, 17, 2) px."""
    t = np.arange(0, seconds, 1 / 30)
    world = simulate_person(t, action, seed, joint_set=BODY_17)
    pose = orbit_camera(t, world[:, 0], 5.0, height_m, speed_deg_s, start_deg)
    return world, to_camera(world, *pose), project(world, *pose, pinhole_matrix(*SIZE, 60.0))


def in_order(points, order, rng, noise_px=1.0):
    """(F, P, D) of an order of points (F, 17, D): what is no joint of BODY_17 lies near the joints about it."""
    found = []
    shoulders, hips = (points[:, [J(f"l{p}"), J(f"r{p}")]].mean(axis=1) for p in ("shoulder", "hip"))
    across = 0.12 * (points[:, J("lshoulder")] - points[:, J("rshoulder")])
    for name in ORDERS[order]:
        sign = 1.0 if name.startswith("left") else -1.0 if name.startswith("right") else 0.0
        short = name.replace("left_", "l").replace("right_", "r")
        if short in BODY_17.joints:
            found.append(points[:, J(short)])
        elif any(part in name for part in ("nose", "eye", "ear", "mouth", "head", "crown", "face")):
            found.append(0.5 * (points[:, J("neck")] + points[:, J("head")]) + sign * across)
        elif any(part in name for part in ("neck", "thorax", "spine3", "collar")):
            found.append(0.8 * shoulders + 0.2 * points[:, J("neck")] + sign * across)
        elif "hip" in name:
            found.append(hips)
        elif any(part in name for part in ("spine", "chest", "torso", "naval")):
            found.append(0.5 * (shoulders + hips))
        elif any(part in name for part in ("toe", "heel", "ball")):
            found.append(points[:, J("ltoe" if sign > 0 else "rtoe")])
        else:
            found.append(points[:, J("lwrist" if sign > 0 else "rwrist")])
    stacked = np.stack(found, axis=1)
    return stacked + rng.normal(0, noise_px, stacked.shape)


def wrong_inputs():
    """(name, arrays of a file): sixty inputs of which no good motion follows."""
    rng, takes = np.random.default_rng(7), itertools.cycle(("walk", "boxing", "kicking", "squats", "mixed"))
    for number, (true, said) in enumerate(
        [("h36m17", "coco17"), ("coco17", "h36m17"), ("body17", "coco17"), ("coco17", "body17"),
         ("mpi3dhp17", "coco17"), ("openpose18", "coco18"), ("coco18", "openpose18"), ("kinect25", "openpose25"),
         ("openpose25", "kinect25"), ("lsp14", "crowdpose14"), ("aichallenger14", "lsp14"), ("coco21", "smpl22"),
         ("panoptic19", "openpose19"), ("openpose15", "body15"), ("itop15", "openpose15"), ("mpii16", "h36m16")]
    ):  # fmt: skip
        points = in_order(views(next(takes), number, start_deg=40 * number)[2], true, rng)
        names = ORDERS[said][: points.shape[1]]
        yield f"{true} named {said}", {"keypoints": points[:, : len(names)], "joints": np.array(names)}
    for number in range(14):
        order = ("coco17", "h36m17", "openpose25", "mediapipe33", "halpe26", "body17", "mpii16")[number % 7]
        points = in_order(views(next(takes), number, height_m=2 + number % 5)[2], order, rng)
        shuffled = points[:, rng.permutation(points.shape[1])]
        yield f"{order} shuffled {number}", {"keypoints": shuffled}
        if number % 2:
            yield f"{order} shuffled and named {number}", {"keypoints": shuffled, "joints": np.array(ORDERS[order])}
    for number, order in enumerate(("coco17", "h36m17", "openpose25", "mediapipe33")):
        world, camera, px = views(next(takes), number)
        about = world - world[:, :1]
        for unit, scale in (("m", 1.0), ("mm", 1000.0)):
            solid = in_order(about, order, rng, 0.0)
            yield f"{order} 3D about the hips in {unit}", {"keypoints": scale * solid}
            yield f"{order} 3D of the camera in {unit}", {"keypoints": scale * in_order(camera, order, rng, 0.0)}
        points = in_order(px, order, rng)
        yield f"{order} from -1 to 1", {"keypoints": 2 * points / SIZE[0] - [1, SIZE[1] / SIZE[0]]}
        yield f"{order} shares without a size", {"keypoints": points / SIZE}
        yield f"{order} y upwards", {"keypoints": [0, SIZE[1]] + points * [1, -1]}
