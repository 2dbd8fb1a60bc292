"""The views of one person at the times and places known so far, and the adjustments that measure both again."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from drocap_ros.geometry.rotations import exp_so3
from drocap_ros.reconstruction.camera.fusion import with_camera_errors
from drocap_ros.reconstruction.common.refusal import Refusal
from drocap_ros.reconstruction.common.windows import even_slots
from drocap_ros.reconstruction.in_metres import reprojection_px
from drocap_ros.reconstruction.lifted.adjustment import span_lengths
from drocap_ros.reconstruction.together.view import View
from drocap_ros.reconstruction.world.refine import Beside, RefinedWorld, refine_in_world
from drocap_ros.reconstruction.world.world_model import Doubt, WorldInput

#: Errors of a place and an attitude that the bodies of single views give: their depths err by a tenth of the range, and
#: a body that is turned a little looks as one that faces the camera: two phones 38 degrees apart seemed to be 20.
_PLACED_M, _PLACED_DEG = 0.5, 15.0
#: Time (s) in which a slow error is measured, and its change in that time over its standard deviation: the path's
#: errors of WorldResiduals have a time constant of 60 s.
_CHANGE_S, _CHANGE = 5.0, 0.4
#: Least error (m) of a place that is believed: that of the best receivers.
_LEAST_PLACED_M = 0.02
#: Weight of the body as single views have it, in a start from the rays of all: deviation (m) of a joint.
_SINGLE_M = 0.3


class JoinedProblem:
    """The views at the times and places known so far.

    at_rest : whether the common world is; else it is that of a camera that moves, and feet rest nowhere in it
    """

    def __init__(self, views: list[View], home: int, offsets: list[float], at_rest: bool) -> None:
        self.views = views if at_rest else [replace(v, config=replace(v.config, feet=False)) for v in views]
        self.home, self.offsets, self.at_rest = home, offsets, at_rest
        self.offset_std = [0.0] * len(views)
        slot, _ = even_slots(views[0].camera.stamp_ns)
        self._slot = slot
        self._time = np.interp(np.arange(slot[-1] + 1), slot, views[0].time_s)
        self._joints: np.ndarray | None = None
        self._doubts = [self._first_doubt(n) for n in range(len(views))]

    def solve(self) -> RefinedWorld:
        """Adjust body, cameras and times in turns."""
        # Each adjustment begins from the times and places that the one before has measured.
        for _ in range(5):
            inputs = self.inputs()
            start = self._start(inputs) if self._joints is None else self._joints
            refined = self._adjust(inputs, start)
            self._joints = refined.joints
            self._find_lenses(refined)
            inputs = self.inputs()
            late = [self._late(view, n, refined) for n, view in enumerate(inputs)]
            # The body goes with every view by its share: a view that is alone in being late seems less so.
            change = [(seconds - late[0][0]) * len(late) / (len(late) - 1) for seconds, _ in late]
            self.offsets = [offset + more for offset, more in zip(self.offsets, change, strict=True)]
            self.offset_std = [std for _, std in late]
            self._doubts = [self._doubt(n, inputs, refined) for n in range(len(inputs))]
            if max(map(abs, change)) < 5e-4 and max(map(abs, refined.lens)) < 5e-3:
                break
        return refined

    def with_home_errors(self, refined: RefinedWorld) -> RefinedWorld:
        """The result whose joints are as uncertain as the camera whose world it is, too."""
        home = self.views[self.home]
        errors = home.errors
        if errors is None:
            return refined
        near = np.searchsorted(home.time_s, self.views[0].time_s - self.offsets[self.home])
        rotation, position = self.camera(self.home, self.inputs()[self.home], refined)
        return with_camera_errors(refined, errors[np.minimum(near, len(errors) - 1)], rotation, position)

    def _find_lenses(self, refined: RefinedWorld) -> None:
        """The focal lengths that the adjustment has found are those of the views from now on."""
        for n, more in enumerate(refined.lens):
            camera, (mean, std) = self.views[n].camera, self._doubts[n].lens
            assert camera.matrix is not None
            matrix = camera.matrix @ np.diag([np.exp(more), np.exp(more), 1.0])
            self.views[n] = replace(self.views[n], camera=replace(camera, matrix=matrix))
            self._doubts[n] = self._doubts[n]._replace(lens=(mean - more, std))

    def inputs(self) -> list[WorldInput]:
        """Every view on the slots of the first one."""
        return [
            view.at(self._time - offset, self._doubts[n])
            for n, (view, offset) in enumerate(zip(self.views, self.offsets, strict=True))
        ]

    def _first_doubt(self, number: int) -> Doubt:
        view = self.views[number]
        # All bodies of a view's lifter have a turn (rad) in common, as its errors last.
        doubt = Doubt(lens=(0.0, view.focal_std), lean_std=0.15)
        if number == self.home:
            return doubt
        # Slow errors of a path beside those that its own recording knows of, before they are measured.
        home, wander_m = self.views[self.home], 0.0 if view.own_world and view.stands else 0.3
        placed = doubt._replace(placed_m=_PLACED_M, wander_m=wander_m)
        if view.reported and home.reported:
            return placed
        upright = view.own_world and home.own_world
        tilt = max(view.solved.camera.up_std_deg, view.config.errors.tilt_deg) if upright else _PLACED_DEG
        return placed._replace(placed_deg=(tilt, _PLACED_DEG))

    def _doubt(self, number: int, inputs: list[WorldInput], refined: RefinedWorld) -> Doubt:
        """The errors of a reported place as large as they are across the line to the other camera.

        Along that line they cannot be told from the scale; receivers err alike in all directions.
        """
        doubt, view = self._doubts[number], self.views[number]
        if number == self.home or not (view.reported and self.views[self.home].reported):
            return doubt
        (_, there), (_, here) = (self.camera(n, inputs[n], refined) for n in (number, self.home))
        line = there - here
        line /= np.maximum(np.linalg.norm(line, axis=1, keepdims=True), _LEAST_PLACED_M)
        off = there - inputs[number].telemetry.position[self._slot]
        off -= here - inputs[self.home].telemetry.position[self._slot]
        off -= (off * line).sum(axis=1, keepdims=True) * line
        time = self.views[0].time_s
        later = np.searchsorted(time, time + _CHANGE_S)
        rows = np.flatnonzero(later < len(time))
        placed = _across(off)
        wander = _across(off[later[rows]] - off[rows]) / _CHANGE if len(rows) else doubt.wander_m
        # A receiver without corrections wanders by 0.6 m; more is another motion.
        return doubt._replace(placed_m=max(placed, _LEAST_PLACED_M), wander_m=min(wander, 0.6))

    def _start(self, inputs: list[WorldInput]) -> np.ndarray:
        """(F, 17, 3) m nearest to the rays of all views, and to the bodies of each."""
        bodies = [view.joints_at(self._time - own) for view, own in zip(self.views, self.offsets, strict=True)]
        single = np.mean(bodies, axis=0)
        normal = np.broadcast_to(np.eye(3) / _SINGLE_M**2, (*single.shape, 3)).copy()
        right = single / _SINGLE_M**2
        for view in inputs:
            focal, centre = np.diagonal(view.camera_matrix)[:2], view.camera_matrix[:2, 2]
            ray = np.concatenate([(view.keypoints - centre) / focal, np.ones((*view.weight.shape, 1))], axis=-1)
            ray = ray @ view.telemetry.rotation
            ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
            across = np.eye(3) - ray[..., :, None] * ray[..., None, :]
            range_m = np.linalg.norm(single[:, 0] - view.telemetry.position, axis=-1)
            precision = view.weight * np.square(focal.mean() / np.maximum(range_m, 0.3))[:, None]
            # Of a pixel's precision a tenth: places err more than pixels at first.
            across *= (0.01 * precision)[..., None, None]
            normal += across
            right += (across @ view.telemetry.position[:, None, :, None])[..., 0]
        joints = np.linalg.solve(normal, right[..., None])[..., 0]
        return np.asarray(joints[self._slot])

    def _adjust(self, inputs: list[WorldInput], start: np.ndarray) -> RefinedWorld:
        """One adjustment."""
        first = self.views[0]
        # Bones between joints that err are too long: those of the bodies that single views give.
        lengths = np.mean([np.median(span_lengths(view.joints), axis=0) for view in self.views], axis=0)
        beside = Beside(tuple(inputs[1:]), inputs[0].doubt, lengths)
        # Several views measure bone lengths: those that single views give have this deviation of their logarithm.
        config = replace(inputs[0].config, length_std=0.02)
        found = refine_in_world(first.camera, first.solved.keypoints, first.placed_poses(start), config, beside=beside)
        assert not isinstance(found, Refusal)
        return found

    def camera(self, number: int, view: WorldInput, refined: RefinedWorld) -> tuple[np.ndarray, np.ndarray]:
        """Corrected rotation (F, 3, 3) and position (F, 3) of a view's camera at the first view's images."""
        if number == 0:
            return refined.rotation, refined.position
        correction, path = refined.further[number - 1], view.telemetry
        turn = exp_so3(correction[:, 3:]) @ path.rotation[self._slot]
        return turn, path.position[self._slot] + correction[:, :3]

    def images(self, number: int) -> tuple[np.ndarray, np.ndarray]:
        """Stamps (G,) ns, on its own clock, of the first view's images while a view records, and their numbers."""
        view, own = self.views[number], self.views[0].camera.stamp_ns
        if number == 0:
            return own, np.arange(len(own))
        there = self.views[0].time_s - self.offsets[number]
        rows = np.flatnonzero((there >= 0.0) & (there <= view.time_s[-1]))
        return view.camera.stamp_ns[0] + np.round(there[rows] * 1e9).astype(np.int64), rows

    def shown(self, number: int, view: WorldInput) -> tuple[np.ndarray, np.ndarray]:
        """Keypoints (F, 17, 2) px of a view at the first view's images, NaN = not seen, and confidences (F, 17)."""
        if number == 0:
            motion = self.views[0].solved.motion
            return motion.keypoints[:, :17], motion.confidence[:, :17]
        assert view.seen is not None
        seen = view.seen[self._slot]
        return np.where(seen[..., None], view.keypoints[self._slot], np.nan), seen.astype(np.float64)

    @staticmethod
    def scale(refined: RefinedWorld) -> float:
        """Metres of the body at its assumed stature per metre of the world."""
        return float(np.median([float(str(window["scale"])) for window in refined.calibration]))

    def told(self, number: int, view: WorldInput, refined: RefinedWorld) -> dict[str, float | bool]:
        """JSON-compatible: time and place of a view, and how far its keypoints lie from the common body.

        misfit : that distance over the one from its own body, or over usual errors of keypoints
        by_body : whether the camera moves and nothing but the body in its pictures tells how
        """
        keypoints, _ = self.shown(number, view)
        off = reprojection_px(refined.joints, *self.camera(number, view, refined), view.camera_matrix, keypoints)
        alone = self.views[number].solved.motion.reprojection_px[:, :17]
        doubt, height = self._doubts[number], keypoints[np.isfinite(keypoints).any(axis=(1, 2)), :, 1]
        size = float(np.median(np.nanmax(height, axis=1) - np.nanmin(height, axis=1)))
        # Usual error of a keypoint, share of the body's height in the image.
        return {
            "offset_s": self.offsets[number],
            "offset_std_s": float(np.hypot(self.offset_std[number], self.offset_std[0])) if number else 0.0,
            "median_px": float(np.nanmedian(off)),
            "median_px_alone": float(np.nanmedian(alone)),
            "misfit": float(np.nanmedian(off)) / max(float(np.nanmedian(alone)), 0.004 * size),
            "placed_m": doubt.placed_m,
            "focal_px": 0.5 * float(view.camera_matrix[0, 0] + view.camera_matrix[1, 1]),
            "by_body": not (self.views[number].own_world or self.views[number].stands),
        }

    def _late(self, view: WorldInput, number: int, refined: RefinedWorld) -> tuple[float, float]:
        """Seconds by which a view's joints are ahead of the body's, and the standard deviation."""
        body = refined.joints[:, :17]
        velocity = np.gradient(body, axis=0) / np.gradient(self._time[self._slot])[:, None, None]
        rotation, position = self.camera(number, view, refined)
        seen = (body - position[:, None]) @ np.swapaxes(rotation, 1, 2)
        moving = velocity @ np.swapaxes(rotation, 1, 2)
        depth = np.maximum(seen[..., 2:], 0.3)
        focal, centre = np.diagonal(view.camera_matrix)[:2], view.camera_matrix[:2, 2]
        pixels = focal * seen[..., :2] / depth + centre
        flow = focal * (moving[..., :2] - seen[..., :2] / depth * moving[..., 2:]) / depth
        weight = view.weight[self._slot] * (view.seen[self._slot] if view.seen is not None else 1.0)
        off = view.keypoints[self._slot] - pixels
        square = np.square(off).sum(-1) * weight
        weight = weight / np.square(1.0 + square / max(9.0, 4.0 * float(np.median(square[weight > 0]))))
        total = float((weight[..., None] * np.square(flow)).sum())
        if total <= 0.0:
            return 0.0, np.inf
        # Errors of 2D joints last for some frames.
        std = (view.config.frames_per_fact / total) ** 0.5
        return float((weight[..., None] * flow * off).sum()) / total, std


def _across(off: np.ndarray) -> float:
    """Root mean square (m) along each of the two directions that vectors (F, 3) across a line have."""
    return float(np.sqrt(np.square(off).sum(axis=-1).mean() / 2.0))
