"""Rules of the house, checked on the source: who may import whom, what stays light and quiet."""

import ast
import importlib
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest

import rasnik

PACKAGE = Path(rasnik.__file__).parent

# What is printed, what the instrument is, what the image must look like, where it is, how well;
# then files, cameras and screens. Nothing imports from a room to its right, not even inside a
# function.
ROOMS = (
    "_config",
    "mask",
    "instrument",
    "mask_files",
    "imaging",
    "analysis",
    "tracking",
    "performance",
    "geometry",
    "characterisation",
    "seismic",
    "io",
    "cameras",
    "recording",
    "live",
    "controls",
    "web",
    "report",
    "archive",
    "paper",
    "cli",
)

# (module, imported module): why it may.
EXCEPTIONS: dict[tuple[str, str], str] = {}

# Imports that take long or need an optional package; each is loaded where it is used.
HEAVY = {
    *("matplotlib", "h5py", "pyarrow", "numba", "PIL", "tifffile", "scipy", "gdstk", "ezdxf"),
    *("gi", "cv2", "starlette", "uvicorn", "softioc", "p4p", "paho", "prometheus_client", "psutil"),
}


def module_name(path: Path) -> str:
    parts = path.relative_to(PACKAGE.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


MODULES = {module_name(path): path for path in sorted(PACKAGE.rglob("*.py"))}
TREES = {name: ast.parse(path.read_text(encoding="utf-8")) for name, path in MODULES.items()}


def room(module: str) -> str:
    return module.split(".")[1] if "." in module else ""


def imports(module: str) -> Iterator[str]:
    """Every module of the package that a module imports, wherever the statement stands."""
    for node in ast.walk(TREES[module]):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if alias.name.startswith("rasnik."))
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{module} line {node.lineno}: imports are written in full"
            if node.module == "rasnik":
                for alias in node.names:
                    yield rasnik._HOME.get(alias.name, f"rasnik.{alias.name}")
            elif node.module and node.module.startswith("rasnik."):
                yield node.module


def test_every_module_is_in_a_room() -> None:
    assert {room(module) for module in MODULES} - {""} <= set(ROOMS)


@pytest.mark.parametrize("module", [name for name in MODULES if room(name)])
def test_nothing_imports_from_a_room_to_its_right(module: str) -> None:
    position = ROOMS.index(room(module))
    for imported in imports(module):
        if imported == "rasnik.__version__" or (module, imported) in EXCEPTIONS:
            continue
        assert ROOMS.index(room(imported)) <= position, f"{module} imports {imported}"


def test_exceptions_are_used_and_have_reasons() -> None:
    for (module, imported), reason in EXCEPTIONS.items():
        assert imported in set(imports(module)), f"{module} no longer imports {imported}"
        assert len(reason) > 10


def test_the_library_does_not_print() -> None:
    for module, tree in TREES.items():
        for node in ast.walk(tree):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
                assert node.func.id != "print" or room(module) == "cli", f"{module} {node.lineno}"


def loaded_by(statement: str) -> set[str]:
    """Top-level packages in memory of a new interpreter after a statement."""
    code = f"{statement}\nimport sys; print(*{{name.partition('.')[0] for name in sys.modules}})"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return set(run.stdout.split())


@pytest.mark.parametrize(
    ("statement", "heavy"),
    [
        ("import rasnik", HEAVY | {"numpy", "pydantic", "typer", "rich"}),
        ("import rasnik; rasnik.load_system('solidras')", HEAVY),
        ("import rasnik; rasnik.Pose", HEAVY),
        ("import rasnik.cli", HEAVY),
    ],
)
def test_what_stays_light(statement: str, heavy: set[str]) -> None:
    assert not loaded_by(statement) & heavy


def test_the_check_of_lightness_can_fail() -> None:
    assert "h5py" in loaded_by("import h5py")


def test_public_names_are_there() -> None:
    assert sorted(rasnik.__all__) == sorted({*rasnik._HOME, "__version__"})
    for name, home in rasnik._HOME.items():
        value = getattr(rasnik, name)
        assert value is getattr(importlib.import_module(home), name)
        assert value.__doc__, name
        assert name in dir(rasnik)
    with pytest.raises(AttributeError, match="has no attribute 'analyze'"):
        _ = rasnik.analyze


def test_type_checkers_see_the_same_public_names() -> None:
    seen = {
        alias.name: node.module
        for node in ast.walk(TREES["rasnik"])
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("rasnik.")
        for alias in node.names
    }
    assert seen == rasnik._HOME


def test_version_is_that_of_the_project_file() -> None:
    project = PACKAGE.parents[1] / "pyproject.toml"
    if not project.exists():
        pytest.skip("the package is installed without its checkout")
    with project.open("rb") as file:
        assert rasnik.__version__ == tomllib.load(file)["project"]["version"]
