"""Stacks of simulated frames: written, read as images, and their truth read back."""

from __future__ import annotations

import json

import numpy as np
import pytest
from typer.testing import CliRunner

from rasnik import load_system, simulate
from rasnik.cli import app
from rasnik.io.images import iter_frames
from rasnik.io.stacks import read_truth, truth_as_json, write_stack

SMALL = {"sensor.width_px": 96, "sensor.height_px": 64}
SETS = [part for key, value in SMALL.items() for part in ("--set", f"{key}={value}")]


@pytest.fixture(scope="module")
def simulation():
    return simulate(
        load_system("solidras", SMALL), (41000, 30200, 0.01), n=3, seed=2**63 + 5,
        motion="drift:x_um_per_s=500", effects={"gain_spread": 0.02},
    )  # fmt: skip


def assert_same_truth(truth, simulation):
    assert truth.poses == [t.as_dict() for t in simulation.truth]
    assert truth.system == simulation.system
    assert truth.seed == simulation.seed
    assert truth.software.startswith("rasnik ")
    assert truth.simulation["effects"] == {"gain_spread": {"rms": 0.02}}
    assert truth.simulation["path"] == "exact"


@pytest.mark.parametrize("name", ["sim.h5", "sim.tif", "sim.tiff", "sim.hdf5"])
def test_frames_and_truth_come_back(simulation, tmp_path, name):
    path = tmp_path / name
    write_stack(path, simulation)
    frames = list(iter_frames([path]))
    assert [f.error for f in frames] == [None] * 3
    np.testing.assert_array_equal([f.image for f in frames], simulation.frames)
    assert frames[0].image.dtype == np.uint8
    assert_same_truth(read_truth(path), simulation)


def test_levels_that_are_not_rounded(tmp_path):
    system = load_system("solidras", SMALL)
    simulation = simulate(system, (41000, 30200), n=2, seed=1, quantise=False)
    for name, tolerance in (("a.h5", 0), ("a.tif", 1e-4)):
        write_stack(tmp_path / name, simulation)
        images = [f.image for f in iter_frames([tmp_path / name])]
        np.testing.assert_allclose(images, simulation.frames, atol=tolerance, rtol=0)


def test_truth_of_a_folder(simulation, tmp_path):
    (tmp_path / "truth.json").write_text(truth_as_json(simulation, ["a", "b", "c"]), "utf-8")
    for path in (tmp_path, tmp_path / "truth.json"):
        truth = read_truth(path)
        assert [pose.pop("file") for pose in truth.poses] == ["a", "b", "c"]
        assert_same_truth(truth, simulation)


def test_what_holds_no_truth(simulation, tmp_path):
    import h5py
    import tifffile

    with pytest.raises(ValueError, match="the folder holds no truth.json"):
        read_truth(tmp_path)
    tifffile.imwrite(tmp_path / "a.tif", np.zeros((4, 5), np.uint8))
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["frames"] = np.zeros((2, 4, 5))
    (tmp_path / "a.json").write_text("[1, 2]", encoding="utf-8")
    for name in ("a.tif", "a.h5", "a.json"):
        with pytest.raises(ValueError, match=f"{name}: there is no truth"):
            read_truth(tmp_path / name)
    (tmp_path / "b.tif").write_bytes(b"no tiff")
    with pytest.raises(ValueError, match="cannot be read"):
        read_truth(tmp_path / "b.tif")
    with pytest.raises(ValueError, match=r"written as \.tif, \.tiff, \.h5 or \.hdf5, not \.png"):
        write_stack(tmp_path / "a.png", simulation)
    text = truth_as_json(simulation).replace("field_um = 85.0", "field_um = -85.0")
    (tmp_path / "c.json").write_text(text, encoding="utf-8")
    with pytest.raises(ValueError, match=r"c\.json: the system in it cannot be read"):
        read_truth(tmp_path / "c.json")


# ---------------------------------------------------------------------- command line


def run(*arguments):
    return CliRunner().invoke(app, ["simulate", *map(str, arguments)])


def test_command_writes_a_stack(tmp_path):
    out = tmp_path / "new" / "sim.h5"
    result = run(
        "solidras", *SETS, "--pose", "41000,30200", "-n", 4, "--seed", 1, "-o", out,
        "--effect", "mask_edges=6,segments=2", "--effect", "blooming",
        "--motion", "sine:hz=10,x_um=0.5",
    )  # fmt: skip
    assert result.exit_code == 0, result.output
    again = simulate(
        load_system("solidras", SMALL), (41000, 30200), n=4, seed=1,
        effects=["mask_edges=6,segments=2", "blooming"], motion="sine:hz=10,x_um=0.5",
    )  # fmt: skip
    frames = [f.image for f in iter_frames([out])]
    np.testing.assert_array_equal(frames, again.frames)
    truth = read_truth(out)
    assert truth.poses[1]["x_um"] == again.truth[1].x_um != 41000
    assert truth.simulation["effects"]["mask_edges"] == {"rms_nm": 6.0, "segments": 2.0}


def test_command_writes_the_paper_path_into_a_folder(tmp_path):
    result = run("solidras", *SETS, "--path", "paper", "--seed", 1, "-o", tmp_path / "sim")
    assert result.exit_code == 0, result.output
    data = json.loads((tmp_path / "sim" / "truth.json").read_text("utf-8"))
    assert data["simulation"]["path"] == "paper"
    assert read_truth(tmp_path / "sim").poses[0]["file"] == "frame_0000.png"


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["-o", "sim", "--format", "h5"], "must end in .h5"),
        (["-o", "sim.h5", "--format", "png"], "does not end as --format png"),
        (["-o", "sim", "--effect", "rounding=0"], "png cannot hold levels"),
        (["-o", "sim", "--effect", "blooming_"], "did you mean blooming"),
        (["-o", "sim", "--motion", "walk"], "there is no motion"),
    ],
)
def test_command_refuses(tmp_path, monkeypatch, arguments, sentence):
    monkeypatch.chdir(tmp_path)
    result = run("solidras", *SETS, *arguments)
    assert result.exit_code != 0
    assert sentence in " ".join(result.output.split())
    assert not (tmp_path / "sim").exists()


def test_table_of_effects():
    from rasnik.imaging.effects import EFFECTS

    result = run("--list-effects")
    assert result.exit_code == 0
    for name in EFFECTS:
        assert name in result.output
