"""Which of the arrays in a file with many holds the images."""

from __future__ import annotations

from collections.abc import Mapping

from rasnik.io.formats import ImageFileError

__all__ = ["choose_images"]


def choose_images(
    dimensions: Mapping[str, int], asked: str | None, *, file_name: str, kind: str, part: str
) -> str:
    """Path of the array with the images: the one asked for, or the only one that can be it.

    Parameters
    ----------
    dimensions : mapping of str to int
        Number of dimensions of every array of numbers, by path. Stacks, of three, come before
        single images.
    asked : str or None
        Path that was asked for.
    file_name, kind, part : str
        For messages: ``"frames.h5"``, ``"HDF5 file"``, ``"dataset"``.

    Raises
    ------
    ImageFileError
        If there is none, or more than one.
    """
    fitting: list[str] = []
    for wanted in (3, 2):
        fitting = fitting or [name for name, number in dimensions.items() if number == wanted]
    if asked is not None:
        name = f"/{asked.strip('/')}"
        if name in dimensions:
            return name
        raise ImageFileError(
            f"there is no {part} {asked} in the {kind}; "
            f"it holds {', '.join(fitting) if fitting else 'no images'}"
        )
    if not fitting:
        raise ImageFileError(
            f"the {kind} holds no image stack; a {part} of shape (frames, height, width) is needed"
        )
    if len(fitting) > 1:
        raise ImageFileError(
            f"the {kind} holds several {part}s that can be images ({', '.join(fitting)}); "
            f"choose one, as in {file_name}:{fitting[0]}"
        )
    return fitting[0]
