"""What all pages of one server share."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Literal

from nicegui import app, ui
from starlette.responses import FileResponse, HTMLResponse, Response

from drocap_ros.app.jobs import Job
from drocap_ros.app.library import Entry


class Desk:
    """What all pages of one server share: the folder, the networks, jobs.

    jobs : that run; a page that was closed leaves its own to those that are opened
    """

    def __init__(self, folder: Path, models: Path | None) -> None:
        self.folder, self.models = folder, models
        self.jobs: list[Job] = []
        self._entries: dict[str, Entry] = {}
        app.get("/library/{key}/report")(self._report)
        app.get("/library/{key}/thumbnail")(self._thumbnail)
        app.get("/library/{key}/frame/{index}")(self._frame)

    def key(self, entry: Entry) -> str:
        """The name of an entry in addresses."""
        key = hashlib.sha256(entry.name.encode()).hexdigest()[:16]
        self._entries[key] = entry
        return key

    def _report(self, key: str) -> Response:
        entry = self._entries.get(key)
        if entry is None or not entry.report.exists():
            return HTMLResponse("<p>no report: it was left out</p>", status_code=404)
        return FileResponse(entry.report, media_type="text/html", headers={"Cache-Control": "no-store"})

    def _thumbnail(self, key: str) -> Response:
        entry = self._entries.get(key)
        jpeg = entry.thumbnail if entry else None
        return Response(jpeg, media_type="image/jpeg") if jpeg else Response(status_code=204)

    def _frame(self, key: str, index: int, close: int = 0) -> Response:
        entry = self._entries.get(key)
        jpeg = entry.pictures.jpeg(index, bool(close)) if entry else None
        return Response(jpeg, media_type="image/jpeg") if jpeg else Response(status_code=404)


def tell(words: str, kind: Literal["warning", "negative"] = "warning") -> None:
    """Say something over the side, which covers no control of the work; what went wrong stays until it is read."""
    ui.notify(words, type=kind, position="bottom-left", multi_line=True, close_button="Close", classes="told",
              timeout=0 if kind == "negative" else 6000)  # fmt: skip
