"""`rasnik doctor`: each check against a machine made up for it; none may raise."""

from __future__ import annotations

import getpass
import json
import os
import shutil
import socket
import subprocess
import tomllib
from collections.abc import Iterable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from typer.testing import CliRunner

from rasnik.cameras.aravis import SeenCamera
from rasnik.cameras.camera import CameraMissingError
from rasnik.cli import app
from rasnik.live import doctor
from rasnik.live.checks import (
    analysis_rate,
    cameras,
    disk,
    machine,
    network,
    packages,
    rates,
    services,
)
from rasnik.live.checks.finding import Finding, Machine, guarded
from rasnik.live.station import StationConfig
from rasnik.live.unit import service_unit
from rasnik.web.server import read_token

ARAVIS = {"kind": "aravis", "device": "CAM-1"}
PROJECT = Path(__file__).resolve().parents[1] / "pyproject.toml"


def station(camera: dict[str, Any] | None = None, **values: Any) -> StationConfig:
    channel = {"name": "one", "camera": camera or {}}
    return StationConfig.model_validate({"channel": [channel]} | values)


def a_machine(root: Path, files: dict[str, str]) -> Machine:
    for name, text in files.items():
        path = root / name.lstrip("/")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text + "\n", encoding="utf-8")
    return Machine(root)


def only(findings: Iterable[Finding]) -> Finding:
    (finding,) = findings
    return finding


# ------------------------------------------------------------------------------ findings


def test_a_remedy_for_whatever_is_not_ok() -> None:
    with pytest.raises(ValueError, match="remedy"):
        Finding("disk", "fault", "full")
    with pytest.raises(ValueError, match="remedy"):
        Finding("disk", "ok", "fine", "nothing")


def test_a_check_that_fails_is_a_finding() -> None:
    def broken() -> Iterable[Finding]:
        yield Finding("disk", "ok", "the first half")
        raise RuntimeError("the second\nhalf")

    first, second = guarded("disk", broken)
    assert first.level == "ok"
    assert second.level == "warning" and "RuntimeError: the second half" in second.found


def test_nothing_is_known_of_an_empty_machine(tmp_path: Path) -> None:
    """Every check that reads files of Linux, where there are none."""
    nowhere, config = Machine(tmp_path / "nowhere"), station(ARAVIS)
    unknown = [
        only(network.jumbo_frames(nowhere, config)),
        only(network.receive_buffers(nowhere, config)),
        only(network.reverse_path_filter(nowhere, config)),
        only(machine.governor(nowhere)),
        only(machine.priority(nowhere)),
        only(machine.memory_lock(nowhere)),
        only(disk.file_system(nowhere, config)),
        only(machine.clock(lambda: None)),
    ]
    for finding in unknown:
        assert finding.level == "note" and "not known here" in finding.found
    assert list(network.usb_memory(nowhere, config)) == []
    assert cameras.video_devices(nowhere) == {}


# ------------------------------------------------------------------------------ packages


def test_table_of_extras_is_that_of_the_project() -> None:
    if not PROJECT.exists():
        pytest.skip("the package is installed without its checkout")
    stated = tomllib.loads(PROJECT.read_text(encoding="utf-8"))["project"]
    optional = stated["optional-dependencies"]
    for name, extra in packages.EXTRAS.items():
        wanted = {each.split(">")[0].split("<")[0] for each in optional[name]}
        assert wanted == set(extra.packages), name
    always = {each.split(">")[0] for each in stated["dependencies"]}
    assert set(packages._CORE) <= always


def test_what_the_station_needs_is_a_fault_if_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(packages, "_is_there", lambda module: False)
    config = station({"kind": "opencv", "device": "0"}, controls={"mqtt": {"enabled": True}})
    levels = {finding.about: finding.level for finding in packages.extras(config)}
    assert levels["extra live"] == levels["extra mqtt"] == levels["opencv"] == "fault"
    assert levels["extra camera"] == levels["extra epics"] == levels["extra parquet"] == "note"
    assert levels["extra prometheus"] == "note", "not asked for in so many words"
    camera = {finding.about: finding for finding in packages.extras(station(ARAVIS))}[
        "extra camera"
    ]
    assert camera.level == "fault"
    assert "apt install" in camera.remedy and 'pip install "rasnik[camera]"' in camera.remedy


