"""miniSEED and StationXML: what obspy reads is what was measured, and its response is ours."""

from __future__ import annotations

import math
import sys
from dataclasses import replace
from datetime import UTC, datetime

import numpy as np
import pytest

from rasnik import Track, load_system
from rasnik.characterisation.gaps import Series
from rasnik.io import TrackWriter, write_track
from rasnik.io.seed_codes import Direction, Site, band_code, channel_code
from rasnik.io.seismic_files import (
    SeismicChannel,
    channels_of,
    read_miniseed,
    to_stream,
    write_miniseed,
)
from rasnik.io.station_xml import (
    counts_per_metre,
    exposure_filter,
    to_inventory,
    write_station_xml,
)
from rasnik.seismic.ground import ground_motion, taper_corners
from rasnik.seismic.suspension import Suspension
from test_cli import rasnik, refused

pytest.importorskip("obspy", reason="needs obspy")

START_S = 1_790_000_000.123456
RATE_HZ = 20.0
SITE = Site("RAS1", latitude_deg=52.36, longitude_deg=4.95, elevation_m=-2.0, depth_m=10.0)
MASS = Suspension(frequency_hz=0.8, q=2.0)


def series_of(values, **changes) -> Series:
    return Series(np.asarray(values, float), RATE_HZ, "x_um", "nm", START_S, **changes)


def channel(values, **changes) -> SeismicChannel:
    return SeismicChannel(SITE, series_of(values), **{"direction": Direction(90.0), **changes})


def track_of(n=400, start_s=START_S, missing=()) -> Track:
    """x and y of known values; frames that are `missing` never arrived."""
    keep = np.setdiff1d(np.arange(n), missing)
    columns = {
        name: np.full(len(keep), 1.0)
        for name in ("scale", "theta_rad", "chi2_ndf", "blur_um", "dark_level", "light_level")
    } | {
        f"sigma_{name}": np.full(len(keep), 1e-3) for name in ("x_um", "y_um", "scale", "theta_rad")
    }
    return Track(
        frame=keep,
        time_s=start_s + keep / RATE_HZ,
        x_um=4000 + np.sin(keep / 7),
        y_um=5000 + np.cos(keep / 9),
        flags=np.zeros(len(keep)),
        **columns,
    )


# ------------------------------------------------------------------------ names


@pytest.mark.parametrize(
    ("rate_hz", "corner_s", "code"),
    [(275, 2, "D"), (275, 20, "C"), (100, 2, "E"), (100, 10, "H"), (20, 2, "S"), (20, 30, "B"),
     (5, 2, "M"), (1, 2, "L"), (0.1, 100, "V"), (0.01, 1e3, "U"), (2000, 1, "G")],
)  # fmt: skip
def test_band_codes_of_the_manual(rate_hz, corner_s, code):
    assert band_code(rate_hz, corner_s) == code


def test_rate_without_a_band_code():
    with pytest.raises(ValueError, match="no band code for 6000 samples/s"):
        band_code(6000, 1)


@pytest.mark.parametrize(
    ("direction", "letter"),
    [(Direction(4), "N"), (Direction(184), "N"), (Direction(86), "E"), (Direction(0, -90), "Z"),
     (Direction(33, 87), "Z"), (Direction(6), "2"), (Direction(45), "2"), (None, "2")],
)  # fmt: skip
def test_orientation_within_five_degrees(direction, letter):
    assert channel_code(100, 0.05, direction, 2) == f"HH{letter}"


def test_without_a_mass_it_is_no_seismometer():
    assert channel_code(100, None, Direction(0), 1) == "HBN"


@pytest.mark.parametrize(
    ("wrong", "sentence"),
    [
        ({"station": "ras1"}, "station code 'ras1' should be one to five capital"),
        ({"station": "RASNIK"}, "station code 'RASNIK'"),
        ({"network": ""}, "network code ''"),
        ({"location": "0"}, "location code '0' should be two"),
        ({"latitude_deg": 91.0}, "latitude_deg = 91 should be from -90"),
        ({"elevation_m": math.nan}, "elevation_m = nan should be a number of metres"),
    ],
)
def test_wrong_names_are_refused(wrong, sentence):
    with pytest.raises(ValueError, match=sentence):
        Site(**{"station": "RAS1", **wrong})
    with pytest.raises(ValueError, match="azimuth is 0 to 360"):
        Direction(361)
    with pytest.raises(ValueError, match="dip is -90"):
        Direction(0, 91)


