"""Exports: every format with its options, and what opens it."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

from nicegui import ui

from drocap_ros.app.jobs import Job, Work
from drocap_ros.export import FORMATS, RIGGED

if TYPE_CHECKING:
    from drocap_ros.app.library import Entry

#: Format -> programs that open it.
OPENED_BY = {
    "bvh": "Blender, Maya, MotionBuilder, Unity",
    "c3d": "Mokka, Visual3D, MATLAB",
    "trc": "OpenSim",
    "csv": "Excel, R, pandas",
    "csv-angles": "Excel, R, pandas",
    "glb": "Blender, three.js, Windows 3D Viewer, Godot",
    "mot": "OpenSim, with the .osim beside it",
    "usd": "Blender, usdview, Omniverse, Unreal",
    "fbx": "Unreal, Unity, Maya; Blender writes it (pip install bpy)",
}


class Exports:
    """The part of the page that writes a motion for other programs."""

    def __init__(self, entry: Entry, work: Work) -> None:
        self._entry, self._work = entry, work
        with ui.column().classes("w-full max-w-xl"):
            labels = {form: f"{form}: {facts}" for form, facts in FORMATS.items()}
            self._form = ui.select(labels, label="Format", value="bvh").classes("w-full")
            ui.label().bind_text_from(self._form, "value", lambda form: f"Opened by {OPENED_BY[form]}.")
            with ui.row().bind_visibility_from(self._form, "value", lambda form: form in RIGGED):
                names = ["h36m", "lafan1", "mixamo", "mixamo-three"]
                self._names = ui.select(names, label="Names of the joints", value="h36m").classes("w-48")
                self._rest = ui.select({"t": "T pose", "a": "A pose"}, label="Rest pose", value="t").classes("w-32")
            self._smooth = ui.number("Low-pass filter, Hz (empty: none)", min=0.5, max=60, step=0.5).classes("w-64")
            self._lock = ui.checkbox("Resting feet keep their place")
            ui.button("Export", on_click=self._export)

    async def _export(self) -> None:
        form = str(self._form.value)
        ending, *kind = form.split("-")
        with tempfile.TemporaryDirectory(prefix="drocap_app_") as folder:
            out = Path(folder) / ".".join([self._entry.name.replace("/", "_"), *kind, ending])
            words = ["export", str(self._entry.file), "--to", form, "--out", str(out)]
            if form in RIGGED:
                words += ["--names", str(self._names.value), "--rest", str(self._rest.value)]
            words += ["--smooth", f"{self._smooth.value:g}"] if self._smooth.value else []
            words += ["--lock-feet"] if self._lock.value else []
            if await self._work(Job(words)):
                for path in sorted(Path(folder).iterdir()):  # a model stands beside its motion
                    ui.download.content(path.read_bytes(), path.name)
