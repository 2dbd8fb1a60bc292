"""The page of the station: what is shown and asked, declared; :class:`~drocap_ros.station.station.Station` decides."""

from __future__ import annotations

import html
import json
import uuid
from typing import TYPE_CHECKING

import numpy as np

from drocap_ros.flight.bridge_config import OPERATOR_PERIOD_S
from drocap_ros.station.desk import PARAMETERS, range_of
from drocap_ros.station.station import OLD_S, Look, Station

if TYPE_CHECKING:
    from nicegui import ui

#: Between two looks at the graph, s, and how many of them between two looks at the tables.
_LOOK_S, _TABLES_EVERY = 0.2, 5
_CHECK_COLUMNS = ("check", "state", "found", "wanted", "how to mend it")
_NODE_COLUMNS = ("node", "state", "Hz", "latency, ms (p50 / p95 / p99)", "status", "counts")
_BODY_COLOUR, _GREY = [0.1, 0.45, 0.2], "#ccd4d8"
_LEVELS = {"OK": "positive", "WAITS": "info", "WARNING": "warning", "MISSING": "negative"}
#: Signs of life, and the stop: plain requests, so that they need neither the page's socket nor a free button.  Space
#: stops wherever the focus is, also on another button, which it would press.
_SCRIPT = """<script>
const station = {
  post: path => fetch(path, {method: "POST", keepalive: true, headers: {"X-Station-Page": %(page)s},
    signal: AbortSignal.timeout(2000)}).catch(() => {}),
};
setInterval(() => station.post("/alive"), %(period_ms)d);
addEventListener("pagehide", () => station.post("/leave"));
for (const kind of ["keydown", "keyup"])
  document.addEventListener(kind, event => {
    if (event.code !== "Space") return;
    event.preventDefault();
    event.stopImmediatePropagation();
    if (kind === "keydown" && !event.repeat) station.post("/stop");
  }, true);
</script>
<style>
.nicegui-content { padding: 0.5rem; }
.station { display: grid; gap: 0.5rem; width: 100%%;
  grid-template-columns: repeat(auto-fit, minmax(min(100%%, 26rem), 1fr)); }
.station > * { min-width: 0; }
.station > .wide { grid-column: 1 / -1; }
.old { color: #c10015; }
.body--dark .old { color: #ff7b7b; }
.facts { display: grid; grid-template-columns: auto 1fr; gap: 0 0.8rem; width: 100%%; }
</style>"""


