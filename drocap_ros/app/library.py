"""What a folder holds: clips, and motions with their videos, images and corrections."""

from __future__ import annotations

import functools
import shlex
import shutil
import tempfile
import threading
import weakref
from dataclasses import dataclass
from pathlib import Path

from drocap_ros.corrections import FILE as CORRECTIONS
from drocap_ros.corrections import corrected, load_corrections, parse_corrections
from drocap_ros.errors import DrocapError, InputError
from drocap_ros.file_kind import FileKind, file_kind
from drocap_ros.motion import FILE, Motion, beside, load_motion, people_files
from drocap_ros.parameters import Values
from drocap_ros.report.checks import quality_sentence, run_checks
from drocap_ros.report.motion_images import FollowingBox, ShownTracks, each_image
from drocap_ros.report.page import images_of_page
from drocap_ros.report.statistics import motion_statistics
from drocap_ros.tracks import Tracks, load_tracks

#: Longer side (px) of the pictures of a clip that is corrected.
_LONG_SIDE = 1600
#: Most pictures that are kept on the disk for one clip: ten minutes at 30 Hz.
_MOST_PICTURES = 18_000


def clips(folder: Path) -> list[Path]:
    """Videos of a folder, by their names."""
    files = (path for path in sorted(folder.iterdir()) if path.is_file() and not path.name.startswith("."))
    return [path for path in files if file_kind(path) is FileKind.VIDEO]


