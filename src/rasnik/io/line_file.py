"""Lines of text on their way to a file, a terminal or a pipe."""

from __future__ import annotations

import os
from types import TracebackType
from typing import Self, TextIO

__all__ = ["LineFile"]


class LineFile:
    """A text file that is written piece by piece, each handed to the system at once.

    A context manager. It closes what it opened itself: a path, not a file that is given.
    """

    def __init__(self, target: str | os.PathLike[str] | TextIO) -> None:
        self._owned = isinstance(target, str | os.PathLike)
        self._file: TextIO = (
            open(target, "w", encoding="utf-8", newline="")
            if isinstance(target, str | os.PathLike)
            else target
        )

    def put(self, text: str) -> None:
        """Write a text as it is."""
        self._file.write(text)
        self._file.flush()

    def close(self) -> None:
        """Complete the file."""
        if self._owned:
            self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()
