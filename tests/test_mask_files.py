"""Mask files: read back by independent readers, measured, rendered and analysed."""

from __future__ import annotations

import builtins
import itertools
import re
import shutil
import subprocess
import sys
from pathlib import Path

import ezdxf
import gdstk
import klayout.db as kdb
import numpy as np
import pypdfium2
import pytest
from PIL import Image
from scipy import ndimage
from typer.testing import CliRunner

from rasnik import ChessField, Projection, analyse, load_system
from rasnik.cli import app
from rasnik.imaging.projection import sensor_grid_um
from rasnik.mask_files import SUFFIXES, MaskFileError, Plate, sized_mask, write_mask
from rasnik.mask_files.cells import field_cells
from rasnik.mask_files.layout import LAYERS

# 20 um fields at scale 1 on pixels of 2.5 um: the view is 0.8 mm x 0.6 mm, four code lines.
SYSTEM = load_system(
    "solidras",
    ["mask.field_um=20.0", "sensor.pixel_um=2.5", "sensor.width_px=320", "sensor.height_px=240"],
)
SMALL = ChessField(field_um=20.0, columns=4, rows=3, first_column=21, first_row=6)


def flat(path: Path, group: str = "fields") -> kdb.Region:
    """All shapes of a layer of a layout file, as KLayout reads them, in nm."""
    layout = kdb.Layout()
    layout.read(str(path))
    assert layout.dbu == pytest.approx(1e-3, rel=1e-12)
    (top,) = layout.top_cells()
    region = kdb.Region(top.begin_shapes_rec(layout.layer(LAYERS[group], 0)))
    return region.flatten()  # so that it outlives the layout


def drawn_region(plate: Plate) -> kdb.Region:
    """What should be drawn, box by box from ChessField.fields, edges sized by KLayout."""
    i0, i1, j0, j1 = plate.mask.bounds_fields
    white = plate.mask.fields(i0, i1, j0, j1) > 0
    a = round(plate.mask.field_um * 1000)
    region = kdb.Region()
    for j, i in np.argwhere(white if plate.tone == "clear" else ~white).tolist():
        region.insert(kdb.Box((i0 + i) * a, (j0 + j) * a, (i0 + i + 1) * a, (j0 + j + 1) * a))
    # Otherwise fields that touch at a corner are one polygon, whose waist is not cut.
    region.min_coherence = True
    return region.merged().sized(round(-500 * plate.gap_um), 2)


def transmission(region: kdb.Region, plate: Plate, x0: int, y0: int, step: int, n: int):
    """Light through n x n squares of `step` nm, the lower-left corner at (x0, y0) nm."""
    window = kdb.Box(x0, y0, x0 + n * step, y0 + n * step)
    part = (region & kdb.Region(window)).merged()
    area = part.rasterize(kdb.Point(x0, y0), kdb.Vector(step, step), n, n)
    share = np.asarray(area, np.float64) / step**2
    return share if plate.tone == "clear" else 1 - share


def photograph(
    region: kdb.Region, plate: Plate, pose: tuple[float, float, float], orientation: int
):
    """Camera image of a drawn region: area by KLayout, blur and view by scipy."""
    x, y, theta = pose
    step, n = 500, 1800
    corner = round(x * 1000) - n * step // 2, round(y * 1000) - n * step // 2
    light = transmission(region, plate, *corner, step, n)
    light = ndimage.uniform_filter(light, 5)  # the pixel, 2.5 um
    light = ndimage.gaussian_filter(light, SYSTEM.optics.blur_um * 1000 / step)
    to_mask = Projection.from_pose(x, y, 1.0, theta, orientation)
    u, v = sensor_grid_um(SYSTEM.shape, SYSTEM.pitch_um)
    X, Y = to_mask.to_mask(u, v[:, None])
    at = [(Y * 1000 - corner[1]) / step - 0.5, (X * 1000 - corner[0]) / step - 0.5]
    return camera(ndimage.map_coordinates(light, at))


def camera(light: np.ndarray) -> np.ndarray:
    dark, bright = SYSTEM.sensor.dark_level, SYSTEM.sensor.light_level
    noise = np.random.default_rng(1).normal(0, 1, light.shape)
    return np.clip(np.rint(dark + (bright - dark) * light + noise), 0, 255).astype(np.uint8)


