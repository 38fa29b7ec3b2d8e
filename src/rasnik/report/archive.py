"""The summary of an archive as one HTML file with its pictures inside, and as a table in CSV.

What is drawn is the document that `rasnik archive summary --json` prints.
"""

from __future__ import annotations

import base64
import csv
import html
import io
import os
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from rasnik import __version__
from rasnik.report.numbers import with_sigma

__all__ = [
    "Picture",
    "archive_figure",
    "draw_overview",
    "write_archive_page",
    "write_archive_table",
]

Document = Mapping[str, Any]

_DPI = 110
_COLOURS = {"x": "#2f6fb3", "y": "#d1762b"}
_FAILED = "#b3382f"
_SPREAD = 300.0  # largest over median
_MOST_NAMES = 24  # on an axis
_MOST_REMARKS = 200  # on the page
_STYLE = """
body { margin: 0 auto; max-width: 84rem; padding: 2rem 1.5rem 4rem; color: #1b1f24;
  font: 15px/1.5 system-ui, "Segoe UI", Arial, sans-serif; background: #fff; }
h1 { font-size: 1.6rem; margin: 0 0 .3rem; } h2 { font-size: 1.15rem; margin: 2.2rem 0 .6rem; }
p, li { max-width: 54rem; } .soft { color: #5a6472; }
.numbers { display: flex; flex-wrap: wrap; gap: .8rem 2.4rem; margin: 1rem 0; }
.numbers b { display: block; font-size: 1.5rem; line-height: 1.2; }
.faults { border-left: 4px solid #b3382f; background: #fdf3ec; padding: .5rem 1rem; }
img { max-width: 100%; height: auto; display: block; }
figure { margin: 1rem 0 2rem; } figcaption { max-width: 60rem; overflow-wrap: anywhere; }
.wide { overflow-x: auto; max-height: 80vh; }
table { border-collapse: collapse; font-size: .85rem; }
th, td { text-align: right; padding: .25rem .6rem; border-bottom: 1px solid #d5dae1;
  white-space: nowrap; }
th { background: #f3f6fa; position: sticky; top: 0; cursor: pointer; }
th:first-child, td:first-child, td.text { text-align: left; }
"""
_SORT = """
document.querySelectorAll("th").forEach((head, column) => head.onclick = () => {
  const body = document.querySelector("tbody"), rows = [...body.rows];
  const value = row => {
    const text = row.cells[column].dataset.value ?? row.cells[column].textContent;
    return text === "" || text === "-" ? NaN : isNaN(text) ? text : Number(text);
  };
  const down = head.dataset.down = head.dataset.down === "1" ? "0" : "1";
  rows.sort((a, b) => {
    const p = value(a), q = value(b);
    if (Number.isNaN(p) || Number.isNaN(q)) return Number.isNaN(p) - Number.isNaN(q);
    return (down === "1" ? -1 : 1) * (p > q ? 1 : p < q ? -1 : 0);
  });
  body.append(...rows);
});
"""


@dataclass(frozen=True)
class Picture:
    """One of the worst images: its description in the document, and a PNG if it can be drawn."""

    about: Mapping[str, Any]
    png: bytes | None
    remark: str = ""


# ------------------------------------------------------------------------ the figure


def archive_figure(document: Document) -> Figure:
    """Resolution against stated errors, drift, failures, and images by day."""
    instruments = document["instruments"]
    figure = Figure(figsize=(13, 8.4), dpi=_DPI, layout="constrained")
    FigureCanvasAgg(figure)
    (ratio, moved), (failed, days) = figure.subplots(2, 2)
    _draw_ratios(ratio, instruments)
    _draw_drifts(moved, instruments)
    _draw_failures(failed, instruments)
    _draw_days(days, document["days"])
    for axes in (ratio, moved, failed):
        _name_instruments(axes, [one["instrument"] for one in instruments])
    return figure


def draw_overview(document: Document) -> bytes:
    """The figure as a PNG."""
    sink = io.BytesIO()
    with warnings.catch_warnings():  # a letter that no font here has is drawn as a box
        warnings.filterwarnings("ignore", message="Glyph .* missing from font")
        archive_figure(document).savefig(sink, format="png")
    return sink.getvalue()


