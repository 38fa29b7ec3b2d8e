"""``rasnik seismic``, run as a user does."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from matplotlib.figure import Figure
from typer.testing import CliRunner, Result

from rasnik import Track
from rasnik.characterisation.gaps import Series, even_series
from rasnik.cli import app
from rasnik.instrument import load_system
from rasnik.io import read_track, write_track
from rasnik.report.seismic import budget_figure, ground_figure, ring_down_figure
from rasnik.seismic.budget import self_noise
from rasnik.seismic.equation_of_motion import reading_of_ground
from rasnik.seismic.ground import ground_motion
from rasnik.seismic.ring_down import ring_down
from rasnik.seismic.suspension import Suspension

RATE_HZ, SIGMA_NM = 25.0, 0.4
MASS = Suspension(frequency_hz=0.5, q=20.0)
MASS_OPTIONS = ("--frequency", "0.5", "--q", "20")
CHEAP = ("--reading", "5")  # no bound to compute


def rasnik(*arguments: str) -> Result:
    return CliRunner(env={"COLUMNS": "200"}).invoke(app, ["seismic", *arguments])


def refused(*arguments: str) -> str:
    """The sentence with which a command ends that was not understood."""
    run = rasnik(*arguments)
    assert run.exit_code == 2, run.output
    assert "Traceback" not in run.output
    return " ".join(run.output.split())


def track_of(x_nm: np.ndarray, y_nm: np.ndarray) -> Track:
    n = len(x_nm)
    columns = {
        name: np.full(n, value)
        for name, value in {
            "scale": 1.0, "theta_rad": 0.0, "sigma_x_um": SIGMA_NM / 1e3,
            "sigma_y_um": 2 * SIGMA_NM / 1e3, "sigma_scale": 1e-6, "sigma_theta_rad": 1e-6,
            "chi2_ndf": 1.0, "blur_um": 5.0, "dark_level": 10.0, "light_level": 200.0,
        }.items()
    }  # fmt: skip
    return Track(
        frame=np.arange(n),
        time_s=np.arange(n) / RATE_HZ,
        x_um=4000 + x_nm / 1e3,
        y_um=5000 + y_nm / 1e3,
        flags=np.zeros(n, np.uint32),
        **columns,
    )


@pytest.fixture(scope="module")
def track_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The ground swings at 1 Hz along x and at 2 Hz along y."""
    rng = np.random.default_rng(7)
    t = np.arange(6000) / RATE_HZ
    read = [
        reading_of_ground(Series(a * np.sin(2 * np.pi * f * t), RATE_HZ), MASS).values
        + noise * rng.normal(size=len(t))
        for a, f, noise in ((300.0, 1.0, SIGMA_NM), (100.0, 2.0, 2 * SIGMA_NM))
    ]
    path = tmp_path_factory.mktemp("seismic") / "track.h5"
    write_track(track_of(*read), path)
    return path


@pytest.fixture(scope="module")
def decay_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    rng = np.random.default_rng(8)
    t = np.arange(3000) / RATE_HZ
    w = np.sqrt(MASS.omega**2 - 1 / MASS.time_constant_s**2)
    x = 2000 * np.exp(-t / MASS.time_constant_s) * np.cos(w * t)
    path = tmp_path_factory.mktemp("seismic") / "decay.csv"
    x, y = (one + SIGMA_NM * rng.normal(size=len(t)) for one in (x, 0 * x))
    write_track(track_of(x, y), path)
    return path


@pytest.mark.parametrize("command", [(), ("budget",), ("ground",), ("ring-down",)])
def test_help(command: tuple[str, ...]) -> None:
    run = rasnik(*command, "--help")
    assert run.exit_code == 0 and "Usage" in run.output


# ------------------------------------------------------------------------ budget


def test_budget(tmp_path: Path) -> None:
    plot = tmp_path / "budget.png"
    run = rasnik("budget", "microras", *MASS_OPTIONS, "--mass", "1", "--plot", str(plot))
    assert run.exit_code == 0, run.output
    for text in ("Cramer-Rao bound", "thermal", "NLNM", "below the low-noise model", "not counted"):
        assert text in run.output
    assert plot.read_bytes().startswith(b"\x89PNG")