def test_a_module_is_looked_for_without_importing_it() -> None:
    assert packages._is_there("json") and packages._is_there("xml.dom")
    assert not packages._is_there("no_such_module") and not packages._is_there("no_such.module")


def test_kernels(monkeypatch: pytest.MonkeyPatch) -> None:
    from rasnik.tracking import kernels, warm_up

    monkeypatch.setattr(kernels, "store", SimpleNamespace())
    assert only(packages.kernels()).level == "fault"
    monkeypatch.setattr(
        kernels, "store", SimpleNamespace(stats=SimpleNamespace(cache_path="/some/where"))
    )
    monkeypatch.setattr(packages, "_can_write", lambda folder: True)
    monkeypatch.setattr(warm_up, "is_compiled", lambda: True)
    assert only(packages.kernels()) == Finding("kernels", "ok", "compiled, in /some/where")
    monkeypatch.setattr(warm_up, "is_compiled", lambda: False)
    assert only(packages.kernels()).level == "note"
    monkeypatch.setattr(packages, "_can_write", lambda folder: False)
    finding = only(packages.kernels())
    assert finding.level == "warning" and "NUMBA_CACHE_DIR" in finding.remedy


def test_a_folder_that_cannot_be_written(tmp_path: Path) -> None:
    assert packages._can_write(tmp_path)
    assert not packages._can_write(tmp_path / "missing")


# ------------------------------------------------------------------------------ network


@pytest.mark.parametrize(
    ("mtu", "camera", "level"),
    [
        ("9000", ARAVIS, "ok"),
        ("1500", ARAVIS, "warning"),
        ("1500", None, "note"),
        ("1500", ARAVIS | {"packet_bytes": 8192}, "fault"),
        ("9000", ARAVIS | {"packet_bytes": 8192}, "ok"),
    ],
)
def test_packet_size(tmp_path: Path, mtu: str, camera: dict[str, Any] | None, level: str) -> None:
    net = "/sys/class/net"
    files = {f"{net}/eth0/mtu": mtu, f"{net}/lo/mtu": "65536", f"{net}/eth1/mtu": "9000"}
    files |= {f"{net}/eth0/operstate": "up", f"{net}/eth1/operstate": "down"}
    finding = only(network.jumbo_frames(a_machine(tmp_path, files), station(camera)))
    assert finding.level == level
    assert f"eth0 {mtu}" in finding.found and "eth1" not in finding.found


def test_socket_buffers(tmp_path: Path) -> None:
    """50 ms of 720 x 540 pixels at 860 Hz are 16.7 MB."""
    computer = a_machine(tmp_path, {"/proc/sys/net/core/rmem_max": "4194304"})
    fast = station(ARAVIS | {"frame_rate_hz": 860.0})
    finding = only(network.receive_buffers(computer, fast))
    assert finding.level == "warning"
    assert str(round(0.05 * 860 * 720 * 540)) in finding.found
    assert f"rmem_max={2**24}" in finding.remedy
    assert only(network.receive_buffers(computer, station())).level == "ok"
    slow = a_machine(tmp_path, {"/proc/sys/net/core/rmem_max": "212992"})
    assert only(network.receive_buffers(slow, station())).level == "note"


@pytest.mark.parametrize(
    ("everywhere", "own", "level"),
    [("0", "0", "ok"), ("1", "0", "warning"), ("0", "1", "warning"), ("2", "1", "ok")],
)
def test_reverse_path_filter(tmp_path: Path, everywhere: str, own: str, level: str) -> None:
    """The larger of the two numbers holds; 1 is strict."""
    conf = "/proc/sys/net/ipv4/conf"
    files = {f"{conf}/all/rp_filter": everywhere, f"{conf}/eth0/rp_filter": own}
    files |= {f"{conf}/lo/rp_filter": "1", f"{conf}/default/rp_filter": "1"}
    finding = only(network.reverse_path_filter(a_machine(tmp_path, files), station(ARAVIS)))
    assert finding.level == level


@pytest.mark.parametrize(("size", "level"), [("16", "note"), ("1000", "ok"), ("0", "ok")])
def test_usb_memory(tmp_path: Path, size: str, level: str) -> None:
    computer = a_machine(tmp_path, {"/sys/module/usbcore/parameters/usbfs_memory_mb": size})
    assert only(network.usb_memory(computer, station(ARAVIS))).level == level
    assert list(network.usb_memory(computer, station())) == []


