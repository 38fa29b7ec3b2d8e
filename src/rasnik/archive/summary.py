"""What an archive of results says about its instruments.

Counts are of all rows. Resolution, drift and medians are those of at most 200,000 rows of an
instrument, in runs of successive images spread evenly over all of them, so that the memory does
not grow with the archive.
"""

from __future__ import annotations

import math
import os
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rasnik.analysis.flags import FLAGS, Flag, info_of
from rasnik.archive.drift import Drift, drift
from rasnik.archive.rows import NUMBERS, Faults, Part, Rows, instruments_of, read_rows
from rasnik.archive.worst import Suspects, Worst, choose
from rasnik.characterisation.resolution import Scatter, difference_scatter

__all__ = ["UNREAD", "InstrumentSummary", "Summary", "summarise"]

#: The reason of failures that no flag explains: the image could not be read or analysed.
UNREAD = "not read"

_MOST_ROWS = 200_000
_RUN = 1_000
_PAUSE = 5.0  # usual intervals; after a longer one images do not follow each other
_GAP = 10  # by more than this a pause adds to the number of an image
_FATAL = [info.name for info in FLAGS if info.fatal]
_SCALE = info_of(Flag.SCALE_UNEXPECTED)
_COORDINATES = {"x": ("x_um", 1e3), "y": ("y_um", 1e3)}  # and the factor to nm
_LEVELS = ("chi2_ndf", "blur_um", "light_level")
_PERCENTILES = (5.0, 50.0, 95.0)


@dataclass(frozen=True)
class InstrumentSummary:
    """One instrument.

    Attributes
    ----------
    instrument : str
    images, good : int
    failed : dict of str to int
        Images without a position by reason: the first flag that explains it, or `UNREAD`.
    flags : dict of str to int
        Images that carry a flag, those with a position among them.
    first_s, last_s : float
        Times of the first and the last image, since 1970 UTC; NaN if not known.
    interval_s : float
        Median time between successive images; NaN if not known.
    scatter : dict of str to Scatter
        Of x and y from image to image, in nm; without those that cannot be measured.
    drift : dict of str to Drift
        Of x and y, um per day.
    levels : dict of str to tuple of float
        Percentiles 5, 50 and 95 of ``chi2_ndf``, ``blur_um`` and ``light_level``.
    used : int
        Rows that scatter, drift and levels are from.
    remarks : list of str
    """

    instrument: str
    images: int
    good: int
    failed: dict[str, int]
    flags: dict[str, int]
    first_s: float
    last_s: float
    interval_s: float
    scatter: dict[str, Scatter]
    drift: dict[str, Drift]
    levels: dict[str, tuple[float, float, float]]
    used: int
    remarks: list[str]

    def as_dict(self) -> dict[str, Any]:
        """For JSON; None where not measured."""
        return {
            "instrument": self.instrument,
            "images": self.images,
            "good": self.good,
            "failed": self.failed,
            "flags": self.flags,
            "first_s": _known(self.first_s),
            "last_s": _known(self.last_s),
            "interval_s": _known(self.interval_s),
            "resolution_nm": {name: _scatter(self.scatter.get(name)) for name in _COORDINATES},
            "drift_um_per_day": {name: one.as_dict() for name, one in self.drift.items()},
            **{name: [_known(v) for v in values] for name, values in self.levels.items()},
            "rows_used": self.used,
            "remarks": self.remarks,
        }


@dataclass(frozen=True)
class Summary:
    """All instruments of a dataset.

    Attributes
    ----------
    source : str
    instruments : list of InstrumentSummary
        Those with a row.
    days : dict of str to list of int
        Images and failures by day.
    worst : list of Worst
        Images to look at, at most ten.
    faults : list of str
        What is wrong with the dataset itself.
    """

    source: str
    instruments: list[InstrumentSummary]
    days: dict[str, list[int]]
    worst: list[Worst]
    faults: list[str]

    @property
    def images(self) -> int:
        """Rows in all."""
        return sum(one.images for one in self.instruments)

    @property
    def good(self) -> int:
        """Rows with a position."""
        return sum(one.good for one in self.instruments)

    @property
    def failed(self) -> dict[str, int]:
        """Images without a position by reason, the most frequent first."""
        total: Counter[str] = Counter()
        for one in self.instruments:
            total.update(one.failed)
        return dict(total.most_common())

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {
            "dataset": self.source,
            "images": self.images,
            "good": self.good,
            "failed": self.failed,
            "instruments": [one.as_dict() for one in self.instruments],
            "days": self.days,
            "worst": [one.as_dict() for one in self.worst],
            "faults": self.faults,
        }


