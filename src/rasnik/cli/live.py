"""``rasnik live``: cameras measured, recorded and shown, until somebody ends it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rasnik.cli.common import fail, messages

if TYPE_CHECKING:
    from rasnik.live.station import StationConfig

__all__ = ["live_command"]

_PAGE, _RECORD = "Page", "Recording"


def live_command(
    station: Annotated[
        Path | None,
        typer.Argument(
            metavar="[STATION.toml]",
            help="Cameras, recording, page and control systems; without it a simulated camera.",
        ),
    ] = None,
    init: Annotated[
        bool,
        typer.Option("--init", help="Write a station file with every setting, and end."),
    ] = False,
    seconds: Annotated[
        float | None,
        typer.Option(metavar="S", min=0.0, help="End after this time."),
    ] = None,
    port: Annotated[
        int | None,
        typer.Option(
            metavar="N", min=0, max=65535, help="Of the page; 0: any.", rich_help_panel=_PAGE
        ),
    ] = None,
    host: Annotated[
        str | None,
        typer.Option(
            metavar="H",
            help="Address the page listens on; any but this machine's own needs a token_file in "
            "the station file.",
            rich_help_panel=_PAGE,
        ),
    ] = None,
    page: Annotated[
        bool,
        typer.Option("--page/--no-page", help="Whether to serve a page.", rich_help_panel=_PAGE),
    ] = True,
    record: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            help="Record all channels into this folder; ./rasnik-data without a station file.",
            rich_help_panel=_RECORD,
        ),
    ] = None,
    no_record: Annotated[
        bool,
        typer.Option("--no-record", help="Record nothing.", rich_help_panel=_RECORD),
    ] = False,
) -> None:
    """Measure with cameras: track, record, show on a page, publish.

    Alone it begins with a simulated camera. Ctrl-C and SIGTERM end it; what was measured by then is
    recorded.

    Exit status: 0 ended by somebody, by --seconds or by the end of recordings, 1 a camera failed
    for good, 2 wrong usage.

    [bold]Examples[/]

    rasnik live

    rasnik live --init station.toml

    rasnik live station.toml --port 8081
    """
    if init:
        _write_station(station or Path("station.toml"))
        return
    if record is not None and no_record:
        fail("--record and --no-record exclude each other; give one of them.")
    config = _configured(_load(station), port, host, record, no_record)

    from rasnik.cli.live_run import run_live

    raise typer.Exit(run_live(config, seconds, page))


def _write_station(path: Path) -> None:
    from rasnik.live.station import StationConfig
    from rasnik.live.station_file import station_toml

    try:
        with path.open("x", encoding="utf-8") as file:
            file.write(station_toml(StationConfig()))
    except FileExistsError:
        fail(f"{path} exists already and is not overwritten; give another name.")
    except OSError as error:
        fail(f"{path} cannot be written: {error.strerror or error}.")
    messages().print(f"{path} is written; change it, then: rasnik live {path}", markup=False)


def _load(path: Path | None) -> StationConfig:
    from rasnik._config import SystemConfigError
    from rasnik.live.station import StationConfig, load_station

    if path is None:
        return StationConfig()
    try:
        return load_station(path)
    except SystemConfigError as error:
        fail(str(error))


def _configured(
    config: StationConfig,
    port: int | None,
    host: str | None,
    record: Path | None,
    no_record: bool,
) -> StationConfig:
    """The station with what the command changes."""
    given = {"port": port, "host": host}
    server = config.server.model_copy(
        update={name: value for name, value in given.items() if value is not None}
    )
    channels = config.channel
    if record is not None or no_record:
        channels = [
            channel.model_copy(
                update={
                    "recording": channel.recording.model_copy(update={"enabled": not no_record})
                }
            )
            for channel in channels
        ]
    return config.model_copy(
        update={"server": server, "channel": channels, "folder": record or config.folder}
    )
