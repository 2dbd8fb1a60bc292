"""OpenSim's motion file: inverse kinematics by OpenSim on a plain model in the sizes of the motion; degrees, metres.

The model is of this project's own making: rigid segments without muscles; axes X forwards, Y up, Z to the right.  A
marker stands at each joint of the motion, an ellipsoid is each bone.  Coordinates have the names of OpenSim's usual
full-body models; left joints are mirrored.  By default the model stands on the floor, y = 0.
"""

from __future__ import annotations

import contextlib
import importlib.util
import os
import sys
import tempfile
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from drocap_ros.errors import InputError
from drocap_ros.export.measured import write_trc
from drocap_ros.export.rig import SOLE, body_of, onto_the_floor
from drocap_ros.export.rigid_body import RigidBody
from drocap_ros.export.take import Take, at_constant_rate, without_gaps, y_up
from drocap_ros.skeleton import TOES

_X, _Y, _Z = (1, 0, 0), (0, 1, 0), (0, 0, 1)
#: A coordinate's name and the axis about or along which it moves.
_Axis = tuple[str, tuple[float, ...]]
_SIX = [(kind, i) for kind in ("rotation", "translation") for i in (1, 2, 3)]
_LINEAR = '<LinearFunction name="function"><coefficients>1 0</coefficients></LinearFunction>'
_ZERO = '<Constant name="function"><value>0</value></Constant>'
#: Ranges of coordinates, degrees; inverse kinematics stays within them.
_RANGES = {"knee_angle": (-5.0, 160.0), "elbow_flex": (-5.0, 160.0)}
#: Width of a bone, and of the head, over the length; colour of bone, red, green, blue; for the eye alone.
_BONE, _HEAD = 0.22, 0.75
_COLOUR = "0.93 0.89 0.8"
#: Weights in inverse kinematics, m^2 per rad^2, of coordinates that joint positions show badly or not at all.
WEIGHTS = {"lumbar_extension": 2.5e-3}
WEIGHTS |= dict.fromkeys(("hip_rotation_r", "hip_rotation_l", "arm_rot_r", "arm_rot_l"), 2e-4)


def model_xml(body: RigidBody) -> str:
    """OpenSim 4 model (``.osim``) in the sizes of a rigid body."""
    trunk = float(sum(body.fixed[name][1] for name in ("spine", "chest", "upperchest", "thorax")))
    lumbar = float(body.fixed["spine"][1])
    half = float(body.fixed["lcollar"][0]) + 0.5 * (body.lengths["lshoulder"] + body.lengths["rshoulder"])
    sole = SOLE * body.lengths["lankle"]
    model = _Model({"pelvis_ty": body.lengths["lknee"] + body.lengths["lankle"] + sole})
    pelvis = [("pelvis_rotation", _Y), ("pelvis_list", _X), ("pelvis_tilt", _Z)]
    model.segment("pelvis", "", (0, 0, 0), pelvis, [("pelvis_tx", _X), ("pelvis_ty", _Y), ("pelvis_tz", _Z)])
    spine = [("lumbar_extension", _Z), ("lumbar_bending", _X), ("lumbar_rotation", _Y)]
    model.segment("torso", "pelvis", (0, lumbar, 0), spine)
    model.segment("neck", "torso", (0, trunk - lumbar, 0), [("neck_extension", _Z), ("neck_bending", _X)])
    model.segment("head", "neck", (0, body.lengths["neck"], 0), [("head_extension", _Z), ("head_bending", _X)])
    model.markers += [("pelvis", "pelvis", (0, 0, 0)), ("neck", "head", (0, 0, 0))]
    model.markers.append(("head", "head", (0, body.lengths["head"], 0)))
    model.bone("pelvis", (0, 0, 0), (0, lumbar, 0))
    model.bone("torso", (0, 0, 0), (0, trunk - lumbar, 0))
    model.bone("neck", (0, 0, 0), (0, body.lengths["neck"], 0))
    model.bone("head", (0, 0, 0), (0, 2.0 * body.lengths["head"], 0), _HEAD)
    for side, sign in (("r", 1), ("l", -1)):
        _limbs(model, body, side, sign, (0, trunk - lumbar, sign * half))
    return model.xml()


