"""``rasnik export``: a track in another format."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape

from rasnik.cli import export_seismic as seismic
from rasnik.cli.common import fail, messages
from rasnik.cli.export_results import export_icaras, export_results, track_or_results
from rasnik.cli.export_seismic import SeismicOptions, export_seismic
from rasnik.cli.seismic_options import FileOption, FrequencyOption, OnMassOption, QOption

__all__ = ["export_command"]


def export_command(
    track: Annotated[
        Path,
        typer.Argument(
            help="A track, as rasnik track writes it; or results, as rasnik analyse does, or "
            "LWDAQ (.txt)."
        ),
    ],
    output: Annotated[
        Path,
        typer.Option(
            "--output",
            "-o",
            metavar="FILE",
            help="File to write: .csv, .parquet, .h5, .icaras; of a track .mseed, of results "
            ".jsonl.",
        ),
    ],
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace a file that is there already.")
    ] = False,
    network: seismic.NetworkOption = "XX",
    station: seismic.StationOption = None,
    location: seismic.LocationOption = "",
    channels: seismic.ChannelOption = None,
    suspension: FileOption = None,
    frequency: FrequencyOption = None,
    q: QOption = None,
    on_mass: OnMassOption = None,
    stationxml: seismic.StationXmlOption = None,
    place: seismic.PlaceOption = None,
    count_nm: seismic.CountOption = None,
    start: seismic.StartOption = None,
    frame_rate: seismic.RateOption = None,
    exposure: seismic.ExposureOption = None,
) -> None:
    """Convert a track to CSV, Parquet, miniSEED or lines of ICARAS; or results of images.

    A track that is still being measured can be exported as well, as far as it has come.

    [bold]Examples[/]

    rasnik export track.h5 -o track.csv

    rasnik export track.h5 -o track.parquet --overwrite

    rasnik export track.h5 -o track.mseed --station RAS1 --frequency 0.5 --q 5
    --channel x=90 --channel y=0,-90 --stationxml track.xml --place 52.36,4.95

    rasnik export lwdaq_results.txt -o results.parquet
    """
    from rasnik.io import write_track
    from rasnik.io.seismic_files import MINISEED_SUFFIXES
    from rasnik.tracking.track import Track

    if output.exists() and track.exists() and output.samefile(track):
        fail(f"{output} is the track itself; name another file.")
    if output.exists() and not overwrite:
        fail(f"{output} exists already; give another name, or --overwrite to replace it.")
    options = SeismicOptions(
        network, station, location, channels, suspension, frequency, q, on_mass, stationxml,
        place, count_nm, start, frame_rate, exposure,
    )  # fmt: skip
    is_seismic = output.suffix.lower() in MINISEED_SUFFIXES
    if options.given and not is_seismic:
        fail(f"{output}: the options of miniSEED need a name in {', '.join(MINISEED_SUFFIXES)}.")
    try:
        rows = track_or_results(track)
        if not isinstance(rows, Track):
            if is_seismic:
                fail(f"{track} holds results of images; miniSEED is made of a track.")
            said = [export_results(rows, output)]
        elif output.suffix.lower() == ".icaras":
            said = [export_icaras(rows, track, output)]
        elif is_seismic:
            said = export_seismic(track, rows, output, options, overwrite=overwrite)
        else:
            write_track(rows, output, overwrite=overwrite)
            said = [f"{len(rows)} frames written to {output}"]
    except (ValueError, ImportError) as error:
        fail(f"{str(error).rstrip('.')}.")
    except OSError as error:
        fail(f"{str(error).rstrip('.')}.")
    for sentence in said:
        messages().print(escape(sentence))