# ------------------------------------------------------------------------------ machine

LIMITS = """Limit                     Soft Limit           Hard Limit           Units
Max locked memory         {lock}              8388608              bytes
Max nice priority         {nice}                    0
Max realtime priority     {realtime}                    0"""


@pytest.mark.parametrize(
    ("nice", "realtime", "capabilities", "level", "words"),
    [
        (0, 0, 0, "note", "may not raise"),
        (30, 0, 0, "ok", "nice -10"),
        (0, 50, 0, "ok", "real time"),
        (0, 0, 1 << 23, "ok", "real time"),
    ],
)
def test_priority(
    tmp_path: Path, nice: int, realtime: int, capabilities: int, level: str, words: str
) -> None:
    files = {
        "/proc/self/limits": LIMITS.format(lock=8388608, nice=nice, realtime=realtime),
        "/proc/self/status": f"Name:\tx\nCapEff:\t{capabilities:016x}",
    }
    finding = only(machine.priority(a_machine(tmp_path, files)))
    assert finding.level == level and words in finding.found


@pytest.mark.parametrize(
    ("lock", "swaps", "level"),
    [
        ("65536", "Filename Type Size\n/swap file 100", "note"),
        ("65536", "Filename Type Size", "ok"),
        ("unlimited", "Filename Type Size\n/swap file 100", "ok"),
    ],
)
def test_memory_lock(tmp_path: Path, lock: str, swaps: str, level: str) -> None:
    files = {
        "/proc/self/limits": LIMITS.format(lock=lock, nice=0, realtime=0),
        "/proc/self/status": "CapEff:\t0000000000000000",
        "/proc/swaps": swaps,
    }
    assert only(machine.memory_lock(a_machine(tmp_path, files))).level == level


@pytest.mark.parametrize(
    ("governors", "level"),
    [(("performance", "performance"), "ok"), (("performance", "powersave"), "note")],
)
def test_governor(tmp_path: Path, governors: tuple[str, ...], level: str) -> None:
    files = {
        f"/sys/devices/system/cpu/cpu{k}/cpufreq/scaling_governor": name
        for k, name in enumerate(governors)
    }
    finding = only(machine.governor(a_machine(tmp_path, files)))
    assert finding.level == level and governors[-1] in finding.found


def test_rationed_cores_count(tmp_path: Path) -> None:
    computer = a_machine(tmp_path, {"/sys/fs/cgroup/cpu.max": "50000 100000"})
    assert machine.cores_to_use(computer) == 0.5
    finding = only(machine.processors(computer, station()))
    assert finding.level == "note" and finding.found.startswith("0.5 of ")
    free = a_machine(tmp_path, {"/sys/fs/cgroup/cpu.max": "max 100000"})
    assert machine.cores_to_use(free) == machine.cores_to_use(Machine(tmp_path / "nowhere"))


@pytest.mark.parametrize(("state", "level"), [(True, "ok"), (False, "warning"), (None, "note")])
def test_clock(state: bool | None, level: str) -> None:
    assert only(machine.clock(lambda: state)).level == level
    assert machine.clock_is_synchronised() in (True, False, None)


# ------------------------------------------------------------------------------ disk


def usage(monkeypatch: pytest.MonkeyPatch, free_bytes: float) -> None:
    monkeypatch.setattr(
        disk.shutil, "disk_usage", lambda folder: SimpleNamespace(free=int(free_bytes))
    )


def recording(tmp_path: Path, **values: Any) -> StationConfig:
    channel = {"name": "one", "camera": {"frame_rate_hz": 100.0}, "recording": values}
    return StationConfig.model_validate({"folder": tmp_path / "new", "channel": [channel]})


def test_demand_of_a_station(tmp_path: Path) -> None:
    raw = {"before_s": 1, "after_s": 2, "most_per_hour": 10, "every_s": 60}
    wanted = disk.demand(recording(tmp_path, flush_s=0.5, keep_free_mib=100, raw=raw))
    frame = 720 * 540
    assert wanted.rows_bytes_s == 100 * rates.row_bytes()
    assert wanted.event_bytes == 3 * 100 * frame
    assert wanted.frames_bytes_s == pytest.approx(3 * 100 * frame * 10 / 3600 + frame / 60)
    assert wanted.keep_free_bytes == 100 * 2**20 and wanted.flush_s == 0.5
    nothing = disk.demand(recording(tmp_path, enabled=False))
    assert nothing.rows_bytes_s == nothing.frames_bytes_s == 0


