"""Builds, serializes and records messages without ROS."""

import numpy as np

from drocap_ros.recording.mcap.metadata import schema_text, standard_types
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


def record(folder, entries):
    """Session of entries (topic, message, log time, serialized message)."""
    with SessionWriter(folder) as writer:
        for topic, message, log_ns, cdr in entries:
            writer.register(topic, message.__msgtype__, schema_text(message.__msgtype__))
            writer.write(topic, cdr, log_ns)
    return folder


def random_image(seed, shape=(48, 64, 3)):
    return np.random.default_rng(seed).integers(0, 255, shape, dtype=np.uint8)


def image_message(messages, image, stamp_ns, encoding="bgr8", pad=0):
    import cv2

    convert = {
        "rgb8": cv2.COLOR_BGR2RGB,
        "mono8": cv2.COLOR_BGR2GRAY,
        "bgra8": cv2.COLOR_BGR2BGRA,
        "rgba8": cv2.COLOR_BGR2RGBA,
    }
    data = cv2.cvtColor(image, convert[encoding]) if encoding in convert else image
    rows = np.pad(data.reshape(data.shape[0], -1), ((0, 0), (0, pad)))
    return messages(
        NAMES["image"], header=messages.header(stamp_ns), height=image.shape[0], width=image.shape[1],
        encoding=encoding, step=rows.shape[1], data=rows.ravel(),
    )  # fmt: skip
