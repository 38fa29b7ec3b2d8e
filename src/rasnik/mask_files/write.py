"""The one call: a plate to a file in the format of its suffix."""

from __future__ import annotations

from os import PathLike
from pathlib import Path

from rasnik.mask_files.layout import MaskFileError, Plate

__all__ = ["DEFAULT_DPI", "SUFFIXES", "write_mask"]

SUFFIXES = (".gds", ".oas", ".dxf", ".svg", ".pdf", ".png")
DEFAULT_DPI = 600.0


def write_mask(path: str | PathLike[str], plate: Plate, *, dpi: float | None = None) -> Path:
    """Write a plate to a file.

    Parameters
    ----------
    path : path
        Its suffix, one of `SUFFIXES`, says which format. An existing file is replaced.
    plate : Plate
    dpi : float, optional
        Pixels per inch of a PNG; 600 by default.

    Returns
    -------
    Path

    Raises
    ------
    MaskFileError
        If the suffix is unknown, a package is missing, or the mask cannot be drawn in this
        format.
    OSError
        If the file cannot be written.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise MaskFileError(
            f"{path.name}: masks are not written as {suffix or 'files without a suffix'}; "
            f"known are {', '.join(SUFFIXES)}"
        )
    if dpi is not None and suffix != ".png":
        raise MaskFileError(f"dpi is for .png; {suffix} files have no pixels")
    if not path.parent.is_dir():
        raise MaskFileError(f"there is no folder {path.parent} to write {path.name} to")
    # Under another name first: a mask that is refused or breaks off leaves nothing behind, and
    # spares a file that was there.
    part = path.with_name(f".{path.stem}.part{suffix}")
    try:
        _write(part, plate, DEFAULT_DPI if dpi is None else dpi)
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)
    return path


def _write(path: Path, plate: Plate, dpi: float) -> None:
    match path.suffix:
        case ".gds" | ".oas":
            from rasnik.mask_files.gds import write_layout

            write_layout(path, plate)
        case ".dxf":
            from rasnik.mask_files.dxf import write_dxf

            write_dxf(path, plate)
        case ".svg":
            from rasnik.mask_files.prints import write_svg

            write_svg(path, plate)
        case ".pdf":
            from rasnik.mask_files.prints import write_pdf

            write_pdf(path, plate)
        case _:
            from rasnik.mask_files.raster import write_png

            write_png(path, plate, dpi)
