"""From the ground through images back to the ground: is its motion found, in amplitude and phase?

Simulated ground motion (noise in a band, falling as 1/f^2 above 1 Hz, and a wave packet) moves the
frame of a suspended mass that carries the mask. The equation of motion gives what the Rasnik reads
at any moment. Each frame is exposed for most of its interval: its image is the mean of images at
the nodes of an integration rule within the exposure. The frames, with the noise of the sensor,
are tracked, and the track is turned into ground motion in four ways: by dividing by the response,
by the equation of motion in time, each with the mean over the exposure taken off, and by obspy's
``remove_response`` on the miniSEED and StationXML files that the track is exported to; and once
with the exposure left as it is, to show what that does.

Printed for x and y: rms of the error over rms of the motion; the worst gain and phase of the
transfer function from the true motion to the one found, over bins of the band; what the error
would be by the noise of the readings alone. Two pictures: the motion, and the error as
self-noise of the instrument beside Peterson's noise models.

    python benchmarks/ground_motion.py -o build/ground
    python benchmarks/ground_motion.py -n 6000 --low 0.3
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import _study

_study.one_thread()

import numpy as np  # noqa: E402
from matplotlib.figure import Figure  # noqa: E402
from scipy.interpolate import CubicSpline  # noqa: E402

from rasnik import System, Track, Tracker, bound, load_system  # noqa: E402
from rasnik.characterisation.gaps import Series, even_series  # noqa: E402
from rasnik.characterisation.spectrum import welch  # noqa: E402
from rasnik.imaging.model import expected_image  # noqa: E402
from rasnik.imaging.noise import add_noise  # noqa: E402
from rasnik.imaging.poses import parse_pose  # noqa: E402
from rasnik.io.seed_codes import Direction, Site  # noqa: E402
from rasnik.io.seismic_files import channels_of, obspy, write_miniseed  # noqa: E402
from rasnik.io.station_xml import write_station_xml  # noqa: E402
from rasnik.performance.bound import camera_of, state_at  # noqa: E402
from rasnik.seismic.budget import self_noise  # noqa: E402
from rasnik.seismic.equation_of_motion import reading_of_ground  # noqa: E402
from rasnik.seismic.ground import ground_motion, readout_rms, taper_corners  # noqa: E402
from rasnik.seismic.network import transfer  # noqa: E402
from rasnik.seismic.noise_models import noise_model  # noqa: E402
from rasnik.seismic.suspension import Quantity, Suspension  # noqa: E402

#: What the issue asks for, and what the table is judged by.
LIMIT = 0.01
START_S = 1_790_000_000.0
POSE = (60_031.7, 70_012.3, 0.002)
RATE_HZ = 50.0
EXPOSURE_S = 0.016
MASS = Suspension(frequency_hz=0.5, q=4.0, mass_kg=1.0)
#: Steps of the simulation between two frames.
FINE = 16
#: Positions of the mask that an image is the mean of: exact for cubic motion in the exposure.
NODES = np.array([-1, 1]) / math.sqrt(3)
OUTPUTS = {"displacement": "DISP", "velocity": "VEL", "acceleration": "ACC"}
AXES = ("x_um", "y_um")


@dataclass(frozen=True)
class Setting:
    """One run."""

    n: int = 1200
    low_hz: float = 1.0
    high_hz: float = 10.0
    seed: int = 1
    pixels: tuple[int, int] = (256, 192)

    @property
    def system(self) -> System:
        """SolidRas with a part of its sensor."""
        return load_system(
            "solidras",
            {
                "sensor.width_px": self.pixels[0],
                "sensor.height_px": self.pixels[1],
                "sensor.frame_rate_hz": RATE_HZ,
                "sensor.exposure_s": EXPOSURE_S,
            },
        )

    @property
    def filled_hz(self) -> tuple[float, float]:
        """Where the ground moves: somewhat less than the band in which it is recovered."""
        return 1.25 * self.low_hz, 0.8 * self.high_hz


# ------------------------------------------------------------------------- ground


def ground(setting: Setting, rng: np.random.Generator) -> np.ndarray:
    """Displacement in um on the fine grid, from one second before the first frame."""
    rate_hz = FINE * RATE_HZ
    n = round((setting.n / RATE_HZ + 2) * rate_hz)
    f_hz = np.fft.rfftfreq(n, 1 / rate_hz)
    low, high = setting.filled_hz
    inside = (f_hz >= low) & (f_hz <= high)
    spectrum = inside / (1 + f_hz**2) * (rng.normal(size=(2, len(f_hz))).T @ [1, 1j])
    noise = np.fft.irfft(spectrum, n)
    t_s = np.arange(n) / rate_hz
    packet_hz = math.sqrt(low * high)
    width_s = 3 / packet_hz
    packet = np.exp(-(((t_s - t_s[-1] / 2) / width_s) ** 2) / 2)
    packet *= np.sin(2 * np.pi * packet_hz * t_s)
    # The mass begins at rest, so the ground does too.
    rise = np.clip(np.minimum(t_s, t_s[-1] - t_s), 0, 1)
    return 3.0 * (noise / noise.std() + packet) * (0.5 - 0.5 * np.cos(np.pi * rise))


def quantity_of(displacement: np.ndarray, quantity: Quantity) -> np.ndarray:
    """Derivative of a motion on the fine grid that is still at both ends."""
    s = 2j * np.pi * np.fft.rfftfreq(len(displacement), 1 / (FINE * RATE_HZ))
    power = list(OUTPUTS).index(quantity)
    return np.fft.irfft(np.fft.rfft(displacement) * s**power, len(displacement))


def at_frames(fine: np.ndarray, setting: Setting) -> np.ndarray:
    """Values at the middle of each exposure."""
    first = round(FINE * RATE_HZ)
    return fine[first::FINE][: setting.n]


# ------------------------------------------------------------------------- images


def images(setting: Setting, readings_um: np.ndarray) -> Iterator[np.ndarray]:
    """Frames of a mask that moves, shape (2, fine) um, while each is exposed."""
    system, rng = setting.system, np.random.default_rng([setting.seed, 1])
    start = parse_pose(system, POSE, "start")
    look, camera = state_at(system, start.projection).appearance, camera_of(system)
    path = CubicSpline(np.arange(readings_um.shape[1]) / (FINE * RATE_HZ), readings_um, axis=1)
    for k in range(setting.n):
        moved = path(1 + k / RATE_HZ + EXPOSURE_S / 2 * NODES).T
        parts = [
            expected_image(system.mask, start.moved(*one, 0.0).projection, look, camera)
            for one in moved
        ]
        yield add_noise(np.mean(parts, axis=0, dtype=float), system, rng)


def tracked(setting: Setting, grounds_um: np.ndarray) -> Track:
    """Track of the readings that two ground motions make, shape (2, fine) um."""
    readings = [
        reading_of_ground(Series(own, FINE * RATE_HZ, unit="um"), MASS).values for own in grounds_um
    ]
    frames = _study.track(
        images(setting, np.array(readings)), "frames", setting.n, disable=setting.n < Setting.n
    )
    times_s = (START_S + np.arange(setting.n) / RATE_HZ).tolist()
    return Tracker(setting.system).run(frames, times_s)


# ------------------------------------------------------------------------- ways back


def without_exposure(series: Series) -> Series:
    """The reading without the mean over the exposure, which lowers it by sinc(f T)."""
    mean = series.values.mean()
    f_hz = np.fft.rfftfreq(len(series), 1 / series.rate_hz)
    spectrum = np.fft.rfft(series.values - mean) / np.sinc(f_hz * EXPOSURE_S)
    values = mean + np.fft.irfft(spectrum, len(series))
    return Series(values, series.rate_hz, series.name, series.unit, series.start_s)


def by_obspy(setting: Setting, track: Track, folder: Path, quantity: Quantity) -> list[np.ndarray]:
    """What `remove_response` makes of the exported files, nm, x and y."""
    site = Site("RASN", latitude_deg=0.0, longitude_deg=0.0)
    directions = {"x_um": Direction(90.0), "y_um": Direction(0.0)}
    channels = channels_of(track, site, directions, suspension=MASS, exposure_s=EXPOSURE_S)
    write_miniseed(channels, folder / "ground.mseed", overwrite=True)
    write_station_xml(channels, folder / "ground.xml", overwrite=True)
    package = obspy()
    stream = package.read(str(folder / "ground.mseed"))
    corners = taper_corners((setting.low_hz, setting.high_hz), RATE_HZ)
    stream.remove_response(
        package.read_inventory(str(folder / "ground.xml")),
        output=OUTPUTS[quantity], pre_filt=corners, water_level=None, taper_fraction=0.02,
    )  # fmt: skip
    return [1e9 * stream.select(component=letter)[0].data for letter in "EN"]


def recovered(
    setting: Setting, track: Track, folder: Path, quantity: Quantity
) -> dict[str, list[np.ndarray]]:
    """Ground motion of x and y in nm (per s, per s^2), by the name of the way."""
    band_hz = setting.low_hz, setting.high_hz
    readings = [even_series(track, axis) for axis in AXES]

    def own(series: list[Series], **how: Any) -> list[np.ndarray]:
        return [ground_motion(one, MASS, quantity, band_hz=band_hz, **how).values for one in series]

    without = [without_exposure(one) for one in readings]
    return {
        "division by the response": own(readings, exposure_s=EXPOSURE_S),
        "equation of motion": own(without, method="time"),
        "obspy remove_response": by_obspy(setting, track, folder, quantity),
        "exposure left in": own(readings),
    }


# ------------------------------------------------------------------------- judgement


@dataclass(frozen=True, eq=False)
class Row:
    """One way for one axis and quantity; `error` in the unit of the motion."""

    quantity: Quantity
    axis: str
    way: str
    error: np.ndarray
    relative: float
    gain: float
    phase_rad: float
    by_noise: float

    @property
    def good(self) -> bool:
        return max(self.relative, self.gain, self.phase_rad) < LIMIT


def judge(setting: Setting, truth: np.ndarray, found: np.ndarray) -> tuple[np.ndarray, Any]:
    """(error, transfer from true to found in the filled band), edges left out."""
    edge = math.ceil(6 / setting.low_hz * RATE_HZ)
    truth, found = truth[edge:-edge], found[edge:-edge]
    true_series, found_series = (
        Series(values, RATE_HZ, name) for values, name in ((truth, "true"), (found, "found"))
    )
    length_s = min(len(truth) / RATE_HZ / 3, 8 / setting.low_hz)
    both = transfer(true_series, found_series, length_s=length_s)
    low, high = setting.filled_hz
    step = both.frequency_hz[1]
    inside = (both.frequency_hz >= low + 2 * step) & (both.frequency_hz <= high - 2 * step)
    return found - truth, both.value[inside]


def run(setting: Setting, folder: Path) -> tuple[list[Row], Track, np.ndarray]:
    """All rows, the track, and the ground in um, shape (2, fine)."""
    rng = np.random.default_rng(setting.seed)
    grounds = np.array([ground(setting, rng) for _ in AXES])
    track = tracked(setting, grounds)
    least_nm = 1e3 * np.sqrt(np.diag(bound(setting.system, POSE, rounding=True).covariance)[:2])
    band_hz = setting.low_hz, setting.high_hz
    rows = []
    for quantity in OUTPUTS:
        truths = [1e3 * at_frames(quantity_of(own, quantity), setting) for own in grounds]
        for way, found in recovered(setting, track, folder, quantity).items():
            for k, axis in enumerate(AXES):
                error, value = judge(setting, truths[k], found[k])
                size = float(np.sqrt(np.mean((truths[k]) ** 2)))
                noise = readout_rms(
                    least_nm[k], RATE_HZ, MASS, quantity, band_hz=band_hz,
                    exposure_s=0.0 if way == "exposure left in" else EXPOSURE_S,
                )  # fmt: skip
                rows.append(
                    Row(
                        quantity, axis, way, error,
                        float(np.sqrt(np.mean(error**2))) / size,
                        float(np.max(np.abs(np.abs(value) - 1))),
                        float(np.max(np.abs(np.angle(value)))),
                        noise / size,
                    )
                )  # fmt: skip
    return rows, track, grounds


# ------------------------------------------------------------------------- what is shown


def table(rows: list[Row]) -> bool:
    """Print all; whether every way but the one without correction is good."""
    print(
        f"\n{'':>14}{'':>4}  {'way':<26}{'rms error':>11}{'by noise':>11}{'gain - 1':>11}"
        f"{'phase, rad':>12}"
    )
    for row in rows:
        print(
            f"{row.quantity:>14}{row.axis[0]:>4}  {row.way:<26}{100 * row.relative:>10.3f}%"
            f"{100 * row.by_noise:>10.3f}%{100 * row.gain:>10.3f}%{row.phase_rad:>12.5f}"
        )
    counted = [row for row in rows if row.way != "exposure left in"]
    good = all(row.good for row in counted)
    print(f"  all ways that undo the exposure within {100 * LIMIT:g} %: {'yes' if good else 'NO'}")
    return good


def plot_motion(setting: Setting, track: Track, grounds: np.ndarray, path: Path) -> None:
    """Ground, reading and what is left, against time."""
    figure = Figure(figsize=(9, 7), layout="constrained")
    upper, middle, lower = figure.subplots(3, 1, sharex=True)
    t_s = np.arange(setting.n) / RATE_HZ
    truth = at_frames(grounds[0], setting)
    series = even_series(track, "x_um")
    band_hz = setting.low_hz, setting.high_hz
    found = ground_motion(series, MASS, "displacement", band_hz=band_hz, exposure_s=EXPOSURE_S)
    upper.plot(t_s, track.x_um - track.x_um.mean(), lw=0.6, color="tab:gray")
    upper.set(ylabel="reading x, um", title="what the Rasnik reads")
    middle.plot(t_s, truth, lw=0.8, color="black", label="true")
    middle.plot(t_s, 1e-3 * found.values, lw=0.6, color="tab:orange", label="from the images")
    middle.set(ylabel="ground, um", title="displacement of the ground")
    middle.legend(loc="upper right", fontsize=8)
    lower.plot(t_s, found.values - 1e3 * truth, lw=0.6, color="tab:red")
    lower.set(ylabel="difference, nm", xlabel="time, s", title="found less true")
    figure.savefig(path, dpi=120)


def plot_self_noise(setting: Setting, rows: list[Row], grounds: np.ndarray, path: Path) -> None:
    """Error of the acceleration as self-noise, with budgets and noise models."""
    figure = Figure(figsize=(9, 6), layout="constrained")
    axes = figure.subplots()
    f_hz = np.geomspace(0.01, 10, 500)
    for model, style in (("low", "-"), ("high", "--")):
        psd = noise_model(f_hz, model, "acceleration")
        name = f"Peterson, {model}-noise model"
        axes.loglog(f_hz, np.sqrt(psd), style, color="black", lw=1.2, label=name)
    low, high = setting.filled_hz
    window_s = 8 / setting.low_hz
    acceleration = at_frames(quantity_of(grounds[0], "acceleration"), setting)
    spectrum = welch(Series(1e-6 * acceleration, RATE_HZ), length_s=window_s)
    inside = (spectrum.frequency_hz > low) & (spectrum.frequency_hz < high)
    axes.loglog(
        spectrum.frequency_hz[inside], spectrum.asd[inside], color="tab:blue", lw=1,
        label="simulated ground, x",
    )  # fmt: skip
    for row in rows:
        if row.quantity == "acceleration" and row.axis == "x_um" and row.way.startswith("division"):
            spectrum = welch(Series(1e-9 * row.error, RATE_HZ), length_s=window_s)
            axes.loglog(
                spectrum.frequency_hz[inside], spectrum.asd[inside], color="tab:red", lw=1,
                label="found less true, x",
            )  # fmt: skip
    width, height = setting.pixels
    budgets = {
        f"budget of this run ({RATE_HZ:g} Hz, {width} x {height} pixels)": setting.system,
        "the same with SolidRas whole, 275 Hz": load_system("solidras"),
        "the same with MicroRas, 275 Hz": load_system("microras"),
    }
    for (name, system), style in zip(budgets.items(), ("-", "-.", ":"), strict=True):
        noise = self_noise(system, MASS, frequency_hz=f_hz)
        axes.loglog(f_hz, noise.total, style, color="tab:green", lw=1.5, label=name)
    axes.set(
        xlabel="frequency, Hz", ylabel="acceleration, m/s$^2$/sqrt(Hz), one-sided",
        xlim=(f_hz[0], f_hz[-1]), ylim=(1e-12, 1e-2),
        title=f"Self-noise: mass of 1 kg at {MASS.frequency_hz:g} Hz, Q = {MASS.q:g}",
    )  # fmt: skip
    axes.grid(alpha=0.3, which="both")
    axes.legend(fontsize=8)
    figure.savefig(path, dpi=120)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("-n", type=int, default=Setting.n, help="frames")
    parser.add_argument("--low", type=float, default=Setting.low_hz, help="Hz, end of the band")
    parser.add_argument("--high", type=float, default=Setting.high_hz, help="Hz, other end")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("-o", "--output", type=Path, default=Path("build/ground"), metavar="DIR")
    options = parser.parse_args()
    setting = Setting(options.n, options.low, options.high, options.seed)
    if setting.n / RATE_HZ < 24 / setting.low_hz:
        parser.error(f"{setting.n} frames are too few for a band from {setting.low_hz:g} Hz")
    options.output.mkdir(parents=True, exist_ok=True)
    print(_study.environment(), f"seed {setting.seed}", sep="\n")
    print(
        f"{setting.n} frames at {RATE_HZ:g} Hz exposed for {1e3 * EXPOSURE_S:g} ms; mass at "
        f"{MASS.frequency_hz:g} Hz, Q = {MASS.q:g}; band {setting.low_hz:g}..{setting.high_hz:g} Hz"
    )
    rows, track, grounds = run(setting, options.output)
    print(
        f"frames without a position: {np.count_nonzero(~track.ok)}; ground motion rms "
        f"{grounds.std():.3g} um, peak {np.abs(grounds).max():.3g} um"
    )
    good = table(rows)
    plot_motion(setting, track, grounds, options.output / "ground-motion.png")
    plot_self_noise(setting, rows, grounds, options.output / "self-noise.png")
    print(f"  plots and files in {options.output}")
    raise SystemExit(not good)


if __name__ == "__main__":
    main()