def summarise(path: str | os.PathLike[str], advance: Any = None) -> Summary:
    """Summarise a dataset of `rasnik archive analyse`.

    Parameters
    ----------
    path : path-like
        Folder of the dataset. It may be being written: parts that are complete count.
    advance : callable, optional
        ``advance(instrument, rows)`` is called after each instrument.

    Returns
    -------
    Summary

    Raises
    ------
    ValueError
        If the folder holds no dataset.
    ImportError
        If pyarrow is not installed.
    """
    path = Path(path)
    faults = Faults()
    days: dict[str, list[int]] = {}
    suspects, found = [], []
    for instrument, parts in instruments_of(path, faults):
        gathered = _Gathered(instrument, _stride(parts))
        for part in parts:
            for rows in read_rows(part, faults):
                gathered.add(rows)
                day = days.setdefault(part.day, [0, 0])
                day[0] += len(rows)
                day[1] += len(rows) - int(rows.ok.sum())
        if gathered.images:
            summary = gathered.summary()
            found.append(summary)
            suspects.append(gathered.suspects)
        if advance is not None:
            advance(instrument, gathered.images)
    return Summary(str(path), found, dict(sorted(days.items())), choose(suspects), faults.sentences)


def _stride(parts: Iterable[Part]) -> int:
    """Of how many runs of rows one is kept."""
    from pyarrow import parquet

    count = 0
    for part in parts:
        try:
            count += parquet.read_metadata(part.path).num_rows
        except Exception:  # named when it is read
            continue
    return max(1, math.ceil(count / _MOST_ROWS))


# ------------------------------------------------------------------------ one instrument


