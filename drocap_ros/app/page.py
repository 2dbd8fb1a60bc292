"""The page: clips, the library, and of the chosen motion the report, its corrections and exports."""

from __future__ import annotations

import asyncio
import secrets
import socket
import threading
from pathlib import Path

from nicegui import ui

from drocap_ros.app.clips import Clips
from drocap_ros.app.correct import Correct
from drocap_ros.app.desk import Desk, tell
from drocap_ros.app.exports import Exports
from drocap_ros.app.jobs import Job
from drocap_ros.app.library import Entry, motions
from drocap_ros.app.serving import serve
from drocap_ros.errors import DrocapError


class Page:
    """One browser's page."""

    def __init__(self, desk: Desk) -> None:
        self._desk = desk
        self._entry: Entry | None = None
        ui.add_css(_STYLE)
        with ui.header().classes("items-center justify-between py-1"):
            ui.label("drocap").classes("text-lg font-bold")
            ui.label(str(desk.folder)).classes("text-sm opacity-80")
            self._dark = ui.dark_mode(None)
            ui.button(icon="contrast", on_click=self._dark.toggle).props(
                'flat round dense color=white aria-label="light or dark"'
            )
        with ui.element("div").classes("desk"):
            with ui.column().classes("side"):
                self._clips = Clips(desk, self._work, self._show_newest)
                ui.label("Motions").classes("text-base font-bold")
                self._library = ui.column().classes("w-full gap-2").props('role=list aria-label="motions"')
                self._said = ui.label().classes("said").props('aria-live=polite data-part="said"')
            self._main = ui.column().classes("main")
        self._client = ui.context.client
        self._refresh()
        for job in desk.jobs:
            self._watch(job)
        if found := motions(desk.folder):
            self._choose(found[0])
        else:
            with self._main:
                ui.label("Drop a video, or choose one, and press Reconstruct.").classes("text-base opacity-80 p-8")

    def _show_newest(self) -> None:
        """A motion was made."""
        self._choose(motions(self._desk.folder)[0])

    def _refresh(self) -> None:
        """Show the library as the folder is now."""
        self._library.clear()
        with self._library:
            for entry in motions(self._desk.folder):
                self._card(entry)

    def _card(self, entry: Entry) -> None:
        key, chosen = self._desk.key(entry), self._entry is not None and entry.name == self._entry.name
        card = ui.card().classes("w-full p-2 cursor-pointer" + (" chosen" if chosen else ""))
        card.props("tabindex=0 role=listitem")
        card.props["data-motion"] = entry.name
        for event in ("click", "keydown.enter"):
            card.on(event, lambda entry=entry: self._choose(entry))
        with card, ui.row().classes("items-center no-wrap w-full"):
            at = f"/library/{key}/thumbnail?{secrets.token_hex(4)}"
            image = f'<img class="thumb" alt="" onerror="this.style.opacity=0" src="{at}">'
            ui.html(image, sanitize=False).classes("shrink-0")
            with ui.column().classes("gap-0 min-w-0"):
                ui.label(entry.name).classes("font-bold break-all")
                quality = ui.label().classes("text-xs opacity-80")

        async def fill() -> None:  # checks of many motions take a while
            words = await asyncio.to_thread(lambda: entry.quality)
            if not quality.is_deleted:
                quality.text = words

        with card:
            ui.timer(0.0, fill, once=True)

    def _choose(self, entry: Entry) -> None:
        """Show a motion."""
        self._entry = entry
        self._main.clear()
        self._refresh()
        with self._main:
            with ui.tabs().classes("w-full") as tabs:
                names = [ui.tab(name) for name in ("Motion", "Correct", "Export")]
            with ui.tab_panels(tabs, value=names[0]).classes("w-full grow").props("keep-alive"):
                with ui.tab_panel(names[0]).classes("p-0"):
                    self._frame = ui.html(self._report(), sanitize=False).classes("report")
                with ui.tab_panel(names[1]):
                    try:
                        Correct(self._desk, entry, self._work, self._solved)
                    except DrocapError as error:
                        ui.label(str(error)).classes("text-negative")
                        if entry.corrections_file.exists():
                            ui.button("Delete the corrections", on_click=lambda: self._without_corrections(entry))
                with ui.tab_panel(names[2]):
                    Exports(entry, self._work)

    def _without_corrections(self, entry: Entry) -> None:
        entry.corrections_file.unlink(missing_ok=True)
        self._choose(entry)

    def _report(self) -> str:
        assert self._entry is not None
        at = f"/library/{self._desk.key(self._entry)}/report?{secrets.token_hex(4)}"
        return f'<iframe title="report" src="{at}"></iframe>'

    def _solved(self) -> None:
        """The chosen motion has changed."""
        self._frame.set_content(self._report())
        self._refresh()

    def _watch(self, job: Job) -> None:
        """Show the progress of a job, of whichever page, until it ends."""
        with ui.dialog().props("persistent") as dialog, ui.card().classes("w-96"):
            title = ui.label(job.words[0].capitalize()).classes("text-base font-bold")
            bar = ui.linear_progress(0.0, show_value=False).props("instant-feedback")
            ui.label(job.command).classes("text-xs opacity-70 break-all font-mono")
            ui.button("Cancel", on_click=job.cancel)

        def show() -> None:
            if job.status is not None:
                timer.cancel()
                dialog.close()
                dialog.delete()
                self._refresh()
                return
            bar.props("indeterminate" if job.share < 0 else "", remove="" if job.share < 0 else "indeterminate")
            bar.value = max(job.share, 0.0)
            title.text = f"{job.stage} {100 * job.share:.0f} %" if job.share >= 0 else job.stage or "begins"

        timer = ui.timer(0.2, show)
        dialog.open()

    async def _work(self, job: Job) -> bool:
        """Run a command with its progress on the page; returns whether it went well."""
        self._desk.jobs.append(job)
        self._watch(job)
        try:
            status = await job.run()
        finally:
            self._desk.jobs.remove(job)
        if self._client.is_deleted:  # it was closed meanwhile
            return False
        self._said.text = "\n".join([job.command, *job.lines])
        told = [line.removeprefix("drocap: ") for line in job.lines if line.startswith("drocap: ")]
        if status not in (0, 130):
            tell(told[-1] if told else f"{job.command}: ended with status {status}", "negative")
        elif status == 0 and told:
            tell("\n".join(told))
        return status == 0


