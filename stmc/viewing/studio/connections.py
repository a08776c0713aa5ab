"""The studio's server, whose connections do not wait for ever for a request to begin or to go on."""

from __future__ import annotations

import asyncio

import h11
import uvicorn
from starlette.types import ASGIApp
from uvicorn.protocols.http.h11_impl import H11Protocol

HEAD_SECONDS = 20.0
"""Within which a request's head has to come, from the connection's beginning or the head's first byte on."""


class Impatient(H11Protocol):
    """HTTP/1.1 as uvicorn speaks it, which closes a connection whose next request stays half said."""

    deadline: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:
        """Begin to wait for the first request."""
        super().connection_made(transport)
        self._await_head()

    def data_received(self, data: bytes) -> None:
        """Go on waiting while the head is not whole; time that has passed counts."""
        super().data_received(data)
        if self.conn.their_state is not h11.IDLE:
            self._stop_waiting()
        elif self.deadline is None:
            self._await_head()

    def connection_lost(self, exc: Exception | None) -> None:
        """Wait no longer."""
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
    """A server that is still to be run, on sockets that listen already."""
    return uvicorn.Server(uvicorn.Config(app, http=Impatient, log_level="warning", timeout_graceful_shutdown=2))
