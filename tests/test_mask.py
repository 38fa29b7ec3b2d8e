"""The mask, checked against its written definition field by field."""

import numpy as np
import pytest
from pydantic import ValidationError

from rasnik.mask import ChessField

# Code cell (5, 3) and the code lines after it: W white, b black, * inverted; y grows upward.
CELL_5_3 = """
W*W b W b W W*W b b*
b*b W b W b W b W b
b W b W b W b W b b*
b*b W b W b W b W W*
b W b W b W b W b W
W b W b W b W b W b
b W b W b W b W b W
W b W b W b W b W b
b W b W b W b W b W
b*b W b W b W W*b*W*
""".strip().splitlines()


def by_the_book(mask: ChessField, i: int, j: int) -> tuple[bool, bool]:
    """(inverted, white) of one field, from the definition with strings of binary digits."""
    m, p = divmod(i, mask.period)
    n, q = divmod(j, mask.period)
    column, row = format(m, f"0{mask.code_bits}b"), format(n, f"0{mask.code_bits}b")
    inverted = False
    if p == 0 and q == 0:
        inverted = True
    elif p == 0:
        inverted = column[q - 1] == "1"  # the most significant digit comes next to the pivot
    elif q == 0:
        inverted = row[p - 1] == "1"
    white = ((i + j) % 2 == 0) == (mask.polarity == "positive")
    return inverted, white != inverted


def test_written_example_character_for_character() -> None:
    mask = ChessField(field_um=85.0)
    i, j = np.arange(10) + 5 * 9, (np.arange(10) + 3 * 9)[::-1, None]
    white, inverted = mask.is_white(i, j), mask.inverted(i, j)
    lines = [
        "".join("bW"[int(w)] + " *"[int(v)] for w, v in zip(*rows, strict=True)).rstrip()
        for rows in zip(white, inverted, strict=True)
    ]
    assert lines == CELL_5_3


