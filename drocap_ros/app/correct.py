"""Corrections by hand: the clip with its keypoints, a timeline of the feet, and the solution again."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from html import escape
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

import numpy as np
from nicegui import events, ui

from drocap_ros.app.desk import Desk, tell
from drocap_ros.app.jobs import Job, Work
from drocap_ros.app.skeleton_svg import skeleton_svg
from drocap_ros.app.timeline import FEET, HEIGHT, ROW, WIDTH, TimeAxis, bars_svg
from drocap_ros.contacts import rest_spans
from drocap_ros.corrections import parse_corrections, save_corrections
from drocap_ros.errors import DrocapError
from drocap_ros.parameters import Values
from drocap_ros.skeleton import joint_set_of

if TYPE_CHECKING:
    from drocap_ros.app.library import Entry

#: A click's most movement on the timeline, px.
_CLICK = 6.0
#: Size of a drawn joint over the picture's longer side, and distance of a click that takes it, in such sizes.
_JOINT, _REACH = 1 / 110, 3.0
_MOVES = {"w": (0, -1), "a": (-1, 0), "s": (0, 1), "d": (1, 0)}
_FEET = {"l": "left", "r": "right"}
_KEYS = (
    "Arrow keys: an image, with Shift ten; [ and ] begin and end a range; W A S D: the chosen joint by a pixel, with"
    " Shift ten; L and R: that foot rests in the range, with Shift not; Esc: no Vertical, no Another person; Ctrl+Z:"
    " undo."
)


class Correct:
    """The part of the page that corrects a motion."""

    def __init__(self, desk: Desk, entry: Entry, work: Work, solved: Callable[[], None]) -> None:
        self._desk, self._entry, self._work, self._solved = desk, entry, work, solved
        self._said = entry.corrections()
        self._past: list[Values] = []
        self._index = 0
        self._range: tuple[int, int] | None = None
        self._drag: int | None = None
        self._mode, self._ends = "", list[tuple[float, float]]()
        self._from: tuple[float, int] | None = None  # where the mouse went down on the timeline, and its row
        self._read()  # refuses a file that somebody has written
        self._build()
        self._draw()

    def _read(self) -> None:
        """Take the motion as the last solution left it."""
        self._motion, self._tracks, self._pictures = self._entry.motion, self._entry.tracks, self._entry.pictures
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
            here = "in the range, else in this image"
            tools = (
                ("Not seen", self._hide, f"the chosen joint is not seen, {here}"),
                ("Exchange legs", lambda: self._exchange("legs"), f"left and right below the hips, {here}"),
                ("Exchange arms", lambda: self._exchange("arms"), f"left and right below the shoulders, {here}"),
                ("Exchange all", lambda: self._exchange("all"), f"left and right of the body, {here}"),
                ("Another person", lambda: self._begin("person"), "draw a box about who is meant, from here on"),
                ("Nobody", self._nobody, f"the person is not in the picture, {here}"),
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
        self._timeline.classes("w-full timeline").props('data-part="timeline"')
        with ui.row().classes("items-center"):
            ui.button(icon="chevron_left", on_click=lambda: self._go(self._index - 1)).props(
                'flat dense aria-label="image before"'
            )
            self._at = ui.label().classes("font-mono")
            ui.button(icon="chevron_right", on_click=lambda: self._go(self._index + 1)).props(
                'flat dense aria-label="next image"'
            )
            ui.button("Solve again", on_click=self._solve)
            ui.button("Undo", on_click=self._undo).props("outline").bind_enabled_from(self, "_past", bool)
            self._unsolved = ui.label("The motion does not follow the corrections yet.").classes("text-sm")
        ui.label(_KEYS).classes("text-xs opacity-70")
        self._list = ui.column().classes("gap-0")
        ui.keyboard(on_key=self._key, ignore=["input", "select", "textarea"])
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
            key = self._desk.key(self._entry)
            self._picture.set_source(f"/library/{key}/frame/{self._index}?close={int(close)}")
        else:
            self._waiting.activate()
        x0, y0, x1, y1 = self._box()
        self._picture.style(f"width: min(100%, {60 * (x1 - x0) / max(y1 - y0, 1):.1f}vh)")
        self._picture.set_content(self._skeleton())
        self._timeline.set_content(bars_svg(self._axis, self._index, self._range, self._rests, self._said))
        span = "" if self._range is None else "; range {from:.2f} to {to:.2f} s".format(**self._span())
        self._at.text = f"{self._seconds[self._index]:.2f} s, image {self._index}{span}"
        self._unsolved.visible = self._said != self._motion.meta.get("corrections", {})
        self._show_list()

    def _box(self) -> tuple[int, int, int, int]:
        """The part of the image that is shown, px of the clip."""
        close = self._close.value and not self._pictures.error
        return self._pictures.boxes[self._index] if close else (0, 0, *self._pictures.size)

    def _joint_px(self) -> float:
        x0, y0, x1, y1 = self._box()
        return _JOINT * max(x1 - x0, y1 - y0)

    def _skeleton(self) -> str:
        corner, scale = np.array(self._box()[:2]), self._pictures.scale
        at, r = (self._meant[self._index] - corner) * scale, self._joint_px() * scale
        placed = {e["joint"] for e in self._said.get("joints", []) if self._axis.image(e["time"]) == self._index}
        rings = {joint: "white" for joint, name in enumerate(self._tracks.joints) if name in placed}
        if self._name.value is not None:
            rings[self._name.value] = "yellow"
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
                    with ui.row().classes("items-center gap-1 no-wrap"):
                        ui.button(icon="close", on_click=lambda k=kind, e=entry: self._remove(k, e)).props(
                            f'flat dense size=sm aria-label="remove {escape(kind)}"'
                        )
                        first = self._axis.span(entry)[0]
                        ui.button(f"{kind}: {_words(entry)}", on_click=lambda at=first: self._go(at)).props(
                            "flat dense no-caps align=left"
                        )

    # Times

    def _go(self, index: int) -> None:
        self._index = int(np.clip(index, 0, len(self._seconds) - 1))
        self._draw()

    def _span(self) -> dict[str, float]:
        """The range, or the image that is shown."""
        first, last = self._range or (self._index, self._index)
        return {"from": self._axis.time(first), "to": self._axis.time(last)}

    # Corrections

    def _write(self, said: Values) -> None:
        """Keep corrections in their file, where a page that is closed has left them and another one finds them."""
        try:
            save_corrections(self._entry.corrections_file, said)
            self._said = self._entry.corrections()
            self._change()
        except (OSError, DrocapError) as error:
            tell(f"{self._entry.corrections_file}: cannot be written: {error}", "negative")
        self._draw()

    def _alter(self, kind: str, change: Callable[[list[Any]], list[Any]]) -> None:
        """Change the entries of a kind, as the file has them now."""
        try:
            said = self._entry.corrections()
        except DrocapError as error:
            tell(str(error), "negative")
            return
        self._past.append(said)
        self._write({**said, kind: change(said.get(kind, []))})

    def _undo(self) -> None:
        if self._past:
            self._write(self._past.pop())

    def _say(self, kind: str, entry: dict[str, Any]) -> None:
        self._alter(kind, lambda rows: [*rows, entry])

    def _remove(self, kind: str, entry: dict[str, Any]) -> None:
        self._alter(kind, lambda rows: [row for row in rows if row != entry])

    def _place(self, joint: int, at: np.ndarray) -> None:
        name, time_s = self._tracks.joints[joint], self._axis.time(self._index)
        entry = {"time": time_s, "joint": name, "at": _px(at)}
        here = (name, self._index)
        self._alter(
            "joints",
            lambda rows: [*(e for e in rows if (e["joint"], self._axis.image(e["time"])) != here), entry],
        )

    def _choose_joint(self) -> None:
        seen = self._name.value is not None and np.isfinite(self._meant[self._index, self._name.value]).all()
        self._hint.text = "" if seen or self._name.value is None else "click in the picture where this joint is"
        self._draw()

    def _hide(self) -> None:
        if self._name.value is None:
            self._hint.text = "choose a joint first: click it, or by its name"
            return
        self._say("hidden", {**self._span(), "joint": self._tracks.joints[self._name.value]})

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
        at = np.array([event.image_x, event.image_y]) / self._pictures.scale + self._box()[:2]
        if self._mode:
            self._mouse_of_mode(event.type, (float(at[0]), float(at[1])))
        elif event.type == "mousedown":
            self._drag = self._near(at)
            if self._drag is not None:
                self._name.set_value(self._drag)
            elif self._name.value is not None and np.isnan(self._meant[self._index, self._name.value]).any():
                self._place(self._name.value, at)
        elif self._drag is not None and event.type == "mousemove" and event.buttons & 1:
            self._meant[self._index, self._drag] = at
            self._picture.set_content(self._skeleton())
        elif self._drag is not None:  # let go, here or outside of the picture
            joint, self._drag = self._drag, None
            at = at if event.type == "mouseup" else self._meant[self._index, joint]
            before = self._entry.corrected(self._said).keypoints[self._index, joint]
            if not np.linalg.norm(at - before) < 0.5:
                self._place(joint, at)

    def _near(self, at: np.ndarray) -> int | None:
        """The joint that a click takes."""
        away = np.nan_to_num(np.linalg.norm(self._meant[self._index] - at, axis=1), nan=np.inf)
        return int(away.argmin()) if away.min() < _REACH * self._joint_px() else None

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
        step, name = 10 if event.modifiers.shift else 1, event.key.name.lower()
        if event.modifiers.ctrl or event.modifiers.meta:
            if name == "z":
                self._undo()
        elif event.key.arrow_left or event.key.arrow_right:
            self._go(self._index + (step if event.key.arrow_right else -step))
        elif event.key.escape:
            self._mode, self._ends, self._hint.text = "", [], ""
            self._draw()
        elif name in _MOVES and self._name.value is not None:
            at = self._meant[self._index, self._name.value]
            at = at if np.isfinite(at).all() else np.nanmean(self._meant[self._index], axis=0)
            self._place(self._name.value, at + step * np.array(_MOVES[name]))
        elif name in _FEET:
            self._say("feet", {**self._span(), "foot": _FEET[name], "rests": step == 1})
        elif name in ("[", "]"):
            first, last = self._range or (self._index, self._index)
            begin, end = (self._index, last) if name == "[" else (first, self._index)
            self._range = (min(begin, end), max(begin, end))
            self._draw()

    async def _solve(self) -> None:
        """Solve the motion again from its tracks."""
        if await self._work(Job(self._entry.words(self._desk.models))):
            self._read()
            self._draw()
            self._solved()


def _words(entry: Mapping[str, Any]) -> str:
    """An entry in words, its time first."""
    when = {"time": "at {:.2f} s", "from": "from {:.2f} s", "to": "to {:.2f} s"}
    times = " ".join(words.format(entry[key]) for key, words in when.items() if key in entry)
    told = {key: ("no", "yes")[value] if isinstance(value, bool) else value for key, value in entry.items()}
    what = [f"{key} {value}" for key, value in told.items() if key not in when]
    return ", ".join([times, *what] if times else what)


def _px(values: Iterable[float]) -> list[float]:
    return [round(float(v), 1) for v in values]
