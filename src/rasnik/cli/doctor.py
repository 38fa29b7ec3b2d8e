"""``rasnik doctor``: whether this machine can run a station."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rasnik.cli.common import fail, messages, output

if TYPE_CHECKING:
    from rasnik.live.checks.finding import Finding
    from rasnik.live.station import StationConfig

__all__ = ["doctor_command"]

_STYLES = {"ok": "green", "note": "cyan", "warning": "yellow", "fault": "bold red"}


def doctor_command(
    station: Annotated[
        Path | None,
        typer.Argument(
            metavar="STATION.toml",
            help="Look at what this station needs; without it, at a station with a simulated "
            "camera.",
        ),
    ] = None,
    quick: Annotated[
        bool, typer.Option("--quick", help="Do not measure the disk and the rate of analysis.")
    ] = False,
    service: Annotated[
        bool,
        typer.Option("--service", help="Print a systemd unit that runs the station, and end."),
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="The findings as JSON.")] = False,
) -> None:
    """Look at what a station needs: packages, cameras, network, privileges, disk, speed.

    Each finding is ok, a note, a warning or a fault, and whatever is not ok comes with one remedy.

    Exit status: 0 no fault, 1 some fault, 2 wrong usage.

    [bold]Examples[/]

    rasnik doctor

    rasnik doctor station.toml --json

    rasnik doctor --service station.toml | sudo tee /etc/systemd/system/rasnik-live.service
    """
    if service:
        _print_unit(station)
        return
    config = _config(station)

    from rasnik.live.doctor import examine
    from rasnik.web.server import read_token

    findings = []
    with messages().status("looking") as status:
        for finding in examine(config, read_token=read_token, quick=quick):
            findings.append(finding)
            status.update(f"looked at {finding.about}")
    if as_json:
        typer.echo(json.dumps([asdict(finding) for finding in findings], indent=2))
    else:
        _print(findings)
    raise typer.Exit(any(finding.level == "fault" for finding in findings))


def _config(station: Path | None) -> StationConfig:
    from rasnik.instrument import SystemConfigError
    from rasnik.live.station import StationConfig, load_station

    if station is None:
        return StationConfig()
    try:
        return load_station(station)
    except SystemConfigError as error:
        fail(str(error))


def _print_unit(station: Path | None) -> None:
    from rasnik.live.unit import service_unit

    if station is None:
        fail("--service needs the station file: rasnik doctor --service STATION.toml")
    typer.echo(service_unit(_config(station), station), nl=False)


def _print(findings: list[Finding]) -> None:
    from rich.markup import escape
    from rich.table import Table

    console = output()
    table = Table(box=None, pad_edge=False, header_style="bold")
    for heading in ("", "about", "found"):
        table.add_column(heading, no_wrap=heading != "found", overflow="fold")
    for finding in findings:
        text = escape(finding.found)
        if finding.remedy:
            text += f"\n[dim]->[/] {escape(finding.remedy)}"
        style = _STYLES[finding.level]
        table.add_row(f"[{style}]{finding.level}[/]", escape(finding.about), text)
    console.print(table)
    counts = {level: sum(each.level == level for each in findings) for level in _STYLES}
    console.print(
        f"\n{counts['fault']} faults, {counts['warning']} warnings, {counts['note']} notes, "
        f"{counts['ok']} ok"
    )
