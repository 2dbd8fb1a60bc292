"""One walk in every spelling of numbers, names, axes, times and persons that files of keypoints have."""

import itertools
import json

import numpy as np
import pytest
from orders_of_points import in_order, views
from test_keypoint_files import SIZE, flat, rows, text, walk, write

from drocap_ros.cli import main
from drocap_ros.errors import InputError
from drocap_ros.recording.keypoints import frames
from drocap_ros.recording.keypoints.files import Stated, is_keypoint_file, read_keypoints
from drocap_ros.skeleton import COCO_17

JOINTS = COCO_17.joints


def is_walk(found, k, tolerance_px=0.01):
    seen = k[..., 2] > 0
    return (
        len(found) == len(k)
        and found.joints == JOINTS
        and (np.isfinite(found.keypoints).all(axis=2) == seen).all()
        and np.abs(found.keypoints - k[..., :2])[seen].max() < tolerance_px
    )


TITLES = {
    "plain": lambda n, a: f"{n}_{a}", "capitals": lambda n, a: f"{n}_{a}".upper(), "dots": lambda n, a: f"{n}.{a}",
    "spaces": lambda n, a: f"{n.replace('_', ' ')} {a}", "turned": lambda n, a: f"{a}_{n}",
    "camel": lambda n, a: "".join(w.title() for w in n.split("_")) + {"x": "X", "y": "Y"}.get(a, "C"),
    "unit": lambda n, a: f"{n}_{a} (px)" if a in "xy" else f"{n}_{a}", "suffix": lambda n, a: f"{n}_{a}_px"[:99],
}  # fmt: skip
SCORES = ("score", "confidence", "likelihood", "visibility", "vis", "presence", "prob", "c")


@pytest.mark.parametrize("title", TITLES.values(), ids=TITLES)
@pytest.mark.parametrize(("separator", "point"), [(",", "."), (";", "."), (";", ","), ("\t", ","), (",", '","')])
@pytest.mark.parametrize(("encoding", "before"), [("utf-8", ""), ("utf-8-sig", ""), ("utf-16", ""),
                                                  ("utf-8", "sep={}\n"), ("utf-8", "# by a tool\n\n")])  # fmt: skip
def test_a_table_is_read_in_every_spelling(tmp_path, title, separator, point, encoding, before):
    k = walk()
    k[3, 9] = 0.0
    k[..., 2] = np.where(k[..., 2] > 0, 0.5 + 0.4 * np.arange(17) / 17, 0)
    score = SCORES[len(encoding + before + point + separator) % len(SCORES)]
    quoted = point == '","'
    cells = [[str(i), *(f'"{v}"'.replace(".", ",") if quoted else f"{v}".replace(".", point) for v in flat(p))]
             for i, p in enumerate(k)]  # fmt: skip
    head = ["Frame", *(title(n, a) for n in JOINTS for a in ("x", "y", score))]
    content = before.format(separator) + "\r\n".join(separator.join(row) for row in [head, *cells]) + "\r\n"
    (tmp_path / "a.csv").write_bytes(content.encode(encoding))
    assert is_keypoint_file(tmp_path / "a.csv")
    found = read_keypoints(tmp_path / "a.csv", Stated(15.0, SIZE))
    assert is_walk(found, k)
    if title in (TITLES["plain"], TITLES["capitals"], TITLES["dots"]):
        assert found.confidence == pytest.approx(k[..., 2], abs=1e-3)


@pytest.mark.parametrize("folders", [0, 1, 2])
@pytest.mark.parametrize("individuals", [False, True])
def test_labels_of_deeplabcut_lose_no_frame(tmp_path, folders, individuals):
    k = walk(20)
    begin = [[name, *[""] * folders] for name in ("scorer", "individuals", "bodyparts", "coords")]
    columns = [["me"] * 34, ["one"] * 34, [n for n in JOINTS for _ in "xy"], ["x", "y"] * 17]
    table = [b + c for b, c in zip(begin, columns, strict=True) if individuals or b[0] != "individuals"]
    for i, p in enumerate(k):
        label = ["labeled-data", "walk", f"img{i:03d}.png"]
        table.append(["/".join(label[: 3 - folders]), *label[3 - folders :], *map(str, flat(p[:, :2]))])
    found = read_keypoints(
        text(tmp_path / "CollectedData.csv", "\n".join(",".join(r) for r in table)), Stated(15.0, SIZE)
    )
    assert is_walk(found, k)


