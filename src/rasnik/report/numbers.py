"""Numbers as text, with as many digits as their errors allow."""

from __future__ import annotations

import math

__all__ = ["concise", "rounded", "with_sigma"]

_MOST_DECIMALS = 12


def _decimals(sigma: float, digits: int) -> int:
    """Decimal places that show `digits` significant digits of a positive number."""
    first = math.floor(math.log10(sigma))
    if round(sigma / 10.0**first, digits - 1) >= 10:  # 0.0999 becomes 0.10
        first += 1
    return min(max(digits - 1 - first, 0), _MOST_DECIMALS)


def rounded(value: float, sigma: float, digits: int = 2) -> str:
    """A value rounded where its standard deviation has `digits` significant digits."""
    if not math.isfinite(value):
        return "-"
    if not (math.isfinite(sigma) and sigma > 0):
        return f"{value:.6g}"
    return f"{value:.{_decimals(sigma, digits)}f}"


def with_sigma(value: float, sigma: float, digits: int = 2) -> str:
    """``12.3457 ± 0.0021``; only the value if the standard deviation is not known."""
    text = rounded(value, sigma, digits)
    if text == "-" or not (math.isfinite(sigma) and sigma > 0):
        return text
    return f"{text} ± {rounded(sigma, sigma, digits)}"


def concise(value: float, sigma: float, digits: int = 2) -> str:
    """``12.3457(21)``: in parentheses the standard deviation, in units of the last digit."""
    text = rounded(value, sigma, digits)
    if text == "-" or not (math.isfinite(sigma) and sigma > 0):
        return text
    return f"{text}({round(sigma * 10 ** _decimals(sigma, digits))})"
