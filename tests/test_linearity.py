"""Linearity: simulated scans against the truth, and periodic errors injected into tracks."""

from __future__ import annotations

import json

import numpy as np
import pytest
from scipy.stats import kstest
from typer.testing import CliRunner

from rasnik import Track, load_system
from rasnik.characterisation.correction import Correction, apply_correction, correction_of
from rasnik.characterisation.folding import LEVEL, fold, fold_track
from rasnik.characterisation.linearity import METHODS, PAPER_SCANS, Scan, linearity
from rasnik.cli import app
from rasnik.io import read_track, write_track

SOLIDRAS = load_system("solidras")
SMALL = load_system("solidras", ["sensor.width_px=240", "sensor.height_px=180"])
FIELD, PIXEL = 85.0, 6.9
NOISE_UM = 4e-4


# ------------------------------------------------------------------------ simulated scans


def test_exact_frames_show_no_error_of_the_fit() -> None:
    scans = [Scan(theta, 2.0, 6, axis) for theta in (0.0, 0.002) for axis in ("x", "y")]
    found = linearity(SMALL, scans)
    assert [one.method for one in found.errors[:3]] == list(METHODS)
    for one in found.errors:
        # 0.002 nm for the fit, 0.03 nm for the reference of the tracker 0.2 um away (docs)
        most = {"likelihood": 0.01, "tracker": 0.05, "fourier": 3.0}[one.method]
        assert one.failed == 0
        assert one.figures["largest_nm"] < most, (one.method, one.scan)
        assert one.error_nm.shape == (6, 2)


def test_the_generator_of_the_paper_makes_the_error_of_the_paper() -> None:
    # Points within the pixel jump over contours all at once where the mask is not rotated.
    found = linearity(SMALL, [Scan(0.0, 0.05, 9), Scan(0.02, 0.05, 9)], methods=["likelihood"],
                      path="paper")  # fmt: skip
    straight, turned = (one.figures["peak_to_peak_nm"] for one in found.errors)
    assert straight > 5
    assert turned < straight / 10
    assert found.errors[0].figures["slope"] > 0.5  # as the paper finds: 70 % or worse


def test_a_source_of_error_is_seen() -> None:
    scan = [Scan(0.002, 85.0, 5)]
    clean = linearity(SMALL, scan, methods=["likelihood"])
    bent = linearity(SMALL, scan, methods=["likelihood"], effects=["distortion=1e-3"])
    assert bent.effects and not clean.effects
    assert bent.errors[0].figures["peak_to_peak_nm"] > 100 * clean.errors[0].figures["rms_nm"]


def test_figures_of_a_known_curve() -> None:
    found = linearity(SMALL, [Scan(0.0, 0.01, 2)], methods=["fourier"]).errors[0]
    known = type(found)(Scan(0.0, 0.004, 5), "fourier", np.array([[0, 1, np.nan, 3, -1.0]] * 2).T)
    assert known.failed == 1
    figures = known.figures  # 0, 1, 3, -1 nm at 0, 1, 3, 4 nm
    assert figures["mean_nm"] == pytest.approx(0.75)
    assert figures["peak_to_peak_nm"] == 4
    assert figures["largest_nm"] == 3
    assert figures["slope"] == pytest.approx(4)
    assert json.loads(json.dumps(known.as_dict()))["error_x_nm"][2] is None


@pytest.mark.parametrize(
    ("arguments", "message"),
    [((0.0, 0.0), "range"), ((0.0, 1.0, 1), "2 positions"), ((0.0, 1.0, 5, "z"), "along x or y")],
)
def test_impossible_scans(arguments, message) -> None:
    with pytest.raises(ValueError, match=message):
        Scan(*arguments)


def test_unknown_methods_are_refused() -> None:
    with pytest.raises(ValueError, match="likelihood, fourier, tracker"):
        linearity(SMALL, PAPER_SCANS, methods=["soap"])


# ------------------------------------------------------------------------ folding


def walk(rng, n: int = 12_000, step_um: float = 60.0) -> np.ndarray:
    return 2e4 + np.cumsum(rng.normal(0, step_um, n))


def sweep(rng, n: int = 40_000, fields: float = 700.0, jitter_um: float = 0.01) -> np.ndarray:
    """A steady motion whose speed wavers."""
    drift = fields * FIELD * np.arange(n) / n + rng.uniform(0, 2 * FIELD)
    return 2e4 + drift + np.cumsum(rng.normal(0, jitter_um, n))


def seen(true_um: np.ndarray, rng) -> np.ndarray:
    return true_um + rng.normal(0, NOISE_UM, len(true_um))


