"""The studio's HTTP server, with a time limit on the heads of requests."""

from __future__ import annotations

import asyncio

import h11
import uvicorn
from starlette.types import ASGIApp
from uvicorn.protocols.http.h11_impl import H11Protocol

HEAD_SECONDS = 20.0
"""Maximum time for a request's head, counted from the start of the connection or the head's first byte."""


class Impatient(H11Protocol):
    """uvicorn's HTTP/1.1 protocol, which closes a connection whose next request stays incomplete."""

    deadline: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]  # as in uvicorn's class
        """Start the timer for the first request."""
        super().connection_made(transport)
        self._await_head()

    def data_received(self, data: bytes) -> None:
        """Keep the timer running until the head is complete."""
        super().data_received(data)
        if self.conn.their_state is not h11.IDLE:
            self._stop_waiting()
        elif self.deadline is None:
            self._await_head()

    def connection_lost(self, exc: Exception | None) -> None:
        """Stop the timer."""
        self._stop_waiting()
        super().connection_lost(exc)

    def _await_head(self) -> None:
        self.deadline = self.loop.call_later(HEAD_SECONDS, self._close_if_idle)

    def _stop_waiting(self) -> None:
        if self.deadline is not None:
            self.deadline.cancel()
            self.deadline = None

    def _close_if_idle(self) -> None:
        self.deadline = None
        if self.conn.their_state is h11.IDLE and not self.transport.is_closing():
            self.transport.close()


def server_of(app: ASGIApp) -> uvicorn.Server:
    """Return a server, to be run on sockets that already listen."""
    return uvicorn.Server(uvicorn.Config(app, http=Impatient, log_level="warning", timeout_graceful_shutdown=2))