# ------------------------------------------------------------------------ miniSEED


def test_miniseed_holds_every_bit_and_every_gap(tmp_path, rng):
    values = 4e6 + rng.normal(0, 100, 1000)
    values[300:310] = np.nan
    values[0] = np.nan
    path = tmp_path / "a.mseed"
    write_miniseed([channel(values)], path)
    stream = obspy_read(path)
    assert [trace.stats.npts for trace in stream] == [299, 690]
    assert abs(stream[0].stats.starttime.timestamp - (START_S + 1 / RATE_HZ)) < 1e-6
    assert abs(stream[1].stats.starttime.timestamp - (START_S + 310 / RATE_HZ)) < 1e-6
    np.testing.assert_allclose(stream[1].data, values[310:] * 1e-9, rtol=1e-15)  # metres
    (back,) = read_miniseed(path, metres_per_count=1.0)
    assert back.name == "XX.RAS1..BBE" and back.unit == "nm" and back.rate_hz == RATE_HZ
    np.testing.assert_allclose(back.values, values[1:], rtol=1e-15)


def obspy_read(path):
    from obspy import read

    return read(str(path))


def test_counts_are_rounded_to_the_stated_step(tmp_path, rng):
    values = 4e6 + rng.normal(0, 100, 1000)
    one = channel(values, encoding="STEIM2", count_nm=0.05)
    write_miniseed([one], tmp_path / "a.mseed")
    write_station_xml([one], tmp_path / "a.xml")
    assert obspy_read(tmp_path / "a.mseed")[0].data.dtype == np.int32
    inventory = read_inventory(tmp_path / "a.xml")
    assert counts_per_metre(inventory, one.identifier, time_of(START_S)) == pytest.approx(
        1e9 / 0.05
    )
    (back,) = read_miniseed(tmp_path / "a.mseed", inventory)
    error = back.values - values
    assert np.abs(error).max() <= 0.025 * 1.000001
    assert error.std() == pytest.approx(0.05 / math.sqrt(12), rel=0.1)


def time_of(seconds):
    from obspy import UTCDateTime

    return UTCDateTime(seconds)


def read_inventory(path):
    from obspy import read_inventory as read

    return read(str(path))


def test_counts_that_do_not_fit_say_which_do():
    with pytest.raises(
        ValueError, match=r"too large for counts of 0\.001 nm .* take counts of (\S+)"
    ) as caught:
        channel([4e6, 4e6], encoding="STEIM2", count_nm=1e-3).samples()
    step = float(str(caught.value).split("take counts of ")[1].split()[0])
    channel([4e6, 4e6], encoding="STEIM2", count_nm=step).samples()
    with pytest.raises(ValueError, match="too large"):  # a step of more than 30 bits
        channel([-9e6, 9e6], encoding="STEIM2", count_nm=0.01).samples()


def test_camera_on_the_mass_turns_the_sign_round():
    values = np.arange(10.0)
    for on_mass, sign in (("mask", 1), ("camera", -1)):
        mass = MASS.model_copy(update={"on_mass": on_mass})
        (trace,) = to_stream([channel(values, suspension=mass)])
        np.testing.assert_allclose(trace.data, sign * values * 1e-9)


def test_channels_of_a_track():
    track = track_of(missing=[5, 6])
    x, y = channels_of(track, SITE, {"x_um": Direction(91), "y_um": Direction(0, -90)})
    assert (x.identifier, y.identifier) == ("XX.RAS1..BBE", "XX.RAS1..BBZ")
    assert x.series.missing == 2
    assert [c.code for c in channels_of(track, SITE, suspension=MASS)] == ["SH1", "SH2"]
    with pytest.raises(ValueError, match="two channels are called"):
        channels_of(track, SITE, {"x_um": Direction(0), "y_um": Direction(3)})
    with pytest.raises(ValueError, match="theta_rad is in rad"):
        channels_of(track, SITE, ["theta_rad"])


