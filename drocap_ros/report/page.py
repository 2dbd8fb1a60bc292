"""``report.html``: one file with a motion, its statistics and checks; needs no network."""

from __future__ import annotations

import base64
import dataclasses
import json
import re
from collections.abc import Mapping
from html import escape
from importlib.resources import files
from pathlib import Path
from string import Template

import numpy as np

from drocap_ros.clip import Progress
from drocap_ros.motion import Motion, upright_camera_rotation, upright_joints
from drocap_ros.report import plots
from drocap_ros.report.checks import Finding, MotionCheck, Severity, run_checks
from drocap_ros.report.motion_images import MotionImages, read_motion_images
from drocap_ros.report.movement import Curve, movement
from drocap_ros.report.statistics import Statistics, mean_known, motion_statistics, scale_of, stage_seconds
from drocap_ros.skeleton import side_of

#: Most poses in the page; of longer motions every n-th is shown.
MAX_POSES = 3000


def page_data(
    motion: Motion,
    s: Statistics,
    images: MotionImages | None,
    people: Mapping[int, Motion] | None = None,
    placed: Mapping[int, Motion] | None = None,
) -> dict[str, object]:
    """JSON-compatible data: integers, row-major, null where unknown.

    ``pose`` mm and ``camera`` (right, forward; thousandths) in axes with z up; ``keypoints`` tenths of a px;
    ``people`` holds poses, keypoints and movement of each of several persons on the same frames, None = there is one;
    ``lead`` is whose plots the page has, the first of ``people``; ``placed`` are all on the frames of ``motion``;
    ``heading`` milliradians; ``times`` ms; ``movement`` 1 / ``scale`` of its unit, a list per side.
    """
    shown = shown_frames(motion)
    axes = upright_camera_rotation(motion)[shown][:, [0, 2]]
    return {
        "joints": list(motion.joints),
        "parents": list(motion.parents),
        "sides": [side_of(name, motion.joints) for name in motion.joints],
        "world": motion.frame == "world",
        "frames": shown.tolist(),
        "times": _times(motion, shown),
        "pose": _integers(upright_joints(motion)[shown], 1000),
        "camera": _integers(axes, 1000),
        "heading": _integers(s.heading_rad[shown], 1000),
        "keypoints": _integers(motion.keypoints[shown], 10),
        "movement": [_curve(curve) for curve in movement(motion, s, shown)],
        "series": {"error": _numbers(s.error_px[shown]), "view": _numbers(s.view_deg[shown])},
        "image": None if images is None else _images(images, shown),
        "lead": str(next(iter(people or ()), "")),
        "people": [_person(number, other, people[number], shown) for number, other in placed.items()]
        if people and placed
        else None,
    }


def _person(number: int, placed: Motion, own: Motion, shown: np.ndarray) -> dict[str, object]:
    stamp_ns = placed.stamp_ns[shown]
    frames = np.searchsorted(own.stamp_ns, stamp_ns).clip(0, len(own.stamp_ns) - 1)
    curves = movement(own, motion_statistics(own), frames)
    for curve in curves:
        curve.values[(stamp_ns < own.stamp_ns[0]) | (stamp_ns > own.stamp_ns[-1])] = np.nan
    return {
        "name": str(number),
        "pose": _integers(upright_joints(placed)[shown], 1000),
        "keypoints": _integers(placed.keypoints[shown], 10),
        "movement": [_curve(curve) for curve in curves],
    }


def _curve(curve: Curve) -> dict[str, object]:
    scale = 10 if curve.unit == "°" else 100
    columns = {"values": curve.values, "deviation": curve.deviation}
    return {
        "name": curve.name,
        "unit": curve.unit,
        "words": curve.words,
        "sides": list(curve.sides),
        "scale": scale,
        **{key: None if v is None else [_integers(column, scale) for column in v.T] for key, v in columns.items()},
    }


def script_json(data: object) -> str:
    """JSON for a script element: no character ends the element or a line."""
    text = json.dumps(data, separators=(",", ":"), allow_nan=False)
    for character in "<>&\u2028\u2029":
        text = text.replace(character, f"\\u{ord(character):04x}")
    return text


