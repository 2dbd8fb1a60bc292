"""2D keypoints of other tools: one person's walk in every form gives the same tracks."""

import json
import random

import numpy as np
import pytest
from telemetry_logs import mutated

from drocap_ros.cli import main
from drocap_ros.errors import InputError
from drocap_ros.recording.keypoints.files import Stated, read_keypoints
from drocap_ros.skeleton import COCO_17
from drocap_ros.tracks import load_tracks

SIZE = (1280, 720)
#: Places about the hips, px, of COCO's points: a person who faces the camera.
BODY = np.array(
    [(0, -90), (4, -94), (-4, -94), (9, -90), (-9, -90), (22, -60), (-22, -60), (30, -25), (-30, -25),
     (32, 5), (-32, 5), (12, 0), (-12, 0), (13, 45), (-13, 45), (13, 90), (-13, 90)]
)  # fmt: skip


def walk(frames=12):
    """(F, 17, 3) x, y px and score."""
    at = np.stack([600 + 4.0 * np.arange(frames), 350 + np.zeros(frames)], axis=1)
    swing = np.sin(0.4 * np.arange(frames))[:, None, None] * np.where(np.arange(17) % 2, 6, -6)[:, None] * [1.0, 0.0]
    xy = np.round(at[:, None] + BODY + swing, 2)
    return np.concatenate([xy, np.full((frames, 17, 1), 0.9)], axis=2)


def rows(points):
    return [[round(float(v), 3) for v in p] for p in points]


def flat(points):
    return [v for p in rows(points) for v in p]


def alphapose(folder, k, far):
    entries = [{"image_id": f"{i}.jpg", "category_id": 1, "keypoints": flat(p), "score": 2.0, "idx": [w]}
               for i, both in enumerate(zip(k, far, strict=True)) for w, p in enumerate(both)]  # fmt: skip
    # The second person is missing in the first frames.
    return write(folder / "alphapose-results.json", entries[:1] + entries[2:3] + entries[4:])


def cmu_form(folder, k, far):
    return write(folder / "pose.json", {f"{i}.jpg": {"version": "AlphaPose", "bodies": [{"joints": flat(p)}]}
                                        for i, p in enumerate(k)})  # fmt: skip


def openpose(folder, k, far):
    (folder / "json").mkdir()
    for i, (one, other) in enumerate(zip(k, far, strict=True)):
        people = [{"person_id": [-1], "pose_keypoints_2d": flat(p), "face_keypoints_2d": []} for p in (other, one)]
        write(folder / "json" / f"walk_{i:012d}_keypoints.json", {"version": 1.3, "people": people})
    return folder / "json"


def mmpose(folder, k, far):
    people = [[{"keypoints": rows(p[:, :2]), "keypoint_scores": p[:, 2].tolist(), "bbox": [[0, 0, 9, 9]]} for p in both]
              for both in zip(k, far, strict=True)]  # fmt: skip
    names = {str(i): name for i, name in enumerate(COCO_17.joints)}
    frames = [{"frame_id": 10 * (i + 1), "instances": each} for i, each in enumerate(people)]
    return write(folder / "results.json", {"meta_info": {"keypoint_id2name": names}, "instance_info": frames})


def coco(folder, k, far):
    points = np.where(k[..., 2:] > 0, [1, 1, 2], 1) * np.concatenate([k[..., :2], np.ones((*k.shape[:2], 1))], axis=2)
    return write(folder / "coco.json", {
        "images": [{"id": i, "width": 1280, "height": 720, "file_name": f"{i:05d}.jpg"} for i in range(len(k))],
        "annotations": [{"id": 7 + i, "image_id": i, "keypoints": flat(p)} for i, p in enumerate(points)],
        "categories": [{"id": 1, "keypoints": list(COCO_17.joints)}],
    })  # fmt: skip


def named_points(folder, k, far):
    return write(folder / "tfjs.json", [
        [{"keypoints": [{"name": n, "x": x, "y": y, "score": s}
                        for n, (x, y, s) in zip(COCO_17.joints, p, strict=True)]}]
        for p in k.tolist()
    ])  # fmt: skip


