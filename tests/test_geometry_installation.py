"""Installations: their files, where elements stand, what all Rasniks read; tables of readings."""

import json
import tomllib
from collections.abc import Callable
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rasnik.geometry.installation import Installation, installation_names, load_installation
from rasnik.geometry.mounting import mounting
from rasnik.geometry.network import Network
from rasnik.geometry.observations import parse_readings, read_readings, write_readings
from rasnik.geometry.reading import FACING
from rasnik.geometry.rigid import axes_along, left_jacobian, rotation_matrix, skew
from rasnik.instrument import SystemConfigError, load_system
from rasnik.performance.bound import bound

SHORT = """
name = "bench"
[defaults]
sigma_x_um = 1.0
sigma_y_um = 2.0
[[bodies]]
name = "table"
position_mm = [0, 0, 0]
fixed = true
[[bodies]]
name = "stage"
position_mm = [10, 0, 300]
[[rasniks]]
name = "one"
mask = { body = "table", position_mm = [0, 0, 0] }
lens = { body = "stage", position_mm = [-10, 0, 0] }
sensor = { body = "table", position_mm = [0, 0, 600] }
[[rasniks]]
name = "two"
mask = { body = "table", position_mm = [50, 0, 0] }
lens = { body = "stage" }
sensor = { body = "table", position_mm = [50, 0, 600] }
"""


def short() -> dict[str, Any]:
    return tomllib.loads(SHORT)


def random_network(rng: np.random.Generator, bodies: int = 4, rasniks: int = 6) -> Network:
    """Bodies and elements anywhere, turned in any way, lenses near the lines."""
    text: dict[str, Any] = {"name": "random", "bodies": [], "rasniks": []}
    text["defaults"] = {"sigma_x_um": 1.0, "sigma_y_um": 1.0}
    text["defaults"] |= {"sigma_scale": 1e-5, "sigma_theta_rad": 1e-5}
    places = rng.uniform(-500, 500, (bodies, 3))
    turns = rng.normal(size=(bodies, 3))
    for b in range(bodies):
        text["bodies"].append(
            {"name": f"b{b}", "position_mm": places[b].tolist(), "rotation_rad": turns[b].tolist()}
        )

    def local(body: int, point: np.ndarray) -> list[float]:
        return (Rotation.from_rotvec(turns[body]).as_matrix().T @ (point - places[body])).tolist()

    for k in range(rasniks):
        carriers = rng.permutation(bodies)[:3]
        mask, sensor = rng.uniform(-800, 800, (2, 3))
        lens = mask + rng.uniform(0.3, 0.7) * (sensor - mask) + rng.normal(size=3)
        elements = zip(("mask", "lens", "sensor"), carriers, (mask, lens, sensor), strict=True)
        text["rasniks"].append(
            {"name": f"r{k}"}
            | {n: {"body": f"b{b}", "position_mm": local(b, p)} for n, b, p in elements}
        )
    return Network(Installation.model_validate(text))


# -------------------------------------------------------------------------- rigid


def test_left_jacobian_against_differences(rng: np.random.Generator) -> None:
    for size in (1e-9, 1e-3, 0.0099, 0.0101, 1.0, 3.0):
        vector = rng.normal(size=3)
        vector *= size / np.linalg.norm(vector)
        for step in np.eye(3) * 1e-6:
            turned = rotation_matrix(vector + step) @ rotation_matrix(vector - step).T
            expected = (turned - turned.T)[[2, 0, 1], [1, 2, 0]] / 4e-6
            np.testing.assert_allclose(left_jacobian(vector) @ (step / 1e-6), expected, atol=1e-9)


def test_skew_is_the_cross_product(rng: np.random.Generator) -> None:
    a, b = rng.normal(size=(2, 3))
    np.testing.assert_allclose(skew(a) @ b, np.cross(a, b))


def test_axes_along_are_right_handed(rng: np.random.Generator) -> None:
    forward, right = rng.normal(size=(2, 3))
    axes = axes_along(forward, right)
    np.testing.assert_allclose(axes.T @ axes, np.eye(3), atol=1e-12)
    assert np.linalg.det(axes) == pytest.approx(1)
    np.testing.assert_allclose(axes[:, 2], forward / np.linalg.norm(forward))
    assert axes[:, 1] @ right == pytest.approx(0, abs=1e-12)


# -------------------------------------------------------------------------- files


