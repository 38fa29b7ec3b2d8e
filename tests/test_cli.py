"""The command line, run as a user does: what it prints, writes, refuses, and its exit status."""

from __future__ import annotations

import csv
import io
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import tifffile
from PIL import Image
from typer.testing import CliRunner, Result

from rasnik import load_system, simulate
from rasnik.cli import app
from rasnik.io.results import read_results

SIZE = {"sensor.width_px": 320, "sensor.height_px": 240}
SYSTEM = load_system("solidras", SIZE)
INSTRUMENT = ["--system", "solidras", *(a for k, v in SIZE.items() for a in ("--set", f"{k}={v}"))]
SIZES = ["--field-um", "85", "--pixel-um", "6.9"]
# A picture of anything but a mask.
BLOBS = np.kron(np.random.default_rng(1).integers(40, 200, (12, 16)), np.ones((20, 20)))
BLOBS = BLOBS.astype(np.uint8)
POSES = [(10000.0, 7000.0, 0.01), (41000.0, 30200.0, -0.002)]


def rasnik(*arguments: object) -> Result:
    result = CliRunner().invoke(app, [str(argument) for argument in arguments])
    assert result.exception is None or isinstance(result.exception, SystemExit), result.exception
    assert "Traceback" not in result.stdout + result.stderr
    return result


def refused(*arguments: object) -> str:
    """What a command that is not understood says: one sentence, nothing on the output."""
    result = rasnik(*arguments)
    assert result.exit_code == 2
    assert result.stdout == ""
    message = " ".join(result.stderr.split())
    assert message.startswith("rasnik: ")
    return message


@pytest.fixture(scope="module")
def frames() -> list[np.ndarray]:
    return [frame for frame, _ in simulate(SYSTEM, POSES, seed=3)]


@pytest.fixture
def images(tmp_path, frames) -> Path:
    folder = tmp_path / "images"
    folder.mkdir()
    for k, frame in enumerate(frames):
        Image.fromarray(frame).save(folder / f"f{k}.png")
    return folder


# ------------------------------------------------------------------------ analyse: results


def test_table_with_positions_and_errors(images):
    result = rasnik("analyse", images, *INSTRUMENT)
    assert result.exit_code == 0
    assert "f0.png" in result.stdout
    assert "10000.0" in result.stdout or "9999.99" in result.stdout
    assert "2 images: 2 with a position" in result.stdout
    assert result.stderr == ""


def test_the_folder_is_named_once(images):
    output = rasnik("analyse", images, *INSTRUMENT).stdout
    assert output.count(str(images)) == 1
    assert f"images in {images}" in output


def test_json_lines_and_nothing_else(images):
    result = rasnik("analyse", images, *INSTRUMENT, "--json")
    assert result.exit_code == 0
    records = [json.loads(line) for line in result.stdout.splitlines()]
    assert [Path(record["file"]).name for record in records] == ["f0.png", "f1.png"]
    for record, (x_um, y_um, theta_rad) in zip(records, POSES, strict=True):
        assert record["ok"] is True
        assert record["error"] is None
        assert abs(record["x_um"] - x_um) < 6 * record["sigma_x_um"] < 0.02
        assert abs(record["y_um"] - y_um) < 6 * record["sigma_y_um"] < 0.02
        assert abs(record["theta_rad"] - theta_rad) < 6 * record["sigma_theta_rad"] < 1e-4
        assert record["orientation"] == 4


def test_csv_on_the_output(images):
    result = rasnik("analyse", images, *INSTRUMENT, "--csv")
    rows = list(csv.DictReader(io.StringIO(result.stdout)))
    assert [float(row["x_um"]) for row in rows] == pytest.approx([10000, 41000], abs=0.02)


def test_field_and_pixel_size_are_enough(images):
    result = rasnik("analyse", images / "f0.png", *SIZES, "--json")
    record = json.loads(result.stdout)
    assert record["x_um"] == pytest.approx(10000, abs=0.02)
    assert "noise_estimated" in record["flags"]


@pytest.mark.parametrize("suffix", [".h5", ".csv", ".parquet", ".jsonl"])
def test_results_in_a_file(tmp_path, images, suffix):
    path = tmp_path / f"r{suffix}"
    result = rasnik("analyse", images, *INSTRUMENT, "-o", path)
    assert result.exit_code == 0
    assert result.stdout == ""
    assert "results in" in result.stderr
    assert read_results(path)["x_um"] == pytest.approx([10000, 41000], abs=0.02)


