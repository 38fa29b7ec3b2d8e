"""The network between cameras and this machine."""

from __future__ import annotations

from collections.abc import Iterator

from rasnik.live.checks.finding import NOT_KNOWN, Finding, Level, Machine
from rasnik.live.checks.rates import stream_bytes_s
from rasnik.live.station import StationConfig

__all__ = ["jumbo_frames", "receive_buffers", "reverse_path_filter", "usb_memory"]

_JUMBO_BYTES = 8000  # cameras send packets of 8192 or 9000 bytes
_BUFFERED_S = 0.05  # of a stream, held by the kernel while the reader is not running
_LEAST_BUFFER = 2**21


def _uses_network(config: StationConfig) -> bool:
    return any(channel.camera.kind == "aravis" for channel in config.channel)


def _amiss(config: StationConfig) -> Level:
    """How bad it is that the network is not as cameras want it."""
    return "warning" if _uses_network(config) else "note"


def jumbo_frames(machine: Machine, config: StationConfig) -> Iterator[Finding]:
    """Largest packets of the interfaces against those of the cameras."""
    sizes: dict[str, int] = {}
    for name in machine.names("/sys/class/net"):
        size = machine.number(f"/sys/class/net/{name}/mtu")
        state = machine.read(f"/sys/class/net/{name}/operstate")
        if name != "lo" and size is not None and state != "down":
            sizes[name] = size
    if not sizes:
        yield Finding("packet size", "note", NOT_KNOWN, "Set 9000 bytes (MTU) for camera networks.")
        return
    found = "MTU " + ", ".join(f"{name} {size}" for name, size in sizes.items())
    wanted = max((channel.camera.packet_bytes or 0) for channel in config.channel)
    largest = max(sizes.values())
    if wanted > largest:
        yield Finding(
            "packet size",
            "fault",
            f"{found}; the station asks a camera for packets of {wanted} bytes",
            f"On the camera's interface: sudo ip link set dev NAME mtu {max(wanted, 9000)}",
        )
    elif largest >= _JUMBO_BYTES:
        yield Finding("packet size", "ok", found)
    else:
        yield Finding(
            "packet size",
            _amiss(config),
            f"{found}; GigE cameras lose less in packets of 8000 bytes and more",
            "On the camera's interface: sudo ip link set dev NAME mtu 9000",
        )


def receive_buffers(machine: Machine, config: StationConfig) -> Iterator[Finding]:
    """What the kernel may hold of a stream against what comes in 50 ms."""
    size = machine.number("/proc/sys/net/core/rmem_max")
    streams = [stream_bytes_s(each) for each in config.channel if each.camera.kind == "aravis"]
    needed = max([_BUFFERED_S * rate for rate in streams] + [_LEAST_BUFFER])
    command = f"sudo sysctl -w net.core.rmem_max={_power_of_two(needed)}"
    if size is None:
        yield Finding("socket buffers", "note", NOT_KNOWN, f"On Linux: {command}")
    elif size >= needed:
        yield Finding("socket buffers", "ok", f"net.core.rmem_max {size} bytes")
    else:
        yield Finding(
            "socket buffers",
            _amiss(config),
            f"net.core.rmem_max {size} bytes; {needed:.0f} are needed for the fastest camera",
            f"{command} (in a file of /etc/sysctl.d it is kept)",
        )


def _power_of_two(size: float) -> int:
    return 1 << (max(int(size), 1) - 1).bit_length()


def reverse_path_filter(machine: Machine, config: StationConfig) -> Iterator[Finding]:
    """The strict filter drops answers of cameras that have no address of this network yet."""
    folder = "/proc/sys/net/ipv4/conf"
    values = {n: machine.number(f"{folder}/{n}/rp_filter") for n in machine.names(folder)}
    known = {name: value for name, value in values.items() if value is not None}
    if not known:
        yield Finding(
            "reverse path",
            "note",
            NOT_KNOWN,
            "If cameras are not found, see whether a firewall drops their packets.",
        )
        return
    everywhere = known.get("all", 0)
    strict = [
        name
        for name, value in known.items()
        if name not in ("all", "default", "lo") and max(value, everywhere) == 1
    ]
    if strict:
        yield Finding(
            "reverse path",
            _amiss(config),
            f"strict filter on {', '.join(strict)}: cameras with an address of another network "
            "are not found",
            "sudo sysctl -w net.ipv4.conf.all.rp_filter=2",
        )
    else:
        yield Finding("reverse path", "ok", "no strict filter")


def usb_memory(machine: Machine, config: StationConfig) -> Iterator[Finding]:
    """What the kernel lends to USB cameras, against some frames of the largest."""
    size_mib = machine.number("/sys/module/usbcore/parameters/usbfs_memory_mb")
    if size_mib is None or not _uses_network(config):
        return
    if size_mib == 0 or size_mib >= 256:
        text = "no limit" if size_mib == 0 else f"{size_mib} MiB"
        yield Finding("USB memory", "ok", text)
        return
    yield Finding(
        "USB memory",
        "note",
        f"{size_mib} MiB; too little for fast USB3 Vision cameras",
        "echo 1000 | sudo tee /sys/module/usbcore/parameters/usbfs_memory_mb",
    )
