"""Network addresses: of cameras, and to listen on."""

from __future__ import annotations

import ipaddress

__all__ = ["is_address", "is_loopback"]


def is_address(host: str) -> bool:
    """Whether it is a numeric address, not a name."""
    try:
        ipaddress.ip_address(host)
    except ValueError:
        return False
    return True


def is_loopback(host: str) -> bool:
    """Whether only this machine reaches an address."""
    if not is_address(host):
        return host == "localhost"
    return ipaddress.ip_address(host).is_loopback