def test_times_must_be_known_in_utc():
    track = track_of(start_s=0.0)
    with pytest.raises(ValueError, match="not counted from 1970; give the time of its first"):
        channels_of(track, SITE)
    (x,) = channels_of(track, SITE, ["x_um"], start_s=START_S)
    assert x.series.start_s == START_S
    with pytest.raises(ValueError, match="counted from 1970 already"):
        channels_of(track_of(), SITE, start_s=START_S)


@pytest.mark.parametrize(
    ("wrong", "sentence"),
    [
        ({"encoding": "STEIM3"}, "not one of FLOAT64, STEIM2"),
        ({"count_nm": 1.0}, "stores metres"),
        ({"count_nm": -1.0, "encoding": "STEIM2"}, "must be above 0"),
        ({"exposure_s": 0.1}, "does not go with 20 frames/s"),
        ({"code": "bhz"}, "three capital letters"),
    ],
)
def test_wrong_channels_are_refused(wrong, sentence):
    with pytest.raises(ValueError, match=sentence):
        channel([1.0, 2.0], **wrong)


def test_what_cannot_be_written_or_read(tmp_path):
    path = tmp_path / "a.mseed"
    with pytest.raises(ValueError, match="no frame with a position"):
        write_miniseed([channel([np.nan] * 4)], path)
    assert not list(tmp_path.iterdir())  # nothing half written
    with pytest.raises(FileNotFoundError, match="no such file"):
        read_miniseed(path, metres_per_count=1)
    write_miniseed([channel(np.arange(100.0))], path)
    with pytest.raises(FileExistsError, match="exists already"):
        write_miniseed([channel(np.arange(100.0))], path)
    with pytest.raises(ValueError, match="does not say what its numbers mean"):
        read_miniseed(path)
    path.write_bytes(b"no miniSEED at all" * 100)
    with pytest.raises(ValueError, match="this is not miniSEED"):
        read_miniseed(path, metres_per_count=1)


def test_overlaps_and_moved_clocks_are_refused(tmp_path):
    first = channel(np.arange(100.0))
    for shift, sentence in ((50, "overlap"), (200.4, "0.4 of an interval beside")):
        later = replace(first, series=replace(first.series, start_s=START_S + shift / RATE_HZ))
        stream = to_stream([first]) + to_stream([later])
        stream.write(str(tmp_path / "b.mseed"), format="MSEED")
        with pytest.raises(ValueError, match=sentence):
            read_miniseed(tmp_path / "b.mseed", metres_per_count=1)


@pytest.mark.parametrize("with_inventory", [True, False])
def test_a_rate_of_many_digits_survives(tmp_path, with_inventory):
    """miniSEED holds 7 digits: after millions of samples gaps would be misplaced."""
    rate_hz = 274.99834567
    values = np.arange(2_000_000.0)
    values[1_000_000:1_000_005] = values[1_999_000:1_999_500] = np.nan
    one = SeismicChannel(SITE, Series(values, rate_hz, "x_um", "nm", START_S), MASS)
    write_miniseed([one], tmp_path / "a.mseed")
    write_station_xml([one], tmp_path / "a.xml")
    inventory = read_inventory(tmp_path / "a.xml") if with_inventory else None
    size_m = None if with_inventory else 1.0
    (back,) = read_miniseed(tmp_path / "a.mseed", inventory, metres_per_count=size_m)
    assert back.rate_hz == pytest.approx(rate_hz, rel=1e-14 if with_inventory else 1e-9)
    np.testing.assert_allclose(back.values, values, rtol=1e-14)


def test_response_of_another_recording_is_refused(tmp_path):
    write_miniseed([channel(np.arange(9.0), code="BHZ")], tmp_path / "a.mseed")
    slower = Series(np.arange(9.0), 19.9, "x_um", "nm", START_S)
    inventory = to_inventory([replace(channel(np.arange(9.0)), series=slower, code="BHZ")])
    with pytest.raises(ValueError, match="20 samples/s where 19.9 are expected"):
        read_miniseed(tmp_path / "a.mseed", inventory)


