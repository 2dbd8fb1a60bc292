"""OpenSim's motion file: inverse kinematics by OpenSim on a plain model in the sizes of the motion; degrees, metres."""

from __future__ import annotations

import contextlib
import importlib.util
import os
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from drocap_ros.errors import InputError
from drocap_ros.export.measured import write_trc
from drocap_ros.export.opensim_model import WEIGHTS, model_xml
from drocap_ros.export.rig import body_of, onto_the_floor
from drocap_ros.export.take import Take, at_constant_rate, without_gaps, y_up


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
