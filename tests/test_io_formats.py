"""The page of formats names every ending that is read or written; gwpy reads what it was given."""

from __future__ import annotations

import re
import warnings
from pathlib import Path

import numpy as np
import pytest

from rasnik.io import to_gwpy
from rasnik.io.formats import IMAGE_SUFFIXES, STACK_SUFFIXES, VIDEO_SUFFIXES
from rasnik.io.results import LINE_SUFFIXES, RESULT_SUFFIXES
from rasnik.io.seismic_files import MINISEED_SUFFIXES
from rasnik.io.track_export import TRACK_SUFFIXES
from rasnik.mask_files import SUFFIXES
from rasnik.tracking.track import TRACK_COLUMNS, Track

PAGE = Path(__file__).resolve().parents[1] / "docs" / "formats.md"


def part(heading: str) -> str:
    if not PAGE.exists():
        pytest.skip("the pages are not beside the tests")
    return PAGE.read_text(encoding="utf-8").split(f"\n## {heading}\n")[1].split("\n## ")[0]


@pytest.mark.parametrize(
    ("heading", "suffixes"),
    [
        ("Images", (*IMAGE_SUFFIXES, *STACK_SUFFIXES, *VIDEO_SUFFIXES)),
        (
            "Results and tracks",
            (*RESULT_SUFFIXES, *LINE_SUFFIXES, *TRACK_SUFFIXES, *MINISEED_SUFFIXES),
        ),
        ("Everything else", SUFFIXES),
    ],
)
def test_the_page_names_every_ending(heading, suffixes):
    rows = [line.split("|")[1] for line in part(heading).splitlines() if line.startswith("| ")]
    assert set(suffixes) <= set(re.findall(r"`(\.[a-z0-9]+)", " ".join(rows)))


def test_gwpy_reads_back_a_series_it_wrote(tmp_path, rng):
    with warnings.catch_warnings():  # of itself, when it is loaded
        warnings.simplefilter("ignore")
        gwpy = pytest.importorskip("gwpy.timeseries", reason="the extra gw is not installed")
        n = 100
        columns = {c.name: np.zeros(n) for c in TRACK_COLUMNS}
        columns |= {"frame": np.arange(n), "time_s": np.arange(n) / 275.0 + 10.0}
        track = Track(**columns | {"x_um": rng.normal(size=n), "flags": np.zeros(n, dtype="u4")})
        series = to_gwpy(track, "x_um")
        series.write(str(tmp_path / "x.h5"), path="x_um", format="hdf5")
        back = gwpy.TimeSeries.read(str(tmp_path / "x.h5"), path="x_um", format="hdf5")
    np.testing.assert_array_equal(back.value, track.x_um)
    assert back.unit == "um"
    assert back.sample_rate.value == 275.0
    assert back.t0.value == 10.0
