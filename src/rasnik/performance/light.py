"""Electrons, photons and light power that an image takes.

Source: van der Graaf et al., section 3 "Quantum fluctuations: shot noise" and section 4
"Welch plots", where the well depth of 22k electrons is compared with the power of the LED.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass

from rasnik.instrument import System

__all__ = ["Light", "light_of"]

_PLANCK_J_S = 6.62607015e-34
_LIGHT_SPEED_M_S = 299792458.0


@dataclass(frozen=True)
class Light:
    """What the shot noise of a system says about its light; None where it says nothing.

    Attributes
    ----------
    electrons_per_grey : float
        1 / B: electrons in a physical pixel per grey level, from the shot noise.
    electrons_white : float
        Electrons in a physical pixel of a white field.
    full_well_use : float
        `electrons_white` / full well.
    full_well_consistency : float
        Electrons at full scale from the shot noise / full well: 1 if both agree.
    electrons_per_second : float
        In all pixels, half of them white.
    quantum_efficiency_assumed : float
        The system's, or 1 if it states none: the power is then the least possible.
    photons_white : float
        Photons on a physical pixel of a white field.
    power_uw : float
        Light power on the sensor, averaged over time, in microwatts. Losses on the way from
        the lamp are not in it.
    """

    electrons_per_grey: float | None
    electrons_white: float | None
    full_well_use: float | None
    full_well_consistency: float | None
    electrons_per_second: float | None
    quantum_efficiency_assumed: float
    photons_white: float | None
    power_uw: float | None

    def figures(self) -> dict[str, float | None]:
        """All of them by name."""
        return asdict(self)


def light_of(system: System) -> Light:
    """Electrons and light of a system.

    The electrons of a grey level are taken from the shot noise, variance = A + B Q: for
    electrons the variance equals the number, so that one is B grey levels high.
    """
    sensor = system.sensor
    efficiency = sensor.quantum_efficiency or 1.0
    per_grey = 1 / sensor.noise_b if sensor.noise_b else sensor.electrons_per_grey
    white = well_use = consistency = rate = photons = power = None
    if per_grey is not None:
        white = per_grey * sensor.light_level
        photons = white / efficiency
        if sensor.full_well_e is not None:
            well_use = white / sensor.full_well_e
            consistency = per_grey * sensor.full_scale / sensor.full_well_e
        if sensor.frame_rate_hz is not None:
            mean = per_grey * (sensor.dark_level + sensor.light_level) / 2
            rate = mean * sensor.width_px * sensor.height_px * sensor.frame_rate_hz
            if system.optics.wavelength_nm is not None:
                photon_j = _PLANCK_J_S * _LIGHT_SPEED_M_S / (system.optics.wavelength_nm * 1e-9)
                power = 1e6 * rate / efficiency * photon_j
    return Light(per_grey, white, well_use, consistency, rate, efficiency, photons, power)
