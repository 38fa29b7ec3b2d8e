"""A station: its cameras, what is recorded, who may look; one TOML file describes it."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError, model_validator

from rasnik._config import SystemConfigError, read_toml, sentences
from rasnik.cameras.camera import CameraSettings
from rasnik.recording.options import Recording

__all__ = [
    "Alarms",
    "CameraConfig",
    "ChannelConfig",
    "Controls",
    "Epics",
    "Mqtt",
    "Prometheus",
    "Server",
    "StationConfig",
    "load_station",
]

_Name = Annotated[str, Field(pattern=r"^[A-Za-z][A-Za-z0-9_-]{0,39}$")]


class _Part(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, strict=False, allow_inf_nan=False)


def _in_order(limits: tuple[float, float]) -> tuple[float, float]:
    if not limits[0] < limits[1]:
        raise ValueError(f"the lower limit comes first, and is below the upper: {list(limits)}")
    return limits


_Limits = Annotated[tuple[float, float], AfterValidator(_in_order)]


class CameraConfig(_Part):
    """Where the frames of a channel come from, and the camera's settings."""

    kind: Literal["simulated", "replay", "aravis", "opencv"] = Field(
        default="simulated", description="simulated, replay, aravis or opencv"
    )
    device: str = Field(
        default="", description="aravis: serial number, name or address; opencv: number or path"
    )
    source: list[str] = Field(default=[], description="replay: folders, stacks, videos")
    pace: Literal["original", "full"] = Field(default="original", description="replay")
    repeat: bool = Field(default=False, description="replay: from the beginning again at its end")
    motion_um: float = Field(default=0.5, ge=0, description="simulated: amplitude of the motion")
    motion_hz: float = Field(default=0.3, gt=0, description="simulated: its frequency")
    seed: int = Field(default=0, ge=0, description="simulated")
    frame_rate_hz: float | None = Field(
        default=None, gt=0, description="Hz; these settings are left as they are if not set"
    )
    exposure_us: float | None = Field(default=None, gt=0, description="us")
    gain_db: float | None = Field(default=None, description="dB")
    pixel_format: Literal["Mono8", "Mono10", "Mono12", "Mono16"] | None = Field(
        default=None, description="Mono8, Mono10, Mono12 or Mono16"
    )
    region: tuple[int, int, int, int] | None = Field(
        default=None, description="left, top, width, height"
    )
    trigger: str | None = Field(default=None, description='"free" or the name of an input')
    packet_bytes: int | None = Field(
        default=None, ge=576, le=16384, description="size of network packets"
    )
    keep_exposure: bool = Field(
        default=False, description="keep the brightest fields just below full scale"
    )

    @property
    def settings(self) -> CameraSettings:
        return CameraSettings(
            self.frame_rate_hz, self.exposure_us, self.gain_db, self.pixel_format, self.region,
            self.trigger, self.packet_bytes,
        )  # fmt: skip

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if self.kind == "replay" and not self.source:
            raise ValueError("a replay needs a source: folders, stacks or videos")
        if self.region is not None and (min(self.region[:2]) < 0 or min(self.region[2:]) < 8):
            raise ValueError(
                f"region = {list(self.region)} is left, top, width and height in pixels: none "
                "below 0, width and height at least 8"
            )
        return self


class Alarms(_Part):
    """Limits; beyond them a channel is in alarm. Positions count from its zero.

    A limit of one side has inf or -inf at the other.
    """

    model_config = ConfigDict(allow_inf_nan=True)

    x_um: _Limits | None = Field(default=None, description="[low, high] in um")
    y_um: _Limits | None = Field(default=None, description="[low, high] in um")
    scale: _Limits | None = Field(default=None, description="[low, high]")
    theta_mrad: _Limits | None = Field(default=None, description="[low, high] in mrad")
    chi2_ndf: _Limits | None = Field(default=None, description="[low, high]")
    frame_rate_hz: _Limits | None = Field(default=None, description="[low, high] in Hz")
    lost_percent: float | None = Field(
        default=1.0, ge=0, description="of the frames of the last 10 s"
    )
    unlocked_s: float | None = Field(default=1.0, ge=0, description="s without a position")


