"""Spectra: against other programs, closed forms, and repeated runs for every stated error."""

from __future__ import annotations

import json
import math
import warnings

import numpy as np
import pytest
from scipy import signal

from rasnik import Track, Tracker, bound, load_system, simulate
from rasnik.characterisation.allan import allan
from rasnik.characterisation.floor import noise_floor
from rasnik.characterisation.gaps import Series, aligned, even_series
from rasnik.characterisation.irregular import lomb_scargle
from rasnik.characterisation.lines import find_lines, mains_name
from rasnik.characterisation.spectrum import coherence, logarithmic, welch, window_length
from rasnik.characterisation.track_spectrum import bound_of, track_spectrum
from rasnik.io import write_track
from rasnik.report.spectrum import plot_spectra, shown_unit
from spectrum import RESONANCES, RESONANCES_X, instrument_series, pulls
from test_cli import rasnik, refused

RATE = 275.0
SOLIDRAS = load_system("solidras")


def track_of(x_um, y_um=None, time_s=None, frame=None, **metadata) -> Track:
    """A track of given positions; at 275 Hz unless times are given."""
    n = len(x_um)
    frame = np.arange(n) if frame is None else frame
    same = {
        name: np.full(n, value)
        for name, value in {
            "scale": 1.0, "theta_rad": 0.001, "sigma_x_um": 4e-4, "sigma_y_um": 4e-4,
            "sigma_scale": 2e-7, "sigma_theta_rad": 2e-7, "chi2_ndf": 1.0, "blur_um": 4.5,
            "dark_level": 25.0, "light_level": 252.0, "flags": 0,
        }.items()
    }  # fmt: skip
    return Track(
        frame=frame,
        time_s=frame / RATE if time_s is None else time_s,
        x_um=4000 + np.asarray(x_um),
        y_um=5000 + np.asarray(x_um if y_um is None else y_um),
        metadata=metadata,
        **same,
    )


@pytest.fixture
def noise(rng) -> Series:
    return Series(rng.normal(size=20_000), RATE)


# ------------------------------------------------------------------------ equal to others


