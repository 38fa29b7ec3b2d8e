"""Systems: the shipped ones, reading, changing, and every way of getting one wrong."""

import math
import pickle
import re
import tomllib
from importlib import resources
from pathlib import Path

import numpy as np
import pytest
from pydantic import BaseModel, ValidationError

from rasnik.instrument import (
    Geometry,
    Optics,
    Sensor,
    System,
    SystemConfigError,
    load_system,
    system_names,
)
from rasnik.mask import ChessField

MINIMAL = """
name = "bench"
[mask]
field_um = 170
[optics]
scale = 1
blur_um = 10
[sensor]
width_px = 344
height_px = 244
pixel_um = 10
dark_level = 40
light_level = 200
"""


def shipped_text(name: str) -> str:
    return (resources.files("rasnik") / "systems" / f"{name}.toml").read_text(encoding="utf-8")


# ----------------------------------------------------------------------- shipped systems


def test_names_of_the_shipped_systems() -> None:
    names = system_names()
    assert names == sorted(names)
    assert {"atlas-ccd", "microras", "solidras", "solidras-uv"} <= set(names)
    # the paper's steps from MicroRas on
    assert {"microras-uv", "microras-200nm", "microras-40x", "microras-860hz"} <= set(names)


@pytest.mark.parametrize("name", system_names())
def test_shipped_system(name: str) -> None:
    system = load_system(name)
    assert system.name == name and system.description
    assert system.optics.orientation is None  # found from the image unless the user fixes it
    assert system.pixels_per_field > 2.5
    assert system.noise_law is not None
    assert set(tomllib.loads(shipped_text(name))) == {
        "name",
        "description",
        "mask",
        "optics",
        "sensor",
        "geometry",
    }


@pytest.mark.parametrize("name", system_names())
def test_every_value_shipped_has_its_source(name: str) -> None:
    above = ""
    for line in shipped_text(name).splitlines():
        is_value = re.match(r"\w+ = ", line) and not re.match("(name|description|model) = ", line)
        assert not is_value or "#" in line or above.startswith("#"), line
        above = line


def test_solidras_is_that_of_the_paper() -> None:
    system = load_system("solidras")
    assert system.mask == ChessField(field_um=85.0)
    assert (system.optics.scale, system.optics.blur_um, system.optics.theta_rad) == (1.0, 4.5, 0.0)
    assert system.shape == (540, 720) and system.pitch_um == 6.9
    assert system.full_scale == 255
    assert system.noise_law == (0.26, 0.011)
    assert (system.sensor.dark_level, system.sensor.light_level) == (25.0, 252.0)
    assert system.sensor.full_well_e == 22000.0 and system.sensor.frame_rate_hz == 275.0
    f, a, b = 30.0, system.geometry.mask_lens_mm, system.geometry.lens_sensor_mm
    assert a is not None and b is not None
    assert 1 / a + 1 / b == pytest.approx(1 / f)
    assert b / a == system.optics.scale


def test_shot_noise_agrees_with_the_full_well() -> None:
    """The slope B of the variance is one grey level over the electrons in it."""
    sensor = load_system("solidras").sensor
    assert sensor.electrons_per_grey == pytest.approx(22000 / 255)
    assert sensor.noise_b == pytest.approx(1 / sensor.electrons_per_grey, rel=0.1)


def test_what_was_derived_follows_from_its_reasons() -> None:
    solid, uv, micro, atlas = map(load_system, ("solidras", "solidras-uv", "microras", "atlas-ccd"))
    assert uv.optics.blur_um == solid.optics.blur_um / 2
    assert uv.optics.diaphragm_mm == 2 * solid.optics.diaphragm_mm == 8.0
    assert uv.optics.wavelength_nm == 365.0
    assert micro.optics.scale == 20.0
    assert micro.mask.field_um * 20 == solid.mask.field_um
    assert 5000 - 9 * 4.25 < micro.mask.width_um <= 5000
    aperture = 2 * micro.optics.numerical_aperture / micro.optics.scale
    assert micro.optics.blur_um == pytest.approx(4.5 * (4 / 60) / aperture)
    sensor = atlas.sensor
    assert (sensor.width_px * sensor.pixel_um, sensor.height_px * sensor.pixel_um) == (4e3, 3e3)
    contour_mm = 4.0 * 3.0 / (atlas.mask.field_um * atlas.optics.scale / 1000)
    assert contour_mm == pytest.approx(100.0)
    a, b = atlas.noise_law
    step, middle = sensor.light_level - sensor.dark_level, 120.0
    bound_um = math.sqrt(2 * math.sqrt(math.pi) * atlas.optics.blur_um * 10 * (a + b * middle))
    assert bound_um / step == pytest.approx(0.2, rel=0.02)


