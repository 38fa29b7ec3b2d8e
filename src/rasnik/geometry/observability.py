"""What an installation can measure: motions that no reading shows, named in words.

The derivatives of all readings, each over its standard deviation, times the range within which
each degree of freedom is believed to lie, make a matrix without units. Its singular values say by
how many standard deviations the readings change, all together, when the bodies move by the whole
range along the singular vector. Where that is less than one, the readings know no more than what
was believed before: such motions are *unmeasured*. They need no fine tuning: of those that a
network does not see at all the singular value is 0 up to rounding, and of those that it is built
to see it is 1000 and more.

Source: Golub and Van Loan, "Matrix Computations", section 5.5 (rank by singular values).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rasnik.geometry.network import Network
from rasnik.geometry.rigid import DOF_WORDS, DOFS, UM_PER_MM, skew

__all__ = ["LEAST_SIGNIFICANCE", "LEAKAGE", "Unmeasured", "name_motions", "unmeasured_space"]

Array = NDArray[np.float64]

#: Standard deviations by which readings must change over the whole range of a motion.
LEAST_SIGNIFICANCE = 1.0

#: Share of an unmeasured motion, of its range, that a quantity may hold and still count as
#: measured; what it holds is part of its error.
LEAKAGE = 0.01

# Part of a motion of unit length that must be new to be named besides others.
_NEW = 0.1


@dataclass(frozen=True)
class Unmeasured:
    """A motion that no reading shows.

    Attributes
    ----------
    words : str
        What moves.
    kind : str
        "freedom" (one degree of freedom of one body), "body" (a body that nothing measures),
        "group" (several bodies as one), "shape" (bodies in proportion to their place) or
        "combination".
    motion : dict of str to float
        ``"body.x_um"`` to how far it moves along, um or rad; the whole scales freely.
    """

    words: str
    kind: str
    motion: dict[str, float]


def unmeasured_space(whitened: Array) -> Array:
    """Motions that rows of readings over their errors, columns over ranges, do not show.

    Parameters
    ----------
    whitened : ndarray, shape (rows, n)
        Derivatives over standard deviations times ranges.

    Returns
    -------
    ndarray, shape (n, k)
        Orthonormal, in units of the ranges.
    """
    n = whitened.shape[1]
    if not whitened.size:
        return np.eye(n)
    rows = np.vstack([whitened, np.zeros((max(0, n - len(whitened)), n))])
    _, singular, motions = np.linalg.svd(rows, full_matrices=False)
    floor = np.finfo(float).eps * max(rows.shape) * singular[0]
    return np.asarray(motions[singular < max(LEAST_SIGNIFICANCE, floor)].T)


def name_motions(
    network: Network, free: NDArray[np.bool_], space: Array, ranges: Array, used: NDArray[np.bool_]
) -> list[Unmeasured]:
    """The simplest names for a space of unmeasured motions.

    Parameters
    ----------
    network : Network
    free : ndarray of bool, shape (bodies, 6)
    space : ndarray, shape (n, k)
        From `unmeasured_space`, n the number of free degrees of freedom.
    ranges : ndarray, shape (n,)
        um and rad.
    used : ndarray of bool, shape (rasniks,)
        Rasniks that take part.

    Returns
    -------
    list of Unmeasured
        As many as the space has dimensions, but six of one body count as one.
    """
    found: list[tuple[str, str, Array]] = []
    known = np.zeros((len(ranges), 0))
    for words, kind, motion in _candidates(network, free, used):
        scaled = motion[free] / ranges
        length = np.linalg.norm(scaled)
        if not length or known.shape[1] == space.shape[1]:
            continue
        scaled = scaled / length
        if np.linalg.norm(scaled - space @ (space.T @ scaled)) > LEAKAGE:
            continue
        fresh = scaled - known @ (known.T @ scaled)
        if np.linalg.norm(fresh) > _NEW:
            known = np.column_stack([known, fresh / np.linalg.norm(fresh)])
            found.append((words, kind, scaled * ranges))
    for motion in _rest(space, known):
        found.append(_in_words(network, free, motion * ranges))
    labels = [f"{network.bodies[b]}.{DOFS[d]}" for b, d in np.argwhere(free)]
    named = [Unmeasured(words, kind, _moving(labels, m, ranges)) for words, kind, m in found]
    return _joined(named)


def _candidates(
    network: Network, free: NDArray[np.bool_], used: NDArray[np.bool_]
) -> Iterator[tuple[str, str, Array]]:
    """Motions that have a name of their own, the simplest first."""
    for b, d in np.argwhere(free):
        motion = np.zeros(free.shape)
        motion[b, d] = 1.0
        yield f"{network.bodies[b]}: {DOF_WORDS[d]}", "freedom", motion
    for group in _groups(network, used):
        if len(group) > 1 and free[group].all():
            yield from _as_one(network, group)
    for group in _groups(network, used):
        if len(group) > 1:
            yield from _in_proportion(network, free, group)


def _groups(network: Network, used: NDArray[np.bool_]) -> list[list[int]]:
    """Bodies that are joined by Rasniks, directly or by others."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    count = len(network.bodies)
    carriers = network.carriers[used]
    start, end = carriers[:, [0, 0]].ravel(), carriers[:, 1:].ravel()
    graph = coo_matrix((np.ones(len(start)), (start, end)), shape=(count, count))
    _, labels = connected_components(graph, directed=False)
    return [np.flatnonzero(labels == k).tolist() for k in np.unique(labels)]


