"""Video of files and of packets in messages, decoded by FFmpeg's libraries (PyAV)."""

from __future__ import annotations

import contextlib
import logging
import re
import sys
from collections.abc import Iterable, Iterator
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from drocap_ros.errors import InputError, first_line
from drocap_ros.file_kind import FileKind, file_kind, unpacking
from drocap_ros.perception.sources.base import Frame, ImageSource, SourceEvent, SourceEventKind
from drocap_ros.perception.sources.image_files import is_mjpeg

if TYPE_CHECKING:
    import av
    from av.container import InputContainer
    from av.filter import Graph
    from av.video.codeccontext import VideoCodecContext
    from av.video.frame import VideoFrame
    from av.video.stream import VideoStream

log = logging.getLogger(__name__)

#: Version of PyAV that tells what an edit list hides and passes over tracks without reading them.
_LEAST_PYAV = (17, 1)
#: Missing frames at the end, against the container's count, from which the file counts as cut off.
_TAIL_FRAMES = 2
#: Pixels of other shapes are not believed.
_MAX_ASPECT = 4
_NS = 10**9
#: Bounds against damaged files: boxes at one level, and the bytes of an index of hours.
_MAX_BOXES, _MAX_INDEX = 4096, 1 << 26
#: Keys of the rate at which a phone recorded, and how much faster than the video's it must be for slow motion.
_CAPTURE_RATES, _SLOW = ("com.android.capture.fps", "com.apple.quicktime.capture.fps", "capture_fps"), 1.5
#: Codecs of messages' packets by their names there.
_CODECS = {r"[hx]\.?264|avc": "h264", r"[hx]\.?265|hevc": "hevc", "vp9": "vp9", "av1": "av1", "mjpe?g": "mjpeg"}


def pyav() -> Any:
    """The package av."""
    needed = ".".join(map(str, _LEAST_PYAV))
    try:
        import av
    except ImportError:
        found = "found none"
    else:
        if tuple(map(int, av.__version__.split(".")[:2])) >= _LEAST_PYAV:
            return av
        found = f"found {av.__version__}"
    raise InputError(
        f'video: expected PyAV {needed} or newer, {found}; run {sys.executable} -m pip install "av>={needed}"'
    )


def open_container(path: Path, form: str | None = None) -> InputContainer:
    """The container of a video file, which no other file or address can take part in."""
    av = pyav()
    # An absolute path is never taken for a protocol.
    whitelist = {"protocol_whitelist": "file"}
    return av.open(str(path.absolute()), format=form, options=whitelist, metadata_errors="replace")  # type: ignore[no-any-return]


def codec_of(name: str) -> str | None:
    """FFmpeg's name of the video codec that the format of a message names."""
    return next((codec for pattern, codec in _CODECS.items() if re.search(pattern, name, re.IGNORECASE)), None)


