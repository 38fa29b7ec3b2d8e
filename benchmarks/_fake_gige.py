"""A GigE Vision camera that is not there: Aravis' own, in a process of its own, showing a Rasnik.

The mask goes round a circle, one turn in `pool` frames; frame k of a turn is always the same
picture. Every frame that is sent is noted in a file with its time stamp, so that whoever
receives it knows where the mask was, and what was sent but not received. The file is complete even
if the process is killed.

    python benchmarks/_fake_gige.py --address 127.0.0.1 --serial R1 --log sent.bin
"""

from __future__ import annotations

import argparse
import ctypes
import signal
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np

CENTRE_UM = (41000.0, 30200.0)
THETA_RAD, ORIENTATION = 0.002, 4
PORT = 3956  # of GigE Vision
NOMINAL_EXPOSURE_US = 1000.0
SENT = np.dtype([("time_us", "<i8"), ("number", "<u4"), ("phase", "<u4")])
_MOST_SENT = 1 << 20  # frames noted: an hour at 275 Hz
_FILL = ctypes.CFUNCTYPE(
    None, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_uint32, ctypes.c_uint32, ctypes.c_uint32
)


def truth_um(phase: np.ndarray, pool: int, radius_um: float) -> np.ndarray:
    """Where the mask is in frames of a turn, shape (n, 2)."""
    angle = 2 * np.pi * np.asarray(phase) / pool
    return np.array(CENTRE_UM) + radius_um * np.stack([np.cos(angle), np.sin(angle)], axis=-1)


def read_sent(path: Path) -> np.ndarray:
    """What was sent, in its order: time stamps, numbers, and phases of the turn."""
    sent = np.fromfile(path, SENT)
    return sent[: np.count_nonzero(sent["time_us"])]


class FakeCamera:
    """The camera's process, as its user sees it; it is ready when this is made.

    Parameters
    ----------
    address, serial : str
        Each camera needs an address of its own; see `add_address`.
    log : Path
        What was sent; see `read_sent`.
    pictures : Path
        Frames of a turn, as `make_pictures` writes them.
    lost_ratio : float
        Part of the packets that get lost.
    light : float
        Below 1 the lamp is dimmer.
    """

    def __init__(
        self,
        log: Path,
        pictures: Path,
        *,
        address: str = "127.0.0.1",
        serial: str = "R1",
        lost_ratio: float = 0.0,
        light: float = 1.0,
    ) -> None:
        self.address, self.log = address, log
        command = [sys.executable, __file__, "--address", address, "--serial", serial]
        command += ["--log", str(log), "--pictures", str(pictures)]
        command += ["--lost-ratio", str(lost_ratio), "--light", str(light)]
        self.process = subprocess.Popen(
            command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, text=True
        )
        assert self.process.stdout is not None
        self._words = self.process.stdout
        if self._words.readline().strip() != "ready":
            self.close()
            raise OSError(f"the fake camera at {address} did not start; is the address in use?")

    def sent(self) -> np.ndarray:
        return read_sent(self.log)

    def kill(self) -> None:
        """As if its power was cut."""
        self.process.kill()
        self.process.wait()

    def close(self) -> None:
        self.process.terminate()
        self.process.wait(10)
        self._words.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()


def make_pictures(path: Path, pool: int, radius_um: float, system: Any, seed: int) -> None:
    """Frames of a turn, with the noise of the sensor, into a .npy file."""
    import _study
    from rasnik.imaging.projection import Projection

    projections = [
        Projection.from_pose(x, y, system.optics.scale, THETA_RAD, ORIENTATION)
        for x, y in truth_um(np.arange(pool), pool, radius_um)
    ]
    np.save(path, _study.frame_pool(system, projections, seed=seed))


def add_address(address: str) -> str:
    """Give the loopback interface another address; a sentence if that is not possible."""
    if address == "127.0.0.1":
        return ""
    try:
        shown = subprocess.run(["ip", "addr", "show", "lo"], capture_output=True, text=True)
        if f" {address}/" in shown.stdout:
            return ""
        command = ["ip", "addr", "add", f"{address}/8", "dev", "lo"]
        run = subprocess.run(command, capture_output=True, text=True)
    except FileNotFoundError:
        return "the program ip is not installed"
    with socket.socket() as probe:
        probe.bind((address, 0))
    return f"{' '.join(command)}: {run.stderr.strip()}" if run.returncode else ""