class Page:
    """The elements of one client's page, and their looks at the graph."""

    def __init__(self, station: Station) -> None:
        from nicegui import ui

        self._station, self._key = station, uuid.uuid4().hex
        self._looks = 0
        ui.add_head_html(_SCRIPT % {"page": json.dumps(self._key), "period_ms": 1000 * OPERATOR_PERIOD_S})
        with ui.header().classes("items-center gap-2 p-2 no-wrap bg-dark text-white"):
            self._state = ui.badge("").classes("state text-base p-2")
            self._words = ui.label("").classes("words grow text-sm").props('role="status" aria-live="polite"')
            stop = ui.button("Stop", icon="stop", color="negative").props('size="lg" aria-keyshortcuts="Space"')
            stop.on("click", js_handler='() => station.post("/stop")').tooltip("space bar")
        with ui.card().classes("viewer w-full bg-warning text-black") as self._viewer, ui.row().classes("items-center"):
            ui.label("Another page commands, or none does: this one shows. Stop works here too.")
            ui.button("Take over", on_click=lambda: station.take_over(self._key))
        with ui.element("main").classes("station"):
            with ui.card().classes("p-1"):
                self._picture = ui.interactive_image(size=(16, 9)).classes("w-full").props('alt="picture of the drone"')
            self._build_commands()
            with ui.card().classes("items-center"):
                self._plan = ui.html("", sanitize=False).classes("w-full")
            self._build_scene()
            with ui.card():
                self._facts = ui.html("", sanitize=False).classes("w-full")
            self._preflight = _table("Preflight", _CHECK_COLUMNS)
            self._nodes = _table("Nodes", _NODE_COLUMNS)
        ui.context.client.on_delete(lambda: station.leave(self._key))
        ui.timer(0.0, lambda: station.enter(self._key), once=True)  # when its connection stands: no mere request
        ui.timer(_LOOK_S, self._draw)

    def _build_commands(self) -> None:
        from nicegui import ui

        self._fields = {}
        with ui.card().classes("items-start"):
            with ui.row().classes("w-full"):
                for name in PARAMETERS:
                    # Without a range of its own, which would change what was typed: the desk refuses it.
                    field = ui.number(f"{name}, {range_of(name)['unit']}").classes("w-24")
                    self._fields[name] = field.props(f'clearable aria-label="{name}"')
            ui.label("Empty: as configured; with adjust, as at present.").classes("text-xs")
            with ui.row():
                self._buttons = [
                    ui.button(action.capitalize(), on_click=lambda action=action: self._send(action))
                    for action in ("start", "engage", "adjust")
                ]
                self._record = ui.button("", on_click=lambda: self._station.record(self._key), color="secondary")
            self._answer = ui.label("").classes("answer font-medium").props('role="status" aria-live="polite"')

    def _build_scene(self) -> None:
        from nicegui import ui

        with ui.card().classes("p-1"), ui.scene(height=320, grid=(80, 80), fps=10, background_color=_GREY) as scene:
            scene.classes("w-full")
            # The browser draws them while the sphere about the first ones is in view: it holds every place.
            self._body = scene.point_cloud(
                [[-99.0, -99.0, 0.0], [99.0, 99.0, 0.0]], [_BODY_COLOUR] * 2, point_size=0.06
            )
            self._drone = scene.box(0.5, 0.5, 0.12).material("#e67e22").visible(False)
            self._nose = scene.box(0.3, 0.06, 0.06).material("#c0392b").visible(False)
            scene.move_camera(x=-6, y=-7, z=4, look_at_x=0, look_at_y=0, look_at_z=1, duration=0)

    def _send(self, action: str) -> None:
        self._station.order(self._key, action, {name: field.value for name, field in self._fields.items()})

    def _draw(self) -> None:
        station, look = self._station, self._station.look()
        self._state.set_text(look.state)
        self._state.props(f'color="{look.colour}"')
        self._words.set_text(look.words)
        commands = station.holder == self._key
        self._viewer.set_visibility(not commands)
        for element in (*self._buttons, *self._fields.values()):
            element.set_enabled(commands)
        recording = station.views.recording()
        self._record.set_enabled(commands and recording is not None)
        self._record.set_text("No recorder" if recording is None else "End recording" if recording else "Record")
        self._answer.set_text(station.answer())
        if look.picture:
            self._picture.set_source(f"/picture?{look.picture}")
        self._picture.set_content(look.overlay)
        self._plan.set_content(look.plan)
        self._facts.set_content(_facts_html(look))
        self._draw_scene(look)
        if self._looks % _TABLES_EVERY == 0:
            for table, rows in ((self._preflight, _check_rows(station)), (self._nodes, station.views.nodes())):
                if rows != table.rows:
                    table.rows = rows
        self._looks += 1

    def _draw_scene(self, look: Look) -> None:
        if look.body is not None and len(look.body):
            self._body.set_points(np.round(look.body, 3).tolist(), [_BODY_COLOUR] * len(look.body))
        if np.isfinite(look.vehicle).all() and look.turn is not None:
            for part, ahead_m in ((self._drone, 0.0), (self._nose, 0.4)):
                part.move(*np.round(look.vehicle + ahead_m * look.turn[:, 0], 3).tolist())
                part.rotate_R(np.round(look.turn, 4).tolist())
                part.visible()


def _facts_html(look: Look) -> str:
    rows = [f"<b>{name}</b><span>{html.escape(words)}</span>" for name, words in look.facts.items()]
    for name, age_s in look.ages.items():
        text = "never" if age_s == float("inf") else f"{age_s:.1f} s ago"
        old = ' class="old"' if age_s > OLD_S else ""
        rows.append(f"<b>{name}</b><span{old}>{text}</span>")
    return f'<div class="facts">{"".join(rows)}</div>'


def _check_rows(station: Station) -> list[dict[str, str]]:
    levels = [finding.level.name for finding in station.findings]
    cells = [(f.name, f.level.name.lower(), f.found, f.wanted, f.remedy) for f in station.findings]
    return [
        dict(zip(_CHECK_COLUMNS, row, strict=True)) | {"colour": _LEVELS[level]}
        for row, level in zip(cells, levels, strict=True)
    ]


def _table(title: str, columns: tuple[str, ...]) -> ui.table:
    """Table below a title, whose column `state` has the row's colour."""
    from nicegui import ui

    with ui.card().classes("wide"), ui.expansion(title, value=True).classes("w-full"):
        shape = [{"name": name, "label": name, "field": name, "align": "left"} for name in columns]
        table = ui.table(columns=shape, rows=[], row_key=columns[0]).props("dense flat wrap-cells").classes("w-full")
        badge = '<q-badge :color="props.row.colour">{{ props.value }}</q-badge>'
        table.add_slot("body-cell-state", f'<q-td :props="props">{badge}</q-td>')
    return table
