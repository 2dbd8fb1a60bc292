"""``summary.html`` of a batch: a table of its recordings, sortable, without a network."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from importlib.resources import files
from pathlib import Path
from urllib.parse import quote

from drocap_ros.cli.batch.recording import Record

#: Title, unit, explanation, key of the record, factor, format.
_COLUMNS = (
    ("doubts", "", "automatic checks that doubt the motion", "doubts", 1, "d"),
    (
        "error",
        "% of body",
        "median reprojection error, share of the body's size in the image",
        "error_body",
        100,
        ".2f",
    ),
    ("seen", "% of frames", "frames with a subject", "seen", 100, ".0f"),
    ("bones", "% spread", "spread of bone lengths", "bone_spread", 100, ".1f"),
    ("view", "°", "range of the view of the body", "view_span_deg", 1, ".0f"),
    ("length", "s", "of the recording", "duration_s", 1, ".1f"),
    ("time", "s", "of the reconstruction", "seconds", 1, ".1f"),
    ("memory", "MB", "peak", "peak_memory_mb", 1, ".0f"),
)

#: On top of the report's style.
_STYLE = """
body { max-width: 1560px }
.tiles { grid-template-columns: repeat(3, minmax(0, 180px)); margin-bottom: 14px }
.card { overflow-x: auto }
td, th { padding: 7px 14px; text-align: right; width: auto; white-space: nowrap }
th { cursor: pointer; border-bottom: 2px solid var(--line) }
th:hover { color: var(--accent) }
th i { display: block; font-size: 11.5px; font-style: normal }
th:first-child, td:first-child, th:last-child, td:last-child { text-align: left }
td:first-child, th:first-child { position: sticky; left: 0; background: var(--card) }
td:first-child { max-width: min(40vw, 26em); overflow: hidden; text-overflow: ellipsis }
td:last-child { min-width: 18em; white-space: normal }
td { font-variant-numeric: tabular-nums }
a { color: var(--accent) }
tr.failed td:last-child, tr.failed td:first-child { color: var(--right) }
"""

_SCRIPT = """
for (const [column, head] of document.querySelectorAll("th").entries()) {
  let sign = 1;
  head.onclick = () => {
    const body = document.querySelector("tbody");
    const value = (row) => row.cells[column].dataset.v ?? row.cells[column].textContent;
    const compare = (a, b) => a - b || String(a).localeCompare(b);
    sign = -sign;
    body.append(...[...body.rows].sort((a, b) => sign * compare(value(a), value(b))));
  };
}
"""


def save_summary(path: Path, records: Sequence[Record], total: int) -> None:
    """Write the page: failures first, then the most doubtful motions.

    records : of the recordings so far, of ``total``
    """
    failures = sum(record["status"] != "done" for record in records)
    style = (files("drocap_ros.report") / "page" / "style.css").read_text(encoding="utf-8") + _STYLE
    heads = "".join(f'<th title="{escape(text)}">{title}<i>{unit}</i></th>' for title, unit, text, *_ in _COLUMNS)
    counts = {"done": len(records) - failures, "failed": failures, "to do": total - len(records)}
    tiles = "".join(f'<div class="tile"><b>{count}</b><span>{name}</span></div>' for name, count in counts.items())
    rows = "\n".join(map(_row, sorted(records, key=_doubtfulness)))
    page = f"""<!doctype html>
<html lang="en"><meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="color-scheme" content="light dark">
<title>drocap batch: {total} recordings</title>
<style>{style}</style>
<header><h1>{total} recordings</h1><p>A name opens its report, a click on a column's title sorts.</p></header>
<section class="tiles">{tiles}</section>
<section class="card"><table><thead><tr><th>recording</th>{heads}<th>remarks</th></tr></thead>
<tbody>
{rows}
</tbody></table></section>
<script>{_SCRIPT}</script>
</html>
"""
    path.write_text(page, encoding="utf-8", errors="backslashreplace")


def _doubtfulness(record: Record) -> tuple[bool, int, float, str]:
    doubts, error = len(record.get("doubts", ())), record.get("error_body") or 0.0
    return record["status"] == "done", -doubts, -error, record["input"]


def _row(record: Record) -> str:
    name = escape(Path(record["input"]).name)
    link = f'<a href="{quote(record["page"])}">{name}</a>' if "page" in record else name
    cells = "".join(_cell(record.get(key), factor, form) for *_, key, factor, form in _COLUMNS)
    remarks = [record["error"]] if "error" in record else [*record["doubts"], *record["messages"]]
    title = escape(record["input"])
    text = escape("; ".join(remarks))
    return f'<tr class="{record["status"]}"><td title="{title}">{link}</td>{cells}<td>{text}</td></tr>'


def _cell(value: float | list[str] | None, factor: float, form: str) -> str:
    if value is None:
        return '<td data-v="Infinity"></td>'
    return f"<td>{factor * (len(value) if isinstance(value, list) else value):{form}}</td>"
