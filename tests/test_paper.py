"""The paper's figures done again: the pieces, and the run that makes all of them."""

from __future__ import annotations

import json
import re
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure
from typer.testing import CliRunner

from rasnik import load_system
from rasnik.cli import app
from rasnik.imaging.projection import Projection
from rasnik.paper import run
from rasnik.paper.contour import crossings
from rasnik.paper.floors import _Series
from rasnik.paper.fourier_picture import peaks, spectrum
from rasnik.paper.images import by_fourier, by_likelihood, noisy, solidras, stream
from rasnik.paper.instruments import MICRORAS, Resonance, record
from rasnik.paper.outcome import Effort, Outcome, Row, Value, json_ready, new_figure
from rasnik.paper.page import write_all
from rasnik.paper.resolution import scatter_of
from rasnik.paper.run import PARTS, Part, Result, parts_named, redo, redo_all
from rasnik.paper.table import HEADINGS, cells, markdown, notes_of

ROWS = (
    Row("resolution", "nm", "3.0", Value(0.782, 0.049), Value(0.407, 0.026), Value(0.391), "a | b"),
    Row("offset", "nm", "+1", None, Value(0.061, 0.027), Value(0.0), "a | b"),
    Row("factor", "", "√2", why="another reason"),
)


# ------------------------------------------------------------------------ numbers


def test_values_have_as_many_digits_as_their_errors_allow():
    assert Value(0.40712, 0.026).text == "0.407 ± 0.026"
    assert Value(1.66132).text == "1.66"
    assert Value(float("nan")).text == "-"


def test_scatter_is_that_of_both_axes_and_its_error_is_right(rng):
    found = [scatter_of(rng.normal(5.0, (1.0, 3.0), (50, 2))) for _ in range(400)]
    values = np.array([one.value for one in found])
    assert np.sqrt((values**2).mean()) == pytest.approx(np.sqrt(5), rel=0.02)
    equal = [scatter_of(rng.normal(0, 2.0, (50, 2))) for _ in range(400)]
    spread = np.std([one.value for one in equal])
    assert spread == pytest.approx(np.mean([one.sigma for one in equal]), rel=0.12)


def test_crossings_of_the_standard_rasnik():
    # Section 2: 4 mm x 3 mm and 100 mm of contour in each direction, that is fields of 120 um.
    standard = load_system(
        "solidras",
        {"mask.field_um": 120, "sensor.pixel_um": 10, "sensor.width_px": 400,
         "sensor.height_px": 300},
    )  # fmt: skip
    assert crossings(standard) == pytest.approx(100e3 / 10)


def test_half_light_halves_the_levels_and_keeps_the_noise_law():
    full, half = solidras(), solidras(light=0.5)
    assert half.sensor.light_level == pytest.approx(full.sensor.light_level / 2)
    assert half.noise_law == full.noise_law
    assert solidras(binning=2).shape == (270, 360)


# ------------------------------------------------------------------------ the picture of a spectrum


def test_spectrum_gives_the_phase_of_a_wave_about_the_image_centre():
    v, u = np.mgrid[:200, :240]
    u0, v0 = 12 / 240, -15 / 200
    # The middle of a transform of even length is at half of it.
    wave = np.cos(2 * np.pi * (u0 * (u - 120) + v0 * (v - 100)) + 0.7)
    found = peaks(spectrum(100 + 50 * wave), faintest=0.5)
    assert len(found) == 2
    one = found[np.argmax(found[:, 0])]
    np.testing.assert_allclose(one[:2], [u0, v0], atol=1e-12)
    assert one[3] == pytest.approx(0.7, abs=1e-3)
    # Half of the amplitude, times the sum of the window, a quarter of the pixels.
    assert one[2] == pytest.approx(50 / 2 * 200 * 240 / 4, rel=1e-3)


def test_primary_peaks_lie_where_the_chess_fields_put_them():
    system = load_system("solidras", {"mask.field_um": 120.0})
    place = Projection.from_pose(4000.0, 5000.0, 1.0, 0.0, 4)
    from rasnik.imaging.montecarlo import exact_image

    found = peaks(spectrum(exact_image(system, place)))[:4]
    # A chessboard of field a repeats along its diagonals: half a cycle in a field, both ways.
    expected = system.pitch_um / (2 * 120.0)
    np.testing.assert_allclose(np.abs(found[:, :2]), expected, atol=1 / 540)


# ------------------------------------------------------------------------ instruments in motion


