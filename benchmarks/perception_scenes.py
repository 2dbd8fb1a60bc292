"""Perception: share of the images on the right person in rendered scenes that are hard for a tracker.

    python benchmarks/perception_scenes.py              page perception_scenes of docs/figures
    python benchmarks/perception_scenes.py --only NAME  scenes whose name begins so; writes no page

The networks are those of ../shared, on rendered images at 10 Hz of 1280x720; the subject is the person nearest the
centre of the first image.  An image counts as right if box and keypoints are the subject's; counted are those with the
subject in view.
"""

from __future__ import annotations

import argparse
import sys
import time

import cv2
import numpy as np
from figures import ROOT, table, write_figures

sys.path[:0] = [str(ROOT / "test" / "helpers")]

from field_scenes import SCENES, FieldScene, field_images, on_subject  # noqa: E402

from drocap_ros.perception.estimator import PoseEstimator  # noqa: E402
from drocap_ros.perception.tracking.pose_estimator_config import PoseEstimatorConfig  # noqa: E402

MODELS = ROOT.parent / "shared" / "models"


def measure(scene: FieldScene) -> tuple[int, int, int, float]:
    """Images with the subject in view, those on it, those without any subject, CPU ms per image."""
    estimator = PoseEstimator(MODELS, PoseEstimatorConfig(subject="centre", on_loss="next"))
    in_view = right = nobody = images = 0
    spent = 0.0
    for image in field_images(scene):
        begin = time.process_time()
        observation = estimator.process(image.image, image.stamp_ns)
        spent += time.process_time() - begin
        images += 1
        if image.in_view:
            in_view += 1
            right += on_subject(observation, image)
            nobody += not observation.has_subject
    return in_view, right, nobody, 1e3 * spent / images


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", metavar="NAME", default="", help="scenes whose name begins so")
    options = parser.parse_args()
    if not MODELS.is_dir():
        print("perception: no ../shared beside the checkout, nothing to measure")
        return
    cv2.setNumThreads(1)
    rows: list[list[object]] = []
    counts: dict[str, list[tuple[int, int]]] = {}
    for scene in (s for s in SCENES if s.name.startswith(options.only)):
        in_view, right, nobody, ms = measure(scene)
        counts.setdefault(scene.name, []).append((in_view, right))
        rows.append([scene.name, scene.seed, f"{scene.elevation_deg:.0f}", in_view, f"{right / in_view:.1%}", nobody])
        print("  ".join(str(cell) for cell in rows[-1]), f" {ms:.0f} ms", flush=True)
    totals = [[name, f"{np.sum([r for _, r in c]) / np.sum([v for v, _ in c]):.1%}"] for name, c in counts.items()]
    head = ["scene", "seed", "camera above, degrees", "images in view", "on the right person", "nobody followed"]
    text = table(["scenes", "on the right person"], totals) + "\n" + table(head, rows)
    if not options.only:
        write_figures("perception_scenes", "Subject tracking in hard rendered scenes", text)


if __name__ == "__main__":
    main()