@pytest.mark.parametrize("code", [0, -1, -9999, 9999, 65535, 1e6, None, "", "NaN"])
@pytest.mark.parametrize("form", ["flat", "pairs", "csv"])
def test_a_missing_point_is_missing_in_every_code(tmp_path, code, form):
    k = walk(20)
    lost = [(i, j) for i in range(5, 9) for j in (9, 10, 15)] + [(12, j) for j in range(17)]
    points = [
        [[code, code, 0.9] if (i, j) in lost else p for j, p in enumerate(rows(frame))] for i, frame in enumerate(k)
    ]
    for i, j in lost:
        k[i, j] = 0.0
    if form == "csv":
        head = ["frame"] + [f"{n}_{a}" for n in JOINTS for a in ("x", "y", "score")]
        body = [[i, *("" if v is None else v for p in frame for v in p)] for i, frame in enumerate(points)]
        path = text(tmp_path / "k.csv", "\n".join(",".join(map(str, row)) for row in [head, *body]))
    elif code in ("", "NaN"):
        return
    else:
        each = [list(itertools.chain(*frame)) for frame in points] if form == "flat" else points
        path = write(tmp_path / "k.json", [{"frame": i, "keypoints": p} for i, p in enumerate(each)])
    assert is_walk(read_keypoints(path, Stated(15.0, SIZE)), k)


@pytest.mark.parametrize(("said", "rate_hz"), [
    ({"fps": 25}, 25), ({"FPS": "25"}, 25), ({"frameRate": 29.97}, 29.97), ({"video_fps": "30000/1001"}, 29.97),
    ({"fps": "50 fps"}, 50), ({"info": {"Frame-Rate": 12.5}}, 12.5),
])  # fmt: skip
@pytest.mark.parametrize("size", [
    {"image_size": [1280, 720]}, {"resolution": "1280x720"}, {"imageWidth": 1280, "imageHeight": 720},
    {"img_shape": [720, 1280, 3]}, {"w": 1280, "h": 720}, {"video": {"Width": "1280", "Height": "720"}},
])  # fmt: skip
def test_rate_and_size_are_read_however_they_are_called(tmp_path, caplog, said, rate_hz, size):
    box = {"bbox": {"x": 5, "y": 9, "width": 60, "height": 80}, "box_size": [50, 90]}
    frames = [{"frame": i, **box, "keypoints": flat(p)}
              for i, p in enumerate(walk())]  # fmt: skip
    found = read_keypoints(write(tmp_path / "k.json", {**said, **size, "frames": frames}))
    assert found.image_size == SIZE
    assert np.diff(found.stamp_ns) == pytest.approx(1e9 / rate_hz, rel=1e-3)
    assert "assumed" not in caplog.text


@pytest.mark.parametrize("size", [{"resolution": [256, 192]}, {"input_size": [64, 48], "bbox": {"w": 60, "h": 90}}])
def test_the_size_of_something_else_is_not_that_of_the_picture(tmp_path, caplog, size):
    found = read_keypoints(write(tmp_path / "k.json", {**size, "f": [{"keypoints": flat(p)} for p in walk()]}))
    assert is_walk(found, walk())
    assert "in the middle of images" in caplog.text


