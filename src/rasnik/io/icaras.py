"""The ASCII lines of ICARAS, Nikhef's "Image Capture and Analysis for RAsnik Systems".

Every image gives a line ``st`` (stamp), a line ``ud`` (user data) and a line ``ue`` (its error
margins)::

    st,seq_no,grab_date,grab_time,rasnik_id,channel_id,icaras_version,analysis_version
    ud ierr X Y M AlphaX AlphaY AlphaZ L Sx Sy
    ue dum DX DY DM DAlphaX DAlphaY DAlphaZ DL dum dum

The lines, the order of their fields, and the form of date and time (yyyy/mm/dd, hh:mm:ss) are
those of the page "Rasnik Image Analysis" of Nikhef's ATLAS wiki
(https://wiki.nikhef.nl/atlas/index.php?title=Rasnik_Image_Analysis&oldid=143). Its further lines
(rx, ry, rg, lr, qf) are for debugging; they are not written, and passed over in reading.

**Ours, because no public description was found:** the units, which are those of this package
(um and radians), the values of ``ierr``, and what ``L``, ``Sx`` and ``Sy`` are. `ICARAS_FIELDS`
is the one place to change. Since nothing in a file tells its units, a file of ICARAS itself is
not read.

* ``ierr`` is 0 where there is a position, else the sum of the fatal flags (their values are in
  ``docs/result-files.md``).
* What is not known or not measured is ``nan``; fields without use are 0, as the page says.
* ``grab_time`` has microseconds; date and time are empty where they are not known.
* ``rasnik_id`` is the file of the image with its frame in brackets, or, of a track, its source;
  ``seq_no`` counts the images, or is the frame of the track. A comma is written ``%2C``, a
  percent sign ``%25``.
* ``icaras_version`` is ``rasnik``, ``analysis_version`` the version of this package.
* Orientation, flags that are not fatal, blur, contrast and chi-square have no field.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, TextIO
from urllib.parse import unquote

from rasnik import __version__
from rasnik.analysis.flags import FLAGS, Flag
from rasnik.analysis.pose import Pose
from rasnik.io.columns import check_record, flag_value, make_record, plain
from rasnik.io.line_file import LineFile
from rasnik.io.results import Record, ResultWriter
from rasnik.io.utc import EARLIEST_S, utc_time
from rasnik.tracking.track import Track

__all__ = [
    "ICARAS_FIELDS",
    "IcarasReading",
    "IcarasWriter",
    "icaras_records",
    "read_icaras",
    "write_icaras",
]


@dataclass(frozen=True)
class _Field:
    """A field of ``ud`` and, with a D before its name, of ``ue``."""

    name: str
    column: str | None = None
    sigma: str | None = None
    per_unit: float = 1.0
    """What is written for one unit of the column."""
    has_margin: bool = True


#: Fields after the first of a line: what they hold, by the names of our columns.
ICARAS_FIELDS: tuple[_Field, ...] = (
    _Field("X", "x_um", "sigma_x_um"),
    _Field("Y", "y_um", "sigma_y_um"),
    _Field("M", "scale", "sigma_scale"),
    _Field("AlphaX"),
    _Field("AlphaY"),
    _Field("AlphaZ", "theta_rad", "sigma_theta_rad"),
    _Field("L"),
    _Field("Sx", has_margin=False),
    _Field("Sy", has_margin=False),
)
_PROGRAM = "rasnik"
_FATAL = Flag(sum(info.flag for info in FLAGS if info.fatal))
_ROWS_AT_A_TIME = 1000
_SKIPPED = ("rx", "ry", "rg", "lr", "qf")


@dataclass(frozen=True)
class IcarasReading:
    """What the lines of one image say.

    Attributes
    ----------
    sequence : int
        Number of the image in its sequence.
    time : datetime or None
        When it was taken, UTC.
    rasnik_id, channel_id : str
    ierr : int
        0 if there is a position.
    values : dict of float
        By the names of columns: ``x_um``, ``y_um``, ``scale``, ``theta_rad`` and their sigmas.
        NaN: not known.
    """

    sequence: int
    time: datetime | None
    rasnik_id: str
    channel_id: str
    ierr: int
    values: Mapping[str, float] = field(default_factory=dict)

    def lines(self) -> str:
        """The three lines."""
        date, clock = "", ""
        if self.time is not None:
            date, clock = f"{self.time.astimezone(UTC):%Y/%m/%d %H:%M:%S.%f}".split()
        names = (_quoted(self.rasnik_id), _quoted(self.channel_id))
        stamp = ("st", str(self.sequence), date, clock, *names, _PROGRAM, __version__)
        data = [_number(self.values, f.column, f.per_unit) for f in ICARAS_FIELDS]
        margins = [
            _number(self.values, f.sigma, f.per_unit) if f.has_margin else "0"
            for f in ICARAS_FIELDS
        ]
        return f"{','.join(stamp)}\nud {self.ierr} {' '.join(data)}\nue 0 {' '.join(margins)}\n"


def _quoted(text: str) -> str:
    for letter in "%,\r\n":
        text = text.replace(letter, f"%{ord(letter):02X}")
    return text


def _number(values: Mapping[str, Any], column: str | None, per_unit: float) -> str:
    """The shortest text that reads back equal."""
    value = values.get(column) if column is not None else None
    return "nan" if value is None else repr(float(value) * per_unit)


def _error_number(ok: bool, flags: Flag) -> int:
    """``ierr``: the fatal flags; where none says why, there was no image."""
    return 0 if ok else int(flags & _FATAL) or int(Flag.NO_IMAGE)


# ------------------------------------------------------------------------ writing


class IcarasWriter(LineFile, ResultWriter):
    """Writes records as lines of ICARAS, each image handed to the system at once.

    Parameters
    ----------
    target : path-like or open text file
    channel_id : str
        Stands in every stamp.
    """

    def __init__(self, target: str | os.PathLike[str] | TextIO, *, channel_id: str = "") -> None:
        super().__init__(target)
        self._channel_id, self._sequence = channel_id, 0

    def write(
        self, record: Record, *, time: datetime | None = None, rasnik_id: str | None = None
    ) -> None:
        """Write one image.

        Parameters
        ----------
        record : mapping
            See `rasnik.io.columns.COLUMNS`.
        time : datetime, optional
            When the image was taken, with its time zone.
        rasnik_id : str, optional
            Instead of the record's file and frame.
        """
        check_record(record)
        ok = record.get("ok") in (True, "true")
        image = f"{record.get('file') or ''}[{record.get('frame') or 0}]"
        reading = IcarasReading(
            sequence=self._sequence,
            time=time,
            rasnik_id=image if rasnik_id is None else rasnik_id,
            channel_id=self._channel_id,
            ierr=_error_number(ok, flag_value(record.get("flags"))),
            values={c: v for c, v in record.items() if v is not None} if ok else {},
        )
        self.put(reading.lines())
        self._sequence += 1


def write_icaras(
    track: Track,
    path: str | os.PathLike[str],
    *,
    rasnik_id: str = "",
    channel_id: str = "",
    start_s: float | None = None,
) -> None:
    """Write a track as lines of ICARAS.

    Parameters
    ----------
    track : Track
        The numbers of its frames become the sequence numbers. Times are written if they are in
        seconds since 1970 UTC, or `start_s` is given.
    path : path-like
        An existing file is replaced.
    rasnik_id, channel_id : str
        Stand in every stamp.
    start_s : float, optional
        When the first frame was taken, in seconds since 1970 UTC; for a track whose times have
        another zero.

    Raises
    ------
    ValueError
        If `start_s` is given, and the times are counted from 1970 already.
    OSError
        If the file cannot be written.
    """
    time_s = track.time_s
    if start_s is not None and len(track):
        if time_s[0] >= EARLIEST_S:
            raise ValueError(
                "the times of the track are counted from 1970 already; another time of its first "
                "frame would contradict them"
            )
        time_s = start_s + (time_s - time_s[0])
    columns = [name for f in ICARAS_FIELDS for name in (f.column, f.sigma) if name]
    with LineFile(path) as file:
        for first in range(0, len(track), _ROWS_AT_A_TIME):
            piece = slice(first, first + _ROWS_AT_A_TIME)
            part, ok, times = track[piece], track.ok[piece], time_s[piece].tolist()
            rows = zip(*(getattr(part, name).tolist() for name in columns), strict=True)
            readings = (
                IcarasReading(
                    sequence=int(part.frame[k]),
                    time=utc_time(times[k]),
                    rasnik_id=rasnik_id,
                    channel_id=channel_id,
                    ierr=_error_number(bool(ok[k]), Flag(int(part.flags[k]))),
                    values=dict(zip(columns, row, strict=True)) if ok[k] else {},
                )
                for k, row in enumerate(rows)
            )
            file.put("".join(reading.lines() for reading in readings))


# ------------------------------------------------------------------------ reading


def read_icaras(path: str | os.PathLike[str]) -> Iterator[IcarasReading | str]:
    """Readings of a file by `IcarasWriter` or `write_icaras`, also one that is being written.

    Parameters
    ----------
    path : path-like

    Yields
    ------
    IcarasReading or str
        In place of a reading that is damaged a sentence that says so. A last one that is not
        complete yet is left out.

    Raises
    ------
    ValueError
        If the file does not begin with a stamp of this package.
    OSError
        If the file cannot be read.
    """
    path = Path(path)
    lines: list[str] = []
    first_number = 1
    with path.open(encoding="utf-8", errors="replace") as file:
        for number, line in enumerate(file, 1):
            if number == 1:
                _check_stamp(path, line)
            if line.startswith("st,"):
                if lines:
                    yield _reading_or_fault(path, first_number, lines)
                lines, first_number = [], number
            if line.endswith("\n") and line[:2] not in _SKIPPED and line.strip():
                lines.append(line.rstrip("\r\n"))
    if len(lines) >= 3:
        yield _reading_or_fault(path, first_number, lines)


def _check_stamp(path: Path, line: str) -> None:
    words = line.strip().split(",")
    if words[0] != "st":
        raise ValueError(f"{path}: this is no file of ICARAS lines; it does not begin with 'st,'")
    if len(words) != 8 or words[6] != _PROGRAM:
        raise ValueError(
            f"{path}: these lines were not written by this package, and nothing tells their "
            "units; convert them with a program that knows them"
        )


def _reading_or_fault(path: Path, number: int, lines: list[str]) -> IcarasReading | str:
    try:
        return _reading(lines)
    except ValueError:
        return (
            f"{path}: the reading at line {number} is damaged; it needs a line of each of "
            "st, ud and ue with all their fields."
        )


def _reading(lines: list[str]) -> IcarasReading:
    stamp, data, margins = lines
    words = stamp.split(",")
    kind, ierr, *numbers = data.split()
    margin_kind, _, *margin_numbers = margins.split()
    if (kind, margin_kind, len(words)) != ("ud", "ue", 8):
        raise ValueError("a line is of another kind")
    values: dict[str, float] = {}
    for f, number, margin in zip(ICARAS_FIELDS, numbers, margin_numbers, strict=True):
        if f.column is not None:
            values[f.column] = float(number) / f.per_unit
        if f.sigma is not None:
            values[f.sigma] = float(margin) / f.per_unit
    time = None
    if words[2]:
        time = datetime.strptime(f"{words[2]} {words[3]}", "%Y/%m/%d %H:%M:%S.%f")
        time = time.replace(tzinfo=UTC)
    return IcarasReading(
        sequence=int(words[1]),
        time=time,
        rasnik_id=unquote(words[4]),
        channel_id=unquote(words[5]),
        ierr=int(ierr),
        values=values,
    )


def icaras_records(path: str | os.PathLike[str]) -> Iterator[dict[str, Any]]:
    """Readings of a file as records; see `rasnik.io.columns.COLUMNS`.

    Raises
    ------
    ValueError, OSError
        As `read_icaras`.
    """
    for reading in read_icaras(path):
        if isinstance(reading, str):
            yield make_record(str(path), error=reading)
            continue
        named = re.fullmatch(r"(.*)\[(\d+)\]", reading.rasnik_id)
        file = named[1] if named else reading.rasnik_id or str(path)
        frame = int(named[2]) if named else reading.sequence
        flags = Flag(reading.ierr) & _FATAL
        record = make_record(file, frame, Pose(ok=reading.ierr == 0, flags=flags))
        if reading.ierr == 0:
            record |= {name: plain(value) for name, value in reading.values.items()}
        yield record
