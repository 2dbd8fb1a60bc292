"""Builds, serializes and records messages without ROS."""

import numpy as np

from drocap_ros.recording.mcap.schemas import schema_text, standard_types
from drocap_ros.recording.mcap.writer import SessionWriter

START_NS = 1_700_000_000_000_000_000
NAMES = {
    "pose2d": "drocap_ros/msg/Pose2D",
    "state": "drocap_ros/msg/VehicleState",
    "info": "sensor_msgs/msg/CameraInfo",
    "image": "sensor_msgs/msg/Image",
    "compressed": "sensor_msgs/msg/CompressedImage",
}


class Messages:
    """Builds and serializes messages without ROS."""

    def __init__(self):
        self.store = standard_types()

    def __call__(self, name, **values):
        kind = self.store.types[name]
        return kind(**{field: values.get(field, self._default(form)) for field, form in self.fields(name)})

    def fields(self, name):
        return self.store.fielddefs[name][1]

    def _default(self, form):
        from rosbags.interfaces import Nodetype

        kind, detail = form
        if kind == Nodetype.BASE:
            return "" if detail[0] == "string" else (False if detail[0] == "bool" else 0)
        if kind == Nodetype.NAME:
            return self(detail)
        (inner, inner_detail), count = detail
        if inner == Nodetype.BASE and inner_detail[0] != "string":
            return np.zeros(count if kind == Nodetype.ARRAY else 0, dtype=inner_detail[0].replace("octet", "uint8"))
        return []

    def header(self, stamp_ns, frame_id="camera_optical"):
        stamp = self("builtin_interfaces/msg/Time", sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
        return self("std_msgs/msg/Header", stamp=stamp, frame_id=frame_id)

    def cdr(self, message):
        return bytes(self.store.serialize_cdr(message, message.__msgtype__))

    def pose2d(self, tracks, i, stamp_ns, track_id=1):
        empty = np.zeros(0, np.float32)
        seen = track_id > 0
        width, height = tracks.image_size
        return self(
            NAMES["pose2d"],
            header=self.header(stamp_ns),
            track_id=track_id,
            skeleton="body15",
            image_width=width,
            image_height=height,
            roi=np.zeros(4, np.float32),
            detection_score=0.9,
            keypoints=tracks.keypoints[i].astype(np.float32).ravel() if seen else empty,
            covariance=tracks.covariance[i].astype(np.float32).ravel() if seen else empty,
            confidence=tracks.confidence[i].astype(np.float32).ravel() if seen else empty,
        )

    def quaternion(self, xyzw):
        return self("geometry_msgs/msg/Quaternion", **dict(zip("xyzw", map(float, xyzw), strict=True)))


def write_poses(folder, messages, tracks, config=None, absent=(), topic="/drocap/pose2d"):
    with SessionWriter(folder, config) as writer:
        writer.register(topic, NAMES["pose2d"], schema_text(NAMES["pose2d"]))
        for i, stamp_ns in enumerate(tracks.stamp_ns.tolist()):
            message = messages.pose2d(tracks, i, stamp_ns, 0 if i in absent else 1)
            writer.write(topic, messages.cdr(message), stamp_ns + 5_000_000)
    assert writer.error is None
    assert writer.dropped == 0
    return writer.path