def test_stacks_and_patterns(tmp_path, frames):
    np.save(tmp_path / "a.npy", np.stack(frames))
    tifffile.imwrite(tmp_path / "b.tif", np.stack(frames), photometric="minisblack")
    result = rasnik("analyse", f"{tmp_path}/*.*", *INSTRUMENT, "--json")
    records = [json.loads(line) for line in result.stdout.splitlines()]
    assert [record["frame"] for record in records] == [0, 1, 0, 1]
    assert records[0]["x_um"] == records[2]["x_um"]


def test_orientation_of_the_user_is_kept(images):
    result = rasnik("analyse", images / "f0.png", *INSTRUMENT, "--orientation", "1", "--json")
    record = json.loads(result.stdout)
    assert record["orientation"] == 1
    assert abs(record["theta_rad"]) == pytest.approx(np.pi - 0.01, abs=1e-4)


def test_bounds_leave_the_rest_out(images):
    result = rasnik("analyse", images / "f0.png", *INSTRUMENT, "--bounds", "0,0,299,199", "--json")
    record = json.loads(result.stdout)
    assert record["x_um"] == pytest.approx(10000, abs=0.02)
    assert record["masked_fraction"] == pytest.approx(1 - 300 * 200 / (320 * 240), abs=0.01)


def test_overlays_have_names_of_their_own(tmp_path, images, frames):
    (tmp_path / "other").mkdir()
    Image.fromarray(frames[0]).save(tmp_path / "other" / "f0.png")
    folder = tmp_path / "overlays"
    arguments = [images / "f0.png", tmp_path / "other", *SIZES, "--overlay", folder]
    result = rasnik("analyse", *arguments)
    assert result.exit_code == 0
    names = sorted(path.name for path in folder.iterdir())
    assert names == ["f0_overlay.png", "f0_overlay_2.png"]
    assert "overlays in" in result.stdout


# ------------------------------------------------------------------------ analyse: bad images