@pytest.mark.parametrize("name", ["SolidRas", "solidras_uv", " microras "])
def test_names_are_forgiving_about_case_and_underscores(name: str) -> None:
    assert load_system(name).name == name.strip().lower().replace("_", "-")


# ------------------------------------------------------------------------------ binning


def test_binning_makes_superpixels() -> None:
    whole, binned = load_system("solidras"), load_system("solidras", "sensor.binning=2")
    assert binned.shape == (270, 360)
    assert binned.pitch_um == 13.8
    assert binned.full_scale == 255
    assert binned.sensor.width_px == 720 and binned.sensor.pixel_um == 6.9
    assert binned.pixels_per_field == whole.pixels_per_field / 2
    assert binned.sensor.electrons_per_grey == whole.sensor.electrons_per_grey


def test_noise_law_of_superpixels_by_averaging(rng: np.random.Generator) -> None:
    system = load_system("solidras", "sensor.binning=3")
    grey, law, single = 180.0, system.noise_law, (system.sensor.noise_a, system.sensor.noise_b)
    assert law is not None
    pixels = rng.normal(grey, math.sqrt(single[0] + single[1] * grey), (300, 300))
    means = pixels.reshape(100, 3, 100, 3).mean((1, 3))
    # 10^4 means: the variance is known to a relative sqrt(2 / 10^4).
    assert means.var() == pytest.approx(law[0] + law[1] * grey, rel=5 * math.sqrt(2e-4))


def test_noise_that_is_not_known() -> None:
    system = load_system("solidras", ["sensor.noise_a=none", "sensor.noise_b=none"])
    assert system.noise_law is None
    assert system.sensor.electrons_per_grey == pytest.approx(22000 / 255)
    system = load_system(system, "sensor.full_well_e=none")
    assert system.sensor.electrons_per_grey is None
    system = load_system("solidras", "sensor.full_well_e=none")
    assert system.sensor.electrons_per_grey == pytest.approx(1 / 0.011)


# ---------------------------------------------------------------------- reading, writing


def test_a_file_with_only_what_is_needed(tmp_path: Path) -> None:
    path = tmp_path / "bench.toml"
    path.write_text(MINIMAL)
    system = load_system(path)
    assert system == load_system(str(path))
    assert system.mask == ChessField(field_um=170.0)
    assert system.geometry == Geometry()
    assert system.sensor.bit_depth == 8 and system.sensor.binning == 1
    assert system.noise_law is None


@pytest.mark.parametrize("name", system_names())
def test_written_toml_loads_back_equal(name: str, tmp_path: Path) -> None:
    system = load_system(name, ["optics.orientation=4", "optics.theta_rad=1e-7"])
    path = tmp_path / "copy.toml"
    path.write_text(system.to_toml(), encoding="utf-8")
    assert load_system(path) == system


def test_written_toml_survives_awkward_text(tmp_path: Path) -> None:
    text = 'a "quoted" \\ back\nslash\ttab \x7f µm — \U0001f52d'
    system = load_system("solidras", {"description": text})
    path = tmp_path / "copy.toml"
    path.write_text(system.to_toml(), encoding="utf-8")
    assert load_system(path).description == text


def test_written_toml_names_every_field() -> None:
    text = load_system("solidras").to_toml()
    for part in (System, ChessField, Optics, Sensor, Geometry):
        for name, info in part.model_fields.items():
            if info.description is None:
                assert issubclass(info.annotation, BaseModel) and f"[{name}]" in text
            else:
                assert re.search(rf"^(# )?{name} .*# {re.escape(info.description)}$", text, re.M)


def test_a_system_does_not_change() -> None:
    system = load_system("solidras")
    with pytest.raises(ValidationError):
        system.sensor.pixel_um = 7.4
    with pytest.raises(ValidationError):
        system.mask = ChessField(field_um=120.0)
    assert hash(system) == hash(load_system("solidras"))
    assert pickle.loads(pickle.dumps(system)) == system


# ---------------------------------------------------------------------------- overrides


@pytest.mark.parametrize(
    "overrides",
    [
        {"sensor.pixel_um": 7.4, "name": "mine"},
        {"sensor": {"pixel_um": 7.4}, "name": "mine"},
        {"sensor.pixel_um": np.float32(7.4).astype(float), "name": "mine"},
        ["sensor.pixel_um=7.4", "name=mine"],
        ["sensor.pixel_um = 1.0", " sensor.pixel_um =7.4", 'name = "mine"'],
        ("sensor={pixel_um=7.4}", "name=mine"),
    ],
)
def test_overrides_in_any_form(overrides: object) -> None:
    system = load_system("solidras", overrides)
    assert system.sensor.pixel_um == pytest.approx(7.4)
    assert system.name == "mine"
    base = load_system("solidras")
    assert system.mask == base.mask and system.optics == base.optics
    assert system.sensor.width_px == 720