def _images(images: MotionImages, shown: np.ndarray) -> dict[str, object]:
    """Images with the index of their frame among those shown, each index once."""
    places, first = np.unique(np.searchsorted(shown, images.frames).clip(0, len(shown) - 1), return_index=True)
    return {
        "boxes": [list(images.boxes[i]) for i in first],
        "places": places.tolist(),
        "jpeg": [base64.b64encode(images.jpegs[i]).decode() for i in first],
    }


def images_of_page(page: Path, motion: Motion) -> MotionImages | None:
    """Images that an earlier report of the same keypoints and times holds; None = there is none, or no such report."""
    try:
        found = re.search(r'id="motion">(.*?)</script>', page.read_text(encoding="utf-8"), re.DOTALL)
        data = json.loads(found[1]) if found else {}
        shown = shown_frames(motion)
        if data.get("image") is None or data["frames"] != shown.tolist():
            return None
        if data["keypoints"] != _integers(motion.keypoints[shown], 10) or data["times"] != _times(motion, shown):
            return None
        image = data["image"]
        jpegs = tuple(base64.b64decode(text) for text in image["jpeg"])
        boxes = tuple((int(x0), int(y0), int(x1), int(y1)) for x0, y0, x1, y1 in image["boxes"])
        return MotionImages(tuple(shown[image["places"]].tolist()), jpegs, boxes)
    except (OSError, ValueError, KeyError, TypeError, IndexError, AttributeError):  # not a report, or one of old
        return None