class _Camera:
    """What runs in the process: Aravis sends, and asks for the pixels of each frame."""

    def __init__(self, options: argparse.Namespace) -> None:
        import gi

        gi.require_version("Aravis", "0.8")
        from gi.repository import Aravis

        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            try:
                probe.bind((options.address, PORT))  # Aravis would share it with another camera
            except OSError as error:
                raise SystemExit(f"no camera is possible at {options.address}: {error}") from None
        self._pictures = np.load(options.pictures)
        self._levels = np.arange(256)
        self._light = options.light
        self._looks: dict[float, np.ndarray] = {1.0: self._levels.astype(np.uint8)}
        self._sent = np.memmap(options.log, SENT, "w+", shape=(_MOST_SENT,))
        self._count = 0
        self._camera = Aravis.GvFakeCamera.new_full(options.address, options.serial, None)
        if not self._camera.is_running():
            raise SystemExit(f"no camera is possible at {options.address}")
        self._camera.set_property("gvsp-lost-ratio", options.lost_ratio)
        self._fake = self._camera.get_fake_camera()
        _, height, width = self._pictures.shape
        self._registers = Aravis
        for register, value in (
            (Aravis.FAKE_CAMERA_REGISTER_WIDTH, width),
            (Aravis.FAKE_CAMERA_REGISTER_HEIGHT, height),
            (Aravis.FAKE_CAMERA_REGISTER_EXPOSURE_TIME_US, int(NOMINAL_EXPOSURE_US)),
        ):
            self._fake.write_register(register, value)
        library = ctypes.CDLL("libaravis-0.8.so.0")
        self._data = library.arv_buffer_get_data
        self._data.restype = ctypes.c_void_p
        self._data.argtypes = [ctypes.c_void_p, ctypes.POINTER(ctypes.c_size_t)]
        self._number = library.arv_buffer_get_frame_id
        self._number.restype, self._number.argtypes = ctypes.c_uint64, [ctypes.c_void_p]
        self._time = library.arv_buffer_get_timestamp
        self._time.restype, self._time.argtypes = ctypes.c_uint64, [ctypes.c_void_p]
        # Kept, or Python would free it while Aravis still calls it.
        self._callback = _FILL(self._fill)
        library.arv_fake_camera_set_fill_pattern.argtypes = [
            ctypes.c_void_p,
            _FILL,
            ctypes.c_void_p,
        ]
        library.arv_fake_camera_set_fill_pattern(hash(self._fake), self._callback, None)

    def _fill(self, buffer: int, _: Any, exposure_us: int, gain: int, pixel_format: int) -> None:
        phase = self._count % len(self._pictures)
        picture = self._picture(phase, exposure_us)
        size = ctypes.c_size_t()
        where = self._data(buffer, ctypes.byref(size))
        ctypes.memmove(where, picture.ctypes.data, min(picture.nbytes, self._fake.get_payload()))
        if self._count < len(self._sent):
            row = self._sent[self._count]
            row["number"], row["phase"] = self._number(buffer), phase
            row["time_us"] = self._time(buffer) // 1000  # last: it marks the row as whole
        self._count += 1

    def _picture(self, phase: int, exposure_us: int) -> np.ndarray:
        """The part that is asked for, as bright as the exposure makes it."""
        picture = self._pictures[phase]
        read, arv = self._fake.read_register, self._registers
        width = read(arv.FAKE_CAMERA_REGISTER_WIDTH)[1]
        height = read(arv.FAKE_CAMERA_REGISTER_HEIGHT)[1]
        if (height, width) != picture.shape:
            left = read(arv.FAKE_CAMERA_REGISTER_X_OFFSET)[1]
            top = read(arv.FAKE_CAMERA_REGISTER_Y_OFFSET)[1]
            part = np.zeros((height, width), np.uint8)
            inside = picture[top : top + height, left : left + width]
            part[: inside.shape[0], : inside.shape[1]] = inside
            picture = part
        factor = self._light * exposure_us / NOMINAL_EXPOSURE_US
        if factor == 1:
            return picture
        if factor not in self._looks:
            self._looks[factor] = np.clip(factor * self._levels, 0, 255).astype(np.uint8)
        return self._looks[factor][picture]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--address", default="127.0.0.1")
    parser.add_argument("--serial", default="R1")
    parser.add_argument("--log", required=True, help="file for what was sent")
    parser.add_argument("--pictures", required=True, help=".npy file with the frames of a turn")
    parser.add_argument("--lost-ratio", type=float, default=0.0, help="of the packets")
    parser.add_argument("--light", type=float, default=1.0, help="brightness of the lamp")
    options = parser.parse_args()
    ended = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: ended.set())
    camera = _Camera(options)
    print("ready", flush=True)
    while not ended.is_set():  # a wait without end would not see the signal
        time.sleep(0.1)
    del camera


if __name__ == "__main__":
    main()
