"""Who may talk to the studio: its own page, in the browser of whoever started it, and nobody else.

Other pages in the same browser, and names of other hosts that lead here, are refused before anything is read.
"""

from __future__ import annotations

import hmac
from http.cookies import CookieError, SimpleCookie
from urllib.parse import parse_qs

from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import JSONResponse, PlainTextResponse, RedirectResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

MOST_BYTES = 2**20 + 2**16
"""Of a request."""

MOST_UPLOAD = 32 * 2**20
"""Of a motion that is brought along."""

UPLOADS = "/api/motions"

HEADERS = {
    "Content-Security-Policy": "default-src 'self'; img-src 'self' data: blob:; style-src 'self' 'unsafe-inline'; "
    "connect-src 'self' blob:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
}


class Guard:
    """An ASGI application before another one: asks for the token (in the address once, then in a cookie), for our own
    host and origin, for a header that other pages cannot send, and for requests of bounded size."""

    def __init__(self, app: ASGIApp, token: str, port: int) -> None:
        self.app, self.token = app, token
        self.cookie = f"stmc-{port}"
        self.hosts = {f"{name}:{port}" for name in ("127.0.0.1", "localhost", "[::1]")}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            if scope["type"] == "lifespan":
                await self.app(scope, receive, send)
            return
        answer = self._refusal(scope)
        if answer is not None:
            await answer(scope, receive, _with_headers(send))
            return
        await self.app(scope, _bounded(receive, _most(scope)), _with_headers(send))

    def _refusal(self, scope: Scope) -> Response | None:
        """The answer where the request goes no further."""
        headers = Headers(scope=scope)
        if headers.get("host") not in self.hosts:
            return _refused(403, "this is not an address of the studio")
        if scope["method"] == "GET" and scope["path"] == "/" and self._given(scope):
            answer = RedirectResponse("/", 303)
            answer.set_cookie(self.cookie, self.token, httponly=True, samesite="strict", path="/")
            return answer
        if not hmac.compare_digest(self._cookie(headers).encode(), self.token.encode()):
            return PlainTextResponse("Open the address that the terminal with `stmc studio` shows.\n", 401)
        if scope["method"] not in ("GET", "HEAD"):
            origin = headers.get("origin")
            ours = origin is None or origin.removeprefix("http://") in self.hosts
            if headers.get("x-stmc") != "1" or not ours:
                return _refused(403, "only the studio's own page may do that")
            length = headers.get("content-length", "0")
            if not length.isdecimal() or len(length) > 12 or int(length) > _most(scope):
                return _refused(413, f"the request is larger than {_most(scope) / 2**20:.0f} MiB")
        return None

    def _given(self, scope: Scope) -> bool:
        given = parse_qs(scope["query_string"].decode("latin-1")).get("token", [""])[0]
        return hmac.compare_digest(given.encode("utf-8", "replace"), self.token.encode())

    def _cookie(self, headers: Headers) -> str:
        try:
            jar = SimpleCookie(headers.get("cookie", ""))
        except CookieError:
            return ""
        return jar[self.cookie].value if self.cookie in jar else ""


class TooLarge(Exception):
    """More bytes came than were announced, or than are taken."""


def _most(scope: Scope) -> int:
    """Bytes of a request to this path."""
    return MOST_UPLOAD if scope["path"] == UPLOADS else MOST_BYTES


def _bounded(receive: Receive, most: int) -> Receive:
    """Stops reading where a request is longer than it said."""
    total = 0

    async def bounded() -> Message:
        nonlocal total
        message = await receive()
        total += len(message.get("body", b""))
        if total > most:
            raise TooLarge
        return message

    return bounded


def _with_headers(send: Send) -> Send:
    async def sent(message: Message) -> None:
        if message["type"] == "http.response.start":
            MutableHeaders(scope=message).update(HEADERS)
        await send(message)

    return sent


def _refused(status: int, sentence: str) -> Response:
    return JSONResponse({"error": sentence}, status)
