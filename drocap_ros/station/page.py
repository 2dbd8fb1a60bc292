"""The page of the station: what is shown and asked, declared; :class:`~drocap_ros.station.station.Station` decides.

This module alone imports NiceGUI at its top: the server imports it when it starts.
"""

from __future__ import annotations

import html
import json
import uuid
from collections.abc import Callable
from typing import Any

import numpy as np
from nicegui import ui

from drocap_ros.flight.bridge_config import OPERATOR_PERIOD_S
from drocap_ros.station.desk import PARAMETERS, range_of
from drocap_ros.station.station import OLD_S, Look, Station

#: Between two looks at the graph, s, and how many of them between two looks at the tables.
_LOOK_S, _TABLES_EVERY = 0.2, 5
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
.facts { display: grid; grid-template-columns: auto 1fr; gap: 0 0.8rem; width: 100%%; }
*:focus-visible { outline: 3px solid #3fbdb5; outline-offset: 1px; }
</style>"""


def build_page(station: Station) -> None:
    """Declare the elements of a new client's page."""
    page = uuid.uuid4().hex
    station.enter(page)
    ui.context.client.on_delete(lambda: station.leave(page))
    ui.add_head_html(_SCRIPT % {"page": json.dumps(page), "period_ms": 1000 * OPERATOR_PERIOD_S})
    draws = [_header(station, page)]
    with ui.element("main").classes("station"):
        draws += [_picture(), _commands(station, page), _plan(), _scene(), _facts()]
        tables = [_preflight(station), _nodes(station)]
    counts = {"look": 0}

    def refresh() -> None:
        look = station.look()
        for draw in draws:
            draw(look)
        if counts["look"] % _TABLES_EVERY == 0:
            for draw in tables:
                draw(look)
        counts["look"] += 1

    ui.timer(_LOOK_S, refresh)


Draw = Callable[[Look], None]


def _header(station: Station, page: str) -> Draw:
    with ui.header().classes("items-center gap-2 p-2 no-wrap bg-dark text-white"):
        state = ui.badge("").classes("state text-base p-2")
        words = ui.label("").classes("words grow text-sm").props('role="status" aria-live="polite"')
        stop = ui.button("Stop", icon="stop", color="negative").props('size="lg" aria-keyshortcuts="Space"')
        stop.on("click", js_handler='() => station.post("/stop")').tooltip("space bar")
    with ui.card().classes("viewer w-full bg-warning text-black") as viewer, ui.row().classes("items-center"):
        ui.label("Another page commands, or none does: this one shows. Stop works here too.")
        ui.button("Take over", on_click=lambda: station.take_over(page))

    def draw(look: Look) -> None:
        state.set_text(look.state)
        state.props(f'color="{look.colour}"')
        words.set_text(look.words)
        viewer.set_visibility(station.holder != page)

    return draw


def _picture() -> Draw:
    with ui.card().classes("p-1"):
        image = ui.interactive_image(size=(16, 9)).classes("w-full").props('alt="picture of the drone"')

    def draw(look: Look) -> None:
        if look.picture:
            image.set_source(f"/picture?{look.picture}")
        image.set_content(look.overlay)

    return draw


def _commands(station: Station, page: str) -> Draw:
    fields: dict[str, Any] = {}

    def send(action: str) -> None:
        station.order(page, action, {name: field.value for name, field in fields.items()})

    with ui.card().classes("items-start"):
        with ui.row().classes("w-full"):
            for name in PARAMETERS:
                # Without a range of its own, which would change what was typed: the desk refuses it.
                field = ui.number(f"{name}, {range_of(name)['unit']}")
                fields[name] = field.classes("w-24").props(f'clearable aria-label="{name}"')
        ui.label("Empty: as configured; with adjust, as at present.").classes("text-xs")
        with ui.row():
            buttons = [
                ui.button(action.capitalize(), on_click=lambda action=action: send(action))
                for action in ("start", "engage", "adjust")
            ]
            record = ui.button("Record", on_click=lambda: station.record(page), color="secondary")
        answer = ui.label("").classes("answer font-medium").props('role="status" aria-live="polite"')

    def draw(_: Look) -> None:
        commands = station.holder == page
        for element in (*buttons, *fields.values()):
            element.set_enabled(commands)
        recording = station.views.recording()
        record.set_enabled(commands and recording is not None)
        record.set_text("No recorder" if recording is None else "End recording" if recording else "Record")
        answer.set_text(station.answer())

    return draw


def _plan() -> Draw:
    with ui.card().classes("items-center"):
        plan = ui.html("", sanitize=False).classes("w-full")

    def draw(look: Look) -> None:
        plan.set_content(look.plan)

    return draw


def _scene() -> Draw:
    with (
        ui.card().classes("p-1"),
        ui.scene(height=320, grid=(80, 80), fps=10, background_color="#8d99a1").classes("w-full") as scene,
    ):
        body = scene.point_cloud([[0.0, 0.0, -10.0]], [[0.2, 0.6, 0.3]], point_size=0.06)
        drone = scene.box(0.5, 0.5, 0.12).material("#e67e22")
        nose = scene.box(0.3, 0.06, 0.06).material("#c0392b")
        scene.move_camera(x=-6, y=-7, z=4, look_at_x=0, look_at_y=0, look_at_z=1, duration=0)

    def draw(look: Look) -> None:
        if look.body is not None and len(look.body):
            body.set_points(np.round(look.body, 3).tolist(), [[0.2, 0.6, 0.3]] * len(look.body))
        if np.isfinite(look.vehicle).all() and look.turn is not None:
            turn = np.round(look.turn, 4)
            for part, ahead in ((drone, 0.0), (nose, 0.4)):
                part.move(*np.round(look.vehicle + ahead * turn[:, 0], 3).tolist())
                part.rotate_R(turn.tolist())

    return draw


def _facts() -> Draw:
    with ui.card():
        facts = ui.html("", sanitize=False).classes("w-full")

    def draw(look: Look) -> None:
        rows = [f"<b>{name}</b><span>{html.escape(words)}</span>" for name, words in look.facts.items()]
        for name, age_s in look.ages.items():
            text = "never" if age_s == float("inf") else f"{age_s:.1f} s ago"
            old = ' class="text-negative"' if age_s > OLD_S else ""
            rows.append(f"<b>{name}</b><span{old}>{text}</span>")
        facts.set_content(f'<div class="facts">{"".join(rows)}</div>')

    return draw


def _table(title: str, columns: tuple[str, ...], rows: Callable[[], list[dict[str, str]]]) -> Draw:
    with ui.card().classes("wide"), ui.expansion(title, value=True).classes("w-full"):
        shape = [{"name": name, "label": name, "field": name, "align": "left"} for name in columns]
        table = ui.table(columns=shape, rows=[], row_key=columns[0]).props("dense flat wrap-cells").classes("w-full")
        table.add_slot(
            "body-cell-state",
            '<q-td :props="props"><q-badge :color="props.row.colour">{{ props.value }}</q-badge></q-td>',
        )

    def draw(_: Look) -> None:
        if (found := rows()) != table.rows:
            table.rows = found

    return draw


def _preflight(station: Station) -> Draw:
    def rows() -> list[dict[str, str]]:
        return [
            {
                "check": finding.name, "state": finding.level.name.lower(), "colour": _LEVELS[finding.level.name],
                "found": finding.found, "wanted": finding.wanted, "how to mend it": finding.remedy,
            }
            for finding in station.findings
        ]  # fmt: skip

    return _table("Preflight", ("check", "state", "found", "wanted", "how to mend it"), rows)


def _nodes(station: Station) -> Draw:
    columns = ("node", "state", "Hz", "latency, ms (p50 / p95 / p99)", "status", "counts")
    return _table("Nodes", columns, station.views.nodes)