def test_bad_files_are_told_and_the_others_come_out(tmp_path, images):
    (images / "empty.png").touch()
    (images / "text.png").write_text("no image")
    whole = (images / "f0.png").read_bytes()
    (images / "short.png").write_bytes(whole[: len(whole) // 2])
    result = rasnik("analyse", images, images / "gone.png", *INSTRUMENT, "--json")
    assert result.exit_code == 1
    records = {
        Path(record["file"]).name: record for record in map(json.loads, result.stdout.splitlines())
    }
    assert {name for name, record in records.items() if record["ok"]} == {"f0.png", "f1.png"}
    words = {
        "empty.png": "the file is empty",
        "text.png": "not that of a .png image",
        "short.png": "truncated",
        "gone.png": "no such file",
    }
    for name, text in words.items():
        assert text in records[name]["error"]
        assert name in records[name]["error"]
        assert text in " ".join(result.stderr.split())
    assert "6 images: 2 with a position, 4 without" in result.stderr


@pytest.mark.parametrize(
    ("image", "flag"),
    [
        (np.full((240, 320), 100, dtype=np.uint8), "blank"),
        (np.full((240, 320), 255, dtype=np.uint8), "saturated"),
        (np.random.default_rng(0).integers(0, 256, (240, 320), dtype=np.uint8), "no_mask"),
        (BLOBS, "no_mask"),
    ],
    ids=["blank", "white", "noise", "blobs"],
)
def test_images_without_a_mask_say_so(tmp_path, image, flag):
    Image.fromarray(image).save(tmp_path / "a.png")
    result = rasnik("analyse", tmp_path / "a.png", *SIZES, "--json")
    assert result.exit_code == 1
    record = json.loads(result.stdout)
    assert record["ok"] is False
    assert flag in record["flags"]
    assert record["x_um"] is None
    assert len(record["error"]) > 20


def test_fields_of_too_few_pixels(tmp_path):
    system = load_system(SYSTEM, {"mask.field_um": 15.0, "optics.blur_um": 2.0})
    frame, _ = simulate(system, (2000.0, 1500.0), seed=1)[0]
    Image.fromarray(frame).save(tmp_path / "a.png")
    arguments = ["--field-um", "15", "--pixel-um", "6.9", "--json"]
    result = rasnik("analyse", tmp_path / "a.png", *arguments)
    assert result.exit_code == 1
    assert "fewer than 2.5 pixels" in json.loads(result.stdout)["error"]


def test_a_mask_of_another_code(images):
    """Read with 7 code bits, the 8 of the mask make no sense."""
    arguments = [*INSTRUMENT, "--set", "mask.code_bits=7", "--json"]
    result = rasnik("analyse", images / "f0.png", *arguments)
    assert result.exit_code == 1
    assert "number of code bits" in json.loads(result.stdout)["error"]


def test_failures_show_in_the_table(tmp_path, images):
    Image.fromarray(np.zeros((240, 320), dtype=np.uint8)).save(images / "dark.png")
    result = rasnik("analyse", images, *INSTRUMENT)
    assert result.exit_code == 1
    assert "FAILED, blank" in result.stdout
    assert "3 images: 2 with a position, 1 without" in result.stdout
    assert "no contrast" in result.stderr


def test_an_image_of_another_size_than_the_system(images):
    result = rasnik("analyse", images / "f0.png", "--system", "solidras", "--json")
    assert result.exit_code == 1
    error = json.loads(result.stdout)["error"]
    assert "320 x 240" in error
    assert "720 x 540" in error


def test_nan_pixels_are_left_out(tmp_path, frames):
    image = frames[0].astype(np.float32)
    image[100:110, 100:110] = np.nan
    np.save(tmp_path / "a.npy", image)
    result = rasnik("analyse", tmp_path / "a.npy", *INSTRUMENT, "--json")
    record = json.loads(result.stdout)
    assert record["x_um"] == pytest.approx(10000, abs=0.02)
    assert "not_finite" in record["flags"]
    assert record["notes"] == ["100 of 76800 pixels are NaN or infinite"]


def test_colour_is_converted_and_said(tmp_path, frames):
    colours = np.repeat(frames[0][..., None], 3, axis=2)
    colours[..., 2] //= 2
    Image.fromarray(colours).save(tmp_path / "a.png")
    record = json.loads(rasnik("analyse", tmp_path / "a.png", *SIZES, "--json").stdout)
    assert record["x_um"] == pytest.approx(10000, abs=0.05)
    assert record["notes"] == ["colour converted to grey (Rec. 601 luminance)"]


def test_bounds_beyond_an_image_are_an_error_of_that_image(images):
    result = rasnik("analyse", images / "f0.png", *SIZES, "--bounds", "0,0,400,200", "--json")
    assert result.exit_code == 1
    assert "reach beyond the image" in json.loads(result.stdout)["error"]


def test_a_fault_in_one_frame_leaves_the_others(images, monkeypatch):
    """A fault of the program itself is told as one."""
    import rasnik.analysis.analyse as module

    original = module.analyse
    calls = []

    def broken(image, *arguments, **options):
        calls.append(image)
        if len(calls) == 1:
            raise ZeroDivisionError("division by zero")
        return original(image, *arguments, **options)

    monkeypatch.setattr(module, "analyse", broken)
    result = rasnik("analyse", images, *INSTRUMENT, "--json")
    assert result.exit_code == 1
    first, second = map(json.loads, result.stdout.splitlines())
    assert "unexpected ZeroDivisionError (division by zero); please report it." in first["error"]
    assert second["ok"] is True


def test_ambiguous_images_list_their_candidates(tmp_path):
    """With one pivot in view, several orientations are consistent."""
    system = load_system("solidras", {"sensor.width_px": 150, "sensor.height_px": 150})
    frame, _ = simulate(system, (10000.0 + 300, 7000.0 + 100, 0.0), seed=3)[0]
    Image.fromarray(frame).save(tmp_path / "a.png")
    result = rasnik("analyse", tmp_path / "a.png", *SIZES, "--json")
    record = json.loads(result.stdout)
    assert result.exit_code == 1
    assert "ambiguous" in record["flags"]
    assert len(record["candidates"]) > 1
    table = rasnik("analyse", tmp_path / "a.png", *SIZES)
    assert "candidate: x =" in table.stderr


# ------------------------------------------------------------------------ analyse: wrong usage


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([], "give --system, or --field-um and --pixel-um"),
        (["--field-um", "85"], "--pixel-um is missing"),
        (["--pixel-um", "6.9"], "--field-um is missing"),
        (["--system", "solidras", "--field-um", "85"], "--set mask.field_um="),
        (["--system", "solidras", "--pixel-um", "7"], "--set sensor.pixel_um="),
        ([*SIZES, "--set", "sensor.pixel_um=7"], "there is none; give it with --system"),
        (["--field-um", "-1", "--pixel-um", "6.9"], "--field-um must be between"),
        (["--field-um", "85", "--pixel-um", "nan"], "--pixel-um must be between"),
        (["--system", "solidra"], "did you mean solidras"),
        (["--system", "missing.toml"], "there is no such file"),
        (["--system", "solidras", "--set", "sensor.pixl_um=7"], "sensor.pixel_um"),
        (["--system", "solidras", "--set", "sensor.pixel_um=-7"], "sensor.pixel_um"),
        (["--system", "solidras", "--set", "nonsense"], "not of the form"),
        ([*SIZES, "--json", "--csv"], "exclude each other"),
        ([*SIZES, "--json", "-o", "r.h5"], "exclude each other"),
        ([*SIZES, "-o", "r.xlsx"], ".xlsx is not a format of results"),
        ([*SIZES, "-o", "nowhere/r.h5"], "there is no folder nowhere"),
        ([*SIZES, "--orientation", "5"], "give auto, 1, 2, 3 or 4"),
        ([*SIZES, "--bounds", "1,2,3"], "has 3 numbers; 4 are needed"),
        ([*SIZES, "--bounds", "a,b,c,d"], "not a list of numbers"),
        ([*SIZES, "--bounds", "1.5,2,30,40"], "whole numbers"),
        ([*SIZES, "--bounds", "30,2,3,40"], "0 <= left < right"),
        ([*SIZES, "--bounds", "-1,2,30,40"], "0 <= left < right"),
        ([*SIZES, "--bounds", "nan,2,30,inf"], "whole numbers"),
        ([*SIZES, "--method", "fourier", "--model", "affine"], "only the similarity"),
    ],
)
def test_wrong_usage_is_refused_in_one_sentence(images, arguments, words):
    assert words in refused("analyse", images, *arguments)


