"""What the station serves: its page, pictures, signs of life and the stop."""

from __future__ import annotations

import socket
import threading
from collections.abc import Callable
from typing import TYPE_CHECKING

from drocap_ros.app import serving
from drocap_ros.station.page import Page
from drocap_ros.station.station import Station

if TYPE_CHECKING:
    from fastapi import FastAPI
    from starlette.requests import Request
    from starlette.responses import Response


def serve(station: Station, sock: socket.socket, token: str, stop: threading.Event) -> None:
    """Serve the page until ``stop``, a signal, or the end of the graph's thread."""

    def build(app: FastAPI) -> None:
        _add_routes(app, station)
        ui.page("/", title="drocap station")(lambda: Page(station))

    from nicegui import ui

    serving.serve(build, sock, stop, token=token, failed=lambda: station.failure is not None)


def _add_routes(app: FastAPI, station: Station) -> None:
    from starlette.responses import Response

    def sign(path: str, act: Callable[[str], None]) -> None:
        async def answer(request: Request) -> Response:
            # The header is none that a foreign page may set.
            page = request.headers.get("X-Station-Page")
            if page is not None:
                act(page)
            return Response(status_code=403 if page is None else 204)

        app.add_route(path, answer, methods=["POST"])

    async def picture(_: Request) -> Response:
        data, kind = station.picture()
        headers = {"Cache-Control": "no-store"}
        return Response(data, 200 if data else 404, headers=headers, media_type=kind)

    sign("/alive", station.alive)
    sign("/leave", station.leave)
    sign("/stop", lambda page: station.order(page, "stop", {}))
    app.add_route("/picture", picture)
