"""A recording in the viewer."""

from __future__ import annotations

from collections.abc import Callable

from drocap_ros.errors import InputError
from drocap_ros.recording.session import COMPRESSED_IMAGE, IMAGE, Session
from drocap_ros.view.message_view import MessageView


def draw_session(
    view: MessageView,
    session: Session,
    namespace: str | None = None,
    progress: Callable[[str, float], None] | None = None,
) -> None:
    """Every message of a recording that can be drawn, in the order of the recording.

    Parameters
    ----------
    namespace : of the topics; None = that with most keypoints, poses and pictures
    progress : called with a name and the share that is drawn

    Raises
    ------
    InputError
        When there is nothing to draw.
    """
    named, view.namespace = _topics(view, session, namespace)
    start_ns, duration_ns = session.info.start_ns or 0, max(session.info.duration_s * 1e9, 1.0)
    for raw, message in session.messages(tuple(named)):
        view.take(named[raw.topic], message, raw.log_time_ns)
        if progress is not None:
            progress("messages", (raw.log_time_ns - start_ns) / duration_ns)
    view.finish()


def _topics(view: MessageView, session: Session, namespace: str | None) -> tuple[dict[str, str], str]:
    """Topic of the recording -> its name in the graph, and the graph's namespace."""
    there = [topic for topic in session.info.topics if topic.count]
    spaces: dict[str, int] = {}
    for topic in there:
        for name in ("pose2d", "pose3d/initial", "pose3d/latest", "pose3d/refined", "image/compressed"):
            if topic.name.endswith("/" + name):
                space = topic.name[: -len(name) - 1]
                spaces[space] = spaces.get(space, 0) + topic.count
    space = max(spaces, key=lambda s: (spaces[s], s), default="") if namespace is None else "/" + namespace.strip("/")
    named = {f"{space}/{name}": name for name in view.handlers if not name.startswith("/")}
    found = {topic.name: named[topic.name] for topic in there if topic.name in named}
    if not found and namespace is None:
        # No recording of ours: pictures at least.
        images = session.topics_of(COMPRESSED_IMAGE, IMAGE)
        found = {images[0].name: "image/compressed"} if images else {}
    if not found:
        listed = ", ".join(t.name for t in there) or "none"
        raise InputError(
            f"{session.path}: expected keypoints, poses or pictures, found the topics {listed}; record some"
        )
    found.update({topic.name: topic.name for topic in there if topic.name == "/diagnostics"})
    return found, space
