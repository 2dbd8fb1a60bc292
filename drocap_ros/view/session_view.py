"""A recording in the viewer."""

from __future__ import annotations

from collections.abc import Callable

from drocap_ros.errors import InputError
from drocap_ros.recording.session import COMPRESSED_IMAGE, IMAGE, Session
from drocap_ros.view.message_view import MessageView


def draw_session(
    view: MessageView,
    session: Session,
    namespace: str | None,
    progress: Callable[[str, float], None],
) -> None:
    """Draw a recording's messages in the order of the recording.

    Parameters
    ----------
    namespace : of the topics; None = that with most keypoints, poses and images
    progress : called with a name and the share done

    Raises
    ------
    InputError
        When the recording holds nothing to draw.
    """
    named, view.namespace = _topics(view, session, namespace)
    start_ns, duration_ns = session.info.start_ns or 0, max(session.info.duration_s * 1e9, 1.0)
    for raw, message in session.messages(tuple(named)):
        view.take(named[raw.topic], message, raw.log_time_ns)
        progress("messages", (raw.log_time_ns - start_ns) / duration_ns)
    view.finish()


def _topics(view: MessageView, session: Session, namespace: str | None) -> tuple[dict[str, str], str]:
    """Topic of the recording -> its name in the graph, and the graph's namespace."""
    present = [topic for topic in session.info.topics if topic.count]
    spaces: dict[str, int] = {}
    for topic in present:
        for name in ("pose2d", "pose3d/initial", "pose3d/latest", "pose3d/refined", "image/compressed"):
            if topic.name.endswith("/" + name):
                space = topic.name[: -len(name) - 1]
                spaces[space] = spaces.get(space, 0) + topic.count
    space = max(spaces, key=lambda s: (spaces[s], s), default="") if namespace is None else "/" + namespace.strip("/")
    named = {f"{space}/{name}": name for name in view.handlers if not name.startswith("/")}
    found = {topic.name: named[topic.name] for topic in present if topic.name in named}
    if not found and namespace is None:
        # Not a recording of this package: its images.
        images = session.topics_of(COMPRESSED_IMAGE, IMAGE)
        found = {images[0].name: "image/compressed"} if images else {}
    if not found:
        listed = ", ".join(t.name for t in present) or "none"
        raise InputError(
            f"{session.path}: expected keypoints, poses or images, found the topics {listed}; record one of them"
        )
    found.update({topic.name: topic.name for topic in present if topic.name == "/diagnostics"})
    return found, space
