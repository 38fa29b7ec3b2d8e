"""All figures, two at a time; one that fails does not stop the others."""

from __future__ import annotations

import importlib
import json
import os
import time
from collections.abc import Callable, Iterable
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from rasnik.paper.outcome import Effort, Row, Value

__all__ = ["PARTS", "Part", "Result", "parts_named", "redo", "redo_all"]


@dataclass(frozen=True)
class Part:
    """A figure of the paper, or figures that need the same images.

    Attributes
    ----------
    name : str
        Of its files.
    function : str
        ``module:function`` in this package, called with an `Effort`.
    weight : float
        Rough share of the time; the longest begin first.
    """

    name: str
    function: str
    weight: float


#: In the order of the paper.
PARTS: tuple[Part, ...] = (
    Part("contour", "contour:contour", 4),
    Part("chessfield", "pictures:chessfield", 1),
    Part("pixel-noise", "pixel_noise:pixel_noise", 8),
    Part("blur", "pictures:blur", 1),
    Part("exaggerated-noise", "pictures:exaggerated_noise", 1),
    Part("image-spectrum", "fourier_picture:image_spectrum", 2),
    Part("scatter", "scatter:scatter", 33),
    Part("linearity", "linearity:linearity", 60),
    Part("light-levels", "floors:light_levels", 110),
    Part("frame-rates", "floors:frame_rates", 85),
    Part("solidras-image", "pictures:solidras_image", 2),
    Part("resolution", "resolution:resolution", 25),
    Part("solidras-uv", "floors:solidras_uv", 30),
    Part("microras", "floors:microras", 31),
    Part("improvements", "improvements:steps", 15),
)


@dataclass(frozen=True)
class Result:
    """What became of a part.

    Attributes
    ----------
    document : dict
        As in its JSON file; empty if it failed.
    error : str
        Why it failed; "" if it did not.
    seconds, processor_s : float
        On the clock, and of the processor.
    """

    name: str
    document: dict[str, Any]
    error: str
    seconds: float
    processor_s: float = 0.0

    @property
    def rows(self) -> tuple[Row, ...]:
        """Its lines of the table."""
        return tuple(_row(one) for one in self.document.get("rows", ()))


def parts_named(names: Iterable[str]) -> list[Part]:
    """The parts of these names, in the order of the paper; all of them if none is named.

    Raises
    ------
    ValueError
        If a name is not that of a part.
    """
    known = [part.name for part in PARTS]
    wanted = set(names) or set(known)
    unknown = sorted(wanted - set(known))
    if unknown:
        raise ValueError(f"there is no figure {', '.join(unknown)}; they are {', '.join(known)}")
    return [part for part in PARTS if part.name in wanted]


def redo(part: Part, folder: Path, effort: Effort) -> Result:
    """Make one part and write its picture and its JSON.

    Whatever goes wrong is in the result: one figure must not take the others with it.
    """
    start, worked = time.perf_counter(), time.process_time()
    document: dict[str, Any] = {}
    error = ""
    try:
        module, _, function = part.function.partition(":")
        make = getattr(importlib.import_module(f"rasnik.paper.{module}"), function)
        outcome = make(effort)
        outcome.figure.savefig(folder / f"{part.name}.png")
        made = {"name": part.name, "quick": effort.quick, **outcome.as_dict()}
        text = json.dumps(made, indent=1, allow_nan=False)
        (folder / f"{part.name}.json").write_text(text + "\n", encoding="utf-8")
        document = made
    except Exception as failure:
        error = f"{type(failure).__name__}: {failure}"
    seconds, processor_s = time.perf_counter() - start, time.process_time() - worked
    return Result(part.name, document, error, seconds, processor_s)


def redo_all(
    folder: Path,
    effort: Effort,
    names: Iterable[str] = (),
    workers: int | None = None,
    finished: Callable[[Result], object] = lambda result: None,
) -> list[Result]:
    """Make all parts, or those named, and write their files.

    Parameters
    ----------
    folder : Path
        Exists.
    effort : Effort
    names : iterable of str
        Which parts; all by default.
    workers : int, optional
        Processes; by default one for each processor core.
    finished : callable
        Called with each result as it comes.

    Returns
    -------
    list of Result
        In the order of the paper.

    Raises
    ------
    ValueError
        If a name is not that of a part.
    """
    parts = parts_named(names)
    count = max(1, min(workers or os.cpu_count() or 1, len(parts)))
    longest_first = sorted(parts, key=lambda part: -part.weight)
    results: dict[str, Result] = {}

    def take(result: Result) -> None:
        results[result.name] = result
        finished(result)

    if count == 1:
        for part in longest_first:
            take(redo(part, folder, effort))
    else:
        # New interpreters: a fork would copy threads in an unknown state.
        with ProcessPoolExecutor(count, get_context("spawn")) as pool:
            waiting = {pool.submit(redo, part, folder, effort): part for part in longest_first}
            for future in as_completed(waiting):
                take(_outcome_of(future, waiting[future]))
    return [results[part.name] for part in parts]


def _outcome_of(future: Future[Result], part: Part) -> Result:
    """The result, also of a process that died."""
    error = future.exception()
    if error is not None:
        return Result(part.name, {}, f"{type(error).__name__}: {error}", 0.0)
    return future.result()


def _row(document: dict[str, Any]) -> Row:
    values = {
        key: None if document[key] is None else _value(document[key])
        for key in ("fourier", "likelihood", "bound")
    }
    return Row(**{**document, **values})


def _value(document: dict[str, float | None]) -> Value:
    nan = float("nan")
    value, sigma = document["value"], document["sigma"]
    return Value(nan if value is None else value, nan if sigma is None else sigma)
