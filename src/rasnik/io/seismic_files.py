"""Readings as miniSEED, the format in which seismometers are recorded, and back.

What is stored is the displacement of the frame relative to the proof mass, along a direction of
the channel: positive where the ground moves that way fast enough for the mass to stay behind.
Without a proof mass it is that of the camera relative to the mask. Both are the reading itself
but for its sign (`rasnik.seismic.suspension`). A float is in metres; an integer counts steps of
a stated length. Frames that are missing divide a channel into traces; nothing is interpolated.

Needs ``pip install "rasnik[seismic]"``. The response is written by `rasnik.io.station_xml`.

Source: SEED Reference Manual 2.4 (2012), appendix B for the Steim compression.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from rasnik.characterisation.gaps import TOLERANCE, Series, even_series
from rasnik.io.seed_codes import Direction, Site, channel_code
from rasnik.io.utc import EARLIEST_S
from rasnik.seismic.suspension import Suspension
from rasnik.tracking.track import Track

if TYPE_CHECKING:
    from obspy import Inventory, Stream, Trace

__all__ = [
    "ENCODINGS",
    "MINISEED_SUFFIXES",
    "SeismicChannel",
    "channels_of",
    "read_miniseed",
    "to_stream",
    "write_miniseed",
]

MINISEED_SUFFIXES = (".mseed", ".miniseed")

Encoding = Literal["FLOAT64", "STEIM2"]
#: Type of the samples in memory. Floats of 32 bits would round a reading of 4 mm to 0.2 nm.
ENCODINGS = {"FLOAT64": np.float64, "STEIM2": np.int32}

_NM_PER_M = 1e9
_DEFAULT_COUNT_NM = 0.01
# miniSEED holds rates in 32 bits, rounded by this fraction at most.
_RATE_ROUNDING = 1e-7
_LARGEST_COUNT = 2**31 - 1
# Steim2 stores differences of at most 30 bits.
_LARGEST_STEP = 2**29 - 1


def obspy() -> Any:
    """The package, or a sentence that says what to install."""
    try:
        with warnings.catch_warnings():
            # obspy reads the entry points of its plug-ins through an interface that Python 3.11
            # calls deprecated, as it is imported.
            warnings.filterwarnings("ignore", "SelectableGroups dict", DeprecationWarning)
            import obspy as package
    except ImportError as error:
        raise ImportError(
            'miniSEED and StationXML need obspy; install it with: pip install "rasnik[seismic]"'
        ) from error
    return package


@dataclass(frozen=True, eq=False)
class SeismicChannel:
    """A series of readings with all that a seismologist has to know of it.

    Attributes
    ----------
    site : Site
    series : Series
        Readings in nm; ``start_s`` is in seconds since 1970 UTC.
    suspension : Suspension, optional
        Of the proof mass that is read; without one, displacement itself is measured.
    direction : Direction, optional
        Where the axis of the mask points that the readings belong to. With the mask on the
        proof mass that is the mask's own +X or +Y.
    number : int
        1 for x and 2 for y: names the channel where the direction does not.
    exposure_s : float
        Light is gathered for so long around the time of each frame; 0 for an instant.
    encoding : {"FLOAT64", "STEIM2"}
    count_nm : float, optional
        Step of the integers of STEIM2; by default 0.01 nm.
    code : str
        Of the channel; by default made by `rasnik.io.seed_codes.channel_code`.
    """

    site: Site
    series: Series
    suspension: Suspension | None = None
    direction: Direction | None = None
    number: int = 1
    exposure_s: float = 0.0
    encoding: Encoding = "FLOAT64"
    count_nm: float | None = None
    code: str = ""

    def __post_init__(self) -> None:
        series = self.series
        if series.unit != "nm":
            raise ValueError(
                f"{series.name} is in {series.unit or 'no unit'}; seismic files hold displacements"
            )
        if not series.start_s >= EARLIEST_S:
            raise ValueError(
                f"{series.name} begins at {round(series.start_s, 6):g} s, which is not counted "
                "from 1970; give the time of its first frame in UTC"
            )
        if self.encoding not in ENCODINGS:
            raise ValueError(f"encoding {self.encoding!r} is not one of {', '.join(ENCODINGS)}")
        if self.count_nm is not None and self.encoding != "STEIM2":
            raise ValueError(f"{self.encoding} stores metres; steps are for STEIM2")
        if self.count_nm is not None and not self.count_nm > 0:
            raise ValueError(f"a count must be above 0 nm, not {self.count_nm:g}")
        if not 0 <= self.exposure_s * series.rate_hz <= 1 + TOLERANCE:
            raise ValueError(
                f"an exposure of {self.exposure_s:g} s does not go with {series.rate_hz:g} frames/s"
            )
        if not self.code:
            natural_hz = self.suspension.frequency_hz if self.suspension else None
            code = channel_code(series.rate_hz, natural_hz, self.direction, self.number)
            object.__setattr__(self, "code", code)
        if len(self.code) != 3 or not (self.code.isalnum() and self.code.isupper()):
            raise ValueError(f"the channel code {self.code!r} should be three capital letters")

    @property
    def sign(self) -> int:
        """Of what is stored, per reading."""
        return 1 if self.suspension is None else -self.suspension.sign

    @property
    def counts_per_m(self) -> float:
        """What is stored for a metre."""
        if self.encoding != "STEIM2":
            return 1.0
        return _NM_PER_M / (self.count_nm or _DEFAULT_COUNT_NM)

    @property
    def identifier(self) -> str:
        """``network.station.location.channel``."""
        return f"{self.site.network}.{self.site.station}.{self.site.location}.{self.code}"

    def samples(self) -> NDArray[Any]:
        """What is stored, NaN where nothing is; integers still as floats.

        Raises
        ------
        ValueError
            If the counts are too large for STEIM2.
        """
        values = self.sign * self.counts_per_m / _NM_PER_M * self.series.values
        if self.encoding != "STEIM2":
            return values
        values = np.rint(values)
        counts = [self.counts_per_m / _NM_PER_M * run for run in self.series.runs()]
        largest = max((np.abs(run).max() for run in counts), default=0.0)
        step = max((np.abs(np.diff(run)).max(initial=0) for run in counts), default=0.0)
        excess = max(largest / _LARGEST_COUNT, step / _LARGEST_STEP)
        if excess > 1:
            least = float(f"{(self.count_nm or _DEFAULT_COUNT_NM) * excess * 1.1:.1g}")
            raise ValueError(
                f"{self.series.name} is too large for counts of "
                f"{self.count_nm or _DEFAULT_COUNT_NM:g} nm in 32 bits; take counts of {least:g} "
                "nm, or FLOAT64"
            )
        return np.asarray(values)


def channels_of(
    track: Track,
    site: Site,
    directions: Mapping[str, Direction | None] | Sequence[str] = ("x_um", "y_um"),
    *,
    suspension: Suspension | None = None,
    start_s: float | None = None,
    rate_hz: float | None = None,
    exposure_s: float = 0.0,
    encoding: Encoding = "FLOAT64",
    count_nm: float | None = None,
) -> list[SeismicChannel]:
    """The channels of a track.

    Parameters
    ----------
    track : Track
        With regular times, in seconds since 1970 UTC unless `start_s` is given.
    site : Site
    directions : mapping or sequence
        Columns of the track, with the directions of their axes if these are known.
    suspension, exposure_s, encoding, count_nm
        As in `SeismicChannel`.
    start_s : float, optional
        When the first frame was taken, in seconds since 1970 UTC; for a track whose times have
        another zero.
    rate_hz : float, optional
        Frames in a second, for a track without times.

    Raises
    ------
    ValueError
        If the times are not regular or not known in UTC, or a column is not a displacement.
    """
    known = directions if isinstance(directions, Mapping) else dict.fromkeys(directions)
    channels = []
    for place, (column, direction) in enumerate(known.items(), start=1):
        series = even_series(track, column, rate_hz=rate_hz)
        if start_s is not None:
            if series.start_s >= EARLIEST_S:
                raise ValueError(
                    "the times of the track are counted from 1970 already; another time of its "
                    "first frame would contradict them"
                )
            series = replace(series, start_s=start_s)
        number = {"x_um": 1, "y_um": 2}.get(column, place)
        channels.append(
            SeismicChannel(
                site, series, suspension, direction, number, exposure_s, encoding, count_nm
            )
        )
    _check_names(channels)
    return channels


def to_stream(channels: Iterable[SeismicChannel]) -> Stream:
    """Traces of obspy, one for each stretch without a gap.

    Raises
    ------
    ValueError
        If two channels have one name, one has no value, or counts are too large.
    ImportError
        If obspy is not installed.
    """
    package = obspy()
    channels = list(channels)
    _check_names(channels)
    return package.Stream([trace for one in channels for trace in _traces(one)])


def write_miniseed(
    channels: Iterable[SeismicChannel], path: str | os.PathLike[str], *, overwrite: bool = False
) -> None:
    """Write channels into one miniSEED file, which appears when it is complete.

    Raises
    ------
    FileExistsError
        If the file exists and is not to be overwritten.
    ValueError, ImportError
        As `to_stream`.
    OSError
        If the file cannot be written.
    """
    path, channels = Path(path), list(channels)
    if path.exists() and not overwrite:
        raise FileExistsError(f"{path} exists already; give another name, or overwrite=True")
    stream = to_stream(channels)
    encodings = {one.identifier: one.encoding for one in channels}
    unfinished = path.with_name(f"{path.stem}.partial{path.suffix}")
    try:
        with unfinished.open("wb") as file:
            for trace in stream:
                trace.write(file, format="MSEED", encoding=encodings[trace.id])
        unfinished.replace(path)
    finally:
        unfinished.unlink(missing_ok=True)


def read_miniseed(
    path: str | os.PathLike[str],
    inventory: Inventory | None = None,
    *,
    metres_per_count: float | None = None,
) -> list[Series]:
    """The channels of a miniSEED file as series in nm.

    Parameters
    ----------
    path : path-like
    inventory : obspy Inventory, optional
        From StationXML: says how many counts make a metre.
    metres_per_count : float, optional
        Says it instead; 1 for floats that `write_miniseed` wrote.

    Returns
    -------
    list of Series
        Named ``network.station.location.channel``. Values are those stored, before any
        suspension is taken off them; what is missing between traces is NaN.

    Raises
    ------
    ValueError
        If the file is no miniSEED, traces overlap or lie beside each other's samples, or the
        length of a count is not known.
    OSError
        If the file cannot be read.
    ImportError
        If obspy is not installed.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: there is no such file")
    if (inventory is None) == (metres_per_count is None):
        raise ValueError(
            f"{path}: miniSEED does not say what its numbers mean; give its StationXML or the "
            "metres of a count, and not both"
        )
    try:
        stream = obspy().read(path, format="MSEED")
    except (ImportError, OSError):
        raise
    except Exception as error:  # obspy raises its own and others' for files of any kind
        raise ValueError(f"{path}: this is not miniSEED ({error})") from None
    names = list(dict.fromkeys(trace.id for trace in stream))
    found = []
    for name in names:
        traces = sorted((t for t in stream if t.id == name), key=lambda t: t.stats.starttime)
        size_m, rate_hz = metres_per_count, float(traces[0].stats.sampling_rate)
        if size_m is None:
            from rasnik.io.station_xml import counts_per_metre, sample_rate_hz

            when = traces[0].stats.starttime
            size_m = 1 / counts_per_metre(inventory, name, when)
            rate_hz = sample_rate_hz(inventory, name, when) or rate_hz
        found.append(_joined(name, traces, size_m * _NM_PER_M, rate_hz))
    return found


