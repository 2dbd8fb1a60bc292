"""Perception: speed of each part, accuracy and uncertainty on the labelled recordings.

    python benchmarks/perception.py            page perception of docs/figures, plots in benchmarks/results
    python benchmarks/perception.py --fit      also fit the calibration and print its constants
    python benchmarks/perception.py --quick    fewer repetitions

Recordings and weights are those of ../shared; without them the benchmark reports that and ends.
Times are CPU and wall time of this process on one thread; other processes disturb CPU time less.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from figures import ROOT, table, write_figures

from drocap_ros.perception.detection.detector import Detector
from drocap_ros.perception.estimator import PoseEstimator
from drocap_ros.perception.load_models import load_detector, load_pose_model
from drocap_ros.perception.models.runtime import network_files, open_model
from drocap_ros.perception.models.spec import read_spec
from drocap_ros.perception.pose.body_pose import CALIBRATIONS, Calibration, calibrate
from drocap_ros.perception.pose.pose_model import NetworkKeypoints, PoseModel
from drocap_ros.perception.sources import open_source
from drocap_ros.perception.sources.image_files import read_image
from drocap_ros.perception.track_video import observe, subjects
from drocap_ros.perception.tracking.pose_estimator_config import PoseEstimatorConfig
from drocap_ros.skeleton import COCO_17

SHARED = ROOT.parent / "shared"
MODELS, MEDIA = SHARED / "models", SHARED / "media"
RESULTS = ROOT / "benchmarks" / "results"

LIMBS = slice(5, 17)
BLAZEPOSE_AS_COCO = [0, 2, 5, 7, 8, 11, 12, 13, 14, 15, 16, 23, 24, 25, 26, 27, 28]
COCO_SIGMAS = np.array([26, 25, 25, 35, 35, 79, 79, 72, 72, 62, 62, 107, 107, 87, 87, 89, 89]) / 1000
GROSS = 0.1


class Case(NamedTuple):
    """One labelled person: recording, kind of degradation, keypoints, labels (17, 2) px."""

    source: str
    kind: str
    keypoints: NetworkKeypoints
    truth: np.ndarray

    @property
    def errors(self) -> np.ndarray:
        """(12, 2) limb joints' errors as shares of the box."""
        return (self.keypoints.xy - self.truth)[LIMBS] / self.keypoints.box_size


def timed(work: Callable[[], object], repetitions: int) -> tuple[float, float]:
    """Median CPU and wall milliseconds."""
    cpu, wall = [], []
    for _ in range(repetitions):
        c, w = time.process_time(), time.perf_counter()
        work()
        cpu.append(time.process_time() - c)
        wall.append(time.perf_counter() - w)
    return 1e3 * float(np.median(cpu)), 1e3 * float(np.median(wall))


def speed(repetitions: int) -> str:
    """Median times of each part, as Markdown."""
    rows = []

    def row(name: str, work: Callable[[], object], count: int = repetitions) -> None:
        work()
        rows.append([name, *(f"{value:.1f}" for value in timed(work, count))])
        print("  ".join(rows[-1]), flush=True)

    image = read_image(MEDIA / "skier.jpg")
    box = np.array([280.0, 44, 500, 392])
    for path in network_files(MODELS):
        model = open_model(path)
        spec = read_spec(model)
        width, height = spec.input_size
        shape = (1, height, width, 3) if spec.channels_last else (1, 3, height, width)
        tensor = np.zeros(shape, np.float32)
        row(f"{path.name}: the network alone", lambda m=model, t=tensor: m(t))
        if spec.task == "pose":
            pose = PoseModel(model, spec)
            row(f"{path.name}: crop, network, decoding", lambda p=pose: p.estimate(image, box))
        else:
            detector = Detector(model, spec)
            row(f"{path.name}: letterbox, network, decoding", lambda d=detector: d.detect(image))
    video = MEDIA / "outdoor_walk.mp4"
    with open_source(video) as source:
        row("decoding one image of outdoor_walk.mp4 (1768x994)", source.read, min(repetitions, 60))
    for name, changes in (("detection in every image", {"detect_every_s": 0.0}), ("as configured", {})):
        rows += [steady(name, PoseEstimatorConfig(**changes), path, 95) for path in (video, MEDIA / "pose_1.mp4")]
    begin, cpu = time.perf_counter(), time.process_time()
    with open_source(video) as source:
        frames = len(observe(source, PoseEstimator(MODELS, PoseEstimatorConfig(on_loss="next"))))
    wall = time.perf_counter() - begin
    track = (
        f"`drocap track outdoor_walk.mp4`, loading of the models included: {frames / wall:.1f} images/s"
        f" ({wall:.1f} s, CPU {time.process_time() - cpu:.1f} s, {frames} images).\n"
    )
    return "## Speed, one thread\n\n" + table(["what (median)", "CPU, ms", "wall, ms"], rows) + "\n" + track


