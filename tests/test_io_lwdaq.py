"""LWDAQ: the header of its images, its lines of results, and what of a pose they hold."""

from __future__ import annotations

import dataclasses
import io
import json
import math

import numpy as np
import pytest
from typer.testing import CliRunner

from rasnik import analyse, load_system
from rasnik.analysis.flags import Flag
from rasnik.analysis.pose import Pose
from rasnik.cli import app
from rasnik.imaging.projection import Projection
from rasnik.io.images import iter_frames
from rasnik.io.lwdaq import lwdaq_bounds, lwdaq_text, with_lwdaq_header, write_lwdaq_image
from rasnik.io.lwdaq_results import (
    LWDAQ_FIELDS,
    LwdaqResult,
    LwdaqWriter,
    parse_lwdaq_line,
    read_lwdaq_results,
)
from rasnik.io.results import read_results

HEIGHT, WIDTH = 40, 100
GREY = np.random.default_rng(5).integers(1, 250, (HEIGHT, WIDTH)).astype(np.uint8)
# As LWDAQ prints it: name, then x, y, magnifications, rotation, error, field, pixel, orientation,
# reference point, skews, slant.
LINE = (
    "Rasnik_1 32535.26 24236.70 0.469865 0.470852 8.532 0.551 120.0 10.0 4 1720.0 1220.0 "
    "0.510 -0.120 1.114"
)
OLD_LINE = "32535.26 24236.70 0.469865 0.470852 8.532 0.551 120.0 10.0 4 2 1720.0 1220.0"


def run(*arguments: object, status: int = 0):
    result = CliRunner().invoke(app, [str(argument) for argument in arguments])
    assert result.exit_code == status, result.output
    return result


# ------------------------------------------------------------------------ images


@pytest.mark.parametrize("suffix", [".png", ".gif", ".daq"])
def test_a_written_image_comes_back_with_bounds_and_text(tmp_path, suffix):
    path = tmp_path / f"a{suffix}"
    write_lwdaq_image(path, GREY, (5, 2, 90, 30), "Sensor 12, 14 C")
    (frame,) = iter_frames([tmp_path])
    assert frame.image is not None
    np.testing.assert_array_equal(frame.image[1:], GREY[1:])
    assert lwdaq_bounds(frame.image) == (5, 2, 90, 30)
    assert lwdaq_text(frame.image) == "Sensor 12, 14 C"
    assert frame.bounds_px == (5, 2, 90, 30)
    assert frame.header_rows == 1
    assert "its text: Sensor 12, 14 C" in frame.notes


def test_the_header_has_the_layout_of_lwdaq():
    # j_max, i_max, top, left, bottom, right as big-endian 16-bit numbers, a text, a zero
    row = with_lwdaq_header(GREY, (5, 2, 90, 30), "ab")[0]
    assert bytes(row[:15]) == b"\x00\x27\x00\x63\x00\x02\x00\x05\x00\x1e\x00\x5aab\x00"


def test_without_bounds_everything_below_the_header():
    assert lwdaq_bounds(with_lwdaq_header(GREY)) == (0, 1, WIDTH - 1, HEIGHT - 1)
    assert lwdaq_text(with_lwdaq_header(GREY)) == ""


def test_a_long_text_is_cut_off_at_the_end_of_the_row():
    image = with_lwdaq_header(GREY, text="x" * 500)
    assert lwdaq_text(image) == "x" * (WIDTH - 13)
    np.testing.assert_array_equal(image[1:], GREY[1:])


def test_pixels_after_the_numbers_are_no_text():
    image = with_lwdaq_header(GREY)
    image[0, 12:] = 200
    assert lwdaq_text(image) == ""
    image[0, 12:] = 65  # readable, but without an end
    assert lwdaq_text(image) == ""
    assert lwdaq_text(GREY) == ""


