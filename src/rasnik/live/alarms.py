"""Limits of a channel, and what is beyond them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rasnik.live.station import Alarms

__all__ = ["AlarmWatch", "Condition"]

_HYSTERESIS = 0.05  # of the width of the limits: so far inside before an alarm ends
_SHORTEST_S = 1.0  # an alarm is seen, however short what caused it
_NAN = float("nan")

#: Field of the limits, what it is called, its unit.
_LIMITS = (
    ("x_um", "x", "um"),
    ("y_um", "y", "um"),
    ("scale", "scale", ""),
    ("theta_mrad", "theta_z", "mrad"),
    ("chi2_ndf", "chi2/ndf", ""),
    ("frame_rate_hz", "frame rate", "Hz"),
)


@dataclass(frozen=True)
class Condition:
    """What is known of a channel beside its rows.

    Attributes
    ----------
    now_s : float
        By a clock that is not set.
    frame_rate_hz, lost_percent, unlocked_s : float
        NaN where they are not known.
    """

    now_s: float
    frame_rate_hz: float = _NAN
    lost_percent: float = _NAN
    unlocked_s: float = _NAN


class AlarmWatch:
    """Which limits of a channel are exceeded.

    An alarm begins with one value beyond a limit, and ends after a second at least, once all
    values are inside by 5 % of the width of the limits.

    Parameters
    ----------
    alarms : Alarms
    """

    def __init__(self, alarms: Alarms) -> None:
        self._alarms = alarms
        self._on: dict[str, tuple[float, str]] = {}  # when, and the sentence

    @property
    def sentences(self) -> tuple[str, ...]:
        """One for each alarm, such as "x is 12.3 um, above 10 um"."""
        return tuple(text for _, text in self._on.values())

    def look(
        self, rows: NDArray[Any], zero_um: tuple[float, float], condition: Condition
    ) -> tuple[str, ...]:
        """Judge the rows since the last look; the sentences of alarms that are new.

        Parameters
        ----------
        rows : ndarray
            With the columns of a track.
        zero_um : tuple of float
            Taken off the positions.
        condition : Condition
        """
        before = set(self._on)
        values = {
            "x_um": rows["x_um"] - zero_um[0],
            "y_um": rows["y_um"] - zero_um[1],
            "scale": rows["scale"],
            "theta_mrad": 1e3 * rows["theta_rad"],
            "chi2_ndf": rows["chi2_ndf"],
            "frame_rate_hz": np.array([condition.frame_rate_hz]),
        }
        for name, label, unit in _LIMITS:
            limits = getattr(self._alarms, name)
            if limits is not None:
                low, high = limits
                margin = _HYSTERESIS * (high - low)
                self._judge(f"{name} low", label, unit, -values[name], -low, margin, condition)
                self._judge(f"{name} high", label, unit, values[name], high, margin, condition)
        self._judge_single("lost_percent", "lost frames are", "%", condition)
        self._judge_single("unlocked_s", "the time without a position is", "s", condition)
        return tuple(self._on[name][1] for name in self._on if name not in before)

    def _judge_single(self, name: str, label: str, unit: str, condition: Condition) -> None:
        limit = getattr(self._alarms, name)
        if limit is not None:
            value = np.array([getattr(condition, name)])
            self._judge(f"{name} high", label, unit, value, limit, _HYSTERESIS * limit, condition)

    def _judge(
        self,
        name: str,
        label: str,
        unit: str,
        values: NDArray[np.float64],
        limit: float,
        margin: float,
        condition: Condition,
    ) -> None:
        """One limit from above; for a lower one, values and limit come with their signs changed."""
        known = values[np.isfinite(values)]
        if not len(known):
            return  # what is not seen is neither an alarm nor the end of one
        highest = float(known.max())
        if highest > limit:
            since_s = self._on[name][0] if name in self._on else condition.now_s
            self._on[name] = since_s, _sentence(name, label, unit, highest, limit)
        elif name in self._on and highest <= limit - margin:
            if condition.now_s - self._on[name][0] >= _SHORTEST_S:
                del self._on[name]


def _sentence(name: str, label: str, unit: str, value: float, limit: float) -> str:
    sign, side = (-1.0, "below") if name.endswith("low") else (1.0, "above")
    digits = max(3, 2 + _digits_to_tell(value, limit))
    verb = "" if label.endswith(("is", "are")) else " is"
    unit = f" {unit}" if unit else ""
    return f"{label}{verb} {sign * value:.{digits}g}{unit}, {side} {sign * limit:.6g}{unit}"


def _digits_to_tell(value: float, limit: float) -> int:
    """Significant digits in which two numbers begin to differ."""
    largest, apart = max(abs(value), abs(limit)), abs(value - limit)
    return min(12, math.ceil(math.log10(largest / apart))) if apart > 0 and largest > 0 else 0
