"""Serves a page of this computer: its address, who may open it, start and end."""

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

if TYPE_CHECKING:
    from fastapi import FastAPI
    from starlette.responses import Response

#: Messages kept for a page whose connection is interrupted; a page that missed more is loaded anew.
_KEPT_MESSAGES = 50
#: Where the focus is; Quasar forbids outlines.
_FOCUS = ":is(:focus-visible, .q-field:has(:focus-visible)) { box-shadow: 0 0 0 3px #3fbdb5 !important; }"
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


def serve(
    build: Callable[[FastAPI], object],
    sock: socket.socket,
    stop: threading.Event,
    *,
    token: str = "",
    failed: Callable[[], bool] = lambda: False,
) -> None:
    """Serve what ``build`` adds to an application until ``stop``, a signal, or a failure."""
    import uvicorn
    from fastapi import FastAPI
    from nicegui import ui

    app = FastAPI(docs_url=None, redoc_url=None, openapi_url=None)
    app.add_middleware(Door, token=token, port=sock.getsockname()[1])
    build(app)
    ui.add_css(_FOCUS, shared=True)
    logging.getLogger("nicegui").setLevel(logging.ERROR)  # warnings of its own end are no user's business
    ui.run_with(
        app, dark=None, show_welcome_message=False, message_history_length=_KEPT_MESSAGES, binding_refresh_interval=None
    )
    server = uvicorn.Server(
        uvicorn.Config(app, log_level="critical", access_log=False, timeout_graceful_shutdown=_CLOSING_S)
    )

    def end() -> None:
        while not stop.wait(0.2) and not failed():
            pass
        server.should_exit = True

    watch = threading.Thread(target=end, daemon=True)
    watch.start()
    server.run([sock])
    stop.set()
    watch.join()
