"""The coded chess-field mask: which fields are white, which carry code, where they lie.

Mask frame: x right, y up, micrometres. The origin is the lower-left corner of the pivot field
of code cell (0, 0). Field (i, j) covers [i, i + 1) x [j, j + 1) in units of the field size.
"""

from __future__ import annotations

from typing import Any, Literal, Self, overload

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import BaseModel, ConfigDict, Field, model_validator

__all__ = ["ChessField"]


class ChessField(BaseModel):
    """A chessboard whose every (code_bits + 1)-th column and row spells out its number.

    With ``period = code_bits + 1``, ``i = period * m + p`` and ``j = period * n + q``, a field
    has the colour opposite to the chessboard (it is *inverted*)

    * at p = q = 0, always: the *pivot* of code cell (m, n), the paper's "valid bit";
    * at p = 0, q > 0, if bit ``code_bits - q`` of m is set (column code, written upward);
    * at q = 0, p > 0, if bit ``code_bits - p`` of n is set (row code, written rightward).

    Source: van der Graaf et al., section 2, "The pattern of the coded mask".

    Attributes
    ----------
    field_um : float
        Side of one chess field.
    code_bits : int
        Bits of a code; 8 on every mask made so far.
    polarity : {"positive", "negative"}
        Positive: fields with even i + j are white (before inversion). Negative: the opposite.
    columns, rows : int, optional
        Number of code cells in x and y. By default all that the code can number.
    first_column, first_row : int
        Code of the first column and row on the mask, 0 unless only a part is printed.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)

    field_um: float = Field(ge=0.01, le=1e6, description="um, side of one chess field")
    code_bits: int = Field(default=8, ge=1, le=24, description="bits of a code")
    polarity: Literal["positive", "negative"] = Field(
        default="positive", description="positive: fields with even i + j are white"
    )
    columns: int | None = Field(default=None, ge=1, description="code cells in x; unset: all")
    rows: int | None = Field(default=None, ge=1, description="code cells in y; unset: all")
    first_column: int = Field(default=0, ge=0, description="code of the first column")
    first_row: int = Field(default=0, ge=0, description="code of the first row")

    @model_validator(mode="after")
    def _codes_fit(self) -> Self:
        for first_name, first, count_name, count in (
            ("first_column", self.first_column, "columns", self.columns),
            ("first_row", self.first_row, "rows", self.rows),
        ):
            room = 2**self.code_bits - first
            if room < 1:
                raise ValueError(
                    f"{first_name} = {first} is beyond the last code, {2**self.code_bits - 1}, "
                    f"of {self.code_bits} code bits"
                )
            if count is not None and count > room:
                raise ValueError(
                    f"{count_name} = {count} from {first_name} = {first} needs codes beyond the "
                    f"last, {2**self.code_bits - 1}, of {self.code_bits} code bits"
                )
        return self

    # ---------------------------------------------------------------- extent

    @property
    def period(self) -> int:
        """Fields from one code line to the next."""
        return self.code_bits + 1

    @property
    def column_count(self) -> int:
        """Number of code cells in x, with the default filled in."""
        return 2**self.code_bits - self.first_column if self.columns is None else self.columns

    @property
    def row_count(self) -> int:
        """Number of code cells in y, with the default filled in."""
        return 2**self.code_bits - self.first_row if self.rows is None else self.rows

    @property
    def bounds_fields(self) -> tuple[int, int, int, int]:
        """(i0, i1, j0, j1): the mask holds the fields i0 <= i < i1, j0 <= j < j1."""
        i0, j0 = self.first_column * self.period, self.first_row * self.period
        return i0, i0 + self.column_count * self.period, j0, j0 + self.row_count * self.period

    @property
    def bounds_um(self) -> tuple[float, float, float, float]:
        """(x0, x1, y0, y1): the edges of the mask."""
        i0, i1, j0, j1 = self.bounds_fields
        a = self.field_um
        return i0 * a, i1 * a, j0 * a, j1 * a

    @property
    def width_um(self) -> float:
        """Size of the mask in x."""
        return self.column_count * self.period * self.field_um

    @property
    def height_um(self) -> float:
        """Size of the mask in y."""
        return self.row_count * self.period * self.field_um

    # --------------------------------------------------------------- pattern

    def inside(self, i: ArrayLike, j: ArrayLike) -> NDArray[np.bool_]:
        """Whether fields (i, j) exist; integer arguments of any shape, broadcast."""
        i, j = _integers("i", i), _integers("j", j)
        i0, i1, j0, j1 = self.bounds_fields
        return np.asarray(((i >= i0) & (i < i1)) & ((j >= j0) & (j < j1)))

    def inverted(self, i: ArrayLike, j: ArrayLike) -> NDArray[np.bool_]:
        """Whether fields (i, j) are code fields of the colour opposite to the chessboard.

        Parameters
        ----------
        i, j : array_like of int
            Field indices in x and y, broadcast against each other.

        Returns
        -------
        ndarray of bool
            False outside the mask's extent.

        Raises
        ------
        TypeError
            If the indices are not integers.
        """
        i, j = _integers("i", i), _integers("j", j)
        b = self.code_bits
        m, p = np.divmod(i, self.period)
        n, q = np.divmod(j, self.period)
        # q = 0 asks for bit b of m, which is 0: the pivot is added by hand.
        in_column = (p == 0) & (((m >> (b - q)) & 1 == 1) | (q == 0))
        in_row = (q == 0) & ((n >> (b - p)) & 1 == 1)
        return np.asarray((in_column | in_row) & self.inside(i, j))

    def is_white(self, i: ArrayLike, j: ArrayLike) -> NDArray[np.bool_]:
        """Whether fields (i, j) let light through; arguments as for `inverted`.

        The glass outside the extent of the mask is taken as opaque.
        """
        i, j = _integers("i", i), _integers("j", j)
        even = (i & 1) == (j & 1)
        plain = even if self.polarity == "positive" else ~even
        return np.asarray((plain ^ self.inverted(i, j)) & self.inside(i, j))

    def fields(self, i0: int, i1: int, j0: int, j1: int) -> NDArray[np.float32]:
        """Transmission of a window of fields.

        Parameters
        ----------
        i0, i1, j0, j1 : int
            The window i0 <= i < i1, j0 <= j < j1; it may reach beyond the mask.

        Returns
        -------
        ndarray of float32, shape (j1 - j0, i1 - i0)
            1 for white, 0 for black; element [j - j0, i - i0] is field (i, j).

        Raises
        ------
        ValueError
            If the window ends before it begins.
        """
        if i1 < i0 or j1 < j0:
            raise ValueError(f"the window i {i0}..{i1}, j {j0}..{j1} ends before it begins")
        return self.is_white(np.arange(i0, i1), np.arange(j0, j1)[:, None]).astype(np.float32)

    def transmission(self, x_um: ArrayLike, y_um: ArrayLike) -> NDArray[np.float64]:
        """Transmission of the hard-edged mask at points (x, y).

        Parameters
        ----------
        x_um, y_um : array_like
            Mask coordinates, broadcast against each other.

        Returns
        -------
        ndarray of float64
            1 or 0; 0 outside the mask, NaN where a coordinate is NaN. A point on the edge
            between two fields belongs to the right or upper one.
        """
        x, y = np.broadcast_arrays(np.asarray(x_um, np.float64), np.asarray(y_um, np.float64))
        i0, i1, j0, j1 = self.bounds_fields
        i, j = np.floor(x / self.field_um), np.floor(y / self.field_um)
        # Only indices known to lie inside are made integers: others may not fit.
        inside = (i >= i0) & (i < i1) & (j >= j0) & (j < j1)
        index_i = np.where(inside, i, i0).astype(np.int64)
        index_j = np.where(inside, j, j0).astype(np.int64)
        out = np.where(inside & self.is_white(index_i, index_j), 1.0, 0.0)
        return np.asarray(np.where(np.isnan(x) | np.isnan(y), np.nan, out))

    # ----------------------------------------------------------------- codes

    @overload
    def code_at(self, x_um: float, y_um: float) -> tuple[int, int]: ...
    @overload
    def code_at(
        self, x_um: NDArray[Any], y_um: NDArray[Any] | float
    ) -> tuple[NDArray[np.int64], NDArray[np.int64]]: ...
    def code_at(self, x_um: Any, y_um: Any) -> Any:
        """Codes (m, n) of the cell that holds a point: column code, row code.

        Parameters
        ----------
        x_um, y_um : float or ndarray
            Mask coordinates, broadcast against each other.

        Returns
        -------
        m, n : int or ndarray of int64

        Raises
        ------
        ValueError
            If a point is not on the mask.
        """
        x, y = np.broadcast_arrays(np.asarray(x_um, np.float64), np.asarray(y_um, np.float64))
        i, j = np.floor(x / self.field_um), np.floor(y / self.field_um)
        i0, i1, j0, j1 = self.bounds_fields
        outside = ~((i >= i0) & (i < i1) & (j >= j0) & (j < j1))
        if outside.any():
            x0, x1, y0, y1 = self.bounds_um
            raise ValueError(
                f"the point ({x[outside].flat[0]:g}, {y[outside].flat[0]:g}) um is not on the "
                f"mask, which covers x {x0:g}..{x1:g} um and y {y0:g}..{y1:g} um"
            )
        m, n = (np.asarray(k.astype(np.int64) // self.period) for k in (i, j))
        return (int(m), int(n)) if m.ndim == 0 else (m, n)

    @overload
    def pivot_um(self, m: int, n: int) -> tuple[float, float]: ...
    @overload
    def pivot_um(
        self, m: NDArray[Any], n: NDArray[Any] | int
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]: ...
    def pivot_um(self, m: Any, n: Any) -> Any:
        """Lower-left corner (x, y) of the pivot of code cell (m, n), in micrometres.

        Parameters
        ----------
        m, n : int or ndarray of int
            Column and row code, broadcast against each other.

        Returns
        -------
        x_um, y_um : float or ndarray of float64

        Raises
        ------
        ValueError
            If a code is not on the mask.
        """
        m, n = np.broadcast_arrays(_integers("m", m), _integers("n", n))
        outside = ~self.inside(m * self.period, n * self.period)
        if outside.any():
            raise ValueError(
                f"code cell ({m[outside].flat[0]}, {n[outside].flat[0]}) is not on the mask, "
                f"which has columns {self.first_column}.."
                f"{self.first_column + self.column_count - 1} and rows {self.first_row}.."
                f"{self.first_row + self.row_count - 1}"
            )
        x, y = (np.asarray(k * self.period * self.field_um) for k in (m, n))
        return (float(x), float(y)) if x.ndim == 0 else (x, y)


def _integers(name: str, value: ArrayLike) -> NDArray[np.int64]:
    array = np.asarray(value)
    if array.size == 0 and array.dtype == np.float64:  # an empty list
        return array.astype(np.int64)
    if not np.issubdtype(array.dtype, np.integer):
        raise TypeError(f"{name} must be whole numbers, not {array.dtype}")
    return array.astype(np.int64)
