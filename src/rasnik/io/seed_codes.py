"""Names of seismic channels: network, station, location and channel codes, checked.

A channel code has three letters. The band code follows from the rate and from the lower corner of
the response. The instrument code is H, a high-gain seismometer, where a proof mass hangs on a
known suspension, and otherwise B, a creep meter: displacement between two places of the ground.
The orientation code is N, E or Z within 5 degrees of north, east or the vertical, and otherwise
1, 2 or 3, so that nobody takes it for one of these.

Source: SEED Reference Manual 2.4 (2012), appendix A; lengths of the codes: chapter 8, fixed
header of data.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass

__all__ = ["Direction", "Site", "band_code", "channel_code"]

#: (lowest rate in Hz, code for a corner below 10 s, code for one of 10 s or more).
_BANDS = (
    (1000.0, "G", "F"),
    (250.0, "D", "C"),
    (80.0, "E", "H"),
    (10.0, "S", "B"),
    (1.1, "M", "M"),
    (0.9, "L", "L"),  # "about 1 Hz"
    (0.05, "V", "V"),  # "about 0.1 Hz"
    (0.001, "U", "U"),  # "about 0.01 Hz"
    (1e-4, "R", "R"),
    (1e-5, "P", "P"),
    (1e-6, "T", "T"),
    (0.0, "Q", "Q"),
)
_HIGHEST_HZ = 5000.0
_LONG_S = 10.0
_TOLERANCE_DEG = 5.0
_CODES = {
    "network": (r"[A-Z0-9]{1,2}", "one or two capital letters or digits"),
    "station": (r"[A-Z0-9]{1,5}", "one to five capital letters or digits"),
    "location": (r"([A-Z0-9]{2})?", "two capital letters or digits, or nothing"),
}


@dataclass(frozen=True)
class Direction:
    """Where a channel points.

    Attributes
    ----------
    azimuth_deg : float
        Clockwise from north, 0 to 360.
    dip_deg : float
        Down from the horizontal: -90 is up.
    """

    azimuth_deg: float
    dip_deg: float = 0.0

    def __post_init__(self) -> None:
        if not 0 <= self.azimuth_deg <= 360:
            raise ValueError(f"an azimuth is 0 to 360 degrees from north, not {self.azimuth_deg:g}")
        if not -90 <= self.dip_deg <= 90:
            raise ValueError(
                f"a dip is -90 (up) to 90 degrees (down) from the horizontal, not {self.dip_deg:g}"
            )

    @property
    def letter(self) -> str:
        """N, E or Z within 5 degrees, also if reversed; else nothing."""
        azimuth, dip = math.radians(self.azimuth_deg), math.radians(self.dip_deg)
        level = math.cos(dip)
        along = {
            "N": level * math.cos(azimuth),
            "E": level * math.sin(azimuth),
            "Z": math.sin(dip),
        }
        close = math.cos(math.radians(_TOLERANCE_DEG))
        return next((name for name, part in along.items() if abs(part) >= close), "")


@dataclass(frozen=True)
class Site:
    """Where a station is, and what it is called.

    Attributes
    ----------
    station : str
        One to five capital letters or digits.
    network : str
        One or two; XX is not assigned to anybody.
    location : str
        Two, or nothing: tells sensors of one station apart.
    latitude_deg, longitude_deg : float, optional
        WGS84; StationXML needs them.
    elevation_m, depth_m : float
        Of the ground above the sea; of the instrument below the ground.
    """

    station: str
    network: str = "XX"
    location: str = ""
    latitude_deg: float | None = None
    longitude_deg: float | None = None
    elevation_m: float = 0.0
    depth_m: float = 0.0

    def __post_init__(self) -> None:
        for name, (pattern, wish) in _CODES.items():
            code = getattr(self, name)
            if not re.fullmatch(pattern, code):
                raise ValueError(f"the {name} code {code!r} should be {wish}")
        for name, limit in (("latitude_deg", 90), ("longitude_deg", 180)):
            value = getattr(self, name)
            if value is not None and not -limit <= value <= limit:
                raise ValueError(f"{name} = {value:g} should be from -{limit} to {limit} degrees")
        for name in ("elevation_m", "depth_m"):
            if not math.isfinite(getattr(self, name)):
                raise ValueError(f"{name} = {getattr(self, name):g} should be a number of metres")


def band_code(rate_hz: float, corner_s: float) -> str:
    """The first letter of a channel code.

    Parameters
    ----------
    rate_hz : float
        Samples in a second.
    corner_s : float
        Period down to which the response is flat: above it the sensor falls off. Infinite for
        what measures displacement down to 0 Hz.

    Raises
    ------
    ValueError
        If the rate has no code.
    """
    if not 0 < rate_hz < _HIGHEST_HZ:
        raise ValueError(
            f"SEED has no band code for {rate_hz:g} samples/s, but for rates below "
            f"{_HIGHEST_HZ:g}; give the code of the channel"
        )
    low_hz, short, long = next(band for band in _BANDS if rate_hz >= band[0])
    return long if corner_s >= _LONG_S else short


def channel_code(
    rate_hz: float, natural_hz: float | None, direction: Direction | None, number: int
) -> str:
    """The three letters of a channel.

    Parameters
    ----------
    rate_hz : float
    natural_hz : float, optional
        Natural frequency of the suspension of a proof mass; none without one.
    direction : Direction, optional
        If it is not known, the code has the number.
    number : int
        1, 2 or 3: which of the channels of the instrument it is.
    """
    corner_s = math.inf if natural_hz is None else 1 / natural_hz
    instrument = "B" if natural_hz is None else "H"
    orientation = (direction.letter if direction else "") or str(number)
    return band_code(rate_hz, corner_s) + instrument + orientation
