"""Where the instrument and the time stand in the path of an image.

A pattern describes the path below the source, part by part::

    {instrument}/{day}/*
    {instrument}/{day:%Y-%m-%d}/{time:%H%M%S}*.png
    **/{instrument}_{time:%Y%m%dT%H%M%S}.tif

Names in braces stand for what lies between the neighbouring characters, ``*`` and ``?`` for
characters of one part of the path, ``**`` for any number of parts. What follows a colon is a
date as `time.strptime` writes it; the dates of all fields are read together, as UTC.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from datetime import UTC, datetime

__all__ = ["Layout"]

# Digits of the directives of strptime that stand for numbers.
_DIRECTIVES = {
    "Y": r"\d{4}", "m": r"\d{2}", "d": r"\d{2}", "j": r"\d{3}", "y": r"\d{2}",
    "H": r"\d{2}", "M": r"\d{2}", "S": r"\d{2}", "f": r"\d{1,6}", "%": "%",
}  # fmt: skip
_TOKEN = re.compile(r"\{(?P<name>\w+)(?::(?P<date>[^{}]+))?\}|(?P<deep>\*\*/?)|(?P<one>[*?])")
_INSTRUMENT = "instrument"


@dataclass(frozen=True)
class Layout:
    """A pattern that was understood; made by `parse`.

    Attributes
    ----------
    text : str
        The pattern.
    expression : re.Pattern
        For the whole path below the source, with ``/`` between its parts.
    dates : tuple of (str, str)
        Group of the expression and format of each date.
    """

    text: str
    expression: re.Pattern[str]
    dates: tuple[tuple[str, str], ...]

    @classmethod
    def parse(cls, text: str) -> Layout:
        """Understand a pattern.

        Raises
        ------
        ValueError
            If it has no ``{instrument}``, a name twice, or a date that is none.
        """
        expression, dates, names, end = "", [], [], 0
        for token in _TOKEN.finditer(text):
            expression += re.escape(text[end : token.start()])
            end = token.end()
            if token["name"] is None:
                expression += _wildcard(token[0])
                continue
            names.append(token["name"])
            if token["date"] is not None:
                dates.append((token["name"], token["date"]))
            content = "[^/]+?" if token["date"] is None else _digits(text, token["date"])
            expression += f"(?P<{token['name']}>{content})"
        expression += re.escape(text[end:])
        _check(text, names, dates)
        return cls(text, re.compile(expression), tuple(dates))

    def match(self, path: str) -> tuple[str, float] | None:
        """Instrument and time (s since 1970 UTC, NaN if there is none) of a path.

        None if the path does not fit, or the date in it does not exist.
        """
        found = self.expression.fullmatch(path)
        if found is None:
            return None
        if not self.dates:
            return found[_INSTRUMENT], math.nan
        try:
            date = datetime.strptime(
                " ".join(found[name] for name, _ in self.dates),
                " ".join(date for _, date in self.dates),
            )
        except ValueError:
            return None
        return found[_INSTRUMENT], date.replace(tzinfo=UTC).timestamp()


def _wildcard(text: str) -> str:
    match text:
        case "**/":
            return "(?:[^/]+/)*"
        case "**":
            return ".*"
        case "*":
            return "[^/]*"
        case _:
            return "[^/]"


def _digits(text: str, date: str) -> str:
    """The expression for a date."""

    def digits(directive: re.Match[str]) -> str:
        if directive[1] not in _DIRECTIVES:
            known = ", ".join(f"%{name}" for name in _DIRECTIVES)
            raise ValueError(
                f"the pattern {text!r} has the date {date!r}, in which %{directive[1]} is not "
                f"read here; use {known}"
            )
        return _DIRECTIVES[directive[1]]

    return re.sub(r"%(.)", digits, re.sub(r"([^\w%])", r"\\\1", date))


def _check(text: str, names: list[str], dates: list[tuple[str, str]]) -> None:
    faults = []
    if _INSTRUMENT not in names:
        faults.append("does not say where the name of the instrument stands; write {instrument}")
    if len(set(names)) < len(names):
        faults.append("has a name in braces twice; each can be used once")
    if not all(name.isidentifier() for name in names):
        faults.append("has a name in braces that begins with a digit")
    if "{" in _TOKEN.sub("", text) or "}" in _TOKEN.sub("", text):
        faults.append("has a brace without its other one")
    whole = " ".join(date for _, date in dates)
    if dates and not (("%Y" in whole or "%y" in whole) and ("%d" in whole or "%j" in whole)):
        faults.append("has a date without year and day; add them, or leave the date out")
    if faults:
        raise ValueError(f"the pattern {text!r} {'; it '.join(faults)}")
