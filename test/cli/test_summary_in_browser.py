"""The summary of a batch in a real browser: units, sorting, narrow and dark, without network."""

import pytest
from browser import Browser, chromium

from drocap_ros.cli.batch_recording import save_summary

pytestmark = pytest.mark.skipif(chromium() is None, reason="no Chromium or Chrome on this machine")


def done(name, doubts, error_body):
    figures = {"error_body": error_body, "seen": 1.0, "bone_spread": 0.01, "view_span_deg": 200.0, "duration_s": 9.0}
    costs = {"seconds": 3.0, "peak_memory_mb": 300.0}
    page = {"page": f"{name}/report.html", "messages": []}
    return {"input": f"/season/{name}.mp4", "status": "done", "doubts": doubts, **figures, **costs, **page}


@pytest.mark.parametrize("width", [1600, 390])
@pytest.mark.parametrize("dark", [False, True])
def test_the_table_sorts_and_fits_without_errors_or_network(tmp_path, width, dark):
    failed = {"input": "/season/broken.mp4", "status": "failed", "error": "expected a video, found text; name a video"}
    save_summary(tmp_path / "summary.html", [done("walk", [], 0.02), failed, done("run", ["Short sequence"], 0.01)], 4)
    browser = Browser(tmp_path / "profile")
    try:
        browser.open(tmp_path / "summary.html", width, 900, dark=dark)
        names = '[...document.querySelectorAll("tbody tr")].map((row) => row.cells[0].textContent)'
        assert browser.run(names) == ["broken.mp4", "run.mp4", "walk.mp4"]
        heads = browser.run('[...document.querySelectorAll("th")].map((head) => head.innerText.split("\\n"))')
        assert [head[1] for head in heads if len(head) > 1 and head[1]] == [
            "% of body",
            "% of frames",
            "% spread",
            "°",
            "s",
            "s",
            "MB",
        ]
        browser.run('document.querySelectorAll("th")[2].click()')
        first = browser.run(names)
        browser.run('document.querySelectorAll("th")[2].click()')
        assert {first[0], browser.run(names)[0]} == {"broken.mp4", "run.mp4"}  # unknown is last of one order
        assert browser.run("document.documentElement.scrollWidth") <= width
        light = sum(map(int, browser.run("getComputedStyle(document.body).backgroundColor.match(/\\d+/g)")))
        assert (light < 200) == dark
        assert browser.errors == []
        assert all(url.startswith("file:") for url in browser.requests)
    finally:
        browser.close()
