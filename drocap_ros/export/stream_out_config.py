"""Parameters of the node ``stream_out``: where the newest pose goes."""

from __future__ import annotations

import ipaddress
from dataclasses import dataclass

from drocap_ros.errors import ParameterError
from drocap_ros.parameters import Parameters, param


@dataclass(frozen=True)
class StreamOutConfig(Parameters):
    """The newest pose to other programs, by VMC (OSC over UDP) and as JSON by a WebSocket."""

    vmc: str = param("", "HOST:PORT of a VMC receiver, usually port 39539; empty = none")
    websocket: str = param(
        "", "HOST:PORT to listen on for WebSocket clients; 0.0.0.0 is open to the network; empty = none"
    )
    stage: str = param(
        "latest", "pose3d/latest, adjusted, or pose3d/initial, of one image alone", choices=("latest", "initial")
    )
    rate_hz: float = param(
        30.0, "least rate: each pose is sent at once, the newest one again after a pause", "Hz", 1, 240
    )
    camera_pitch_deg: float = param(
        0.0, "pitch of the camera, negative = down, that levels poses in its own frame", "deg", -90, 90
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("vmc", "websocket"):
            if text := getattr(self, name):
                address_of(text, name)


def address_of(text: str, name: str) -> tuple[str, int]:
    """Host and port of HOST:PORT; ``name`` stands in the error."""
    host, _, port = text.rpartition(":")
    if not (host and port.isascii() and port.isdigit() and 0 < int(port) < 65536):
        raise ParameterError(f"{name}: expected HOST:PORT with a port from 1 to 65535, got {text!r}; correct it")
    return host.strip("[]"), int(port)


def is_loopback(host: str) -> bool:
    """Whether an address is this machine's own alone."""
    try:
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:  # another name, whatever it begins with
        return False