class Decoder:
    """Images of the packets of one stream as they are shown: progressive, upright, with square pixels, of one size.

    A packet that does not decode is counted and passed over.
    """

    def __init__(self, context: VideoCodecContext, time_base: Fraction, aspect: Fraction | None = None) -> None:
        self._av = pyav()
        self._context, self._time_base = context, time_base
        self._aspect = aspect if aspect and 1 / Fraction(_MAX_ASPECT) <= aspect <= _MAX_ASPECT else Fraction(1)
        self._scaler = self._av.video.reformatter.VideoReformatter()
        self._size: tuple[int, int] | None = None
        self._shape = Fraction(1)
        #: Whether a later image is of another shape, and stretched.
        self.reshaped = False
        self._progressive: Graph | None = None
        self._turn: int | None = None  # degrees, of the matrix by which images are shown
        self._matrix: Any = None
        #: Times of packets that did not decode, None where a packet has none, s.
        self.damaged: list[float | None] = []

    def images(self, packet: av.Packet[Any] | None) -> Iterator[tuple[int | None, np.ndarray]]:
        """Presentation times in ns and images (H, W, 3) uint8 BGR that follow from the next packet; None ends them."""
        try:
            frames = self._context.decode(packet)
        except self._av.error.EOFError:
            return
        except self._av.error.FFmpegError:
            pts = packet.pts if packet else None
            self.damaged.append(None if pts is None else float(pts * self._time_base))
            return
        for frame in frames:
            yield from map(self._shown, self._deinterlaced(frame))
        if self._progressive is not None and (packet is None or not packet.size):
            self._progressive.vpush(None)
            yield from map(self._shown, self._filtered())

    def _deinterlaced(self, frame: VideoFrame) -> Iterator[VideoFrame]:
        if self._progressive is None:
            if not frame.interlaced_frame:
                yield frame
                return
            graph = self._progressive = self._av.filter.Graph()
            source = graph.add_buffer(
                width=frame.width, height=frame.height, format=frame.format.name, time_base=self._time_base
            )
            graph.link_nodes(source, graph.add("yadif", "deint=interlaced"), graph.add("buffersink")).configure()
        self._progressive.vpush(frame)
        yield from self._filtered()

    def _filtered(self) -> Iterator[VideoFrame]:
        assert self._progressive is not None
        with contextlib.suppress(self._av.error.BlockingIOError, self._av.error.EOFError):
            while True:
                yield self._progressive.vpull()

    def _shown(self, frame: VideoFrame) -> tuple[int | None, np.ndarray]:
        if self._size is None:
            across = max(self._aspect, Fraction(1))
            self._size = round(frame.width * across), round(frame.height * across / self._aspect)
            self._shape = Fraction(frame.width, frame.height)
        self.reshaped |= abs(Fraction(frame.width, frame.height) / self._shape - 1) > 0.02  # no rounding
        # The way of OpenCV and of the program ffmpeg.
        bgr = self._scaler.reformat(frame, *self._size, "bgr24", interpolation="BICUBIC").to_ndarray()
        pts = frame.dts if frame.pts is None else frame.pts
        time_ns = None if pts is None else round(pts * (frame.time_base or self._time_base) * _NS)
        if frame.rotation != self._turn:
            # Seldom: a frame and its side data refer to each other, megabytes that wait for the garbage collector.
            self._turn = frame.rotation
            self._matrix = frame.side_data.get(self._av.sidedata.sidedata.Type.DISPLAYMATRIX)
        return time_ns, _upright(bgr, self._matrix)


def _upright(image: np.ndarray, matrix: Any) -> np.ndarray:
    """The image turned and mirrored by a display matrix of FFmpeg: rows a b u, c d v, which take x y to x' y'."""
    if matrix is None:
        return image
    a, b, _, c, d = np.frombuffer(matrix, np.int32)[:5].astype(np.int64)
    if abs(a) + abs(d) < abs(b) + abs(c):
        image, a, d = image.swapaxes(0, 1), c, b
    return np.ascontiguousarray(image[:: -1 if d < 0 else 1, :: -1 if a < 0 else 1])