def shown_frames(motion: Motion) -> np.ndarray:
    """Indices of the frames in the page."""
    return np.arange(0, len(motion.joints3d), -(-len(motion.joints3d) // MAX_POSES))


def _times(motion: Motion, shown: np.ndarray) -> list[int | None]:
    return _integers((motion.stamp_ns[shown] - motion.stamp_ns[0]) * 1e-9, 1000)


def _integers(values: np.ndarray, scale: float) -> list[int | None]:
    flat = np.asarray(values, float).ravel() * scale
    known = np.isfinite(flat)
    whole = np.rint(np.where(known, flat, 0.0)).astype(np.int64).astype(object)
    whole[~known] = None
    listed: list[int | None] = whole.tolist()
    return listed


def _numbers(values: np.ndarray) -> list[float | None]:
    return [round(v, 2) if np.isfinite(v) else None for v in np.asarray(values, float).tolist()]


_SCRIPTS = ("data.js", "scene.js", "image.js", "charts.js", "player.js")


def save_report(
    path: str | Path,
    motion: Motion,
    *,
    video: Path | None = None,
    images: MotionImages | None = None,
    former: Path | None = None,
    command: str = "",
    progress: Progress | None = None,
) -> bool:
    """Write the report of a motion; returns whether it holds images.

    video : source of the motion, for its images
    images : those of the motion, where they were read already
    former : report whose images are kept, where there are no others and it shows the same keypoints; it may be missing
    command : command line of the report, shown beside the one in the motion's ``meta``
    progress : called with the stage "report" and its completed share
    """
    if video is not None:
        images = read_motion_images(video, motion, progress)
    if images is None and former is not None:
        images = images_of_page(former, motion)
    Path(path).write_text(render_report(motion, images, command), encoding="utf-8")
    return images is not None


def render_report(
    motion: Motion,
    images: MotionImages | None = None,
    command: str = "",
    people: Mapping[int, Motion] | None = None,
    placed: Mapping[int, Motion] | None = None,
) -> str:
    """HTML of the report; see :func:`save_report`.

    people : everybody by number, ``motion`` first, for a page of several; placed : the same on its times
    """
    s = motion_statistics(motion)
    findings = run_checks(motion, s) if people is None else _findings(people)
    folder = files("drocap_ros.report") / "page"
    page = Template((folder / "page.html").read_text(encoding="utf-8"))
    name = str(motion.meta.get("input", "motion"))
    return page.substitute(
        title=escape(name),
        subtitle=escape(_subtitle(motion, people)),
        style=(folder / "style.css").read_text(encoding="utf-8"),
        tiles="".join(_tile(*tile) for tile in (_tiles(motion, s) if people is None else _people_tiles(people))),
        badge=_badge(findings),
        checks=_checks(findings),
        plots="".join(_figure(*figure) for figure in _plots(motion, s)),
        provenance=_provenance(motion, command),
        parameters=escape(json.dumps(motion.meta, indent=1, sort_keys=True)),
        data=script_json(page_data(motion, s, images, people, placed)),
        script="\n".join((folder / name).read_text(encoding="utf-8") for name in _SCRIPTS),
    )


def _subtitle(motion: Motion, people: Mapping[int, Motion] | None) -> str:
    method = motion.meta.get("method", "unknown")
    frame = "in the world, z up" if motion.frame == "world" else "as the camera saw it"
    if people is None:
        return f"3D motion of a person, {frame} · method {method}"
    first = next(iter(people))
    return f"3D motion of {len(people)} persons, {frame} · method {method} · plots: person {first}"


def _tile(value: str, unit: str, label: str) -> str:
    return f'<div class="tile"><b>{escape(value)}<i>{escape(unit)}</i></b><span>{escape(label)}</span></div>'


def _tiles(motion: Motion, s: Statistics) -> list[tuple[str, str, str]]:
    share = s.median_px / s.body_px
    scale, source = scale_of(motion)
    return [
        (f"{s.times_s[-1]:.1f}", "s", f"{len(s.times_s)} frames at {s.rate_hz:.3g} Hz"),
        (f"{100 * s.seen.mean():.0f}", "%", "of frames with a subject"),
        (_number(s.median_px, ".1f"), "px", f"median reprojection error, {_number(100 * share, '.1f')} % of the body"),
        (_number(100 * float(mean_known(s.bone_spread, None)), ".1f"), "%", "spread of bone lengths"),
        (f"{s.view_speed_dps:.0f}", "°/s", f"view of the body, {s.view_span_deg:.0f}° in all"),
        (scale, "", f"scale, {source}"),
    ]


def _people_tiles(people: Mapping[int, Motion]) -> list[tuple[str, str, str]]:
    """One for each person."""
    tiles = []
    begin_ns = min(int(motion.stamp_ns[0]) for motion in people.values())
    for number, motion in sorted(people.items()):
        s = motion_statistics(motion)
        seen = np.flatnonzero(s.seen)
        first, last = ((int(motion.stamp_ns[at]) - begin_ns) * 1e-9 for at in (seen[0], seen[-1]))
        share = _number(100 * s.median_px / s.body_px, ".1f")
        label = f"{first:.1f} to {last:.1f} s, median reprojection error {share} % of the body, {scale_of(motion)[1]}"
        tiles.append((f"person {number}", "", label))
    return tiles


def _findings(people: Mapping[int, Motion]) -> list[Finding]:
    """The checks of everybody, each with its person, and who was left out."""
    found = [
        dataclasses.replace(finding, person=number)
        for number, motion in people.items()
        for finding in run_checks(motion, motion_statistics(motion))
    ]
    left_out = next(iter(people.values())).meta.get("left_out", [])
    return found + [Finding(MotionCheck.LEFT_OUT, Severity.NOTE, {"words": words}) for words in left_out]


def _number(value: float, form: str) -> str:
    return format(value, form) if np.isfinite(value) else "-"


def _grouped(results: list[Finding]) -> list[tuple[Severity, str, str]]:
    """Severity, title and text of each check; what several persons share is said once, with their numbers."""
    groups: dict[tuple[Severity, MotionCheck], list[Finding]] = {}
    for result in results:
        groups.setdefault((result.severity, result.check), []).append(result)
    said = []
    for (severity, check), found in groups.items():
        found.sort(key=lambda result: result.person or 0)
        persons = ", ".join(str(result.person) for result in found if result.person is not None)
        text = (
            found[0].text
            if len({result.text for result in found}) == 1
            else " ".join(f"{result.person}: {result.text}" for result in found)
        )
        said.append((severity, f"{check.title} (person {persons})" if persons else check.title, text))
    return said


def _badge(results: list[Finding]) -> str:
    titles = [title for severity, title, _ in _grouped(results) if severity is Severity.WARNING]
    if not titles:
        return '<span class="badge">no warnings</span>'
    return f'<span class="badge warning">{len(titles)} to read below: {escape(", ".join(titles))}</span>'


def _checks(results: list[Finding]) -> str:
    items = [(severity.value, title, text) for severity, title, text in _grouped(results)]
    if not any(result.severity is Severity.WARNING for result in results):
        items.insert(0, ("good", "No warnings", "No automatic check doubts this motion."))
    return "".join(f'<li class="{kind}"><b>{escape(title)}</b> {escape(text)}</li>' for kind, title, text in items)


def _figure(title: str, caption: str, svg: str) -> str:
    labelled = svg.replace("<svg ", f'<svg role="img" aria-label="{escape(title)}" ', 1)
    return (
        f'<figure><figcaption><b>{escape(title)}</b><output class="readout"></output></figcaption>'
        f"{labelled}<p>{escape(caption)}</p></figure>"
    )


def _plots(motion: Motion, s: Statistics) -> list[tuple[str, str, str]]:
    sides = [side_of(joint, motion.joints) for joint in motion.joints]
    bone_sides = [side_of(bone.split(" - ")[1], motion.joints) for bone in s.bones]
    return [
        (
            "Reprojection error",
            "Distance of the projected 3D joints from the 2D keypoints, RMS over joints.",
            plots.line_plot(s.times_s, s.error_px, unit="px", series="error"),
        ),
        (
            "View of the body",
            "Azimuth of the camera from the body: 0° in front, 90° from its left. Its change makes depth visible.",
            plots.line_plot(s.times_s, s.view_deg, unit="°", series="view", from_zero=False),
        ),
        (
            "Bone lengths",
            "Median, and the range of 90 % of the frames. A bone that changes its length is a sign of depth errors.",
            plots.range_plot(s.bones, 100 * s.bone_lengths_m, unit="cm", classes=bone_sides),
        ),
        *_time(motion),
        (
            "Confidence per joint",
            "Mean over the frames, 0 to 1.",
            plots.bar_plot(motion.joints, mean_known(motion.confidence, 0), form="{:.2f}", classes=sides, limit=1.0),
        ),
        (
            "Error per joint",
            "Reprojection error of each joint, RMS over the frames, px.",
            plots.bar_plot(motion.joints, s.joint_error_px, form="{:.1f} px", classes=sides),
        ),
    ]


def _time(motion: Motion) -> list[tuple[str, str, str]]:
    if not (seconds := stage_seconds(motion.meta)):
        return []
    bars = plots.bar_plot(list(seconds), np.array([*seconds.values()]), form="{:.2f} s")
    return [("Time", "Seconds per stage of the reconstruction.", bars)]


def _provenance(motion: Motion, command: str) -> str:
    meta = motion.meta
    versions = meta.get("versions")
    rows: list[tuple[str, object]] = [
        ("reconstructed by", meta.get("command")),
        ("report by", command),
        ("corrected by hand", ", ".join(f"{kind}: {len(said)}" for kind, said in meta.get("corrections", {}).items())),
        ("git revision", meta.get("git_revision")),
        *(
            (f"{name} version", version)
            for name, version in sorted(versions.items() if isinstance(versions, dict) else ())
        ),
        ("solver", _solver(meta)),
        ("scale", ", ".join(scale_of(motion))),
    ]
    return "".join(
        f"<tr><th>{escape(name)}</th><td><code>{escape(str(value))}</code></td></tr>" for name, value in rows if value
    )


def _solver(meta: Mapping[str, object]) -> str:
    if "iterations" not in meta:
        return ""
    return f"{meta['iterations']} iterations, stopped by: {meta.get('stop_reason', 'unknown')}"
