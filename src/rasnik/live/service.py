"""All channels of a station, started and stopped together."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from types import TracebackType
from typing import Self

from rasnik.live.channel import Channel
from rasnik.live.station import StationConfig

__all__ = ["Station"]


class Station:
    """The channels of an installation. A context manager.

    Parameters
    ----------
    config : StationConfig

    Attributes
    ----------
    config : StationConfig
    channels : dict of str to Channel
        By name, in the order of the configuration.

    Raises
    ------
    SystemConfigError
        If a system cannot be read.
    CameraMissingError
        If what a camera needs is not installed.
    """

    def __init__(self, config: StationConfig) -> None:
        self.config = config
        self.channels: dict[str, Channel] = {}
        try:
            for index, channel in enumerate(config.channel):
                self.channels[channel.name] = Channel(channel, config.folder, index=index)
        except BaseException:
            self.stop()
            raise

    def start(self) -> None:
        for channel in self.channels.values():
            channel.start()

    def stop(self) -> None:
        """End all channels at the same time; none waits for another."""
        if not self.channels:
            return
        with ThreadPoolExecutor(len(self.channels)) as pool:
            for done in [pool.submit(channel.stop) for channel in self.channels.values()]:
                done.result()

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.stop()