@dataclass
class _Gathered:
    """What is known of an instrument while its rows go by."""

    instrument: str
    stride: int
    images: int = 0
    failed: Counter[str] = field(default_factory=Counter)
    flags: Counter[str] = field(default_factory=Counter)
    first_s: float = math.inf
    last_s: float = -math.inf
    kept: list[dict[str, NDArray[Any]]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.suspects = Suspects(self.instrument)

    def add(self, rows: Rows) -> None:
        """Take some rows."""
        time_s = rows.numbers["time_s"]
        if np.isfinite(time_s).any():
            self.first_s = min(self.first_s, float(np.nanmin(time_s)))
            self.last_s = max(self.last_s, float(np.nanmax(time_s)))
        reasons = dict(_reasons(rows))
        self.failed.update(reasons.values())
        if rows.flags is not None:
            counts = rows.flags.flatten().value_counts()
            for name, count in zip(counts.field(0).to_pylist(), counts.field(1).to_pylist(),
                                   strict=True):  # fmt: skip
                self.flags[str(name)] += count
        self.suspects.add(rows, reasons)
        index = self.images + np.arange(len(rows))
        kept = index // _RUN % self.stride == 0
        piece: dict[str, NDArray[Any]] = {k: v[kept] for k, v in rows.numbers.items()}
        # A run that begins does not follow what was kept before it.
        follows = rows.follows & ((index % _RUN > 0) | (self.stride == 1))
        self.kept.append(piece | {"ok": rows.ok[kept], "follows": follows[kept]})
        self.images += len(rows)

    def summary(self) -> InstrumentSummary:
        """The summary of the rows taken."""
        columns = {
            name: np.concatenate([piece[name] for piece in self.kept])
            for name in (*NUMBERS, "ok", "follows")
        }
        self.kept.clear()
        ok, time_s = columns["ok"], columns["time_s"]
        interval_s, number = _numbered(time_s, columns["follows"])
        remarks = []
        if other := self.flags[_SCALE.name]:  # every image may be good and every position wrong
            remarks.append(f"{other:,} images: {_SCALE.sentence.rstrip('.')}")
        scatter = _scatters(columns, number, remarks)
        drifts = {}
        for name, (column, _) in _COORDINATES.items():
            drifts[name] = drift(time_s[ok], columns[column][ok])
            if drifts[name].remark:
                remarks.append(f"drift of {name}: {drifts[name].remark}")
        levels = {name: _percentiles(columns[name][ok]) for name in _LEVELS}
        self.suspects.compare(
            {name: one.sigma for name, one in scatter.items()},
            {name: _percentiles(columns[name][ok])[1] for name in ("chi2_ndf", "sigma_x_um")},
        )
        return InstrumentSummary(
            instrument=self.instrument,
            images=self.images,
            good=self.images - self.failed.total(),
            failed=dict(self.failed.most_common()),
            flags=dict(self.flags.most_common()),
            first_s=self.first_s if math.isfinite(self.first_s) else math.nan,
            last_s=self.last_s if math.isfinite(self.last_s) else math.nan,
            interval_s=interval_s,
            scatter=scatter,
            drift=drifts,
            levels=levels,
            used=len(ok),
            remarks=remarks,
        )


def _reasons(rows: Rows) -> Iterator[tuple[int, str]]:
    """Index and reason of every row without a position."""
    bad = np.flatnonzero(~rows.ok)
    named: list[Any] = [None] * len(bad)
    if rows.flags is not None and len(bad):
        named = rows.flags.take(_indices(bad)).to_pylist()
    for index, names in zip(bad, named, strict=True):
        reason = next((name for name in _FATAL if name in (names or ())), UNREAD)
        yield int(index), reason


def _indices(values: NDArray[np.int64]) -> Any:
    import pyarrow

    return pyarrow.array(values)


def _numbered(
    time_s: NDArray[np.float64], follows: NDArray[np.bool_]
) -> tuple[float, NDArray[np.int64]]:
    """Usual interval, and numbers of the images that leave out some where there is a pause."""
    step = np.diff(time_s, prepend=np.nan)
    steps = step[follows & np.isfinite(step) & (step > 0)]
    interval_s = float(np.median(steps)) if len(steps) else math.nan
    pause = ~follows
    if math.isfinite(interval_s):
        pause |= (step > _PAUSE * interval_s) | (step < 0)
    # Gaps of growing length: no two are alike, and none can pass for the usual step.
    gaps = np.where(pause, _GAP + np.cumsum(pause), 0)
    return interval_s, np.arange(len(time_s)) + np.cumsum(gaps)


def _scatters(
    columns: dict[str, NDArray[Any]], number: NDArray[np.int64], remarks: list[str]
) -> dict[str, Scatter]:
    """Scatter of single images, for the coordinates where it can be measured."""
    ok, found = columns["ok"], {}
    for name, (column, factor) in _COORDINATES.items():
        stated = columns[f"sigma_{column}"][ok] * factor
        stated = stated[np.isfinite(stated)]
        try:
            one = difference_scatter(
                np.where(ok, columns[column], np.nan) * factor,
                number,
                name=name,
                stated=float(np.sqrt(np.mean(stated**2))) if len(stated) else math.nan,
            )
        except ValueError as error:
            remarks.append(f"resolution of {name} not measured: {error}")
            continue
        found[name] = one
        if one.drift_left:
            remarks.append(
                f"{name} moves so fast from image to image that its resolution is an upper limit"
            )
    return found


def _percentiles(values: NDArray[np.float64]) -> tuple[float, float, float]:
    values = values[np.isfinite(values)]
    if not len(values):
        return math.nan, math.nan, math.nan
    low, middle, high = np.percentile(values, _PERCENTILES)
    return float(low), float(middle), float(high)


def _known(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _scatter(one: Scatter | None) -> dict[str, Any] | None:
    """What a summary says of the scatter."""
    if one is None:
        return None
    ratio = one.sigma / one.stated if one.stated > 0 else math.nan
    return {
        "sigma": _known(one.sigma),
        "error": _known(one.sigma_error),
        "stated": _known(one.stated),
        "ratio": _known(ratio),
        "ratio_error": _known(one.sigma_error / one.stated) if one.stated > 0 else None,
        "order": one.order,
        "moved": bool(one.moved),
        "upper_limit": bool(one.drift_left),
        "outliers": one.outliers,
    }