def _points(axes: Axes, name: str, values: Sequence[Any], errors: Sequence[Any]) -> None:
    y = np.array([np.nan if v is None else v for v in values], dtype=float)
    sigma = np.array([np.nan if v is None else v for v in errors], dtype=float)
    shift = -0.12 if name == "x" else 0.12
    axes.errorbar(
        np.arange(len(y)) + shift, y, np.nan_to_num(sigma), fmt="o", markersize=4, capsize=2,
        color=_COLOURS[name], label=name,
    )  # fmt: skip


def _draw_ratios(axes: Axes, instruments: Sequence[Document]) -> None:
    for name in _COLOURS:
        found = [one["resolution_nm"].get(name) or {} for one in instruments]
        ratios = [f.get("ratio") for f in found]
        _points(axes, name, ratios, [f.get("ratio_error") for f in found])
        if any(r is not None and r > 5 for r in ratios):
            axes.set_yscale("log")
    axes.axhline(1.0, color="black", linewidth=1, linestyle="--")
    axes.set_ylabel("scatter between images / stated error")
    axes.set_title("Resolution against the stated error (1: as stated)", fontsize=10)
    # Beside the title: inside, its signs look like more points.
    axes.legend(frameon=False, fontsize=8, ncols=2, loc="lower right", bbox_to_anchor=(1.0, 1.0))


def _draw_drifts(axes: Axes, instruments: Sequence[Document]) -> None:
    for name in _COLOURS:
        found = [one["drift_um_per_day"].get(name) or {} for one in instruments]
        # Without an error a slope says nothing.
        known = [f.get("slope") if f.get("sigma") is not None else None for f in found]
        _points(axes, name, known, [f.get("sigma") for f in found])
    axes.axhline(0.0, color="black", linewidth=1)
    _spread_out(axes)
    axes.set_ylabel("drift, µm/day")
    axes.set_title("Drift with one standard deviation", fontsize=10)


def _spread_out(axes: Axes) -> None:
    """A logarithmic axis on both sides of zero, where a few values are far larger than most."""
    sizes = np.concatenate(
        [np.abs(np.asarray(line.get_ydata(), dtype=float)) for line in axes.lines]
    )
    sizes = sizes[np.isfinite(sizes) & (sizes > 0)]
    if len(sizes) and sizes.max() > _SPREAD * np.median(sizes):
        axes.set_yscale("symlog", linthresh=3 * float(np.median(sizes)))
        axes.set_ylim(-3 * sizes.max(), 3 * sizes.max())


def _draw_failures(axes: Axes, instruments: Sequence[Document]) -> None:
    reasons: dict[str, int] = {}
    for one in instruments:
        for reason, count in one["failed"].items():
            reasons[reason] = reasons.get(reason, 0) + count
    base = np.zeros(len(instruments))
    for reason in sorted(reasons, key=lambda name: -reasons[name]):
        part = np.array([100.0 * i["failed"].get(reason, 0) / i["images"] for i in instruments])
        axes.bar(
            np.arange(len(instruments)), part, bottom=base, label=f"{reason}: {reasons[reason]:,}"
        )
        base += part
    axes.set_ylim(0, max(1.0, 1.15 * float(base.max(initial=0.0))))
    axes.set_ylabel("images without a position, %")
    axes.set_title("Failures by reason", fontsize=10)
    if reasons:
        axes.legend(frameon=False, fontsize=8)


def _draw_days(axes: Axes, days: Mapping[str, Sequence[int]]) -> None:
    names = list(days)
    images = np.array([days[name][0] for name in names], dtype=float)
    failed = np.array([days[name][1] for name in names], dtype=float)
    place = np.arange(len(names))
    axes.bar(place, images - failed, color=_COLOURS["x"], label="with a position")
    axes.bar(place, failed, bottom=images - failed, color=_FAILED, label="without")
    axes.set_ylim(0, 1.25 * max(1.0, float(images.max(initial=0.0))))  # room for the legend
    shown = place if len(names) <= 12 else np.linspace(0, len(names) - 1, 10).astype(int)
    axes.set_xticks(shown, [names[k] for k in shown], rotation=40, ha="right", fontsize=8)
    axes.set_ylabel("images a day")
    axes.set_title("Images by day (UTC)", fontsize=10)
    axes.legend(frameon=False, fontsize=8)


