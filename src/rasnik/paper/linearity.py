"""Linearity: x moved in steps, by the paper's generator and by the exact one."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from rasnik.analysis.analyse import analyse
from rasnik.characterisation.linearity import PAPER_SCANS, MethodError, Scan
from rasnik.characterisation.linearity import linearity as measure_linearity
from rasnik.imaging.paper import POINTS, paper_image
from rasnik.imaging.projection import Projection
from rasnik.paper.images import POSITION_UM, solidras
from rasnik.paper.outcome import (
    BLUE,
    GREEN,
    ORANGE,
    VERMILION,
    Effort,
    Outcome,
    Row,
    Value,
    new_figure,
)

__all__ = ["linearity"]

_METHODS = ("fourier", "likelihood")
#: Points along the side of a pixel, coarser than the package's choice; the paper's is not stated.
_COARSE = (3, 5)
_PAPER = {0.0: "35 (local slope off by 0.7)", 0.02: "~3 (offset)", 0.002: "5"}


def linearity(effort: Effort) -> Outcome:
    """Fig. 9: the error of x at theta_z = 0, 20 and 2 mrad."""
    scans = [replace(scan, positions=effort.pick(11, 41)) for scan in PAPER_SCANS]
    system = solidras()
    found: dict[tuple[str, float, str], MethodError] = {}
    for path in ("paper", "exact"):
        measured = measure_linearity(
            system, scans, methods=_METHODS, path=path, start_um=POSITION_UM
        )
        for one in measured.errors:
            found[path, one.scan.theta_rad, one.method] = one
    coarse = {points: _with_points(scans[0], points) for points in _COARSE}
    figure = new_figure(10.5, 7.0)
    panels = figure.subplots(2, 2)
    for axes, scan in zip(panels.flat, scans, strict=False):
        _draw(axes, found, scan)
    _draw_coarse(panels[1, 1], found["paper", 0.0, "likelihood"], coarse)
    figure.legend(
        *panels[0, 0].get_legend_handles_labels(),
        loc="outside lower center",
        ncols=4,
        frameon=False,
    )
    caption = (
        "x found minus x simulated in images without noise. First three panels: the paper's "
        "scans. Last panel: the likelihood fit at theta_z = 0 on images of the paper's generator "
        "with fewer points along the side of a pixel. A slope of −1 means that the image does "
        "not move at all while x is changed."
    )
    data = {
        "scans": {
            f"{path}, {1e3 * theta:g} mrad, {method}": one.as_dict()
            for (path, theta, method), one in found.items()
        },
        "fewer_points": {str(points): one.as_dict() for points, one in coarse.items()},
    }
    rows = _rows(scans, found, coarse)
    return Outcome("Fig. 9", "Linearity error", caption, figure, rows, data)


def _with_points(scan: Scan, points: int) -> MethodError:
    """The fit of images of the paper's generator, with so many points along a pixel."""
    system, (x0, y0) = solidras(), POSITION_UM
    errors = []
    for offset in scan.offsets_um.tolist():
        place = Projection.from_pose(x0 + offset, y0, 1.0, scan.theta_rad, 4)
        pose = analyse(paper_image(system, place, points=points), system, orientation=4)
        errors.append([1e3 * (pose.x_um - x0 - offset), 1e3 * (pose.y_um - y0)])
    return MethodError(scan, "likelihood", np.array(errors))


_LOOKS: dict[tuple[str, str], dict[str, Any]] = {
    ("paper", "fourier"): {"color": VERMILION, "marker": "^", "linestyle": "-"},
    ("paper", "likelihood"): {"color": ORANGE, "marker": "s", "linestyle": "--"},
    ("exact", "fourier"): {"color": GREEN, "marker": "v", "linestyle": "-."},
    ("exact", "likelihood"): {"color": BLUE, "marker": "o", "linestyle": "-"},
}


def _draw(axes: Axes, found: dict[tuple[str, float, str], MethodError], scan: Scan) -> None:
    unit, name = (1e3, "nm") if scan.range_um < 1 else (1.0, "µm")
    for (path, method), look in _LOOKS.items():
        one = found[path, scan.theta_rad, method]
        generator = "the paper's generator" if path == "paper" else "exact generator"
        axes.plot(
            unit * scan.offsets_um, one.along_nm, markersize=3.5, linewidth=1.1,
            label=f"{method}, {generator}", **look,
        )  # fmt: skip
    axes.set_title(f"theta_z = {1e3 * scan.theta_rad:g} mrad")
    _finish(axes, name)


def _draw_coarse(axes: Axes, usual: MethodError, coarse: dict[int, MethodError]) -> None:
    at = 1e3 * usual.scan.offsets_um
    looks = (("#000000", "x", ":"), ("#56b4e9", "D", "-"), (ORANGE, "s", "--"))
    for (points, one), (colour, marker, line) in zip(
        [*coarse.items(), (POINTS, usual)], looks, strict=True
    ):
        axes.plot(
            at, one.along_nm - one.along_nm.mean(), color=colour, marker=marker, linestyle=line,
            markersize=3.5, linewidth=1.1, label=f"{points} x {points} points in a pixel",
        )  # fmt: skip
    axes.set_title("theta_z = 0, fewer points (mean taken off)")
    axes.legend(frameon=False, fontsize=8)
    _finish(axes, "nm")


def _finish(axes: Axes, unit: str) -> None:
    axes.set_xlabel(f"x − 4000 µm, {unit}")
    axes.set_ylabel("error of x, nm")
    axes.grid(color="#e4e4e4")
    axes.set_axisbelow(True)


def _rows(
    scans: list[Scan],
    found: dict[tuple[str, float, str], MethodError],
    coarse: dict[int, MethodError],
) -> tuple[Row, ...]:
    rows = []
    few = coarse[_COARSE[0]].figures
    blamed = found["paper", 0.0, "likelihood"].figures
    why = (
        "The generator makes most of this error, not the Fourier phase: the fit that is good to "
        f"{found['exact', 0.0, 'likelihood'].figures['peak_to_peak_nm']:.1g} nm on exact images "
        f"sees {blamed['peak_to_peak_nm']:.2g} nm peak to peak in those of the paper's generator "
        f"with {POINTS} x {POINTS} points in a pixel, {few['peak_to_peak_nm']:.2g} nm with "
        f"{_COARSE[0]} x {_COARSE[0]}: contours in line with the pixels move only when they pass "
        "a point, and between such jumps the local slope is off by 1. How many points the paper "
        "takes is not stated."
    )
    for scan in scans:
        length = f"{1e3 * scan.range_um:g} nm" if scan.range_um < 1 else f"{scan.range_um:g} µm"
        for path in ("paper", "exact"):
            name = "the paper's generator" if path == "paper" else "exact generator"
            values = {
                method: Value(found[path, scan.theta_rad, method].figures["largest_nm"])
                for method in _METHODS
            }
            rows.append(
                Row(
                    f"largest linearity error, {1e3 * scan.theta_rad:g} mrad, {length}, {name}",
                    "nm",
                    _PAPER[scan.theta_rad] if path == "paper" else "",
                    **values,
                    why=why,
                )
            )
    return tuple(rows)