@pytest.mark.parametrize(
    ("image", "options", "message"),
    [
        (GREY.astype(np.uint16), {}, "8-bit grey levels, not uint16"),
        (GREY[:1], {}, "2 to 32768 rows"),
        (GREY[:, :12], {}, "13 to 32768 columns"),
        (GREY, {"bounds_px": (0, 0, 9, 9)}, "do not lie below row 0"),
        (GREY, {"bounds_px": (0, 1, WIDTH, 9)}, "do not lie below row 0"),
        (GREY, {"text": "20 °C"}, "must be ASCII"),
    ],
)
def test_what_cannot_be_in_a_header(image, options, message):
    with pytest.raises(ValueError, match=message):
        with_lwdaq_header(image, **options)


def test_a_daq_file_is_the_pixels_and_nothing_else(tmp_path):
    path = tmp_path / "a.daq"
    write_lwdaq_image(path, GREY, text="ab")
    assert path.read_bytes() == with_lwdaq_header(GREY, text="ab").tobytes()
    for content in (path.read_bytes()[:-1], path.read_bytes() + b"x", b"\0"):
        path.write_bytes(content)
        (frame,) = iter_frames([path])
        assert frame.image is None
        assert "truncated" in (frame.error or "")


def test_other_suffixes(tmp_path):
    with pytest.raises(ValueError, match=r"ends in one of \.png, \.gif, \.daq"):
        write_lwdaq_image(tmp_path / "a.jpg", GREY)


# ------------------------------------------------------------------------ lines


def test_a_line_of_lwdaq():
    name, result = parse_lwdaq_line(LINE + "\n")
    assert name == "Rasnik_1"
    assert isinstance(result, LwdaqResult)
    assert result.x_um == 32535.26
    assert result.orientation == 4
    assert result.reference_y_um == 1220.0
    assert result.slant_mrad == 1.114
    assert f"{name} {result.text()}" == LINE


def test_an_older_line_has_a_reference_code_and_no_skew():
    name, result = parse_lwdaq_line(f"2009 03 01 {OLD_LINE}")
    assert name == "2009 03 01"
    assert isinstance(result, LwdaqResult)
    assert (result.reference_x_um, result.reference_y_um) == (1720.0, 1220.0)
    assert (result.skew_x_rad_per_m, result.skew_y_rad_per_m, result.slant_mrad) == (0, 0, 0)


def test_failures_are_sentences():
    assert parse_lwdaq_line("ERROR: Rasnik analysis failed.") == ("", "Rasnik analysis failed.")
    assert parse_lwdaq_line("Tower_3 ERROR: No image.") == ("Tower_3", "No image.")


@pytest.mark.parametrize(
    "line",
    [
        "",
        "Cycle 12 finished",
        LINE.replace(" 4 ", " 7 "),
        LINE.replace("0.469865", "0.000000"),
        LINE.replace("32535.26", "nan"),
        LINE.rsplit(" ", 2)[0],
        LINE + " V",
    ],
)
def test_other_lines_are_refused(line):
    with pytest.raises(ValueError, match="no line of results of LWDAQ"):
        parse_lwdaq_line(line)


def i_from_p(result: LwdaqResult, x: float, y: float) -> tuple[float, float]:
    """Place on the image, in um from the reference point, of a point of LWDAQ's pattern.

    The pattern has its axes right and down and squares of size 1; here its origin is the
    reference point. The steps are those that transforms.pas describes: turn, magnify, slant
    both axes by half the angle, and let the scale change along the image.
    """
    c, s = math.cos(result.rotation_mrad / 1e3), math.sin(result.rotation_mrad / 1e3)
    turned = (x * c + y * s, -x * s + y * c)
    right = turned[0] * result.square_um * result.magnification_x
    down = turned[1] * result.square_um * result.magnification_y
    half = result.slant_mrad / 2e3
    u = math.cos(half) * right + math.sin(half) * down
    v = math.sin(half) * right + math.cos(half) * down
    # from (u, v) / (1 + skew . (u', v')) = known: to first order in the skew
    skew = (result.skew_x_rad_per_m * u + result.skew_y_rad_per_m * v) / 1e6
    return u / (1 - skew), v / (1 - skew)