def test_override_values_of_other_kinds() -> None:
    assert load_system("solidras", "sensor.pixel_um=7").sensor.pixel_um == 7.0
    assert load_system("solidras", "sensor.model=IMX 287").sensor.model == "IMX 287"
    assert load_system("solidras", "sensor.model=a=b").sensor.model == "a=b"
    assert load_system("solidras", "optics.orientation=3").optics.orientation == 3
    fixed = load_system("solidras", "optics.orientation=3")
    assert load_system(fixed, {"optics.orientation": None}).optics.orientation is None
    mask = ChessField(field_um=120.0, polarity="negative")
    assert load_system("solidras", {"mask": mask}).mask == mask
    assert load_system("solidras", {"sensor.width_px": np.int64(640)}).shape == (540, 640)


def test_without_overrides_a_system_is_itself() -> None:
    system = load_system("microras")
    assert load_system(system) == system


def test_a_new_scale_drops_the_distances_it_contradicts() -> None:
    assert load_system("solidras", "optics.scale=2").geometry == Geometry()
    kept = load_system("solidras", "optics.scale=1.01").geometry
    assert kept == load_system("solidras").geometry
    moved = load_system(
        "solidras", {"optics.scale": 2, "geometry": {"mask_lens_mm": 45, "lens_sensor_mm": 90}}
    )
    assert moved.geometry == Geometry(mask_lens_mm=45.0, lens_sensor_mm=90.0)


# --------------------------------------------------------------------------- bad input

WRONG_VALUES = [
    ("sensor.pixel_um=-6.9", "sensor.pixel_um = -6.9: it should be greater than"),
    ("sensor.pixel_um=6.9e-6", "sensor.pixel_um = 6.9e-06: it should be greater than"),
    ("sensor.pixel_um=nan", "sensor.pixel_um = nan: it should be a finite number"),
    ("sensor.pixel_um=wide", "sensor.pixel_um = 'wide': it should be a valid number"),
    ("sensor.pixel_um=true", "sensor.pixel_um = True: it should be a valid number"),
    ("sensor.width_px=0", "sensor.width_px = 0: it should be greater than"),
    ("sensor.width_px=720.5", "sensor.width_px = 720.5: it should be a valid integer"),
    ("sensor.bit_depth=17", "sensor.bit_depth = 17: it should be less than"),
    ("sensor.noise_a=-1", "sensor.noise_a = -1: it should be"),
    ("sensor.noise_b=-1", "sensor.noise_b = -1: it should be"),
    ("sensor.full_well_e=0", "sensor.full_well_e = 0: it should be"),
    ("sensor.quantum_efficiency=1.1", "sensor.quantum_efficiency = 1.1: it should be"),
    ("sensor.dark_level=-1", "sensor.dark_level = -1: it should be"),
    ("sensor.frame_rate_hz=0", "sensor.frame_rate_hz = 0: it should be"),
    ("sensor.exposure_s=-1", "sensor.exposure_s = -1: it should be"),
    ("sensor.binning=0", "sensor.binning = 0: it should be"),
    ("sensor=7", "sensor = 7: it should be a table"),
    ("optics.scale=0", "optics.scale = 0: it should be"),
    ("optics.blur_um=-1", "optics.blur_um = -1: it should be"),
    ("optics.orientation=5", "optics.orientation = 5: it should be 1, 2, 3 or 4"),
    ("optics.theta_rad=20", "optics.theta_rad = 20: it should be"),
    ("optics.wavelength_nm=0.448", "optics.wavelength_nm = 0.448: it should be"),
    ("optics.numerical_aperture=0", "optics.numerical_aperture = 0: it should be"),
    ("optics.focal_length_mm=-30", "optics.focal_length_mm = -30: it should be"),
    ("optics.diaphragm_mm=0", "optics.diaphragm_mm = 0: it should be"),
    ("geometry.mask_lens_mm=-60", "geometry.mask_lens_mm = -60: it should be"),
    ("mask.field_um=0", "mask.field_um = 0: it should be"),
    ("mask.polarity=neg", "mask.polarity = 'neg': it should be 'positive' or 'negative'"),
    ("mask.columns=257", "in mask, columns = 257 from first_column = 0 needs codes beyond"),
    ("name=", "the override 'name=' is not of the form sensor.pixel_um=7.4"),
    ("sensor.pixel_um", "the override 'sensor.pixel_um' is not of the form"),
    ("=7.4", "the override '=7.4' is not of the form"),
    ('name=""', "name = '': "),
    ("name=none", "name is missing"),
    ("sensor.pixel_um=none", "sensor.pixel_um is missing"),
    ("sensor=none", "sensor is missing"),
]

