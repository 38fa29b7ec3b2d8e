"""The page's server proper: a thread that answers on a socket."""

from __future__ import annotations

import socket
import threading
import time
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rasnik.live.service import Station

__all__ = ["PageError", "Serving"]

_PATIENCE_S = 10.0


class PageError(Exception):
    """The page cannot be served; the message is a sentence with its remedy."""


class Serving:
    """Answers requests from its making until it is stopped.

    Parameters
    ----------
    station : Station
        Or what stands in its place in another process.
    token : str or None
    listener : socket
        Listens already.

    Raises
    ------
    PageError
        If a package is missing.
    """

    def __init__(self, station: Station, token: str | None, listener: socket.socket) -> None:
        try:
            import uvicorn

            from rasnik.web.app import create_app
            from rasnik.web.connections import Connection
        except ImportError as error:
            raise PageError(
                f"The page needs {error.name}; install it with: pip install 'rasnik[live]'"
            ) from None
        self._server = uvicorn.Server(
            uvicorn.Config(
                create_app(station, token=token),
                ws="websockets-sansio",
                http=Connection,
                loop="asyncio",
                lifespan="off",
                log_config=None,
                access_log=False,
                server_header=False,
                proxy_headers=False,
                ws_max_size=16 * 1024,
                ws_per_message_deflate=False,  # pictures are compressed already
                limit_concurrency=200,
                timeout_keep_alive=15,
                timeout_graceful_shutdown=2,
            )
        )
        self._thread = threading.Thread(
            target=self._server.run, args=([listener],), name="page", daemon=True
        )
        self._thread.start()
        end = time.monotonic() + _PATIENCE_S
        while not self._server.started:
            if not self._thread.is_alive() or time.monotonic() > end:
                raise PageError("The page's server did not start; the log says why.")
            time.sleep(0.005)

    def stop(self) -> None:
        """Close all connections, and the listener."""
        self._server.should_exit = True
        self._thread.join(_PATIENCE_S)