def test_shipped_installations_are_part_of_the_package() -> None:
    assert installation_names() == ["atlas-tower", "atlas-tower-linked"]
    for name in installation_names():
        assert (resources.files("rasnik") / "installations" / f"{name}.toml").is_file()
        installation = load_installation(name)
        assert installation.name == name
        assert len(installation.rasniks) == 12 and len(installation.bodies) == 3


def test_what_a_short_file_leaves_open() -> None:
    installation = Installation.model_validate(short())
    one, two = (mounting(installation, rasnik) for rasnik in installation.rasniks)
    np.testing.assert_allclose(one.world_mm, [[0, 0, 0], [0, 0, 300], [0, 0, 600]])
    np.testing.assert_allclose(two.world_mm[1], [50, 0, 300])  # scale 1: in the middle
    np.testing.assert_allclose(one.mask_axes, np.eye(3), atol=1e-15)
    np.testing.assert_allclose(one.sensor_axes, FACING, atol=1e-15)
    network = Network(installation)
    np.testing.assert_allclose(network.nominal, [[0, 0, 1, 0]] * 2, atol=1e-12)
    assert list(network.orientation) == [4, 4]


def test_lens_of_a_system_stands_where_its_scale_wants_it() -> None:
    data = short()
    data["rasniks"][1]["system"] = "microras"
    installation = Installation.model_validate(data)
    scale = load_system("microras").optics.scale
    lens = mounting(installation, installation.rasniks[1]).world_mm[1, 2]
    assert lens == pytest.approx(600 / (1 + scale))


def test_mask_point_is_what_is_read() -> None:
    data = short()
    data["rasniks"][0]["mask"]["point_um"] = [4000.0, 5000.0]
    np.testing.assert_allclose(
        Network(Installation.model_validate(data)).nominal[0], [4000, 5000, 1, 0], atol=1e-9
    )


def test_errors_of_values() -> None:
    data = short()
    data["rasniks"][1] |= {"system": "atlas-ccd", "measures": ["x", "scale"], "sigma_x_um": 3.0}
    installation = Installation.model_validate(data)
    one, two = (installation.value_sigmas(rasnik) for rasnik in installation.rasniks)
    np.testing.assert_array_equal(one, [1, 2, np.inf, np.inf])
    least = np.sqrt(np.diag(bound(load_system("atlas-ccd"), rounding=True).covariance))
    assert two[0] == pytest.approx(np.hypot(3, least[0]))
    assert two[2] == pytest.approx(least[2])
    assert np.isinf(two[[1, 3]]).all()
    own = installation.value_sigmas(installation.rasniks[1], np.array([4.0, 1.0, np.nan, 1.0]))
    assert own[0] == pytest.approx(5) and own[2] == pytest.approx(least[2])


def change(*path: str | int, to: Any) -> Callable[[dict[str, Any]], None]:
    def apply(data: Any) -> None:
        for key in path[:-1]:
            data = data[key]
        data[path[-1]] = to

    return apply


FAULTS = {
    "lens of rasnik one: there is no body 'stag'; did you mean 'stage'?": change(
        "rasniks", 0, "lens", "body", to="stag"
    ),
    "2 rasniks have the name 'one'": change("rasniks", 1, "name", to="one"),
    "2 bodies have the name 'table'": change("bodies", 1, "name", to="table"),
    "rasnik one: mask and sensor are at the same place": change(
        "rasniks", 0, "sensor", "position_mm", to=[0, 0, 0]
    ),
    "rasnik one: lens and mask are at the same place": change(
        "rasniks", 0, "lens", "position_mm", to=[-10, 0, -300]
    ),
    "rasnik one: the lens is not between mask and sensor but 1.33": change(
        "rasniks", 0, "lens", "position_mm", to=[-10, 0, 500]
    ),
    "the distances make a scale of 1 (mask to lens 300 mm, lens to sensor 300 mm), but system "
    "microras has optics.scale = 20": change("rasniks", 0, "system", to="microras"),
    "there is no system of this name": change("rasniks", 0, "system", to="nothing"),
    "it measures theta with an unknown error; give sigma_theta_rad": change(
        "rasniks", 0, "measures", to=["x", "theta"]
    ),
    "bodies.1.position_mm.0 = nan: it should be": change(
        "bodies", 1, "position_mm", to=[float("nan"), 0, 0]
    ),
    "rasniks.0.sigma_x_um = 0: it should be greater than 0": change(
        "rasniks", 0, "sigma_x_um", to=0
    ),
    "there is no field rasniks.0.masc; did you mean rasniks.mask": change(
        "rasniks", 0, "masc", to={}
    ),
    "bodies.1.held.0 = 'w'": change("bodies", 1, "held", to=["w"]),
    "rasniks.0.sensor.position_mm = [0, 1]: it should have at least 3": change(
        "rasniks", 0, "sensor", "position_mm", to=[0, 1]
    ),
    "sagitta sagitta needs three different bodies": change(
        "sagittas", to=[{"bodies": ["table", "stage", "table"]}]
    ),
    "sagitta sagitta: there is no body 'roof'": change(
        "sagittas", to=[{"bodies": ["table", "stage", "roof"]}]
    ),
    "sagitta sagitta: the points of table and roof are at the same place": lambda data: data.update(
        bodies=[*data["bodies"], {"name": "roof", "position_mm": [0, 0, 5]}],
        sagittas=[
            {"bodies": ["table", "stage", "roof"], "points_mm": [[0, 0, 5], [0, 0, 0], [0, 0, 0]]}
        ],
    ),
    "body table is fixed, and prior.x_um says how far it may move": change(
        "bodies", 0, "prior", to={"x_um": 5.0}
    ),
    "body stage is held in rz, and prior.rz_rad says": lambda data: data["bodies"][1].update(
        held=["rz"], prior={"rz_rad": 1e-3, "x_um": 5.0}
    ),
    "the sensor is seen edge on": change(
        "rasniks", 0, "sensor", "rotation_rad", to=[np.pi / 2, 0, 0]
    ),
}