SIGNS = {1: (+1, +1), 2: (-1, +1), 3: (+1, -1), 4: (-1, -1)}  # mask x right, mask y up


@pytest.mark.parametrize("orientation", [1, 2, 3, 4])
def test_the_pose_sees_the_mask_where_lwdaq_does(orientation, rng):
    for _ in range(20):
        result = LwdaqResult(
            x_um=rng.uniform(0, 1e5), y_um=rng.uniform(0, 1e5),
            magnification_x=rng.uniform(0.2, 2), magnification_y=rng.uniform(0.2, 2),
            rotation_mrad=rng.uniform(-1500, 1500), error_um=0.3, square_um=120.0, pixel_um=10.0,
            orientation=orientation, reference_x_um=1720.0, reference_y_um=1220.0,
            skew_x_rad_per_m=rng.uniform(-5, 5), skew_y_rad_per_m=rng.uniform(-5, 5),
            slant_mrad=rng.uniform(-300, 300),
        )  # fmt: skip
        pose = result.pose()
        assert pose.ok
        assert pose.projection is not None
        x, y = rng.uniform(-5, 5, 2)
        u, v = i_from_p(result, x, y)
        on_mask = pose.projection.to_mask(u, v)
        right, up = SIGNS[orientation]
        # pattern y is down, mask y may be up
        expected = (result.x_um + right * x * 120, result.y_um - up * y * 120)
        np.testing.assert_allclose(on_mask, expected, rtol=0, atol=1e-6)


def test_round_trip_through_a_pose(rng):
    for orientation in (1, 2, 3, 4):
        result = dataclasses.replace(
            parse_lwdaq_line(LINE)[1],
            orientation=orientation,
            rotation_mrad=rng.uniform(-1400, 1400),
            slant_mrad=rng.uniform(-60, 60),
        )
        pose = result.pose()
        shape = (244, 344)
        again = LwdaqResult.from_pose(pose, square_um=120.0, pixel_um=10.0, shape=shape)
        for name, _ in LWDAQ_FIELDS:
            assert getattr(again, name) == pytest.approx(getattr(result, name), rel=1e-9, abs=1e-9)


def pose_of(theta_rad: float, orientation: int, projection: Projection | None = None) -> Pose:
    covariance = np.diag([0.03**2, 0.04**2, 1e-10, 1e-10])
    return Pose(
        ok=True, x_um=500.0, y_um=700.0, scale=0.8, theta_rad=theta_rad, orientation=orientation,
        covariance=covariance, projection=projection,
    )  # fmt: skip


def test_a_similarity_needs_no_projection():
    result = LwdaqResult.from_pose(pose_of(0.1, 3), square_um=85, pixel_um=7, shape=(20, 30))
    assert result.magnification_x == pytest.approx(0.8, rel=1e-12)
    assert result.magnification_y == pytest.approx(0.8, rel=1e-12)
    assert result.rotation_mrad == pytest.approx(100.0, rel=1e-12)
    assert result.error_um == pytest.approx(math.sqrt((0.03**2 + 0.04**2) / 2))
    assert (result.reference_x_um, result.reference_y_um) == (105.0, 70.0)
    assert result.text().endswith("0.000 0.000 0.000")
    back = result.pose()
    assert back.model == "similarity"
    assert (back.scale, back.theta_rad) == (pytest.approx(0.8), pytest.approx(0.1))
    assert math.isnan(back.sigma_scale)


def test_beyond_a_quarter_turn_it_is_the_other_orientation():
    result = LwdaqResult.from_pose(pose_of(3.0, 1), square_um=85, pixel_um=7, shape=(20, 30))
    assert result.orientation == 4
    assert result.rotation_mrad == pytest.approx(1e3 * (3.0 - math.pi))