def test_resonance_has_the_rms_and_the_spectrum_of_an_oscillator():
    from scipy.signal import welch

    motion = Resonance(hz=12.0, quality=8.0, x_rms_um=0.5, y_rms_um=0.0)
    t_s = np.arange(400_000) / 200.0
    x, y, theta = motion.at(t_s, np.random.default_rng(5)).T
    assert not y.any() and not theta.any()
    assert x.std() == pytest.approx(0.5, rel=0.02)
    f, psd = welch(x, 200.0, nperseg=8192)
    level = 0.25 / (np.pi / 2 * 12.0 * 8.0)
    for hz in (3.0, 12.0, 30.0):
        r = hz / 12.0
        band = (f > 0.97 * hz) & (f < 1.03 * hz)
        expected = level / ((1 - (f[band] / 12) ** 2) ** 2 + (f[band] / 12 / 8) ** 2)
        assert psd[band].mean() == pytest.approx(expected.mean(), rel=0.1), r


def test_recording_follows_the_motion_and_its_errors_are_those_of_the_bound():
    from rasnik.performance.bound import bound

    system = load_system("microras", {"sensor.binning": 3})
    recording = record(system, MICRORAS, 120, (1, 2), fourier=20)
    assert len(recording.track) == 120
    assert recording.fourier_errors.shape == (20, 4)
    assert recording.track.frame_rate_hz == pytest.approx(275.0)
    # The same seed moves alike, and the tracker sees it: nm of pendulum above pm of noise.
    again = record(system, MICRORAS, 120, (1, 2), fourier=20)
    np.testing.assert_array_equal(again.track.x_um, recording.track.x_um)
    least = bound(system, rounding=True).sigma_x_nm
    assert 1e3 * np.ptp(recording.track.x_um) > 10 * least
    assert 1e3 * recording.fourier_errors[:, 0].std() < 6 * least


def test_likelihood_beats_fourier_on_the_same_frames(rng):
    from rasnik.imaging.montecarlo import exact_image

    system = solidras(width_px=320, height_px=240)
    expected = exact_image(system, Projection.from_pose(4000.0, 5000.0, 1.0, 0.0, 4))
    frames = list(noisy(expected, system, 40, stream(1, 1)))
    fit, fourier = by_likelihood(frames, system), by_fourier(frames, system)
    assert fit.x_um.std() < fourier.x_um.std()
    assert abs(fit.x_um.mean() - 4000) < 4 * fit.sigma_x_um.mean() / np.sqrt(40)
    with pytest.raises(RuntimeError, match="no position"):
        by_fourier([np.zeros_like(frames[0])], system)


# ------------------------------------------------------------------------ table and report


def test_table_numbers_each_reason_once():
    notes, numbers = notes_of(ROWS)
    assert notes == ["a | b", "another reason"]
    assert numbers == [1, 1, 2]
    text = markdown(ROWS)
    head, rule, first, *_ = text.splitlines()
    assert head.count("|") == rule.count("|") == len(HEADINGS) + 2
    assert first == ("| resolution | nm | 3.0 | 0.782 ± 0.049 | 0.407 ± 0.026 | 0.391 | 1 |")
    assert "1. a | b\n2. another reason\n" in text
    assert cells(ROWS[1])[3] == ""


def test_json_has_no_numbers_that_json_lacks():
    document = json_ready({"a": np.array([1.0, np.nan]), "b": (np.int64(3), np.inf), "c": "x"})
    assert json.loads(json.dumps(document, allow_nan=False)) == {
        "a": [1.0, None], "b": [3, None], "c": "x",
    }  # fmt: skip


def _drawn(effort: Effort) -> Outcome:
    figure: Figure = new_figure(2, 1)
    figure.subplots().plot([0, 1])
    data = {"quick": effort.quick, "bad": float("nan")}
    return Outcome("Fig. <1>", "A & B", "a caption", figure, ROWS, data)


def _raises(effort: Effort) -> Outcome:
    raise ValueError("no light")


@pytest.fixture
def two_parts(monkeypatch):
    """A run of one figure that succeeds and one that fails, in place of the paper's."""
    from rasnik.paper import pictures

    monkeypatch.setattr(pictures, "drawn", _drawn, raising=False)
    monkeypatch.setattr(pictures, "raises", _raises, raising=False)
    parts = (Part("bad", "pictures:raises", 2), Part("good", "pictures:drawn", 1))
    monkeypatch.setattr(run, "PARTS", parts)
    return parts


class _Page(HTMLParser):
    def __init__(self) -> None:
        super().__init__()
        self.sources: list[str] = []
        self.links: list[str] = []

    def handle_starttag(self, tag, attrs):
        names = dict(attrs)
        if "src" in names:
            self.sources.append(names["src"])
        if tag in ("link", "script"):
            self.links.append(tag)