def test_integers_without_any_value():
    with pytest.raises(ValueError, match="no frame with a position"):
        to_stream([channel([np.nan] * 4, encoding="STEIM2")])


def test_without_obspy_it_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "obspy", None)
    with pytest.raises(ImportError, match=r'pip install "rasnik\[seismic\]"'):
        to_stream([channel([1.0, 2.0])])


# ------------------------------------------------------------------------ response


@pytest.mark.parametrize("exposure_s", [0.0, 0.02, 0.05])
@pytest.mark.parametrize("on_mass", ["mask", "camera"])
@pytest.mark.parametrize("power", [0, 1, 2])
def test_response_is_that_of_the_suspension(exposure_s, on_mass, power):
    """Against the closed form of the suspension, not its poles."""
    mass = Suspension(frequency_hz=0.8, q=3.0, on_mass=on_mass, coupling=0.9)
    one = channel(
        np.arange(9.0), suspension=mass, exposure_s=exposure_s, encoding="STEIM2", count_nm=0.1
    )
    f_hz = np.array([0.05, 0.3, 0.8, 1.7, 5.0, 9.0])
    response = to_inventory([one])[0][0][0].response
    found = response.get_evalresp_response_for_frequencies(f_hz, ["DISP", "VEL", "ACC"][power])
    s = 2j * np.pi * f_hz
    w0 = 2 * np.pi * 0.8
    expected = (
        0.9 * s ** (2 - power) / (s**2 + s * w0 / 3 + w0**2) * 1e10 * np.sinc(f_hz * exposure_s)
    )
    np.testing.assert_allclose(found, expected, rtol=2e-4)


def test_without_a_mass_the_response_is_flat():
    one = channel(np.arange(9.0))
    response = to_inventory([one])[0][0][0].response
    found = response.get_evalresp_response_for_frequencies(np.array([0.01, 1, 9]), "DISP")
    np.testing.assert_allclose(found, 1, rtol=1e-6)


@pytest.mark.parametrize("frames", [0.1, 0.5, 0.9, 1.0])
def test_filter_of_the_exposure(frames):
    half = exposure_filter(frames)
    whole = np.concatenate([half, half[-2::-1]])
    assert whole.sum() == pytest.approx(1, abs=1e-12)
    nu = np.linspace(0, 0.45, 500)
    k = np.arange(len(whole)) - len(half) + 1
    response = np.exp(-2j * np.pi * np.outer(nu, k)) @ whole
    np.testing.assert_allclose(response, np.sinc(nu * frames), atol=2e-4)