def assert_found(image: np.ndarray, mask: ChessField, x_um: float, y_um: float, limit=0.003):
    system = SYSTEM.model_copy(update={"mask": mask})
    pose = analyse(image, system)
    assert pose.ok, pose.error
    assert pose.x_um == pytest.approx(x_um, abs=limit)
    assert pose.y_um == pytest.approx(y_um, abs=limit)
    return pose


# ------------------------------------------------------------------ layout files, measured

PLATES = [
    Plate(SMALL.model_copy(update={"polarity": polarity}), tone=tone, gap_um=gap)
    for polarity, tone, gap in itertools.product(
        ("positive", "negative"), ("black", "clear"), (0.0, 1.0, -0.4)
    )
] + [
    Plate(ChessField(field_um=0.5, code_bits=b, columns=c, rows=r, first_row=1), gap_um=g)
    for b, c, r, g in [(1, 2, 1, 0.1), (2, 1, 3, 0.0), (5, 5, 6, 0.002), (9, 1, 1, 0.1)]
]


def name(plate: Plate) -> str:
    return f"{plate.mask.code_bits}-{plate.mask.polarity}-{plate.tone}-{plate.gap_um:g}"


@pytest.mark.parametrize("suffix", [".gds", ".oas"])
@pytest.mark.parametrize("plate", PLATES, ids=name)
def test_exactly_the_fields_are_drawn(tmp_path, plate, suffix):
    found = flat(write_mask(tmp_path / f"m{suffix}", plate))
    expected = drawn_region(plate)
    found.min_coherence = True
    assert (found ^ expected).is_empty()
    assert found.merged().area() == expected.area() > 0
    if plate.gap_um >= 0:  # nothing is drawn twice
        found.merged_semantics = False
        assert found.area() == expected.area()


def test_the_measure_can_fail(tmp_path):
    found = flat(write_mask(tmp_path / "m.gds", PLATES[0]))
    other = PLATES[0].mask.model_copy(update={"first_column": 22})
    assert not (found ^ drawn_region(Plate(other))).is_empty()
    assert not (found ^ drawn_region(Plate(PLATES[0].mask, gap_um=0.002))).is_empty()


def test_a_gap_keeps_neighbours_joined_and_corners_apart(tmp_path):
    region = flat(write_mask(tmp_path / "m.gds", Plate(SMALL, gap_um=1.0))).merged()
    corners_apart = region.space_check(1000, False, kdb.Metrics.Square)
    assert corners_apart.is_empty()
    assert not region.space_check(1001, False, kdb.Metrics.Square).is_empty()


def test_large_mask_is_small_on_disk_and_exact(tmp_path):
    mask = sized_mask(SYSTEM.mask, 10.0)
    assert (mask.column_count, mask.row_count) == (55, 55)
    plate = Plate(mask)
    path = write_mask(tmp_path / "m.gds", plate)
    assert path.stat().st_size < 120_000
    polygons = [
        p for p in gdstk.read_gds(path).top_level()[0].get_polygons() if p.layer == LAYERS["fields"]
    ]
    i0, i1, j0, j1 = mask.bounds_fields
    black = int(np.count_nonzero(mask.fields(i0, i1, j0, j1) == 0))
    assert len(polygons) == plate.drawn_count() == black
    assert sum(p.area() for p in polygons) == pytest.approx(black * 400, rel=1e-12)
    # Every field, by the place of its box.
    low = np.array([p.bounding_box()[0] for p in polygons]) / 20
    drawn = np.zeros((j1, i1), bool)
    drawn[np.rint(low[:, 1]).astype(int), np.rint(low[:, 0]).astype(int)] = True
    assert np.array_equal(drawn, mask.fields(i0, i1, j0, j1) == 0)
    assert np.abs(low - np.rint(low)).max() < 1e-9


def test_no_rounding_accumulates(tmp_path):
    mask = ChessField(field_um=4.251, first_column=200, first_row=3, rows=2)
    region = flat(write_mask(tmp_path / "m.gds", Plate(mask, tone="clear")))
    edges = {e.x1 for p in region.merged(True, 0).each() for e in p.each_edge()}
    assert max(edges) > 256 * 9 * 4251 - 3 * 4251
    assert {x % 4251 for x in edges} == {0}


def test_cells_are_few(tmp_path):
    cells = field_cells(Plate(ChessField(field_um=1.0)))
    boxes = sum(len(cell.boxes) for cell in cells)
    assert boxes < 2 * 2 * 256 * 2 * 8  # against 2.65 million drawn fields
    assert len({cell.name for cell in cells}) == len(cells)