def track_of(x_um: np.ndarray, y_um: np.ndarray) -> Track:
    n = len(x_um)
    ones = np.ones(n)
    return Track(
        frame=np.arange(n), time_s=np.arange(n) / 275, x_um=x_um, y_um=y_um, scale=ones,
        theta_rad=0 * ones, sigma_x_um=NOISE_UM * ones, sigma_y_um=NOISE_UM * ones,
        sigma_scale=1e-7 * ones, sigma_theta_rad=1e-7 * ones, chi2_ndf=ones, blur_um=4.5 * ones,
        dark_level=25 * ones, light_level=252 * ones, flags=0 * ones,
        metadata={"system_toml": SOLIDRAS.to_toml()},
    )  # fmt: skip


@pytest.mark.parametrize("motion", [walk, sweep])
def test_clean_tracks_give_even_probabilities(motion, rng) -> None:
    found = [fold(seen(motion(rng), rng), 2 * FIELD, harmonics=10) for _ in range(200)]
    for values in ([one.p_value for one in found], [one.control_p_value for one in found]):
        assert kstest(values, "uniform").pvalue > 1e-3
        # 2 expected of 200 at a level of 0.01; 8 or more by chance in one of 1000 tests
        assert np.sum(np.array(values) < LEVEL) < 8


@pytest.mark.parametrize("motion", [walk, sweep])
def test_the_stated_error_is_that_of_repeated_runs(motion, rng) -> None:
    pulls = []
    for _ in range(100):
        one = fold(seen(motion(rng), rng), 2 * FIELD, harmonics=4)
        pulls.append((one.error_nm / one.sigma_nm)[::64])
    # 400 values, mostly independent; Student's t of 23 has a spread of 1.05
    assert np.std(pulls) == pytest.approx(1.05, abs=0.12)


def injected_nm(x_um: np.ndarray) -> np.ndarray:
    turn = 2 * np.pi * x_um / (2 * FIELD)
    return 35 * np.sin(2 * turn + 0.4) + 12 * np.cos(turn) - 8 * np.sin(5 * turn)


def test_an_injected_error_is_recovered_within_its_uncertainty(rng) -> None:
    detected, pulls = 0, []
    for _ in range(40):
        true = sweep(rng)
        one = fold(seen(true + 1e-3 * injected_nm(true), rng), 2 * FIELD, harmonics=10)
        detected += one.detected
        expected = injected_nm(one.position_um)
        assert np.abs(one.error_nm - expected).max() < 6 * one.sigma_nm.max()
        assert one.sigma_nm.max() < 20
        pulls.append(((one.error_nm - expected) / one.sigma_nm)[::25])
    assert detected >= 39
    assert np.std(pulls) == pytest.approx(1.05, abs=0.15)
    assert abs(np.mean(pulls)) < 0.2


def test_a_pixel_error_beside_one_of_the_fields(rng) -> None:
    true = sweep(rng, jitter_um=1e-3)
    error = injected_nm(true) + 3 * np.sin(2 * np.pi * true / PIXEL)
    found = fold_track(track_of(seen(true + 1e-3 * error, rng), seen(sweep(rng), rng)), SOLIDRAS)
    pixel = found["x", "pixel"]
    assert pixel.detected and pixel.period_um == pytest.approx(PIXEL)
    assert pixel.rms_nm == pytest.approx(3 / np.sqrt(2), abs=3 * pixel.sigma_rms_nm)
    assert found["x", "two fields"].detected and found["x", "one field"].detected
    correction = correction_of(found)
    assert [(t.axis, t.name) for t in correction.terms if t.axis == "x"] == [
        ("x", "two fields"), ("x", "pixel"),
    ]  # fmt: skip
    left = error - correction.error_nm("x", true)
    assert left.std() < 0.1 * error.std()


def test_correction_of_a_track_through_json(rng) -> None:
    true = sweep(rng, jitter_um=1e-3)
    track = track_of(seen(true + 1e-3 * injected_nm(true), rng), seen(sweep(rng), rng))
    table = correction_of(fold_track(track, SOLIDRAS))
    again = Correction.from_dict(json.loads(json.dumps(table.as_dict())))
    assert again == table
    corrected = apply_correction(track, again)
    before, after = (t.x_um - true - np.mean(t.x_um - true) for t in (track, corrected))
    assert before.std() == pytest.approx(1e-3 * np.std(injected_nm(true)), rel=0.01)
    assert after.std() < 0.1 * before.std()
    np.testing.assert_array_equal(corrected.y_um, track.y_um)  # nothing was found there
    assert not fold_track(corrected, SOLIDRAS)["x", "two fields"].detected
    with pytest.raises(ValueError, match="corrected already"):
        apply_correction(corrected, again)
    # the table for other programs is the same function
    term = table.as_dict()["terms"][0]
    np.testing.assert_allclose(
        term["error_nm"], table.terms[0].error_nm(np.array(term["position_um"]))
    )