def run(folder: Path, models: Path | None, sock: socket.socket, stop: threading.Event) -> None:
    """Serve the page until ``stop`` or a signal."""
    desk = Desk(folder, models)

    serve(lambda _: ui.page("/", title="drocap")(lambda: Page(desk)), sock, stop)


_STYLE = """
.nicegui-content { padding: 0; }
.desk { display: grid; grid-template-columns: minmax(260px, 340px) 1fr; width: 100%; min-height: calc(100vh - 52px); }
.desk .side { padding: 12px; border-right: 1px solid #8884; overflow: auto; max-height: calc(100vh - 52px); }
.desk .main { padding: 0 12px 12px; min-width: 0; }
.told { max-width: 320px; overflow-wrap: anywhere; }
.chosen { outline: 2px solid var(--q-primary); }
.timeline { height: 84px; aspect-ratio: auto !important; }
.thumb { width: 64px; height: 64px; object-fit: cover; border-radius: 4px; background: #8883; }
.report, .report iframe { width: 100%; height: calc(100vh - 120px); border: 0; }
.said { white-space: pre-wrap; word-break: break-word; font: 11px monospace; opacity: 0.75; }
.persons { display: flex; flex-wrap: wrap; gap: 6px; }
@media (max-width: 800px) {
  .desk { grid-template-columns: 1fr; }
  .desk .side { border-right: 0; max-height: none; }
}
"""