def _limbs(model: _Model, body: RigidBody, side: str, sign: int, shoulder: tuple[float, ...]) -> None:
    x, y, backwards = (sign, 0, 0), (0, sign, 0), (0, 0, -1)
    hip = (0, 0, sign * float(body.fixed["lhip"][0]))
    thigh, shank, upper, fore = ((0, -body.lengths[side + name], 0) for name in ("knee", "ankle", "elbow", "wrist"))
    model.bone("pelvis", (0, 0, 0), hip)
    model.bone("torso", (0, shoulder[1], 0), shoulder)
    femur, tibia, humerus, forearm = (f"{name}_{side}" for name in ("femur", "tibia", "humerus", "forearm"))
    ball = [(f"hip_flexion_{side}", _Z), (f"hip_adduction_{side}", x), (f"hip_rotation_{side}", y)]
    model.segment(femur, "pelvis", hip, ball)
    model.segment(tibia, femur, thigh, [(f"knee_angle_{side}", backwards)])
    ball = [(f"arm_flex_{side}", _Z), (f"arm_add_{side}", x), (f"arm_rot_{side}", y)]
    model.segment(humerus, "torso", shoulder, ball)
    model.segment(forearm, humerus, upper, [(f"elbow_flex_{side}", _Z)])
    for segment, end in ((femur, thigh), (tibia, shank), (humerus, upper), (forearm, fore)):
        model.bone(segment, (0, 0, 0), end)
    if set(TOES) <= set(body.joints):
        foot, toe = f"foot_{side}", (body.lengths[side + "toe"], 0, 0)
        # The toes reach the floor, where the ankle stands at its height above the sole.
        model.rest[f"ankle_angle_{side}"] = -float(np.arcsin(min(SOLE * body.lengths["lankle"] / toe[0], 1.0)))
        model.segment(foot, tibia, shank, [(f"ankle_angle_{side}", _Z)])
        model.bone(foot, (0, 0, 0), toe)
        model.markers.append((side + "toe", foot, toe))
    model.markers += [(side + "hip", "pelvis", hip), (side + "knee", tibia, (0, 0, 0)), (side + "ankle", tibia, shank)]
    model.markers += [(side + "shoulder", "torso", shoulder), (side + "elbow", forearm, (0, 0, 0))]
    model.markers.append((side + "wrist", forearm, fore))


class _Model:
    """Bodies, joints and markers as XML of OpenSim 4.

    rest : default values of coordinates that are not 0, m and rad
    """

    def __init__(self, rest: dict[str, float]) -> None:
        self.rest = rest
        self.bones: dict[str, list[str]] = {}
        self.joints: list[str] = []
        self.markers: list[tuple[str, str, tuple[float, ...]]] = []

    def segment(
        self,
        name: str,
        parent: str,
        place: tuple[float, ...],
        turns: Sequence[_Axis],
        moves: Sequence[_Axis] | None = None,
    ) -> None:
        """Add a body and its joint at ``place`` of the parent ("": the ground): rotations in order, translations."""
        self.bones[name] = []
        axes, transform = _transform(turns, moves)
        above = f"/bodyset/{parent}" if parent else "/ground"
        self.joints.append(
            f'<CustomJoint name="{name}_joint"><socket_parent_frame>{name}_place</socket_parent_frame>'
            f"<socket_child_frame>/bodyset/{name}</socket_child_frame>"
            f"<coordinates>{''.join(self._coordinate(c) for c, _ in axes if c)}</coordinates>"
            f'<frames><PhysicalOffsetFrame name="{name}_place"><socket_parent>{above}</socket_parent><translation>'
            f"{_numbers(place)}</translation><orientation>0 0 0</orientation></PhysicalOffsetFrame></frames>"
            f"<SpatialTransform>{transform}</SpatialTransform></CustomJoint>"
        )

    def bone(self, segment: str, start: Sequence[float], end: Sequence[float], width: float = _BONE) -> None:
        """Show an ellipsoid between two places of a segment, ``width`` times as wide as long."""
        along = np.subtract(end, start)
        half = 0.5 * float(np.linalg.norm(along))
        radii = np.where(np.abs(along) > half, half, width * half)
        places = self.bones[segment]
        name = f"{segment}_bone{len(places)}"
        places.append(
            f'<PhysicalOffsetFrame name="{name}"><socket_parent>/bodyset/{segment}</socket_parent><translation>'
            f"{_numbers(0.5 * np.add(start, end))}</translation><orientation>0 0 0</orientation><attached_geometry>"
            f'<Ellipsoid name="{name}_shape"><socket_frame>..</socket_frame><radii>{_numbers(radii)}</radii>'
            f"<Appearance><color>{_COLOUR}</color></Appearance></Ellipsoid></attached_geometry></PhysicalOffsetFrame>"
        )

    def _coordinate(self, name: str) -> str:
        inner = f"<default_value>{self.rest[name]:.9g}</default_value>" if name in self.rest else ""
        if (span := _RANGES.get(name[:-2])) is not None:
            inner += f"<range>{_numbers(np.radians(span))}</range><clamped>true</clamped>"
        return f'<Coordinate name="{name}">{inner}</Coordinate>'

    def xml(self) -> str:
        """The whole document."""
        # Inverse kinematics needs no masses; the reader refuses bodies without.
        bodies = "\n".join(
            f'<Body name="{name}"><components>{"".join(shapes)}</components><mass>1</mass>'
            "<mass_center>0 0 0</mass_center><inertia>0.01 0.01 0.01 0 0 0</inertia></Body>"
            for name, shapes in self.bones.items()
        )
        markers = "\n".join(
            f'<Marker name="{name}"><socket_parent_frame>/bodyset/{segment}</socket_parent_frame>'
            f"<location>{_numbers(place)}</location></Marker>"
            for name, segment, place in self.markers
        )
        parts = {"BodySet": bodies, "JointSet": "\n".join(self.joints), "MarkerSet": markers}
        sets = "\n".join(
            f'<{kind} name="{kind.lower()}"><objects>\n{text}\n</objects></{kind}>' for kind, text in parts.items()
        )
        return (
            '<?xml version="1.0" encoding="UTF-8" ?>\n<OpenSimDocument Version="40500"><Model name="drocap_ros">\n'
            "<credits>drocap_ros: plain skeleton in the sizes of one motion, without muscles</credits>\n"
            f"<length_units>meters</length_units><force_units>N</force_units>\n{sets}\n</Model></OpenSimDocument>\n"
        )


