"""What several test modules share."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

# Tests of what happens in time: cameras, stations, pages, processes that are killed. They run one
# after the other, the rest beside each other (Makefile).
TIMED = (
    *("test_archive_run", "test_cameras_", "test_cli_archive", "test_cli_live", "test_controls_"),
    *("test_doctor", "test_live_", "test_recording_", "test_track_file", "test_warm_up"),
    "test_web_",
)

SHARED = Path(__file__).resolve().parents[2] / "shared"


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        if item.path.name.startswith(TIMED):
            item.add_marker("timed")


@pytest.fixture(scope="session")
def shared() -> Callable[[str], Path]:
    """``shared("vectors/truth.json")``: a file or folder beside the checkout, or skip."""

    def find(relative: str) -> Path:
        path = SHARED / relative
        if not path.exists():
            pytest.skip(f"../shared/{relative} is not beside this checkout")
        return path

    return find


@pytest.fixture
def rng(request: pytest.FixtureRequest) -> np.random.Generator:
    """Random numbers, the same in every run, different for every test."""
    return np.random.default_rng(list(request.node.nodeid.encode()))
