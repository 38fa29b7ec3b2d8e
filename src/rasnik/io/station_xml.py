"""The response of a channel as StationXML, from which obspy's ``remove_response`` works.

Stages, in the order of the signal:

1. displacement of the ground -> displacement of the frame relative to the proof mass: poles and
   zeros of the suspension (none without a proof mass),
2. metres -> counts: the gain, and the rate,
3. the mean over the exposure: a symmetric FIR filter, fitted to the transform of the exposure,
   sin(pi f T) / (pi f T).

Time stamps are taken as the middle of the exposure; what a camera and its link add to that is not
in the response.

Source: FDSN StationXML schema 1.1; SEED Reference Manual 2.4 (2012), appendix C, for stages
and their normalisation.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from rasnik.io.seismic_files import SeismicChannel, obspy

if TYPE_CHECKING:
    from obspy import Inventory

__all__ = [
    "counts_per_metre",
    "exposure_filter",
    "sample_rate_hz",
    "to_inventory",
    "write_station_xml",
]

#: Coefficients of the filter on each side of its middle.
_HALF = 24
#: Up to this fraction of the rate it is fitted; half the rate is the end of the band.
_FITTED = 0.48
# Exposures below this fraction of an interval change an amplitude by less than 2e-4.
_SHORT = 0.02
_SOFTWARE = "rasnik"


def to_inventory(channels: Iterable[SeismicChannel]) -> Inventory:
    """The channels with their responses, as obspy has them.

    Raises
    ------
    ValueError
        If a place is not known, channels of one station disagree about theirs, or the damping
        of a suspension is structural, which has no poles.
    ImportError
        If obspy is not installed.
    """
    obspy()
    from obspy.core.inventory import Inventory, Network, Station

    channels = list(channels)
    networks: dict[str, dict[str, list[SeismicChannel]]] = {}
    for one in channels:
        networks.setdefault(one.site.network, {}).setdefault(one.site.station, []).append(one)
    made = []
    for network, stations in networks.items():
        inside = []
        for code, own in stations.items():
            latitude, longitude = _place(own[0])
            if any(_place(one) != (latitude, longitude) for one in own):
                raise ValueError(f"the channels of station {code} are not at one place")
            inside.append(
                Station(
                    code,
                    latitude,
                    longitude,
                    own[0].site.elevation_m,
                    channels=[_channel(one) for one in own],
                    creation_date=min(_start(one) for one in own),
                    start_date=min(_start(one) for one in own),
                )
            )
        made.append(Network(network, stations=inside))
    return Inventory(networks=made, source=_SOFTWARE)


def write_station_xml(
    channels: Iterable[SeismicChannel], path: str | os.PathLike[str], *, overwrite: bool = False
) -> None:
    """Write the responses of channels into one StationXML file.

    Raises
    ------
    FileExistsError
        If the file exists and is not to be overwritten.
    ValueError, ImportError
        As `to_inventory`.
    OSError
        If the file cannot be written.
    """
    path = Path(path)
    if path.exists() and not overwrite:
        raise FileExistsError(
            f"{path} exists already; give another name, or overwrite=True to replace it"
        )
    inventory = to_inventory(channels)
    unfinished = path.with_name(f"{path.stem}.partial{path.suffix}")
    try:
        with unfinished.open("wb") as file:
            inventory.write(file, format="STATIONXML")
        unfinished.replace(path)
    finally:
        unfinished.unlink(missing_ok=True)


def counts_per_metre(inventory: Inventory, identifier: str, when: Any) -> float:
    """Counts of a channel for a metre of the displacement that its sensor hands on.

    Parameters
    ----------
    inventory : obspy Inventory
    identifier : str
        ``network.station.location.channel``.
    when : obspy UTCDateTime
        Descriptions change with time.

    Raises
    ------
    ValueError
        If the channel is not described, or hands on something else than a displacement.
    """
    response = _described(inventory, identifier, when).response
    stages = response.response_stages if response else []
    if not stages:
        raise ValueError(f"the StationXML holds no stages of the response of {identifier}")
    digital = stages[1:] if (stages[0].output_units or "").upper() == "M" else stages
    if (digital[0].input_units or "").upper() != "M":
        raise ValueError(
            f"{identifier} turns {digital[0].input_units} into counts, not metres: it is not a "
            "displacement sensor"
        )
    return float(np.prod([stage.stage_gain for stage in digital]))


def sample_rate_hz(inventory: Inventory, identifier: str, when: Any) -> float | None:
    """Samples in a second of a channel, which miniSEED rounds to 7 digits; None if not stated.

    Raises
    ------
    ValueError
        If the channel is not described.
    """
    rate_hz = _described(inventory, identifier, when).sample_rate
    return float(rate_hz) if rate_hz else None


def exposure_filter(exposure_frames: float) -> NDArray[np.float64]:
    """Symmetric filter with the response of an exposure, as far as frames can show it.

    Parameters
    ----------
    exposure_frames : float
        Exposure time as a fraction of the time between two frames.

    Returns
    -------
    ndarray, shape (25,)
        From the outermost coefficient to the one in the middle; the other half mirrors it.
        The whole sums to 1. For an exposure of a whole interval it is right to 2e-4 up to
        0.45 of the rate.
    """
    nu = np.linspace(0, _FITTED, 40 * _HALF)
    wanted = np.sinc(nu * exposure_frames)
    # 2 c_k (cos(2 pi nu k) - 1) keeps the sum of all at 1.
    k = np.arange(1, _HALF + 1)
    matrix = 2 * (np.cos(2 * np.pi * np.outer(nu, k)) - 1)
    side = np.linalg.lstsq(matrix, wanted - 1, rcond=1e-9)[0]
    return np.append(side[::-1], 1 - 2 * side.sum())


# ------------------------------------------------------------------------ parts


def _described(inventory: Inventory, identifier: str, when: Any) -> Any:
    """The channel of obspy's inventory."""
    network, station, location, code = identifier.split(".")
    found = inventory.select(network, station, location, code, time=when)
    for one in found:
        for place in one:
            for channel in place:
                return channel
    raise ValueError(f"the StationXML does not describe {identifier} at this time")