@pytest.mark.parametrize("windows", [1, 40, 501])
def test_welch_is_that_of_scipy(noise, windows):
    found = welch(noise, windows=windows)
    frequency_hz, psd = signal.welch(noise.values, RATE, "hann", found.window, found.window // 2)
    assert np.array_equal(found.frequency_hz, frequency_hz)
    assert np.array_equal(found.psd, psd)
    # In whole, even numbers of frames.
    assert found.segments == pytest.approx(windows, rel=0.03)
    assert found.unused < found.window


def test_welch_is_that_of_gwpy(noise):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # gwpy and astropy warn of themselves
        series = pytest.importorskip("gwpy.timeseries", reason="the extra gw is not installed")
        length_s = 512 / RATE
        theirs = series.TimeSeries(noise.values, sample_rate=RATE).asd(
            fftlength=length_s, overlap=length_s / 2, window="hann", method="welch"
        )
    ours = welch(noise, length_s=length_s)
    np.testing.assert_allclose(ours.frequency_hz, theirs.frequencies.value, rtol=1e-12)
    np.testing.assert_allclose(ours.asd, theirs.value, rtol=1e-12)


def test_allan_is_that_of_allantools(noise):
    allantools = pytest.importorskip("allantools", reason="the extra test is not installed")
    frames = np.array([1, 2, 5, 30, 400, 9000])
    drifting = Series(noise.values + 1e-4 * np.arange(len(noise)) + 7, RATE)
    tau_s, deviation, _, count = allantools.oadev(
        drifting.values, rate=RATE, data_type="freq", taus=frames / RATE
    )
    found = allan(drifting, frames)
    np.testing.assert_allclose(found.tau_s, tau_s, rtol=1e-12)
    np.testing.assert_allclose(found.deviation, deviation, rtol=1e-9)
    assert np.array_equal(found.differences, count)


def test_allan_of_allantools_with_gaps(noise):
    allantools = pytest.importorskip("allantools", reason="the extra test is not installed")
    values = noise.values.copy()
    values[[700, 5000, 5001]] = np.nan
    found = allan(Series(values, RATE), np.array([1, 10]))
    runs = [values[:700], values[701:5000], values[5002:]]
    for m, deviation in zip((1, 10), found.deviation, strict=True):
        theirs = [allantools.oadev(run, rate=1.0, data_type="freq", taus=[m])[1][0] for run in runs]
        weights = [len(run) - 2 * m + 1 for run in runs]
        assert deviation == pytest.approx(np.sqrt(np.average(np.square(theirs), weights=weights)))


def test_coherence_is_that_of_scipy(rng):
    common = rng.normal(size=8000)
    one, other = (Series(common + rng.normal(size=8000), RATE) for _ in range(2))
    found = coherence(one, other, length_s=200 / RATE)
    frequency_hz, theirs = signal.coherence(one.values, other.values, RATE, "hann", 200)
    np.testing.assert_allclose(found.coherence, theirs, rtol=1e-9)
    assert np.array_equal(found.frequency_hz, frequency_hz)
    assert found.coherence.mean() == pytest.approx(0.25, abs=0.03)  # half of each is common


def test_lomb_scargle_on_even_times_is_welch(rng):
    track = track_of(rng.normal(size=4096))
    ours = lomb_scargle(track, "x_um", length_s=512 / RATE)
    theirs = welch(even_series(track, "x_um"), length_s=512 / RATE)
    assert ours.segments == theirs.segments
    np.testing.assert_allclose(ours.frequency_hz, theirs.frequency_hz[1:], rtol=1e-9)
    # Means are taken away before the window in both, and sines are orthogonal but near 0 and f/2.
    np.testing.assert_allclose(ours.psd[3:-3], theirs.psd[4:-3], rtol=1e-6)


def test_logarithmic_spectrum_of_white_noise(noise):
    pytest.importorskip("speckit", reason="the extra spectrum is not installed")
    frequency_hz, psd = logarithmic(noise)
    high = frequency_hz > 20
    assert psd[high].mean() == pytest.approx(2 / RATE, rel=0.03)
    assert np.ptp(np.diff(np.log(frequency_hz[high]))) < 0.2
    with pytest.raises(ValueError, match="without gaps, and 1 frames are missing"):
        logarithmic(Series(np.append(noise.values, np.nan), RATE))


# ------------------------------------------------------------------------ conventions


def test_white_noise_lies_at_sigma_sqrt_2_over_f(rng):
    found = welch(Series(rng.normal(0, 3.0, 200_000), RATE))
    assert found.rms() == pytest.approx(3.0, rel=0.01)
    assert np.median(found.asd) == pytest.approx(3 * math.sqrt(2 / RATE), rel=0.01)
    floor = noise_floor(found)
    assert floor.per_frame == pytest.approx(3.0, abs=4 * floor.sigma * math.sqrt(RATE / 2))
    assert floor.as_paper == pytest.approx(floor.asd / math.sqrt(2))


def test_lengths_are_nanometres(rng):
    x_um = rng.normal(0, 1e-3, 4000)
    series = even_series(track_of(x_um), "x_um")
    assert series.unit == "nm"
    np.testing.assert_allclose(series.values - 4e6, 1e3 * x_um, atol=1e-8)
    assert even_series(track_of(x_um), "theta_rad").unit == "rad"
    assert shown_unit("nm", 0.033) == ("pm", pytest.approx(1e3))


def test_cumulative_rms_adds_up_to_the_variance():
    n = 27_500
    sine = 5 * np.sqrt(2) * np.sin(2 * np.pi * 20 * np.arange(n) / RATE)
    found = welch(Series(sine, RATE), length_s=10.0)
    assert found.rms(15, 25) == pytest.approx(5.0, rel=1e-6)
    assert found.cumulative_rms[0] == pytest.approx(5.0, rel=1e-6)
    assert found.cumulative_rms[found.frequency_hz > 25][0] < 1e-6


# ------------------------------------------------------------------------ stated errors


def test_scatter_of_a_bin(rng):
    runs = [welch(Series(rng.normal(size=2000), RATE), windows=9) for _ in range(300)]
    psd = np.array([one.psd[2:-2] for one in runs])
    scatter = float(np.mean(psd.std(axis=0) / psd.mean(axis=0)))
    # 300 runs of some 100 independent bins: a per cent.
    assert scatter == pytest.approx(runs[0].relative_error, rel=0.02)


def test_floor_of_white_noise_and_its_error():
    # Without systematic error the mean pull is 0 as well.
    found = pulls(300, lambda rng: Series(rng.normal(size=20_000), RATE), 2 / RATE)
    assert found.mean() == pytest.approx(0, abs=4 / math.sqrt(300))
    assert found.std() == pytest.approx(1, abs=4 / math.sqrt(600))


@pytest.mark.slow
def test_floor_under_drift_resonances_and_mains_in_half_hours():
    sigma_nm = bound(SOLIDRAS, (4000, 5000, 0.0), rounding=True).sigma_x_nm
    white = sigma_nm**2 * 2 / RATE
    n = 30 * 60 * int(RATE)
    found, relative = pulls(
        40, lambda rng: instrument_series(rng, n, RATE, sigma_nm), white, with_error=True
    )
    assert np.abs(relative).max() < 0.03
    # 200 of them are in benchmarks/spectrum.py; the root of 40 squares is known to 0.11.
    assert math.sqrt(np.mean(found**2)) == pytest.approx(1, abs=0.33)


def test_floors_follow_light_and_rate(rng):
    n = 30 * 60 * int(RATE)
    full = SOLIDRAS
    levels = {
        "sensor.dark_level": full.sensor.dark_level / 2,
        "sensor.light_level": full.sensor.light_level / 2,
    }
    # In the shot-noise limit: nothing but the term B Q.
    quantum = {"sensor.noise_a": 0.0}
    sigmas = [
        bound(load_system("solidras", values), (4000, 5000, 0.0)).sigma_x_nm
        for values in (quantum, quantum | levels)
    ]
    floors = []
    for sigma, rate in ((sigmas[0], RATE), (sigmas[1], RATE), (sigmas[0], 100.0)):
        made = instrument_series(rng, n, rate, sigma, resonances=RESONANCES_X)
        spectrum = welch(made)
        floors.append(noise_floor(spectrum, find_lines(spectrum)))
    asd = np.array([floor.asd for floor in floors])
    errors = np.array([floor.sigma for floor in floors]) / asd
    for k, factor in ((1, math.sqrt(2)), (2, math.sqrt(2.75))):
        ratio, error = asd[k] / asd[0], math.hypot(errors[k], errors[0])
        assert error < 0.015
        assert ratio / factor == pytest.approx(1, abs=4 * error)


def test_floor_of_tracked_frames_is_the_bound():
    size = {"sensor.width_px": 240, "sensor.height_px": 180}
    system = load_system("solidras", size)
    frames = simulate(system, (4000.0, 5000.0, 0.001), n=300, seed=4).frames
    track = Tracker(system).run(frames, np.arange(300) / RATE)
    found = track_spectrum(track, "x_um", windows=8, limit=bound_of(track, system))
    assert found.floor is not None
    # 3 % and the chance of 300 frames, which know a floor to 6 %.
    assert found.floor.asd == pytest.approx(found.bound_asd, abs=3 * found.floor.sigma)
    assert found.floor.sigma < 0.07 * found.floor.asd


@pytest.mark.parametrize("m", [1, 20, 300])
def test_error_of_the_allan_deviation(rng, m):
    found = [allan(Series(rng.normal(size=2000), 1.0), np.array([m])) for _ in range(400)]
    deviation = np.array([one.deviation[0] for one in found])
    assert np.mean(deviation**2) == pytest.approx(1 / m, rel=5 * np.sqrt(m / 2000 / 400) + 0.01)
    assert deviation.std() == pytest.approx(np.mean([one.error[0] for one in found]), rel=0.15)


def test_lines_and_their_errors(rng):
    n, rms, at = 27_500, 0.3, 61.7
    found = []
    for _ in range(100):
        phase = rng.uniform(0, 2 * np.pi)
        sine = rms * np.sqrt(2) * np.sin(2 * np.pi * at * np.arange(n) / RATE + phase)
        lines = find_lines(welch(Series(sine + rng.normal(size=n), RATE)))
        found += [line for line in lines if abs(line.frequency_hz - at) < 0.5]
    assert len(found) == 100
    pull = np.array([(line.rms - rms) / line.rms_error for line in found])
    assert abs(pull.mean()) < 0.5
    assert pull.std() == pytest.approx(1, abs=0.25)
    assert np.std([line.frequency_hz for line in found]) < 0.1
    assert {line.width_hz for line in found} == {0.0}


def test_noise_has_no_lines(rng):
    false = sum(len(find_lines(welch(Series(rng.normal(size=20_000), RATE)))) for _ in range(100))
    assert false <= 2  # 0.1 are expected


# ------------------------------------------------------------------------ names


@pytest.mark.parametrize(
    ("frequency_hz", "rate_hz", "name"),
    [
        (50.01, 275, "mains, 50 Hz"),
        (59.99, 275, "mains, 60 Hz"),
        (100, 275, "mains, 2 x 50 Hz"),
        (120, 275, "mains, 2 x 60 Hz"),
        (25, 275, "alias of 5 x 50 Hz or alias of 5 x 60 Hz"),
        (75, 275, "alias of 4 x 50 Hz"),
        (40, 100, "alias of 60 Hz"),
        (33.3, 275, ""),
        (0.02, 100, ""),  # 2 x 50 Hz on top of the drift
    ],
)
def test_mains_are_named(frequency_hz, rate_hz, name):
    assert mains_name(frequency_hz, rate_hz, 0.05).startswith(name)
    assert bool(mains_name(frequency_hz, rate_hz, 0.05)) == bool(name)


def test_a_resonance_is_not_called_mains(rng):
    values = instrument_series(rng, 100_000, RATE, 1.0, resonances=((50, 60, 2),), mains=())
    (line,) = find_lines(welch(values))
    assert line.width_hz > 0.3
    assert line.name == ""


# ------------------------------------------------------------------------ gaps and times


def test_windows_with_a_missing_frame_are_left_out(noise):
    values = noise.values.copy()
    values[[5000, 5001, 12_345]] = np.nan
    found = welch(Series(values, RATE), length_s=200 / RATE)
    runs = [values[:5000], values[5002:12_345], values[12_346:]]
    each = [signal.welch(run, RATE, "hann", 200)[1] for run in runs]
    counts = [len(run) // 100 - 1 for run in runs]
    np.testing.assert_allclose(found.psd, np.average(each, axis=0, weights=counts), rtol=1e-12)
    assert (found.segments, found.missing) == (sum(counts), 3)
    assert found.left_out == len(values) // 100 - 1 - sum(counts)
    assert found.unused == sum(len(run) % 100 for run in runs)


def test_frames_without_position_and_lost_ones_are_gaps(rng):
    track = track_of(rng.normal(size=1000))
    x_um = track.x_um.copy()
    x_um[100] = np.nan
    track = Track(**(track.as_dict() | {"x_um": x_um}))[np.r_[0:500, 510:1000]]
    series = even_series(track)
    assert (len(series), series.missing, series.rate_hz) == (1000, 11, RATE)
    assert np.isnan(series.values[[100, 500, 509]]).all()
    assert np.isfinite(series.values[[99, 101, 499, 510]]).all()


def test_tracks_without_times(rng):
    track = track_of(rng.normal(size=100), time_s=np.full(100, np.nan))
    with pytest.raises(ValueError, match="neither times nor a frame rate are known"):
        even_series(track)
    assert even_series(track, rate_hz=50.0).rate_hz == 50.0
    for wrong in (0.0, -1.0, np.nan, np.inf):
        with pytest.raises(ValueError, match="frame rate must be a number of hertz above 0, not"):
            even_series(track, rate_hz=wrong)
    known = Track(**track.as_dict(), metadata={"frame_rate_hz": "860.0"})
    assert even_series(known[::2]).rate_hz == 430.0
    with pytest.raises(ValueError, match="have times; a rate cannot be given"):
        even_series(track_of(np.zeros(10)), rate_hz=50.0)


def test_irregular_times_are_refused_or_used(rng):
    n = 6000
    time_s = (np.arange(n) + rng.uniform(-0.3, 0.3, n)) / RATE
    x_um = 1e-3 * rng.normal(size=n) + 5e-4 * np.sin(2 * np.pi * 31 * time_s)
    track = track_of(x_um, time_s=time_s)
    with pytest.raises(ValueError, match="not regular.*Lomb-Scargle"):
        track_spectrum(track)
    found = track_spectrum(track, irregular=True)
    assert found.series is None and found.allan is None
    assert found.spectrum.method == "lomb-scargle"
    assert found.floor.per_frame == pytest.approx(1.0, rel=0.05)
    strongest = max(found.lines, key=lambda line: line.significance)
    assert strongest.frequency_hz == pytest.approx(31, abs=0.3)
    assert strongest.rms == pytest.approx(0.5 / math.sqrt(2), abs=3 * strongest.rms_error)


def test_a_floor_that_does_not_stand_out_is_not_told():
    """A resonance near the Nyquist frequency covers it: the fitted floor came out below zero."""
    rng, rate_hz = np.random.default_rng([5, 60]), 100.0
    sigma = bound(load_system("solidras"), (4000.0, 5000.0, 0.0), rounding=True).sigma_x_nm
    series = instrument_series(rng, 180_000, rate_hz, sigma, resonances=RESONANCES)
    spectrum = welch(series)
    with pytest.raises(ValueError, match="does not stand out"):
        noise_floor(spectrum, find_lines(spectrum))


def test_what_cannot_be_done_is_said(rng):
    series = Series(rng.normal(size=1000), RATE)
    with pytest.raises(ValueError, match="too short for a spectrum"):
        window_length(series, windows=900)
    with pytest.raises(ValueError, match="cannot both be given"):
        welch(series, windows=3, length_s=1.0)
    gappy = series.values.copy()
    gappy[::50] = np.nan
    with pytest.raises(ValueError, match="longest stretch without a missing frame has 49"):
        welch(Series(gappy, RATE), windows=9)
    assert welch(Series(gappy, RATE)).window == 48
    with pytest.raises(ValueError, match="no flat part|free of lines"):
        noise_floor(welch(series, windows=50))
    with pytest.raises(ValueError, match="not one of the columns"):
        even_series(track_of(np.zeros(5)), "speed")


def test_two_tracks_are_aligned_by_their_times(rng):
    values = rng.normal(size=1000)
    one, other = Series(values, RATE), Series(values[100:], RATE, start_s=100 / RATE)
    first, second = aligned(one, other)
    assert np.array_equal(first.values, second.values)
    assert coherence(one, other).coherence[1:-1].min() == pytest.approx(1)
    with pytest.raises(ValueError, match=r"\+0\.40 of an interval"):
        aligned(one, Series(values, RATE, start_s=0.4 / RATE))
    with pytest.raises(ValueError, match="the rates differ"):
        aligned(one, Series(values, 100.0))
    with pytest.raises(ValueError, match="no time in common"):
        aligned(one, Series(values, RATE, start_s=4.0))


# ------------------------------------------------------------------------ the command


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    folder = tmp_path_factory.mktemp("tracks")
    generator = np.random.default_rng(8)
    for name, factor in (("full", 1.0), ("half", math.sqrt(2))):
        x_um, y_um = (
            instrument_series(generator, 30_000, RATE, 0.4 * factor).values / 1e3 for _ in "xy"
        )
        write_track(track_of(x_um, y_um), folder / f"{name}.h5", system=SOLIDRAS)
    return folder


def test_command(files, tmp_path):
    plot, figures = tmp_path / "s.png", tmp_path / "s.json"
    result = rasnik(
        "spectrum", files / "full.h5", files / "half.h5", "--coherence", "-o", plot, "-o", figures
    )
    assert result.exit_code == 0, result.stderr
    for text in ("One-sided", "mains, 50 Hz", "coherence of", "100 windows of"):
        assert text in result.stdout
    assert plot.stat().st_size > 50_000
    document = json.loads(figures.read_text())
    assert [one["track"] for one in document["spectra"]] == ["full", "full", "half", "half"]
    first = document["spectra"][0]
    assert len(first["asd_nm_rthz"]) == len(first["frequency_hz"])
    assert first["floor_over_bound"] == pytest.approx(1.0, abs=0.1)
    assert len(document["coherence"]) == 4


def test_command_in_json(files):
    result = rasnik("spectrum", files / "full.h5", "-c", "x,theta", "--windows", "20", "--json")
    x, theta = json.loads(result.stdout)["spectra"]
    assert (x["column"], theta["column"], x["windows"]) == ("x_um", "theta_rad", 20)
    assert "frequency_hz" not in x
    floor = x["floor"]
    assert floor["asd_nm_rthz"] == pytest.approx(math.sqrt(2) * floor["sigma_over_sqrt_f_nm_rthz"])


def test_command_refuses(files, tmp_path):
    assert "not one of the columns" in refused("spectrum", files / "full.h5", "-c", "z")
    assert "must end in" in refused("spectrum", files / "full.h5", "-o", tmp_path / "a.txt")
    assert "needs two columns" in refused("spectrum", files / "full.h5", "-c", "x", "--coherence")
    assert "too short" in refused("spectrum", files / "full.h5", "--windows", "20000")
    assert "no.h5" in refused("spectrum", tmp_path / "no.h5")


def test_plot_states_the_convention(files, tmp_path):
    from rasnik.io import read_track

    found = track_spectrum(read_track(files / "full.h5"), "x_um", label="full")
    path = tmp_path / "s.svg"
    with warnings.catch_warnings():
        plot_spectra([found], path)
    assert path.stat().st_size > 10_000
    from rasnik.report.spectrum import spectra_figure

    figure = spectra_figure([found])
    assert "One-sided" in figure.get_suptitle()
    assert "pm/√Hz" in figure.axes[0].get_ylabel()