def test_budget_as_json_is_that_of_python() -> None:
    run = rasnik(
        "budget", "microras", *MASS_OPTIONS, "--mass", "2", "--damping", "structural",
        "--frame-rate", "100", "--axis", "y", "--temperature", "77", "--extra", "air=2.5",
        "--at", "0.1,5", "--json",
    )  # fmt: skip
    found = json.loads(run.output)
    mass = Suspension(frequency_hz=0.5, q=20.0, mass_kg=2.0, damping="structural")
    from rasnik import load_system

    wanted = self_noise(
        load_system("microras"), mass, axis="y", rate_hz=100.0, temperature_k=77.0,
        extra={"air": 2.5},
    )  # fmt: skip
    assert found == json.loads(json.dumps(wanted.as_dict((0.1, 5.0), curves=True)))


def test_budget_without_a_mass_says_so() -> None:
    run = rasnik("budget", "microras", *MASS_OPTIONS, *CHEAP)
    assert "not counted: thermal noise of the suspension: the mass is not known" in run.output


def test_budget_of_a_slow_camera_ends_at_half_its_rate() -> None:
    run = rasnik("budget", "microras", *MASS_OPTIONS, *CHEAP, "--frame-rate", "8", "--json")
    found = json.loads(run.output)
    assert [need["frequency_hz"] for need in found["needs"]] == [0.01, 0.1, 1]


def test_budget_of_a_suspension_in_a_file(tmp_path: Path) -> None:
    path = tmp_path / "watt.toml"
    path.write_text("[suspension]\nkind = 'watt'\nfrequency_hz = 0.3\nq = 30\nmass_kg = 1\n")
    run = rasnik("budget", "microras", *CHEAP, "--suspension", str(path), "--q", "50", "--json")
    found = json.loads(run.output)["suspension"]
    assert (found["kind"], found["frequency_hz"], found["q"]) == ("watt", 0.3, 50)


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (("--q", "20"), "frequency_hz is missing"),
        (("--suspension", "none.toml"), "there is no such file"),
        ((*MASS_OPTIONS, "--plot", "budget.doc"), "must end in .png"),
        ((*MASS_OPTIONS, "--extra", "air"), "is not of the form NAME=PM"),
        ((*MASS_OPTIONS, "--extra", "air=x"), "is not a list of numbers"),
        ((*MASS_OPTIONS, "--at", "500"), "not to 500 Hz"),
        ((*MASS_OPTIONS, "--mass", "-1"), "mass_kg = -1"),
        ((*MASS_OPTIONS, "--frame-rate", "0"), "the frame rate must be above 0"),
    ],
)
def test_wrong_budgets_are_refused(arguments: tuple[str, ...], sentence: str) -> None:
    assert sentence in refused("budget", "microras", *CHEAP, *arguments)


# ------------------------------------------------------------------------ ground motion


