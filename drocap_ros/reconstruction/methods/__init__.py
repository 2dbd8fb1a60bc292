"""The methods of ``drocap reconstruct``: ``--method NAME`` runs ``METHODS[NAME]``.

A new method is one file here and its entry, or one file of another package with an entry point of the group
``drocap_ros.methods``: commands, help texts and studies follow.  Nothing is imported before a method runs.  ``live`` is
no entry: it needs a recording of the live graph and runs in :mod:`drocap_ros.live_replay`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from importlib import import_module
from importlib.metadata import entry_points
from typing import TYPE_CHECKING

from drocap_ros.errors import InputError

if TYPE_CHECKING:
    from drocap_ros.reconstruction.common.poses import ImagePoses, MethodInput
    from drocap_ros.skeleton import JointSet


@dataclass(frozen=True)
class Method:
    """A method of reconstruction.

    place : module, after a dot one of this folder, and its function of a ``MethodInput`` that gives ``ImagePoses``
    summary : for the help text
    body : name of its joint set; the paper has fifteen joints; empty = the function's attribute ``body``, or "body17"
    """

    place: str
    summary: str
    body: str = "body15"

    @property
    def joints(self) -> JointSet:
        """The joints of the method's keypoints and poses."""
        from drocap_ros.skeleton import joint_set

        return joint_set(self.body or getattr(self.run, "body", "body17"))

    @cached_property
    def run(self) -> Callable[[MethodInput], ImagePoses]:
        """The function that gives the poses."""
        module, _, name = self.place.partition(":")
        try:
            function: Callable[[MethodInput], ImagePoses] = getattr(import_module(module, __name__), name)
        except (ImportError, AttributeError) as error:
            raise InputError(
                f"method {self.summary}: expected the function {self.place}, found none ({error}); install it again"
            ) from None
        return function


METHODS = {
    "ba": Method(
        ".ba:run", "learned lifter, depth signs, constant bone lengths; the most accurate (default)", "body17"
    ),
    "paper": Method(".paper:run", "the paper as written: single-view initializer, equations (2) to (4)"),
    "paper-no-articulation": Method(".paper:run_without_articulation", "the paper without its rank-1 term"),
    "initial": Method(".paper:run_initializer", "the paper's single-view initializer alone"),
    "mf-nnm": Method(".paper:run_factorization", "baseline: factorization and nuclear norm (Dai 2012)"),
}
for _point in entry_points(group="drocap_ros.methods"):
    # Another package's method cannot take the name of one of ours.
    METHODS.setdefault(_point.name, Method(_point.value, f"of the package {_point.dist and _point.dist.name}", ""))