@pytest.mark.parametrize("tone", ["black", "clear"])
def test_border(tmp_path, tone):
    plate = Plate(sized_mask(SYSTEM.mask, 2.0), tone=tone, border_mm=0.3, title="Plate #7")
    path = write_mask(tmp_path / "m.gds", plate)
    outline = flat(path, "outline").bbox()
    assert (outline.left, outline.bottom, outline.width()) == (
        -300_000,
        -300_000,
        1980_000 + 600_000,
    )
    shapes = [flat(path, group) for group in ("fields", "frame", "crosses", "label")]
    for one, other in itertools.combinations(shapes, 2):
        assert (one & other).is_empty()
        assert (one - kdb.Region(outline)).is_empty()
    frame, crosses, label = shapes[1:]
    assert frame.is_empty() == (tone == "clear")
    centres = sorted((p.bbox().center().x, p.bbox().center().y) for p in crosses.merged().each())
    assert centres == sorted(plate.cross_centres)
    assert label.bbox().width() > 1_500_000
    assert "Plate #7, field 20 um, columns 0-10, rows 0-10, 8 bits positive" in plate.label
    assert f"{tone} drawn" in plate.label


def test_border_left_out(tmp_path):
    path = write_mask(tmp_path / "m.gds", Plate(SMALL, border_mm=0))
    assert all(flat(path, group).is_empty() for group in ("frame", "crosses", "label"))
    path = write_mask(tmp_path / "m.gds", Plate(SMALL, crosses=False))
    assert flat(path, "crosses").is_empty()
    assert not flat(path, "label").is_empty()


def test_same_mask_same_file(tmp_path):
    first, second = (write_mask(tmp_path / f"{k}.gds", Plate(SMALL)).read_bytes() for k in range(2))
    assert first == second


@pytest.mark.parametrize("gap", [0.0, 1.0])
def test_dxf(tmp_path, gap):
    plate = Plate(SMALL, gap_um=gap)
    path = write_mask(tmp_path / "m.dxf", plate)
    drawing = ezdxf.readfile(path)
    assert not drawing.audit().has_errors
    assert drawing.header["$INSUNITS"] == 13  # micrometres
    region = kdb.Region()

    def gather(entity):
        if entity.dxftype() == "INSERT":
            for one in entity.multi_insert() if entity.mcount > 1 else [entity]:
                for inner in one.virtual_entities():
                    gather(inner)
        elif entity.dxf.layer == "FIELDS":
            assert entity.closed
            corners = np.array([point[:2] for point in entity.get_points()])
            low, high = np.rint(corners.min(axis=0) * 1000), np.rint(corners.max(axis=0) * 1000)
            region.insert(kdb.Box(*map(int, (*low, *high))))

    for entity in drawing.modelspace():
        gather(entity)
    region.min_coherence = True
    assert (region ^ drawn_region(plate)).is_empty()


# --------------------------------------------------------------------- rendered, analysed


@pytest.mark.parametrize(
    ("start", "polarity", "tone", "gap", "orientation", "theta"),
    [
        ((0, 0), "positive", "black", 0.0, 4, 0.0),
        ((37, 200), "positive", "clear", 0.0, 1, 0.02),
        ((201, 5), "negative", "black", 0.0, 2, -0.013),
        ((90, 91), "negative", "clear", 1.0, 3, 0.004),
    ],
)
def test_rendered_layout_decodes(tmp_path, rng, start, polarity, tone, gap, orientation, theta):
    mask = sized_mask(
        SYSTEM.mask, 10.0, polarity=polarity, start_column=start[0], start_row=start[1]
    )
    plate = Plate(mask, tone=tone, gap_um=gap)
    region = flat(write_mask(tmp_path / "m.gds", plate))
    x0, x1, y0, y1 = mask.bounds_um
    for _ in range(2):
        x, y = rng.uniform([x0 + 600, y0 + 600], [x1 - 600, y1 - 600])
        image = photograph(region, plate, (x, y, theta), orientation)
        pose = assert_found(image, mask, x, y)
        assert pose.orientation == orientation
        assert pose.polarity == polarity
        assert pose.theta_rad == pytest.approx(theta, abs=2e-5)


PDF_DPI = 25_400 / 2.5  # pixels of 2.5 um


