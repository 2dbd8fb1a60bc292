"""Adjustments in the world of one window after the other: each goes on where the last one was, and knows what it found.

A frame's information counts once: a window hands on its share of the frames that the next one has no longer.
"""

from __future__ import annotations

import itertools
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from drocap_ros.camera_path import CameraPath
from drocap_ros.geometry.rotations import log_so3
from drocap_ros.keypoints import Keypoints2D
from drocap_ros.reconstruction.common.poses import ImagePoses
from drocap_ros.reconstruction.common.refusal import Refusal
from drocap_ros.reconstruction.world.findings import Findings
from drocap_ros.reconstruction.world.in_world import in_world
from drocap_ros.reconstruction.world.refine import Before, RefinedWorld
from drocap_ros.reconstruction.world.world_model import WorldConfig

#: Share of a recording's steps that lock feet, and of all steps of a window that continues another, as its inverse:
#: what more steps would change, the next window does, half a second later.
_FEWER_STEPS = 2


class _Last(NamedTuple):
    """The window before, what it found, and the camera that its adjustment was given."""

    before: Before
    found: Findings
    camera: CameraPath


class WorldChain:
    """What the last window and all before it found; memory is that of a window."""

    def __init__(self) -> None:
        self._known = Findings.unknown()
        self._last: _Last | None = None

    def begin(self) -> None:
        """The next window continues none; what was found stays known."""
        self._last = None

    def of_scale(self, stamp_ns: np.ndarray) -> None:
        """The next window, of these stamps, has another source of the camera: the scale alone stays known."""
        self._known, self._last = self._prior(stamp_ns).of_scale(), None

    def move(self, by: np.ndarray) -> None:
        """The last window lies (3,) m beside where it was, and the next one continues it there."""
        if self._last is not None:
            before, found, camera = self._last
            there = replace(camera, position=camera.pose[1] + by)
            self._last = _Last(before._replace(joints=before.joints + by), found, there)

    def steps(self, config: WorldConfig, stamp_ns: np.ndarray) -> WorldConfig:
        """The configuration with the steps of a window of these stamps."""
        config = replace(config, locking_iterations=config.locking_iterations // _FEWER_STEPS)
        return (
            config
            if self._continued(stamp_ns) is None
            else replace(config, iterations=config.iterations // _FEWER_STEPS)
        )

    def refined(
        self,
        camera: CameraPath,
        keypoints: Keypoints2D,
        poses: ImagePoses,
        per_px: np.ndarray,
        config: WorldConfig,
        extra: Findings | None = None,
    ) -> RefinedWorld | Refusal | None:
        """The next window in the world; None = too short.  ``extra`` : priors of this window alone."""
        known = self._prior(camera.stamp_ns)
        every = known if extra is None else known.later(extra, 1.0, 0.0)
        found = in_world(camera, keypoints, poses, per_px, config, every, self._before_in(camera))
        if found.refined is None:
            return found.refusal
        self._known, self._last = known, _Last(found.refined.before, found.refined.found, camera)
        return found.refined

    def _continued(self, stamps: np.ndarray) -> _Last | None:
        """The window before, where the window of these stamps shares frames with it."""
        return None if self._last is None or stamps[0] > self._last.before.stamp_ns[-1] else self._last

    def _prior(self, stamps: np.ndarray) -> Findings:
        """Findings of earlier windows that the window of these stamps has not itself."""
        return (
            self._known
            if self._last is None
            else self._known.after(self._last.found, self._last.before.stamp_ns, stamps)
        )

    def _before_in(self, camera: CameraPath) -> Before | None:
        """The window that this one continues, with its slow errors as those of this camera."""
        last = self._continued(camera.stamp_ns)
        if last is None:
            return None
        before = last.before
        wander = before.wander.copy()
        at, here = (np.isin(a, b) for a, b in itertools.permutations((before.stamp_ns, camera.stamp_ns)))
        (turn, place), (their_turn, their_place) = camera.pose, last.camera.pose
        wander[at, :3] += their_place[at] - place[here]
        wander[at, 3:] += log_so3(their_turn[at] @ np.swapaxes(turn[here], 1, 2))
        return before._replace(wander=wander)
