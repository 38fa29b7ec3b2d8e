"""Process variables, read by two clients that are independent of each other and of the server."""

import importlib.util
import json
import math
import os
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from rasnik.controls.epics import EpicsServer, pv_name
from rasnik.controls.values import STATES, VALUES, Severity, judge
from rasnik.live.station import Alarms, Epics
from rasnik.live.status import ChannelStatus
from test_controls_values import STATUS, FakeStation

needs_server = pytest.mark.skipif(
    importlib.util.find_spec("softioc") is None, reason="softioc is not installed"
)
ALARMS = Alarms(x_um=(-1.0, 1.0), y_um=(-0.05, 0.05))

# Each client is a process: their libraries keep threads, and settings of the environment, for good.
CA_CLIENT = """
import json, sys
from functools import partial
from caproto.sync import client
read, write = (partial(f, repeater=False) for f in (client.read, client.write))
found = {}
for pv in sys.argv[1:]:
    a = read(pv, data_type="time", timeout=10)
    data = bytes(a.data).rstrip(b"\\0").decode() if a.data.dtype == "uint8" else float(a.data[0])
    found[pv] = [data, a.metadata.severity, a.metadata.timestamp]
answers = []
for value in (1.0, 2.0):
    answers.append(write(sys.argv[1], [value], notify=True, timeout=5).status.name)
    answers.append(write(sys.argv[1] + ".DISP", [0], notify=True, timeout=5).status.name)
control = read(sys.argv[1], data_type="control", timeout=5).metadata
about = read(sys.argv[1] + ".DESC", timeout=5).data[0].decode()
found["about"] = [control.units.decode(), control.precision, about, sorted(set(answers))]
print(json.dumps(found))
"""
PVA_CLIENT = """
import json, sys
from p4p.client.thread import Context, RemoteError
found = {}
with Context("pva", nt=False) as client:
    for pv in sys.argv[1:]:
        a = client.get(pv, timeout=10)
        data = a.value.index if hasattr(a.value, "choices") else a.value
        seconds = a.timeStamp.secondsPastEpoch + 1e-9 * a.timeStamp.nanoseconds
        found[pv] = [data, a.alarm.severity, seconds]
    first = client.get(sys.argv[1], timeout=5).display
    refused = []
    for field in ("", ".DISP"):
        try:
            client.put(sys.argv[1] + field, 1, timeout=5)
        except RemoteError as error:
            refused.append(str(error))
found["about"] = [first.units, first.precision, first.description, len(refused)]
print(json.dumps(found))
"""


def free_port() -> int:
    with socket.socket() as a_socket:
        a_socket.bind(("127.0.0.1", 0))
        return int(a_socket.getsockname()[1])


@pytest.fixture
def loopback(monkeypatch: pytest.MonkeyPatch) -> None:
    """EPICS in this process and those it starts: own ports, and nothing outside this machine."""
    here, ca, pva = "127.0.0.1", str(free_port()), str(free_port())
    for name in ("CA", "PVA"):
        monkeypatch.setenv(f"EPICS_{name}_ADDR_LIST", here)
        monkeypatch.setenv(f"EPICS_{name}_AUTO_ADDR_LIST", "NO")
        monkeypatch.setenv(f"EPICS_{name}S_INTF_ADDR_LIST", here)
        monkeypatch.setenv(f"EPICS_{name}S_BEACON_ADDR_LIST", here)
        monkeypatch.setenv(f"EPICS_{name}S_AUTO_BEACON_ADDR_LIST", "NO")
    monkeypatch.setenv("EPICS_CA_SERVER_PORT", ca)
    monkeypatch.setenv("EPICS_CA_REPEATER_PORT", str(free_port()))
    monkeypatch.setenv("EPICS_PVA_SERVER_PORT", pva)
    monkeypatch.setenv("EPICS_PVA_BROADCAST_PORT", pva)


@pytest.fixture
def station() -> FakeStation:
    station = FakeStation()
    station.add(STATUS, ALARMS)
    station.add(replace(STATUS, name="two", locked=False, x_um=math.nan, state="lost"))
    return station


@pytest.fixture
def server(loopback: None, station: FakeStation) -> Iterator[EpicsServer]:
    server = EpicsServer(station, Epics(prefix="TEST", rate_hz=20))
    server.start()
    try:
        assert server.wait(20), server.message
        yield server
    finally:
        server.stop()


def read(client: str, *pvs: str) -> dict[str, Any]:
    command = [sys.executable, "-c", client, *pvs]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    found: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return found


