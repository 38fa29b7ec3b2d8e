"""Values to an MQTT broker.

Topics begin with TOPIC/STATION. Below them are

``availability``
    "online", or "offline" after a stop; the broker says it if the station is gone.
``CHANNEL/status``
    All values of a channel in one JSON object; what is not known is null.
``CHANNEL/NAME``
    Each value by itself, sent when it changes.

All messages are retained: whoever subscribes has the last values at once. Nothing is
subscribed to, so nothing can be commanded.
"""

from __future__ import annotations

import json
import logging
import math
import threading
from typing import Any

from rasnik.controls.values import VALUES, PublishedStation, statuses
from rasnik.live.station import Mqtt
from rasnik.live.status import ChannelStatus

__all__ = ["MqttPublisher", "payload"]

_log = logging.getLogger(__name__)
_LONGEST_WAIT_S = 10  # between attempts to connect
_FAREWELL_S = 2.0  # for the last messages


def payload(station: str, status: ChannelStatus) -> dict[str, Any]:
    """All values of a channel, for JSON; numbers that are not known are None."""
    found: dict[str, Any] = {"station": station, "channel": status.name}
    for value in VALUES:
        content = value.read(status)
        unknown = isinstance(content, float) and not math.isfinite(content)
        found[value.name] = None if unknown else content
    return found


class MqttPublisher:
    """Publish the values of a station, `rate_hz` times a second, from a thread of its own.

    A broker that is not there is tried again and again; meanwhile `message` says what is
    wrong. What could not be sent is not kept: the next values replace it.

    Parameters
    ----------
    station : Station
    config : Mqtt

    Attributes
    ----------
    message : str
        What is wrong, as a sentence; empty if nothing is.

    Raises
    ------
    ImportError
        If paho-mqtt is missing; the message says how to install it.
    ValueError
        If the topic or the file with the password cannot be used.
    """

    def __init__(self, station: PublishedStation, config: Mqtt) -> None:
        self._station = station
        self._broker = f"The MQTT broker at {config.host}:{config.port}"
        self._config = config
        self._root = f"{config.topic}/{station.config.name}"
        if any(letter in config.topic for letter in "+#\0"):
            raise ValueError(
                f"controls.mqtt.topic: {config.topic!r} holds + or #, which MQTT keeps for "
                "subscriptions; choose a topic without them"
            )
        self._client = self._new_client()
        self._stopping = threading.Event()
        self._thread: threading.Thread | None = None
        self._sent: dict[str, str] = {}  # single values, by topic
        self._last: Any = None  # receipt of the last message
        self.message = ""

    # ----------------------------------------------------------------- what callers use

    def start(self) -> None:
        """Begin to connect and to publish; returns at once."""
        if self._thread is not None:
            return
        self.message = f"{self._broker} is not connected yet."
        self._client.connect_async(self._config.host, self._config.port, keepalive=30)
        self._client.loop_start()
        self._thread = threading.Thread(target=self._run, name="mqtt", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Say "offline", disconnect, and end the threads; harmless if it was not started."""
        if self._thread is None:
            return
        self._stopping.set()
        self._thread.join()
        self._thread = None
        try:
            if self._client.is_connected():
                self._publish("availability", "offline")
                self._last.wait_for_publish(_FAREWELL_S)
            self._client.disconnect()
        except (RuntimeError, ValueError, OSError) as error:
            _log.warning("%s has not been told that the station stops: %s", self._broker, error)
        # It may be waiting for an answer from a network that gives none.
        end = threading.Thread(target=self._client.loop_stop, name="mqtt end", daemon=True)
        end.start()
        end.join(_FAREWELL_S)

    # ----------------------------------------------------------------- connection

    def _new_client(self) -> Any:
        try:
            from paho.mqtt.client import Client
            from paho.mqtt.enums import CallbackAPIVersion
        except ImportError as error:
            raise ImportError(
                'MQTT needs paho-mqtt 2; install it with: pip install "rasnik[mqtt]"'
            ) from error
        client = Client(CallbackAPIVersion.VERSION2)
        if self._config.username is not None:
            client.username_pw_set(self._config.username, self._password())
        client.will_set(f"{self._root}/availability", "offline", qos=1, retain=True)
        client.reconnect_delay_set(1, _LONGEST_WAIT_S)
        client.on_connect = self._on_connect
        client.on_connect_fail = self._on_connect_fail
        client.on_disconnect = self._on_disconnect
        return client

    def _password(self) -> str | None:
        path = self._config.password_file
        if path is None:
            return None
        try:
            return path.read_text(encoding="utf-8").strip()
        except (OSError, UnicodeDecodeError) as error:
            raise ValueError(
                f"controls.mqtt.password_file: {path} cannot be read: {error}"
            ) from None

    def _on_connect(
        self, client: Any, userdata: Any, flags: Any, reason: Any, properties: Any
    ) -> None:
        if reason.is_failure:
            self._complain(f"refuses the connection ({reason}); see username and password_file")
            return
        if self.message:
            _log.info("%s is connected.", self._broker)
        self.message = ""
        self._last = None
        self._sent.clear()  # the broker may have been started anew
        self._publish("availability", "online")

    def _on_connect_fail(self, client: Any, userdata: Any) -> None:
        self._complain("cannot be reached; it is tried again until it answers")

    def _on_disconnect(
        self, client: Any, userdata: Any, flags: Any, reason: Any, properties: Any
    ) -> None:
        if reason.is_failure and not self.message:
            self._complain(f"is gone ({reason}); it is tried again until it answers")

    def _complain(self, what: str) -> None:
        """Say it where it is shown, and once in the log."""
        message = f"{self._broker} {what}."
        if message != self.message:
            self.message = message
            _log.warning(message)

    # ----------------------------------------------------------------- messages

    def _run(self) -> None:
        """What the thread does."""
        while not self._stopping.wait(1 / self._config.rate_hz):
            try:
                if self._client.is_connected() and self._has_gone_out():
                    self._publish_all()
            except Exception as error:  # whatever it is, the next values are tried again
                self._complain(f"does not take values ({error})")

    def _has_gone_out(self) -> bool:
        """Whether the last message is on its way: a broker that stalls must not fill the memory."""
        try:
            return self._last is None or self._last.is_published()
        except (RuntimeError, ValueError):  # it was refused, and will never go
            return True

    def _publish_all(self) -> None:
        for name, status in statuses(self._station).items():
            values = payload(self._station.config.name, status)
            for value in VALUES:
                self._publish_changed(f"{name}/{value.name}", _text(values[value.name]))
            self._publish(f"{name}/status", json.dumps(values, allow_nan=False))

    def _publish_changed(self, topic: str, text: str) -> None:
        if self._sent.get(topic) != text:
            self._publish(topic, text)
            self._sent[topic] = text

    def _publish(self, topic: str, text: str) -> None:
        self._last = self._client.publish(f"{self._root}/{topic}", text, retain=True)


def _text(content: Any) -> str:
    """A single value as text: as in JSON, but texts without quotes."""
    return content if isinstance(content, str) else json.dumps(content, allow_nan=False)