@pytest.mark.parametrize(
    ("days", "level"), [(-0.01, "fault"), (3.0, "warning"), (10.0, "note"), (1e5, "ok")]
)
def test_disk_space(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, days: float, level: str
) -> None:
    config = recording(tmp_path)
    wanted = disk.demand(config)
    usage(monkeypatch, wanted.keep_free_bytes + days * 86400 * wanted.rows_bytes_s)
    finding = only(disk.free_space(config))
    assert finding.level == level
    if days > 0:
        assert f"{days:.0f} days of positions" in finding.found


@pytest.mark.parametrize(
    ("kind", "level"),
    [("ext4", "ok"), ("nfs4", "fault"), ("fuse.sshfs", "fault"), ("tmpfs", "warning")],
)
def test_file_system(tmp_path: Path, kind: str, level: str) -> None:
    """The innermost mount above the folder counts; blanks are written as octal codes."""
    folder = tmp_path / "with blank" / "data"
    folder.mkdir(parents=True)
    at = str(folder.parent.resolve()).replace(" ", "\\040")
    lines = [
        "22 1 8:1 / / rw,relatime shared:1 - xfs /dev/sda1 rw",
        f"30 22 0:40 / {at} rw,relatime shared:2 - {kind} server:/x rw",
        "31 22 0:41 / /elsewhere rw - nfs server:/y rw",
        "nonsense",
    ]
    computer = a_machine(tmp_path / "root", {"/proc/self/mountinfo": "\n".join(lines)})
    finding = only(disk.file_system(computer, station(folder=folder / "new")))
    assert finding.level == level and kind in finding.found
    outside = only(disk.file_system(computer, station(folder=tmp_path)))
    assert outside.level == "ok" and "xfs" in outside.found


@pytest.mark.parametrize(
    ("speed", "sync_s", "level"),
    [(1e9, 0.01, "ok"), (1e3, 0.01, "fault"), (1e9, 30.0, "fault"), (1e5, 0.01, "warning")],
)
def test_disk_speed_judged(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, speed: float, sync_s: float, level: str
) -> None:
    monkeypatch.setattr(disk, "_measure", lambda folder: (speed, sync_s))
    assert only(disk.write_speed(recording(tmp_path))).level == level