@pytest.mark.parametrize("sentence", FAULTS)
def test_every_fault_has_a_sentence(sentence: str, tmp_path: Path) -> None:
    data = short()
    FAULTS[sentence](data)
    path = tmp_path / "bench.toml"
    path.write_text("\n".join(_toml(data)))
    with pytest.raises(SystemConfigError) as caught:
        load_installation(path)
    assert sentence in str(caught.value)
    assert "bench.toml" in str(caught.value)


def _toml(data: dict[str, Any]) -> list[str]:
    def value(item: Any) -> str:
        if isinstance(item, dict):
            return "{ " + ", ".join(f"{k} = {value(v)}" for k, v in item.items()) + " }"
        if isinstance(item, list):
            return f"[{', '.join(map(value, item))}]"
        return str(item).lower() if isinstance(item, bool | float) else json.dumps(item)

    return [f"{key} = {value(item)}" for key, item in data.items()]


def test_a_line_beside_the_mask() -> None:
    data = short()
    data["rasniks"][0] |= {"system": "atlas-ccd"}
    data["rasniks"][0]["mask"]["point_um"] = [-2000.0, 0.0]
    with pytest.raises(ValueError, match="beside the mask"):
        Installation.model_validate(data)


def test_distances_that_contradict_the_system(tmp_path: Path) -> None:
    (tmp_path / "mine.toml").write_text(
        load_system(
            "atlas-ccd", {"geometry.mask_lens_mm": 100.0, "geometry.lens_sensor_mm": 100.0}
        ).to_toml()
    )
    data = short()
    data["rasniks"][0]["system"] = "mine.toml"  # beside the installation
    (tmp_path / "bench.toml").write_text("\n".join(_toml(data)))
    with pytest.raises(
        SystemConfigError, match="mask_lens_mm = 100, but the positions make it 300"
    ):
        load_installation(tmp_path / "bench.toml")


def test_faulty_rasniks_can_be_left_out(tmp_path: Path) -> None:
    data = short()
    broken = json.loads(json.dumps(data["rasniks"][0]))
    broken["name"] = "broken"
    broken["lens"]["position_mm"] = [-10, 0, 500]
    data["rasniks"] += [broken, dict(data["rasniks"][1]), {"name": "empty"}]
    (tmp_path / "bench.toml").write_text("\n".join(_toml(data)))
    left_out: list[str] = []
    installation = load_installation(tmp_path / "bench.toml", left_out=left_out)
    assert [rasnik.name for rasnik in installation.rasniks] == ["one", "two"]
    assert len(left_out) == 5  # empty has no mask, lens, sensor
    assert "rasnik broken: the lens is not between" in left_out[0]
    assert "rasnik two is described twice" in left_out[1]
    assert left_out[2] == "rasnik empty: mask is missing"
    data["bodies"][0]["position_mm"] = [0]
    (tmp_path / "bench.toml").write_text("\n".join(_toml(data)))
    with pytest.raises(SystemConfigError, match="bodies.0.position_mm"):
        load_installation(tmp_path / "bench.toml", left_out=left_out)


