"""Where the page listens, and who may look."""

from __future__ import annotations

import os
import socket
import stat
from abc import ABC, abstractmethod
from pathlib import Path
from typing import TYPE_CHECKING, Self

from rasnik.cameras.addresses import is_loopback
from rasnik.live.station import Server
from rasnik.web.serving import PageError, Serving

if TYPE_CHECKING:
    from rasnik.live.service import Station

__all__ = ["Page", "PageError", "PageServer", "read_token"]

#: Letters of a token, at least.
SHORTEST_TOKEN = 16


def read_token(path: Path) -> str:
    """The token in a file that nobody else may read.

    Raises
    ------
    PageError
        If there is none, it is short, or others can read it.
    """
    try:
        with path.open(encoding="ascii") as file:
            mode = os.fstat(file.fileno()).st_mode
            token = file.read(4096).strip()
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "it is not plain text"
        raise PageError(f"The token file {path} cannot be read: {reason}.") from None
    if os.name == "posix" and mode & (stat.S_IRWXG | stat.S_IRWXO):
        raise PageError(
            f"Others can read the token file {path}; make it yours alone: chmod 600 {path}"
        )
    if len(token) < SHORTEST_TOKEN or len(token.split()) != 1:
        raise PageError(
            f"The token in {path} must be one word of {SHORTEST_TOKEN} letters or more; make one "
            f"with: openssl rand -hex 24 > {path}"
        )
    return token


class Page(ABC):
    """The page and the HTTP interface of a station: its address and token. A context manager.

    Parameters
    ----------
    station : Station
    config : Server
        Where to listen. Port 0 takes any that is free.

    Raises
    ------
    PageError
        If the address is not that of this machine alone and there is no token.
    """

    def __init__(self, station: Station, config: Server) -> None:
        self._station = station
        self._config = config
        self._token = read_token(config.token_file) if config.token_file is not None else None
        if self._token is None and not is_loopback(config.host):
            raise PageError(
                f"The page would be open to everybody at {config.host}: give a token_file in "
                "[server] of the station file, or listen on 127.0.0.1."
            )
        self._port = config.port

    @property
    def url(self) -> str:
        """Where the page is."""
        host = self._config.host
        if host in ("0.0.0.0", "::"):
            host = socket.gethostname()
        return f"http://[{host}]:{self._port}/" if ":" in host else f"http://{host}:{self._port}/"

    def start(self) -> None:
        """Listen; returns when requests are answered.

        Raises
        ------
        PageError
            If the port is taken, or a package is missing.
        """
        listener = self._listener()
        self._port = listener.getsockname()[1]
        try:
            self._serve(listener)
        except BaseException:
            listener.close()
            raise

    @abstractmethod
    def _serve(self, listener: socket.socket) -> None:
        """Answer on a listener, which belongs to this page from now on."""

    @abstractmethod
    def stop(self) -> None:
        """Close all connections; harmless if it does not run."""

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(self, *error: object) -> None:
        self.stop()

    def _listener(self) -> socket.socket:
        host, port = self._config.host, self._config.port
        try:
            family, _, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
            listener = socket.socket(family, socket.SOCK_STREAM)
        except OSError as error:
            raise PageError(f"There is no address {host}: {error.strerror or error}.") from None
        try:
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            listener.bind(address)
            listener.listen(128)
        except OSError as error:
            listener.close()
            raise PageError(
                f"The page cannot listen on {host}, port {port}: {error.strerror or error}. "
                "Choose another with --port; 0 takes any that is free."
            ) from None
        return listener


class PageServer(Page):
    """The page served by a thread of this process: for tests, and where no process can be had."""

    def __init__(self, station: Station, config: Server) -> None:
        super().__init__(station, config)
        self._serving: Serving | None = None

    def _serve(self, listener: socket.socket) -> None:
        self._serving = Serving(self._station, self._token, listener)

    def stop(self) -> None:
        """Close all connections; harmless if it does not run."""
        if self._serving is not None:
            self._serving.stop()
            self._serving = None
