"""SVG and PDF: the mask at its true size on paper or film, for a demonstration on a desk."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from xml.sax.saxutils import escape

import numpy as np
from numpy.typing import NDArray

from rasnik.mask_files.layout import Box, MaskFileError, Plate

__all__ = ["bar_boxes", "write_pdf", "write_svg"]

#: Drawn fields are listed one by one in these formats.
_FIELD_LIMIT = 6_000_000
_POINTS_PER_NM = 72 / 25.4e6
#: Sizes of paper, mm, upright.
_PAPERS_MM = ((210, 297), (297, 420), (420, 594), (594, 841), (841, 1189))
#: The paper must be this much larger than the drawing on each side: printers do not reach further.
_UNPRINTABLE_MM = 6
#: Advance of a letter of the fixed-pitch Courier over its size.
_COURIER = 0.6


def field_runs(plate: Plate) -> Iterator[NDArray[np.int64]]:
    """The drawn fields as boxes (x0, y0, x1, y1) in nm, in bands of rows, shape (n, 4).

    Runs of drawn fields in a row are one box; so are runs of two or more in a column. Boxes of
    the two kinds cross; together they cover what is drawn, bridges across a gap included.

    Raises
    ------
    MaskFileError
        If there are more fields than such files can hold.
    """
    i0, i1, j0, j1 = plate.mask.bounds_fields
    if (i1 - i0) * (j1 - j0) > _FIELD_LIMIT:
        raise MaskFileError(
            f"{i1 - i0} x {j1 - j0} fields are too many for a print (at most {_FIELD_LIMIT:.0e}); "
            "draw a smaller part of the mask, or write .gds, .oas or .dxf, which repeat cells"
        )
    a, h, band = plate.field, plate.half_gap, 64
    columns = np.arange(i0, i1)
    for start in range(j0, j1, band):
        # One row more above, so that runs in a column go on from band to band.
        stop = min(start + band, j1)
        drawn = plate.drawn(columns, np.arange(start, min(stop + 1, j1))[:, None])
        rows, first, last = _runs(drawn[: stop - start])
        across = np.stack([first + i0, rows + start, last + i0, rows + start + 1], axis=1)
        lines, first, last = _runs(drawn.T)
        long = last - first > 1
        lines, first, last = lines[long], first[long], last[long]
        upright = np.stack([lines + i0, first + start, lines + i0 + 1, last + start], axis=1)
        yield np.concatenate([across, upright]) * a + np.array([h, h, -h, -h])


def _runs(drawn: NDArray[np.bool_]) -> tuple[NDArray[np.int64], ...]:
    """(row, first, end) of every run of True in the rows of an array."""
    edges = np.diff(drawn.astype(np.int8), axis=1, prepend=0, append=0)
    rows, first = np.nonzero(edges == 1)
    return rows, first, np.nonzero(edges == -1)[1]


def bar_boxes(plate: Plate) -> tuple[list[Box], str]:
    """Scale bar of a round length in the upper border: boxes, and the text beside it."""
    box = plate.bar_box
    if box is None:
        return [], ""
    room_mm = (box[2] - box[0]) / 1e6 / 3
    decade = 10.0 ** np.floor(np.log10(room_mm))
    length_mm = max(k * decade for k in (1, 2, 5) if k * decade <= room_mm)
    length, thick = round(length_mm * 1e6), round((box[3] - box[1]) * 0.12)
    x, y = box[0], (box[1] + box[3]) // 2
    ends = [(x + k, y - 3 * thick, x + k + thick, y + 3 * thick) for k in (0, length - thick)]
    return [(x, y - thick // 2, x + length, y + thick // 2), *ends], f"{length_mm:g} mm"


def letter_size(plate: Plate, text: str) -> float:
    """Size in nm of Courier with which a text fits between the crosses."""
    box = plate.label_box
    assert box is not None  # asked for only where there is a border
    return float(min((box[2] - box[0]) / (len(text) * _COURIER), (box[3] - box[1]) * 0.6))


def _texts(plate: Plate) -> list[tuple[float, float, float, str]]:
    """(x, y of the base line, size, text) in nm: the label and what the scale bar says."""
    lower, upper = plate.label_box, plate.bar_box
    if lower is None or upper is None:
        return []
    size = letter_size(plate, plate.label)
    boxes, length = bar_boxes(plate)
    middle = [(box[1] + box[3]) / 2 for box in (lower, upper)]
    return [
        (lower[0], middle[0] - 0.3 * size, size, plate.label),
        (boxes[0][2] + size, middle[1] - 0.3 * size, size, length),
    ]


def _ink(plate: Plate) -> NDArray[np.int64]:
    """All boxes besides the fields."""
    return np.array([*plate.frame, *plate.cross_boxes, *bar_boxes(plate)[0]]).reshape(-1, 4)


# -------------------------------------------------------------------------------- SVG


def write_svg(path: Path, plate: Plate) -> None:
    """Write a plate to ``.svg``, one user unit a micrometre, with its true size in mm.

    Ink stands for the drawn tone on a white ground.
    """
    x0, y0, x1, y1 = plate.outline
    width, height = x1 - x0, y1 - y0

    def shape(boxes: NDArray[np.int64]) -> str:
        # Moves are relative to the end of the last box, which is its start: digits are saved.
        steps = np.diff(boxes[:, :2], axis=0, prepend=[[0, 0]])
        sides = boxes[:, 2:] - boxes[:, :2]
        return "".join(
            f"m{_um(dx)} {_um(dy)}h{_um(w)}v{_um(h)}h{_um(-w)}z"
            for (dx, dy), (w, h) in zip(steps.tolist(), sides.tolist(), strict=True)
        )

    with path.open("w", encoding="ascii") as file:
        file.write(
            f'<svg xmlns="http://www.w3.org/2000/svg" width="{width / 1e6:.10g}mm" '
            f'height="{height / 1e6:.10g}mm" viewBox="0 0 {_um(width)} {_um(height)}">\n'
            f"<title>{escape(plate.label)}</title>\n"
            '<rect width="100%" height="100%" fill="white"/>\n'
            f'<g transform="matrix(1 0 0 -1 {_um(-x0)} {_um(y1)})">\n'
        )
        # One path for all fields: between separate ones some viewers leave hairlines.
        file.write('<path id="fields" d="')
        file.writelines(shape(boxes).replace("m", "M", 1) for boxes in field_runs(plate))
        file.write(f'"/>\n<path id="border" d="{shape(_ink(plate))}"/>\n</g>\n')
        for x, y, size, text in _texts(plate):
            file.write(
                f'<text x="{_um(x - x0)}" y="{_um(y1 - y)}" font-size="{_um(size)}" '
                f'font-family="Courier, monospace" textLength="{_um(len(text) * size * _COURIER)}"'
                f' lengthAdjust="spacingAndGlyphs">{escape(text)}</text>\n'
            )
        file.write("</svg>\n")


def _um(nm: float) -> str:
    return f"{nm / 1000:.10g}"


# -------------------------------------------------------------------------------- PDF


def write_pdf(path: Path, plate: Plate) -> None:
    """Write a plate to ``.pdf`` at its true size, in the middle of the smallest paper it fits on.

    From A4 to A0, or a page of its own where none is large enough. Viewers are asked not to
    scale the page when they print it.
    """
    x0, y0, x1, y1 = plate.outline
    page = _page_nm(x1 - x0, y1 - y0)
    # Lower-left corner of the drawing on the page, and one unit a nanometre.
    shift = [(side - length) / 2 for side, length in zip(page, (x1 - x0, y1 - y0), strict=True)]
    k = _POINTS_PER_NM
    packer = zlib.compressobj(9)
    parts: list[bytes] = []

    def put(text: str) -> None:
        parts.append(packer.compress(text.encode("ascii")))

    # Readers hold coordinates in single precision: they begin at the corner of the drawing,
    # in micrometres.
    origin = np.array([x0, y0, x0, y0])
    put(f"q {k * 1000:.12f} 0 0 {k * 1000:.12f} {shift[0] * k:.6f} {shift[1] * k:.6f} cm\n")
    for boxes in field_runs(plate):
        _put_boxes(put, boxes - origin)
    _put_boxes(put, _ink(plate) - origin)
    put("Q\n")
    for x, y, size, text in _texts(plate):
        at = [(s + v - c) * k for s, v, c in zip(shift, (x, y), (x0, y0), strict=True)]
        put(f"BT /F1 {size * k:.6f} Tf {at[0]:.6f} {at[1]:.6f} Td ({_literal(text)}) Tj ET\n")
    stream = b"".join([*parts, packer.flush()])
    sides = " ".join(f"{side * k:.6f}" for side in page)
    objects = [
        b"<< /Type /Catalog /Pages 2 0 R /ViewerPreferences << /PrintScaling /None >> >>",
        b"<< /Type /Pages /Kids [3 0 R] /Count 1 >>",
        f"<< /Type /Page /Parent 2 0 R /MediaBox [0 0 {sides}] /Contents 4 0 R "
        "/Resources << /Font << /F1 5 0 R >> >> >>".encode(),
        f"<< /Length {len(stream)} /Filter /FlateDecode >>\nstream\n".encode()
        + stream
        + b"\nendstream",
        b"<< /Type /Font /Subtype /Type1 /BaseFont /Courier /Encoding /WinAnsiEncoding >>",
        f"<< /Title ({_literal(plate.label)}) /Creator (rasnik) >>".encode(),
    ]
    path.write_bytes(_pdf_file(objects))


def _put_boxes(put: Callable[[str], None], boxes: NDArray[np.int64]) -> None:
    """Boxes in um, filled together: between separate ones some viewers leave hairlines."""
    if len(boxes):
        sides = boxes[:, 2:] - boxes[:, :2]
        rows = np.concatenate([boxes[:, :2], sides], axis=1) / 1000
        put("".join(f"{x:.10g} {y:.10g} {w:.10g} {h:.10g} re\n" for x, y, w, h in rows.tolist()))
        put("f\n")


def _page_nm(width: int, height: int) -> tuple[int, int]:
    for paper in _PAPERS_MM:
        for sides in (paper, paper[::-1]):
            page = (sides[0] * 10**6, sides[1] * 10**6)
            room = 2 * _UNPRINTABLE_MM * 10**6
            if width <= page[0] - room and height <= page[1] - room:
                return page
    return width, height


def _literal(text: str) -> str:
    return text.replace("\\", r"\\").replace("(", r"\(").replace(")", r"\)")


def _pdf_file(objects: list[bytes]) -> bytes:
    """A PDF file of numbered objects, the first the catalogue and the last the information."""
    body, places = b"%PDF-1.6\n%\xe2\xe3\xcf\xd3\n", []
    for number, content in enumerate(objects, 1):
        places.append(len(body))
        body += b"%d 0 obj\n" % number + content + b"\nendobj\n"
    count = len(objects) + 1
    table = b"".join(b"%010d 00000 n \n" % place for place in places)
    return b"".join(
        [
            body,
            b"xref\n0 %d\n0000000000 65535 f \n" % count,
            table,
            b"trailer\n<< /Size %d /Root 1 0 R /Info %d 0 R >>\n" % (count, len(objects)),
            b"startxref\n%d\n%%%%EOF\n" % len(body),
        ]
    )