def _name_instruments(axes: Axes, names: Sequence[str]) -> None:
    axes.set_xlim(-0.6, len(names) - 0.4)
    axes.grid(axis="y", color="#e4e4e4")
    axes.set_axisbelow(True)
    if len(names) > _MOST_NAMES:
        axes.set_xlabel(f"instrument, 0 to {len(names) - 1} as in the table")
        return
    labels = [name if len(name) < 20 else f"{name[:18]}…" for name in names]
    labels = [label.replace("$", r"\$") for label in labels]  # which is for formulas
    axes.set_xticks(range(len(names)), labels, rotation=40, ha="right", fontsize=8)


# ------------------------------------------------------------------------ the table

#: Heading, and how to find (value, sigma or None) in the description of an instrument.
_COLUMNS: tuple[tuple[str, str, tuple[str, ...], str], ...] = (
    ("images", "images", ("images",), ""),
    ("good", "good", ("good",), ""),
    *[
        column
        for c in ("x", "y")
        for column in (
            (f"resolution {c}, nm", f"resolution_{c}_nm", ("resolution_nm", c, "sigma"), "error"),
            (f"stated {c}, nm", f"stated_{c}_nm", ("resolution_nm", c, "stated"), ""),
            (f"ratio {c}", f"ratio_{c}", ("resolution_nm", c, "ratio"), "ratio_error"),
            (f"drift {c}, µm/day", f"drift_{c}_um_per_day", ("drift_um_per_day", c, "slope"),
             "sigma"),
        )
    ],
    ("interval, s", "interval_s", ("interval_s",), ""),
    ("chi2/ndf", "chi2_ndf", ("chi2_ndf", "1"), ""),
    ("blur, µm", "blur_um", ("blur_um", "1"), ""),
    ("light, grey", "light_level", ("light_level", "1"), ""),
)  # fmt: skip


def _value(one: Any, path: Sequence[str]) -> float | None:
    """A number of the document by its path; None where it is not known."""
    for key in path:
        if one is None:
            return None
        one = one[int(key)] if isinstance(one, list) else one.get(key)
    return one


def _cells(one: Document) -> list[tuple[float | None, float | None]]:
    """(value, sigma) for each of `_COLUMNS`."""
    return [
        (_value(one, path), _value(one, (*path[:-1], sigma)) if sigma else None)
        for _, _, path, sigma in _COLUMNS
    ]


def write_archive_table(path: str | os.PathLike[str], document: Document) -> None:
    """Write a CSV file with one line for each instrument; empty cells are not measured.

    Raises
    ------
    OSError
        If the file cannot be written.
    """
    heads = ["instrument"]
    for _, key, _, sigma in _COLUMNS:
        heads += [key, f"sigma_{key}"] if sigma else [key]
    with open(path, "w", encoding="utf-8", newline="") as file:
        rows = csv.writer(file, lineterminator="\n")
        rows.writerow([*heads, "failed", "remarks"])
        for one in document["instruments"]:
            cells: list[Any] = [one["instrument"]]
            for (_, _, _, sigma), (value, error) in zip(_COLUMNS, _cells(one), strict=True):
                cells += [value, error] if sigma else [value]
            failed = " ".join(f"{reason}:{count}" for reason, count in one["failed"].items())
            rows.writerow([*cells, failed, "; ".join(one["remarks"])])


# ------------------------------------------------------------------------ the page