@pytest.mark.parametrize(
    ("output", "quantity"), [("DISP", "displacement"), ("VEL", "velocity"), ("ACC", "acceleration")]
)
@pytest.mark.parametrize("on_mass", ["mask", "camera"])
def test_remove_response_of_obspy_gives_the_ground(tmp_path, rng, output, quantity, on_mass):
    """Files on disk, a motion known in closed form, and our own ground motion of the same."""
    mass = Suspension(frequency_hz=0.8, q=2.0, on_mass=on_mass)
    n, band_hz = 8000, (0.2, 5.0)
    f_hz = np.fft.rfftfreq(n, 1 / RATE_HZ)
    spectrum = np.where((f_hz > 0.3) & (f_hz < 4), rng.normal(size=(2, len(f_hz))), 0)
    spectrum = spectrum[0] + 1j * spectrum[1]
    s = 2j * np.pi * f_hz
    power = {"DISP": 0, "VEL": 1, "ACC": 2}[output]
    ground = np.fft.irfft(spectrum * s**power, n)
    # r'' + w0 / Q r' + w0^2 r = -x_g'', and a mask on the mass reads -r
    w0 = 2 * np.pi * 0.8
    relative = -(s**2) / (s**2 + s * w0 / 2 + w0**2)
    reading = (-1 if on_mass == "mask" else 1) * np.fft.irfft(spectrum * relative, n)
    one = channel(4e6 + reading, suspension=mass)
    write_miniseed([one], tmp_path / "a.mseed")
    write_station_xml([one], tmp_path / "a.xml")
    stream = obspy_read(tmp_path / "a.mseed")
    stream.remove_response(
        read_inventory(tmp_path / "a.xml"),
        output=output,
        pre_filt=taper_corners(band_hz, RATE_HZ),
        water_level=None,
        taper_fraction=0.02,
    )
    inside = slice(n // 8, -n // 8)
    found = 1e9 * stream[0].data
    assert (found - ground)[inside].std() < 2e-3 * ground.std()
    own = ground_motion(one.series, mass, quantity, band_hz=band_hz)
    assert (found - own.values)[inside].std() < 2e-3 * ground.std()


def test_place_and_names_in_the_station_xml(tmp_path):
    channels = channels_of(
        track_of(), SITE, {"x_um": Direction(35), "y_um": Direction(360, -90)}, suspension=MASS
    )
    write_station_xml(channels, tmp_path / "a.xml")
    with pytest.raises(FileExistsError, match="exists already"):
        write_station_xml(channels, tmp_path / "a.xml")
    from obspy.io.stationxml.core import validate_stationxml

    inventory = read_inventory(tmp_path / "a.xml")
    (network,) = inventory
    (station,) = network
    assert (network.code, station.code) == ("XX", "RAS1")
    assert (station.latitude, station.longitude, station.elevation) == (52.36, 4.95, -2.0)
    assert [(c.code, c.azimuth, c.dip) for c in station] == [("SH1", 35, 0), ("SHZ", 0, -90)]
    # The schema wants azimuths below 360, and the elevation of the sensor, not of the ground.
    assert validate_stationxml(str(tmp_path / "a.xml")) == (True, ())
    assert (station[0].elevation, station[0].depth) == (-12, 10)
    assert "0.8 Hz, Q 2" in station[0].sensor.description
    with pytest.raises(ValueError, match="does not describe XX.RAS2..SHZ"):
        counts_per_metre(inventory, "XX.RAS2..SHZ", time_of(START_S))


def test_station_xml_that_cannot_be():
    with pytest.raises(ValueError, match="needs the place of station RAS1"):
        to_inventory([replace(channel([1.0, 2.0]), site=Site("RAS1"))])
    other = replace(channel([1.0, 2.0]), site=replace(SITE, latitude_deg=1.0))
    with pytest.raises(ValueError, match="not at one place"):
        to_inventory([channel([1.0, 2.0]), other])
    loss = MASS.model_copy(update={"damping": "structural"})
    with pytest.raises(ValueError, match="structural damping has no poles"):
        to_inventory([channel([1.0, 2.0], suspension=loss)])


# ------------------------------------------------------------------------ rasnik export


def test_export_writes_both_files(tmp_path):
    write_track(track_of(missing=[7]), tmp_path / "track.csv")
    (tmp_path / "mass.toml").write_text("[suspension]\nfrequency_hz = 0.8\nq = 2.0\n")
    command = ("export", tmp_path / "track.csv", "-o", tmp_path / "a.mseed", "--station", "RAS1")
    result = rasnik(
        *command, "--suspension", tmp_path / "mass.toml", "--channel", "x=90",
        "--channel", "y=0,-90", "--stationxml", tmp_path / "a.xml", "--place", "52.36,4.95,-2",
    )  # fmt: skip
    assert result.exit_code == 0, result.output
    assert "XX.RAS1..SHE, XX.RAS1..SHZ: 400 frames at 20 Hz, 1 of them missing" in result.stderr
    assert "response written to" in result.stderr
    x, y = read_miniseed(tmp_path / "a.mseed", read_inventory(tmp_path / "a.xml"))
    keep = np.arange(400) != 7
    np.testing.assert_allclose(x.values[keep], 1e3 * track_of(missing=[7]).x_um, rtol=1e-14)
    np.testing.assert_allclose(y.values[keep], 1e3 * track_of(missing=[7]).y_um, rtol=1e-14)
    assert "exists already" in refused(*command)
    camera = ("--frequency", "0.8", "--q", "2", "--on-mass", "camera", "--count-nm", "0.1")
    assert rasnik(*command, "--overwrite", *camera).exit_code == 0
    (trace, *_) = obspy_read(tmp_path / "a.mseed").select(id="XX.RAS1..SH1")
    np.testing.assert_allclose(trace.data[:7], -1e4 * track_of().x_um[:7], atol=0.5)


def test_exposure_of_the_stored_system_is_in_the_response(tmp_path):
    system = load_system("solidras", {"sensor.frame_rate_hz": 20.0, "sensor.exposure_s": 0.04})
    with TrackWriter(tmp_path / "track.h5", system=system) as writer:
        writer.write(track_of())
    options = ("--station", "RAS1", "--stationxml", tmp_path / "a.xml", "--place", "1,2")
    assert (
        rasnik("export", tmp_path / "track.h5", "-o", tmp_path / "a.mseed", *options).exit_code == 0
    )
    response = read_inventory(tmp_path / "a.xml")[0][0][0].response
    found = response.get_evalresp_response_for_frequencies(np.array([5.0]), "DISP")
    np.testing.assert_allclose(np.abs(found), np.sinc(5 * 0.04), rtol=2e-4)


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ((), "needs the code of a station: --station"),
        (("--station", "toolong"), "station code 'toolong' should be"),
        (("--station", "A", "--frequency", "1"), "q is missing: give it, or a file"),
        (("--station", "A", "--frequency", "-1", "--q", "2"), "frequency_hz = -1.0"),
        (("--station", "A", "--stationxml", "x.xml"), "needs the place of the station: --place"),
        (("--station", "A", "--place", "1"), "has 1 numbers"),
        (("--station", "A", "--channel", "x=1", "--channel", "x=2"), "x_um is given twice"),
        (("--station", "A", "--channel", "z"), "'z' is not one of the columns"),
        (("--station", "A", "--start", "noon"), "is not a time such as"),
        (("--station", "A", "--start", "2026-01-01"), "counted from 1970 already"),
        (("--station", "A", "--suspension", "none.toml"), "none.toml: there is no such file"),
        (("--station", "A", "--exposure", "1"), "exposure of 1 s does not go with 20 frames/s"),
        (("--station", "A", "--frame-rate", "20"), "a rate cannot be given as well"),
        (("--station", "A", "--stationxml", "no/x.xml", "--place", "1,2"), "there is no folder no"),
    ],
)
def test_export_says_what_is_wrong(tmp_path, options, sentence):
    write_track(track_of(20), tmp_path / "track.csv")
    message = refused("export", tmp_path / "track.csv", "-o", tmp_path / "a.mseed", *options)
    assert sentence in message
    assert not (tmp_path / "a.mseed").exists()