def _check_names(channels: Sequence[SeismicChannel]) -> None:
    names = [one.identifier for one in channels]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise ValueError(
            f"two channels are called {twice[0]}; give them different directions, or locations"
        )


def _traces(channel: SeismicChannel) -> list[Trace]:
    package, series = obspy(), channel.series
    samples = channel.samples()
    edges = np.flatnonzero(np.diff(np.isfinite(samples), prepend=False, append=False))
    if not len(edges):
        raise ValueError(f"{series.name} has no frame with a position")
    keys = ("network", "station", "location", "channel")
    names = dict(zip(keys, channel.identifier.split("."), strict=True))
    traces = []
    for first, last in edges.reshape(-1, 2):
        # Whole nanoseconds, since a float of seconds since 1970 is good to a quarter of a us.
        whole_s, rest_s = divmod(series.start_s, 1)
        begin_ns = int(whole_s) * 10**9 + round((rest_s + first / series.rate_hz) * 1e9)
        start = package.UTCDateTime(ns=begin_ns)
        header = {**names, "sampling_rate": series.rate_hz, "starttime": start}
        data = np.ascontiguousarray(samples[first:last], dtype=ENCODINGS[channel.encoding])
        traces.append(package.Trace(data, header))
    return traces


def _joined(name: str, traces: list[Trace], size_nm: float, rate_hz: float) -> Series:
    first = traces[0].stats
    for trace in traces:
        if abs(trace.stats.sampling_rate / rate_hz - 1) > _RATE_ROUNDING:
            raise ValueError(
                f"{name} has {trace.stats.sampling_rate:.9g} samples/s where {rate_hz:.9g} are "
                "expected; its rate changes, or the StationXML belongs to another recording"
            )
    passed_s = [trace.stats.starttime - first.starttime for trace in traces]
    places, stored_hz = [0], rate_hz
    for later_s in passed_s[1:]:
        places.append(round(later_s * rate_hz))
        # After millions of samples the beginning of a trace tells the rate better.
        if later_s > 0 and abs(later_s * rate_hz - places[-1]) > TOLERANCE / 5:
            better_hz = places[-1] / later_s
            rate_hz = better_hz if abs(better_hz / stored_hz - 1) < _RATE_ROUNDING else rate_hz
    off = max(abs(s * rate_hz - place) for s, place in zip(passed_s, places, strict=True))
    ends = [place + trace.stats.npts for place, trace in zip(places, traces, strict=True)]
    if any(begin < end for begin, end in zip(places[1:], ends[:-1], strict=True)):
        raise ValueError(f"{name} has traces that overlap")
    if off > TOLERANCE:
        raise ValueError(
            f"{name} has a trace that begins {off:.2g} of an interval beside the samples of the "
            "one before; the clock was set, or frames are irregular"
        )
    values = np.full(ends[-1], np.nan)
    for place, end, trace in zip(places, ends, traces, strict=True):
        values[place:end] = trace.data * size_nm
    start_s = first.starttime.ns / 1e9
    return Series(values, rate_hz, name, "nm", float(start_s))