def columns(folder, k, far):
    return write(folder / "ultralytics.json", [
        [{"name": "person", "box": {"x1": 0, "y1": 0}, "keypoints": dict(zip(("x", "y", "visible"), p.T.tolist(),
          strict=True))}]
        for p in k
    ])  # fmt: skip


def deeplabcut(folder, k, far):
    names = ["_".join(reversed(n.split("_", 1))).title() if "_" in n else n for n in COCO_17.joints]  # Shoulder_Left
    head = [["scorer"] + ["net"] * 51, ["bodyparts"] + [n for n in names for _ in range(3)],
            ["coords"] + ["x", "y", "likelihood"] * 17]  # fmt: skip
    body = [[i, *flat(p)] for i, p in enumerate(k)]
    return text(folder / "walkDLC.csv", "\n".join(",".join(map(str, row)) for row in head + body))


def several_animals(folder, k, far):
    both = np.concatenate([k, far], axis=1)
    head = [["scorer"] + ["net"] * 102, ["individuals"] + ["one"] * 51 + ["two"] * 51,
            ["bodyparts"] + [n for n in COCO_17.joints * 2 for _ in range(3)],
            ["coords"] + ["x", "y", "likelihood"] * 34]  # fmt: skip
    body = [[i, *flat(p)] for i, p in enumerate(both)]
    return text(folder / "walk_el.csv", "\n".join(";".join(map(str, row)) for row in head + body))


def sleap(folder, k, far):
    head = ["track", "frame_idx", "instance.score"] + [f"{n}.{a}" for n in COCO_17.joints for a in ("x", "y", "score")]
    body = [[f"track_{w}", i, 0.9, *flat(p)] for i, both in enumerate(zip(k, far, strict=True))
            for w, p in enumerate(both) if w == 0 or i > 2]  # fmt: skip
    return text(folder / "sleap.csv", "\n".join(",".join(map(str, row)) for row in [head, *body]))


def wide_table(folder, k, far):
    head = ["frame"] + [f"{n}_{a}" for n in COCO_17.joints for a in ("x", "y", "z", "visibility")]
    body = [[i, *(v for x, y, s in rows(p) for v in (x, y, -0.1, s))] for i, p in enumerate(k)]
    return text(folder / "wide.csv", "\n".join(";".join(map(str, row)) for row in [head, *body]))


def numbered_table(folder, k, far):
    head = [f"{a}{n}" for n in range(17) for a in ("x", "y")]
    return text(folder / "n.csv", "\n".join(",".join(map(str, row)) for row in [head, *(flat(p[:, :2]) for p in k)]))


def long_table(folder, k, far):
    body = [[i, n, *v] for i, p in enumerate(k) for n, v in zip(COCO_17.joints, rows(p), strict=True)]
    return text(folder / "long.tsv", "\n".join("\t".join(map(str, row)) for row in
                                               [["frame", "landmark", "x", "y", "confidence"], *body]))  # fmt: skip


def unordered_ids(folder, k, far):
    """COCO whose numbers of pictures are not in the order of time."""
    numbers = np.random.default_rng(3).permutation(len(k)).tolist()
    return write(folder / "cvat.json", {
        "images": [{"id": n, "width": 1280, "height": 720, "file_name": f"walk_{i:06d}.jpg"}
                   for n, i in sorted((n, i) for i, n in enumerate(numbers))],
        "annotations": [{"id": n, "image_id": n, "keypoints": flat(p)} for n, p in zip(numbers, k, strict=True)],
    })  # fmt: skip


def with_scores(folder, k, far):
    np.savez(folder / "a.npz", keypoints=k, joints=COCO_17.joints, stamp_ns=np.arange(len(k)) * 10**9, image_size=SIZE)
    return folder / "a.npz"


def rate_only(folder, k, far):
    np.savez(folder / "b.npz", keypoints=k[..., :2], scores=k[..., 2], joints=COCO_17.joints, fps=15, image_size=SIZE)
    return folder / "b.npz"


def bare_array(folder, k, far):
    np.save(folder / "c.npy", k)
    return folder / "c.npy"


def write(path, data):
    return text(path, json.dumps(data))


