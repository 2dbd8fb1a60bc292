"""The methods of ``drocap reconstruct``: ``--method NAME`` runs ``METHODS[NAME]``.

A new method is one file here and its entry: commands, help texts and studies follow.  Nothing is imported before a
method runs.  ``live`` is no entry: it needs a recording of the live graph and runs in :mod:`drocap_ros.live_replay`.
"""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from drocap_ros.reconstruction.common.poses import ImagePoses, MethodInput
    from drocap_ros.skeleton import JointSet


@dataclass(frozen=True)
class Method:
    """A method of reconstruction.

    place : module of this folder, and its function of a ``MethodInput`` that gives ``ImagePoses``
    summary : for the help text
    body : name of its joint set; the paper has fifteen joints
    """

    place: str
    summary: str
    body: str = "body15"

    @property
    def joints(self) -> JointSet:
        """The joints of the method's keypoints and poses."""
        from drocap_ros.skeleton import joint_set

        return joint_set(self.body)

    def run(self, data: MethodInput) -> ImagePoses:
        """Poses by the method."""
        module, function = self.place.split(":")
        poses: ImagePoses = getattr(import_module(f"{__name__}.{module}"), function)(data)
        return poses


METHODS = {
    "ba": Method("ba:run", "learned lifter, depth signs, constant bone lengths; the most accurate (default)", "body17"),
    "paper": Method("paper:run", "the paper as written: single-view initializer, equations (2) to (4)"),
    "paper-no-articulation": Method("paper:run_without_articulation", "the paper without its rank-1 term"),
    "initial": Method("paper:run_initializer", "the paper's single-view initializer alone"),
    "mf-nnm": Method("paper:run_factorization", "baseline: factorization and nuclear norm (Dai 2012)"),
}