def test_unknown_installation() -> None:
    with pytest.raises(SystemConfigError, match="did you mean atlas-tower"):
        load_installation("atlas-towr")
    with pytest.raises(SystemConfigError, match="there is no such file"):
        load_installation("nowhere/tower.toml")


# ------------------------------------------------------------------------ network


def test_moving_everything_changes_no_reading(rng: np.random.Generator) -> None:
    network = random_network(rng)
    shift, turn = rng.normal(size=3) * 100, rng.normal(size=3)
    world = Rotation.from_rotvec(turn).as_matrix()
    motions = np.zeros((len(network.bodies), 6))
    for b, (p, base) in enumerate(zip(network.positions_mm, network.rotations, strict=True)):
        motions[b, :3] = 1e3 * base.T @ (world @ p + shift - p)
        motions[b, 3:] = Rotation.from_matrix(base.T @ world @ base).as_rotvec()
    np.testing.assert_allclose(network.values(motions), network.nominal, rtol=1e-9, atol=1e-6)


def test_derivatives_against_differences(rng: np.random.Generator) -> None:
    network = random_network(rng)
    motions = np.hstack([rng.normal(size=(4, 3)) * 2000, rng.normal(size=(4, 3)) * 0.01])
    jacobian = network.jacobian(motions)
    for b in range(4):
        for d in range(6):
            step = 1.0 if d < 3 else 1e-5
            up, down = motions.copy(), motions.copy()
            up[b, d] += step
            down[b, d] -= step
            slope = (network.values(up) - network.values(down)) / (2 * step)
            for v in range(4):
                size = np.abs(jacobian[:, v, :, d]).max()
                np.testing.assert_allclose(jacobian[:, v, b, d], slope[:, v], atol=1e-6 * size)


def test_a_rasnik_on_one_body_reads_the_same_always(rng: np.random.Generator) -> None:
    data = short()
    for kind in ("mask", "lens", "sensor"):
        data["rasniks"][0][kind]["body"] = "stage"
    data["rasniks"][0]["lens"]["position_mm"] = [0, 0, 300]
    network = Network(Installation.model_validate(data))
    motions = rng.normal(size=(2, 6)) * [1e3, 1e3, 1e3, 0.1, 0.1, 0.1]
    np.testing.assert_allclose(network.values(motions)[0], network.nominal[0], atol=1e-9)
    assert np.abs(network.jacobian(motions)[0]).max() < 1e-9


# ----------------------------------------------------------------------- readings


ROWS: list[dict[str, Any]] = [
    {"name": "one", "x_um": 1.5, "y_um": -2.0, "scale": 1.01, "theta_rad": 0.1, "sigma_x_um": 0.5},
    {"name": "two", "x_um": 3.0},
]


def test_all_formats_read_alike(tmp_path: Path) -> None:
    network = Network(Installation.model_validate(short()))
    named = {row["name"]: {k: v for k, v in row.items() if k != "name"} for row in ROWS}
    keys = ["name", "x_um", "y_um", "scale", "theta_rad", "sigma_x_um"]
    lines = [",".join(keys)] + [",".join(str(row.get(k, "")) for k in keys) for row in ROWS]
    texts = {
        "a.json": json.dumps(ROWS),
        "b.json": json.dumps(named),
        "c.json": json.dumps({"readings": ROWS}),
        "d.jsonl": "\n".join(json.dumps(row) for row in ROWS),
        "e.csv": "\n".join(lines),
        "f.toml": "\n".join(_toml(named)),
    }
    for name, text in texts.items():
        (tmp_path / name).write_text(text)
        found = read_readings(network, tmp_path / name)
        np.testing.assert_array_equal(found.values[0], [1.5, -2.0, 1.01, 0.1], err_msg=name)
        np.testing.assert_array_equal(found.values[1], [3.0, np.nan, np.nan, np.nan])
        np.testing.assert_array_equal(found.sigmas[0], [0.5, np.nan, np.nan, np.nan])
        assert not found.problems


def test_written_readings_come_back_exactly(tmp_path: Path, rng: np.random.Generator) -> None:
    network = random_network(rng)
    values = network.nominal.copy()
    values[2, 1], values[4] = np.nan, np.nan
    write_readings(network, values, tmp_path / "r.csv")
    found = read_readings(network, tmp_path / "r.csv")
    np.testing.assert_array_equal(found.values, values)
    assert found.problems == ("there is no reading of r4",)


