"""Images of an archive that somebody should look at, each with the reason.

The places are dealt in turn to the kinds of trouble, so that a thousand images of one kind do
not hide the others: every reason of failure, scales that are not the system's, positions that
jump, images that differ from the model, and large stated errors.
"""

from __future__ import annotations

import math
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rasnik.analysis.flags import Flag, info_of
from rasnik.archive.rows import Rows

__all__ = ["Suspects", "Worst", "choose"]

_PLACES = 10
_EACH = 10  # kept of a kind and an instrument
_JUMP = 6.0  # times the scatter of a single image
_TIMES = 1.5  # times the median of the instrument
_BESIDE_FAILURES = ("scale", "jump", "misfit", "uncertain")
_SCALE = info_of(Flag.SCALE_UNEXPECTED)
#: Error of a mean of neighbours against the image between them: sqrt(1 + 1/2).
_AGAINST_NEIGHBOURS = math.sqrt(1.5)


@dataclass(frozen=True)
class Worst:
    """One image.

    Attributes
    ----------
    instrument, file : str
    frame : int
    kind : str
        A reason of failure, ``scale``, ``jump``, ``misfit`` or ``uncertain``.
    score : float
        How bad, compared with others of its kind.
    sentence : str
        Why it is here.
    system_toml : str
        The system it was analysed with; empty if it is not stored.
    """

    instrument: str
    file: str
    frame: int
    kind: str
    score: float
    sentence: str
    system_toml: str = ""

    @property
    def name(self) -> str:
        """File, and frame unless it is the first."""
        return f"{self.file}[{self.frame}]" if self.frame else self.file

    @property
    def is_failure(self) -> bool:
        """Whether it has no position."""
        return self.kind not in _BESIDE_FAILURES

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        names = ("instrument", "file", "frame", "kind", "sentence")
        return {name: getattr(self, name) for name in names}


@dataclass
class Suspects:
    """Images of one instrument that may be among the worst."""

    instrument: str
    failed: Counter[str] = field(default_factory=Counter)
    by_kind: dict[str, list[Worst]] = field(default_factory=lambda: defaultdict(list))

    def add(self, rows: Rows, reasons: Mapping[int, str]) -> None:
        """Look through some rows; `reasons` are those of the rows without a position."""
        self.failed.update(reasons.values())
        for index, reason in reasons.items():
            if len(self.by_kind[reason]) < _EACH:
                text = str(rows.text("error", index) or "no reason is stored")
                self._keep(rows, index, reason, 1.0, text)
        odd = [k for k in rows.flagged(_SCALE.name) if rows.ok[k]]
        if odd and not self.by_kind["scale"]:  # one shows it for all of the instrument
            text = f"the scale is {rows.numbers['scale'][odd[0]]:.4g}. {_SCALE.sentence}"
            self._keep(rows, int(odd[0]), "scale", 1.0, text)
        for name in ("x", "y"):
            self._largest(rows, f"jump {name}", _deviation(rows, f"{name}_um"))
        self._largest(rows, "chi2_ndf", np.where(rows.ok, rows.numbers["chi2_ndf"], np.nan))
        self._largest(rows, "sigma_x_um", np.where(rows.ok, rows.numbers["sigma_x_um"], np.nan))

    def _largest(self, rows: Rows, kind: str, values: NDArray[np.float64]) -> None:
        """Keep the rows with the largest values."""
        held = self.by_kind[kind]
        values = np.where(np.isfinite(values), values, -np.inf)
        least = held[-1].score if len(held) == _EACH else -np.inf
        for index in np.argsort(-values, kind="stable")[:_EACH]:
            if values[index] > least:
                self._keep(rows, int(index), kind, float(values[index]), "")
        held.sort(key=lambda one: -one.score)
        del held[_EACH:]

    def _keep(self, rows: Rows, index: int, kind: str, score: float, sentence: str) -> None:
        file, frame = rows.text("file", index), rows.text("frame", index)
        worst = Worst(
            self.instrument, file or "", frame or 0, kind, score, sentence, rows.system_toml
        )
        self.by_kind[kind].append(worst)

    def compare(self, scatter_nm: Mapping[str, float], usual: Mapping[str, float]) -> None:
        """Turn numbers into what is remarkable about them, and forget what is not.

        Parameters
        ----------
        scatter_nm : mapping of str to float
            Scatter of x and y from image to image, where it was measured.
        usual : mapping of str to float
            Medians of ``chi2_ndf`` and ``sigma_x_um``.
        """
        for name in ("x", "y"):
            jumps, scatter = self.by_kind.pop(f"jump {name}", []), scatter_nm.get(name, math.nan)
            for one in jumps:
                times = 1e3 * one.score / (scatter * _AGAINST_NEIGHBOURS) if scatter > 0 else 0.0
                if times > _JUMP:
                    sentence = (
                        f"{name} is {one.score:.4g} um off the mean of its neighbours, {times:.0f} "
                        "times what the scatter explains"
                    )
                    self._remark(one, "jump", times, sentence)
        for column, kind, what in (
            ("chi2_ndf", "misfit", "chi2_ndf"),
            ("sigma_x_um", "uncertain", "the stated error of x, in um,"),
        ):
            for one in self.by_kind.pop(column, []):
                times = one.score / usual[column] if usual[column] > 0 else 0.0
                if times > _TIMES:
                    sentence = (
                        f"{what} is {one.score:.4g}, {times:.1f} times the instrument's usual"
                    )
                    self._remark(one, kind, times, sentence)

    def _remark(self, one: Worst, kind: str, score: float, sentence: str) -> None:
        self.by_kind[kind].append(replace(one, kind=kind, score=score, sentence=sentence))


def _deviation(rows: Rows, name: str) -> NDArray[np.float64]:
    """How far each value is from the mean of the values before and after it.

    Only where it is further than theirs are, which a jump disturbs by half as much.
    """
    values = np.where(rows.ok, rows.numbers[name], np.nan)
    found = np.full(len(values), np.nan)
    if len(values) > 2:
        middle = np.abs(values[1:-1] - 0.5 * (values[2:] + values[:-2]))
        found[1:-1] = np.where(rows.follows[1:-1] & rows.follows[2:], middle, np.nan)
        around = np.nan_to_num(np.pad(found, 1, constant_values=np.nan), nan=-np.inf)
        found[(found < around[:-2]) | (found < around[2:])] = np.nan
    return found


def choose(suspects: Iterable[Suspects], places: int = _PLACES) -> list[Worst]:
    """The worst images of all instruments: one of each kind in turn, until there is no place.

    Kinds of failure come first, the most frequent one before the others. Within a kind
    different instruments come first.
    """
    failed: Counter[str] = Counter()
    piles: dict[str, list[tuple[int, float, int, Worst]]] = defaultdict(list)
    for number, one in enumerate(suspects):
        failed.update(one.failed)
        for kind, images in one.by_kind.items():
            images = sorted(images, key=lambda image: -image.score)
            piles[kind] += [(k, -image.score, number, image) for k, image in enumerate(images)]
    for pile in piles.values():
        pile.sort(key=lambda entry: entry[:3], reverse=True)  # the first is taken from the end
    order = [kind for kind, _ in failed.most_common()] + [*_BESIDE_FAILURES]
    chosen: dict[tuple[str, int], Worst] = {}
    while len(chosen) < places and any(piles.get(kind) for kind in order):
        for kind in order:
            while piles.get(kind) and len(chosen) < places:
                image = piles[kind].pop()[3]
                if (image.file, image.frame) not in chosen:
                    chosen[image.file, image.frame] = image
                    break
    return list(chosen.values())
