"""Study of what the adjustment in the world finds out about telemetry whose yaw and clock are wrong.

Sequences of the world protocol, an orbit that reverses once; the camera's yaw is off by 1 to 3 degrees about the
vertical, and attitude and position are both late.  The tracks hold fixed points of the scene, or the body alone.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from drocap_ros.evaluation.tables import markdown_table
from drocap_ros.reconstruction.reconstruct import reconstruct
from lab.studies.protocol import FPS, protocol_sequences, reported
from lab.studies.world_protocol import SHORTEST_S, TelemetryErrors, WorldCase, world_view

LATE_S = 0.08
#: Longest time of a run, and bounds within which an error counts as found.
SECONDS, YAW_DEG, LATENCY_S = 30.0, 0.5, 0.02
#: Standard deviations of a 95 % interval.
_INTERVAL = 1.96


@dataclass(frozen=True)
class CalibrationRow:
    """One run: true errors of the telemetry, and those found with their standard deviations (deg; s)."""

    sequence: str
    yaw_deg: float
    yaw_found_deg: float
    yaw_std_deg: float
    late_found_s: tuple[float, float]
    late_std_s: tuple[float, float]

    @property
    def yaw_error_deg(self) -> float:
        """Found less true."""
        return self.yaw_found_deg - self.yaw_deg

    @property
    def late_s(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """Latencies found and their standard deviations."""
        return self.late_found_s, self.late_std_s

    @property
    def late_errors_s(self) -> np.ndarray:
        """(2,) of attitude and position, found less true."""
        return np.array(self.late_found_s) - LATE_S


def calibration_study(
    folder: Path,
    *,
    runs: int,
    limit: int | None,
    background: bool,
    progress: Callable[[str, float], None],
) -> list[CalibrationRow]:
    """``runs`` flights over the folder's sequences in turn, each with a yaw error and noise of its own."""
    sequences = protocol_sequences(folder, shortest_s=SHORTEST_S, longest_s=SECONDS)[:limit]
    rows = []
    for run in reported(range(runs), runs, "calibration study", progress):
        sequence = sequences[run % len(sequences)]
        rng = np.random.default_rng([0, run])
        yaw = float(rng.uniform(1.0, 3.0) * rng.choice([-1.0, 1.0]))
        case = WorldCase(reverse_s=len(sequence.x) / FPS, background=background)
        view = world_view(sequence, case, TelemetryErrors(yaw_deg=yaw, late_s=LATE_S), seed=run)
        windows = reconstruct(view.tracks).meta.get("calibration")
        if windows:
            found = windows[0]
            rows.append(
                CalibrationRow(
                    sequence.name,
                    yaw,
                    -float(found["misalignment_deg"][1]),
                    float(found["misalignment_std_deg"][1]),
                    (float(found["attitude_latency_s"]), float(found["position_latency_s"])),
                    (float(found["attitude_latency_std_s"]), float(found["position_latency_std_s"])),
                )
            )
    return rows


def calibration_markdown(rows: list[CalibrationRow]) -> str:
    """Every run, and how many found the errors within the bounds and inside their own intervals, as Markdown."""
    cells = [
        [
            row.sequence, f"{row.yaw_deg:+.2f}", f"{row.yaw_found_deg:+.2f} +- {row.yaw_std_deg:.2f}",
            *(f"{1e3 * late:.0f} +- {1e3 * std:.0f}" for late, std in zip(*row.late_s, strict=True)),
        ]
        for row in rows
    ]  # fmt: skip
    head = [
        "sequence",
        "yaw error deg",
        "found deg",
        f"attitude late by {1e3 * LATE_S:.0f} ms, found",
        "position, found",
    ]
    yaw = np.array([row.yaw_error_deg for row in rows])
    late = np.array([row.late_errors_s for row in rows])
    yaw_std, late_std = np.array([row.yaw_std_deg for row in rows]), np.array([row.late_std_s for row in rows])
    lines = markdown_table(head, cells)
    lines += [
        "",
        f"Yaw within {YAW_DEG:g} degrees in {(np.abs(yaw) < YAW_DEG).sum()} of {len(rows)} runs, inside its own 95 % "
        f"interval in {(np.abs(yaw) < _INTERVAL * yaw_std).sum()}, RMS error {_rms(yaw):.2f} degrees.",
    ]
    for k, name in enumerate(("attitude", "position")):
        error = late[:, k]
        lines.append(
            f"Latency of the {name} within {1e3 * LATENCY_S:.0f} ms in {(np.abs(error) < LATENCY_S).sum()}, inside its "
            f"interval in {(np.abs(error) < _INTERVAL * late_std[:, k]).sum()}, RMS error "
            f"{1e3 * _rms(error):.0f} ms."
        )
    return "\n".join(lines) + "\n"


def _rms(errors: np.ndarray) -> float:
    return float(np.sqrt(np.square(errors).mean()))
