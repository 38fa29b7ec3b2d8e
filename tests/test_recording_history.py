"""Looking back: the bins are those of the rows, from whichever file and however they are read."""

import time

import numpy as np
import pytest

from rasnik import Flag, load_system
from rasnik.io.track_file import TrackWriter
from rasnik.io.track_table import from_rows
from rasnik.recording import summary
from rasnik.recording.history import History
from rasnik.recording.options import Recording
from rasnik.recording.record_file import RecordFiles
from rasnik.recording.rows import RECORD_COLUMNS, RECORD_ROW
from rasnik.recording.summary import Summary, bins_of, merged, summary_of, summary_path

SYSTEM = load_system("solidras")
BEGIN_S = 1_772_366_400.0
RATE_HZ = 50.0
NAMES = ("x_um", "y_um", "scale", "theta_rad")


def rows_of(rng: np.random.Generator, first: int, stop: int) -> np.ndarray:
    """Random values; some rows without a position, some with one that does not count."""
    rows = np.zeros(stop - first, dtype=RECORD_ROW)
    rows["frame"] = np.arange(first, stop)
    rows["host_time_s"] = rows["time_s"] = BEGIN_S + (rows["frame"] + 0.5) / RATE_HZ
    for name in NAMES:
        rows[name] = rng.normal(size=len(rows))
    rows["x_um"][rng.random(len(rows)) < 0.05] = np.nan
    rows["flags"][rng.random(len(rows)) < 0.05] = Flag.NO_MASK
    return rows


def plainly(rows: np.ndarray, start_s: float, end_s: float, points: int) -> dict:
    """The same bins, one after the other."""
    rows = rows[np.isfinite(rows["x_um"]) & (rows["flags"] != Flag.NO_MASK)]
    place = np.floor((rows["host_time_s"] - start_s) / ((end_s - start_s) / points))
    kinds = {"min": np.min, "mean": np.mean, "max": np.max}
    result = {"count": np.array([np.count_nonzero(place == k) for k in range(points)])}
    for name in NAMES:
        for kind, function in kinds.items():
            result[f"{name}_{kind}"] = np.array(
                [
                    function(rows[name][place == k]) if (place == k).any() else np.nan
                    for k in range(points)
                ]
            )
    return result


def assert_same(found: dict, expected: dict) -> None:
    for name, values in expected.items():
        np.testing.assert_allclose(found[name], values, rtol=1e-9, atol=1e-12, err_msg=name)


@pytest.fixture
def recorded(tmp_path, rng):
    """(history, all rows) of three files, of which the last is being written."""
    files = RecordFiles(tmp_path, "a", SYSTEM, Recording(keep_free_mib=0), {})
    parts = []
    for first, stop in ((0, 3000), (3100, 6000), (6000, 9000)):
        files.close()
        for begin in range(first, stop, 700):
            rows = rows_of(rng, begin, min(begin + 700, stop))
            files.write(rows)
            parts.append(rows)
    yield History(tmp_path, files.current), np.concatenate(parts)
    files.close()


@pytest.mark.parametrize(
    ("start", "end", "points"),
    [
        (0, 180, 60),  # 3 s: summaries
        (-20, 220, 24),
        (0, 180, 180),  # 1 s
        (0, 180, 1800),  # 0.1 s: rows
        (59, 63, 40),  # over the gap between two files
        (119.3, 121.1, 17),
    ],
)
def test_bins_are_those_of_the_rows(recorded, start, end, points):
    history, rows = recorded
    found = history.read(BEGIN_S + start, BEGIN_S + end, points)
    assert_same(found, plainly(rows, BEGIN_S + start, BEGIN_S + end, points))
    width_s = (end - start) / points
    np.testing.assert_allclose(
        found["time_s"], BEGIN_S + start + width_s * (np.arange(points) + 0.5), rtol=0, atol=1e-6
    )
    assert_same(history.read(BEGIN_S + start, BEGIN_S + end, points), found)  # from what it knows


def test_bins_that_half_seconds_do_not_fit_hold_every_row_once(recorded):
    history, rows = recorded
    found = history.read(BEGIN_S - 10, BEGIN_S + 190.3, 77)
    valid = np.isfinite(rows["x_um"]) & (rows["flags"] != Flag.NO_MASK)
    assert found["count"].sum() == np.count_nonzero(valid)
    assert np.nanmin(found["y_um_min"]) == rows["y_um"][valid].min()
    assert np.nanmax(found["y_um_max"]) == rows["y_um"][valid].max()


def test_times_without_a_record_are_empty(recorded, tmp_path):
    history, _ = recorded
    for start_s in (0.0, BEGIN_S + 1e6):
        found = history.read(start_s, start_s + 100, 10)
        assert (found["count"] == 0).all()
        assert np.isnan(found["x_um_mean"]).all()
    assert (History(tmp_path / "none", lambda: None).read(0, 1, 5)["count"] == 0).all()