@dataclass(frozen=True)
class Entry:
    """A motion of the library, as one camera sees it; ``name`` is its path below the library, for people."""

    file: Path
    name: str

    @property
    def folder(self) -> Path:
        """What is exported, reported and solved as a whole: of several persons the folder of all."""
        own = self.file.parent
        several = own.name.startswith("person_") and self.file in people_files(own.parent).values()
        return own.parent if several else own

    @property
    def motion(self) -> Motion:
        """The motion as it is now."""
        return _motion(self.file, self.file.stat().st_mtime_ns)

    @property
    def tracks(self) -> Tracks:
        """Its tracks before corrections."""
        path = beside(self.file, "tracks.npz")
        return _tracks(path, path.stat().st_mtime_ns if path.exists() else 0)

    @property
    def report(self) -> Path:
        """Its page; of one of several persons that of all."""
        return self.folder / "report.html"

    @property
    def quality(self) -> str:
        """The sentence of the summary, or why there is none."""
        try:
            return _quality(self.file, self.file.stat().st_mtime_ns)
        except (DrocapError, OSError) as error:
            return str(error)

    @property
    def thumbnail(self) -> bytes | None:
        """A JPEG of its middle; None = the report has no images."""
        images = images_of_page(self.report, self.motion)
        return images.jpegs[len(images.jpegs) // 2] if images else None

    @property
    def video(self) -> Path | None:
        """The clip that it was made from, where it can be found: as the command named it, or beside the motion."""
        words = shlex.split(str(self.motion.meta.get("command", "")))
        name = str(self.motion.meta.get("input", ""))
        near = [parent / name for parent in self.file.parents[:4] if name]
        named = [Path(word) for word in words if Path(word).name == name]
        usable = (path for path in (*named, *near) if path.exists() and path.suffix != ".npz")
        return next(usable, None)

    @property
    def pictures(self) -> Pictures:
        """Its images, of the clips that pages have shown last."""
        return _pictures(self, beside(self.file, "tracks.npz").stat().st_mtime_ns)

    @property
    def corrections_file(self) -> Path:
        """It need not exist."""
        return beside(self.file, CORRECTIONS)

    def corrections(self) -> Values:
        """The entries of the file; none without one."""
        return dict(load_corrections(self.corrections_file).values) if self.corrections_file.exists() else {}

    def corrected(self, corrections: Values) -> Tracks:
        """The tracks as they are meant, but for other persons, whom only the solution looks for."""
        try:
            return corrected(self.tracks, parse_corrections({**corrections, "person": []}))
        except InputError as error:
            raise InputError(f"{self.corrections_file}: {error}") from None

    def words(self, models: Path | None) -> list[str]:
        """The command that solves it again, from its tracks and its corrections, with the options it had.

        Persons of the same images, and recordings of one person, are solved again together.
        """
        folder = self.folder
        if people := list(people_files(folder).values()):
            words, solved, videos = [str(folder), "--all"], people, [self.video]
        else:
            solved = [folder / FILE, *further_cameras(folder)]
            words = [str(beside(file, "tracks.npz")) for file in solved] + ["--together"] * (len(solved) > 1)
            videos = [Entry(file, "").video for file in solved]
        words += [word for video in videos for word in ("--video", str(video)) if all(videos)]
        words += ["--corrections", str(folder)] if any(beside(file, CORRECTIONS).exists() for file in solved) else []
        words += ["--models", str(models)] if models else []
        given = shlex.split(str(self.motion.meta.get("command", "")))
        for option in ("--height", "--method", "--config", "--dictionary"):
            for at, word in enumerate(given):
                if word == option and at + 1 < len(given):
                    words += [option, given[at + 1]]
                elif word.startswith(f"{option}="):
                    words += [word]
        return ["reconstruct", *words, "--out", str(folder)]


def motions(folder: Path) -> list[Entry]:
    """Motions in the folders of a folder, those of the newest folder first; of several persons and cameras each."""
    found = [path for pattern in (f"*/{FILE}", f"*/person_*/{FILE}") for path in folder.glob(pattern)]
    found += [camera for path in found for camera in further_cameras(path.parent)]
    shown = {path.relative_to(folder): path for path in found}
    names = {str(name.parent if path.name == FILE else name.with_suffix("")): path for name, path in shown.items()}
    entries = [Entry(path, name) for name, path in names.items() if not name.startswith(".")]  # one is being written
    changed_ns: dict[Path, int] = {}
    for entry in entries:
        changed_ns[entry.folder] = max(entry.file.stat().st_mtime_ns, changed_ns.get(entry.folder, 0))
    return sorted(entries, key=lambda entry: (-changed_ns[entry.folder], entry.name))


def further_cameras(folder: Path) -> list[Path]:
    """The motion of a folder as the second and further cameras see it."""
    numbered = {path.stem.removeprefix("camera_"): path for path in folder.glob("camera_*.npz")}
    return [numbered[number] for number in sorted(filter(str.isdecimal, numbered), key=int)]


@functools.lru_cache(maxsize=8)
def _motion(path: Path, _changed_ns: int) -> Motion:
    return load_motion(path)


@functools.lru_cache(maxsize=2)
def _tracks(path: Path, _changed_ns: int) -> Tracks:
    return load_tracks(path)


@functools.lru_cache(maxsize=4)
def _pictures(entry: Entry, _changed_ns: int) -> Pictures:
    return Pictures(entry)


@functools.lru_cache(maxsize=1000)
def _quality(path: Path, changed_ns: int) -> str:
    motion = _motion(path, changed_ns)
    return quality_sentence(run_checks(motion, motion_statistics(motion)))


class Pictures:
    """The images of a motion's tracks as JPEG files, read in a thread, whole and as crops about the person."""

    def __init__(self, entry: Entry) -> None:
        self._folder = Path(tempfile.mkdtemp(prefix="drocap_app_"))
        weakref.finalize(self, shutil.rmtree, self._folder, ignore_errors=True)  # at the program's end, too
        self.read, self.error = 0, ""
        tracks, box = entry.tracks, FollowingBox()
        self.scale, self.size = 1.0, tracks.image_size  # px of a picture per px of the clip
        self.boxes: list[tuple[int, int, int, int]] = [
            box(int(stamp_ns), keypoints, self.size[::-1])
            for stamp_ns, keypoints in zip(tracks.stamp_ns, tracks.keypoints, strict=True)
        ]
        shown = ShownTracks(tracks.stamp_ns, tracks.keypoints, entry.motion.meta)
        threading.Thread(target=self._fill, args=(entry.video, shown), daemon=True).start()

    def _fill(self, video: Path | None, shown: ShownTracks) -> None:
        import cv2

        if video is None:
            self.error = "the video of this motion is not found beside it"
            return
        try:
            for index, image in each_image(video, shown):
                if self.read >= _MOST_PICTURES:
                    return
                shrink = min(1.0, _LONG_SIDE / max(image.shape[:2]))
                small = cv2.resize(image, None, fx=shrink, fy=shrink, interpolation=cv2.INTER_AREA)
                jpeg = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, 85])[1]
                self.scale = shrink
                (self._folder / f"{index}.jpg").write_bytes(jpeg.tobytes())
                self.read = index + 1
        except (InputError, OSError) as error:
            self.error = str(error)

    def jpeg(self, index: int, close: bool) -> bytes | None:
        """An image, or the part about the person; None = it is not read yet, or there is none."""
        import cv2

        path = self._folder / f"{index}.jpg"
        if not path.exists():
            return None
        if not close:
            return path.read_bytes()
        image = cv2.imread(str(path))
        if image is None:
            return None
        x0, y0, x1, y1 = (round(self.scale * v) for v in self.boxes[index])
        return bytes(cv2.imencode(".jpg", image[y0:y1, x0:x1])[1].tobytes())
