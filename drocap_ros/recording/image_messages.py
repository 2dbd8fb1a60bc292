"""Images from messages: one message to an array, or those of a recording one at a time."""

from __future__ import annotations

import itertools
import re
from collections import Counter
from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from drocap_ros.errors import InputError
from drocap_ros.perception.sources.image_files import colour_rank, decoded, raw_to_bgr
from drocap_ros.perception.sources.video import codec_of, decoded_packets
from drocap_ros.recording.session import IMAGES, Message, Session, TopicInfo, header_stamp_ns
from drocap_ros.stamps import JUMP_S, NS, StampValidator

if TYPE_CHECKING:
    from drocap_ros.perception.sources.base import Frame

#: A topic of this name holds no pictures of a camera.
_NO_PICTURE = re.compile(r"depth|disparity|mask|label|segment|confidence", re.IGNORECASE)
#: Rank of a topic of distances or labels, behind colour (0) and grey (1).
_DEPTH_RANK = 2
#: Messages by which a clock that stands still is known.
_FIRST = 32


def image_from_message(message: Message, compressed: bool | None = None) -> np.ndarray:
    """(H, W, 3) uint8 BGR of an image or compressed image of ROS or Foxglove.

    compressed : None = by the fields of the message
    """
    data = np.ascontiguousarray(np.frombuffer(bytes(message.data), np.uint8))
    if hasattr(message, "format") if compressed is None else compressed:
        return decoded(data, str(message.format))
    size = int(message.width), int(message.height)
    return raw_to_bgr(data, size, int(message.step), str(message.encoding), bool(getattr(message, "is_bigendian", 0)))


def choose_images(session: Session, wanted: str = "") -> TopicInfo:
    """The topic of a name, else that of colour images with most messages, else of grey ones; depth is passed over."""
    found = session.topics_of(*IMAGES)
    names = ", ".join(topic.name for topic in found)
    if wanted:
        for topic in found:
            if topic.name.strip("/") == wanted.strip("/"):
                return topic
        raise InputError(f"--topic {wanted}: expected a topic with images, found {names or 'none'}; correct the name")
    if len(found) < 2:
        return session.choose_topic(*IMAGES)
    by_rank: dict[int, list[TopicInfo]] = {}
    for topic in found:
        by_rank.setdefault(_rank(session, topic), []).append(topic)
    least, best = min(by_rank.items())
    if least == _DEPTH_RANK:
        raise InputError(f"{session.path}: expected colour or grey images, found {names}; choose one with --topic NAME")
    if len(best) > 1:
        session.warn(f"several topics of images: {names}; took {best[0].name}, --topic NAME chooses another")
    return best[0]


def _rank(session: Session, topic: TopicInfo) -> int:
    """0 for colour, 1 for grey, 2 for distances and labels, by the first message."""
    first = next((message for _, message in session.messages((topic.name,))), None)
    form = str(getattr(first, "encoding", getattr(first, "format", "")))
    return _DEPTH_RANK if first is None or _NO_PICTURE.search(topic.name) else colour_rank(form)


def read_images(session: Session, topic: str = "") -> Iterator[Frame]:
    """Images of a recording, one at a time, with strictly increasing stamps.

    Images that do not decode, or with a stamp not later than the previous one or far from it, are left out with a
    warning.  Where the stamps of the messages do not advance, the times at which they were recorded are taken.
    """
    from drocap_ros.perception.sources.base import Frame

    chosen = choose_images(session, topic)
    last_ns, unordered, problems = None, 0, Counter[str]()
    for stamp_ns, image in _images(session, chosen, problems):
        if last_ns is not None and stamp_ns <= last_ns:
            unordered += 1
            continue
        try:
            pixels = image if isinstance(image, np.ndarray) else image_from_message(image)
        except InputError as error:
            problems[str(error)] += 1
            continue
        last_ns = stamp_ns
        yield Frame(stamp_ns, pixels)
    if unordered:
        session.warn(f"{unordered} images on {chosen.name} with a stamp not later than the previous one were left out")
    if problems:
        worst, _ = problems.most_common(1)[0]
        session.warn(f"{problems.total()} images on {chosen.name} were left out: {worst}")
        if last_ns is None:
            raise InputError(f"{session.path}: {chosen.name}: {worst}")


def _images(session: Session, chosen: TopicInfo, problems: Counter[str]) -> Iterator[tuple[int, Message | np.ndarray]]:
    """Stamps with messages, or with the images that a video's packets decode to."""
    stamped = _stamped(session, chosen.name, problems)
    first = next(stamped, None)
    if first is None:
        return
    stamped = itertools.chain((first,), stamped)
    codec = str(getattr(first[1], "encoding", getattr(first[1], "format", "")))
    video = chosen.type_name.endswith(("CompressedVideo", "FFMPEGPacket"))
    if not video and (not hasattr(first[1], "format") or codec_of(codec) in (None, "mjpeg")):
        yield from stamped
        return
    try:
        yield from decoded_packets(codec, ((stamp_ns, bytes(message.data)) for stamp_ns, message in stamped))
    except InputError as error:
        problems[str(error)] += 1


def _stamped(session: Session, topic: str, problems: Counter[str]) -> Iterator[tuple[int, Message]]:
    """Messages with their stamps, or with the recorder's times where the stamps do not advance."""
    heads = [header_stamp_ns(m) for _, m in itertools.islice(session.messages((topic,)), _FIRST)]
    by_recorder = sum(b > a for a, b in itertools.pairwise(heads)) < (len(heads) - 1) / 2
    if by_recorder:
        session.warn(f"the stamps on {topic} do not advance: the recorder's times are used, late by the transport")
    stamps, begun, middle_ns = StampValidator(), False, sorted(heads)[len(heads) // 2] if heads else 0
    for raw, message in session.messages((topic,)):
        stamp_ns = raw.log_time_ns if by_recorder else header_stamp_ns(message)
        begun = begun or by_recorder or abs(stamp_ns - middle_ns) < JUMP_S * NS
        if not begun:
            problems["stamp: expected a time near the next ones, got one from before the clock was set"] += 1
            continue
        try:
            stamps.check(*divmod(stamp_ns, 10**9))
        except InputError as error:
            problems[str(error)] += 1
            continue
        yield stamp_ns, message