def pdf_view(path: Path, renderer: str, corner_um: tuple[float, float], scratch: Path):
    """A view of 320 x 240 pixels, its upper left corner so far from that of the page."""
    left, top = (round(v / 2.5) for v in corner_um)
    if renderer == "pdftoppm":
        if not shutil.which("pdftoppm"):
            pytest.skip("pdftoppm (poppler-utils) is not installed")
        window = f"-gray -r {PDF_DPI:g} -x {left} -y {top} -W 320 -H 240 -singlefile".split()
        subprocess.run(["pdftoppm", *window, str(path), str(scratch / "view")], check=True)
        return np.asarray(Image.open(scratch / "view.pgm"), np.float64) / 255
    with pypdfium2.PdfDocument(path) as document:
        page = document[0]
        width, height = page.get_size()
        k = 72 / PDF_DPI
        # A pixel more to the right and below: the reader rounds sizes down.
        crop = (left * k, height - (top + 241) * k, width - (left + 321) * k, top * k)
        bitmap = page.render(scale=1 / k, crop=crop, grayscale=True)
        return bitmap.to_numpy()[:240, :320].reshape(240, 320) / 255.0


@pytest.mark.parametrize("renderer", ["pdfium", "pdftoppm"])
def test_printed_pdf_is_true_to_size_and_decodes(tmp_path, renderer):
    mask = sized_mask(SYSTEM.mask, 10.0, start_column=60)
    plate = Plate(mask)
    path = write_mask(tmp_path / "m.pdf", plate)
    with pypdfium2.PdfDocument(path) as document:
        assert len(document) == 1
        paper = np.array(document[0].get_size()) * 25.4 / 72
        assert document.get_metadata_value("Title") == plate.label
    assert paper == pytest.approx([210, 297], abs=1e-4)
    # The middle of the drawing lies on the middle of the paper.
    x0, x1, y0, y1 = mask.bounds_um
    for dx, dy in [(0, 0), (-3000, 3500), (4000, -4000)]:
        corner = paper[0] * 500 + dx - 400, paper[1] * 500 - dy - 300
        left, top = (np.round(v / 2.5) * 2.5 for v in corner)
        light = ndimage.gaussian_filter(pdf_view(path, renderer, corner, tmp_path), 4.5 / 2.5)
        x = (x0 + x1) / 2 + left + 400 - paper[0] * 500
        y = (y0 + y1) / 2 - (top + 300 - paper[1] * 500)
        # Renderers round the corner of the view to whole pixels of 2.5 um.
        pose = assert_found(camera(light), mask, x, y, limit=1.3)
        assert pose.scale == pytest.approx(1, abs=5e-5)
        assert pose.orientation == 1


def test_pdf_pages():
    from rasnik.mask_files.prints import _page_nm

    mm = 10**6
    assert _page_nm(190 * mm, 280 * mm) == (210 * mm, 297 * mm)
    assert _page_nm(280 * mm, 190 * mm) == (297 * mm, 210 * mm)
    assert _page_nm(210 * mm, 280 * mm) == (297 * mm, 420 * mm)
    assert _page_nm(2000 * mm, 300 * mm) == (2000 * mm, 300 * mm)


