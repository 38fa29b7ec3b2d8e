"""GigE Vision and USB3 Vision cameras of any maker, through Aravis."""

from __future__ import annotations

import threading
import time
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

from rasnik.cameras import aravis_settings
from rasnik.cameras.addresses import is_address
from rasnik.cameras.camera import (
    NAN,
    Camera,
    CameraFrame,
    CameraLostError,
    CameraMissingError,
    CameraSettings,
    SettingRefusedError,
)
from rasnik.cameras.packed_pixels import grey_levels

__all__ = ["AravisCamera", "SeenCamera", "list_cameras"]

_BUFFERS = 50
# For packets that are sent again, which are asked for after 20 ms; later frames wait, too.
_WAIT_FOR_PACKETS_US = 40_000
_SIXTEEN_BITS = 65535
# A camera that is cut off is known to be lost only when the keep-alive messages of several
# seconds have failed; frames that do not come tell earlier.
_SILENT_S, _SILENT_PERIODS = 1.0, 10.0
_RESTARTING = {"region", "pixel_format", "packet_bytes"}  # cannot change under way
_COUNTERS = {
    "missing_packets": "n_missing_packets",
    "failures": "n_failures",
    "underruns": "n_underruns",
}
_DISCOVERY = threading.Lock()  # Aravis keeps one list of devices for all


@dataclass(frozen=True)
class SeenCamera:
    """A camera that answers; any of `device_id`, `serial` and `address` names it."""

    device_id: str
    maker: str
    model: str
    serial: str
    address: str
    protocol: str

    def __str__(self) -> str:
        return f"{self.maker} {self.model}, serial number {self.serial}, {self.address}"


def load_aravis() -> Any:
    """The module of Aravis.

    Raises
    ------
    CameraMissingError
        If it is not installed, with what to install.
    """
    try:
        import gi

        gi.require_version("Aravis", "0.8")
        from gi.repository import Aravis
    except (ImportError, ValueError) as error:
        raise CameraMissingError(
            f"GigE Vision and USB3 Vision cameras need Aravis 0.8 ({error}). On Debian: apt-get "
            "install gir1.2-aravis-0.8 libgirepository1.0-dev libcairo2-dev pkg-config gcc "
            "python3-dev, then pip install 'rasnik[camera]'."
        ) from None
    return Aravis


def list_cameras() -> list[SeenCamera]:
    """All cameras that answer; it takes about a second.

    Raises
    ------
    CameraMissingError
        If Aravis is not installed.
    """
    arv = load_aravis()
    with _DISCOVERY:
        arv.update_device_list()
        return [
            SeenCamera(
                *(
                    str(tell(k) or "")
                    for tell in (
                        arv.get_device_id,
                        arv.get_device_vendor,
                        arv.get_device_model,
                        arv.get_device_serial_nbr,
                        arv.get_device_address,
                        arv.get_device_protocol,
                    )
                )
            )
            for k in range(arv.get_n_devices())
        ]