@pytest.mark.parametrize(
    "arguments", [[], ["a.png", "--method", "magic"], ["a.png", "--model", "cubic"], ["--nonsense"]]
)
def test_what_the_parser_refuses(arguments):
    result = rasnik("analyse", *arguments)
    assert result.exit_code == 2
    assert result.stderr


def test_no_images_matched(tmp_path):
    assert "no file matches this pattern" in refused("analyse", f"{tmp_path}/*.png", *SIZES)
    assert "holds no images" in refused("analyse", tmp_path, *SIZES)


def test_an_image_is_not_overwritten_by_results(tmp_path, frames):
    import h5py

    path = tmp_path / "stack.h5"
    with h5py.File(path, "w") as file:
        file["images"] = np.stack(frames)
    before = path.read_bytes()
    assert "would be overwritten" in refused("analyse", path, *INSTRUMENT, "-o", path)
    assert path.read_bytes() == before


def test_overlay_folder_that_is_a_file(images):
    message = refused("analyse", images, *SIZES, "--overlay", images / "f0.png")
    assert "cannot be made" in message


# ------------------------------------------------------------------------ simulate


SMALL = ["--set", "sensor.width_px=160", "--set", "sensor.height_px=120"]


@pytest.mark.parametrize("kind", ["png", "tiff", "npy"])
def test_simulated_images_and_their_truth(tmp_path, kind):
    folder = tmp_path / "deep" / "sim"
    arguments = ["--pose", "10000,7000,0.002,1.01,2", "-n", "2", "--seed", "4", "--format", kind]
    result = rasnik("simulate", "solidras", *SMALL, *arguments, "-o", folder)
    assert result.exit_code == 0
    truth = json.loads((folder / "truth.json").read_text())
    assert truth["seed"] == 4
    assert [entry["file"] for entry in truth["frames"]] == [
        f"frame_0000.{kind}",
        f"frame_0001.{kind}",
    ]
    first = truth["frames"][0]
    assert (first["x_um"], first["y_um"], first["theta_rad"]) == (10000, 7000, 0.002)
    assert (first["scale"], first["orientation"]) == (1.01, 2)
    system = load_system(folder / "system.toml")
    assert system.shape == (120, 160)
    expected = simulate(system, (10000, 7000, 0.002, 1.01, 2), n=2, seed=4)
    path = folder / "frame_0001"
    match kind:
        case "png":
            frame = np.asarray(Image.open(path.with_suffix(".png")))
        case "tiff":
            frame = tifffile.imread(path.with_suffix(".tiff"))
        case _:
            frame = np.load(path.with_suffix(".npy"))
    np.testing.assert_array_equal(frame, expected[1][0])


def test_simulation_then_analysis(tmp_path):
    rasnik("simulate", "solidras", "--set", "sensor.width_px=320", "--set",
           "sensor.height_px=240", "--pose", "10000,7000", "-o", tmp_path)  # fmt: skip
    result = rasnik("analyse", tmp_path, "--system", tmp_path / "system.toml", "--json")
    assert json.loads(result.stdout)["x_um"] == pytest.approx(10000, abs=0.02)


def test_random_positions_and_deep_images(tmp_path):
    rasnik("simulate", "solidras", *SMALL, "--set", "sensor.bit_depth=12", "-n", "2",
           "--seed", "1", "-o", tmp_path)  # fmt: skip
    truth = json.loads((tmp_path / "truth.json").read_text())["frames"]
    assert truth[0]["x_um"] != truth[1]["x_um"]
    with Image.open(tmp_path / "frame_0000.png") as picture:
        assert np.asarray(picture).dtype == np.uint16


