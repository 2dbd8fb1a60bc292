"""Results of the live study as Markdown."""

from __future__ import annotations

import numpy as np

from drocap_ros.evaluation.tables import markdown_table
from lab.studies.live_study import REFINED_AFTER_S, LiveRow


def live_markdown(rows: list[LiveRow], delay_s: float) -> str:
    """Means over the sequences, then a line per sequence, as Markdown."""
    first = rows[0]
    kind = "noisy" if first.noisy else "clean"

    def mean(name: str) -> float:
        return float(np.mean([getattr(row, name) for row in rows]))

    head = f"Live, {len(rows)} sequences, {first.speed_deg_s:g} deg/s, {kind} 2D, solutions {delay_s:g} s late."
    ratio = mean("refined_mm") / mean("offline_mm")
    means = [
        ["pose3d/initial when published, all images", f"{mean('initial_mm'):.1f}"],
        ["pose3d/latest when published, all images", f"{mean('latest_mm'):.1f}"],
        [f"pose3d/refined {REFINED_AFTER_S:g} s after the image", f"{mean('refined_mm'):.1f}"],
        ["offline (ba), the same images", f"{mean('offline_mm'):.1f}"],
        ["offline (ba), all images", f"{mean('offline_all_mm'):.1f}"],
    ]
    others = [
        ["refined over offline, the same images", f"{ratio:.3f}"],
        ["standardized error, refined / initial", f"{mean('refined_std'):.2f} / {mean('initial_std'):.2f}"],
        ["most that a solution moves a joint of latest per image, mm", f"{max(r.step_mm for r in rows):.1f}"],
        ["initial pose of an image, ms, median / p95", f"{mean('initial_ms'):.1f} / {mean('initial_p95_ms'):.1f}"],
        ["adjustment, s, p95", f"{mean('solve_p95_s'):.2f}"],
    ]
    columns = {
        "initial": "initial_mm",
        "latest": "latest_mm",
        "refined": "refined_mm",
        "offline": "offline_mm",
        "std. refined": "refined_std",
        "std. initial": "initial_std",
    }
    lines = [head, "", *markdown_table(["what", "mm"], means), "", *markdown_table(["what", "value"], others), ""]
    lines += markdown_table(
        ["sequence", *columns],
        [[row.sequence, *(f"{getattr(row, n):.{2 if 'std' in n else 1}f}" for n in columns.values())] for row in rows],
    )
    return "\n".join(lines) + "\n"
