"""Access control: only the studio's own page in the user's browser, and the user's programs, may use the server.

Other pages in the same browser, and other host names for this server, are rejected before a body is read.
"""

from __future__ import annotations

import asyncio
from collections.abc import Collection, Mapping

from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import JSONResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from stmc.viewing.studio.request_errors import RequestError
from stmc.viewing.studio.sessions import Sessions

MOST_BYTES = 2**20 + 2**16
"""Maximum size of a request that uploads no file."""

BODY_SECONDS = 30.0
"""Maximum time between two parts of a request's body."""

API = "/api/"

HEADERS = {
    "Content-Security-Policy": "default-src 'self'; img-src 'self' data: blob:; style-src 'self' 'unsafe-inline'; "
    "connect-src 'self' blob: data:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
}


class AccessControl:
    """ASGI middleware that requires our host and origin, a key, and requests of bounded size.

    The key is in the header `Authorization: Bearer KEY`, which browsers never send by themselves, and no other page can
    know it. The page itself holds no secret.

    Args:
        app: Application to protect.
        sessions: Keys of pages and programs.
        port: Port of the application.
        public: Addresses below `API` that need no key.
        uploads: Addresses that take larger requests, and their maximum size in bytes.
    """

    def __init__(
        self,
        app: ASGIApp,
        sessions: Sessions,
        port: int,
        public: Collection[str] = (),
        uploads: Mapping[str, int] | None = None,
    ) -> None:
        self.app, self.sessions, self.public, self.uploads = app, sessions, public, uploads or {}
        self.hosts = {f"{name}:{port}" for name in ("127.0.0.1", "localhost", "[::1]")}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "lifespan":
            await self.app(scope, receive, send)
        elif scope["type"] == "websocket":
            await _deny(scope, receive, send)
        elif (answer := self._refusal(scope)) is not None:
            await answer(scope, receive, _with_headers(scope, send))
        else:
            await self.app(scope, _limit_body(receive, self._most(scope)), _with_headers(scope, send))

    def _refusal(self, scope: Scope) -> Response | None:
        """Return the answer to a rejected request, or None."""
        headers, path = Headers(scope=scope), scope["path"]
        if headers.get("host") not in self.hosts:
            return error_response(403, "this is not an address of the studio")
        origin = headers.get("origin")
        if origin is not None and origin.removeprefix("http://") not in self.hosts:
            return error_response(403, "only the studio's own page may do that")
        if path.startswith(API) and path not in self.public and not self.sessions.knows(_bearer(headers)):
            sentence = "open the address that the terminal with `stmc studio` shows; programs send its token: see /api"
            return error_response(401, sentence)
        length, most = headers.get("content-length", "0"), self._most(scope)
        if not (length.isascii() and length.isdecimal()) or len(length) > 12 or int(length) > most:
            return error_response(413, f"the request is larger than {most / 2**20:.0f} MiB")
        return None

    def _most(self, scope: Scope) -> int:
        """Return the maximum number of bytes of a request to this path."""
        return self.uploads.get(scope["path"], MOST_BYTES)


def _bearer(headers: Headers) -> str:
    """Return the key of a request, empty without one."""
    scheme, _, key = headers.get("authorization", "").partition(" ")
    return key.strip() if scheme.lower() == "bearer" else ""


def error_response(status: int, sentence: str, **others: object) -> Response:
    """Build an error response; a request that was not read to its end also closes the connection.

    Args:
        status: HTTP status.
        sentence: Message to the user.
        **others: Further fields of the JSON object.
    """
    headers = {408: {"Connection": "close"}, 413: {"Connection": "close"}, 401: {"WWW-Authenticate": "Bearer"}}
    return JSONResponse({"error": sentence, **others}, status, headers.get(status))


async def _deny(scope: Scope, receive: Receive, send: Send) -> None:
    """Reject a WebSocket, with a message if the server can send one."""
    if "websocket.http.response" in scope.get("extensions", {}):
        await error_response(403, "the studio has no WebSockets")(scope, receive, send)
    else:
        await send({"type": "websocket.close", "code": 1008, "reason": "the studio has no WebSockets"})


def _limit_body(receive: Receive, most: int) -> Receive:
    """Limit the size of a body and the time between its parts; waiting for a disconnection has no limit."""
    total, complete = 0, False

    async def receive_part() -> Message:
        nonlocal total, complete
        if complete:
            return await receive()
        try:
            message = await asyncio.wait_for(receive(), BODY_SECONDS)
        except TimeoutError:
            raise RequestError(408, f"the rest of the request did not come within {BODY_SECONDS:g} s") from None
        complete = not message.get("more_body", False)
        total += len(message.get("body", b""))
        if total > most:
            raise RequestError(413, "the request is too large")
        return message

    return receive_part


def _with_headers(scope: Scope, send: Send) -> Send:
    """Add headers to every response; browsers do not cache the API, and revalidate files."""
    kept = "no-store" if scope["path"].startswith(API) else "no-cache"

    async def send_with_headers(message: Message) -> None:
        if message["type"] == "http.response.start":
            headers = MutableHeaders(scope=message)
            headers.update(HEADERS)
            headers.setdefault("Cache-Control", kept)
        await send(message)

    return send_with_headers
