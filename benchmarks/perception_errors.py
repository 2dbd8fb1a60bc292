"""Random errors of perception during a simulated orbit."""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import numpy as np

from drocap_ros.keypoints import PoseObservation
from lab.flights.orbit_loop import LoopSettings, OrbitLoop, with_config

#: Half of the orbits have errors; in the others perception errs as a detector does.
KINDS = ("none", "range", "swing", "another person", "shadow", "ground", "frozen", "late stamps")


class PerceptionErrors(NamedTuple):
    """One kind of error, drawn by a seed.

    factor : of the apparent size
    begin_s, length_s : of an error that lasts
    aside_px : place of another person in the picture
    """

    kind: str
    factor: float
    begin_s: float
    length_s: float
    aside_px: float
    ground_m: float
    late_s: float

    @classmethod
    def drawn(cls, seed: int) -> PerceptionErrors:
        """The error of this orbit."""
        rng = np.random.default_rng([seed, 0xE1])
        kind = "none" if rng.random() < 0.5 else str(rng.choice(KINDS[1:]))
        return cls(
            kind, float(rng.choice([rng.uniform(0.6, 0.9), rng.uniform(1.1, 1.4)])), float(rng.uniform(6.0, 14.0)),
            float(rng.uniform(0.3, 4.0)), float(rng.uniform(60, 400) * rng.choice([-1, 1])),
            float(rng.choice([-2.0, 2.0])), float(rng.uniform(0.03, 0.1)),
        )  # fmt: skip

    def settings(self, settings: LoopSettings) -> LoopSettings:
        """Settings with the ground configured wrongly, where that is the error."""
        if self.kind != "ground":
            return settings
        config = settings.config
        return with_config(
            settings, ground_height_m=config.ground_height_m - self.ground_m,
            max_height_m=config.max_height_m + 2.0, min_height_m=min(config.min_height_m, 1.0),
        )  # fmt: skip

    def disturb(self, loop: OrbitLoop) -> None:
        """Change what the loop perceives from now on."""
        kept: list[PoseObservation] = []

        def change(seen: PoseObservation) -> PoseObservation:
            inside = self.begin_s <= loop.t < self.begin_s + self.length_s
            keypoints = seen.keypoints
            if self.kind in ("range", "swing"):
                factor = self.factor
                if self.kind == "swing":
                    factor = 1 + (self.factor - 1) * float(np.sin(2 * np.pi * loop.t / self.length_s))
                middle = np.nanmean(keypoints, axis=0)
                keypoints = (keypoints - middle) * factor + middle
            elif self.kind == "another person" and inside:
                keypoints = keypoints + np.array([self.aside_px, 0.0])
            elif self.kind == "shadow" and inside:
                keypoints = keypoints.copy()
                keypoints[:, 1] = 2 * np.nanmax(keypoints[:, 1]) - keypoints[:, 1]
            elif self.kind == "frozen" and inside:
                kept.append(seen)
                keypoints = kept[0].keypoints
            late_ns = round(self.late_s * 1e9) if self.kind == "late stamps" else 0
            return dataclasses.replace(seen, keypoints=keypoints.astype(np.float32), stamp_ns=seen.stamp_ns + late_ns)

        loop.perceive = change
