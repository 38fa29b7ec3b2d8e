"""``rasnik export`` of results of images, and of tracks as lines of ICARAS."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from numpy.typing import NDArray

if TYPE_CHECKING:
    from rasnik.tracking.track import Track

__all__ = ["export_icaras", "export_results", "track_or_results"]

Results = dict[str, NDArray[Any]]


def track_or_results(path: Path) -> Track | Results:
    """What a file holds; raises what reading it raises."""
    from rasnik.io import read_track
    from rasnik.io.results import LINE_SUFFIXES, RESULT_SUFFIXES, read_results
    from rasnik.io.track_export import TRACK_SUFFIXES

    suffix = path.suffix.lower()
    if suffix in (*LINE_SUFFIXES, *RESULT_SUFFIXES) and suffix not in TRACK_SUFFIXES:
        return read_results(path)
    try:
        return read_track(path)
    except ValueError:
        if suffix not in RESULT_SUFFIXES:
            raise
        try:
            return read_results(path)
        except ValueError:
            pass
        raise


def export_results(results: Results, output: Path) -> str:
    """Write results in the format that the name tells; says what was done."""
    from rasnik.io.results import as_records, open_results

    count = 0
    with open_results(output) as writer:
        for record in as_records(results):
            writer.write(record)
            count += 1
    return f"{count} results written to {output}"


def export_icaras(track: Track, source: Path, output: Path) -> str:
    """Write a track as lines of ICARAS; says what was done."""
    from rasnik.io.icaras import write_icaras
    from rasnik.io.utc import EARLIEST_S

    write_icaras(track, output, rasnik_id=track.metadata.get("source") or source.stem)
    said = f"{len(track)} frames written to {output}"
    if len(track) and not track.time_s[0] >= EARLIEST_S:
        said += "; without times, for those of the track are not counted from 1970"
    return said