def test_png_has_whole_pixels_and_decodes(tmp_path):
    mask = sized_mask(SYSTEM.mask, (4.0, 3.0), start_row=100)
    plate = Plate(mask)
    path = write_mask(tmp_path / "m.png", plate, dpi=10_000)
    with Image.open(path) as opened:
        dpi, light = opened.info["dpi"], np.asarray(opened).astype(float)
    assert dpi == pytest.approx((8 * 25.4 / 0.02,) * 2, rel=1e-4)
    i0, i1, j0, j1 = mask.bounds_fields
    border = round(plate.border / 20_000 * 8)
    inner = light[border:-border, border:-border]
    assert np.array_equal(inner, np.kron(mask.fields(i0, i1, j0, j1)[::-1], np.ones((8, 8))))
    view = ndimage.gaussian_filter(inner, 4.5 / 2.5)[300:540, 500:820]
    x0, _, _, y1 = mask.bounds_um
    assert_found(camera(view), mask, x0 + 660 * 2.5, y1 - 420 * 2.5)
    # The scale bar above is as long as it says: 1 mm.
    bar = light[: border // 2 + 4].min(axis=0) == 0
    lengths = [len(list(run)) for dark, run in itertools.groupby(bar) if dark]
    assert 1000 / 2.5 in lengths


@pytest.mark.parametrize("gap", [0.0, 1.0])
def test_svg(tmp_path, gap):
    plate = Plate(SMALL, gap_um=gap, title="<&>")
    text = write_mask(tmp_path / "m.svg", plate).read_text()
    x0, y0, x1, y1 = (v / 1e6 for v in plate.outline)
    assert f'width="{x1 - x0:.10g}mm" height="{y1 - y0:.10g}mm"' in text
    assert f'viewBox="0 0 {(x1 - x0) * 1000:.10g} ' in text
    assert "&lt;&amp;&gt;" in text
    path = re.search(r'id="fields" d="([^"]*)"', text)[1]
    region, x, y = kdb.Region(), 0.0, 0.0
    for kind, dx, dy, w, h in re.findall(r"([Mm])(\S+) (\S+?)h([^v]+)v([^h]+)h[^z]+z", path):
        x, y = (float(dx), float(dy)) if kind == "M" else (x + float(dx), y + float(dy))
        corners = (x, y, x + float(w), y + float(h))
        region.insert(kdb.Box(*(round(v * 1000) for v in corners)))
    region.min_coherence = True
    assert (region ^ drawn_region(plate)).is_empty()


# ------------------------------------------------------------------------- what is refused


@pytest.mark.parametrize(
    ("size", "options", "sentence"),
    [
        (0.17, {}, "less than one code cell, which is 9 fields of 20 um = 0.18 mm"),
        (-5.0, {}, "must be above zero"),
        (float("nan"), {}, "must be above zero"),
        (47.0, {}, "need the column codes 0 to 260, but 8 bits end at 255; 9 bits would do: "
                   "--set mask.code_bits=9"),
        ((5.0, 10.0), {"start_row": 240}, "need the row codes 240 to 294, .* 9 bits would do"),
        (1e6, {}, "22 bits would do"),
        (1e9, {}, "no number of bits up to 24 would do"),
        (None, {"start_column": 256}, "cannot start at column 256: .* codes are 0 to 255"),
        (5.0, {"start_row": -1}, "cannot start at row -1"),
    ],
)  # fmt: skip
def test_sizes_that_cannot_be(size, options, sentence):
    with pytest.raises(MaskFileError, match=sentence):
        sized_mask(SYSTEM.mask, size, **options)


def test_the_bits_offered_would_do():
    mask = SYSTEM.mask.model_copy(update={"code_bits": 9})
    assert sized_mask(mask, 47.0).column_count == 235


def test_size_holds_as_many_cells_as_fit():
    assert sized_mask(SYSTEM.mask, 0.36).column_count == 2  # 2 x 9 x 20 um
    assert sized_mask(SYSTEM.mask, (0.3599, 0.55)).row_count == 3
    assert sized_mask(SYSTEM.mask, start_column=250).column_count == 6
    part = sized_mask(SMALL, start_column=253)
    assert (part.first_column, part.column_count, part.row_count) == (253, 3, 3)


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"gap_um": 20.0}, "gap of 20 um must be smaller than a field of 20 um"),
        ({"gap_um": -25.0}, "overlap of 25 um must be smaller than a field"),
        ({"gap_um": 0.0011}, "not a multiple of 0.002 um"),
        ({"gap_um": float("nan")}, "not a length"),
        ({"border_mm": -1.0}, "must not be below zero"),
        ({"title": "µm"}, "letters that cannot be drawn"),
        ({"title": "a\nb"}, "letters that cannot be drawn"),
        ({"tone": "grey"}, "neither black nor clear"),
    ],
)
def test_plates_that_cannot_be(options, sentence):
    with pytest.raises(MaskFileError, match=sentence):
        Plate(SMALL, **options)


def test_fields_off_the_grid():
    with pytest.raises(MaskFileError, match=r"4.2505 um is not a multiple of 0.001 um.*nearest"):
        Plate(ChessField(field_um=4.2505, columns=1, rows=1))


