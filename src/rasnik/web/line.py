"""Questions of the page's process, and the station's answers.

Questions are JSON: name, channel, arguments. Answers are pickled, so that a row, a frame or an
error arrives as what it was. It is not so the other way round: the page's process reads what
strangers send, and nothing that it says is unpickled.
"""

from __future__ import annotations

import json
import logging
import pickle
import threading
from multiprocessing.connection import Connection
from typing import TYPE_CHECKING, Any

from rasnik.cameras.camera import CameraError

if TYPE_CHECKING:
    from rasnik.live.service import Station

__all__ = ["READY", "Answers", "Line", "StationGoneError"]

_log = logging.getLogger(__name__)

#: What the page's process says when it serves; anything else is a sentence why it does not.
READY = b"ready"
_LARGE_BYTES = 4096  # sent from where they lie
_METHODS = frozenset(
    {
        "set_exposure",
        "keep_exposure",
        "zero",
        "clear_zero",
        "start_recording",
        "stop_recording",
        "snapshot",
        "keep_frames",
        "history",
    }
)


class StationGoneError(Exception):
    """The station's process does not answer any more."""


class Line:
    """Asks a station in another process; one question at a time, from any thread."""

    def __init__(self, connection: Connection) -> None:
        self._connection = connection
        self._lock = threading.Lock()

    def ask(self, question: str, channel: str | None = None, *arguments: Any) -> Any:
        """The answer.

        Raises
        ------
        CameraError, ValueError, OSError
            As the station raised it.
        StationGoneError
            If there is no answer.
        RuntimeError
            If something failed inside; the station's log says what.
        """
        with self._lock:
            try:
                self._connection.send_bytes(json.dumps([question, channel, arguments]).encode())
                fine, answer = _receive(self._connection)
            except (EOFError, OSError) as error:
                raise StationGoneError(f"The station has ended ({type(error).__name__}).") from None
        if fine:
            return answer
        if answer is None:
            raise RuntimeError(f"the station failed at {question}; its log says why")
        raise answer


class Answers:
    """Answers for a station, in threads that wait nearly all the time.

    Parameters
    ----------
    station : Station
    """

    def __init__(self, station: Station) -> None:
        self._station = station

    def serve(self, connection: Connection) -> None:
        """Answer until the other side is gone; closes the connection."""
        with connection:
            try:
                while True:
                    question, channel, arguments = json.loads(connection.recv_bytes())
                    _send(connection, self._answer(question, channel, arguments))
            except (EOFError, OSError):
                pass
            except Exception:  # the page's process ends without answers, and is started again
                _log.exception("the page could not be answered")

    def _answer(self, question: str, channel: str, arguments: list[Any]) -> tuple[bool, Any]:
        try:
            return True, self._found(question, channel, arguments)
        except (CameraError, ValueError, OSError) as error:
            return False, _as_it_arrives(error)
        except Exception:
            _log.exception("the page asked for %s", question)
            return False, None

    def _found(self, question: str, name: str, arguments: list[Any]) -> Any:
        channels = self._station.channels
        if question == "statuses":
            return {
                name: (channel.status(), getattr(channel, "keeps_exposure", None))
                for name, channel in channels.items()
            }
        channel = channels[name]
        if question == "rows":
            return channel.recent.since(*arguments)
        if question == "latest":
            sample = channel.latest()
            known = sample is None or sample.number == arguments[0]
            return None if known else sample
        if question == "recorded":
            return channel.recorder.current()
        if question not in _METHODS:
            raise KeyError(question)
        return getattr(channel, question)(*arguments)


def _as_it_arrives(error: Exception) -> Exception:
    """The error itself, or one of its kind where it cannot be sent."""
    try:
        pickle.loads(pickle.dumps(error))
    except Exception:
        if isinstance(error, OSError):
            return OSError(error.errno, error.strerror or str(error))
        return CameraError(str(error)) if isinstance(error, CameraError) else ValueError(str(error))
    return error


def _send(connection: Connection, content: Any) -> None:
    """Pickled; large arrays are sent from where they lie, without a copy."""
    large: list[memoryview] = []

    def apart(buffer: pickle.PickleBuffer) -> bool:
        """Whether it stays within the pickle."""
        view = buffer.raw()
        if view.nbytes < _LARGE_BYTES:
            return True
        large.append(view)
        return False

    text = pickle.dumps(content, protocol=5, buffer_callback=apart)
    connection.send_bytes(len(large).to_bytes(4, "little") + text)
    for view in large:
        connection.send_bytes(view)


def _receive(connection: Connection) -> Any:
    message = connection.recv_bytes()
    count = int.from_bytes(message[:4], "little")
    return pickle.loads(
        memoryview(message)[4:], buffers=[connection.recv_bytes() for _ in range(count)]
    )
