"""The table of systems: thousands of rows, names and patterns, and faults named by row."""

import pickle
import time
from pathlib import Path

import pyarrow
import pytest
from pyarrow import parquet

from rasnik._config import SystemConfigError
from rasnik.archive.systems_table import InstrumentSettings, MissingSystemError, SystemsTable
from rasnik.instrument import load_system


def csv(folder: Path, *lines: str, head: str = "instrument,system") -> Path:
    path = folder / "systems.csv"
    path.write_text("\n".join((head, *lines)) + "\n", encoding="utf-8")
    return path


ALL = "instrument,system,overrides,model,orientation,frame_rate_hz"


def test_every_column_of_a_csv_row(tmp_path: Path) -> None:
    line = "EML1,solidras,optics.blur_um=7.5; sensor.frame_rate_hz=none,affine,3,12.5"
    table = SystemsTable.read(csv(tmp_path, line, "EML2,microras,,,,", head=ALL))
    one = table.of("EML1")
    assert one.system == load_system(
        "solidras", {"optics.blur_um": 7.5, "sensor.frame_rate_hz": None}
    )
    assert (one.model, one.orientation, one.frame_rate_hz) == ("affine", 3, 12.5)
    assert table.of("EML2") == InstrumentSettings(load_system("microras"))
    assert not table.faults


def test_the_three_formats_say_the_same(tmp_path: Path) -> None:
    from_csv = SystemsTable.read(csv(tmp_path, "A,solidras,optics.blur_um=7.5,,2,10", head=ALL))
    toml = tmp_path / "systems.toml"
    toml.write_text(
        '[[instruments]]\ninstrument = "A"\nsystem = "solidras"\norientation = 2\n'
        'frame_rate_hz = 10.0\noverrides = { "optics.blur_um" = 7.5 }\n'
    )
    rows = pyarrow.table(
        {
            "instrument": ["A"],
            "system": ["solidras"],
            "orientation": [2],
            "frame_rate_hz": [10.0],
            "overrides": ["optics.blur_um=7.5"],
            "model": pyarrow.array([None], pyarrow.string()),
        }
    )
    parquet.write_table(rows, tmp_path / "systems.parquet")
    expected = from_csv.of("A")
    assert SystemsTable.read(toml).of("A") == expected
    assert SystemsTable.read(tmp_path / "systems.parquet").of("A") == expected


def test_paths_of_systems_are_relative_to_the_table(tmp_path: Path) -> None:
    (tmp_path / "sub").mkdir()
    (tmp_path / "sub" / "mine.toml").write_text(load_system("solidras").to_toml())
    table = SystemsTable.read(csv(tmp_path, "A,sub/mine.toml", "B,none.toml"))
    assert table.of("A").system == load_system("solidras")
    with pytest.raises(MissingSystemError, match=r"line 3.*none\.toml.*no such file"):
        table.of("B")


def test_the_most_exact_row_wins(tmp_path: Path) -> None:
    path = csv(tmp_path, "*,solidras", "EML*,microras", "EML0?,solidras-uv", "EML07,microras-uv")
    table = SystemsTable.read(path)
    names = {"X": "solidras", "EML7": "microras", "EML08": "solidras-uv", "EML07": "microras-uv"}
    for instrument, system in names.items():
        assert table.of(instrument).system == load_system(system)


def test_patterns_that_fit_equally_well_are_refused(tmp_path: Path) -> None:
    table = SystemsTable.read(csv(tmp_path, "EML*,solidras", "*_1A,microras"))
    with pytest.raises(MissingSystemError, match=r"EML\* and \*_1A .* equally well"):
        SystemsTable.read(csv(tmp_path, "EML*,solidras", "*_1A,microras")).of("EML_1A")
    assert table.of("EML3").system == load_system("solidras")