def text(path, content):
    path.write_text(content)
    return path


FORMS = [alphapose, cmu_form, openpose, mmpose, coco, named_points, columns, deeplabcut, several_animals,
         sleap, wide_table, numbered_table, long_table, unordered_ids, with_scores, rate_only, bare_array]  # fmt: skip


@pytest.mark.parametrize("form", FORMS)
def test_every_form_gives_the_same_tracks(tmp_path, form):
    k = walk()
    k[3, 9] = 0.0  # not seen, as COCO, OpenPose and AlphaPose write it
    far = walk() * [0.3, 0.3, 1.0] + [100, 100, 0]
    found = read_keypoints(form(tmp_path, k, far), Stated(15.0, SIZE))
    assert found.joints == COCO_17.joints
    assert np.isnan(found.keypoints[3, 9]).all()
    seen = k[..., 2] > 0
    assert np.abs(found.keypoints - k[..., :2])[seen].max() < 0.01
    assert np.isfinite(found.keypoints).all(axis=2).sum() == seen.sum()
    step_s = np.diff(found.stamp_ns) * 1e-9
    assert step_s == pytest.approx(10 / 15 if form is mmpose else 1 / 15, rel=1e-6)
    assert found.image_size == SIZE
    assert found.real_lens == (form not in (with_scores, rate_only, bare_array))


@pytest.mark.parametrize("form", [alphapose, openpose, deeplabcut, bare_array])
def test_reconstruct_and_info_read_other_tools_files(tmp_path, capsys, form):
    path = form(tmp_path, walk(), walk() * 0.5)
    assert main(["info", str(path)]) == 0
    assert "frames: 12" in capsys.readouterr().out
    options = ["--rate", "15", "--image-size", "1280x720", "--method", "initial", "--no-report", "--quiet"]
    assert main(["reconstruct", str(path), "--out", str(tmp_path / "out"), *options]) == 0
    assert "assumed" not in capsys.readouterr().err
    assert load_tracks(tmp_path / "out" / "tracks.npz").stamp_ns[-1] == pytest.approx(11e9 / 15, abs=2)
    assert main(["reconstruct", str(path), "--image-size", "1280"]) == 2


def test_what_a_file_does_not_say_is_assumed_aloud(tmp_path, caplog):
    found = read_keypoints(alphapose(tmp_path, walk(), walk()))
    assert "assumed: 30 images per second" in caplog.text
    assert (found.keypoints <= found.image_size).all()
    assert not found.real_lens


def test_frames_without_a_person_stay_frames(tmp_path):
    folder = openpose(tmp_path, walk(), walk())
    write(folder / "walk_000000000004_keypoints.json", {"people": []})
    found = read_keypoints(folder, Stated(15.0, SIZE))
    assert np.isnan(found.keypoints[4]).all()
    assert len(found) == 12


def test_shares_of_the_picture_need_its_size(tmp_path):
    k = walk() / [*SIZE, 1.0]
    np.save(tmp_path / "n.npy", k)
    with pytest.raises(InputError, match="--image-size"):
        read_keypoints(tmp_path / "n.npy")
    assert read_keypoints(tmp_path / "n.npy", Stated(15.0, SIZE)).keypoints == pytest.approx(walk()[..., :2])


def test_zeros_and_places_outside_the_picture_are_not_seen(tmp_path, caplog):
    k = walk()[..., :2]
    k[2, 5], k[3, 6], k[4, 7], k[5, 8] = (0, 0), (-1, -1), (5000, 300), (1300, 300)
    arrays = {"joints": COCO_17.joints, "stamp_ns": np.arange(12) * 10**8, "image_size": SIZE}
    np.savez(tmp_path / "t.npz", keypoints=k, **arrays)
    found = load_tracks(tmp_path / "t.npz").keypoints
    assert np.argwhere(np.isnan(found[..., 0])).tolist() == [[2, 5], [3, 6], [4, 7]]
    assert "3 keypoints" in caplog.text