def _transform(turns: Sequence[_Axis], moves: Sequence[_Axis] | None) -> tuple[list[_Axis], str]:
    """The six axes of a joint, and their XML: rotations without a coordinate need axes too, not parallel to others."""
    used = np.abs([axis for _, axis in turns])
    fixed = [("", axis) for axis in (_Z, _X, _Y) if not (used @ axis).any()]
    axes: list[_Axis] = [*turns, *fixed, *(moves or [("", axis) for axis in (_X, _Y, _Z)])]
    return axes, "".join(
        f'<TransformAxis name="{kind}{i}"><coordinates>{coordinate}</coordinates><axis>{_numbers(axis)}</axis>'
        f"{_LINEAR if coordinate else _ZERO}</TransformAxis>"
        for (coordinate, axis), (kind, i) in zip(axes, _SIX, strict=True)
    )


def _numbers(values: Iterable[float]) -> str:
    return " ".join(f"{value:.9g}" for value in values)


def write_mot(path: Path, take: Take) -> tuple[str, ...]:
    """Write the coordinates of a z-up take, and beside them the model as ``.osim``; returns notes on changes."""
    if path.suffix == ".osim":
        raise InputError(f"{path.name}: expected a name for the coordinates, found that of the model; end it in .mot")
    if importlib.util.find_spec("opensim") is None:
        install = f"{sys.executable} -m pip install 'drocap_ros[opensim]'"
        raise InputError(f"opensim: expected the Python package, found none; run {install}")
    import opensim

    take = at_constant_rate(take)
    body, notes = body_of(y_up(take))
    lift, floor_note = onto_the_floor(body, take.positions[:, take.joints.index("pelvis")])
    take = replace(take, positions=take.positions + lift[:, None, None] * (0.0, 0.0, 1.0))
    opensim.Logger.removeFileSink()  # opensim.log in the current folder
    opensim.Logger.setLevelString("Off")
    # The tool writes further files into the working folder of its model.
    with tempfile.TemporaryDirectory(prefix="drocap_ik_") as folder:
        markers = Path(folder) / "markers.trc"
        # OpenSim stops at a frame without any marker.
        write_trc(markers, without_gaps(take))
        path.with_suffix(".osim").write_text(model_xml(body), encoding="utf-8")
        model = opensim.Model(str(path.with_suffix(".osim")))
        tool = opensim.InverseKinematicsTool()
        tool.setModel(model)
        tool.setMarkerDataFileName(str(markers))
        tool.setOutputMotionFileName(str(path))
        tool.setResultsDir(folder)
        # By default the tool stops after two seconds.
        tool.setStartTime(0.0)
        tool.setEndTime(len(body.positions) / take.rate_hz)
        tool.set_report_errors(False)
        tasks = tool.upd_IKTaskSet()
        for name in (marker.getName() for marker in model.getMarkerSet()):
            task = opensim.IKMarkerTask()
            task.setName(name)
            task.setWeight(1.0)
            tasks.cloneAndAppend(task)
        for name, weight in WEIGHTS.items():
            rest = opensim.IKCoordinateTask()
            rest.setName(name)
            rest.setValueType(opensim.IKCoordinateTask.ManualValue)
            rest.setValue(0.0)
            rest.setWeight(weight)
            tasks.cloneAndAppend(rest)
        try:
            with _silent():
                tool.run()
        except RuntimeError as error:
            reason = str(error).splitlines()[0]
            raise InputError(f"opensim: expected inverse kinematics to succeed, got {reason}; try --to trc") from None
    return (
        *notes,
        floor_note,
        f"skeletal model of these sizes: {path.with_suffix('.osim').name}, made by drocap, without muscles",
    )


@contextlib.contextmanager
def _silent() -> Iterator[None]:
    """Standard output of compiled code to nowhere: the tool prints a summary of the model."""
    kept, nowhere = os.dup(1), os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)
    try:
        yield
    finally:
        os.dup2(kept, 1)
        os.close(kept)
        os.close(nowhere)
