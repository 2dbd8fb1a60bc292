"""What all pages of one server share, and what the parts of a page ask of it."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol

from nicegui import app
from starlette.responses import FileResponse, HTMLResponse, Response

from drocap_ros.app.jobs import Job
from drocap_ros.app.library import Entry, Pictures


class Desk:
    """What all pages of one server share: the folder, the networks, pictures of the clips that are corrected."""

    def __init__(self, folder: Path, models: Path | None) -> None:
        self.folder, self.models = folder, models
        self._entries: dict[str, Entry] = {}
        self._pictures: dict[str, tuple[Pictures, int]] = {}
        app.get("/library/{key}/report")(self._report)
        app.get("/library/{key}/thumbnail")(self._thumbnail)
        app.get("/library/{key}/frame/{index}")(self._frame)

    def key(self, entry: Entry) -> str:
        """The name of an entry in addresses."""
        key = hashlib.sha256(entry.name.encode()).hexdigest()[:16]
        self._entries[key] = entry
        return key

    def _entry(self, key: str) -> Entry | None:
        return self._entries.get(key)

    def _report(self, key: str) -> Response:
        entry = self._entry(key)
        if entry is None or not entry.report.exists():
            return HTMLResponse("<p>no report: it was left out</p>", status_code=404)
        return FileResponse(entry.report, media_type="text/html", headers={"Cache-Control": "no-store"})

    def _thumbnail(self, key: str) -> Response:
        entry = self._entry(key)
        jpeg = entry.thumbnail if entry else None
        return Response(jpeg, media_type="image/jpeg") if jpeg else Response(status_code=404)

    def _frame(self, key: str, index: int, close: int = 0) -> Response:
        entry = self._entry(key)
        shown = self._pictures.get(key)
        jpeg = shown[0].jpeg(index, bool(close)) if entry and shown else None
        return Response(jpeg, media_type="image/jpeg") if jpeg else Response(status_code=404)

    def open_pictures(self, entry: Entry) -> Pictures:
        """The pictures of a clip, shared by all pages that show it, until each has closed them."""
        key = self.key(entry)
        pictures, users = self._pictures.get(key) or (Pictures(entry), 0)
        self._pictures[key] = pictures, users + 1
        return pictures

    def close_pictures(self, entry: Entry) -> None:
        """A page shows them no more."""
        key = self.key(entry)
        if key in self._pictures:
            pictures, users = self._pictures.pop(key)
            if users > 1:
                self._pictures[key] = pictures, users - 1
            else:
                pictures.close()

    def close(self) -> None:
        """Remove what was kept for the pages."""
        for pictures, _ in self._pictures.values():
            pictures.close()
        self._pictures.clear()


class Host(Protocol):
    """The page, for its parts."""

    desk: Desk

    async def work(self, job: Job, done: Callable[[], Any] | None = None) -> bool:
        """Run a command with its progress on the page; returns whether it went well."""

    def show_newest(self) -> None:
        """A motion was made."""

    def solved(self) -> None:
        """The chosen motion has changed."""
