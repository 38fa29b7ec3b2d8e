"""What is drawn against time, in the units that it is read in: nm, ppm and urad from the zero."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import Any

from rasnik.live.status import ChannelStatus

__all__ = ["QUANTITIES", "Quantity", "channel_dict", "finite", "relative"]


@dataclass(frozen=True)
class Quantity:
    """One curve.

    Attributes
    ----------
    key : str
        Its name in messages, with the unit.
    column, sigma : str
        Where it stands in rows, and its standard deviation.
    unit : str
        As it is read.
    factor : float
        From the unit of the column.
    """

    key: str
    column: str
    sigma: str
    unit: str
    factor: float

    def zero(self, status: ChannelStatus) -> float:
        """What is taken off, in the unit of the column."""
        return {
            "x_um": status.zero_um[0],
            "y_um": status.zero_um[1],
            "scale": status.zero_scale,
            "theta_rad": status.zero_theta_rad,
        }[self.column]

    def gain(self, status: ChannelStatus) -> float:
        """From the column to the curve: a scale is relative to that of the zero."""
        return self.factor / status.zero_scale if self.column == "scale" else self.factor

    def shown(self, values: Any, status: ChannelStatus) -> Any:
        """Values of the column as they are drawn; numbers or arrays."""
        return (values - self.zero(status)) * self.gain(status)


#: Their order is that of the page.
QUANTITIES = (
    Quantity("x_nm", "x_um", "sigma_x_um", "nm", 1e3),
    Quantity("y_nm", "y_um", "sigma_y_um", "nm", 1e3),
    Quantity("scale_ppm", "scale", "sigma_scale", "ppm", 1e6),
    Quantity("theta_urad", "theta_rad", "sigma_theta_rad", "urad", 1e6),
)


def relative(status: ChannelStatus) -> dict[str, float]:
    """The position from the zero, and its standard deviations, in the units of the page."""
    values: dict[str, float] = {}
    for quantity in QUANTITIES:
        values[quantity.key] = quantity.shown(getattr(status, quantity.column), status)
        values[f"sigma_{quantity.key}"] = getattr(status, quantity.sigma) * quantity.gain(status)
    return values


def finite(value: Any) -> Any:
    """The same with None for every number that JSON has no word for."""
    if isinstance(value, dict):
        return {key: finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [finite(item) for item in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value


def channel_dict(channel: Any) -> dict[str, Any]:
    """A channel's status as JSON, with the position from the zero beside that from the origin.

    `keep_exposure` is null where the channel does not tell whether it keeps its exposure.
    """
    status = channel.status()
    content = dataclasses.asdict(status)
    content["relative"] = relative(status)
    content["keep_exposure"] = getattr(channel, "keeps_exposure", None)
    return dict(finite(content))