class AravisCamera(Camera):
    """A GigE Vision or USB3 Vision camera.

    Frames that did not come whole are counted, not handed out: their numbers are missing.

    Parameters
    ----------
    device : str
        Serial number, address, model or identifier; empty for the first camera that answers.
    settings : CameraSettings, optional
        Applied whenever it is opened. The size of packets is negotiated if it is not given;
        automatic exposure and gain are switched off.
    """

    def __init__(self, device: str = "", settings: CameraSettings | None = None) -> None:
        self._arv = load_aravis()
        self.name = device or "Aravis"
        self._device_name = device.strip()
        self._asked = settings or CameraSettings()
        self._settings = CameraSettings()
        self._camera: Any = None
        self._stream: Any = None
        self._lock = threading.RLock()  # around everything but reading
        self._counted = dict.fromkeys((*_COUNTERS, "incomplete"), 0)
        self._told = dict(self._counted)
        self._last_frame_s = 0.0
        self._lost = False

    # --------------------------------------------------------------------- opening and closing

    def open(self) -> None:
        with self._lock:
            self.close()
            camera = self._connected()
            self._camera, self._lost = camera, False
            self.name = " ".join(
                str(part)
                for part in (
                    camera.get_vendor_name(),
                    camera.get_model_name(),
                    camera.get_device_serial_number(),
                )
                if part
            )
            try:
                aravis_settings.prepare(camera, self._arv, negotiate=not self._asked.packet_bytes)
                aravis_settings.apply(camera, self._asked, self.name)
                self.number_wraps_at = _largest_number(camera)
                self._begin()
            except self._error as error:
                self._lost = True
                self._let_go()
                raise CameraMissingError(
                    f"{self.name} answered, but could not be started: {error.message}"
                ) from None
            except BaseException:
                self._let_go()
                raise

    def close(self) -> None:
        with self._lock:
            if self._camera is not None:
                self._let_go()

    @property
    def _error(self) -> Any:
        from gi.repository import GLib

        return GLib.Error

    def _connected(self) -> Any:
        """The camera of that name, under our control."""
        name = self._device_name
        if not is_address(name):
            seen = list_cameras()
            chosen = [one for one in seen if not name or name in _names(one)]
            if not chosen:
                listed = "; ".join(map(str, seen)) or "none"
                raise CameraMissingError(
                    f"the camera {name or '(any)'} does not answer; seen: {listed}. Check cable, "
                    "power, and that the camera has an address of the same network."
                )
            name = chosen[0].device_id
        try:
            camera = self._arv.Camera.new(name)
        except self._error as error:
            raise CameraMissingError(
                f"the camera {name} does not answer: {error.message}. Check cable, power and "
                "address."
            ) from None
        if camera.is_gv_device() and not camera.get_device().is_controller():
            raise CameraMissingError(
                f"the camera {name} is controlled by another program; close that, or wait a few "
                "seconds if it has ended just now."
            )
        return camera

    def _begin(self) -> None:
        """A new stream of frames with the settings in force."""
        camera = self._camera
        stream = camera.create_stream(None, None)
        if stream is None:
            raise CameraMissingError(f"{self.name} gives no stream of frames.")
        if camera.is_gv_device():
            stream.set_property("frame-retention", _WAIT_FOR_PACKETS_US)
        payload = camera.get_payload()
        for _ in range(_BUFFERS):
            stream.push_buffer(self._arv.Buffer.new_allocate(payload))
        self._settings = aravis_settings.in_force(camera, self._asked.trigger)
        camera.start_acquisition()
        self._last_frame_s = time.perf_counter()
        self._stream = stream

    def _let_go(self) -> None:
        """Forget the camera; what its driver has counted is kept."""
        stream = self._keep_counts()
        camera, self._camera = self._camera, None
        if self._lost:
            # To say goodbye to a camera that does not answer takes ten seconds; a program that
            # connects again need not wait for it.
            held = [stream, camera]
            del stream, camera
            threading.Thread(target=held.clear, name="camera let go", daemon=True).start()
            return
        with suppress(self._error):
            camera.stop_acquisition()

    def _keep_counts(self) -> Any:
        """The stream, which is not read from any more."""
        stream, self._stream = self._stream, None
        if stream is not None:
            for name, counter in _COUNTERS.items():
                self._counted[name] += stream.get_info_uint64_by_name(counter)
        return stream

    # ----------------------------------------------------------------------------------- frames

    def read(self, timeout_s: float) -> CameraFrame | None:
        until_s = time.perf_counter() + timeout_s
        while True:
            stream = self._stream
            if stream is None:
                if self._camera is None:
                    raise CameraLostError(f"{self.name} is not open.")
                time.sleep(0.001)  # its settings are being changed
                buffer = None
            else:
                left_s = max(until_s - time.perf_counter(), 0.0)
                buffer = stream.timeout_pop_buffer(round(1e6 * left_s))
            received_s, host_s = time.perf_counter(), time.time()
            if buffer is not None:
                self._last_frame_s = received_s  # also if it is not whole: the camera is there
                frame = self._frame(buffer, received_s, host_s)
                stream.push_buffer(buffer)
                if frame is not None:
                    return frame
            if received_s >= until_s:
                self._check_presence(received_s)
                return None

    def _frame(self, buffer: Any, received_s: float, host_s: float) -> CameraFrame | None:
        """What a buffer holds; None if it is not a whole frame."""
        if buffer.get_status() != self._arv.BufferStatus.SUCCESS:
            self._counted["incomplete"] += 1
            return None
        try:
            image = grey_levels(
                buffer.get_image_data(),
                buffer.get_image_pixel_format(),
                buffer.get_image_width(),
                buffer.get_image_height(),
            )
        except ValueError:
            self._counted["incomplete"] += 1
            return None
        settings = self._settings
        return CameraFrame(
            image=image,
            number=buffer.get_frame_id(),
            host_time_s=host_s,
            received_s=received_s,
            device_time_s=1e-9 * buffer.get_timestamp(),
            exposure_us=NAN if settings.exposure_us is None else settings.exposure_us,
            gain_db=NAN if settings.gain_db is None else settings.gain_db,
        )

    def _check_presence(self, now_s: float) -> None:
        """Called when no frame has come.

        Raises
        ------
        CameraLostError
        """
        with self._lock:
            if self._camera is None or self._stream is None:
                return
            device = self._camera.get_device()
            if self._camera.is_gv_device() and not device.is_controller():
                self._lost = True
                raise CameraLostError(
                    f"{self.name} is not under control any more: its cable or power was cut, or "
                    "another program took it."
                )
            settings = self._settings
            if settings.trigger not in (None, "free"):
                return  # it waits for its trigger
            period_s = 1 / (settings.frame_rate_hz or _SILENT_PERIODS)
            silent_s = now_s - self._last_frame_s
            longest_s = _SILENT_S + _SILENT_PERIODS * period_s + 1e-6 * (settings.exposure_us or 0)
            if silent_s > longest_s:
                self._lost = True
                raise CameraLostError(
                    f"{self.name} has sent no frame for {silent_s:.1f} s. Check its cable and "
                    "power."
                )

    # --------------------------------------------------------------------------------- settings

    @property
    def settings(self) -> CameraSettings:
        return self._settings

    def change(self, settings: CameraSettings) -> CameraSettings:
        with self._lock:
            if self._camera is None:
                raise SettingRefusedError(f"{self.name} is not open; it has no settings yet.")
            changed = settings.changed()
            try:
                if _RESTARTING & changed.keys():
                    self._restart_with(settings)
                else:
                    aravis_settings.apply(self._camera, settings, self.name)
                    trigger = settings.trigger or self._asked.trigger
                    self._settings = aravis_settings.in_force(self._camera, trigger)
            except self._error as error:
                raise SettingRefusedError(
                    f"{self.name} refuses {', '.join(changed)}: {error.message}"
                ) from None
            self._asked = replace(self._asked, **changed)  # also after reconnection
            return self._settings

    def _restart_with(self, settings: CameraSettings) -> None:
        """Change what needs the stream to stop; frames go on whether it is accepted or not."""
        self._keep_counts()
        self._camera.stop_acquisition()
        try:
            aravis_settings.apply(self._camera, settings, self.name)
        finally:
            self._begin()

    def counters(self) -> dict[str, int]:
        """Besides the driver's: "incomplete", frames of which a part was missing.

        While the camera is connected or set, which takes seconds if it does not answer, the last
        ones are told again: who asks looks after alarms, too.
        """
        if not self._lock.acquire(blocking=False):
            return self._told
        try:
            counted = dict(self._counted)
            if self._stream is not None:
                for name, counter in _COUNTERS.items():
                    counted[name] += self._stream.get_info_uint64_by_name(counter)
            self._told = counted
        finally:
            self._lock.release()
        return counted


def _largest_number(camera: Any) -> int | None:
    """GigE Vision counts with 16 bits, unless its 64 bits are switched on; USB3 Vision with 64."""
    if not camera.is_gv_device():
        return None
    extended = "GevGVSPExtendedIDMode"
    if camera.is_feature_available(extended) and camera.get_string(extended) == "On":
        return None
    return _SIXTEEN_BITS


def _names(camera: SeenCamera) -> set[str]:
    return {camera.device_id, camera.serial, camera.address, camera.model}