def _title(network: Network, group: list[int]) -> str:
    if len(group) == len(network.bodies):
        return "the whole installation"
    return f"{_listed(network, group)} together"


def _listed(network: Network, group: list[int]) -> str:
    names = [network.bodies[b] for b in group]
    return ", ".join(names[:-1]) + f" and {names[-1]}" if len(names) > 1 else names[0]


def _as_one(network: Network, group: list[int]) -> Iterator[tuple[str, str, Array]]:
    """A group of bodies moved as one, along and about the axes of the installation."""
    back = np.swapaxes(network.rotations, 1, 2)
    centre = network.positions_mm[group].mean(axis=0)
    for d, unit in enumerate(np.eye(3)):
        shift = np.zeros((len(network.bodies), 6))
        shift[group, :3] = back[group] @ unit
        yield f"{_title(network, group)}: translation along {'xyz'[d]}", "group", shift
    for d, unit in enumerate(np.eye(3)):
        turn = np.zeros((len(network.bodies), 6))
        arms = network.positions_mm[group] - centre
        around = UM_PER_MM * (skew(unit) @ arms.T).T
        turn[group, :3] = (back[group] @ around[..., None])[..., 0]
        turn[group, 3:] = back[group] @ unit
        yield f"{_title(network, group)}: rotation about {'xyz'[d]}", "group", turn


def _in_proportion(
    network: Network, free: NDArray[np.bool_], group: list[int]
) -> Iterator[tuple[str, str, Array]]:
    """Bodies shifted in proportion to their place: shears and stretches of a group."""
    back = np.swapaxes(network.rotations, 1, 2)
    fixed = [b for b in group if not free[b, :3].any()]
    origin = network.positions_mm[fixed[0] if fixed else group].reshape(-1, 3).mean(axis=0)
    arms = network.positions_mm - origin
    for along in range(3):
        for by in range(3):
            motion = np.zeros(free.shape)
            field = np.zeros((len(group), 3))
            field[:, along] = arms[group, by]
            motion[group, :3] = (back[group] @ field[..., None])[..., 0]
            if (np.abs(motion[~free]) > 1e-9 * np.abs(arms).max()).any():
                continue
            moving = [b for b in group if motion[b].any()]
            if len(moving) > 1:
                what = "stretch" if along == by else "shear"
                yield (
                    f"{_listed(network, moving)}: {what}, along {'xyz'[along]} in proportion to "
                    f"their distance in {'xyz'[by]}",
                    "shape",
                    motion,
                )


def _rest(space: Array, known: Array) -> Iterator[Array]:
    """What of a space is not yet known, in vectors with few entries (Gauss-Jordan)."""
    remaining = space - known @ (known.T @ space)
    left, sizes, _ = np.linalg.svd(remaining, full_matrices=False)
    rows = left[:, : space.shape[1] - known.shape[1]].T.copy()
    if not len(rows) or not sizes.size:
        return
    for k in range(len(rows)):
        column = np.unravel_index(np.argmax(np.abs(rows[k:])), rows[k:].shape)[1]
        best = k + int(np.argmax(np.abs(rows[k:, column])))
        rows[[k, best]] = rows[[best, k]]
        rows[k] /= rows[k, column]
        for other in range(len(rows)):
            if other != k:
                rows[other] -= rows[other, column] * rows[k]
    yield from rows


def _in_words(network: Network, free: NDArray[np.bool_], motion: Array) -> tuple[str, str, Array]:
    """A combination, as so many mm along with so many mrad about."""
    places = np.argwhere(free)
    shifts = np.array([d < 3 for _, d in places])
    sizes = np.abs(motion) * np.where(shifts, 1e-3, 1e3)  # mm, mrad
    lead = int(np.argmax(sizes * np.where(shifts, 1.0, 1e-3) if shifts.any() else sizes))
    unit = motion / (motion[lead] / (UM_PER_MM if shifts[lead] else 1e-3))
    shown = [k for k in np.argsort(-sizes) if sizes[k] > LEAKAGE * sizes[lead]]
    parts = []
    for k in [lead, *(k for k in shown if k != lead)]:
        b, d = places[k]
        amount = (
            f"{unit[k] / UM_PER_MM:.3g} mm along" if d < 3 else f"{1e3 * unit[k]:.3g} mrad about"
        )
        parts.append(f"{network.bodies[b]} {amount} {'xyz'[d % 3]}")
    return f"{' with '.join(parts[:2])}{''.join(f', {p}' for p in parts[2:])}", "combination", unit


def _moving(labels: list[str], motion: Array, ranges: Array) -> dict[str, float]:
    """What takes part in a motion by more than rounding; ranges make um and rad comparable."""
    sizes = np.abs(motion / ranges)
    return {labels[k]: float(motion[k]) for k in np.flatnonzero(sizes > 1e-6 * sizes.max())}


def _joined(named: list[Unmeasured]) -> list[Unmeasured]:
    """Six degrees of freedom of one body, or of one group, in one line."""
    heads = [one.words.split(": ")[0] for one in named]
    joined, done = [], set()
    for one, head in zip(named, heads, strict=True):
        if one.kind in ("freedom", "group") and heads.count(head) == 6:
            if head not in done:
                words = f"{head}: all six degrees of freedom"
                joined.append(Unmeasured(words, "body" if one.kind == "freedom" else one.kind, {}))
                done.add(head)
        else:
            joined.append(one)
    return joined