class VideoSource(ImageSource):
    """Frames of a video file, of its largest track, of these the longest, or of a numbered one from 1 on.

    A stamp is the frame's presentation time in its container, from 0 at the first; variable frame rates keep
    their times.  What an edit list hides is left out.  Decoding goes on after damage, and a ``DAMAGED`` event
    follows at the end; a file that is cut off gives its frames up to the cut and an ``ENDED_EARLY`` event.
    """

    def __init__(self, path: Path, track: str = "") -> None:
        super().__init__()
        self.path, self._track = path, track
        if not path.is_file():
            raise InputError(f"{path}: expected a video file, found no such file; check the path")
        if (kind := file_kind(path)) is not FileKind.VIDEO and not (kind is FileKind.IMAGE and is_mjpeg(path)):
            raise InputError(f"{path}: expected a video file, found {kind.value}{unpacking(path)}")
        self._error = pyav().error.FFmpegError
        try:
            self._container = open_container(path, None if kind is FileKind.VIDEO else "mjpeg")
        except self._error as error:
            raise InputError(
                f"{path}: expected a video that FFmpeg can open, found {path.stat().st_size} bytes without a readable"
                f" header or index ({error.strerror or first_line(error)}); copy it again"
            ) from None
        self._closed = False
        self._last_ns: int | None = None
        self._origin_ns: int | None = None
        self._count = 0
        self._begin()

    def _begin(self) -> None:
        """Choose the track, read what the container states, and the first picture."""
        known = [stream for stream in self._container.streams.video if stream.codec_context is not None]
        shown = [s for s in known if not s.disposition & s.disposition.attached_pic]
        only_covers = not shown and len(known) == len(self._container.streams.video)
        if only_covers and self._container.streams.audio:
            self.close()
            raise InputError(f"{self.path}: expected a video, found sound without pictures; name the video")
        if not (known := shown or known):
            raise self._refused(f"no video of a known codec ({', '.join(track_codes(self.path)) or 'no track'})")
        self._stream = self._chosen(known)
        self._stream.thread_type = "AUTO"
        self._decoder = Decoder(self._stream.codec_context, _time_base(self._stream), self._stream.sample_aspect_ratio)
        rate = float(self._stream.guessed_rate or 0)
        self._rate_hz = rate if 0.1 < rate < 1000 else 30.0
        self._tell_slow_motion()
        if chapters := _other_chapters(self.path):
            names = f"{self.path.name} is one of {len(chapters) + 1} chapters"
            log.warning("%s: %s: only this one is used; join them: ffmpeg -f concat", self.path, names)
        self._stated_s = stated_s(self._container, self._stream)
        self.length = self._stated_length()
        self.duration_s = (self.length - 1) / self._rate_hz if self.length else None
        self._images = self._decoded()
        first = self._first = self._next()
        if first is None:
            raise self._refused(f"{self._stream.codec_context.codec.long_name} without a frame that it decodes")
        self.size = (first.image.shape[1], first.image.shape[0])

    def _tell_slow_motion(self) -> None:
        """A line where the camera says that it took more images a second than the video shows, as phones do."""
        stated = [self._container.metadata.get(key, "") for key in _CAPTURE_RATES]
        rates = [float(text) for text in stated if re.fullmatch(r"\d{1,4}(\.\d+)?", text)]
        if rates and rates[0] > _SLOW * self._rate_hz:
            log.warning(
                "%s: slow motion: recorded at %g images a second, shown at %.4g; --rate %g gives the true times",
                *(self.path, rates[0], self._rate_hz, rates[0]),
            )

    def _chosen(self, streams: list[VideoStream]) -> VideoStream:
        tracks = {str(number): stream for number, stream in enumerate(streams, 1)}
        if self._track:
            if self._track not in tracks:
                self.close()
                raise InputError(
                    f"--topic {self._track}: expected a video track of {self.path}, 1 to {len(tracks)}, or a topic of a"
                    " recording; correct it"
                )
            return tracks[self._track]
        largest = max(tracks, key=lambda n: (tracks[n].width * tracks[n].height, tracks[n].duration or 0))
        if len(tracks) > 1:
            sizes = ", ".join(f"{n} ({s.width}x{s.height} px)" for n, s in tracks.items())
            log.warning("%s: several video tracks, %s: %s is used, --topic N is another", self.path, sizes, largest)
        return tracks[largest]

    def _refused(self, found: str) -> InputError:
        self.close()
        return InputError(f"{self.path}: expected a video for FFmpeg, found {found}; convert it: ffmpeg -i IN OUT.mp4")

    def _stated_length(self) -> int | None:
        """Number of shown frames."""
        by_time = self._stated_s * self._rate_hz if self._stated_s else None
        if not self._stream.frames:
            return round(by_time) or None if by_time and by_time < 1e9 else None
        if by_time and by_time < self._stream.frames - _TAIL_FRAMES:  # an edit list hides some, as after a trim
            return sum(not entry.is_discard for entry in self._stream.index_entries) or None
        return self._stream.frames

    def read(self) -> Frame | None:
        """Next frame, or None at the end."""
        frame, self._first = self._first or self._next(), None
        if frame is None:
            self._report_end()
            self.close()
        else:
            self._count += 1
        return frame

    def _next(self) -> Frame | None:
        found = None if self._closed else next(self._images, None)
        return Frame(self._stamp(found[0]), found[1]) if found else None

    def _decoded(self) -> Iterator[tuple[int | None, np.ndarray]]:
        try:
            for packet in self._container.demux(self._stream):
                yield from self._decoder.images(packet)
        except self._error:  # the container ends in damage
            yield from self._decoder.images(None)

    def _stamp(self, time_ns: int | None) -> int:
        if self._last_ns is None:
            self._origin_ns, now = time_ns, 0
        else:
            now = -1 if time_ns is None or self._origin_ns is None else time_ns - self._origin_ns
            if now <= self._last_ns:
                if time_ns is None:  # raw H.264
                    self._tell(SourceEventKind.NO_TIMES, "the nominal rate is used")
                now = self._last_ns + round(_NS / self._rate_hz)
        self._last_ns = now
        return now

    def _tell(self, kind: SourceEventKind, detail: str) -> None:
        if all(event.kind is not kind for event in self._events):
            self._events.append(SourceEvent(kind, str(self.path), detail))

    def _report_end(self) -> None:
        if self._closed or self._last_ns is None:
            return
        end_s, before = self._last_ns * 1e-9, len(self._events)
        if self._decoder.reshaped:
            log.warning("%s: the shape of the images changes: later ones are stretched; cut it there", self.path)
        decoded = f"{self._count} of {self.length} frames decoded"
        if not self._stream.frames:
            decoded = f"{end_s:.1f} of {self._stated_s or end_s:.1f} s decoded"
        short = not self._stream.frames or (self.length is not None and self._count < self.length - _TAIL_FRAMES)
        tail_s = _TAIL_FRAMES * end_s / max(self._count - 1, 1)
        begin_s = max(self._origin_ns or 0, 0) * 1e-9  # in Matroska the duration is a time: that of the end
        if short and self._stated_s and begin_s + end_s + tail_s < self._stated_s - _TAIL_FRAMES / self._rate_hz:
            self._tell(SourceEventKind.ENDED_EARLY, f"cut off or damaged, {decoded}")
        elif damaged := self._decoder.damaged:
            near = next((f" near {time_s:.1f} s" for time_s in damaged if time_s is not None), "")
            self._tell(SourceEventKind.DAMAGED, f"packets that do not decode: {len(damaged)}{near}; {decoded}")
        for event in self._events[before:]:
            log.warning(str(event))

    def close(self) -> None:
        """Close the file."""
        self._closed = True
        self._container.close()


