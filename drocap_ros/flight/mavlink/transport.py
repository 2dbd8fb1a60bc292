"""Byte transports under MAVLink: UDP, TCP and serial, opened from one URL."""

from __future__ import annotations

import errno
import fcntl
import re
import select
import socket
import termios
import time
from typing import TYPE_CHECKING, Protocol, TypeAlias

from drocap_ros.errors import DrocapError, InputError

if TYPE_CHECKING:
    import serial

URL_FORMS = "udpin:HOST:PORT, udpout:HOST:PORT, tcp:HOST:PORT or serial:DEVICE[:BAUD]"
Address: TypeAlias = tuple[str | int | bytes, ...]  # of a datagram, as its family has it
_MAX_DATAGRAM = 65535  # bytes of UDP
_TAKEN = (errno.EADDRINUSE, errno.EAGAIN, errno.EBUSY)  # of UDP, of the lock of a serial port, of its exclusive use
#: The guardian of a bridge that died holds its port for 1.6 s at most; tried again so often.
_HELD_S, _AGAIN_S = 2.0, 0.1


class LinkError(DrocapError):
    """The link to the autopilot broke."""


class _TakenError(InputError):
    """Another program holds the port."""


class Transport(Protocol):
    """Carries bytes to and from an autopilot.

    sender : of the latest datagram; None = there is one peer
    """

    sender: Address | None = None

    def read(self, timeout_s: float) -> bytes:
        """Bytes that arrive within the time, maybe none.  Raises LinkError when the link broke."""

    def write(self, data: bytes) -> bool:
        """Send; False without a peer or without room."""

    def accept_peer(self) -> None:
        """Send to the sender of the latest datagram from now on; where there is one peer, do nothing."""
        return

    def port(self) -> tuple[int, Address | None]:
        """Descriptor of the open port, and where its datagrams go; None = it is no port of datagrams."""

    def close(self) -> None:
        """Close the port."""


def open_transport(url: str) -> Transport:
    """Open the transport that a URL names: one of ``URL_FORMS``, also with ``//`` after the colon."""
    last_s = time.monotonic() + _HELD_S
    while True:
        try:
            return _open(url)
        except _TakenError:
            if time.monotonic() > last_s:
                raise
        time.sleep(_AGAIN_S)


def _open(url: str) -> Transport:
    match = re.fullmatch(r"(udp|udpin|udpout|tcp|serial):(?://)?(.+)", url.strip())
    if match is None:
        raise InputError(f"url: expected {URL_FORMS}, got {url!r}; correct the parameter")
    kind, rest = match.groups()
    if kind == "serial":
        return _open_serial(rest, url)
    host, port = _address(rest, url)
    try:
        if kind == "tcp":
            return _TcpTransport(host, port)
        return _UdpTransport(host, port, listen=kind != "udpout")
    except OSError as error:
        raise _refusal(error)(
            f"url: expected an address that can be opened, got {url!r}: {error.strerror or error}; "
            "check host and port, and that no other program holds them"
        ) from None


def _address(text: str, url: str) -> tuple[str, int]:
    host, _, port = text.rpartition(":")
    if not port.isdigit() or not 0 < int(port) < 65536:
        raise InputError(f"url: expected a port from 1 to 65535 after the last colon, got {url!r}; use {URL_FORMS}")
    return host.strip("[]") or "0.0.0.0", int(port)


def _open_serial(rest: str, url: str) -> Transport:
    device, _, baud = rest.rpartition(":")
    if not device:
        # Telemetry radios have this baud rate as shipped.
        device, baud = rest, "57600"
    if not baud.isdigit() or int(baud) == 0:
        raise InputError(f"url: expected a baud rate after the last colon, got {url!r}; use serial:/dev/ttyACM0:57600")
    try:
        import serial
    except ImportError:
        raise InputError(
            "url: expected the package pyserial for serial URLs, found none; pip install pyserial"
        ) from None
    try:
        port = serial.Serial(device, int(baud), timeout=0, write_timeout=0.2, exclusive=True)
        # Ground stations that open each autopilot they find heed no lock, and would read half of what comes.
        fcntl.ioctl(port.fileno(), termios.TIOCEXCL)
        return _SerialTransport(port)
    except (serial.SerialException, OSError, ValueError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise _refusal(error)(f"url: expected a serial device that can be opened, got {url!r}: {reason}") from None


def _refusal(error: Exception) -> type[InputError]:
    """What a port that cannot be opened is refused with."""
    return _TakenError if getattr(error, "errno", None) in _TAKEN else InputError


class _UdpTransport(Transport):
    def __init__(self, host: str, port: int, listen: bool) -> None:
        family, _, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)[0]
        self._socket = socket.socket(family, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        self._peer: Address | None = None if listen else address
        self._fixed_peer = not listen
        try:
            if listen:
                self._socket.bind(address)
        except OSError:
            self._socket.close()
            raise

    def read(self, timeout_s: float) -> bytes:
        if not select.select([self._socket], [], [], timeout_s)[0]:
            return b""
        try:
            data, self.sender = self._socket.recvfrom(_MAX_DATAGRAM)
        except (BlockingIOError, ConnectionRefusedError):  # refused: no peer listens yet
            return b""
        return data

    def write(self, data: bytes) -> bool:
        if self._peer is None:
            return False
        try:
            self._socket.sendto(data, self._peer)
        except OSError:
            return False
        return True

    def accept_peer(self) -> None:
        if not self._fixed_peer and self.sender is not None:
            self._peer = self.sender

    def port(self) -> tuple[int, Address | None]:
        return self._socket.fileno(), self._peer

    def close(self) -> None:
        self._socket.close()


class _TcpTransport(Transport):
    def __init__(self, host: str, port: int) -> None:
        # A local network connects sooner.
        self._socket = socket.create_connection((host, port), timeout=3.0)
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._socket.setblocking(False)

    def read(self, timeout_s: float) -> bytes:
        try:
            if not select.select([self._socket], [], [], timeout_s)[0]:
                return b""
            data = self._socket.recv(_MAX_DATAGRAM)
        except BlockingIOError:
            return b""
        except OSError as error:
            raise LinkError(f"the TCP link to the autopilot broke: {error.strerror or error}") from None
        if not data:
            raise LinkError("the autopilot's side closed the TCP link")
        return data

    def write(self, data: bytes) -> bool:
        # A partial write would tear a packet: MAVLink resynchronizes, and the packets are small.
        try:
            return self._socket.send(data) == len(data)
        except BlockingIOError:
            return False
        except OSError as error:
            raise LinkError(f"the TCP link to the autopilot broke: {error.strerror or error}") from None

    def port(self) -> tuple[int, None]:
        return self._socket.fileno(), None

    def close(self) -> None:
        self._socket.close()


class _SerialTransport(Transport):
    def __init__(self, port: serial.Serial) -> None:
        self._port = port

    def read(self, timeout_s: float) -> bytes:
        try:
            if not select.select([self._port.fileno()], [], [], timeout_s)[0]:
                return b""
            data = bytes(self._port.read(_MAX_DATAGRAM))
        except Exception as error:  # noqa: BLE001  drivers raise many kinds on a lost device
            raise LinkError(f"the serial link to the autopilot broke: {error}") from None
        if not data:
            raise LinkError("the serial link to the autopilot broke: the device is gone")
        return data

    def write(self, data: bytes) -> bool:
        try:
            return bool(self._port.write(data) == len(data))
        except Exception:  # noqa: BLE001  as above; what is not sent is a gap of the stream
            return False

    def port(self) -> tuple[int, None]:
        return self._port.fileno(), None

    def close(self) -> None:
        self._port.close()