CONTRADICTIONS = [
    ("sensor.dark_level=252", "in sensor, dark_level = 252 must be below light_level = 252"),
    ("sensor.light_level=256", "in sensor, light_level = 256 is above 255, the full scale of 8"),
    ("sensor.bit_depth=6", "in sensor, light_level = 252 is above 63, the full scale of 6 bits"),
    ("sensor.noise_a=none", "in sensor, noise_a and noise_b go together"),
    ("sensor.binning=7", "720 x 540 pixels cannot be divided into squares of binning = 7"),
    ("sensor.exposure_s=0.01", "exposure_s = 0.01 is longer than a frame at frame_rate_hz = 275"),
    (
        "geometry.mask_lens_mm=30",
        "optics.scale = 1, but geometry.lens_sensor_mm = 60 and geometry.mask_lens_mm = 30 make a "
        "scale of 2",
    ),
]

UNKNOWN_FIELDS = [
    ("sensor.pixl_um=7", "there is no field sensor.pixl_um; did you mean sensor.pixel_um?"),
    ("pixel_um=7", "there is no field pixel_um; did you mean sensor.pixel_um?"),
    ("optics.pixel_um=7", "there is no field optics.pixel_um; did you mean sensor.pixel_um?"),
    ("senzor.pixel_um=7", "there is no field senzor; did you mean sensor?"),
    ("name.first=7", "there is no field name.first"),
    ("sensor.pixel_um.x=7", "there is no field sensor.pixel_um.x"),
    ("colour=blue", "there is no field colour"),
    ("colour=none", "there is no field colour"),
]


@pytest.mark.parametrize(("override", "sentence"), WRONG_VALUES + CONTRADICTIONS + UNKNOWN_FIELDS)
def test_wrong_value(override: str, sentence: str) -> None:
    with pytest.raises(SystemConfigError) as caught:
        load_system("solidras", override)
    assert len(caught.value.problems) == 1
    assert sentence in caught.value.problems[0]
    assert str(caught.value).startswith("solidras")


def test_every_fault_is_named_with_the_file(tmp_path: Path) -> None:
    path = tmp_path / "bad.toml"
    path.write_text(
        MINIMAL.replace("scale = 1", "scale = -1\nblurr_um = 3").replace("height_px = 244", "")
    )
    with pytest.raises(SystemConfigError) as caught:
        load_system(path)
    assert sorted(caught.value.problems) == [
        "optics.scale = -1: it should be greater than or equal to 0.001",
        "sensor.height_px is missing",
        "there is no field optics.blurr_um; did you mean optics.blur_um?",
    ]
    assert str(caught.value).startswith(f"{path} has 3 faults:\n  - ")


def test_several_contradictions_are_several_sentences() -> None:
    with pytest.raises(SystemConfigError) as caught:
        load_system("solidras", {"sensor": {"dark_level": 300, "binning": 7, "noise_b": None}})
    assert [p.split(",")[0] for p in caught.value.problems] == ["in sensor"] * 3


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        (b"", "name is missing"),
        (b"name = ", "this is not valid TOML: "),
        (b"name = 'a'\nname = 'b'", "this is not valid TOML: "),
        (b"\xff\xfe\x00", "this is not a text file in UTF-8"),
    ],
)
def test_broken_file(tmp_path: Path, content: bytes, sentence: str) -> None:
    path = tmp_path / "broken.toml"
    path.write_bytes(content)
    with pytest.raises(SystemConfigError) as caught:
        load_system(path)
    assert str(path) in str(caught.value) and sentence in str(caught.value)


def test_missing_file_and_folder(tmp_path: Path) -> None:
    with pytest.raises(SystemConfigError, match=r"nowhere\.toml: there is no such file"):
        load_system(tmp_path / "nowhere.toml")
    with pytest.raises(SystemConfigError, match="this is a folder"):
        load_system(tmp_path)
    with pytest.raises(SystemConfigError, match=r"nowhere\.toml: there is no such file"):
        load_system("nowhere.toml")


def test_unknown_name_offers_the_near_ones() -> None:
    with pytest.raises(SystemConfigError, match=r"'solidrass': .*did you mean solidras"):
        load_system("solidrass")
    with pytest.raises(SystemConfigError, match="Shipped are atlas-ccd, lunar, .*solidras") as c:
        load_system("xyz")
    assert "did you mean" not in str(c.value)


def test_the_error_can_travel_between_processes() -> None:
    error = SystemConfigError("file.toml", ["one is wrong", "two is wrong"])
    back = pickle.loads(pickle.dumps(error))
    assert str(back) == str(error) and back.problems == error.problems


def test_models_check_themselves() -> None:
    with pytest.raises(ValidationError, match=r"dark_level = 9 must be below light_level = 8"):
        Sensor(width_px=10, height_px=10, pixel_um=1.0, dark_level=9.0, light_level=8.0)