def test_what_cannot_be_asked_for(recorded):
    history, _ = recorded
    for start_s, end_s in ((2, 1), (1, 1), (np.nan, 1), (0, np.inf)):
        with pytest.raises(ValueError, match="must be after its start"):
            history.read(start_s, end_s, 10)
    for points in (0, -1, 10**6):
        with pytest.raises(ValueError, match="points must be from 1 to"):
            history.read(0, 1, points)


def test_a_summary_is_made_again_from_the_rows(tmp_path, rng, monkeypatch):
    """As after a kill; also if it is damaged, or older than the file."""
    monkeypatch.setattr(summary, "_PIECE_ROWS", 500)
    files = RecordFiles(tmp_path, "a", SYSTEM, Recording(keep_free_mib=0), {})
    rows = rows_of(rng, 0, 2300)
    files.write(rows)
    path = files.path
    files.close()
    kept = summary_of(path)
    expected = merged(bins_of(rows, 0)["step"], bins_of(rows, 0))
    assert len(expected) == 2300 / RATE_HZ * 2

    def check(bins: np.ndarray) -> None:
        for name in bins.dtype.names:
            np.testing.assert_allclose(bins[name], expected[name], rtol=1e-12, atol=1e-12)

    check(kept)
    summary_path(path).unlink()
    check(summary_of(path))
    assert summary_path(path).is_file()
    summary_path(path).write_bytes(b"damaged")
    check(summary_of(path))
    np.save(summary_path(path), kept[:3])
    time.sleep(0.02)
    path.touch()
    check(summary_of(path))


def test_a_clock_that_is_set_back_confuses_nothing(tmp_path, rng):
    rows = rows_of(rng, 0, 1000)
    rows["host_time_s"][500:] -= 8.0
    rows["host_time_s"][700] = np.nan
    files = RecordFiles(tmp_path, "a", SYSTEM, Recording(keep_free_mib=0), {})
    files.write(rows)
    timed = rows[np.isfinite(rows["host_time_s"])]
    for points in (4, 200):
        found = History(tmp_path, files.current).read(BEGIN_S, BEGIN_S + 20, points)
        assert_same(found, plainly(timed, BEGIN_S, BEGIN_S + 20, points))
    files.close()


def test_a_damaged_file_is_left_out(recorded, tmp_path):
    history, rows = recorded
    (tmp_path / "a_20200101T000000Z.h5").write_bytes(b"nothing")
    found = history.read(BEGIN_S, BEGIN_S + 180, 60)
    assert_same(found, plainly(rows, BEGIN_S, BEGIN_S + 180, 60))


def test_days_are_quick(tmp_path, rng):
    """Ten days in hourly files: 172,800 bins in each day, and no row is read."""
    path = tmp_path / "a_20260301T120000Z.h5"
    for hour in range(240):
        path = tmp_path / f"a_202603{1 + hour // 24:02d}T{hour % 24:02d}0000Z.h5"
        path.touch()
        bins = np.zeros(7200, dtype=summary.BIN)
        bins["step"] = np.floor(BEGIN_S / summary.STEP_S) + hour * 7200 + np.arange(7200)
        bins["count"] = 1
        bins["x_um_sum"] = hour
        summary.save_summary(path, bins)
    history = History(tmp_path, lambda: None)
    begin_s = time.perf_counter()
    found = history.read(BEGIN_S, BEGIN_S + 240 * 3600, 240)
    assert time.perf_counter() - begin_s < 5.0  # 0.5 s where nothing else runs
    np.testing.assert_allclose(found["x_um_mean"], np.arange(240))


def test_a_summary_that_grows_is_that_of_all_rows(rng):
    rows, growing, first = rows_of(rng, 0, 1000), Summary(), 0
    assert len(growing.bins()) == 0
    while first < len(rows):
        step = int(rng.integers(1, 60))
        growing.extend(rows[first : first + step], first)
        first += step
        if step > 50:
            growing.bins()
    expected = merged(bins_of(rows, 0)["step"], bins_of(rows, 0))
    bins = growing.bins()
    for name in bins.dtype.names:
        np.testing.assert_allclose(bins[name], expected[name], rtol=1e-12, atol=1e-12)


def test_rows_of_a_track_without_further_columns_are_no_record(tmp_path, rng):
    """They have no clock of the host; such a file in the folder is left out."""
    path = tmp_path / "a_20260301T120000Z.h5"
    with TrackWriter(path) as file:
        file.write(from_rows(rows_of(rng, 0, 10)))
    found = History(tmp_path, lambda: None).read(BEGIN_S, BEGIN_S + 1, 2)
    assert (found["count"] == 0).all()
    assert "host_time_s" in {column.name for column in RECORD_COLUMNS}
