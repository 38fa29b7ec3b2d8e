"""The report: one HTML file with the table, every picture and what it says, pictures included."""

from __future__ import annotations

import base64
import html
import json
import os
import platform
from collections.abc import Iterable, Sequence
from dataclasses import asdict
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np

from rasnik import __version__
from rasnik.paper.outcome import Effort, Row, json_ready
from rasnik.paper.run import Result
from rasnik.paper.table import HEADINGS, cells, markdown, notes_of

__all__ = ["CONVENTIONS", "made_by", "write_all", "write_page"]

#: What has to be known to read the table.
CONVENTIONS = (
    "paper: as the paper states it, by its own analysis (SOAP), on its simulated or real images.",
    "fourier, likelihood: this package's two methods on images simulated here, with one standard "
    "deviation of the figure from the finite number of images.",
    "bound: the Cramer-Rao bound with rounding to 8 bits counted, or a figure that follows from "
    "the system's description alone.",
    "Noise floors are given in two conventions. sigma/√f is what the paper computes from a "
    "resolution per image (3.3 nm/√275 Hz = 200 pm/√Hz); the one-sided amplitude spectral "
    "density of that white noise, which a Welch plot shows, is sigma √(2/f), larger by √2.",
    "All lengths are on the mask, not in the image.",
)

_STYLE = """
:root { --ink: #1b1f24; --soft: #5a6472; --line: #d5dae1; --tint: #f3f6fa; --mark: #0072b2; }
* { box-sizing: border-box; }
body { margin: 0 auto; max-width: 66rem; padding: 2.5rem 1.5rem 4rem; color: var(--ink);
  font: 16px/1.5 system-ui, "Segoe UI", "Helvetica Neue", Arial, sans-serif; background: #fff; }
h1 { font-size: 1.75rem; line-height: 1.2; margin: 0 0 .4rem; }
h2 { font-size: 1.2rem; margin: 2.6rem 0 .6rem; padding-top: 1rem;
  border-top: 1px solid var(--line); }
h2 small { color: var(--mark); font-weight: 600; font-size: .85rem; margin-right: .6rem; }
p, li { max-width: 48rem; }
.lead { color: var(--soft); margin-top: 0; }
figure { margin: 1rem 0; }
figure img { max-width: 100%; height: auto; display: block; }
figcaption { color: var(--soft); font-size: .92rem; margin-top: .5rem; max-width: 48rem; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; font-size: .88rem; width: 100%; }
th, td { text-align: right; padding: .32rem .6rem; border-bottom: 1px solid var(--line);
  vertical-align: top; white-space: nowrap; }
th { background: var(--tint); font-weight: 600; position: sticky; top: 0; }
th:first-child, td:first-child { text-align: left; white-space: normal; min-width: 15rem; }
th:nth-child(2), td:nth-child(2) { text-align: left; color: var(--soft); }
td:nth-child(3) { white-space: normal; max-width: 14rem; }
td sup { color: var(--mark); padding-left: .2rem; }
ol.notes { font-size: .88rem; padding-left: 1.6rem; color: #303842; }
.failed { border-left: 4px solid #d55e00; background: #fdf3ec; padding: .6rem 1rem; }
code { background: var(--tint); padding: .05rem .3rem; border-radius: 3px; }
footer { color: var(--soft); font-size: .85rem; margin-top: 3rem;
  border-top: 1px solid var(--line); padding-top: 1rem; }
@media print {
  body { max-width: none; padding: 0; font-size: 10.5pt; }
  h2 { break-after: avoid; } figure, tr { break-inside: avoid; }
  th { position: static; } .wide { overflow: visible; } table { font-size: 8pt; }
  td, th { padding: .2rem .35rem; } p, li, figcaption { max-width: none; }
  ol.notes { font-size: 8pt; } figure img { max-height: 9.5cm; width: auto; }
  h2 { margin-top: 1.4rem; }
}
"""