def _place(one: SeismicChannel) -> tuple[float, float]:
    site = one.site
    if site.latitude_deg is None or site.longitude_deg is None:
        raise ValueError(
            f"StationXML needs the place of station {site.station}: its latitude and longitude"
        )
    return site.latitude_deg, site.longitude_deg


def _start(one: SeismicChannel) -> Any:
    return obspy().UTCDateTime(math.floor(one.series.start_s))


def _channel(one: SeismicChannel) -> Any:
    from obspy.core.inventory import Channel, Equipment

    latitude, longitude = _place(one)
    direction = one.direction
    return Channel(
        one.code,
        one.site.location,
        latitude,
        longitude,
        one.site.elevation_m - one.site.depth_m,  # of the sensor; of a station it is the ground's
        one.site.depth_m,
        azimuth=direction.azimuth_deg % 360 if direction else None,  # 360 is not in the schema
        dip=direction.dip_deg if direction else None,
        types=["CONTINUOUS", "GEOPHYSICAL"],
        sample_rate=one.series.rate_hz,
        sensor=Equipment(type="Rasnik", description=_about(one)),
        response=_response(one),
        start_date=_start(one),
    )


def _about(one: SeismicChannel) -> str:
    """One sentence for people; the response is for programs."""
    if one.suspension is None:
        return f"Rasnik, column {one.series.name}: displacement of the camera relative to the mask"
    mass = one.suspension
    return (
        f"Rasnik, column {one.series.name}: displacement of the frame relative to a proof mass at "
        f"{mass.frequency_hz:g} Hz, Q {mass.q:g}, that carries the {mass.on_mass}"
    )


def _response(one: SeismicChannel) -> Any:
    from obspy.core.inventory import InstrumentSensitivity, Response

    rate_hz = one.series.rate_hz
    at_hz = _reference_hz(one)
    stages = [_suspension_stage(one, at_hz)] if one.suspension else []
    stages.append(_gain_stage(one, len(stages) + 1, at_hz))
    total = float(np.prod([stage.stage_gain for stage in stages]))
    if one.exposure_s * rate_hz > _SHORT:
        half = exposure_filter(one.exposure_s * rate_hz)
        stages.append(_exposure_stage(half, len(stages) + 1, rate_hz))
        k = np.arange(len(half) - 1, 0, -1)
        total *= half[-1] + 2 * float(half[:-1] @ np.cos(2 * np.pi * k * at_hz / rate_hz))
    sensitivity = InstrumentSensitivity(
        total, at_hz, "M", "COUNTS", "displacement of the ground, metres", "digital counts"
    )
    return Response(instrument_sensitivity=sensitivity, response_stages=stages)


def _reference_hz(one: SeismicChannel) -> float:
    """Where gains are stated: well above the resonance if frames can show that."""
    rate_hz = one.series.rate_hz
    natural_hz = one.suspension.frequency_hz if one.suspension else 0.0
    return float(min(max(10 * natural_hz, rate_hz / 100), rate_hz / 10))


def _suspension_stage(one: SeismicChannel, at_hz: float) -> Any:
    from obspy.core.inventory import PolesZerosResponseStage

    assert one.suspension is not None
    found = one.suspension.poles_zeros("displacement")
    size = float(abs(found.response(at_hz)))
    # Stored is the frame relative to the mass, of the other sign than the mass to the frame.
    return PolesZerosResponseStage(
        1, size, at_hz, "M", "M", "LAPLACE (RADIANS/SECOND)", at_hz,
        list(found.zeros), list(found.poles), normalization_factor=-found.gain / size,
        name="suspension",
        input_units_description="displacement of the ground, metres",
        output_units_description="displacement of the frame relative to the mass, metres",
    )  # fmt: skip


def _gain_stage(one: SeismicChannel, number: int, at_hz: float) -> Any:
    from obspy.core.inventory import CoefficientsTypeResponseStage

    return CoefficientsTypeResponseStage(
        number, one.counts_per_m, at_hz, "M", "COUNTS", "DIGITAL", name="readout",
        numerator=[1.0], denominator=[],
        input_units_description="displacement, metres",
        output_units_description="digital counts",
        **_timing(one.series.rate_hz),
    )  # fmt: skip


def _exposure_stage(half: NDArray[np.float64], number: int, rate_hz: float) -> Any:
    from obspy.core.inventory import FIRResponseStage

    return FIRResponseStage(
        number, 1.0, 0.0, "COUNTS", "COUNTS", symmetry="ODD", coefficients=half.tolist(),
        name="mean over the exposure",
        input_units_description="digital counts", output_units_description="digital counts",
        **_timing(rate_hz),
    )  # fmt: skip


def _timing(rate_hz: float) -> dict[str, Any]:
    return {
        "decimation_input_sample_rate": rate_hz,
        "decimation_factor": 1,
        "decimation_offset": 0,
        "decimation_delay": 0.0,
        "decimation_correction": 0.0,
    }
