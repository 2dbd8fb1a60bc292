"""``--method mf-nnm``: the baseline of :mod:`drocap_ros.reconstruction.paper.mf_nnm`, window by window."""

from __future__ import annotations

import time
from dataclasses import replace

from drocap_ros.reconstruction.common.poses import CameraPoses, MethodInput
from drocap_ros.reconstruction.common.windows import WindowResult, over_windows, placed
from drocap_ros.reconstruction.paper.mf_nnm import factorize
from drocap_ros.reconstruction.paper.normalize import NormalizedTracks


def run(data: MethodInput) -> CameraPoses:
    """Poses by matrix factorization and nuclear norm minimization."""
    clock = time.perf_counter()

    def solve(_: slice, n: NormalizedTracks) -> WindowResult:
        poses, terms, iterations, stop = factorize(n.w, n.information, data.dictionary, data.adjuster)
        return WindowResult(placed(poses, n.w, n.information), terms, iterations, stop)

    poses = over_windows(data, solve)
    return replace(poses, seconds={"initial": 0.0, "ba": time.perf_counter() - clock})