@pytest.mark.parametrize("steps", [[1] * 19, [1, 1, 3, 1, 1, 6, 1] * 2 + [1, 4, 1, 1, 1]])
@pytest.mark.parametrize(("key", "factor"), [("timestamp", 1), ("timestamp_ms", 1e3), ("time", 1e9), ("time_us", 1e6)])
@pytest.mark.parametrize("numbered", [True, False])
def test_uneven_times_are_the_stamps(tmp_path, steps, key, factor, numbered):
    at = 1_700_000.0 + np.cumsum([0, *steps]) / 25
    nodes = [{**({"frame": i} if numbered else {}), key: factor * t, "keypoints": rows(p)}
             for i, (t, p) in enumerate(zip(at, walk(20), strict=True))]  # fmt: skip
    found = read_keypoints(write(tmp_path / "k.json", nodes), Stated(None, SIZE))
    assert found.stamp_ns * 1e-9 == pytest.approx(at - at[0], abs=1e-4)
    assert read_keypoints(tmp_path / "k.json", Stated(10.0, SIZE)).stamp_ns[-1] == pytest.approx(1.9e9)


def crossing(frames=60):
    """Two persons, of whom one goes by behind the other at half the size."""
    far = walk(frames) * [0.5, 0.5, 1.0] + [600, 150, 0]
    far[..., 0] -= (9.0 * np.arange(frames))[:, None]
    return walk(frames), far