def steady(name: str, config: PoseEstimatorConfig, video: Path, count: int) -> list[str]:
    """Mean CPU and wall time of detection and pose in steady tracking, decoding left out; a row of the table."""
    estimator = PoseEstimator(MODELS, config)
    cpu, wall = [], []
    with open_source(video) as source:
        for i, frame in enumerate(source):
            if i == count:
                break
            c, w = time.process_time(), time.perf_counter()
            estimator.process(frame.image, frame.stamp_ns)
            if i >= 10:
                cpu.append(time.process_time() - c)
                wall.append(time.perf_counter() - w)
    return [f"detection + pose, {video.name}, {name} (mean)", *(f"{1e3 * np.mean(t):.1f}" for t in (cpu, wall))]


def labelled() -> Iterator[tuple[str, int, np.ndarray, np.ndarray]]:
    """(recording, index, image, labels (17, 2) px) of each labelled image."""
    skier = json.loads((MEDIA / "skier_keypoints.json").read_text())["persons"][0]
    named = json.loads((MEDIA / "pose_1_keypoints2d.json").read_text())
    squats = np.array(json.loads((MEDIA / "pose_squats_landmarks2d.json").read_text()))
    truths = {
        "skier.jpg": np.array(skier["keypoints_xyv_coco17"], float).reshape(1, 17, 3)[..., :2],
        "pose_1.mp4": np.array([[[f[j]["x"], f[j]["y"]] for j in COCO_17.joints] for f in named]),
        "pose_squats.mp4": squats[:, BLAZEPOSE_AS_COCO, :2],
    }
    for name, truth in truths.items():
        with open_source(MEDIA / name) as source:
            for i, frame in enumerate(source):
                yield name, i, frame.image, truth[i]


def clean_cases(pose: str) -> list[Case]:
    cases, estimator, last = [], None, ""
    for name, i, image, truth in labelled():
        if name != last:
            estimator, last = PoseEstimator(MODELS, PoseEstimatorConfig(pose_model=pose)), name
        assert estimator is not None
        estimator.process(image, i * 33_000_000)
        if estimator.keypoints is not None:
            cases.append(Case(name, "unchanged", estimator.keypoints, truth))
    return cases


