"""Download of a known model: resumable, verified before installation."""

from __future__ import annotations

import hashlib
import os
import shutil
import tempfile
import urllib.error
import urllib.request
import zipfile
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path

from drocap_ros.errors import InputError
from drocap_ros.perception.models.registry import KnownModel
from drocap_ros.perception.models.wheel import FetchError, Package, fetch_member

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
    matched.  Of a package pip downloads the wheel, and the network in it is converted.

    Raises FetchError when the network, the server or the checksum fails.
    """
    target = folder / model.file
    if target.is_file() and (model.package or sha256_of(target) == model.sha256):
        return target
    if model.package:
        _convert(model, model.package, target)
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


def _convert(model: KnownModel, package: Package, target: Path) -> None:
    """Fetch a wheel and write its network as ONNX."""
    from drocap_ros.perception.models.blazepose import write_blazepose

    if find_spec("onnx") is None:
        raise InputError(f"{model.name}: expected the package onnx, which writes it, found none; run pip install onnx")
    target.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / Path(model.member).name
        fetch_member(package, model.member, file)
        write_blazepose(file, target)


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