def test_one_failure_does_not_stop_the_others(two_parts, tmp_path):
    seen = []
    results = redo_all(tmp_path, Effort(quick=True), workers=1, finished=seen.append)
    assert [one.name for one in results] == ["bad", "good"]
    assert [one.error for one in results] == ["ValueError: no light", ""]
    assert {one.name for one in seen} == {"bad", "good"}
    assert [cells(row) for row in results[1].rows] == [cells(row) for row in ROWS]
    document = json.loads((tmp_path / "good.json").read_text())
    assert document["quick"] is True and document["data"]["bad"] is None
    assert (tmp_path / "good.png").read_bytes()[:4] == b"\x89PNG"
    summary = write_all(tmp_path, results, "made so")
    assert summary["failed"] == {"bad": "ValueError: no light"}
    assert len(summary["rows"]) == 3
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    parsed = _Page()
    parsed.feed(page)
    assert parsed.links == [] and len(parsed.sources) == 1
    assert parsed.sources[0].startswith("data:image/png;base64,")
    assert "Fig. &lt;1&gt;" in page and "A &amp; B" in page and "no light" in page
    assert not re.search(r"https?://", page)


def test_results_survive_their_way_through_json(two_parts, tmp_path):
    result = redo(two_parts[1], tmp_path, Effort())
    again = Result(result.name, json.loads((tmp_path / "good.json").read_text()), "", 0.0)
    assert [cells(row) for row in again.rows] == [cells(row) for row in ROWS]


def test_command_names_what_failed_and_ends_with_status_1(two_parts, tmp_path):
    out = tmp_path / "new" / "folder"
    ended = CliRunner().invoke(app, ["paper", "-o", str(out), "--workers", "1"])
    assert ended.exit_code == 1
    assert "failed: bad: ValueError: no light" in " ".join(ended.stderr.split())
    assert "0.407 ± 0.026" in ended.stdout
    assert sorted(path.name for path in out.iterdir()) == [
        "good.json", "good.png", "report.html", "results.json", "table.md",
    ]  # fmt: skip
    as_json = CliRunner().invoke(
        app, ["paper", "-o", str(out), "--workers", "1", "--only", "good", "--json"]
    )
    assert as_json.exit_code == 0
    assert json.loads(as_json.stdout)["failed"] == {}


def test_command_refuses_a_figure_that_is_not_there(tmp_path):
    ended = CliRunner().invoke(app, ["paper", "-o", str(tmp_path), "--only", "fig99"])
    assert ended.exit_code == 2
    assert "there is no figure fig99; they are contour" in " ".join(ended.stderr.split())
    (tmp_path / "file").write_text("")
    ended = CliRunner().invoke(app, ["paper", "-o", str(tmp_path / "file")])
    assert ended.exit_code == 2


def test_every_part_has_its_function():
    import importlib

    assert len({part.name for part in PARTS}) == len(PARTS)
    for part in PARTS:
        module, _, function = part.function.partition(":")
        made = getattr(importlib.import_module(f"rasnik.paper.{module}"), function)
        assert made.__doc__ and re.match(r"(Figs?\.|Section)", made.__doc__), part.name
    assert [part.name for part in parts_named(["scatter", "contour"])] == ["contour", "scatter"]
    assert _Series.floor.__doc__


def test_figures_in_processes_of_their_own(tmp_path):
    results = redo_all(tmp_path, Effort(quick=True), ["chessfield", "blur"], workers=2)
    assert [one.error for one in results] == ["", ""]
    assert (tmp_path / "blur.png").exists() and (tmp_path / "chessfield.json").exists()


def test_the_table_in_the_docs_is_one_of_a_run():
    page = Path(__file__).resolve().parents[1] / "docs" / "paper.md"
    if not page.exists():
        pytest.skip("the pages are not beside the tests")
    text = page.read_text(encoding="utf-8")
    for part in PARTS:
        assert f"`{part.name}`" in text, part.name
    table = text.split("<!-- table: begin -->")[1].split("<!-- table: end -->")[0]
    rows = [line.split("|")[1:-1] for line in table.splitlines() if line.startswith("| ")]
    assert tuple(cell.strip() for cell in rows[0][:-1]) == HEADINGS
    assert len(rows) > 40
    for quantity, _, _, *values, _ in rows[1:]:
        assert any(re.search(r"\d", value) for value in values), quantity
    assert re.search(r"`rasnik paper( --quick)? --seed \d+: ", table)