@pytest.mark.parametrize(("near_ids", "far_ids"), [
    (lambda i: 1, lambda i: 2), (lambda i: 1 if i < 25 else 7, lambda i: 2), (lambda i: i // 4, lambda i: 100 + i // 9),
    (lambda i: 1 if i < 10 else 2, lambda i: 2 if i < 10 else 1), (lambda i: i, lambda i: 1000 + i),
    (lambda i: f"id_{i // 11}", lambda i: "other"),
])  # fmt: skip
@pytest.mark.parametrize("lost", [0, 1, 8])
def test_numbers_that_change_are_one_person(tmp_path, near_ids, far_ids, lost):
    k, far = crossing()
    nodes = [
             {"image_id": f"{i}.jpg", "track_id": ids(i), "keypoints": flat(p)} for i in range(len(k))
             for ids, p in ((near_ids, k[i]), (far_ids, far[i])) if ids is far_ids or not 25 <= i < 25 + lost
             ]  # fmt: skip
    path = write(tmp_path / "k.json", nodes)
    k[25 : 25 + lost] = 0.0
    found = [read_keypoints(path, Stated(15.0, SIZE, None, n)) for n in (1, 2)]
    assert any(is_walk(each, k) for each in found)
    assert any(is_walk(each, far) for each in found)


def test_persons_before_frames(tmp_path):
    k, far = crossing(30)
    people = {
        name: {str(i): {"keypoints": flat(p)} for i, p in enumerate(of)} for name, of in (("person_0", k), ("p", far))
    }
    found = read_keypoints(write(tmp_path / "k.json", {**people, "player 2": people.pop("p")}), Stated(15.0, SIZE))
    assert is_walk(found, k)
    nested = [
        {"player_1": {"keypoints": flat(p)}, "player_2": {"keypoints": flat(q)}} for p, q in zip(k, far, strict=True)
    ]
    assert is_walk(read_keypoints(write(tmp_path / "n.json", nested), Stated(15.0, SIZE, None, 2)), far)
    named = [{n: [*map(float, q)] for n, q in zip(JOINTS, p, strict=True)} for p in k]
    assert is_walk(read_keypoints(write(tmp_path / "d.json", named), Stated(15.0, SIZE)), k)


@pytest.mark.parametrize("axes", [
    lambda k, far: k.transpose(0, 2, 1), lambda k, far: k.reshape(len(k), -1), lambda k, far: np.stack([k, far]),
    lambda k, far: np.stack([k, far], axis=1), lambda k, far: k[:, None], lambda k, far: k[None],
])  # fmt: skip
@pytest.mark.parametrize("scores", [True, False])
def test_axes_of_arrays_are_told_by_their_lengths(tmp_path, axes, scores):
    k, far = crossing(40)
    array = axes(k if scores else k[..., :2], far if scores else far[..., :2])
    np.save(tmp_path / "k.npy", array)
    np.savez(tmp_path / "k.npz", keypoints=array, fps=15)
    for name in ("k.npy", "k.npz"):
        assert is_walk(read_keypoints(tmp_path / name, Stated(15.0, SIZE)), k)
    np.save(tmp_path / "one.npy", k[7])
    assert is_walk(read_keypoints(tmp_path / "one.npy", Stated(15.0, SIZE)), k[7:8])


@pytest.mark.parametrize(("visible", "score", "number"), [(True, False, False), (False, False, False),
                                                          (True, True, True), (True, False, True)])  # fmt: skip
def test_a_folder_of_yolo_s_labels_is_read(tmp_path, capsys, visible, score, number):
    k, far = crossing(20)
    folder = tmp_path / "labels"
    folder.mkdir()
    for i, both in enumerate(zip(k, far, strict=True)):
        lines = [
            [0, 0.5, 0.5, 0.2, 0.4, *(v for x, y, s in p for v in (x / 1280, y / 720, *[s] * visible)),
             *[0.87] * score, *[who + 1] * number]
            for who, p in enumerate(both)
        ]  # fmt: skip
        text(folder / f"walk_{i + 1}.txt", "\n".join(" ".join(f"{v:.6g}" for v in line) for line in lines))
    assert is_walk(read_keypoints(folder, Stated(15.0, SIZE)), k)
    assert main(["info", str(folder)]) == 2
    assert "--image-size WxH" in capsys.readouterr().err


def test_a_folder_of_json_may_hold_other_files(tmp_path):
    folder = tmp_path / "json"
    folder.mkdir()
    for i, p in enumerate(walk()):
        write(folder / f"v_{i:012d}_keypoints.json", {"people": [{"pose_keypoints_2d": flat(p)}]})
    for name in ("Thumbs.db", "rendered.avi", "readme.md"):
        (folder / name).write_bytes(b"x")
    assert is_keypoint_file(folder)
    assert is_walk(read_keypoints(folder, Stated(15.0, SIZE, "coco17")), walk())
    for i in range(12):
        (folder / f"{i}.jpg").write_bytes(b"x")
    assert not is_keypoint_file(folder)


@pytest.mark.parametrize("mark", ["\ufeff", ""])
@pytest.mark.parametrize("name", ["k.json", "k.jsonl"])
def test_a_byte_order_mark_costs_no_frame(tmp_path, mark, name):
    nodes = [json.dumps({"frame": i, "keypoints": flat(p)}) for i, p in enumerate(walk())]
    content = "\n".join(nodes) if name == "k.jsonl" else f"[{','.join(nodes)}]"
    assert is_walk(read_keypoints(text(tmp_path / name, mark + content), Stated(15.0, SIZE)), walk())


@pytest.mark.parametrize("named", [True, False])
def test_exchanged_axes_are_told(tmp_path, caplog, named):
    k = walk()
    names = {"keypoint_names": list(JOINTS)} if named else {}
    path = write(tmp_path / "k.json", {**names, "f": [{"keypoints": [[y, x, s] for x, y, s in p]} for p in k.tolist()]})
    if named:
        read_keypoints(path)
        assert "x and y exchanged make a body" in caplog.text
    else:
        with pytest.raises(InputError, match="x and y exchanged make a body"):
            read_keypoints(path)


def test_ids_of_many_persons_stay(tmp_path):
    """Five in a row, each with its number, in any order of the list."""
    people = [walk(20) * [0.4, 0.4, 1.0] + [240 * n - 240, 200, 0] for n in range(1, 6)]
    rng = np.random.default_rng(0)
    nodes = [{"frame": i, "idx": n, "keypoints": flat(people[n][i])}
             for i in range(20) for n in rng.permutation(5).tolist()]  # fmt: skip
    path = write(tmp_path / "k.json", nodes)
    found = [read_keypoints(path, Stated(15.0, SIZE, None, n)) for n in range(1, 6)]
    assert all(any(is_walk(each, person) for each in found) for person in people)


ANIMAL = ["L_Eye", "R_Eye", "Nose", "Neck", "Root_of_tail"]
ANIMAL += [f"{side}_{joint}" for side in "LR" for joint in ("Shoulder", "Elbow", "F_Paw", "Hip", "Knee", "B_Paw")]


@pytest.mark.parametrize("order", list(itertools.permutations(["person", "dog", "car"])))
@pytest.mark.parametrize("first", [True, False])
def test_a_person_is_told_from_an_animal_by_the_category(tmp_path, order, first):
    k, dog = crossing(20)
    joints = {"person": list(JOINTS), "dog": ANIMAL, "car": []}
    number = {name: i + 1 for i, name in enumerate(order)}
    people = [
        {"id": number[name], "image_id": i, "category_id": number[name], "keypoints": flat(p)}
        for i in range(len(k))
        for name, p in (("dog", dog[i]), ("person", k[i]))
    ]
    kinds = {"categories": [{"id": number[name], "name": name, "keypoints": joints[name]} for name in order]}
    of_images = [{"id": i, "width": 1280, "height": 720, "file_name": f"{i:05d}.jpg"} for i in range(len(k))]
    rest = {"images": of_images, "annotations": people}
    path = write(tmp_path / "coco.json", {**kinds, **rest} if first else {**rest, **kinds})
    assert is_walk(read_keypoints(path), k)


def posenet(p, j):
    x, y, score = p[j]
    return {"part": JOINTS[j], "position": {"x": x, "y": y}, "score": score}


def labelme(p, j):
    return {"label": JOINTS[j], "points": [p[j][:2]], "shape_type": "point", "group_id": 1}


def label_studio(p, j):
    value = {"x": p[j][0] / 12.8, "y": p[j][1] / 7.2, "width": 0.4, "keypointlabels": [JOINTS[j]]}
    return {"original_width": 1280, "original_height": 720, "type": "keypointlabels", "value": value}


def tfjs(p, j):
    return {"name": JOINTS[j], "x": p[j][0], "y": p[j][1], "score": p[j][2]}


@pytest.mark.parametrize(("key", "form", "box"), [
    ("keypoints", posenet, None), ("keypoints", tfjs, None),
    ("shapes", labelme, {"label": "person", "points": [[1, 2], [30, 40]], "shape_type": "rectangle"}),
    ("result", label_studio, {"original_width": 1280, "value": {"width": 9, "rectanglelabels": ["a"]}}),
])  # fmt: skip
@pytest.mark.parametrize("shuffled", [True, False])
@pytest.mark.parametrize("folder", [True, False])
def test_named_points_may_come_in_any_order_and_number(tmp_path, key, form, box, shuffled, folder):
    k = walk(20)
    k[0, 2:5] = k[7, 9:16] = k[13, :3] = 0.0
    rng, nodes = np.random.default_rng(0), []
    for p in k.tolist():
        order = rng.permutation(17).tolist() if shuffled else range(17)
        nodes.append({key: [form(p, j) for j in order if p[j][2]] + [box] * (box is not None)})
    (tmp_path / "json").mkdir()
    for i, node in enumerate(nodes):
        write(tmp_path / "json" / f"f_{i:04d}.json", {"imagePath": f"f_{i:04d}.jpg", **node})
    path = tmp_path / "json" if folder else write(tmp_path / "k.json", nodes)
    found = read_keypoints(path, Stated(15.0, SIZE))
    at = [found.joints.index(joint) for joint in JOINTS]
    seen = k[..., 2] > 0
    assert (np.isfinite(found.keypoints[:, at]).all(axis=2) == seen).all()
    assert np.abs(found.keypoints[:, at] - k[..., :2])[seen].max() < 0.01


@pytest.mark.parametrize("shuffled", [True, False])
def test_a_long_table_may_lack_joints(tmp_path, shuffled):
    k = walk(20)
    k[3, 9:14] = k[11, 0] = 0.0
    cells = [[i, n, *v] for i, p in enumerate(k) for n, v in zip(JOINTS, rows(p), strict=True) if v[2]]
    if shuffled:
        cells = [cells[i] for i in np.random.default_rng(0).permutation(len(cells))]
    head = ["frame", "landmark", "x", "y", "confidence"]
    found = read_keypoints(
        text(tmp_path / "k.csv", "\n".join(",".join(map(str, row)) for row in [head, *cells])), Stated(15.0, SIZE)
    )
    at = [found.joints.index(joint) for joint in JOINTS]
    seen = k[..., 2] > 0
    assert (np.isfinite(found.keypoints[:, at]).all(axis=2) == seen).all()
    assert np.abs(found.keypoints[:, at] - k[..., :2])[seen].max() < 0.01


@pytest.mark.parametrize("number", [float, int, str, lambda i: f"{i:.1f}", lambda i: f"C:\\walk\\f_{i:06d}.jpg"])
@pytest.mark.parametrize("shuffled", [True, False])
def test_numbers_of_frames_are_numbers_however_they_are_written(tmp_path, number, shuffled):
    k, at = walk(12), [*range(5, 11), *range(14, 20)]
    nodes = [{"frame": number(i), "keypoints": flat(p)} for i, p in zip(at, k, strict=True)]
    if shuffled:
        nodes = [nodes[i] for i in np.random.default_rng(0).permutation(12)]
    found = read_keypoints(write(tmp_path / "k.json", nodes), Stated(15.0, SIZE))
    assert len(found) == 15
    assert np.isnan(found.keypoints[6:9]).all()
    assert np.abs(found.keypoints[[i - 5 for i in at]] - k[..., :2]).max() < 0.01


@pytest.mark.parametrize("order", ["mediapipe33", "coco17", "openpose25", "smpl24", "halpe26", "mpii16", "coco21"])
@pytest.mark.parametrize("scores", [True, False])
@pytest.mark.parametrize("form", ["json", "npy"])
def test_flat_numbers_are_pairs_or_have_scores(tmp_path, order, scores, form):
    """66 numbers are 33 points, or 22 with their scores."""
    xy = in_order(views(seconds=1.0)[2], order, np.random.default_rng(0))
    values = np.concatenate([xy, np.full((*xy.shape[:2], 1), 0.8)], axis=2) if scores else xy
    if form == "json":
        path = write(tmp_path / "k.json", [{"keypoints": row} for row in values.reshape(len(xy), -1).tolist()])
    else:
        path = tmp_path / "k.npy"
        np.save(path, values.reshape(len(xy), -1))
    found = read_keypoints(path, Stated(30.0, SIZE, order))
    assert np.abs(found.keypoints - xy[:, : found.keypoints.shape[1]]).max() < 0.01


@pytest.mark.parametrize("first", [True, False])
@pytest.mark.parametrize("names", [("pose", "left_hand", "right_hand", "face"), ("body", "lh", "rh", "mesh")])
def test_a_body_is_told_from_hands_and_a_face(tmp_path, first, names):
    xy = in_order(views(seconds=1.0)[2], "mediapipe33", np.random.default_rng(0))
    rng, nodes = np.random.default_rng(1), []
    for i, p in enumerate(xy):
        parts = [
            p,
            p[15] + rng.normal(0, 5, (21, 2)),
            p[16] + rng.normal(0, 5, (21, 2)),
            p[0] + rng.normal(0, 5, (468, 2)),
        ]
        parts = {name: part.tolist() for name, part in zip(names, parts, strict=True) if i % 5 or name != names[1]}
        nodes.append(parts if first else dict(reversed(parts.items())))
    found = read_keypoints(write(tmp_path / "k.json", nodes), Stated(30.0, SIZE))
    assert np.abs(found.keypoints - xy[:, : found.keypoints.shape[1]]).max() < 0.01


def test_a_long_file_of_ever_new_numbers_is_compared_with_those_of_its_time_alone(monkeypatch):
    rng, count = np.random.default_rng(0), []
    step = frames._step
    monkeypatch.setattr(frames, "_step", lambda old, new: (count.append(0), step(old, new))[1])
    places = rng.uniform(0, 2000, (300, 1, 4))
    people = [(f, f // 5, places[f // 5] + rng.normal(0, 20, (17, 4))) for f in range(1500)]
    assert len(frames.followed(people)) == len(people)
    assert len(count) < 12 * len(people)  # of 300 persons
