"""An avatar's pose as messages for other programs: VMC (protocol.vmc.info, marionette specification) and JSON."""

from __future__ import annotations

import json

import numpy as np

from drocap_ros.export.avatar import BONES, AvatarPose

_NO_TURN = np.array([0.0, 0.0, 0.0, 1.0])


def vmc_packet(pose: AvatarPose | None, time_s: float) -> bytes:
    """One OSC bundle: model loaded and calibrated, time, root and bones in Unity's axes.

    pose : None = nobody is seen: the bundle says so (tracking status 0) and holds no bones, so receivers keep the last

    The root is the place below the hips, the hips' bone has their height above it.
    """
    from pythonosc.osc_bundle_builder import IMMEDIATELY, OscBundleBuilder
    from pythonosc.osc_message_builder import OscMessageBuilder

    bundle = OscBundleBuilder(IMMEDIATELY)

    def add(address: str, *values: tuple[str, float | str]) -> None:
        message = OscMessageBuilder(address)
        for kind, value in values:
            message.add_arg(value, kind)
        bundle.add_content(message.build())

    def add_place(address: str, name: str, place: np.ndarray, turn: np.ndarray) -> None:
        add(address, ("s", name), *(("f", float(value)) for value in (*place, *turn)))

    add("/VMC/Ext/OK", ("i", 1), ("i", 3), ("i", 0), ("i", int(pose is not None)))
    add("/VMC/Ext/T", ("f", time_s))
    if pose is not None:
        pose = pose.unity()
        level = np.array([1.0, 0.0, 1.0])
        add_place("/VMC/Ext/Root/Pos", "root", pose.place * level, _NO_TURN)
        offsets = np.concatenate([(pose.place * (1.0 - level))[None], pose.offsets[1:]])
        for name, offset, turn in zip(BONES.values(), offsets, pose.rotations, strict=True):
            add_place("/VMC/Ext/Bone/Pos", name, offset, turn)
    return bytes(bundle.build().dgram)


def json_text(pose: AvatarPose | None, stamp_ns: int, frame: str) -> str:
    """One JSON object: stamp, frame, whether somebody is seen, place and local rotation of each bone.

    Axes as in glTF: right-handed, y up, m; rotations are quaternions x y z w.
    """
    joints = {}
    if pose is not None:
        places, turns = np.round(pose.positions(), 4).tolist(), np.round(pose.rotations, 5).tolist()
        joints = {
            name: {"position": place, "rotation": turn}
            for name, place, turn in zip(BONES.values(), places, turns, strict=True)
        }
    return json.dumps({"stamp_ns": stamp_ns, "frame": frame, "seen": pose is not None, "joints": joints})
