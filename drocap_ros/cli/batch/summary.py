"""``summary.html`` of a batch: a table of its recordings, sortable, without a network."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from pathlib import Path
from urllib.parse import quote

from drocap_ros.cli.batch.recording import Record

#: Title, explanation, key of the record, factor, format.
_COLUMNS = (
    ("doubts", "automatic checks that doubt the motion", "doubts", 1, "d"),
    ("error", "median reprojection error, % of the body's size in the image", "error_body", 100, ".2f"),
    ("seen", "frames with a subject, %", "seen", 100, ".0f"),
    ("bones", "spread of bone lengths, %", "bone_spread", 100, ".1f"),
    ("view", "range of the view of the body, degrees", "view_span_deg", 1, ".0f"),
    ("length", "s", "duration_s", 1, ".1f"),
    ("time", "of the reconstruction, s", "seconds", 1, ".1f"),
    ("memory", "peak, MB", "peak_memory_mb", 1, ".0f"),
)

_STYLE = """
body { font: 15px/1.45 system-ui, sans-serif; margin: 2em auto; max-width: 80em; padding: 0 1em }
table { border-collapse: collapse; width: 100% }
th, td { padding: .25em .6em; border-bottom: 1px solid #8884; text-align: right; vertical-align: top }
th { cursor: pointer; position: sticky; top: 0; background: Canvas }
th:first-child, td:first-child, th:last-child, td:last-child { text-align: left }
tr.failed td { color: #b3261e }
:root { color-scheme: light dark }
@media (prefers-color-scheme: dark) { tr.failed td { color: #f2b8b5 } }
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
    heads = "".join(f'<th title="{escape(text)}">{title}</th>' for title, text, *_ in _COLUMNS)
    rows = "\n".join(map(_row, sorted(records, key=_doubtfulness)))
    page = f"""<!doctype html>
<html lang="en"><meta charset="utf-8"><meta name="viewport" content="width=device-width">
<title>drocap batch: {total} recordings</title>
<style>{_STYLE}</style>
<h1>{total} recordings</h1>
<p>{len(records) - failures} done, {failures} failed, {total - len(records)} to do.
A click on a column's title sorts.</p>
<table><thead><tr><th>recording</th>{heads}<th>remarks</th></tr></thead>
<tbody>
{rows}
</tbody></table>
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
    cells = "".join(_cell(record.get(key), factor, form) for _, _, key, factor, form in _COLUMNS)
    remarks = [record["error"]] if "error" in record else [*record["doubts"], *record["messages"]]
    title = escape(record["input"])
    text = escape("; ".join(remarks))
    return f'<tr class="{record["status"]}"><td title="{title}">{link}</td>{cells}<td>{text}</td></tr>'


def _cell(value: float | list[str] | None, factor: float, form: str) -> str:
    if value is None:
        return '<td data-v="Infinity"></td>'
    return f"<td>{factor * (len(value) if isinstance(value, list) else value):{form}}</td>"