@pytest.mark.parametrize(
    ("file", "plate", "dpi", "sentence"),
    [
        ("m.gdz", Plate(SMALL), None, "known are .gds, .oas, .dxf, .svg, .pdf, .png"),
        ("mask", Plate(SMALL), None, "files without a suffix"),
        ("no/m.gds", Plate(SMALL), None, "there is no folder"),
        ("m.gds", Plate(SMALL), 600, "dpi is for .png"),
        ("m.png", Plate(SMALL), 600, "less than one pixel; it needs at least 1270 dpi"),
        ("m.png", Plate(SMALL), 0, "must be above zero"),
        ("m.png", Plate(SMALL), 1e9, "at most 4e"),
        ("m.png", Plate(SMALL, gap_um=1.0), 5000, "none for a gap"),
        ("m.pdf", Plate(ChessField(field_um=1.0, code_bits=9)), None, "too many for a print"),
        ("m.gds", Plate(ChessField(field_um=1000.0)), None, "coordinates of layout files end"),
    ],
)  # fmt: skip
def test_files_that_cannot_be(tmp_path, file, plate, dpi, sentence):
    with pytest.raises(MaskFileError, match=sentence):
        write_mask(tmp_path / file, plate, dpi=dpi)
    assert not list(tmp_path.iterdir())


def test_more_cells_than_files_can_repeat():
    with pytest.raises(MaskFileError, match="65536 code cells in a row"):
        field_cells(Plate(ChessField(field_um=0.05, code_bits=16)))


def test_a_refused_mask_spares_the_file(tmp_path):
    path = tmp_path / "m.svg"
    path.write_text("old")
    with pytest.raises(MaskFileError):
        write_mask(path, Plate(ChessField(field_um=1.0, code_bits=9)))
    assert path.read_text() == "old"
    write_mask(path, Plate(SMALL))
    assert path.read_text().startswith("<svg")
    assert [file.name for file in tmp_path.iterdir()] == ["m.svg"]


@pytest.mark.parametrize("suffix", [".gds", ".oas", ".dxf"])
def test_missing_packages_are_named(tmp_path, monkeypatch, suffix):
    whole = builtins.__import__

    def without(module, *rest):
        if module.partition(".")[0] in ("gdstk", "ezdxf"):
            raise ImportError(module)
        return whole(module, *rest)

    for module in [m for m in sys.modules if m.partition(".")[0] in ("gdstk", "ezdxf")]:
        monkeypatch.delitem(sys.modules, module)
    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(MaskFileError, match=r"pip install 'rasnik\[mask\]'"):
        write_mask(tmp_path / f"m{suffix}", Plate(SMALL))


# ---------------------------------------------------------------------------- command line


def command(*arguments: object):
    result = CliRunner().invoke(app, ["mask", *map(str, arguments)])
    assert result.exception is None or isinstance(result.exception, SystemExit), result.exception
    return result.exit_code, " ".join(result.stderr.split())


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_command(tmp_path, suffix):
    path = tmp_path / f"m{suffix}"
    status, said = command("solidras", "--size-mm", "8x5", "--start-column", 200, "-o", path)
    assert status == 0
    assert path.stat().st_size > 400
    assert "10 x 6 code cells of 85 um fields, 7.65 x 4.59 mm: x 153 to 160.65" in said
    assert "crosses at x 152.7125 and 160.9375" in said
    if suffix == ".png":
        assert "2 pixels to a field; print at 597.65 dpi for true size" in said


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["--size-mm", "5x5x5"], "is neither a side"),
        (["--size-mm", "large"], "is neither a side"),
        (["--size-mm", "300"], "--set mask.code_bits=9"),
        (["--gap-um", "1", "--overlap-um", "1"], "exclude each other"),
        (["--overlap-um", "-1"], "must not be below zero"),
        (["--set", "mask.field_um=85.0005"], "not a multiple of 0.001 um"),
        (["--set", "mask.feild_um=85"], "did you mean mask.field_um?"),
    ],
)
def test_command_refuses(tmp_path, arguments, sentence):
    path = tmp_path / "m.gds"
    status, said = command("solidras", *arguments, "-o", path)
    assert status == 2
    assert said.startswith("rasnik: ")
    assert sentence in said
    assert not path.exists()


def test_command_gap_and_tone(tmp_path):
    path = tmp_path / "m.gds"
    arguments = "--size-mm 2 --draw clear --gap-um 0.4 --polarity negative --label X".split()
    status, said = command("solidras", *arguments, "-o", path)
    assert status == 0
    assert "label: X, field 85 um, columns 0-1, rows 0-1, 8 bits negative, clear drawn, gap" in said
    mask = ChessField(field_um=85.0, columns=2, rows=2, polarity="negative")
    found = flat(path)
    found.min_coherence = True
    assert (found ^ drawn_region(Plate(mask, tone="clear", gap_um=0.4))).is_empty()