def test_disk_speed_measured(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    config = recording(tmp_path)
    speed, sync_s = disk._measure(tmp_path)
    assert 1e4 < speed < 1e12 and 0 <= sync_s < 10
    assert list(tmp_path.iterdir()) == [], "the file of the measurement is gone"

    def refused(folder: Path) -> tuple[float, float]:
        raise PermissionError("no")

    monkeypatch.setattr(disk, "_measure", refused)
    assert only(disk.write_speed(config)).level == "fault"
    usage(monkeypatch, 1e6)
    assert "too little space" in only(disk.write_speed(config)).found


# ------------------------------------------------------------------------------ services


def test_port_taken_and_free() -> None:
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        number = other.getsockname()[1]
        finding = only(services.port(station(server={"port": number})))
        assert finding.level == "fault" and "taken" in finding.found
    assert only(services.port(station(server={"port": 0}))).level == "ok"


def test_addresses(tmp_path: Path) -> None:
    # 192.0.2.0/24 belongs to nobody: it is for examples.
    server = {"host": "192.0.2.7", "port": 0, "token_file": tmp_path / "token"}
    finding = only(services.port(station(server=server)))
    assert finding.level == "fault" and "does not have the address" in finding.found
    everywhere = list(services.port(station(server={"host": "0.0.0.0", "port": 0})))
    assert [finding.about for finding in everywhere] == ["port", "access"]
    assert everywhere[1].level == "fault" and "token_file" in everywhere[1].remedy


TOKEN = "0123456789abcdef0123"


@pytest.mark.parametrize(
    ("text", "mode", "level", "remedy"),
    [
        (TOKEN, 0o600, "ok", ""),
        (TOKEN, 0o644, "fault", "chmod 600"),
        (" \n", 0o600, "fault", "(umask 077; openssl rand"),
        (None, 0, "fault", "(umask 077; openssl rand"),
    ],
    ids=["good", "open", "empty", "missing"],
)
def test_token_file(tmp_path: Path, text: str | None, mode: int, level: str, remedy: str) -> None:
    config = station(server={"token_file": secret(tmp_path, text, mode)})
    finding = only(services.token_file(config, read_token))
    assert finding.level == level and finding.remedy.startswith(remedy)
    assert TOKEN not in finding.found + finding.remedy


@pytest.mark.parametrize(
    ("text", "mode", "level"),
    [
        ("Tr0ub4dor", 0o600, "ok"),
        ("Tr0ub4dor", 0o640, "warning"),
        ("", 0o600, "fault"),
        (None, 0, "fault"),
    ],
    ids=["good", "open", "empty", "missing"],
)
def test_password_file(tmp_path: Path, text: str | None, mode: int, level: str) -> None:
    file = secret(tmp_path, text, mode)
    config = station(controls={"mqtt": {"enabled": True, "password_file": file}})
    finding = only(services.password_file(config))
    assert finding.level == level and str(file) in finding.found
    assert "Tr0ub4dor" not in finding.found + finding.remedy


def secret(folder: Path, text: str | None, mode: int) -> Path:
    file = folder / "key"
    if text is not None:
        file.write_text(text)
        file.chmod(mode)
    return file


def test_broker() -> None:
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        mqtt = {"enabled": True, "host": "127.0.0.1", "port": other.getsockname()[1]}
        config = station(controls={"mqtt": mqtt})
        finding = only(services.broker(config, timeout_s=1.0))
        assert finding.level == "warning" and "does not answer" in finding.found
        other.listen()
        assert only(services.broker(config, timeout_s=5.0)).level == "ok"
    assert list(services.broker(station())) == []


# ------------------------------------------------------------------------------ cameras

SEEN = [SeenCamera("Maker-CAM-1", "Maker", "M1", "CAM-1", "10.0.0.2", "GigEVision")]
MISSING = CameraMissingError("Install Aravis.")


@pytest.mark.parametrize(
    ("camera", "seen", "level", "words"),
    [
        ({}, [], "ok", "simulated"),
        (ARAVIS, SEEN, "ok", "CAM-1"),
        (ARAVIS | {"device": "10.0.0.2"}, SEEN, "ok", "Maker"),
        (ARAVIS | {"device": "CAM-2"}, SEEN, "fault", "not among those seen"),
        (ARAVIS | {"device": ""}, SEEN, "ok", "Maker"),
        (ARAVIS | {"device": "CAM"}, SEEN, "fault", "not among those seen"),
        (ARAVIS | {"device": "10.0.0.3"}, SEEN, "warning", "did not answer"),
        (ARAVIS | {"device": "10.0.0.3"}, MISSING, "fault", "needs Aravis"),
        (ARAVIS, [], "fault", "not seen"),
        (ARAVIS, MISSING, "fault", "needs Aravis"),
        ({"kind": "opencv", "device": "0"}, [], "ok", "/dev/video0"),
        ({"kind": "opencv", "device": "3"}, [], "fault", "no video device /dev/video3"),
        ({"kind": "replay", "source": ["/no/such/run"]}, [], "fault", "nothing at /no/such/run"),
        ({"kind": "replay", "source": ["/no/such/*.png"]}, [], "ok", "replay"),
    ],
)
def test_camera_of_a_channel(
    tmp_path: Path, camera: dict[str, Any], seen: Any, level: str, words: str
) -> None:
    computer = a_machine(tmp_path, {"/dev/video0": "", "/dev/null": ""})
    finding = only(cameras.channels(computer, station(camera), seen))
    assert finding.level == level and words in finding.found


def test_cameras_that_are_seen(tmp_path: Path) -> None:
    files = {"/dev/video0": "", "/dev/videos": "", "/sys/class/video4linux/video0/name": "Webcam"}
    computer = a_machine(tmp_path, files)
    first, second = cameras.seen(computer, SEEN)
    assert "CAM-1" in first.found and "10.0.0.2" in first.found
    assert second.found == "/dev/video0 Webcam"
    assert next(iter(cameras.seen(computer, MISSING))).remedy == "Install Aravis."
    assert next(iter(cameras.seen(computer, []))).level == "note"


def test_channel_without_a_system(tmp_path: Path) -> None:
    channel = {"name": "one", "system": "no-such-system"}
    config = StationConfig.model_validate({"channel": [channel]})
    finding = only(cameras.channels(Machine(tmp_path), config, []))
    assert finding.level == "fault" and "no-such-system" in finding.found


def test_a_channel_without_a_system_hides_nothing_else(tmp_path: Path, quiet: None) -> None:
    channels = [{"name": "one"}, {"name": "two", "system": "no-such-system"}]
    values = {"folder": tmp_path, "server": {"port": 0}, "channel": channels}
    config = StationConfig.model_validate(values)
    findings = list(doctor.examine(config, read_token=read_token, quick=True))
    levels = {finding.about: finding.level for finding in findings}
    assert levels["channel one"] == "ok" and levels["channel two"] == "fault"
    (space,) = (finding for finding in findings if finding.about == "disk space")
    assert "of positions" in space.found
    none = StationConfig.model_validate(values | {"channel": channels[1:]})
    assert all(
        "could not be looked at" not in finding.found
        for finding in doctor.examine(none, read_token=read_token)
    )


def test_size_of_a_region() -> None:
    channel = station({"region": (8, 16, 320, 200), "pixel_format": "Mono12"}).channel[0]
    assert rates.system_of(channel).shape == (200, 320)
    assert rates.frame_bytes(channel) == 2 * 200 * 320


# ------------------------------------------------------------------------------ analysis


def measured(**values: Any) -> analysis_rate.Measured:
    usual: dict[str, Any] = {
        "name": "one", "size": (720, 540), "rate_hz": 1000.0, "needed_hz": 275.0,
        "share": 0.2, "median_ms": 0.5, "p99_ms": 1.0, "lost": 0,
    }  # fmt: skip
    return analysis_rate.Measured(**(usual | values))


@pytest.mark.parametrize(
    ("values", "level"),
    [
        ({}, "ok"),
        ({"rate_hz": 274.0}, "fault"),
        ({"rate_hz": 300.0}, "warning"),
        ({"p99_ms": 25.0}, "warning"),
        ({"lost": 1}, "fault"),
    ],
)
def test_analysis_judged(values: dict[str, Any], level: str) -> None:
    finding = only(analysis_rate.judged([measured(**values)], 2))
    assert finding.level == level and "275, which take 20 % of a core" in finding.found


def test_channels_are_judged_together() -> None:
    """Each alone would do, both together would not."""
    both = [measured(share=0.9), measured(name="two", share=0.9)]
    assert [finding.level for finding in analysis_rate.judged(both, 4)] == ["ok", "ok", "ok"]
    *_, last = analysis_rate.judged(both, 2)
    assert last.level == "fault" and "1.80 of 2 cores" in last.found


def test_analysis_measured() -> None:
    """Two channels at a time; more frames than the machine can do are refused."""
    region = (0, 0, 240, 180)
    config = StationConfig.model_validate(
        {
            "channel": [
                {"name": "slow", "camera": {"frame_rate_hz": 1.0, "region": region}},
                {"name": "fast", "camera": {"frame_rate_hz": 1e6, "region": region}},
            ]
        }
    )
    slow, fast = analysis_rate.measure(config.channel, seconds=0.2)
    assert slow.lost == fast.lost == 0
    assert slow.size == (240, 180)
    assert 0 < slow.median_ms <= slow.p99_ms
    assert slow.rate_hz == pytest.approx(1e3 / slow.median_ms, rel=0.9)
    assert 0 < slow.share < 0.2 and fast.share > 10
    levels = [finding.level for finding in analysis_rate.judged([slow, fast], 2)]
    assert levels[1:] == ["fault", "fault"] and levels[0] != "fault"


# ------------------------------------------------------------------------------ as a whole


def rasnik(*arguments: object) -> Any:
    result = CliRunner().invoke(app, [str(argument) for argument in arguments])
    assert result.exception is None or isinstance(result.exception, SystemExit), result.exception
    return result


@pytest.fixture
def quiet(monkeypatch: pytest.MonkeyPatch) -> None:
    """No look at the network for cameras."""
    monkeypatch.setattr(cameras, "aravis_cameras", lambda: [])


def examined(folder: Path, **options: Any) -> Iterable[Finding]:
    config = station({"region": (0, 0, 240, 180)}, folder=folder)
    return doctor.examine(config, read_token=read_token, **options)


def write_station(folder: Path, text: str = "") -> Path:
    file = folder / "station.toml"
    start = f'folder = "{(folder / "data").as_posix()}"\n[server]\nport = 0\n'
    file.write_text(start + text + '\n[[channel]]\nname = "one"\n')
    return file


def test_nothing_stops_the_examination(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, quiet: None
) -> None:
    def broken(*arguments: Any) -> Any:
        raise OSError("out of order")

    for module, name in ((packages, "python"), (machine, "clock"), (disk, "free_space")):
        monkeypatch.setattr(module, name, broken)
    monkeypatch.setattr(cameras, "aravis_cameras", broken)
    findings = list(examined(tmp_path, quick=True, computer=Machine(tmp_path)))
    failed = {finding.about for finding in findings if "out of order" in finding.found}
    assert failed == {"python", "clock", "disk space"}
    assert any("out of order" in finding.remedy for finding in findings)
    assert {"port", "extra live", "channel one"} <= {finding.about for finding in findings}


def test_command(tmp_path: Path, quiet: None) -> None:
    result = rasnik("doctor", write_station(tmp_path), "--json", "--quick")
    findings = json.loads(result.stdout)
    assert {each["level"] for each in findings} <= {"ok", "note", "warning", "fault"}
    assert all(bool(each["remedy"]) == (each["level"] != "ok") for each in findings)
    about = {each["about"] for each in findings}
    assert "channel one" in about and not {"disk speed", "analysis one"} & about
    assert result.exit_code == int(any(each["level"] == "fault" for each in findings))
    assert not (tmp_path / "data").exists(), "a look changes nothing"


def test_exit_status_tells_of_a_fault(tmp_path: Path, quiet: None) -> None:
    file = write_station(tmp_path, f'token_file = "{(tmp_path / "none").as_posix()}"')
    result = rasnik("doctor", file, "--quick")
    assert result.exit_code == 1
    assert "token file" in result.stdout and "openssl rand" in result.stdout


def test_measured_as_a_whole(tmp_path: Path, quiet: None) -> None:
    findings = {each.about: each for each in examined(tmp_path)}
    assert "MiB/s" in findings["disk speed"].found
    assert "frames/s of 240 x 180" in findings["analysis one"].found


def test_wrong_usage(tmp_path: Path) -> None:
    result = rasnik("doctor", tmp_path / "none.toml")
    assert result.exit_code == 2 and "there is no such file" in result.stderr
    result = rasnik("doctor", "--service")
    assert result.exit_code == 2 and "station file" in result.stderr


# ------------------------------------------------------------------------------ service


def test_unit_of_a_station(tmp_path: Path) -> None:
    folder = tmp_path / "100 % here"
    folder.mkdir()
    file = write_station(folder)
    unit = rasnik("doctor", "--service", file).stdout
    assert "@" not in unit
    lines = unit.splitlines()
    assert f"User={getpass.getuser()}" in lines
    doubled = str(folder.resolve()).replace("%", "%%")
    assert f"WorkingDirectory={doubled}" in lines
    (start,) = (line for line in lines if line.startswith("ExecStart="))
    assert start.endswith(f' live "{doubled}/station.toml"')


@pytest.mark.skipif(not shutil.which("systemd-analyze"), reason="systemd is not on this machine")
def test_systemd_understands_the_unit(tmp_path: Path) -> None:
    unit = service_unit(station(), write_station(tmp_path))
    assert _complaints(tmp_path, unit) == ""
    wrong = unit.replace("RestartSec", "RestartSecs")
    assert "Unknown" in _complaints(tmp_path, wrong), "it can fail"


def _complaints(folder: Path, text: str) -> str:
    """What systemd has to say about a unit, as far as it is about that unit."""
    file = folder / "rasnik-live.service"
    file.write_text(text)
    run = subprocess.run(
        ["systemd-analyze", "verify", "--man=no", str(file)],
        capture_output=True,
        text=True,
        env=os.environ | {"SYSTEMD_LOG_LEVEL": "warning"},
    )
    return "\n".join(line for line in run.stderr.splitlines() if "rasnik-live" in line)