def test_ground_in_files_and_figures(track_file: Path, tmp_path: Path) -> None:
    stored, plot = tmp_path / "ground.h5", tmp_path / "ground.png"
    run = rasnik(
        "ground", str(track_file), *MASS_OPTIONS, "--band", "0.5", "4", "-o", str(stored),
        "--quantity", "displacement", "--plot", str(plot), "--json",
    )  # fmt: skip
    assert run.exit_code == 0, run.output
    x, y = json.loads(run.stdout)["motions"]
    assert x["rms"] == pytest.approx(300 / np.sqrt(2), rel=0.01)
    assert y["rms"] == pytest.approx(100 / np.sqrt(2), rel=0.01)
    assert y["sigma_readout"] == pytest.approx(2 * x["sigma_readout"])
    assert (x["unit"], x["stretches"], x["edge_s"]) == ("nm", 1, 12)
    assert plot.read_bytes().startswith(b"\x89PNG")
    with h5py.File(stored) as file:
        values, time_s = file["x_displacement_nm"][:], file["time_s"][:]
        assert file["x_displacement_nm"].attrs["unit"] == "nm"
        assert json.loads(file.attrs["suspension"])["q"] == 20
        assert "complete from 0.5 to 4 Hz" in file.attrs["x_motion"]
    there = np.isfinite(values)
    wanted = 300 * np.sin(2 * np.pi * time_s[there])
    assert np.abs(values[there] - wanted).max() < 3 + 5 * x["sigma_readout"]
    again = rasnik(
        "ground", str(track_file), *MASS_OPTIONS, "--band", "0.5", "4", "-o", str(stored)
    )
    assert again.exit_code == 2 and "exists already" in again.output


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_ground_in_other_files(track_file: Path, tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"ground{suffix}"
    run = rasnik(
        "ground", str(track_file), *MASS_OPTIONS, "--band", "0.5", "4", "-c", "y",
        "--on-mass", "camera", "--method", "time", "-o", str(path),
    )  # fmt: skip
    assert run.exit_code == 0, run.output
    assert "by the readout" in run.output
    if suffix == ".csv":
        with path.open(newline="") as file:
            rows = list(csv.DictReader(file))
        found = np.array([float(row["y_velocity_nm_per_s"]) for row in rows])
    else:
        pytest.importorskip("pyarrow")
        from rasnik.io.parquet import read_columns

        columns, about = read_columns(path)
        found = columns["y_velocity_nm_per_s"]
        assert "method time" in about["y_motion"]
    camera = MASS.model_copy(update={"on_mass": "camera"})
    series = even_series(read_track(track_file), "y_um")
    wanted = ground_motion(series, camera, "velocity", band_hz=(0.5, 4.0), method="time")
    np.testing.assert_array_equal(found, wanted.values)


def test_ground_of_a_track_without_errors_knows_no_noise(track_file: Path, tmp_path: Path) -> None:
    track = read_track(track_file)
    none = np.full(len(track), np.nan)
    path = tmp_path / "bare.h5"
    write_track(replace(track, sigma_x_um=none, sigma_y_um=none), path)
    options = ("ground", str(path), *MASS_OPTIONS, "--band", "0.5", "4", "--json", "-c", "x")
    assert json.loads(rasnik(*options).output)["motions"][0]["sigma_readout"] is None
    given = json.loads(rasnik(*options, "--sigma", "1").output)["motions"][0]
    assert given["sigma_readout"] > 0
    stored = tmp_path / "ground.h5"
    assert rasnik(*options, "-o", str(stored)).exit_code == 0
    with h5py.File(stored) as file:
        assert "x_motion" in file.attrs and "x_sigma" not in file.attrs


def test_the_exposure_of_the_tracks_system_is_named(track_file: Path, tmp_path: Path) -> None:
    system = load_system("solidras", {"sensor.exposure_s": 0.04, "sensor.frame_rate_hz": RATE_HZ})
    track = read_track(track_file)
    path, stored = tmp_path / "track.h5", tmp_path / "ground.h5"
    write_track(replace(track, metadata={"system_toml": system.to_toml()}), path)
    options = ("ground", str(path), *MASS_OPTIONS, "--band", "0.5", "5", "-c", "x")
    run = rasnik(*options, "-o", str(stored))
    assert "The mean over an exposure of 0.04 s is undone." in run.output
    with h5py.File(stored) as file:
        assert "exposure of 0.04 s undone" in file.attrs["x_motion"]
    assert json.loads(rasnik(*options, "--json").output)["motions"][0]["exposure_s"] == 0.04
    left_in = rasnik(*options, "--method", "time")
    assert left_in.exit_code == 0
    # 1 - sin(0.2 pi) / (0.2 pi)
    assert "too small by 6.5 % at 5 Hz" in " ".join(left_in.output.split())


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (("--band", "4", "0.5"), "is no band"),
        (("--band", "0.01", "1"), "no stretch without a gap is longer than"),
        (("--band", "0.5", "4", "-c", "theta"), "is read off x, y or x,y"),
        (("--band", "0.5", "4", "-o", "ground.txt"), "must end in .h5"),
        (("--band", "0.5", "4", "--sigma", "-1"), "must be above 0"),
        (("--band", "0.5", "4", "--frame-rate", "10"), "the frames have times"),
    ],
)
def test_wrong_ground_motions_are_refused(
    track_file: Path, arguments: tuple[str, ...], sentence: str
) -> None:
    assert sentence in refused("ground", str(track_file), *MASS_OPTIONS, *arguments)


# ------------------------------------------------------------------------ ring-down


def test_ring_down(decay_file: Path, tmp_path: Path) -> None:
    plot = tmp_path / "decay.svg"
    run = rasnik("ring-down", str(decay_file), "--plot", str(plot))
    assert run.exit_code == 0, run.output
    assert "f0         0.5000" in run.output and "Q          20.0" in run.output
    assert "does not tell viscous from structural" in run.output
    assert plot.stat().st_size > 1000


