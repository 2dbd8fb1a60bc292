"""The git revision of the running code."""

from __future__ import annotations

import subprocess
from functools import lru_cache
from pathlib import Path

#: Written by setup.py and CMakeLists.txt into an installed package.
FILE = "git_revision.txt"


@lru_cache(maxsize=1)
def git_revision() -> str | None:
    """Revision of the checkout, or of the one that was installed; ``+`` after it = with changes; None = unknown."""
    package = Path(__file__).resolve().parent
    if (package / FILE).is_file():
        return (package / FILE).read_text(encoding="ascii").strip() or None
    if not (package.parent / ".git").exists():
        return None

    def git(*words: str) -> str:
        command = ["git", "--no-optional-locks", "-C", str(package), *words]
        return subprocess.run(command, capture_output=True, text=True, timeout=5, check=True).stdout.strip()

    try:
        return git("rev-parse", "HEAD") + ("+" if git("status", "--porcelain", "--untracked-files=no") else "")
    except (OSError, subprocess.SubprocessError):
        return None


if __name__ == "__main__":
    print(git_revision() or "")
