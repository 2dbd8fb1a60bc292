"""Clips: the choice of files and of a person, stature, lens and log, and the command that makes the motion."""

from __future__ import annotations

import base64
import itertools
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path

from nicegui import events, ui

from drocap_ros.app.desk import Desk, tell
from drocap_ros.app.jobs import Job, Work
from drocap_ros.app.library import clips
from drocap_ros.perception.load_models import models_folder
from drocap_ros.perception.models.runtime import network_files
from drocap_ros.recording.telemetry.read import LOG_SUFFIXES


class Clips:
    """The part of the page that makes motions."""

    def __init__(self, desk: Desk, work: Work, made: Callable[[], None]) -> None:
        self._desk, self._work, self._made, self._person = desk, work, made, ""
        ui.label("Clips").classes("text-base font-bold")
        ui.upload(label="Drop videos and logs here", multiple=True, auto_upload=True, on_upload=self._keep).classes(
            "w-full"
        ).props("flat bordered")
        self._files = ui.select([], label="Videos; several show one person together", multiple=True).classes("w-full")
        self._files.on_value_change(self._forget_persons)
        with ui.row().classes("w-full no-wrap"):
            self._height = ui.number("Stature, m", min=0.5, max=2.5, step=0.01).classes("w-1/2")
            self._fov = ui.number("Lens, degrees wide", min=5, max=170, step=1).classes("w-1/2")
        self._log = ui.select([""], label="Log of the flight", value="").classes("w-full")
        self._persons = ui.element("div").classes("persons").props('role=radiogroup aria-label="persons"')
        with ui.row():
            find = ui.button("Find persons", on_click=self._find).props("outline")
            ui.button("Reconstruct", on_click=self._reconstruct)
        for of_one in (self._fov, self._log, find):
            of_one.bind_enabled_from(self._files, "value", lambda names: len(names or []) < 2)
        self._models_missing()
        self.refresh()

    def refresh(self) -> None:
        """Show the files as the folder has them now."""
        folder = self._desk.folder
        self._files.set_options([path.name for path in clips(folder)])
        logs = sorted(path.name for path in folder.iterdir() if path.suffix.lower() in LOG_SUFFIXES)
        self._log.set_options({"": "none but the video's own", **{name: name for name in logs}})

    def _models_missing(self) -> None:
        if network_files(models_folder(self._desk.models)):
            return
        with ui.card().classes("w-full p-2") as card:
            ui.label("No networks are installed yet; they are fetched from their publishers once.").classes("text-sm")

            async def fetch() -> None:
                if await self._work(Job(["models", "fetch"])):
                    card.delete()

            ui.button("Fetch the networks", on_click=fetch).props("outline")

    async def _keep(self, event: events.UploadEventArguments) -> None:
        """Save a file into the folder; one of its name stays, and the new one gets a number."""
        folder, name = self._desk.folder, Path(event.file.name.replace("\\", "/")).name
        path = _free(folder / name)
        try:
            await event.file.save(path)
        except OSError as error:
            tell(f"{name}: cannot be kept in {folder}: {error.strerror}", "negative")
            return
        self.refresh()
        if path.name in self._files.options:
            self._files.set_value([*(self._files.value or []), path.name])
        elif path.name in self._log.options:
            self._log.set_value(path.name)
        else:
            path.unlink()
            tell(f"{name}: expected a video or a flight log, found neither")

    def _chosen(self) -> list[Path]:
        names = self._files.value or []
        if not names:
            tell("expected a video, found none chosen; drop or choose one")
        return [self._desk.folder / name for name in names]

    def _models(self) -> list[str]:
        return ["--models", str(self._desk.models)] if self._desk.models else []

    def _forget_persons(self) -> None:
        self._person = ""
        self._persons.clear()

    async def _find(self) -> None:
        """Show a picture of each person of the first chosen video."""
        chosen = self._chosen()
        if not chosen:
            return
        folder = Path(tempfile.mkdtemp(prefix="drocap_app_"))
        try:
            job = Job(["track", str(chosen[0]), "--list", "--out", str(folder / "persons"), *self._models()])
            if await self._work(job):
                found = sorted((folder / "persons").glob("person_*.jpg"), key=lambda path: int(path.stem[7:]))
                self._show_persons({path.stem.removeprefix("person_"): path.read_bytes() for path in found})
        finally:
            shutil.rmtree(folder, ignore_errors=True)

    def _show_persons(self, pictures: dict[str, bytes]) -> None:
        self._forget_persons()
        buttons: dict[str, ui.button] = {}

        def choose(number: str) -> None:
            self._person = number
            for name, button in buttons.items():
                chosen = name == number
                button.props(f"aria-checked={str(chosen).lower()}", remove="outline" if chosen else "")
                if not chosen:
                    button.props("outline")

        with self._persons:
            for number, jpeg in {**pictures, "all": b""}.items():
                button = ui.button(on_click=lambda number=number: choose(number)).props(
                    f'outline stack padding=xs role=radio aria-label="person {number}" data-person="{number}"'
                )
                buttons[number] = button
                with button:
                    if jpeg:
                        data = base64.b64encode(jpeg).decode()
                        ui.html(f'<img alt="" style="height:96px" src="data:image/jpeg;base64,{data}">', sanitize=False)
                    ui.label(number if jpeg else "everybody")

    async def _reconstruct(self) -> None:
        """Make a motion of what is chosen."""
        chosen = self._chosen()
        if not chosen:
            return
        out = _free(chosen[0].with_name(f"{chosen[0].stem}_motion"))  # an older one may hold somebody's corrections
        words = ["reconstruct", *map(str, chosen), "--out", str(out), *self._models()]
        words += ["--height", f"{self._height.value:g}"] if self._height.value else []
        if len(chosen) > 1:
            words += ["--together"]
        else:
            words += ["--all"] if self._person == "all" else ["--subject", self._person] if self._person else []
            words += ["--fov", f"{self._fov.value:g}"] if self._fov.value else []
            words += ["--telemetry", str(self._desk.folder / self._log.value)] if self._log.value else []
        if await self._work(Job(words)):
            self._made()


def _free(path: Path) -> Path:
    """The path, with a number where something has its name."""
    return next(
        free for number in itertools.count(1)
        if not (free := path if number == 1 else path.with_stem(f"{path.stem}_{number}")).exists()
    )  # fmt: skip