def test_names_are_told_apart_by_case(tmp_path: Path) -> None:
    with pytest.raises(MissingSystemError, match="names no system for the instrument eml1"):
        SystemsTable.read(csv(tmp_path, "EML*,solidras")).of("eml1")


def test_faults_name_file_and_row_and_spare_the_rest(tmp_path: Path) -> None:
    path = csv(
        tmp_path,
        "A,solidra,,,,",
        "B,solidras,,,9,",
        "C,solidras,optics.blur=3,,,",
        "D,solidras,,,,fast",
        ",solidras,,,,",
        "E,solidras,,,,",
        "F,solidras,,,,",
        "F,microras,,,,",
        "G,,,,,",
        "H,solidras,optics.blur_um=6,,,,5",
        head=ALL,
    )
    table = SystemsTable.read(path, default=load_system("microras"))
    text = "\n".join(table.faults)
    for said in (
        "line 2: 'solidra': there is no system of this name; did you mean solidras",
        "line 3: orientation = 9",
        "line 4: solidras with overrides: there is no field optics.blur; did you mean",
        "line 5: frame_rate_hz = 'fast'",
        "line 6: instrument is missing",
        "line 9: F is in the table more than once",
        "line 10: system is missing",
        "line 11: '5' stands beyond the last column; put quotes",
    ):
        assert f"{path}, {said}" in text
    assert len(table.faults) == 8
    assert table.of("E").system == load_system("solidras")
    with pytest.raises(MissingSystemError, match="the system of B cannot be used"):
        table.of("B")  # the default must not take the place of a row with a fault


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        ("instrument,sytem\nA,solidras\n", "the column system is missing.*unknown columns: sytem"),
        ("instrument,system,system\nA,solidras,microras\n", "columns that are there twice: system"),
        ("instrument,system\n", "the table has no rows"),
        ("", "the column instrument is missing"),
        (b"instrument,system\n\xff\xfe,a\n", "this is not CSV in UTF-8"),
    ],
)
def test_what_is_no_table_is_refused(tmp_path: Path, content: str | bytes, sentence: str) -> None:
    path = tmp_path / "systems.csv"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(SystemConfigError, match=f"(?s)systems.csv.*{sentence}"):
        SystemsTable.read(path)


def test_other_files_are_refused(tmp_path: Path) -> None:
    with pytest.raises(SystemConfigError, match=r"\.txt is not a kind of table"):
        SystemsTable.read(tmp_path / "a.txt")
    for suffix in (".csv", ".toml", ".parquet"):
        with pytest.raises(SystemConfigError, match="no such file"):
            SystemsTable.read(tmp_path / f"a{suffix}")
    bad = tmp_path / "bad.parquet"
    bad.write_text("nothing")
    with pytest.raises(SystemConfigError, match="not a Parquet file"):
        SystemsTable.read(bad)
    one = tmp_path / "one.toml"
    one.write_text('[instruments]\nA = "solidras"\n')
    with pytest.raises(SystemConfigError, match=r"consists of \[\[instruments\]\]"):
        SystemsTable.read(one)


def test_thousands_of_channels(tmp_path: Path) -> None:
    path = csv(tmp_path, *(f"EML{k:05d},{('solidras', 'microras')[k % 2]}" for k in range(8000)))
    start_s = time.process_time()
    table = SystemsTable.read(path, default=load_system("atlas-ccd"))
    for k in range(8000):
        table.of(f"EML{k:05d}")
        table.of(f"other{k}")
    assert time.process_time() - start_s < 1.5  # 0.3 s where nothing else runs
    assert table.of("EML00002").system is table.of("EML00004").system  # one object in memory
    assert len(pickle.dumps(table)) < 3_000_000


def test_one_system_for_all() -> None:
    table = SystemsTable.for_all(InstrumentSettings(load_system("solidras"), orientation=2))
    assert table.of("anything").orientation == 2
    again = pickle.loads(pickle.dumps(table))
    assert again.of("anything") == table.of("other")