def test_motion_that_favours_places_is_told_from_an_error() -> None:
    # A pendulum of constant swing visits the same places in the same way for ever.
    t = np.arange(40_000)
    x = 2e4 + 3000 * np.sin(2 * np.pi * t * 0.7317 / 275)
    one = fold(x, 2 * FIELD, harmonics=10)
    assert one.p_value < LEVEL  # uneven it is
    assert not one.smooth and not one.detected and "not smooth enough" in one.remark


def test_motion_that_is_not_wide_is_told(rng) -> None:
    short = fold(seen(sweep(rng, fields=200), rng), 2 * FIELD, harmonics=10)
    assert not short.wide and not short.detected and "not wide enough" in short.remark
    with pytest.raises(ValueError, match="motion covers"):
        fold(seen(sweep(rng, fields=20), rng), 2 * FIELD)
    found = fold_track(track_of(seen(sweep(rng, fields=20), rng), seen(sweep(rng), rng)), SOLIDRAS)
    assert "x, two fields" in found.refused and found["y", "two fields"].points == 40_000
    with pytest.raises(ValueError, match="500 positions"):
        fold_track(track_of(sweep(rng, 500), sweep(rng, 500)), SOLIDRAS)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"kind": "other"}, "not a linearity correction"),
        ({"terms": [{"axis": "x"}]}, "damaged"),
        ({"terms": 3}, "damaged"),
    ],
)
def test_what_is_no_correction(change, message) -> None:
    with pytest.raises(ValueError, match=message):
        Correction.from_dict({"kind": "rasnik linearity correction", "terms": []} | change)


# ------------------------------------------------------------------------ command


def run(*arguments: object):
    return CliRunner().invoke(app, ["linearity", *map(str, arguments)])


def test_command_on_a_system(tmp_path) -> None:
    toml, plot, figures = (tmp_path / name for name in ("s.toml", "l.png", "l.json"))
    toml.write_text(SMALL.to_toml())
    options = ("--theta", "0,20", "--range", "50nm", "-n", "3", "--method", "fourier")
    result = run(toml, *options, "-o", plot, "-o", figures)
    assert result.exit_code == 0, result.output
    assert plot.read_bytes().startswith(b"\x89PNG")
    scans = json.loads(figures.read_text())["scans"]
    assert [(one["theta_rad"], one["range_um"]) for one in scans] == [(0, 0.05), (0.02, 0.05)]
    assert json.loads(run(toml, *options, "--json").stdout)["scans"] == scans


def test_command_on_a_track_and_its_correction(tmp_path, rng) -> None:
    true = sweep(rng, jitter_um=1e-3)
    file, table, plot, corrected = (
        tmp_path / name for name in ("t.h5", "c.json", "f.png", "corrected.h5")
    )
    track = track_of(seen(true + 1e-3 * injected_nm(true), rng), seen(sweep(rng), rng))
    write_track(track, file)
    result = run(file, "-o", table, "-o", plot)
    assert result.exit_code == 0, result.output
    assert "correction: x modulo two fields" in result.stdout
    assert plot.read_bytes().startswith(b"\x89PNG")
    assert run(file, "--apply", table, "-o", corrected).exit_code == 0
    error = read_track(corrected).x_um - true
    assert error.std() < 0.1 * (track.x_um - true).std()
    periods = json.loads(run(file, "--period", "100um,50um", "--json").stdout)
    assert [one["period_um"] for one in periods["folds"]] == [100, 50, 100, 50]
    assert periods["terms"] == []
    again = run(corrected, "--apply", table, "-o", tmp_path / "again.h5")
    assert again.exit_code == 2 and "corrected already" in " ".join(again.stderr.split())


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["solidras", "--range", "5"], "with their unit"),
        (["solidras", "--theta", "a"], "numbers in mrad"),
        (["solidras", "--axis", "z"], "--axis must be x or y"),
        (["solidras", "--method", "soap", "-n", "2"], "a method is one of"),
        (["solidras", "--path", "fast", "-n", "2"], "path must be one of"),
        (["nothing.h5"], "nothing.h5"),
        (["t.h5", "--apply", "c.json"], "needs one -o"),
        (["solidras", "-o", "l.txt"], "must end in"),
    ],
)
def test_command_says_what_is_wrong(arguments, message) -> None:
    result = run(*arguments)
    assert result.exit_code == 2
    assert message in " ".join(result.stderr.split())