def test_the_reference_point_is_carried_to_the_centre():
    # LWDAQ's reference code 0: the corner of the image, 1720 um right and 1220 um down of which
    # is the centre of 344 x 244 pixels of 10 um.
    result = dataclasses.replace(
        parse_lwdaq_line(LINE)[1],
        **{"reference_x_um": 0.0, "reference_y_um": 0.0, "skew_x_rad_per_m": 0.0},
        **{"skew_y_rad_per_m": 0.0, "slant_mrad": 0.0, "rotation_mrad": 0.0},
    )
    pose = result.pose((244, 344))  # orientation 4: mask x left, mask y down
    assert pose.x_um == pytest.approx(result.x_um - 1720 / result.magnification_x)
    assert pose.y_um == pytest.approx(result.y_um + 1220 / result.magnification_y)
    assert result.pose().x_um == result.x_um


def test_no_result_without_a_position():
    with pytest.raises(ValueError, match="without a position"):
        LwdaqResult.from_pose(Pose(), square_um=85, pixel_um=7, shape=(2, 3))


# ------------------------------------------------------------------------ LWDAQ's own results


REAL = "benchmark.gif blurred.gif dust.png rotated.gif slanted.png small_squares.gif".split()


@pytest.mark.parametrize("name", REAL)
def test_conventions_are_those_of_lwdaq(name, shared):
    """Our analysis in LWDAQ's terms beside what LWDAQ found on the same image.

    Tolerances: the position as in test_analyse.py; magnifications to the 1.2 % and angles to a
    few mrad that LWDAQ's own systematic errors reach, more where the mask is tilted or blurred,
    since LWDAQ states them near the middle of its bounds. A wrong sign would show: the angles
    that matter are 28, -71, -12 and 9 mrad, the slant -40.
    """
    row = next(
        entry
        for entry in json.loads(shared("real/reference.json").read_text())
        if entry["file"] == f"Rasnik_{name}"
    )
    (frame,) = iter_frames([shared("real") / row["file"]])
    assert frame.bounds_px is not None
    assert frame.image is not None
    pose = analyse(
        frame.image, field_um=row["field_um"], pixel_um=row["pixel_um"], bounds=frame.bounds_px
    )
    found = LwdaqResult.from_pose(
        pose, square_um=row["field_um"], pixel_um=row["pixel_um"], shape=frame.image.shape
    )
    pixel_on_mask = row["pixel_um"] / row["magnification_x"]
    assert abs(found.x_um - row["x_um"]) < row["agreement_um"] + 0.2 * pixel_on_mask
    assert abs(found.y_um - row["y_um"]) < row["agreement_um"] + 0.2 * pixel_on_mask
    assert found.orientation == row["orientation"]
    assert found.magnification_x == pytest.approx(row["magnification_x"], rel=0.012)
    assert found.magnification_y == pytest.approx(row["magnification_y"], rel=0.012)
    assert found.rotation_mrad == pytest.approx(row["rotation_mrad"], abs=3)
    assert found.slant_mrad == pytest.approx(row["slant_mrad"], abs=10)


# ------------------------------------------------------------------------ files


def test_an_archive_with_bad_lines(tmp_path):
    path = tmp_path / "results.txt"
    path.write_text(f"{LINE}\n\nCycle 2\nERROR: b.gif: Rasnik analysis failed.\n{OLD_LINE}\n")
    first, second, third, fourth = read_lwdaq_results(path)
    assert (first["file"], first["frame"], first["ok"]) == ("Rasnik_1", 0, True)
    assert first["notes"][0] == "field 120 um, pixel 10 um"
    assert first["method"] == "lwdaq"
    assert first["sigma_x_um"] == 0.551
    assert first["sigma_scale"] is None
    assert first["scale"] == pytest.approx(math.sqrt(0.469865 * 0.470852), rel=1e-6)
    assert not second["ok"]
    assert "line 3: this is no line of results" in second["error"]
    assert (third["file"], third["error"]) == ("b.gif", "Rasnik analysis failed.")
    assert (fourth["file"], fourth["frame"], fourth["ok"]) == (str(path), 4, True)
    assert read_results(path)["ok"].tolist() == [True, False, False, True]


def test_a_file_of_anything_else(tmp_path):
    path = tmp_path / "results.txt"
    path.write_text("Dear all,\nplease find\n")
    with pytest.raises(ValueError, match="no line of this file is a result of LWDAQ"):
        read_results(path)


