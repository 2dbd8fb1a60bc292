"""The methods of ``drocap reconstruct``: ``--method NAME`` runs ``METHODS[NAME]``.

A new method is one file here and its entry.  ``live`` is no entry: it needs a recording of the live graph and runs in
:mod:`drocap_ros.live_replay`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from drocap_ros.reconstruction.common.poses import ImagePoses, MethodInput
from drocap_ros.reconstruction.methods import ba, paper
from drocap_ros.skeleton import BODY_15, BODY_17, JointSet


@dataclass(frozen=True)
class Method:
    """A method of reconstruction, its help text and its joints: those of the paper are fifteen."""

    run: Callable[[MethodInput], ImagePoses]
    summary: str
    joints: JointSet = BODY_15


METHODS = {
    "ba": Method(ba.run, "the default: learned lifter, depth signs, adjustment with constant bone lengths", BODY_17),
    "paper": Method(paper.run, "single-view initializer and equations (2) to (4) of the paper"),
    "paper-no-articulation": Method(paper.run_without_articulation, "paper with gamma = 0"),
    "initial": Method(paper.run_initializer, "the paper's single-view initializer alone"),
    "mf-nnm": Method(paper.run_factorization, "baseline: matrix factorization and nuclear norm minimization"),
}