def test_arrays_of_objects_are_refused(tmp_path):
    np.savez(tmp_path / "h.npz", positions_2d={"walk.mp4": {"custom": [walk()]}})
    with pytest.raises(InputError, match="of VideoPose3D one video"):
        read_keypoints(tmp_path / "h.npz")


@pytest.mark.parametrize("name", ["a.json", "a.npz", "a.npy", "a.csv", "a.pkl", "a.h5"])
@pytest.mark.parametrize("content", [b"", b"{}", b"[[[[", b"[" * 100_000, b'{"people": [{"keypoints": ["a", {}]}]}',
                                     b"scorer,a\nbodyparts,b\ncoords,x\n0,1e999\n", bytes(500)])  # fmt: skip
def test_files_without_a_person_are_refused_in_one_line(tmp_path, capsys, name, content):
    (tmp_path / name).write_bytes(content)
    assert main(["info", str(tmp_path / name)]) == 2
    assert capsys.readouterr().err.count("\n") == 1


def json_lines(folder, k, far):
    return text(
        folder / "lines.jsonl", "\n".join(json.dumps({"frame": i, "keypoints": rows(p)}) for i, p in enumerate(k))
    )


@pytest.mark.parametrize("share", [0.4, 0.6, 0.9])
@pytest.mark.parametrize("form", [alphapose, cmu_form, mmpose, named_points, json_lines])
def test_a_file_that_is_cut_off_gives_what_is_whole(tmp_path, form, share, caplog):
    path = form(tmp_path, walk(30), walk(30) * 0.5)
    whole = read_keypoints(path)
    assert "damaged" not in caplog.text
    data = path.read_bytes()
    path.write_bytes(data[: int(share * len(data))])
    cut = read_keypoints(path)
    assert 0.5 * share * 30 < len(cut) < 30
    assert np.allclose(cut.keypoints, whole.keypoints[: len(cut)], equal_nan=True)
    assert "damaged in 1 places" in caplog.text


@pytest.mark.parametrize(("key", "factor"), [
    ("timestamp_ms", 1e3), ("timestamp", 1), ("time", 1e3), ("time_s", 1), ("timestamp", 1e6), ("timestamp", 1e9),
    ("timestamp_us", 1e6),
])  # fmt: skip
@pytest.mark.parametrize("rate_hz", [12.5, 29.97, 120.0])
def test_times_of_frames_are_the_rate(tmp_path, key, factor, rate_hz, caplog):
    at = [1_700_000.0 + i / rate_hz for i in range(20)]
    k = walk(20)
    nodes = [{"frame": 10 + i, key: factor * t, "keypoints": rows(k[i])} for i, t in enumerate(at)]
    found = read_keypoints(write(tmp_path / "k.json", nodes))
    assert np.median(np.diff(found.stamp_ns)) == pytest.approx(1e9 / rate_hz, rel=1e-3)
    assert "images per second" not in caplog.text
    head = ["frame", key] + [f"{n}_{a}" for n in COCO_17.joints for a in ("x", "y")]
    body = [[i, factor * t, *flat(k[i, :, :2])] for i, t in enumerate(at)]
    found = read_keypoints(text(tmp_path / "k.csv", "\n".join(",".join(map(str, row)) for row in [head, *body])))
    assert np.median(np.diff(found.stamp_ns)) == pytest.approx(1e9 / rate_hz, rel=1e-3)


@pytest.mark.parametrize("form", [alphapose, several_animals, sleap])
def test_another_person_of_a_file_is_chosen_by_number(tmp_path, form, caplog):
    k, far = walk(), walk() * [0.3, 0.3, 1.0] + [100, 100, 0]
    path = form(tmp_path, k, far)
    first, second = (read_keypoints(path, Stated(15.0, SIZE, None, n)) for n in (None, 2))
    assert "--subject N is another" in caplog.text
    assert np.nanmedian(first.keypoints[5]) != np.nanmedian(second.keypoints[5])
    assert np.allclose(second.keypoints[-1], far[-1, :, :2], atol=0.01)
    with pytest.raises(InputError, match="--subject 3: expected a person of the file, 1 to 2"):
        read_keypoints(path, Stated(15.0, SIZE, None, 3))
    words = ["--subject", "2", "--image-size", "1280x720", "--rate", "15", "--method", "initial", "--no-report"]
    assert main(["reconstruct", str(path), "--out", str(tmp_path / "out"), *words]) == 0
    assert np.nanmax(load_tracks(tmp_path / "out" / "tracks.npz").keypoints) < 400


