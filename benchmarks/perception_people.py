"""Perception of several persons: joints that go to another in rendered scenes, and what company costs a motion.

    python benchmarks/perception_people.py              page perception_people of docs/figures
    python benchmarks/perception_people.py --only NAME  scenes whose name begins so; writes no page

Three people walk, cross and hug before one drone; the networks are those of ../shared, on images of 1280x720.  A frame
of a person is wrong if one of its keypoints lies on a joint of another, of either side: within 6 % of the body's length
of it, and more than 10 % from the own.  PA: reconstruction error with the camera's true path, of those who hug also of
each alone in the same scene.
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
import time
from collections.abc import Sequence

import cv2
import numpy as np
from figures import ROOT, table, write_figures

sys.path[:0] = [str(ROOT / "test" / "helpers")]

from people_scenes import SCENES, PeopleScene, camera_of, images_of, of_another, people_of  # noqa: E402

from drocap_ros.evaluation.metrics import pa_mpjpe  # noqa: E402
from drocap_ros.perception.people import PeopleEstimator, observe_people  # noqa: E402
from drocap_ros.perception.tracking.pose_estimator_config import PoseEstimatorConfig  # noqa: E402
from drocap_ros.reconstruction.people import reconstruct_people  # noqa: E402
from drocap_ros.tracks import Tracks  # noqa: E402

MODELS = ROOT.parent / "shared" / "models"


def tracked(scene: PeopleScene, people: Sequence[np.ndarray], who: Sequence[int]) -> dict[int, Tracks]:
    """Tracks of some of the people, by their index, with the true camera."""
    camera = camera_of(scene)
    found = observe_people(images_of(scene, people, who), PeopleEstimator(MODELS, PoseEstimatorConfig()))
    truth = {k: camera.pixels(people[k]) for k in who}
    by_index: dict[int, Tracks] = {}
    for tracks in sorted(found.values(), key=lambda t: np.isnan(t.keypoints).sum()):
        off = {k: np.nanmedian(np.linalg.norm(tracks.keypoints[:, :15] - px, axis=2)) for k, px in truth.items()}
        given = dataclasses.replace(
            tracks, camera_rotation=camera.rotation, camera_position=camera.position, camera_matrix=camera.matrix
        )
        by_index.setdefault(min(off, key=lambda k: float(off[k])), dataclasses.replace(given, background=None))
    return by_index


def errors_mm(scene: PeopleScene, people: Sequence[np.ndarray], tracks: dict[int, Tracks]) -> dict[int, np.ndarray]:
    """Reconstruction error (F,) mm of each person over the scene, NaN outside of its motion."""
    found = {}
    for k, motion in reconstruct_people(tracks).items():
        rows = np.searchsorted(tracks[k].stamp_ns, motion.stamp_ns)
        found[k] = np.full(len(scene.times), np.nan)
        found[k][rows] = 1e3 * pa_mpjpe(motion.joints3d[:, :15], people[k][rows])
    return found


def measure(scene: PeopleScene, alone: bool) -> list[list[object]]:
    """A row per person."""
    people, camera = people_of(scene), camera_of(scene)
    begin = time.process_time()
    tracks = tracked(scene, people, (0, 1, 2))
    spent_ms = 1e3 * (time.process_time() - begin) / len(scene.times)
    truth = [camera.pixels(person) for person in people]
    error = errors_mm(scene, people, tracks)
    rows: list[list[object]] = []
    for k in sorted(tracks):
        keypoints = tracks[k].keypoints[:, :15]
        wrong = int(of_another(keypoints, truth, k).any(axis=1).sum())
        seen = float(np.isfinite(keypoints).all(axis=2).any(axis=1).mean())
        ratio = "-"
        if alone:
            own = errors_mm(scene, people, tracked(scene, people, (k,)))[k]
            both = np.isfinite(own) & np.isfinite(error[k])
            ratio = f"{error[k][both].mean() / own[both].mean():.2f}"
        row = [scene.name, scene.seed, k, f"{seen:.0%}", wrong, len(scene.times), f"{np.nanmean(error[k]):.0f}", ratio]
        rows.append([*row, f"{spent_ms:.0f}"])
        print("  ".join(str(cell) for cell in rows[-1]), flush=True)
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", metavar="NAME", default="", help="scenes whose name begins so")
    options = parser.parse_args()
    if not MODELS.is_dir():
        print("perception: no ../shared beside the checkout, nothing to measure")
        return
    cv2.setNumThreads(1)
    rows: list[list[object]] = []
    for scene in (s for s in SCENES if s.name.startswith(options.only)):
        rows += measure(scene, alone=scene.name == "hug")
    names = dict.fromkeys(str(row[0]) for row in rows)
    counts = {name: [(int(str(r[4])), int(str(r[5]))) for r in rows if r[0] == name] for name in names}
    totals = [[name, f"{sum(w for w, _ in c) / sum(n for _, n in c):.1%}"] for name, c in counts.items()]
    head = ["scene", "seed", "person", "seen", "wrong frames", "of", "PA, mm", "over alone", "CPU, ms an image"]
    text = table(["scenes", "frames with a joint of another"], totals) + "\n" + table(head, rows)
    if not options.only:
        write_figures("perception_people", "Everybody in the picture: whose joints are these", text)


if __name__ == "__main__":
    main()
