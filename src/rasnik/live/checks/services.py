"""The port of the page, who may look, and brokers."""

from __future__ import annotations

import errno
import os
import socket
import stat
from collections.abc import Callable, Iterator
from pathlib import Path

from rasnik.cameras.addresses import is_loopback
from rasnik.live.checks.finding import Finding
from rasnik.live.station import StationConfig

__all__ = ["broker", "password_file", "port", "token_file"]

_BROKER_S = 3.0


def port(config: StationConfig) -> Iterator[Finding]:
    """Whether the page can listen where it is told to."""
    host, number = config.server.host, config.server.port
    where = f"{host}:{number}"
    try:
        family, kind, *_, address = socket.getaddrinfo(
            host, number, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
        )[0]
        with socket.socket(family, kind) as test:
            if os.name == "posix":  # as the server does; elsewhere it would share the port
                test.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            test.bind(address)
    except socket.gaierror:
        yield Finding(
            "port",
            "fault",
            f"{host} is not an address",
            "Set host in [server] to 127.0.0.1, or to an address of this machine.",
        )
    except OSError as error:
        found, remedy = _refused(error, where)
        yield Finding("port", "fault", found, remedy)
    else:
        any_free = " (any that is free)" if number == 0 else ""
        yield Finding("port", "ok", f"{where} is free{any_free}")
    if not is_loopback(host) and config.server.token_file is None:
        yield Finding(
            "access",
            "fault",
            f"{host} can be reached from other machines, and no token is asked for",
            "Name a file with a token: token_file = ... in [server] of the station file.",
        )


def _refused(error: OSError, where: str) -> tuple[str, str]:
    if error.errno == errno.EADDRINUSE:
        return (
            f"{where} is taken by another program, or by a station that runs already",
            "Stop that program, or choose another port (rasnik live --port N).",
        )
    if error.errno == errno.EACCES:
        return f"{where} is not allowed for this user", "Choose a port above 1023."
    if error.errno == errno.EADDRNOTAVAIL:
        return (
            f"this machine does not have the address of {where}",
            "Set host in [server] to 127.0.0.1, or to an address of this machine.",
        )
    return f"{where} cannot be used: {error.strerror or error}", "Choose another port."


def token_file(config: StationConfig, read_token: Callable[[Path], object]) -> Iterator[Finding]:
    """Whether the page will accept the file with its token."""
    path = config.server.token_file
    if path is None:
        return
    try:
        read_token(path)
    except Exception as error:
        remedy = f"(umask 077; openssl rand -hex 24 > '{path}')"
        if path.is_file() and _open_to_others(path):
            remedy = f"chmod 600 '{path}'"
        yield Finding("token file", "fault", " ".join(str(error).split()), remedy)
    else:
        yield Finding("token file", "ok", f"{path}, for its owner alone")


def password_file(config: StationConfig) -> Iterator[Finding]:
    """Whether the password for the broker is there, and for nobody else to read."""
    path = config.controls.mqtt.password_file
    if path is None:
        return
    try:
        empty = not path.read_text(encoding="utf-8").strip()
    except (OSError, UnicodeDecodeError) as error:
        yield Finding(
            "password file",
            "fault",
            f"{path} cannot be read: {getattr(error, 'strerror', None) or 'it is not text'}",
            f"Write the password into {path}, as the user who runs the station.",
        )
        return
    if empty:
        remedy = f"Write the password into {path}."
        yield Finding("password file", "fault", f"{path} is empty", remedy)
    elif _open_to_others(path):
        found = f"{path} can be read by others"
        yield Finding("password file", "warning", found, f"chmod 600 '{path}'")
    else:
        yield Finding("password file", "ok", f"{path}, for its owner alone")


def _open_to_others(path: Path) -> bool:
    return os.name == "posix" and bool(path.stat().st_mode & (stat.S_IRWXG | stat.S_IRWXO))


def broker(config: StationConfig, timeout_s: float = _BROKER_S) -> Iterator[Finding]:
    """Whether somebody listens at the address of the MQTT broker."""
    mqtt = config.controls.mqtt
    if not mqtt.enabled:
        return
    where = f"{mqtt.host}:{mqtt.port}"
    try:
        socket.create_connection((mqtt.host, mqtt.port), timeout_s).close()
    except OSError as error:
        yield Finding(
            "MQTT broker",
            "warning",
            f"{where} does not answer: {error.strerror or error}",
            "Start the broker, or correct host and port in [controls.mqtt].",
        )
    else:
        yield Finding("MQTT broker", "ok", f"{where} answers")