@pytest.mark.parametrize("names", ["{}/{:06d}.jpg", "{}_{:04d}.png", "take{}-{}"])
def test_one_of_several_recordings_in_a_file_is_named(tmp_path, names, caplog):
    takes = (("1", walk(8)), ("2", walk(12) + np.array([50, 0, 0])))
    nodes = [{"image_id": names.format(of, i), "keypoints": flat(p)} for of, k in takes for i, p in enumerate(k)]
    found = read_keypoints(write(tmp_path / "k.json", nodes))
    assert len(found) == 12
    assert np.allclose(found.keypoints, walk(12)[..., :2] + [50, 0], atol=0.01)
    assert "several recordings" in caplog.text
    dated = [{"image_id": f"2024-05-01_10-00-{i // 6:02d}_{i % 6}.jpg", "keypoints": flat(p)}
             for i, p in enumerate(walk(18))]  # fmt: skip
    assert len(read_keypoints(write(tmp_path / "d.json", dated))) == 18


def test_a_head_above_the_picture_is_no_middle(tmp_path):
    k = walk()
    k[..., 1] -= 290  # of an ordinary person, whose head is cut off
    np.save(tmp_path / "k.npy", k)
    assert len(read_keypoints(tmp_path / "k.npy", Stated(15.0, SIZE))) == 12


def test_damaged_frames_are_gaps(tmp_path, caplog):
    folder = openpose(tmp_path, walk(20), walk(20) * 0.5)
    for i in (3, 9):
        (folder / f"walk_{i:012d}_keypoints.json").write_text('{"people": [{"pose_keyp')
    (folder / "._walk_000000000001_keypoints.json").write_bytes(bytes(90))
    found = read_keypoints(folder)
    assert len(found) == 20
    assert np.flatnonzero(np.isnan(found.keypoints).all(axis=(1, 2))).tolist() == [3, 9]
    path = json_lines(tmp_path, walk(20), None)
    lines = path.read_text().splitlines()
    lines[5] = lines[5][:40]
    path.write_text("\n".join(lines))
    found = read_keypoints(path)
    assert len(found) == 20
    assert np.isnan(found.keypoints[5]).all()
    assert np.isfinite(found.keypoints[6:]).all()


def test_damaged_files_give_tracks_or_one_clear_line(tmp_path):
    rng, k = random.Random(5), walk(4)
    whole = [form(tmp_path, k, k) for form in (alphapose, mmpose, coco, named_points, deeplabcut, with_scores)]
    words = [b"NaN", b"1e999", b"-7", b"null", b'"x"', b"[]", b"{}", b"10000000000000000000000"]
    for path in whole:
        data = path.read_bytes()
        for i in range(25):
            damaged = mutated(data, rng) if i % 2 else swapped(data, words, rng)
            path.write_bytes(damaged)
            seen, refusal = attempt(path)
            assert seen or refusal
            assert "\n" not in refusal


def attempt(path):
    try:
        return np.isfinite(read_keypoints(path).keypoints).any(), ""
    except InputError as error:
        return False, str(error)


def swapped(data, words, rng):
    """Some of the numbers in a text are other words."""
    parts = data.split(b",")
    for _ in range(rng.randrange(1, 5)):
        parts[rng.randrange(len(parts))] = rng.choice(words)
    return b",".join(parts)


def test_a_last_number_below_zero_is_a_depth_and_no_score(tmp_path):
    points = walk()
    depths = np.concatenate([points[..., :2], np.linspace(-0.4, 0.6, 17)[:, None].repeat(12, 1).T[..., None]], axis=2)
    folder = [{"frame": i, "keypoints": rows(frame)} for i, frame in enumerate(depths)]
    tracks = read_keypoints(write(tmp_path / "pose.json", folder))
    assert np.isfinite(tracks.keypoints).all()
    assert (tracks.confidence == 1.0).all()
