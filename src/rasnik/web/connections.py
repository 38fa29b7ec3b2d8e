"""Connections of the page's server: whoever connects and asks nothing is let go.

The number of connections is limited, and somebody without a token could hold all of them.
"""

from __future__ import annotations

import asyncio
from typing import Any

from uvicorn.protocols.http.h11_impl import H11Protocol

__all__ = ["PATIENCE_S", "Connection"]

#: At the latest twice this time after the last answer the next request has come.
PATIENCE_S = 10.0


class Connection(H11Protocol):
    """As uvicorn has it, which would wait for ever for the head of a request."""

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        super().connection_made(transport)
        self._look_later()

    def _look_later(self) -> None:
        self.loop.call_later(PATIENCE_S, self._look, self.cycle)

    def _look(self, before: Any) -> None:
        """Close the connection if nothing was asked since `before`, the request of then."""
        if self.transport.is_closing() or self.transport.get_protocol() is not self:
            return  # it is over, or is a websocket now
        cycle: Any = self.cycle  # None before the first request
        if cycle is before and (cycle is None or cycle.response_complete):
            self.transport.close()
            return
        self._look_later()