def test_ring_down_of_a_part_as_json(decay_file: Path) -> None:
    run = rasnik(
        "ring-down", str(decay_file), "--from", "10", "--to", "60", "--frequency", "0.5",
        "--json",
    )  # fmt: skip
    found = json.loads(run.output)
    assert found["q"] == pytest.approx(20, abs=5 * found["sigma_q"])
    wanted = 2000 * np.exp(-10 / MASS.time_constant_s)
    assert found["amplitude_nm"] == pytest.approx(wanted, abs=5 * found["sigma_amplitude_nm"])
    assert found["chi2_ndf"] == pytest.approx(1, abs=0.2)


def test_a_short_decay_is_said_to_be_short(decay_file: Path, tmp_path: Path) -> None:
    plot = tmp_path / "short.png"
    run = rasnik("ring-down", str(decay_file), "--from", "95", "--to", "100", "--plot", str(plot))
    assert run.exit_code == 0, run.output
    assert "too short to give Q" in run.output and "Q          above" in run.output
    assert plot.exists()


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (("-c", "y"), "no free oscillation stands out"),
        (("--from", "1000"), "between --from and --to; it goes from 0 to 119.96 s"),
        (("--from", "60", "--to", "60.5"), "too few for a ring-down"),
        (("--from", "nan"), "are times of the track in s"),
        (("--frequency", "40"), "cannot be seen in these readings, which show 0.0167 to 12.5 Hz"),
    ],
)
def test_wrong_ring_downs_are_refused(
    decay_file: Path, arguments: tuple[str, ...], sentence: str
) -> None:
    assert sentence in refused("ring-down", str(decay_file), *arguments)


def test_times_from_1970_are_not_mistaken_for_those_of_the_track(
    decay_file: Path, tmp_path: Path
) -> None:
    track = read_track(decay_file)
    path = tmp_path / "live.h5"
    write_track(replace(track, time_s=1_790_000_000 + track.time_s), path)
    said = refused("ring-down", str(path), "--from", "10")
    assert "count from 1970" in said and "from 1790000000 to 1790000119.96 s" in said
    assert rasnik("ring-down", str(path), "--from", "1790000010").exit_code == 0


@pytest.mark.parametrize("command", [("ground", *MASS_OPTIONS, "--band", "1", "5"), ("ring-down",)])
@pytest.mark.parametrize("frames", [0, 1])
def test_a_track_without_frames_shows_no_motion(
    tmp_path: Path, command: tuple[str, ...], frames: int
) -> None:
    path = tmp_path / "track.csv"
    write_track(track_of(np.zeros(frames), np.zeros(frames)), path)
    assert f"two frames at least; the track has {frames}." in refused(*command, str(path))


# ------------------------------------------------------------------------ figures


def labels(figure: Figure) -> str:
    texts = [text.get_text() for one in figure.axes for text in one.texts]
    for axes in figure.axes:
        texts += [axes.get_title(), axes.get_xlabel(), axes.get_ylabel()]
    return " ".join(texts)


def test_figures_have_units_and_what_is_left_out(rng: np.random.Generator) -> None:
    from rasnik import load_system

    budget = self_noise(load_system("microras"), MASS, reading_pm_rthz=5.0)
    shown = labels(budget_figure(budget))
    assert "m/s²/√Hz" in shown and "frequency, Hz" in shown and "not counted: slow drifts" in shown
    series = Series(rng.normal(size=2000), RATE_HZ)
    motion = ground_motion(series, MASS, "acceleration", band_hz=(0.5, 4.0), sigma=1.0)
    assert "m/s²/√Hz" in labels(ground_figure({"x": motion}, MASS))
    short = ground_motion(
        Series(rng.normal(size=610), RATE_HZ), MASS, "velocity", band_hz=(0.5, 4.0)
    )
    assert "too short for a spectrum" in labels(ground_figure({"x": short}, MASS))
    with pytest.raises(ValueError, match="nothing to plot"):
        ground_figure({}, MASS)
    t = np.arange(1000) / RATE_HZ
    swing = 50 * np.exp(-t / 10) * np.cos(np.pi * t) + rng.normal(size=1000)
    assert "reading less" in labels(ring_down_figure(ring_down(Series(swing, RATE_HZ))))
