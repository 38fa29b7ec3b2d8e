"""PNG: whole pixels to a field, and the resolution that makes the print true to size."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from rasnik.mask_files.layout import Box, MaskFileError, Plate
from rasnik.mask_files.prints import bar_boxes

__all__ = ["pixels_per_field", "write_png"]

_NM_PER_INCH = 25_400_000
_PIXEL_LIMIT = 400_000_000


def pixels_per_field(plate: Plate, dpi: float) -> tuple[int, float]:
    """(pixels along a field, true pixels per inch): the whole number nearest to that of `dpi`.

    Raises
    ------
    MaskFileError
        If a field would be less than a pixel, or the image too large.
    """
    if not 0 < dpi < np.inf:
        raise MaskFileError(f"{dpi:g} dpi must be above zero")
    pixels = round(plate.field / _NM_PER_INCH * dpi)
    if pixels < 1:
        raise MaskFileError(
            f"at {dpi:g} dpi a field of {plate.mask.field_um:g} um is less than one pixel; "
            f"it needs at least {int(np.ceil(_NM_PER_INCH / plate.field))} dpi"
        )
    x0, y0, x1, y1 = plate.outline
    count = (x1 - x0) * (y1 - y0) / plate.field**2 * pixels**2
    if count > _PIXEL_LIMIT:
        raise MaskFileError(
            f"at {dpi:g} dpi the image has {count:.1e} pixels (at most {_PIXEL_LIMIT:.0e}); "
            "take fewer dpi, a smaller part of the mask, or write .pdf"
        )
    return pixels, pixels * _NM_PER_INCH / plate.field


def write_png(path: Path, plate: Plate, dpi: float) -> None:
    """Write a plate to a black-and-white ``.png``; black is the drawn tone.

    The resolution in the file is the true one of `pixels_per_field`, to 0.01 %.

    Raises
    ------
    MaskFileError
        If the fields do not go into pixels, or there is a gap or overlap.
    """
    from PIL import Image, ImageDraw, ImageFont

    if plate.half_gap:
        raise MaskFileError(
            "a PNG has whole pixels to a field, which leaves none for a gap or overlap; "
            "leave it out or write another format"
        )
    pixels, true_dpi = pixels_per_field(plate, dpi)
    i0, i1, j0, j1 = plate.mask.bounds_fields
    drawn = plate.drawn(np.arange(i0, i1), np.arange(j0, j1)[::-1, None])
    border = round(plate.border / plate.field * pixels)
    fields = np.repeat(np.repeat(~drawn, pixels, axis=0), pixels, axis=1)
    image = Image.fromarray(np.pad(fields, border, constant_values=True))
    draw = ImageDraw.Draw(image)
    x0, y0, _, y1 = plate.area

    def column(x: float) -> int:
        return round((x - x0) / plate.field * pixels) + border

    def row(y: float) -> int:
        return round((y1 - y) / plate.field * pixels) + border

    def fill(box: Box) -> None:
        left, top, right, bottom = column(box[0]), row(box[3]), column(box[2]), row(box[1])
        # Pillow's rectangles include their last pixel; what is drawn is at least one wide.
        draw.rectangle((left, top, max(right, left + 1) - 1, max(bottom, top + 1) - 1), fill=0)

    bars, length = bar_boxes(plate)
    for box in [*plate.frame, *plate.cross_boxes, *bars]:
        fill(box)

    def write(box: Box, x: float, text: str) -> None:
        size = min((box[3] - box[1]) * 0.6, (box[2] - box[0]) / (0.62 * len(plate.label)))
        size *= pixels / plate.field
        if size >= 5:  # smaller letters cannot be read
            font = ImageFont.load_default(size)
            draw.text((column(x), row((box[1] + box[3]) / 2)), text, fill=0, font=font, anchor="lm")

    if plate.label_box and plate.bar_box:
        write(plate.label_box, plate.label_box[0], plate.label)
        gap = plate.label_box[3] - plate.label_box[1]
        write(plate.bar_box, bars[0][2] + gap // 2, length)
    image.save(path, dpi=(true_dpi, true_dpi), optimize=True)
