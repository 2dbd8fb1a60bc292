"""Corrections by hand: the clip with its keypoints, a timeline of the feet, and the solution again."""

from __future__ import annotations

from html import escape
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

import numpy as np
from nicegui import events, ui

from drocap_ros.app.jobs import Job
from drocap_ros.app.skeleton_svg import skeleton_svg
from drocap_ros.app.timeline import FEET, HEIGHT, ROW, WIDTH, TimeAxis, bars_svg
from drocap_ros.contacts import rest_spans
from drocap_ros.corrections import parse_corrections, save_corrections
from drocap_ros.skeleton import joint_set_of

if TYPE_CHECKING:
    from drocap_ros.app.desk import Host
    from drocap_ros.app.library import Entry

#: A click's most movement on the timeline, px.
_CLICK = 6.0
#: Size of a drawn joint over the picture's longer side, and distance of a click that takes it, in such sizes.
_JOINT, _REACH = 1 / 110, 3.0


class Correct:
    """The part of the page that corrects a motion."""

    def __init__(self, page: Host, entry: Entry) -> None:
        self._page, self._entry = page, entry
        self._said: dict[str, list[Any]] = {kind: list(rows) for kind, rows in entry.corrections().items()}
        self._index = 0
        self._range: tuple[int, int] | None = None
        self._joint: int | None = None
        self._drag: int | None = None
        self._mode, self._ends = "", list[tuple[float, float]]()
        self._from: tuple[float, int] | None = None  # where the mouse went down on the timeline, and its row
        self._read()  # refuses a file that somebody has written
        self._pictures = page.desk.open_pictures(entry)
        self._build()
        self._draw()

    def close(self) -> None:
        """The page shows something else."""
        self._page.desk.close_pictures(self._entry)

    def _read(self) -> None:
        """Take the motion as the last solution left it."""
        self._motion, self._tracks = self._entry.motion, self._entry.tracks
        stamp_ns, motion = self._tracks.stamp_ns, self._motion
        self._seconds = (stamp_ns - stamp_ns[0]) * 1e-9
        self._axis = TimeAxis(self._seconds)
        # One of several persons has tracks in all images, and a motion while it is seen.
        self._rows = np.searchsorted(stamp_ns, motion.stamp_ns).clip(0, len(stamp_ns) - 1)
        rate = 1.0 / max(float(np.median(np.diff(self._seconds))), 1e-3) if len(stamp_ns) > 1 else 30.0
        ankles = [motion.joints3d[:, motion.joints.index(f"{side[0]}ankle")] for side in FEET]
        spans = [rest_spans(ankle, rate) if motion.frame == "world" else [] for ankle in ankles]
        self._rests = [[(self._rows[a], self._rows[b - 1] + 1) for a, b in of_foot] for of_foot in spans]
        source, place = joint_set_of(self._tracks.joints)
        bones = [(int(place[a]), int(place[b])) for a, b in source.bones]
        self._bones = [(a, b) for a, b in bones if a >= 0 and b >= 0]
        self._change()

    def _change(self) -> None:
        """Apply the corrections to the keypoints in the picture; the last solution has those of other persons."""
        self._meant = self._entry.corrected(self._said).keypoints.copy()  # a drag moves them
        for span, box in parse_corrections(self._said).person:
            rows = span.of(self._seconds)
            self._meant[rows] = np.nan
            solved = np.flatnonzero(rows[self._rows])
            for joint, name in enumerate(self._tracks.joints if box is not None else ()):
                if name in self._motion.joints:
                    found = self._motion.keypoints[solved, self._motion.joints.index(name)]
                    self._meant[self._rows[solved], joint] = found

    def _build(self) -> None:
        with ui.row().classes("w-full items-center gap-2"):
            self._close = ui.switch("Close up", value=True, on_change=self._draw)
            self._name = ui.select(
                dict(enumerate(self._tracks.joints)), label="Joint", on_change=self._choose_joint
            ).classes("w-40")
            tools = (
                ("Not seen", self._hide, "the chosen joint is not seen in the range"),
                ("Exchange legs", lambda: self._exchange("legs"), "left and right below the hips, in the range"),
                ("Exchange arms", lambda: self._exchange("arms"), "left and right below the shoulders, in the range"),
                ("Exchange all", lambda: self._exchange("all"), "left and right of the body, in the range"),
                ("Another person", lambda: self._begin("person"), "draw a box about who is meant, from here on"),
                ("Nobody", self._nobody, "the person is not in the picture, in the range"),
                ("Vertical", lambda: self._begin("upright"), "click the lower, then the upper end of an edge"),
            )
            for label, action, words in tools:
                ui.button(label, on_click=action).props("outline dense no-caps").tooltip(words)
        self._hint = ui.label().classes("text-sm opacity-80")
        self._picture = ui.interactive_image(
            on_mouse=self._mouse, events=["mousedown", "mousemove", "mouseup"], sanitize=False
        )
        self._picture.props('data-part="picture"')
        self._timeline = ui.interactive_image(
            size=(WIDTH, HEIGHT), on_mouse=self._time_mouse, events=["mousedown", "mouseup"], sanitize=False
        )
        self._timeline.classes("w-full").props('data-part="timeline"')
        with ui.row().classes("items-center"):
            ui.button(icon="chevron_left", on_click=lambda: self._go(self._index - 1)).props("flat dense")
            self._at = ui.label().classes("font-mono")
            ui.button(icon="chevron_right", on_click=lambda: self._go(self._index + 1)).props("flat dense")
            ui.button("Solve again", on_click=self._solve)
            ui.label("Arrow keys: an image, with Shift ten; [ and ] begin and end a range.").classes(
                "text-xs opacity-70"
            )
        self._list = ui.column().classes("gap-0")
        ui.keyboard(on_key=self._key)
        self._waiting = ui.timer(0.3, self._wait)

    def _wait(self) -> None:
        """Until the picture has been read."""
        if self._pictures.read > self._index or self._pictures.error:
            self._waiting.deactivate()
            self._draw()

    # Drawing

    def _draw(self) -> None:
        """Everything as it is now."""
        pictures, close = self._pictures, bool(self._close.value)
        if pictures.error:
            self._hint.text, (width, height) = pictures.error, pictures.size
            blank = f"<svg xmlns='http://www.w3.org/2000/svg' width='{width}' height='{height}'/>"
            self._picture.set_source(f"data:image/svg+xml,{quote(blank)}")
        elif pictures.read > self._index:
            key = self._page.desk.key(self._entry)
            self._picture.set_source(f"/library/{key}/frame/{self._index}?close={int(close)}")
        else:
            self._waiting.activate()
        x0, y0, x1, y1 = pictures.boxes[self._index] if close else (0, 0, *pictures.size)
        self._picture.style(f"width: min(100%, {60 * (x1 - x0) / max(y1 - y0, 1):.1f}vh)")
        self._picture.set_content(self._skeleton())
        self._timeline.set_content(bars_svg(self._axis, self._index, self._range, self._rests, self._said))
        span = (
            ""
            if self._range is None
            else f"  range {self._axis.time(self._range[0]):.2f} to {self._axis.time(self._range[1]):.2f} s"
        )
        self._at.text = f"{self._seconds[self._index]:.2f} s, image {self._index}{span}"
        self._show_list()

    def _view(self) -> tuple[np.ndarray, float]:
        return self._pictures.shown(self._index, bool(self._close.value) and not self._pictures.error)

    def _skeleton(self) -> str:
        (corner, scale), keypoints = self._view(), self._meant[self._index]
        at = (keypoints - corner) * scale
        x0, y0, x1, y1 = self._pictures.boxes[self._index]
        longer = max(x1 - x0, y1 - y0) if self._close.value else max(self._pictures.size)
        r = longer * scale * _JOINT
        placed = {e["joint"] for e in self._said.get("joints", []) if self._axis.image(e["time"]) == self._index}
        rings = {joint: "white" for joint, name in enumerate(self._tracks.joints) if name in placed}
        if self._joint is not None:
            rings[self._joint] = "yellow"
        out = [skeleton_svg(self._tracks.joints, self._bones, at, r, rings)]
        ends = [(np.array(end) - corner) * scale for end in self._ends]
        if self._mode == "person" and len(ends) == 2:
            (ax, ay), (bx, by) = np.minimum(*ends), np.maximum(*ends)
            out.append(
                f'<rect x="{ax:.1f}" y="{ay:.1f}" width="{bx - ax:.1f}" height="{by - ay:.1f}" fill="none"'
                f' stroke="yellow" stroke-width="{0.5 * r:.1f}"/>'
            )
        out += [f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{r:.1f}" fill="yellow"/>' for x, y in ends]
        return "".join(out)

    def _show_list(self) -> None:
        self._list.clear()
        with self._list:
            for kind, entries in self._said.items():
                for entry in entries:
                    words = ", ".join(f"{key} {value}" for key, value in entry.items())
                    with ui.row().classes("items-center gap-1"):
                        ui.button(icon="close", on_click=lambda k=kind, e=entry: self._remove(k, e)).props(
                            f'flat dense size=sm aria-label="remove {escape(kind)}"'
                        )
                        ui.label(f"{kind}: {words}").classes("text-sm")

    # Times

    def _go(self, index: int) -> None:
        self._index = int(np.clip(index, 0, len(self._seconds) - 1))
        self._draw()

    def _span(self) -> dict[str, float]:
        """The range, or the image that is shown."""
        first, last = self._range or (self._index, self._index)
        return {"from": self._axis.time(first), "to": self._axis.time(last)}

    # Corrections

    def _say(self, kind: str, entry: dict[str, Any]) -> None:
        self._said.setdefault(kind, []).append(entry)
        self._change()
        self._draw()

    def _remove(self, kind: str, entry: dict[str, Any]) -> None:
        self._said[kind].remove(entry)
        self._change()
        self._draw()

    def _place(self, joint: int, at: np.ndarray) -> None:
        name, time_s = self._tracks.joints[joint], self._axis.time(self._index)
        said, here = self._said.get("joints", []), (name, self._index)
        self._said["joints"] = [e for e in said if (e["joint"], self._axis.image(e["time"])) != here]
        self._say("joints", {"time": time_s, "joint": name, "at": [round(float(v), 2) for v in at]})

    def _choose_joint(self) -> None:
        self._joint = self._name.value
        seen = self._joint is not None and np.isfinite(self._meant[self._index, self._joint]).all()
        self._hint.text = "" if seen or self._joint is None else "click in the picture where this joint is"
        self._draw()

    def _hide(self) -> None:
        if self._joint is None:
            self._hint.text = "choose a joint first: click it, or by its name"
            return
        self._say("hidden", {**self._span(), "joint": self._tracks.joints[self._joint]})

    def _exchange(self, limbs: str) -> None:
        self._say("sides", {**self._span(), "limbs": limbs})

    def _nobody(self) -> None:
        self._say("person", self._span())

    def _begin(self, mode: str) -> None:
        """The next clicks in the whole picture mean something else."""
        self._mode, self._ends = mode, []
        if mode == "person" and self._range is not None:
            self._index = self._range[0]
        self._hint.text = {
            "person": "draw a box about the person who is meant",
            "upright": "click the lower end of something vertical, then its upper end",
        }[mode]
        self._close.set_value(False)
        self._draw()

    # The mouse and keys

    def _mouse(self, event: events.MouseEventArguments) -> None:
        corner, scale = self._view()
        at = np.array([event.image_x, event.image_y]) / scale + corner
        if self._mode:
            self._mouse_of_mode(event.type, (float(at[0]), float(at[1])))
        elif event.type == "mousedown":
            self._drag = self._near(at)
            if self._drag is not None:
                self._joint = self._drag
                self._name.set_value(self._drag)
            elif self._joint is not None and np.isnan(self._meant[self._index, self._joint]).any():
                self._place(self._joint, at)
        elif self._drag is not None and event.type == "mousemove" and event.buttons & 1:
            self._meant[self._index, self._drag] = at
            self._picture.set_content(self._skeleton())
        elif self._drag is not None and event.type == "mouseup":
            joint, self._drag = self._drag, None
            before = self._entry.corrected(self._said).keypoints[self._index, joint]
            if not np.linalg.norm(at - before) < 0.5:
                self._place(joint, at)

    def _near(self, at: np.ndarray) -> int | None:
        """The joint that a click takes."""
        x0, y0, x1, y1 = self._pictures.boxes[self._index]
        longer = max(x1 - x0, y1 - y0) if self._close.value else max(self._pictures.size)
        away = np.linalg.norm(self._meant[self._index] - at, axis=1)
        if not np.isfinite(away).any() or np.nanmin(away) > _REACH * _JOINT * longer:
            return None
        return int(np.nanargmin(away))

    def _mouse_of_mode(self, kind: str, at: tuple[float, float]) -> None:
        if self._mode == "upright":
            if kind == "mousedown":
                self._ends.append(at)
            if len(self._ends) == 2:
                (lower, upper), self._ends = sorted(self._ends, key=lambda end: -end[1]), []
                self._end_mode(
                    "upright", {"time": self._axis.time(self._index), "bottom": _px(lower), "top": _px(upper)}
                )
                return
        elif kind == "mousedown":
            self._ends = [at, at]
        elif self._ends:
            self._ends[1] = at
            if kind == "mouseup":
                low, high = np.array(self._ends).min(axis=0), np.array(self._ends).max(axis=0)
                if (high - low).min() > 8:
                    entry: dict[str, Any] = {"from": self._axis.time(self._index), "box": _px((*low, *high))}
                    entry |= {} if self._range is None else {"to": self._axis.time(self._range[1])}
                    self._end_mode("person", entry)
                    return
        self._picture.set_content(self._skeleton())

    def _end_mode(self, kind: str, entry: dict[str, Any]) -> None:
        self._mode, self._ends, self._hint.text = "", [], ""
        self._say(kind, entry)

    def _time_mouse(self, event: events.MouseEventArguments) -> None:
        row = int(np.clip(event.image_y // ROW, 0, 2))
        if event.type == "mousedown":
            self._from = (event.image_x, row)
            return
        if self._from is None:
            return
        (begin, row), self._from = self._from, None
        first, last = sorted((self._axis.at(begin), self._axis.at(event.image_x)))
        dragged = abs(event.image_x - begin) > _CLICK
        if row == 0:
            self._range = (first, last) if dragged else None
            self._go(first)
        else:
            self._foot(FEET[row - 1], first, last if dragged else None)

    def _foot(self, foot: str, first: int, last: int | None) -> None:
        """Add a rest by a drag; deny a rest by a click on it; take a correction back by a click on that."""
        if last is not None:
            self._say_of_foot(foot, first, last, rests=True)
            return
        for entry in self._said.get("feet", []):
            begin, end = self._axis.span(entry)
            if entry["foot"] == foot and begin <= first <= end:
                self._remove("feet", entry)
                return
        for a, b in self._rests[FEET.index(foot)]:
            if a <= first < b:
                self._say_of_foot(foot, a, b - 1, rests=False)
                return
        self._go(first)

    def _say_of_foot(self, foot: str, first: int, last: int, *, rests: bool) -> None:
        self._say("feet", {"from": self._axis.time(first), "to": self._axis.time(last), "foot": foot, "rests": rests})

    def _key(self, event: events.KeyEventArguments) -> None:
        if not event.action.keydown:
            return
        step = 10 if event.modifiers.shift else 1
        if event.key.arrow_left or event.key.arrow_right:
            self._go(self._index + (step if event.key.arrow_right else -step))
        elif event.key.name in ("[", "]"):
            first, last = self._range or (self._index, self._index)
            begin, end = (self._index, last) if event.key.name == "[" else (first, self._index)
            self._range = (min(begin, end), max(begin, end))
            self._draw()

    async def _solve(self) -> None:
        """Write the file and solve the motion again from its tracks."""
        save_corrections(self._entry.corrections_file, self._said)
        if await self._page.work(Job(self._entry.words(self._page.desk.models))):
            self._read()
            self._draw()
            self._page.solved()


def _px(values: tuple[float, ...]) -> list[float]:
    return [round(float(v), 1) for v in values]