def test_the_writer_names_the_failed():
    text = io.StringIO()
    with LwdaqWriter(text, square_um=85.0, pixel_um=6.9) as writer:
        writer.write("a b.png", pose_of(0.01, 4), (240, 320))
        writer.write("c.png", Pose(flags=Flag.NO_MASK), (240, 320))
        writer.write("d.png", None, (0, 0), "d.png: no such file.")
    first, second, third = text.getvalue().splitlines()
    name, result = parse_lwdaq_line(first)
    assert name == "a_b.png"
    assert isinstance(result, LwdaqResult)
    assert result.rotation_mrad == 10.0
    assert second.startswith("ERROR: c.png: No chess pattern")
    assert third == "ERROR: d.png: no such file."


# ------------------------------------------------------------------------ commands

SIZE = ("--set", "sensor.width_px=320", "--set", "sensor.height_px=240")
SYSTEM = ("--system", "solidras", *SIZE)


@pytest.fixture(scope="module")
def simulated(tmp_path_factory):
    folder = tmp_path_factory.mktemp("lwdaq") / "sim"
    run("simulate", "solidras", *SIZE, "-n", 2, "--seed", 1, "--format", "lwdaq", "-o", folder)
    return folder


def test_simulated_images_carry_header_and_truth(simulated):
    truth = json.loads((simulated / "truth.json").read_text())
    frames = list(iter_frames([simulated]))
    assert len(frames) == 2
    system = load_system("solidras", ["sensor.width_px=320", "sensor.height_px=240"])
    for frame, pose in zip(frames, truth["frames"], strict=True):
        assert frame.image is not None
        assert frame.bounds_px == (0, 1, 319, 239)
        _, result = parse_lwdaq_line(lwdaq_text(frame.image))
        assert isinstance(result, LwdaqResult)
        assert result.x_um == pytest.approx(pose["x_um"], abs=0.005)
        assert result.pixel_um == system.pitch_um
        assert result.square_um == system.mask.field_um


def test_images_of_more_than_8_bits_have_no_header(tmp_path):
    options = ("--set", "sensor.bit_depth=12", "--format", "lwdaq", "-o", tmp_path / "sim")
    result = run("simulate", "solidras", *SIZE, *options, status=2)
    assert "8-bit grey levels" in " ".join(result.stderr.split())


def test_lines_on_the_output_and_from_them_a_table(simulated, tmp_path):
    lines = run("analyse", simulated, *SYSTEM, "--lwdaq").stdout
    path = tmp_path / "lines.txt"
    run("analyse", simulated, *SYSTEM, "-o", path)
    assert path.read_text() == lines
    run("export", path, "-o", tmp_path / "table.parquet")
    run("analyse", simulated, *SYSTEM, "-o", tmp_path / "all.h5")
    table, full = read_results(tmp_path / "table.parquet"), read_results(tmp_path / "all.h5")
    np.testing.assert_allclose(table["x_um"], full["x_um"], rtol=0, atol=6e-6)
    np.testing.assert_allclose(table["y_um"], full["y_um"], rtol=0, atol=6e-6)
    np.testing.assert_allclose(table["scale"], full["scale"], rtol=0, atol=1e-9)
    np.testing.assert_allclose(table["theta_rad"], full["theta_rad"], rtol=0, atol=1e-9)
    np.testing.assert_array_equal(table["orientation"], full["orientation"])
    assert table["file"].tolist() == full["file"].tolist()


def test_one_output_only(simulated):
    result = run("analyse", simulated, *SYSTEM, "--lwdaq", "--json", status=2)
    assert "exclude each other" in result.stderr


def test_results_are_not_exported_to_lwdaq(simulated, tmp_path):
    run("analyse", simulated, *SYSTEM, "-o", tmp_path / "a.csv")
    result = run("export", tmp_path / "a.csv", "-o", tmp_path / "a.txt", status=2)
    assert "rasnik analyse writes them" in " ".join(result.stderr.split())