class ChannelConfig(_Part):
    """One Rasnik: a system, a camera, and what is done with its poses."""

    name: _Name = Field(description="letters, digits, - and _")
    system: str = Field(default="solidras", description="name or TOML file of the system")
    orientation: int | None = Field(
        default=None, ge=1, le=4, description="1 to 4; found from the first frames if not set"
    )
    model: Literal["auto", "similarity", "affine", "projective"] = Field(
        default="auto", description="map from mask to image: similarity, affine, projective"
    )
    camera: CameraConfig = CameraConfig()
    recording: Recording = Recording()
    alarms: Alarms = Alarms()


class Server(_Part):
    """Who may look."""

    host: str = Field(default="127.0.0.1", description="address to listen on")
    port: int = Field(default=8080, ge=0, le=65535, description="0 takes one that is free")
    token_file: Path | None = Field(default=None, description="needed for any other address")


class Epics(_Part):
    """Process variables, by Channel Access and PV Access."""

    enabled: bool = False
    prefix: str = Field(
        default="RASNIK", pattern=r"^[A-Za-z0-9_:-]{1,40}$", description="of all names"
    )
    rate_hz: float = Field(default=10.0, gt=0, le=100, description="updates in a second")


class Mqtt(_Part):
    """Messages to a broker."""

    enabled: bool = False
    host: str = Field(default="localhost", description="of the broker")
    port: int = Field(default=1883, ge=1, le=65535)
    topic: str = Field(default="rasnik", min_length=1, description="all topics begin with it")
    username: str | None = None
    password_file: Path | None = Field(default=None, description="holds the password")
    rate_hz: float = Field(default=1.0, gt=0, le=100, description="messages in a second")


class Prometheus(_Part):
    """Metrics at /metrics."""

    enabled: bool = True


class Controls(_Part):
    epics: Epics = Epics()
    mqtt: Mqtt = Mqtt()
    prometheus: Prometheus = Prometheus()


class StationConfig(_Part):
    """An installation."""

    name: _Name = "rasnik"
    folder: Path = Field(default=Path("rasnik-data"), description="where recordings go")
    server: Server = Server()
    controls: Controls = Controls()
    channel: list[ChannelConfig] = Field(default=[ChannelConfig(name="simulated")], min_length=1)

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        names = [channel.name for channel in self.channel]
        folders = [name.lower() for name in names]  # as some file systems see them
        twice = sorted({name for name in names if folders.count(name.lower()) > 1})
        if twice:
            raise ValueError(f"channels need different names; not so: {', '.join(twice)}")
        return self


def load_station(path: Path) -> StationConfig:
    """Read a station file. Relative paths in it count from its folder.

    Raises
    ------
    SystemConfigError
        With one sentence for each fault.
    """
    data: dict[str, Any] = read_toml(path)
    try:
        return _placed(StationConfig.model_validate(data), path.parent)
    except ValidationError as error:
        problems = [_with_name(text, data) for text in sentences(StationConfig, error)]
        raise SystemConfigError(str(path), problems) from None


def _with_name(sentence: str, data: dict[str, Any]) -> str:
    """A sentence about channel.0 with the name of that channel, or its place counted from 1."""

    def named(found: re.Match[str]) -> str:
        index = int(found[1])
        channel = data["channel"][index]
        name = channel.get("name") if isinstance(channel, dict) else None
        return f"channel[{name if isinstance(name, str) else index + 1}]"

    return re.sub(r"\bchannel\.(\d+)(?=[. ,])", named, sentence, count=1)


def _placed(config: StationConfig, folder: Path) -> StationConfig:
    """The same with relative paths counted from a folder."""

    def at(path: Path | None) -> Path | None:
        return None if path is None else folder / path.expanduser()

    mqtt = config.controls.mqtt
    mqtt = mqtt.model_copy(update={"password_file": at(mqtt.password_file)})
    return config.model_copy(
        update={
            "folder": at(config.folder),
            "server": config.server.model_copy(update={"token_file": at(config.server.token_file)}),
            "controls": config.controls.model_copy(update={"mqtt": mqtt}),
            "channel": [_placed_channel(channel, folder) for channel in config.channel],
        }
    )


def _placed_channel(channel: ChannelConfig, folder: Path) -> ChannelConfig:
    camera = channel.camera
    source = [str(folder / Path(name).expanduser()) for name in camera.source]
    system = channel.system
    if system.endswith(".toml"):
        system = str(folder / Path(system).expanduser())
    return channel.model_copy(
        update={"system": system, "camera": camera.model_copy(update={"source": source})}
    )
