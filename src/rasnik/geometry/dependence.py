"""What one Rasnik cannot tell apart: motions whose effects on the reading are made of others."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rasnik.geometry.reading import READINGS
from rasnik.geometry.three_points import ALL_MOTIONS, ThreePoints, motion_unit

__all__ = ["dependent", "indistinguishable"]

# A column that is known to this part of its length is made of the others.
_DEPENDENT = 1e-9


def dependent(
    instrument: ThreePoints,
    names: Sequence[str] = ALL_MOTIONS,
    use: Sequence[str] = READINGS,
) -> dict[str, dict[str, float]]:
    """Motions that cannot be told from those named before them, to first order.

    Parameters
    ----------
    instrument : ThreePoints
    names : sequence of str
        Of `ALL_MOTIONS`.
    use : sequence of str
        The readings that are looked at, of `READINGS`.

    Returns
    -------
    dict
        ``{"lens_x": {"mask_x": -2.0}}``: 1 um of lens_x reads as -2 um of mask_x; an empty dict
        for a motion that is not read at all. What is not named can be told apart.
    """
    columns = instrument.natural_motions(names)
    matrix = instrument.matrix(names) / instrument.natural_readings[:, None] * columns
    matrix = matrix[[READINGS.index(name) for name in use]]
    kept: list[int] = []
    found: dict[str, dict[str, float]] = {}
    for k, name in enumerate(names):
        column, basis = matrix[:, k], matrix[:, kept]
        size = float(np.linalg.norm(column))
        parts = np.linalg.lstsq(basis, column)[0] if kept else np.zeros(0)
        if size <= _DEPENDENT:
            found[name] = {}
        elif np.linalg.norm(column - basis @ parts) > _DEPENDENT * size:
            kept.append(k)
        else:
            found[name] = {
                names[j]: float(part * columns[j] / columns[k])
                for j, part in zip(kept, parts, strict=True)
                if abs(part) > _DEPENDENT * size
            }
    return found


def indistinguishable(
    instrument: ThreePoints,
    names: Sequence[str] = ALL_MOTIONS,
    use: Sequence[str] = READINGS,
) -> list[str]:
    """The same in sentences.

    Parameters
    ----------
    instrument, names, use
        As in `dependent`.

    Returns
    -------
    list of str
        Empty if all can be told apart.
    """
    found = dependent(instrument, names, use)
    unseen = [name for name, parts in found.items() if not parts]
    said = []
    if unseen:
        seen_in = "the reading" if set(use) == set(READINGS) else ", ".join(use)
        said.append(f"{', '.join(unseen)}: not seen in {seen_in} to first order")
    for name, parts in found.items():
        if parts:
            same = " with ".join(_amount(part, name, other) for other, part in parts.items())
            said.append(f"1 {_shown_unit(name)} of {name} reads as {same}")
    return said


def _shown_unit(name: str) -> str:
    return "µrad" if motion_unit(name) == "rad" else "µm"


def _amount(value: float, of: str, name: str) -> str:
    # rad is shown as µrad on both sides, so only mixed units change the number
    ratio = {("rad", "um"): 1e-6, ("um", "rad"): 1e6}
    shown = value * ratio.get((motion_unit(of), motion_unit(name)), 1.0)
    return f"{shown:.6g} {_shown_unit(name)} of {name}"
