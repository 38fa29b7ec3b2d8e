"""Messages through a real mosquitto broker."""

import getpass
import json
import math
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from rasnik.controls.mqtt import MqttPublisher, payload
from rasnik.controls.values import VALUES
from rasnik.live.station import Mqtt
from test_controls_values import STATUS, FakeStation

pytest.importorskip("paho.mqtt", reason="paho-mqtt is not installed")
PROGRAM = shutil.which("mosquitto") or shutil.which("mosquitto", path="/usr/sbin")
needs_broker = pytest.mark.skipif(PROGRAM is None, reason="mosquitto is not installed")

Start = Callable[..., subprocess.Popen[bytes]]


def free_port() -> int:
    with socket.socket() as a_socket:
        a_socket.bind(("127.0.0.1", 0))
        return int(a_socket.getsockname()[1])


def until(is_so: Callable[[], Any], what: str, timeout_s: float = 8.0) -> Any:
    end = time.monotonic() + timeout_s
    while time.monotonic() < end:
        if found := is_so():
            return found
        time.sleep(0.02)
    raise AssertionError(f"{what} within {timeout_s} s")


@pytest.fixture
def broker(tmp_path: Path) -> Iterator[Start]:
    """Start a broker on a port; it ends with the test."""
    running: list[subprocess.Popen[bytes]] = []

    def start(port: int, *lines: str) -> subprocess.Popen[bytes]:
        assert PROGRAM is not None
        file = tmp_path / "mosquitto.conf"
        setting = lines or ("allow_anonymous true",)
        # without a user it would become one that cannot read the files of the test
        lines = (f"listener {port} 127.0.0.1", f"user {getpass.getuser()}", *setting)
        file.write_text("\n".join(lines) + "\n")
        silent = subprocess.DEVNULL
        program = subprocess.Popen([PROGRAM, "-c", file], stdout=silent, stderr=silent)
        running.append(program)

        def answers() -> bool:
            with socket.socket() as a_socket:
                return a_socket.connect_ex(("127.0.0.1", port)) == 0

        until(answers, "the broker answers")
        return program

    yield start
    for program in running:
        program.kill()
        program.wait()


class Listener:
    """A client of its own that keeps the last message of each topic."""

    def __init__(self, port: int) -> None:
        from paho.mqtt.client import Client
        from paho.mqtt.enums import CallbackAPIVersion

        self.last: dict[str, str] = {}
        self.retained: set[str] = set()
        self.client = Client(CallbackAPIVersion.VERSION2)
        self.client.on_connect = lambda client, *_: client.subscribe("#")
        self.client.on_message = self._keep
        self.client.connect("127.0.0.1", port)
        self.client.loop_start()

    def _keep(self, client: Any, userdata: Any, message: Any) -> None:
        self.last[message.topic] = message.payload.decode()
        if message.retain:
            self.retained.add(message.topic)

    def __enter__(self) -> "Listener":
        return self

    def __exit__(self, *_: object) -> None:
        self.client.disconnect()
        self.client.loop_stop()


def publisher(station: FakeStation, port: int, **options: Any) -> MqttPublisher:
    return MqttPublisher(station, Mqtt(host="127.0.0.1", port=port, rate_hz=50, **options))


@needs_broker
def test_values_are_those_of_the_status(broker: Start) -> None:
    port = free_port()
    broker(port)
    station = FakeStation()
    station.add(replace(STATUS, gain_db=math.nan))
    station.add_broken("bad")
    sender = publisher(station, port)
    sender.start()
    try:
        until(lambda: not sender.message, "the publisher is connected")
        with Listener(port) as listener:
            until(lambda: "rasnik/rasnik/bad/status" in listener.last, "values come")
            found = json.loads(listener.last["rasnik/rasnik/one/status"])
            bad = json.loads(listener.last["rasnik/rasnik/bad/status"])
            alone = "rasnik/rasnik/one/recording_message"
            until(lambda: alone in listener.last, "single values come")
            single = {v.name: listener.last[f"rasnik/rasnik/one/{v.name}"] for v in VALUES}
            assert listener.last["rasnik/rasnik/availability"] == "online"
            sender.stop()
            topic = "rasnik/rasnik/availability"
            until(lambda: listener.last[topic] == "offline", "the farewell comes")
        with Listener(port) as late:
            until(lambda: {alone, "rasnik/rasnik/one/status"} <= late.retained, "values stay")
    finally:
        sender.stop()
    assert found.pop("station") == "rasnik" and found.pop("channel") == "one"
    assert found.pop("gain_db") is None and single.pop("gain_db") == "null"
    expected = {v.name: v.read(STATUS) for v in VALUES if v.name != "gain_db"}
    assert found == expected
    for name, content in expected.items():
        assert (single[name] if isinstance(content, str) else json.loads(single[name])) == content
    assert bad["state"] == "failed" and bad["x_um"] is None