def write_archive_page(
    path: str | os.PathLike[str],
    document: Document,
    overview: bytes,
    pictures: Sequence[Picture],
) -> None:
    """Write the report as one HTML file that needs no other.

    Parameters
    ----------
    path : path-like
    document : mapping
        As of ``rasnik archive summary --json``.
    overview : bytes
        PNG by `draw_overview`.
    pictures : sequence of Picture
        The worst images.

    Raises
    ------
    OSError
        If the file cannot be written.
    """
    parts = [
        "<h1>Summary of an archive</h1>",
        f'<p class="soft">{_text(document["dataset"])}</p>',
        _headline(document),
        _listed("Faults of the dataset", document["faults"], "faults"),
        f"<figure>{_image(overview, 'overview')}</figure>",
        "<h2>Images to look at</h2>",
        *([_picture(one) for one in pictures] or ["<p>No image stands out.</p>"]),
        "<h2>Instruments</h2>",
        "<p class=soft>Resolution: standard deviation of a single image, from the differences "
        "between successive images; in the column after it the error stated with the positions. "
        "Drift: error for scatter that is correlated in time. chi2, blur and light: medians. "
        "±: one standard deviation. -: not measured. A click on a heading sorts.</p>",
        _table(document["instruments"]),
        _remarks(document["instruments"]),
        f'<p class="soft">rasnik {__version__}, {datetime.now(UTC):%Y-%m-%d %H:%M} UTC</p>',
    ]
    page = (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>Summary of an archive</title><style>{_STYLE}</style></head>\n<body>"
        + "\n".join(filter(None, parts))
        + f"<script>{_SORT}</script></body></html>\n"
    )
    with open(path, "w", encoding="utf-8", errors="backslashreplace") as file:
        file.write(page)


def _text(value: Any) -> str:
    return html.escape(str(value))


def _image(png: bytes, what: str) -> str:
    data = base64.b64encode(png).decode("ascii")
    return f'<img alt="{_text(what)}" src="data:image/png;base64,{data}">'


def _headline(document: Document) -> str:
    images, good = document["images"], document["good"]
    numbers = [
        ("instruments", f"{len(document['instruments']):,}"),
        ("images", f"{images:,}"),
        ("with a position", f"{good:,}"),
        ("without", f"{images - good:,}"),
        *[(f"of these {_text(name)}", f"{n:,}") for name, n in document["failed"].items()],
    ]
    cells = "".join(f"<div><b>{value}</b>{name}</div>" for name, value in numbers)
    return f'<div class="numbers">{cells}</div>'


def _listed(title: str, sentences: Sequence[str], kind: str) -> str:
    if not sentences:
        return ""
    items = "".join(f"<li>{_text(one)}</li>" for one in sentences)
    return f'<div class="{kind}"><b>{title}</b><ul>{items}</ul></div>'


def _picture(one: Picture) -> str:
    about = one.about
    name = f"{about['file']}[{about['frame']}]" if about["frame"] else about["file"]
    image = "" if one.png is None else _image(one.png, name)
    says_more = one.remark not in ("", about["sentence"])
    remark = f" <span class=soft>{_text(one.remark)}</span>" if says_more else ""
    return (
        f"<figure><figcaption><b>{_text(about['kind'])}</b>, {_text(about['instrument'])}: "
        f"<code>{_text(name)}</code><br>{_text(about['sentence'])}{remark}</figcaption>{image}"
        "</figure>"
    )


def _table(instruments: Sequence[Document]) -> str:
    heads = ["instrument", *(head for head, *_ in _COLUMNS), "failed"]
    lines = []
    for one in instruments:
        failed = ", ".join(f"{count:,} {reason}" for reason, count in one["failed"].items())
        cells = [f"<td>{_text(one['instrument'])}</td>"]
        for value, sigma in _cells(one):
            shown = "-" if value is None else _number(value, sigma)
            sorts = "" if value is None else f"{value:.9g}"
            cells.append(f'<td data-value="{sorts}">{shown}</td>')
        cells.append(f'<td class="text">{_text(failed)}</td>')
        lines.append(f"<tr>{''.join(cells)}</tr>")
    head = "".join(f"<th>{_text(one)}</th>" for one in heads)
    return (
        f'<div class="wide"><table><thead><tr>{head}</tr></thead>'
        f"<tbody>{''.join(lines)}</tbody></table></div>"
    )


def _number(value: float, sigma: float | None) -> str:
    if sigma is not None:
        return with_sigma(value, sigma)
    return f"{value:,}" if isinstance(value, int) else f"{value:.4g}"


def _remarks(instruments: Sequence[Document]) -> str:
    said = [f"{one['instrument']}: {remark}." for one in instruments for remark in one["remarks"]]
    more = len(said) - _MOST_REMARKS
    if more > 0:
        said = [*said[:_MOST_REMARKS], f"and {more:,} more, in the table of the CSV file."]
    return _listed("Remarks", said, "remarks")