@pytest.mark.parametrize(
    ("row", "sentence"),
    [
        ({"name": "three", "x_um": 1}, "reading 1 is of 'three', but there is no such Rasnik"),
        ({"x_um": 1}, "reading 1 has no name"),
        (7, "reading 1 is 7: it should be a table"),
        ({"name": "one"}, "the reading of one is left out: it holds none of x_um"),
        ({"name": "one", "x_um": "1,5"}, "x_um = '1,5' is not a number"),
        ({"name": "one", "x_um": "nan"}, "x_um = 'nan' is not a finite number"),
        ({"name": "one", "x_um": 1, "scale": -1}, "scale = -1 is not positive"),
        ({"name": "one", "x_um": 1, "sigma_x_um": 0}, "sigma_x_um = 0 is not positive"),
        ({"name": "one", "x_um": 1, "orientation": 2}, "it has orientation 2, but as described"),
        ({"name": "one", "x_um": 1, "orientation": "up"}, "orientation = 'up' is not a number"),
        ({"name": "one", "x_um": True}, "x_um = True is not a number"),
        (
            {"name": "one", "ok": False, "flags": ["no_mask"]},
            "the reading of one is left out: its analysis failed (no_mask)",
        ),
    ],
)
def test_a_bad_reading_is_named_and_the_rest_used(row: Any, sentence: str) -> None:
    network = Network(Installation.model_validate(short()))
    found = parse_readings(network, [row, ROWS[1]])
    assert any(sentence in text for text in found.problems), found.problems
    assert np.isnan(found.values[0]).all()
    assert found.values[1, 0] == 3.0


def test_tables_as_people_write_them(tmp_path: Path) -> None:
    network = Network(Installation.model_validate(short()))
    path = tmp_path / "r.csv"
    path.write_text("name, x_um , y_um\none, 1.5, -2.0\ntwo,3.0\n")
    found = read_readings(network, path)
    np.testing.assert_array_equal(found.values[:, :2], [[1.5, -2.0], [3.0, np.nan]])
    assert not found.problems
    path.write_text("name,x_um,y_um\none,1,5,-2,0\ntwo,3.0\n")  # 1.5 and -2.0, with commas
    found = read_readings(network, path)
    assert np.isnan(found.values[0]).all() and found.values[1, 0] == 3.0
    assert found.problems == (
        "the reading of one is left out: it has more values than the header line has columns; "
        "numbers have a decimal point, not a comma",
    )


def test_two_readings_of_one_rasnik() -> None:
    network = Network(Installation.model_validate(short()))
    found = parse_readings(network, [ROWS[0], ROWS[0], ROWS[1]])
    assert "there are 2 readings of one and none is used" in found.problems[0]
    assert np.isnan(found.values[0]).all()


def test_half_a_turn_is_the_same_image() -> None:
    network = Network(Installation.model_validate(short()))  # code 4
    found = parse_readings(network, [ROWS[0] | {"orientation": 1, "theta_rad": 0.1 - np.pi}])
    assert found.values[0, 3] == pytest.approx(0.1)


def test_results_of_images_are_known_by_their_file_or_folder() -> None:
    network = Network(Installation.model_validate(short()))
    rows = [
        {"file": "/data/today/one.png", "ok": "true", "x_um": "1", "flags": ""},
        {"file": "/data/two/0001.png", "ok": True, "x_um": 2.0, "flags": []},
    ]
    np.testing.assert_array_equal(parse_readings(network, rows).values[:, 0], [1, 2])


@pytest.mark.parametrize(
    ("name", "text", "sentence"),
    [
        ("a.json", "{", "cannot be read as json"),
        ("a.json", '{"x_um": 1}', "holds no readings"),
        ("a.csv", "x_um\n1\n", "the header line needs a column 'name'$"),
        ("a.csv", "name;x_um\none;1\n", "separated by commas, not by ';'"),
        ("a.csv", "name,x_um,x_um\none,1,2\n", "x_um must not stand more than once"),
        ("a.json", '{"one": {"x_um": 1}, "one": {"x_um": 2}}', "one must not stand more than once"),
        ("a.toml", "=", "not valid TOML"),
        ("a.xls", "", "readings are .csv, .json, .jsonl or .toml"),
    ],
)
def test_files_that_are_no_readings(tmp_path: Path, name: str, text: str, sentence: str) -> None:
    network = Network(Installation.model_validate(short()))
    (tmp_path / name).write_text(text)
    with pytest.raises(ValueError, match=sentence):
        read_readings(network, tmp_path / name)