def check(found: dict[str, Any], status: ChannelStatus, alarms: Alarms) -> None:
    """Every value, its severity and time."""
    for value in VALUES:
        data, severity, when = found[pv_name("TEST", status.name, value)]
        expected: Any = value.read(status)
        if value.kind == "state":
            expected = STATES.index(expected)
        if isinstance(expected, float) and math.isnan(expected):
            assert math.isnan(data)
        else:
            assert data == expected, value.name  # to the last bit
        assert severity == judge(value, status, alarms), value.name
        if value.measured:
            assert when == pytest.approx(status.time_s, abs=1e-6)
        elif value.name != "time_s":
            assert abs(when - time.time()) < 60


@needs_server
@pytest.mark.parametrize(("client", "package"), [(CA_CLIENT, "caproto"), (PVA_CLIENT, "p4p")])
def test_values_are_those_of_the_status(server: EpicsServer, client: str, package: str) -> None:
    pytest.importorskip(package, reason=f"{package} is not installed")
    found = read(client, *(pv_name("TEST", name, v) for name in ("one", "two") for v in VALUES))
    check(found, STATUS, ALARMS)
    lost = replace(STATUS, name="two", locked=False, x_um=math.nan, state="lost")
    check(found, lost, Alarms())
    assert found["TEST:one:X"][1] == Severity.OK and found["TEST:two:X"][1] == Severity.INVALID
    assert found["TEST:one:Y"][1] == found["TEST:one:YREL"][1] == Severity.MAJOR
    unit, decimals, about, refused = found["about"]
    assert (unit, decimals, about) == ("um", 6, "mask x at the sensor's centre")
    # nobody can write: neither the value nor the field that would allow it
    assert refused == (["ECA_NOWTACCESS"] if package == "caproto" else 2)
    assert not server.message


@needs_server
def test_values_follow_the_station(server: EpicsServer, station: FakeStation) -> None:
    pytest.importorskip("caproto", reason="caproto is not installed")
    moved = replace(STATUS, x_um=4014.0, time_s=STATUS.time_s + 10, message="é" * 300)
    station.channels["one"].tell = lambda: moved
    time.sleep(0.3)
    found = read(CA_CLIENT, *(f"TEST:one:{pv}" for pv in ("X", "XREL", "MESSAGE")))
    assert found["TEST:one:X"] == [4014.0, Severity.MAJOR, moved.time_s]
    assert found["TEST:one:XREL"][:2] == [(4014.0 - 4012.3) * 1e3, Severity.MAJOR]
    assert found["TEST:one:MESSAGE"][0] == "é" * 127  # 255 bytes


def child(server: EpicsServer) -> "subprocess.Popen[str]":
    assert server._child is not None
    return server._child


@needs_server
def test_a_server_that_ends_is_started_again(server: EpicsServer) -> None:
    first = child(server)
    first.kill()
    end = time.monotonic() + 10
    while not (child(server) is not first and server.wait(0.1)):
        assert time.monotonic() < end, server.message
        time.sleep(0.05)
    assert not server.message
    began = time.monotonic()
    server.stop()
    assert time.monotonic() - began < 2
    assert child(server).poll() is not None


@needs_server
def test_the_server_ends_with_the_station(loopback: None) -> None:
    code = (
        "import time; from test_controls_epics import *; station = FakeStation(); "
        "station.add(STATUS); server = EpicsServer(station, Epics()); server.start(); "
        "server.wait(20); print(child(server).pid, flush=True); time.sleep(60)"
    )
    program = subprocess.Popen(
        [sys.executable, "-c", code], cwd=os.path.dirname(__file__), stdout=subprocess.PIPE
    )
    assert program.stdout is not None
    with program.stdout:
        served_by = int(program.stdout.readline())
        os.kill(served_by, 0)
        program.kill()
        program.wait()
    end = time.monotonic() + 10
    while time.monotonic() < end:
        try:
            os.kill(served_by, 0)
        except ProcessLookupError:
            return
        time.sleep(0.05)
    raise AssertionError("the server goes on without its station")


@needs_server
def test_names_too_long_for_epics_are_refused() -> None:
    station = FakeStation()
    station.add(replace(STATUS, name="c" * 40))
    with pytest.raises(ValueError, match=r"has \d\d letters and EPICS takes 60; choose a shorter"):
        EpicsServer(station, Epics(prefix="P" * 19))


def test_a_missing_package_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "softioc", None)
    with pytest.raises(ImportError, match=r'pip install "rasnik\[epics\]"'):
        EpicsServer(FakeStation(), Epics())


@needs_server
def test_files_beside_the_recordings_are_not_modules(
    loopback: None, station: FakeStation, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "random.py").write_text("raise SystemExit('a file of the user was run')\n")
    monkeypatch.chdir(tmp_path)
    made = EpicsServer(station, Epics(prefix="TEST"))
    made.start()
    try:
        assert made.wait(30), made.message
    finally:
        made.stop()