def test_simulation_without_noise(tmp_path):
    for folder in ("a", "b"):
        rasnik("simulate", "solidras", *SMALL, "--no-noise", "--pose", "10000,7000",
               "-o", tmp_path / folder)  # fmt: skip
    one, other = ((tmp_path / f / "frame_0000.png").read_bytes() for f in ("a", "b"))
    assert one == other


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["solidra"], "did you mean solidras"),
        (["solidras", "--pose", "1"], "has 1 numbers; 2 to 5 are needed"),
        (["solidras", "--pose", "1,x"], "not a list of numbers"),
        (["solidras", "--pose", "10000,7000,0,1,7"], "orientation must be 1, 2, 3 or 4"),
        (["solidras", "--pose", "10000,7000,0,-1"], "scale must be positive"),
        (["solidras", "--pose", "-1e6,7000"], "not on the mask"),
        (["solidras", "--set", "sensor.noise_a=none", "--set", "sensor.noise_b=none"], "noise"),
    ],
)
def test_simulations_that_are_refused(tmp_path, arguments, words):
    assert words in refused("simulate", *arguments, "-o", tmp_path / "sim")
    assert not (tmp_path / "sim").exists()


def test_two_simulations_are_not_mixed(tmp_path):
    arguments = ["simulate", "solidras", *SMALL, "--pose", "10000,7000", "-o", tmp_path]
    assert rasnik(*arguments, "-n", "2").exit_code == 0
    assert rasnik(*arguments, "-n", "2").exit_code == 0
    assert "frame_0001.png" in refused(*arguments, "-n", "1")


# ------------------------------------------------------------------------ systems, demo, rasnik


def test_systems_are_listed():
    result = rasnik("systems")
    assert result.exit_code == 0
    for name in ("solidras", "microras", "atlas-ccd", "solidras-uv"):
        assert name in result.stdout


def test_a_system_is_printed_with_its_sources(tmp_path):
    result = rasnik("systems", "SolidRas")
    assert result.exit_code == 0
    assert "# results" in result.stdout
    (tmp_path / "mine.toml").write_text(result.stdout, encoding="utf-8")
    assert load_system(tmp_path / "mine.toml") == load_system("solidras")
    assert rasnik("systems", tmp_path / "mine.toml").stdout == result.stdout


def test_unknown_system():
    assert "did you mean microras" in refused("systems", "micoras")


def test_demo(tmp_path):
    result = rasnik("demo", "-n", "2", "-o", tmp_path / "demo")
    assert result.exit_code == 0
    assert "2 of 2 positions found" in result.stdout
    assert "Cramer-Rao bound" in result.stdout
    for name in ("image.png", "overlay.png", "errors.png"):
        assert (tmp_path / "demo" / name).stat().st_size > 10_000
        assert name in result.stdout


def test_demo_compares_with_the_truth():
    from rasnik.report.demo import run_demo

    demo = run_demo(SYSTEM, count=4, seed=2)
    assert demo.found.all()
    truth = [pose.x_um for pose in demo.simulation.truth]
    found = [pose.x_um for pose in demo.poses]
    np.testing.assert_allclose(demo.errors("x_um"), np.subtract(found, truth))
    assert demo.rms("x_um") == pytest.approx(np.sqrt(np.mean(demo.errors("x_um") ** 2)))
    assert 0.3 < demo.rms("x_um") / demo.bound("x_um") < 2


def test_version():
    import rasnik as package

    assert rasnik("--version").stdout == f"rasnik {package.__version__}\n"


@pytest.mark.parametrize("command", ["analyse", "simulate", "systems", "demo"])
def test_help_has_examples(command):
    result = rasnik(command, "--help")
    assert result.exit_code == 0
    assert "Example" in result.stdout
    assert f"rasnik {command}" in result.stdout


def test_no_command_shows_the_help():
    assert "analyse" in CliRunner().invoke(app, []).output


def test_a_reader_that_has_seen_enough(images):
    """`rasnik analyse ... --json | head -1` ends quietly."""
    code = "import sys; from rasnik.cli import app; sys.argv[0] = 'rasnik'; app()"
    run = [sys.executable, "-c", code, "analyse", *[str(images)] * 5, *INSTRUMENT, "--json"]
    with subprocess.Popen(run, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        process.stdout.readline()
        process.stdout.close()
        assert b"Traceback" not in process.stderr.read()