@needs_broker
def test_the_broker_may_come_late_and_go(broker: Start, caplog: pytest.LogCaptureFixture) -> None:
    port = free_port()
    station = FakeStation()
    station.add(STATUS)
    sender = publisher(station, port)
    began = time.monotonic()
    sender.start()
    assert time.monotonic() - began < 0.5
    try:
        until(lambda: "cannot be reached" in sender.message, "it says that there is no broker")
        for _ in range(2):
            program = broker(port)
            until(lambda: not sender.message, "it connects")
            with Listener(port) as listener:
                every = {f"rasnik/rasnik/one/{v.name}" for v in VALUES}  # also what is as before
                until(lambda: every <= set(listener.last), "all values come")  # noqa: B023
            program.kill()
            program.wait()
            until(lambda: sender.message, "it says that the broker is gone")
    finally:
        sender.stop()
    assert f"127.0.0.1:{port}" in sender.message
    said = [record.message for record in caplog.records if "cannot be reached" in record.message]
    assert 1 <= len(said) <= 3  # once for each time, not once for each attempt


@needs_broker
def test_the_broker_tells_when_the_station_is_gone(broker: Start) -> None:
    port = free_port()
    broker(port)
    code = (
        "import sys, time; from test_controls_mqtt import *; station = FakeStation(); "
        f"station.add(STATUS); publisher(station, {port}).start(); time.sleep(60)"
    )
    program = subprocess.Popen([sys.executable, "-c", code], cwd=Path(__file__).parent)
    topic = "rasnik/rasnik/availability"
    try:
        with Listener(port) as listener:
            until(lambda: listener.last.get(topic) == "online", "the station is online", 15)
            program.send_signal(signal.SIGKILL)
            until(lambda: listener.last[topic] == "offline", "the last will comes")
    finally:
        program.kill()
        program.wait()


@needs_broker
def test_name_and_password(broker: Start, tmp_path: Path) -> None:
    tool = shutil.which("mosquitto_passwd")
    if tool is None:
        pytest.skip("mosquitto_passwd is not installed")
    users, right, wrong = (tmp_path / name for name in ("users", "right", "wrong"))
    subprocess.run([tool, "-b", "-c", users, "rasnik", "secret"], check=True, capture_output=True)
    right.write_text("secret\n")
    wrong.write_text("guess\n")
    port = free_port()
    broker(port, f"password_file {users}", "allow_anonymous false")
    station = FakeStation()
    station.add(STATUS)
    for file, expected in ((wrong, "refuses"), (right, "")):
        sender = publisher(station, port, username="rasnik", password_file=file)
        sender.start()
        try:
            until(
                lambda: expected in sender.message and "not connected" not in sender.message,  # noqa: B023
                "the broker answers",
            )
            assert bool(sender.message) == bool(expected)
        finally:
            sender.stop()


def test_a_channel_as_json_knows_no_nan() -> None:
    found = payload("here", replace(STATUS, x_um=math.nan, zero_scale=math.inf))
    assert found["x_um"] is None and found["x_rel_nm"] is None
    assert json.loads(json.dumps(found, allow_nan=False)) == found


def test_what_cannot_work_is_said_at_once(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"controls.mqtt.topic: 'a/#' holds"):
        publisher(FakeStation(), 1, topic="a/#")
    with pytest.raises(ValueError, match=r"password_file: .*secret cannot be read"):
        publisher(FakeStation(), 1, username="me", password_file=tmp_path / "secret")


def test_a_missing_package_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "paho.mqtt.client", None)
    with pytest.raises(ImportError, match=r'pip install "rasnik\[mqtt\]"'):
        publisher(FakeStation(), 1)