def degraded_cases(pose: str) -> list[Case]:
    """Degraded labelled images with their labels; deterministic."""
    config = PoseEstimatorConfig(pose_model=pose)
    model, detector = load_pose_model(MODELS, config), load_detector(MODELS, config)
    rng = np.random.default_rng(0)
    cases = []
    for name, i, image, truth in labelled():
        if i % {"skier.jpg": 1, "pose_1.mp4": 5, "pose_squats.mp4": 3}[name]:
            continue
        box = detector.detect(image).boxes[0].astype(float)
        size = box[2:] - box[:2]
        for _ in range(12 if name == "skier.jpg" else 1):

            def add(kind: str, image: np.ndarray, b: np.ndarray, t: np.ndarray, name: str = name) -> None:
                cases.append(Case(name, kind, model.estimate(image, b), t))

            for height in (40, 60, 90, 150):
                s = height / size[1]
                small = cv2.resize(image, None, fx=s, fy=s, interpolation=cv2.INTER_AREA)
                add(f"{height} px", _noisy(small, 4, rng), box * s, (truth + 0.5) * s - 0.5)
            for _ in range(4):
                add("partly covered", _covered(image, box, rng), box, truth)
            length = max(3, int(size.max() * rng.uniform(0.03, 0.1)))
            kernel = np.zeros((length, length), np.float32)
            kernel[length // 2] = 1 / length
            add("motion blur", cv2.filter2D(image, -1, kernel), box, truth)
            add("dark", _noisy(image * 0.25, 12, rng), box, truth)
            add("haze", np.clip(image * 0.35 + 150, 0, 255).astype(np.uint8), box, truth)
            add("shaken box", image, box + rng.uniform(-0.12, 0.12, 4) * np.tile(size, 2), truth)
            cut = box.copy()
            cut[3] = box[1] + size[1] * rng.uniform(0.5, 0.75)
            add("box cut off", image, cut, truth)
    return cases


def _noisy(image: np.ndarray, sigma: float, rng: np.random.Generator) -> np.ndarray:
    return np.clip(image + rng.normal(0, sigma, image.shape), 0, 255).astype(np.uint8)


def _covered(image: np.ndarray, box: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A piece of the image's background over a quarter to a half of the person."""
    out = image.copy()
    w = int((box[2] - box[0]) * rng.uniform(0.5, 1))
    h = int((box[3] - box[1]) * rng.uniform(0.25, 0.5))
    x, y = int(rng.uniform(box[0], box[2] - w + 1)), int(rng.uniform(box[1], box[3] - h))
    sx, sy = int(rng.uniform(0, image.shape[1] - w)), int(rng.uniform(0, image.shape[0] - h))
    patch = image[sy : sy + h, sx : sx + w]
    target = out[y : y + h, x : x + w]
    target[:] = patch[: target.shape[0], : target.shape[1]]
    return out


def standardized(cases: list[Case], layout: str, most: float = np.inf) -> np.ndarray:
    """Errors of the limb joints over their stated standard deviations, those beyond ``most`` of the box left out."""
    out = []
    for case in cases:
        covariance, _ = calibrate(case.keypoints, layout)
        sigma = np.sqrt(covariance[LIMBS][:, [0, 2]]) / case.keypoints.box_size
        fine = np.linalg.norm(case.errors, axis=1) < most
        out.append((case.errors / sigma)[fine].ravel())
    return np.concatenate(out)


def gross_and_confidence(cases: list[Case], layout: str) -> tuple[np.ndarray, np.ndarray]:
    gross = np.concatenate([np.linalg.norm(c.errors, axis=1) > GROSS for c in cases])
    return gross, np.concatenate([calibrate(c.keypoints, layout)[1][LIMBS] for c in cases])


def area_under_roc(gross: np.ndarray, confidence: np.ndarray) -> float:
    """Chance that a gross error has the lower confidence of two."""
    rank = np.empty(len(gross))
    rank[np.argsort(confidence, kind="stable")] = np.arange(len(gross))
    fine, bad = (~gross).sum(), gross.sum()
    return float((rank[~gross].sum() - fine * (fine - 1) / 2) / (fine * bad)) if fine and bad else float("nan")


def accuracy(pose: str, cases: list[Case], degraded: list[Case], layout: str) -> str:
    """Errors of the 12 limb joints and their covariance and confidence, as Markdown."""
    area = json.loads((MEDIA / "skier_keypoints.json").read_text())["persons"][0]["area"]
    skier = next(c for c in cases if c.source == "skier.jpg")
    squared = ((skier.keypoints.xy - skier.truth) ** 2).sum(axis=1)
    similarity = np.exp(-squared / (2 * area * (2 * COCO_SIGMAS) ** 2)).mean()
    rows = []
    for name in ("skier.jpg", "pose_1.mp4", "pose_squats.mp4"):
        mine = [c for c in cases if c.source == name]
        distance = 100 * np.mean([np.linalg.norm(c.errors, axis=1) for c in mine])
        rows.append([name, len(mine), f"{distance:.2f}", f"{standardized(mine, layout).std():.2f}"])
    kinds = []
    for kind in dict.fromkeys(c.kind for c in degraded):
        mine = [c for c in degraded if c.kind == kind]
        distances = np.concatenate([np.linalg.norm(c.errors, axis=1) for c in mine])
        kinds.append([kind, f"{100 * np.median(distances):.2f}", f"{100 * np.mean(distances > GROSS):.1f}"])
    few, _ = gross_and_confidence(cases, layout)
    gross, confidence = gross_and_confidence(degraded, layout)
    return "\n".join([
        f"## {pose}: accuracy and uncertainty of the 12 limb joints\n",
        table(["recording", "images", "mean distance, % of the box", "standardized error"], rows),
        f"Object keypoint similarity of skier.jpg: {similarity:.3f}. All images: standardized error"
        f" {standardized(cases, layout).std():.2f}, gross errors (> 10 % of the box) {few.sum()} of {few.size}.\n",
        table(["degradation", "median distance, % of the box", "gross errors, %"], kinds),
        f"Degraded ({len(degraded)} images): gross errors {gross.mean():.1%}, area under the ROC curve of the"
        f" confidence {area_under_roc(gross, confidence):.3f}; standardized error of the others"
        f" {standardized(degraded, layout, GROSS).std():.2f}.\n",
    ])  # fmt: skip


def plot(pose: str, cases: list[Case], degraded: list[Case], layout: str) -> None:
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    figure, (left, right) = plt.subplots(1, 2, figsize=(10, 4))
    bins = np.linspace(-4, 4, 49)
    left.hist(standardized(cases, layout), bins, density=True, alpha=0.6, label="unchanged")
    left.hist(
        standardized(degraded, layout, GROSS), bins, density=True, histtype="step", label="degraded, no gross errors"
    )
    left.plot(bins, np.exp(-(bins**2) / 2) / np.sqrt(2 * np.pi), "k--", label="unit normal")
    left.set(xlabel="error / stated standard deviation", ylabel="density", title=f"{pose}: covariance")
    left.legend()
    gross, confidence = gross_and_confidence(degraded + cases, layout)
    place = np.clip((confidence * 10).astype(int), 0, 9)
    filled = [place == i for i in range(10) if (place == i).sum() >= 20]
    stated = [confidence[at].mean() for at in filled]
    right.plot([0, 1], [0, 1], "k--")
    right.plot(stated, [1 - gross[at].mean() for at in filled], "o-")
    right.set(xlabel="stated confidence", ylabel="share within 10 % of the box", title=f"{pose}: confidence")
    figure.tight_layout()
    RESULTS.mkdir(exist_ok=True)
    path = RESULTS / f"keypoint_uncertainty_{pose}.png"
    figure.savefig(path, dpi=110)
    plt.close(figure)
    print(f"plot: {path.relative_to(ROOT)}")


def fit(cases: list[Case], degraded: list[Case], spread_share: float) -> Calibration:
    """Calibration by maximum likelihood: sigmas from errors below 10 %, the logistic regression from all."""
    from scipy.optimize import minimize

    knots = np.array(CALIBRATIONS["heatmap"].scores)
    # Equal weights of the three recordings, one of which is a single image; degraded images count less.
    weights = {"pose_1.mp4": 0.5, "pose_squats.mp4": 0.7, "skier.jpg": 20.0}

    def columns(these: list[Case], weight: Callable[[Case], float]) -> tuple[np.ndarray, ...]:
        error = np.concatenate([c.errors for c in these])
        score = np.concatenate([c.keypoints.score[LIMBS] for c in these])
        spread = np.concatenate([c.keypoints.spread[LIMBS] / c.keypoints.box_size**2 for c in these])
        second_peak = np.concatenate([c.keypoints.second[LIMBS] for c in these])
        return error, score, spread, second_peak, np.repeat([weight(c) for c in these], 12)

    parts = [columns(cases, lambda c: weights[c.source]), columns(degraded, lambda c: 0.15)]
    error, score, spread, second_peak, weight = (np.concatenate(p) for p in zip(*parts, strict=True))
    inlier = np.linalg.norm(error, axis=1) < GROSS

    def loss(log_sigma: np.ndarray) -> float:
        variance = np.exp(2 * np.interp(score, knots, log_sigma))[:, None] + spread_share * spread[:, [0, 2]]
        terms = (error**2 / variance / 2 + np.log(variance) / 2).sum(axis=1)
        rising = np.maximum(np.diff(log_sigma), 0.0)
        return float((weight * terms)[inlier].sum() + 5e3 * (rising**2).sum())

    sigmas = np.exp(minimize(loss, np.log(np.linspace(0.045, 0.01, len(knots))), method="L-BFGS-B").x)
    error, score, spread, second_peak, _ = parts[1]
    fine = np.linalg.norm(error, axis=1) < GROSS
    width = np.sqrt(spread[:, [0, 2]].mean(axis=1))
    features = np.stack([np.ones_like(score), score, second_peak, 10 * width], axis=1)
    if spread_share == 0:
        features = features[:, :2]

    def cross_entropy(b: np.ndarray) -> float:
        u = features @ b
        return float(np.where(fine, np.logaddexp(0, -u), np.logaddexp(0, u)).sum() + 0.01 * (b**2).sum())

    b = np.append(minimize(cross_entropy, np.zeros(features.shape[1])).x, [0.0, 0.0])[:4]
    rounded = tuple(round(float(s), 4) for s in sigmas)
    return Calibration(rounded, spread_share, *(round(float(v), 3) for v in b), scores=tuple(map(float, knots)))


def tracking() -> str:
    """Subjects of two recordings over their images, as Markdown."""
    rows = []
    for name in ("outdoor_walk.mp4", "one_by_one_person_detection.mp4"):
        with open_source(MEDIA / name) as source:
            seen = observe(source, PoseEstimator(MODELS, PoseEstimatorConfig(on_loss="next")))
        ids = np.array([o.track_id for o in seen])
        changes = np.nonzero(np.diff(ids))[0] + 1
        runs = [(int(r[0]), int(r[-1]), int(ids[r[0]])) for r in np.split(np.arange(len(ids)), changes)]
        found = ", ".join(f"person {i}: {n}" for i, n in subjects(seen))
        rows.append([name, len(seen), found, ", ".join(f"{a}-{b}: {i or 'nobody'}" for a, b, i in runs)])
    head = ["recording", "images", "with keypoints", "subject by image"]
    return "## Subject tracking\n\n" + table(head, rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--fit", action="store_true", help="fit the calibration")
    parser.add_argument("--quick", action="store_true", help="fewer repetitions, no long video")
    options = parser.parse_args()
    if not MODELS.is_dir() or not MEDIA.is_dir():
        print("perception: no ../shared beside the checkout, nothing to measure")
        return
    cv2.setNumThreads(1)
    parts = []
    for pose in ("tinypose_256x192", "movenet_lightning_int8"):
        layout = load_pose_model(MODELS, PoseEstimatorConfig(pose_model=pose)).spec.layout
        cases, degraded = clean_cases(pose), degraded_cases(pose)
        parts.append(accuracy(pose, cases, degraded, layout))
        plot(pose, cases, degraded, layout)
        if options.fit:
            print(fit(cases, degraded, CALIBRATIONS[layout].spread_share))
    parts.append(speed(20 if options.quick else 100))
    if not options.quick:
        parts.append(tracking())
    write_figures("perception", "Perception: accuracy, uncertainty, speed", "\n".join(parts))


if __name__ == "__main__":
    main()
