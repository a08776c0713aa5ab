"""Access control: only the studio's own page in the user's browser may use the server.

Other pages in the same browser, and other host names for this server, are rejected before a body is read.
"""

from __future__ import annotations

import asyncio

from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import JSONResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from stmc.viewing.studio.request_errors import RequestError
from stmc.viewing.studio.sessions import Sessions

MOST_BYTES = 2**20 + 2**16
"""Maximum size of a request."""

MOST_UPLOAD = 32 * 2**20
"""Maximum size of an uploaded motion."""

BODY_SECONDS = 30.0
"""Maximum time between two parts of a request's body."""

API, SESSION, UPLOADS = "/api/", "/api/session", "/api/motions"

HEADERS = {
    "Content-Security-Policy": "default-src 'self'; img-src 'self' data: blob:; style-src 'self' 'unsafe-inline'; "
    "connect-src 'self' blob:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
}


class AccessControl:
    """ASGI middleware that requires our host and origin, the session's key, and requests of bounded size.

    The key is in the header `X-Stmc`, and no other page can know it. The page itself holds no secret.
    """

    def __init__(self, app: ASGIApp, sessions: Sessions, port: int) -> None:
        self.app, self.sessions = app, sessions
        self.hosts = {f"{name}:{port}" for name in ("127.0.0.1", "localhost", "[::1]")}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "lifespan":
            await self.app(scope, receive, send)
        elif scope["type"] == "websocket":
            await _deny(scope, receive, send)
        elif (answer := self._refusal(scope)) is not None:
            await answer(scope, receive, _with_headers(scope, send))
        else:
            await self.app(scope, _bounded(receive, _most(scope)), _with_headers(scope, send))

    def _refusal(self, scope: Scope) -> Response | None:
        """Return the answer to a rejected request, or None."""
        headers, path = Headers(scope=scope), scope["path"]
        if headers.get("host") not in self.hosts:
            return error_response(403, "this is not an address of the studio")
        origin = headers.get("origin")
        if origin is not None and origin.removeprefix("http://") not in self.hosts:
            return error_response(403, "only the studio's own page may do that")
        if path.startswith(API) and path != SESSION and not self.sessions.knows(headers.get("x-stmc", "")):
            return error_response(401, "open the address that the terminal with `stmc studio` shows")
        length = headers.get("content-length", "0")
        if not (length.isascii() and length.isdecimal()) or len(length) > 12 or int(length) > _most(scope):
            return error_response(413, f"the request is larger than {_most(scope) / 2**20:.0f} MiB")
        return None


def error_response(status: int, sentence: str, **others: object) -> Response:
    """Build an error response; a request that was not read to its end also closes the connection.

    Args:
        status: HTTP status.
        sentence: Message to the user.
        **others: Further fields of the JSON object.
    """
    headers = {"Connection": "close"} if status in (408, 413) else None
    return JSONResponse({"error": sentence, **others}, status, headers)


async def _deny(scope: Scope, receive: Receive, send: Send) -> None:
    """Reject a WebSocket, with a message if the server can send one."""
    if "websocket.http.response" in scope.get("extensions", {}):
        await error_response(403, "the studio has no WebSockets")(scope, receive, send)
    else:
        await send({"type": "websocket.close", "code": 1008, "reason": "the studio has no WebSockets"})


def _most(scope: Scope) -> int:
    """Return the maximum number of bytes of a request to this path."""
    return MOST_UPLOAD if scope["path"] == UPLOADS else MOST_BYTES


def _bounded(receive: Receive, most: int) -> Receive:
    """Limit the size of a body and the time between its parts; waiting for a disconnection has no limit."""
    total, complete = 0, False

    async def bounded() -> Message:
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

    return bounded


def _with_headers(scope: Scope, send: Send) -> Send:
    """Add headers to every response; browsers do not cache the API, and revalidate files."""
    kept = "no-store" if scope["path"].startswith(API) else "no-cache"

    async def sent(message: Message) -> None:
        if message["type"] == "http.response.start":
            headers = MutableHeaders(scope=message)
            headers.update(HEADERS)
            headers.setdefault("Cache-Control", kept)
        await send(message)

    return sent