def test_a_track_without_times_is_given_its_rate(tmp_path):
    track = track_of(20, missing=[7])
    write_track(replace(track, time_s=np.full(len(track), np.nan)), tmp_path / "track.csv")
    command = ("export", tmp_path / "track.csv", "-o", tmp_path / "a.mseed", "--station", "RAS1")
    assert "give the rate" in refused(*command)
    start = ("--start", "2026-11-23T02:10:00")
    assert rasnik(*command, *start, "--frame-rate", "20").exit_code == 0
    x = read_miniseed(tmp_path / "a.mseed", metres_per_count=1)[0]
    assert (x.rate_hz, len(x), x.missing) == (20.0, 20, 1)
    assert x.start_s == datetime(2026, 11, 23, 2, 10, tzinfo=UTC).timestamp()


@pytest.mark.parametrize("frames", [0, 1])
def test_a_track_without_frames_is_no_recording(tmp_path, frames):
    write_track(track_of(frames), tmp_path / "track.csv")
    command = ("export", tmp_path / "track.csv", "-o", tmp_path / "a.mseed", "--station", "RAS1")
    assert f"two frames at least; the track has {frames}." in refused(*command)


def test_options_of_miniseed_belong_to_it(tmp_path):
    write_track(track_of(20), tmp_path / "track.csv")
    target = tmp_path / "a.parquet"
    assert "the options of miniSEED need a name in .mseed" in refused(
        "export", tmp_path / "track.csv", "-o", target, "--station", "RAS1"
    )
    assert "--stationxml" in rasnik("export", "--help").output
