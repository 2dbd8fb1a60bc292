"""Serves the station's page: who may open it, signs of life, pictures, start and end."""

from __future__ import annotations

import logging
import secrets
import socket
import threading
from collections.abc import Callable
from typing import TYPE_CHECKING, Any
from urllib.parse import parse_qs

from drocap_ros.errors import InputError
from drocap_ros.export.stream_out_config import is_loopback
from drocap_ros.station.page import Page
from drocap_ros.station.station import Station

if TYPE_CHECKING:
    from starlette.requests import Request
    from starlette.responses import Response

#: Messages that a page misses while its connection is interrupted; beyond them it is loaded anew.
_KEPT_MESSAGES = 50
#: Time for open connections at the end, s.
_CLOSING_S = 1


def listen(host: str, port: int) -> socket.socket:
    """Socket of an address, or an InputError where it is taken or not ours."""
    try:
        family, kind, _, _, place = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        sock = socket.socket(family, kind)
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        sock.bind(place)
        sock.listen()
    except OSError as error:
        raise InputError(
            f"--port: expected a free address, found {host}:{port} refused ({error.strerror}); choose another"
        ) from None
    return sock


class Door:
    """ASGI middleware: off the loopback a token is asked for once, then a cookie has it.

    On the loopback the name of this computer is: a foreign page whose name leads here is refused.
    """

    def __init__(self, app: Any, token: str, port: int) -> None:
        self._app, self._token, self._cookie = app, token, f"station_{port}"

    async def __call__(self, scope: Any, receive: Any, send: Any) -> None:
        """As of ASGI."""
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        from starlette.requests import HTTPConnection
        from starlette.responses import PlainTextResponse, RedirectResponse

        asks = HTTPConnection(scope)
        if self._is_known(asks):
            await self._app(scope, receive, send)
            return
        given = parse_qs(scope["query_string"].decode("latin-1")).get("token", [""])[0]
        if scope["type"] == "http" and self._token and secrets.compare_digest(given.encode(), self._token.encode()):
            answer: Response = RedirectResponse(scope["path"], 303)
            answer.set_cookie(self._cookie, self._token, httponly=True, samesite="strict")
        else:
            answer = PlainTextResponse("Open the address that `drocap station` has printed.\n", 403)
        await answer(scope, receive, send)

    def _is_known(self, asks: Any) -> bool:
        if self._token:
            return secrets.compare_digest(asks.cookies.get(self._cookie, "").encode(), self._token.encode())
        return is_loopback(asks.url.hostname or "")


def serve(station: Station, sock: socket.socket, token: str, stop: threading.Event) -> None:
    """Serve the page until ``stop``, or a signal."""
    import uvicorn
    from fastapi import FastAPI
    from nicegui import ui
    from starlette.responses import Response

    app = FastAPI(docs_url=None, redoc_url=None, openapi_url=None)
    app.add_middleware(Door, token=token, port=sock.getsockname()[1])

    def route(path: str, method: str, act: Callable[[Request], Response]) -> None:
        async def answer(request: Request) -> Response:
            return act(request)

        app.add_route(path, answer, methods=[method])

    def sign(act: Callable[[str], None]) -> Callable[[Request], Response]:
        def answer(request: Request) -> Response:
            # The header is none that a foreign page may set.
            page = request.headers.get("X-Station-Page")
            if page is not None:
                act(page)
            return Response(status_code=403 if page is None else 204)

        return answer

    def picture(_: Request) -> Response:
        data, kind = station.picture()
        headers = {"Cache-Control": "no-store"}
        return Response(data, 200 if data else 404, headers=headers, media_type=kind)

    route("/alive", "POST", sign(station.alive))
    route("/leave", "POST", sign(station.leave))
    route("/stop", "POST", sign(lambda page: station.order(page, "stop", {})))
    route("/picture", "GET", picture)

    @ui.page("/", title="drocap station")
    def page() -> None:
        Page(station)

    logging.getLogger("nicegui").setLevel(logging.ERROR)  # warnings of its own end are no user's business
    ui.run_with(
        app, dark=None, show_welcome_message=False, message_history_length=_KEPT_MESSAGES, binding_refresh_interval=None
    )
    server = uvicorn.Server(
        uvicorn.Config(app, log_level="critical", access_log=False, timeout_graceful_shutdown=_CLOSING_S)
    )
    watch = threading.Thread(target=_end, args=(server, station, stop), daemon=True)
    watch.start()
    server.run([sock])
    stop.set()
    watch.join()


def _end(server: Any, station: Station, stop: threading.Event) -> None:
    """End the server with ``stop``, and with the graph's thread."""
    while not stop.wait(0.2) and station.failure is None:
        pass
    server.should_exit = True
