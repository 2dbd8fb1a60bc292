"""Write docs/report.jpg, the picture of docs/report.md: ``python docs/make_report_picture.py REPORT [SECONDS [NAME]]``.

The upper part of a report in Chromium, at a time of its motion: ``make demo`` writes demo_out/report.html.  NAME is the
picture's, people.jpg for that of docs/people.md.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import cv2
import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT / "test" / "helpers")]

from browser import Browser  # noqa: E402

WIDTH_PX, HEIGHT_PX = 1600, 920


def main(report: Path, seconds: float = 13.3, name: str = "report.jpg") -> None:
    """Open the report, go to a time, and write the picture."""
    with tempfile.TemporaryDirectory() as profile:
        browser = Browser(Path(profile))
        try:
            browser.open(report.resolve(), WIDTH_PX, HEIGHT_PX)
            browser.run(f"show(frameAt({seconds}))")
            browser.settle()
            browser.settle()
            picture = cv2.imdecode(np.frombuffer(browser.screenshot(), np.uint8), cv2.IMREAD_COLOR)
        finally:
            browser.close()
    cv2.imwrite(str(ROOT / "docs" / name), picture, [cv2.IMWRITE_JPEG_QUALITY, 82])


if __name__ == "__main__":
    main(Path(sys.argv[1]), *map(float, sys.argv[2:3]), *sys.argv[3:4])