@pytest.mark.parametrize("polarity", ["positive", "negative"])
@pytest.mark.parametrize("bits", [1, 2, 5, 8, 11])
def test_every_field_follows_the_definition(bits: int, polarity: str) -> None:
    mask = ChessField(field_um=1.0, code_bits=bits, polarity=polarity)
    last = 2**bits - 1
    for m0, n0 in ((0, 0), (last, last), (last // 3, last // 2)):
        i0, j0 = max(m0 - 1, 0) * mask.period, max(n0 - 1, 0) * mask.period
        i1, j1 = (m0 + 1) * mask.period, (n0 + 1) * mask.period
        i, j = np.arange(i0, i1), np.arange(j0, j1)[:, None]
        expected = np.array([[by_the_book(mask, a, b) for a in range(i0, i1)] for b in j[:, 0]])
        np.testing.assert_array_equal(mask.inverted(i, j), expected[..., 0])
        np.testing.assert_array_equal(mask.is_white(i, j), expected[..., 1])
        np.testing.assert_array_equal(mask.fields(i0, i1, j0, j1), expected[..., 1])


def test_code_zero_inverts_nothing_but_its_pivot() -> None:
    mask = ChessField(field_um=1.0)
    assert np.argwhere(mask.inverted(np.arange(9), np.arange(9)[:, None])).tolist() == [[0, 0]]


def test_code_fields_read_back_as_the_code() -> None:
    mask = ChessField(field_um=1.0, code_bits=6)
    for m in range(64):
        bits = mask.inverted(m * 7, 7 * 5 + np.arange(1, 7))
        assert int("".join(str(int(bit)) for bit in bits), 2) == m
        bits = mask.inverted(7 * 5 + np.arange(1, 7), m * 7)
        assert int("".join(str(int(bit)) for bit in bits), 2) == m


def test_negative_is_the_complement_on_the_mask_only() -> None:
    positive = ChessField(field_um=1.0, columns=2, rows=2)
    negative = ChessField(field_um=1.0, columns=2, rows=2, polarity="negative")
    total = positive.fields(-2, 20, -2, 20) + negative.fields(-2, 20, -2, 20)
    inside = np.zeros((22, 22))
    inside[2:20, 2:20] = 1
    np.testing.assert_array_equal(total, inside)


def test_opaque_and_plain_outside_the_extent() -> None:
    mask = ChessField(field_um=10.0, columns=3, rows=2, first_column=4, first_row=1)
    assert mask.bounds_fields == (36, 63, 9, 27)
    assert mask.bounds_um == (360.0, 630.0, 90.0, 270.0)
    assert (mask.width_um, mask.height_um) == (270.0, 180.0)
    i, j = np.arange(-100, 200), np.arange(-100, 200)[:, None]
    inside = (i >= 36) & (i < 63) & (j >= 9) & (j < 27)
    np.testing.assert_array_equal(mask.inside(i, j), inside)
    assert not mask.is_white(i, j)[~inside].any()
    assert not mask.inverted(i, j)[~inside].any()
    assert mask.is_white(i, j)[inside].mean() == pytest.approx(0.5, abs=0.05)
    far = np.array([-1e300, -1e9, 359.999, 630.0, 1e9, 1e300, np.inf, -np.inf])
    assert not mask.transmission(far, 100.0).any()
    assert not mask.transmission(500.0, far).any()


def test_a_part_of_the_mask_is_the_whole_mask_there() -> None:
    whole = ChessField(field_um=1.0)
    part = ChessField(field_um=1.0, first_column=100, columns=2, first_row=37, rows=3)
    np.testing.assert_array_equal(
        part.fields(*part.bounds_fields), whole.fields(*part.bounds_fields)
    )


def test_default_extent_is_every_code() -> None:
    mask = ChessField(field_um=85.0)
    assert mask.period == 9
    assert mask.bounds_fields == (0, 2304, 0, 2304)
    assert mask.width_um == mask.height_um == 2304 * 85.0
    assert ChessField(field_um=1.0, first_column=250).column_count == 6
    assert ChessField(field_um=1.0, code_bits=3, first_row=7).row_count == 1


def test_transmission_is_exact_and_vectorised() -> None:
    mask = ChessField(field_um=85.0)
    rng = np.random.default_rng(3)
    x, y = rng.uniform(0, mask.width_um, (2, 40, 50))
    shown = mask.transmission(x, y)
    assert shown.shape == (40, 50) and shown.dtype == np.float64
    fields = zip((x // 85.0).astype(int).flat, (y // 85.0).astype(int).flat, strict=True)
    np.testing.assert_array_equal(shown.ravel(), [by_the_book(mask, i, j)[1] for i, j in fields])
    # The same grid given as a row and a column.
    np.testing.assert_array_equal(
        mask.transmission(x[0], y[:, :1]), mask.transmission(*np.meshgrid(x[0], y[:, 0]))
    )


def test_transmission_steps_exactly_at_the_edges() -> None:
    mask = ChessField(field_um=85.0)
    edge = np.float64(46 * 85)
    y = 28.5 * 85
    before, at = mask.transmission([np.nextafter(edge, 0), edge], y)
    assert (before, at) == (mask.is_white(45, 28), mask.is_white(46, 28))
    assert before != at
    assert mask.transmission(0.0, 0.0) == 0.0  # the pivot of (0, 0), white turned black
    assert mask.transmission(-1e-9, 0.0) == 0.0
    assert mask.transmission(mask.width_um, 0.0) == 0.0


def test_nan_stays_nan() -> None:
    mask = ChessField(field_um=85.0)
    np.testing.assert_array_equal(
        mask.transmission([np.nan, 100.0, 100.0], [100.0, np.nan, 10.0]), [np.nan, np.nan, 0.0]
    )


def test_codes_of_a_position_and_back() -> None:
    mask = ChessField(field_um=85.0)
    assert mask.code_at(4000.0, 5000.0) == (5, 6)
    assert mask.pivot_um(5, 6) == (3825.0, 4590.0)
    m, n = np.arange(256), np.arange(256)[:, None]
    x, y = mask.pivot_um(m, n)
    assert x.shape == y.shape == (256, 256)
    for shift in (0.0, 9 * 85.0 - 1e-6):
        back = mask.code_at(x + shift, y + shift)
        np.testing.assert_array_equal(back[0], np.broadcast_to(m, (256, 256)))
        np.testing.assert_array_equal(back[1], np.broadcast_to(n, (256, 256)))


def test_positions_and_codes_off_the_mask_raise() -> None:
    mask = ChessField(field_um=10.0, columns=2, rows=2, first_column=1)
    with pytest.raises(ValueError, match=r"point \(89, 5\) um is not on the mask.*90\.\.270"):
        mask.code_at(89.0, 5.0)
    with pytest.raises(ValueError, match="not on the mask"):
        mask.code_at(float("nan"), 5.0)
    with pytest.raises(ValueError, match=r"code cell \(3, 0\).*columns 1\.\.2 and rows 0\.\.1"):
        mask.pivot_um(3, 0)
    with pytest.raises(ValueError, match="ends before"):
        mask.fields(4, 3, 0, 1)


def test_field_indices_must_be_whole_numbers() -> None:
    mask = ChessField(field_um=10.0)
    with pytest.raises(TypeError, match="whole numbers"):
        mask.is_white(0.5, 1)
    assert mask.is_white([], []).shape == (0,)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"field_um": 0.0}, "field_um"),
        ({"field_um": -85.0}, "field_um"),
        ({"field_um": float("nan")}, "field_um"),
        ({"field_um": float("inf")}, "field_um"),
        ({"code_bits": 0}, "code_bits"),
        ({"polarity": "upside-down"}, "polarity"),
        ({"columns": 0}, "columns"),
        ({"first_row": -1}, "first_row"),
        ({"columns": 257}, "columns = 257 from first_column = 0"),
        ({"columns": 250, "first_column": 7}, "columns = 250 from first_column = 7"),
        ({"code_bits": 3, "first_row": 8}, "first_row = 8 is beyond the last code, 7"),
        ({"pitch_um": 85.0}, "pitch_um"),
    ],
)
def test_impossible_masks_are_refused(wrong: dict[str, object], message: str) -> None:
    with pytest.raises(ValidationError, match=message):
        ChessField(**{"field_um": 85.0, **wrong})


def test_a_mask_does_not_change() -> None:
    mask = ChessField(field_um=85.0)
    with pytest.raises(ValidationError):
        mask.field_um = 120.0
    assert mask == ChessField(field_um=85.0)
    assert hash(mask) == hash(ChessField(field_um=85.0))
