"""Images from messages: one message to an array, or those of a recording one at a time."""

from __future__ import annotations

import itertools
import math
from collections import Counter
from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from drocap_ros.errors import InputError
from drocap_ros.perception.sources.image_files import NO_PICTURE, colour_rank, decoded, raw_to_bgr
from drocap_ros.perception.sources.video import codec_of, decoded_packets
from drocap_ros.recording.session import IMAGES, Message, Session, TopicInfo, header_stamp_ns
from drocap_ros.stamps import CONFIRMED_AFTER, NS

if TYPE_CHECKING:
    from drocap_ros.perception.sources.base import Frame

#: Rank of a topic of distances or labels, behind colour (0) and grey (1).
_DEPTH_RANK = 2
#: Least step of stamps against the recorder's times that is one of the clock, and no jitter.
_STEP_NS = NS


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
    if not found:
        there = ", ".join(f"{t.name} ({t.type_name})" for t in session.info.topics if t.count)
        there = there or ("no messages" if session.info.topics else "no topics")
        raise InputError(f"{session.path}: expected a topic with images, found {there}; record one")
    if len(found) < 2:
        return found[0]
    ranks = {topic: _rank(session, topic) for topic in found}
    least = min(rank for rank, _ in ranks.values())
    best = [topic for topic in found if ranks[topic][0] == least]
    # A small picture is a preview of the large one, of which few images are no recording.
    chosen = max(best, key=lambda topic: (2 * topic.count > best[0].count, ranks[topic][1]))
    if least == _DEPTH_RANK:
        raise InputError(f"{session.path}: expected colour or grey images, found {names}; choose one with --topic NAME")
    if len(best) > 1:
        session.warn(f"several topics of images: {names}; took {chosen.name}, --topic NAME chooses another")
    return chosen


def _rank(session: Session, topic: TopicInfo) -> tuple[int, float]:
    """0 for colour, 1 for grey, 2 for distances and labels, and the area, by the first message; infinity of a video."""
    first = next((message for _, message in session.messages((topic.name,))), None)
    form = str(getattr(first, "encoding", getattr(first, "format", "")))
    rank = _DEPTH_RANK if first is None or NO_PICTURE.search(topic.name) else colour_rank(form)
    try:
        return rank, float(np.prod(image_from_message(first).shape[:2]))
    except (InputError, AttributeError, ValueError):  # a packet of a video, or damage
        return rank, math.inf if codec_of(form) else 0.0


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
    if last_ns is None:
        raise InputError(f"{session.path}: {chosen.name}: expected images, found {chosen.count} messages of"
                         f" {chosen.type_name} that cannot be decoded; record them with their definition")  # fmt: skip


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
    """Messages with their stamps by one clock, or with the recorder's times where the stamps do not advance."""
    times = [(header_stamp_ns(message), raw.log_time_ns) for raw, message in session.messages((topic,))]
    by_recorder = sum(b > a for (a, _), (b, _) in itertools.pairwise(times)) < (len(times) - 1) / 2
    if by_recorder:
        session.warn(f"the stamps on {topic} do not advance: the recorder's times are used, late by the transport")
    stamps = [log_ns for _, log_ns in times] if by_recorder else _of_one_clock(session, topic, times)
    for (_, message), stamp_ns in zip(session.messages((topic,)), stamps, strict=False):
        if stamp_ns is not None and stamp_ns >= 0:
            yield stamp_ns, message
        else:
            problems["stamp: expected a time of the others' clock, got one from before it was set, or a stray one"] += 1


def _of_one_clock(session: Session, topic: str, times: list[tuple[int, int]]) -> list[int | None]:
    """Stamps by the clock of most messages, None for stray ones.

    A clock that is set during the recording makes a step of the stamps that the recorder's times do not have: what
    comes before and behind it is joined by these.

    times : stamp and recorder's time of each message, ns
    """
    clocks: list[list[int]] = []  # numbers of the messages of each
    before: tuple[list[int], int, int] | None = None
    for i, (stamp_ns, log_ns) in enumerate(times):
        step_ns, passed_ns = (0, 0) if before is None else (stamp_ns - before[1], log_ns - before[2])
        if before is None or (abs(step_ns - passed_ns) > _STEP_NS and not 0 < step_ns < _STEP_NS):
            own = [c for c in clocks if abs(stamp_ns - log_ns - times[c[-1]][0] + times[c[-1]][1]) < _STEP_NS]
            clock = own[0] if own else []
            clocks += [] if own else [clock]
        else:
            clock = before[0]
        clock.append(i)
        before = clock, stamp_ns, log_ns
    stamps: list[int | None] = [None] * len(times)
    main = max(clocks, key=len, default=[])
    offsets = [_offset_ns(times, clock) for clock in clocks]
    for clock, offset_ns in zip(clocks, offsets, strict=True):
        if clock is main or len(clock) >= CONFIRMED_AFTER:
            step_ns = 0 if clock is main else _offset_ns(times, main) - offset_ns
            for i in clock:
                stamps[i] = times[i][0] + step_ns
            if step_ns:
                session.warn(f"the clock of {topic} was set during the recording, by {-step_ns * 1e-9:+.1f} s: its"
                             f" {len(clock)} images are joined to the others by the recorder's times")  # fmt: skip
    return stamps


def _offset_ns(times: list[tuple[int, int]], clock: list[int]) -> int:
    """Median of a clock's stamps less the recorder's times."""
    return sorted(times[i][0] - times[i][1] for i in clock)[len(clock) // 2]
