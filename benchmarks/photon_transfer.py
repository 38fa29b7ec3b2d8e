"""A and B of simulated recordings, again and again: do they lie within their stated errors?

Each trial is a recording of its own, with noise, rounding and saturation of an 8-bit sensor:
a still mask; light that flickers by 1 % rms; a mask that drifts by 0.1 pixel along x and 0.05
along y; both; and a mask that shakes by 0.1 pixel (rms 0.03) with the flicker.

    python benchmarks/photon_transfer.py -n 200
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator
from functools import partial
from typing import Any

import _study

_study.one_thread()

import numpy as np  # noqa: E402

from rasnik import Projection, load_system  # noqa: E402
from rasnik.characterisation.photon_transfer import photon_transfer  # noqa: E402
from rasnik.imaging.appearance import Appearance, Camera  # noqa: E402
from rasnik.imaging.model import expected_image  # noqa: E402
from rasnik.imaging.noise import ReadOut  # noqa: E402
from rasnik.instrument import System  # noqa: E402

#: (name, relative rms of the light, range of the drift and of the shaking in pixels)
CASES = (
    ("still", 0.0, 0.0, 0.0),
    ("1 % flicker", 0.01, 0.0, 0.0),
    ("0.1 pixel drift", 0.0, 0.1, 0.0),
    ("flicker and drift", 0.01, 0.1, 0.0),
    ("flicker and shaking", 0.01, 0.0, 0.1),
)
WITHIN = 0.6827  # of a normal distribution within one sigma


def small_system(width: int, height: int, light_level: float) -> System:
    """SolidRas with fewer pixels and a light that leaves room for the flicker."""
    sizes = {"width_px": width, "height_px": height, "light_level": light_level}
    return load_system("solidras", {"sensor": sizes})


def recording(
    system: System, n: int, seed: tuple[int, ...], flicker: float, drift: float, shake: float
) -> Iterator[np.ndarray]:
    """Frames of one recording, the mask at a place of its own."""
    rng = np.random.default_rng(seed)
    sensor = system.sensor
    look = Appearance.uniform(sensor.dark_level, sensor.light_level, system.optics.blur_um)
    camera = Camera(system.shape, system.pitch_um)
    x, y = rng.uniform(3000, 9000, 2)
    theta = rng.normal(0, 5e-3)
    along = drift * np.linspace(-0.5, 0.5, n)
    path = np.stack([along, along / 2]) + shake * rng.uniform(-0.5, 0.5, (2, n))
    light = 1 + flicker * rng.standard_normal(n)
    expected = None
    for k in range(n):
        if expected is None or drift or shake:
            dx, dy = path[:, k] * system.pitch_um
            projection = Projection.from_pose(x + dx, y + dy, 1.0, theta, 4)
            expected = expected_image(system.mask, projection, look, camera)
        yield ReadOut(light[k] * expected, system).frame(rng)


def trial(k: int, case: tuple[Any, ...], system: System, frames: int, seed: int) -> list[float]:
    """(A, sigma_A, B, sigma_B, chi2_ndf, edge_excess) of one recording."""
    name, *disturbance = case
    key = (seed, k, [c[0] for c in CASES].index(name))
    found = photon_transfer(recording(system, frames, key, *disturbance))
    law = found.law
    return [law.A, law.sigma_A, law.B, law.sigma_B, law.chi2_ndf, found.edge_excess]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("-n", type=int, default=200, help="trials for each case")
    parser.add_argument("--frames", type=int, default=64)
    parser.add_argument("--width", type=int, default=180)
    parser.add_argument("--height", type=int, default=135)
    parser.add_argument("--light", type=float, default=235.0, help="grey level of white")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("-j", "--jobs", type=int, default=2)
    parser.add_argument("--case", help="only cases whose name holds this")
    parser.add_argument("--json", metavar="FILE")
    options = parser.parse_args()
    system = small_system(options.width, options.height, options.light)
    a, b = system.noise_law
    print(_study.environment())
    print(
        f"\n{options.n} recordings for each case, {options.frames} frames of {options.width} x "
        f"{options.height} pixels, A = {a}, B = {b}, seed {options.seed}"
    )
    print(
        f"{'':22}{'A':>8}{'sigma':>8}{'bias/sigma':>12}{'within 1 sigma':>16}"
        f"{'B':>11}{'sigma':>9}{'bias/sigma':>12}{'within 1 sigma':>16}{'chi2/ndf':>10}"
        f"{'edges':>8}"
    )
    results = {}
    for case in CASES:
        if options.case and options.case not in case[0]:
            continue
        run = partial(trial, case=case, system=system, frames=options.frames, seed=options.seed)
        rows = np.array(_study.trials(run, range(options.n), options.jobs))
        line, results[case[0]] = f"{case[0]:22}", rows.tolist()
        for value, sigma, truth, digits in ((*rows[:, :2].T, a, 4), (*rows[:, 2:4].T, b, 6)):
            pull = (value - truth) / sigma
            line += f"{value.mean():8.{digits}f}" if digits == 4 else f"{value.mean():11.{digits}f}"
            line += f"{sigma.mean():8.{digits}f}" if digits == 4 else f"{sigma.mean():9.{digits}f}"
            line += f"{pull.mean():12.2f}{100 * np.mean(np.abs(pull) < 1):14.1f} %"
        print(f"{line}{rows[:, 4].mean():10.4f}{100 * rows[:, 5].mean():7.2f}%")
    chance = 100 * math.sqrt(WITHIN * (1 - WITHIN) / options.n)
    print(f"(expected {100 * WITHIN:.1f} %, by chance +- {chance:.1f} %)")
    _study.save_json(options.json, options=vars(options), results=results)


if __name__ == "__main__":
    main()
