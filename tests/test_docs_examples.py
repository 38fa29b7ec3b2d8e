"""What stands in code blocks of the pages is run, page by page, each in a folder of its own.

Blocks marked ``python`` and ``bash`` are run in their order; python blocks of a page share their
names. A block marked ``output`` holds what the block before it prints: words must be the same,
numbers within 5 % (seeds are fixed, machines differ in the last digits), ``...`` stands for
anything, space is not compared. Blocks with other marks are only read.
"""

import contextlib
import io
import os
import re
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import pytest

DOCS = Path(__file__).resolve().parents[1] / "docs"
PAGES = sorted(DOCS.rglob("*.md"))
BLOCK = re.compile(r"^```(python|bash|output)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
PART = re.compile(r"(?P<any>\.\.\.)|(?P<number>\d+(?:\.\d+)?(?:e[-+]?\d+)?)|(?P<space>\s+)")


@dataclass(frozen=True)
class Block:
    kind: str
    text: str
    line: int


def blocks(page: Path) -> list[Block]:
    text = page.read_text(encoding="utf-8")
    return [
        Block(found[1], found[2], text.count("\n", 0, found.start()) + 2)
        for found in BLOCK.finditer(text)
    ]


def run_python(block: Block, page: Path, names: dict[str, object]) -> str:
    said = io.StringIO()
    code = compile("\n" * (block.line - 1) + block.text, str(page), "exec")
    with contextlib.redirect_stdout(said):
        exec(code, names)
    return said.getvalue()


def run_bash(block: Block, page: Path) -> str:
    programs = Path(sys.executable).parent
    environment = os.environ | {
        "PATH": f"{programs}{os.pathsep}{os.environ['PATH']}",
        "COLUMNS": "160",
        "MPLBACKEND": "agg",
    }
    run = subprocess.run(
        ["bash", "-euo", "pipefail", "-c", block.text],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env=environment,
        timeout=120,
    )
    assert run.returncode == 0, f"{page.name}, line {block.line}: {run.stdout}"
    return run.stdout


def prints_like(wanted: str, said: str) -> bool:
    """Whether a program said what a page shows."""
    pattern, numbers, end = "", [], 0
    wanted, said = wanted.strip(), said.strip()
    for part in PART.finditer(wanted):
        pattern += re.escape(wanted[end : part.start()])
        end = part.end()
        if part["number"]:
            numbers.append(float(part["number"]))
            pattern += r"(\d+(?:\.\d+)?(?:e[-+]?\d+)?)"
        else:
            pattern += ".*?" if part["any"] else r"\s+"
    found = re.fullmatch(pattern + re.escape(wanted[end:]), said, re.DOTALL)
    return found is not None and [float(number) for number in found.groups()] == [
        pytest.approx(number, rel=0.05) for number in numbers
    ]


def test_what_a_page_shows_is_compared() -> None:
    said = "x  9146.94 nm\n3 frames, 1389 a second\n"
    assert prints_like("x 9146.9 nm\n3 frames, ... a second", said)
    assert prints_like("...\n3 frames...", said)
    assert not prints_like("x 8146.9 nm\n3 frames, ... a second", said)
    assert not prints_like("y 9146.9 nm\n...", said)
    assert not prints_like("x 9146.9 nm", said)


@pytest.mark.slow
@pytest.mark.parametrize(
    "page", [page for page in PAGES if blocks(page)], ids=lambda page: page.stem
)
def test_examples_of_a_page_run(
    page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MPLBACKEND", "agg")
    names: dict[str, object] = {"__name__": "__main__"}
    said = ""
    for block in blocks(page):
        if block.kind == "python":
            said = run_python(block, page, names)
        elif block.kind == "bash":
            said = run_bash(block, page)
        elif not prints_like(block.text, said):
            pytest.fail(f"{page.name}, line {block.line}: what was said is\n{said}")