def made_by(effort: Effort, seconds: float, only: Iterable[str] = ()) -> str:
    """Command, software, machine and duration of a run, in one line."""
    options = (" --quick" if effort.quick else "") + f" --seed {effort.seed}"
    options += "".join(f" --only {name}" for name in only)
    return (
        f"rasnik paper{options}: rasnik {__version__}, numpy {np.__version__}, "
        f"Python {platform.python_version()}, {os.cpu_count()} processor cores, "
        f"{date.today().isoformat()}, {seconds:.0f} s"
    )


def write_all(folder: Path, results: Sequence[Result], made: str) -> dict[str, Any]:
    """Write ``report.html``, ``table.md`` and ``results.json``; the content of the last."""
    rows = [row for result in results for row in result.rows]
    (folder / "table.md").write_text(f"{markdown(rows)}\n`{made}`\n", encoding="utf-8")
    write_page(folder / "report.html", folder, results, made)
    document = {
        "made": made,
        "rows": [json_ready(asdict(row)) for row in rows],
        "failed": {result.name: result.error for result in results if result.error},
        "seconds": {result.name: round(result.seconds, 1) for result in results},
        "processor_s": {result.name: round(result.processor_s, 1) for result in results},
    }
    text = json.dumps(document, indent=1, allow_nan=False)
    (folder / "results.json").write_text(text + "\n", encoding="utf-8")
    return document


def write_page(path: Path, folder: Path, results: Sequence[Result], made: str) -> None:
    """Write the report.

    Parameters
    ----------
    path : Path
    folder : Path
        Where the pictures are.
    results : sequence of Result
        In the order of the page; failed ones are named at the end.
    made : str
        Command, software, date and duration, for the foot of the page.
    """
    done = [result for result in results if not result.error]
    failed = [result for result in results if result.error]
    rows = [row for result in done for row in result.rows]
    parts = [
        "<h1>The paper's figures, done again</h1>",
        '<p class="lead">H. van der Graaf et al., <i>The ultimate performance of the Rasnik '
        "3-point alignment system</i>: what software can redo of its figures and numbers, by "
        "simulated instruments and this package's analysis.</p>",
        _failures(failed),
        "<ul>" + "".join(f"<li>{html.escape(one)}</li>" for one in CONVENTIONS) + "</ul>",
        _table(rows),
        *(_section(folder, result) for result in done),
        f"<footer>{html.escape(made)}</footer>",
    ]
    text = (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>The paper's figures, done again</title><style>{_STYLE}</style></head>\n<body>"
    )
    path.write_text(text + "\n".join(filter(None, parts)) + "</body></html>\n", encoding="utf-8")


def _failures(failed: Iterable[Result]) -> str:
    items = [
        f"<li><code>{html.escape(one.name)}</code>: {html.escape(one.error)}</li>" for one in failed
    ]
    if not items:
        return ""
    return f'<div class="failed"><b>These figures failed:</b><ul>{"".join(items)}</ul></div>'


def _table(rows: Sequence[Row]) -> str:
    if not rows:
        return ""
    notes, numbers = notes_of(rows)
    head = "".join(f"<th>{html.escape(one)}</th>" for one in HEADINGS)
    lines = []
    for row, number in zip(rows, numbers, strict=True):
        texts = [html.escape(one) for one in cells(row)]
        if number:
            texts[0] += f"<sup>{number}</sup>"
        lines.append("<tr>" + "".join(f"<td>{one}</td>" for one in texts) + "</tr>")
    below = "".join(f"<li>{html.escape(note)}</li>" for note in notes)
    return (
        f'<div class="wide"><table><thead><tr>{head}</tr></thead>'
        f'<tbody>{"".join(lines)}</tbody></table></div><ol class="notes">{below}</ol>'
    )


def _section(folder: Path, result: Result) -> str:
    document = result.document
    picture = base64.b64encode((folder / f"{result.name}.png").read_bytes()).decode("ascii")
    title, source = html.escape(document["title"]), html.escape(document["source"])
    return (
        f'<h2 id="{result.name}"><small>{source}</small>{title}</h2>'
        f'<figure><img alt="{title}" src="data:image/png;base64,{picture}">'
        f"<figcaption>{html.escape(document['caption'])}</figcaption></figure>"
    )
