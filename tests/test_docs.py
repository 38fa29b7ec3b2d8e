"""Pages that must keep up with the code: links, and tables made from those of the package."""

import re
from pathlib import Path

import pytest

from rasnik.analysis.flags import FLAGS
from rasnik.io.columns import COLUMNS

DOCS = Path(__file__).resolve().parents[1] / "docs"
pytestmark = pytest.mark.skipif(not DOCS.is_dir(), reason="the pages are not beside the tests")


@pytest.mark.parametrize("page", sorted(DOCS.glob("*.md")), ids=lambda page: page.name)
def test_links_lead_somewhere(page: Path) -> None:
    for target in re.findall(r"\]\(([^)#:]+?)(?:#[^)]*)?\)", page.read_text(encoding="utf-8")):
        assert (page.parent / target).exists(), f"{page.name} links to {target}"


def test_every_column_and_flag_of_results_is_described() -> None:
    text = (DOCS / "result-files.md").read_text(encoding="utf-8")
    for column in COLUMNS:
        row = (
            rf"\| `{column.name}` \| [a-z ]+ \| {column.unit} \| {re.escape(column.description)} \|"
        )
        assert re.search(row, text), column.name
    for info in FLAGS:
        fatal = "yes" if info.fatal else ""
        assert f"| {int(info.flag)} | `{info.name}` | {fatal} | {info.sentence} |" in text
