"""The table of ``rasnik analyse``: one row for each image, as wide as the terminal allows."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

from rich.markup import escape
from rich.table import Table

from rasnik.cli.common import output
from rasnik.report.numbers import concise

if TYPE_CHECKING:
    from rasnik.analysis.pose import Pose
    from rasnik.io.images import Frame

__all__ = ["print_table"]

_COLUMNS = ("x (µm)", "y (µm)", "theta (mrad)", "S", "or.", "chi2/ndf")
_WIDTHS = (94, 104, 112)  # characters from which on the last three columns are shown


def print_table(rows: list[tuple[Frame, Pose | None, str | None]]) -> None:
    """Print positions with their errors, and what is to be remarked on each image.

    Parameters
    ----------
    rows : list of (Frame, Pose or None, str or None)
        Each image, its pose if it was analysed, and why there is no position.
    """
    console = output()
    room = sum(console.width >= width for width in _WIDTHS)
    headings = _COLUMNS[: len(_COLUMNS) - len(_WIDTHS) + room]
    folder = _common_folder([frame.file for frame, _, _ in rows])
    if folder:
        console.print(escape(f"images in {folder}"))
    table = Table(box=None, pad_edge=False, header_style="bold")
    table.add_column("image", overflow="fold")
    for heading in headings:
        table.add_column(heading, justify="right", no_wrap=True)
    table.add_column("remarks", overflow="fold")
    stacks = {frame.file for frame, _, _ in rows if frame.frame > 0}
    for frame, pose, error in rows:
        name = os.path.relpath(frame.file, folder) if folder else frame.file
        name += f"[{frame.frame}]" if frame.file in stacks else ""
        cells = _cells(pose)[: len(headings)]
        table.add_row(escape(name), *cells, escape(_remarks(frame, pose, error)))
    console.print(table)
    if any(pose is not None and pose.ok for _, pose, _ in rows):
        console.print("(in parentheses: one standard deviation, in units of the last digit)")


def _common_folder(files: list[str]) -> str:
    """The folder that all files lie in, "" if there is none to speak of."""
    try:
        folder = os.path.commonpath([os.path.dirname(file) for file in files])
    except ValueError:  # relative and absolute names
        return ""
    return "" if Path(folder) == Path(folder).parent else folder


def _cells(pose: Pose | None) -> list[str]:
    if pose is None or not pose.ok:
        return ["-"] * len(_COLUMNS)
    return [
        concise(pose.x_um, pose.sigma_x_um),
        concise(pose.y_um, pose.sigma_y_um),
        concise(1e3 * pose.theta_rad, 1e3 * pose.sigma_theta_rad),
        concise(pose.scale, pose.sigma_scale),
        str(pose.orientation),
        f"{pose.chi2_ndf:.3f}",
    ]


def _remarks(frame: Frame, pose: Pose | None, error: str | None) -> str:
    words = [] if error is None else ["FAILED"]
    words += pose.flags.names if pose is not None else ["see below"]
    return ", ".join([*words, *frame.notes])