def _other_chapters(path: Path) -> list[Path]:
    """The other files of a GoPro's recording: GX010012.MP4, GX020012.MP4, older ones GOPR0012.MP4, GP010012.MP4."""
    found = re.fullmatch(r"(?:G[XHLP]\d\d|GOPR)(\d{4})", path.stem, re.IGNORECASE)
    others = path.parent.glob(f"[Gg]*[0-9]{path.suffix}") if found else ()
    same = re.compile(rf"(?:G[XHLP]\d\d|GOPR){found[1]}" if found else "", re.IGNORECASE)
    kind = path.stem[:2].upper()
    return [
        p
        for p in others
        if p != path and same.fullmatch(p.stem) and (kind in ("GP", "GO") or p.stem[:2].upper() == kind)
    ]


def _time_base(stream: VideoStream) -> Fraction:
    return stream.time_base or Fraction(1, _NS)


def stated_s(container: InputContainer, stream: VideoStream) -> float | None:
    """Duration that a file states of a stream, else of all, s."""
    if stream.duration:
        return float(stream.duration * _time_base(stream))
    return container.duration / 1e6 if container.duration else None


def track_codes(path: Path) -> list[str]:
    """Formats of the tracks of an MP4 or MOV file (ISO/IEC 14496-12), such as avc1 and djmd; none of another file.

    FFmpeg has the tracks in this order, and tells no format that it does not know.
    """
    end = path.stat().st_size
    with path.open("rb") as file:
        place = 0
        for _ in range(_MAX_BOXES):
            file.seek(place)
            head = file.read(16)
            size = int.from_bytes(head[8:] if head[:4] == b"\0\0\0\x01" else head[:4], "big")
            if head[4:8] == b"moov" and size <= _MAX_INDEX:
                tracks = file.read(size).split(b"trak")[1:]
                found = (re.search(rb"stsd.{12}(.{4})", track, re.DOTALL) for track in tracks)
                return [match[1].decode("latin1") if match else "" for match in found]
            if size < 8 or (place := place + size) >= end:
                break
    return []


def decoded_packets(codec: str, packets: Iterable[tuple[int, bytes]]) -> Iterator[tuple[int, np.ndarray]]:
    """Stamps and images of packets with their stamps; those before the first key frame are left out."""
    name = codec_of(codec)
    if name is None:
        raise InputError(f"video: expected H.264, H.265, VP9, AV1 or MJPEG, found {codec[:40]!r}; convert it")
    av = pyav()
    context = av.CodecContext.create(name, "r")
    context.thread_type = "AUTO"
    decoder, none = Decoder(context, Fraction(1, _NS)), True
    for stamp_ns, data in packets:
        if data:
            packet = av.Packet(len(data))  # made of Python's bytes it would be freed by threads of FFmpeg: a deadlock
            packet.update(data)
            packet.pts, packet.time_base = stamp_ns, Fraction(1, _NS)
            for time_ns, image in decoder.images(packet):
                none = False
                yield stamp_ns if time_ns is None else time_ns, image
    for time_ns, image in decoder.images(None):
        none = False
        yield time_ns or 0, image
    if none:
        raise InputError(f"video: expected a key frame of {codec[:40]!r}, found none; record it again")
