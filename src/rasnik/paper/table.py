"""The table ``paper | fourier | likelihood | bound``, its notes, and both as Markdown."""

from __future__ import annotations

from collections.abc import Iterable

from rasnik.paper.outcome import Row, Value

__all__ = ["HEADINGS", "cells", "markdown", "notes_of"]

HEADINGS = ("", "unit", "paper", "fourier", "likelihood", "bound")


def cells(row: Row) -> tuple[str, ...]:
    """The text of a row under `HEADINGS`."""
    values = (row.fourier, row.likelihood, row.bound)
    return (row.quantity, row.unit, row.paper, *(_text(value) for value in values))


def notes_of(rows: Iterable[Row]) -> tuple[list[str], list[int]]:
    """The sentences on why rows differ from the paper, each once, and each row's number or 0."""
    notes: list[str] = []
    numbers = []
    for row in rows:
        if row.why and row.why not in notes:
            notes.append(row.why)
        numbers.append(notes.index(row.why) + 1 if row.why else 0)
    return notes, numbers


def markdown(rows: Iterable[Row]) -> str:
    """The table as Markdown, with numbered notes below it."""
    rows = list(rows)
    notes, numbers = notes_of(rows)
    lines = [f"| {' | '.join((*HEADINGS, 'note'))} |", f"|{'---|' * (len(HEADINGS) + 1)}"]
    for row, number in zip(rows, numbers, strict=True):
        texts = (*map(_escaped, cells(row)), str(number or ""))
        lines.append(f"| {' | '.join(texts)} |")
    numbered = [f"{number}. {note}" for number, note in enumerate(notes, 1)]
    return "\n".join([*lines, "", *numbered]).rstrip() + "\n"


def _text(value: Value | None) -> str:
    return "" if value is None else value.text


def _escaped(text: str) -> str:
    return text.replace("|", "\\|")
