"""``rasnik export`` to miniSEED and StationXML: its options, and the way to the files."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rasnik.cli.common import fail, numbers
from rasnik.cli.files import check_folder, check_frames, exposure_of
from rasnik.cli.seismic_options import OnMass

if TYPE_CHECKING:
    from rasnik.io.seed_codes import Direction, Site
    from rasnik.io.seismic_files import SeismicChannel
    from rasnik.seismic.suspension import Suspension
    from rasnik.tracking.track import Track

__all__ = ["SeismicOptions", "export_seismic"]

_PANEL = "miniSEED"

NetworkOption = Annotated[
    str,
    typer.Option(metavar="CODE", help="SEED network; XX is nobody's.", rich_help_panel=_PANEL),
]
StationOption = Annotated[
    str | None, typer.Option(metavar="CODE", help="SEED station.", rich_help_panel=_PANEL)
]
LocationOption = Annotated[
    str,
    typer.Option(
        metavar="CODE", help="SEED location, two characters or none.", rich_help_panel=_PANEL
    ),
]
ChannelOption = Annotated[
    list[str] | None,
    typer.Option(
        "--channel",
        metavar="COLUMN[=AZIMUTH[,DIP]]",
        help="Column and where its axis on the mask points: degrees clockwise from north, degrees "
        "down. Repeatable; by default x and y, directions unknown.",
        rich_help_panel=_PANEL,
    ),
]
StationXmlOption = Annotated[
    Path | None,
    typer.Option(
        "--stationxml", metavar="FILE", help="Write the response, too.", rich_help_panel=_PANEL
    ),
]
PlaceOption = Annotated[
    str | None,
    typer.Option(
        "--place",
        metavar="LAT,LON[,ELEVATION[,DEPTH]]",
        help="Of the station, degrees and metres; StationXML needs it.",
        rich_help_panel=_PANEL,
    ),
]
CountOption = Annotated[
    float | None,
    typer.Option(
        "--count-nm",
        metavar="NM",
        help="Write integers (Steim2) of this step; by default floats in metres.",
        rich_help_panel=_PANEL,
    ),
]
StartOption = Annotated[
    str | None,
    typer.Option(
        "--start",
        metavar="TIME",
        help="UTC time of the first frame, as 2026-11-23T02:10:00, where the track's times do not "
        "count from 1970.",
        rich_help_panel=_PANEL,
    ),
]
RateOption = Annotated[
    float | None,
    typer.Option(
        "--frame-rate",
        metavar="HZ",
        help="Of a track that has no times.",
        rich_help_panel=_PANEL,
    ),
]
ExposureOption = Annotated[
    float | None,
    typer.Option(
        "--exposure",
        metavar="SECONDS",
        help="Exposure of a frame, for the response; by default that of the track's system.",
        rich_help_panel=_PANEL,
    ),
]


@dataclass(frozen=True)
class SeismicOptions:
    """What the options said, as they came."""

    network: str
    station: str | None
    location: str
    channels: list[str] | None
    suspension: Path | None
    frequency_hz: float | None
    q: float | None
    on_mass: OnMass | None
    stationxml: Path | None
    place: str | None
    count_nm: float | None
    start: str | None
    rate_hz: float | None
    exposure_s: float | None

    @property
    def given(self) -> bool:
        """Whether any was given that only miniSEED knows."""
        return self != SeismicOptions("XX", None, "", *[None] * 11)


def export_seismic(
    path: Path, track: Track, output: Path, options: SeismicOptions, *, overwrite: bool
) -> list[str]:
    """Write the files of a track; one sentence for each.

    Raises
    ------
    ValueError, OSError, ImportError
        As the functions that write them.
    """
    from rasnik.io.seismic_files import channels_of, write_miniseed
    from rasnik.io.station_xml import to_inventory, write_station_xml

    xml = options.stationxml
    for one in (output, xml):
        if one is not None:
            check_folder(one)
    if xml is not None and xml.exists() and not overwrite:
        fail(f"{xml} exists already; give another name, or --overwrite to replace it.")
    check_frames(path, track, "miniSEED")
    channels = channels_of(
        track,
        _site(options),
        _directions(options.channels),
        suspension=_suspension(options),
        start_s=_start_s(options.start),
        rate_hz=options.rate_hz,
        exposure_s=options.exposure_s
        if options.exposure_s is not None
        else exposure_of(path, track),
        encoding="FLOAT64" if options.count_nm is None else "STEIM2",
        count_nm=options.count_nm,
    )
    if xml is not None:
        to_inventory(channels)  # whatever is wrong with it comes out before the first file
    write_miniseed(channels, output, overwrite=overwrite)
    said = [f"{_listed(channels)} written to {output}"]
    if xml is not None:
        write_station_xml(channels, xml, overwrite=overwrite)
        said.append(f"response written to {xml}")
    return said


def _listed(channels: list[SeismicChannel]) -> str:
    names = ", ".join(one.identifier for one in channels)
    missing = max(one.series.missing for one in channels)
    frames = f"{len(channels[0].series)} frames at {channels[0].series.rate_hz:g} Hz"
    return f"{names}: {frames}" + (f", {missing} of them missing," if missing else "")


def _site(options: SeismicOptions) -> Site:
    from rasnik.io.seed_codes import Site

    if options.station is None:
        fail("miniSEED needs the code of a station: --station.")
    place: dict[str, Any] = {}
    if options.place is not None:
        names = ("latitude_deg", "longitude_deg", "elevation_m", "depth_m")
        values = numbers(options.place, "--place", "LAT,LON,ELEVATION,DEPTH", least=2)
        place = dict(zip(names, values, strict=False))
    elif options.stationxml is not None:
        fail("StationXML needs the place of the station: --place LAT,LON.")
    return Site(options.station, options.network, options.location, **place)


def _directions(texts: list[str] | None) -> dict[str, Direction | None]:
    from rasnik.io.seed_codes import Direction

    found: dict[str, Direction | None] = {}
    for text in texts or ("x", "y"):
        name, equals, angles = text.partition("=")
        column = {"x": "x_um", "y": "y_um"}.get(name.strip(), name.strip())
        if column in found:
            fail(f"--channel {text}: {column} is given twice.")
        found[column] = None
        if equals:
            option = f"--channel {name}="
            found[column] = Direction(*numbers(angles, option, "AZIMUTH,DIP", least=1))
    return found


def _suspension(options: SeismicOptions) -> Suspension | None:
    from rasnik.cli.seismic_options import suspension_of

    given = options.suspension, options.frequency_hz, options.q, options.on_mass
    if all(one is None for one in given):
        return None
    path, frequency_hz, q, on_mass = given
    return suspension_of(path, frequency_hz, q, None, None, on_mass, None)


def _start_s(text: str | None) -> float | None:
    if text is None:
        return None
    try:
        when = datetime.fromisoformat(text)
    except ValueError:
        fail(f"--start {text!r} is not a time such as 2026-11-23T02:10:00.")
    return (when if when.tzinfo else when.replace(tzinfo=UTC)).timestamp()
