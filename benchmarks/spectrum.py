"""Noise floors of simulated tracks: agreement with the bound, and the errors that are stated.

Half hours of SolidRas at 275 Hz: white noise at the bound, drift, pendulum resonances and mains
lines. Repeated with half of the light and at 100 frames a second, and all the same for y, which
has a resonance near 20 Hz as well, as in the paper.

    python benchmarks/spectrum.py -n 200 --json spectrum.json
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

import _study
from rasnik.characterisation.floor import noise_floor
from rasnik.characterisation.gaps import Series
from rasnik.characterisation.lines import find_lines
from rasnik.characterisation.spectrum import welch

#: (frequency in Hz, quality, rms in sigma) of what swings in the suspended SolidRas: the pendulum
#: in x; its strings too in y.
RESONANCES_X = ((0.7, 30, 30), (3.1, 50, 20))
RESONANCES = (*RESONANCES_X, (20.0, 80, 3))
#: (frequency in Hz, amplitude in sigma) of mains lines; 25 and 75 Hz are aliases at 275 Hz.
MAINS = ((50.0, 1.0), (250.0, 0.3), (200.0, 0.2), (100.0, 0.5))
HALF_HOUR_S = 1800.0


def instrument_series(
    rng: np.random.Generator,
    n: int,
    rate_hz: float,
    sigma_nm: float,
    *,
    drift: float = 0.05,
    resonances: Sequence[tuple[float, float, float]] = RESONANCES,
    mains: Sequence[tuple[float, float]] = MAINS,
) -> Series:
    """A track as a suspended instrument on a lab table gives it.

    White noise of `sigma_nm`; a random walk with steps of `drift` sigma; resonators driven by
    white noise; sines that are sampled at the frame rate, so those above half of it are aliases.
    """
    from scipy.signal import lfilter

    values = rng.normal(0, sigma_nm, n) + np.cumsum(rng.normal(0, drift * sigma_nm, n))
    for frequency_hz, quality, rms in resonances:
        turn = 2 * math.pi * frequency_hz / rate_hz
        decay = math.exp(-turn / 2 / quality)
        swing = lfilter([1], [1, -2 * decay * math.cos(turn), decay**2], rng.normal(size=n))
        values += rms * sigma_nm * swing / swing.std()
    time_s = np.arange(n) / rate_hz
    for frequency_hz, amplitude in mains:
        phase = rng.uniform(0, 2 * math.pi)
        values += amplitude * sigma_nm * np.sin(2 * math.pi * frequency_hz * time_s + phase)
    return Series(values, rate_hz)


def pulls(
    runs: int,
    make: Callable[[np.random.Generator], Series],
    psd: float,
    *,
    seed: int = 1,
    with_error: bool = False,
) -> Any:
    """(found - true) / stated error of the noise floor in repeated runs, shape (runs,).

    With `with_error` also (found - true) / true. Both are NaN where no floor was found.
    """
    true = math.sqrt(psd)
    rows = []
    for k in range(runs):
        spectrum = welch(make(np.random.default_rng([seed, k])))
        try:
            floor = noise_floor(spectrum, find_lines(spectrum))
        except ValueError:
            rows.append((math.nan, math.nan))
            continue
        rows.append(((floor.asd - true) / floor.sigma, floor.asd / true - 1))
    found, relative = np.array(rows).T
    return (found, relative) if with_error else found


def main() -> None:
    from rasnik import bound, load_system

    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("-n", type=int, default=200, help="tracks of each kind")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--json", type=Path, help="write the figures to this file")
    options = parser.parse_args()
    print(_study.environment())
    full = load_system("solidras")
    halved = {
        "sensor.dark_level": full.sensor.dark_level / 2,
        "sensor.light_level": full.sensor.light_level / 2,
    }
    pose = (4000.0, 5000.0, 0.0)
    sigma = bound(full, pose, rounding=True).sigma_x_nm
    dim = bound(load_system("solidras", halved), pose, rounding=True).sigma_x_nm
    quantum = [
        bound(load_system("solidras", {"sensor.noise_a": 0.0, **values}), pose).sigma_x_nm
        for values in ({}, halved)
    ]
    kinds = (
        ("x, full light, 275 Hz", sigma, 275.0, RESONANCES_X),
        ("x, half light, 275 Hz", dim, 275.0, RESONANCES_X),
        ("x, full light, 100 Hz", sigma, 100.0, RESONANCES_X),
        ("y, full light, 275 Hz", sigma, 275.0, RESONANCES),
        ("y, full light, 100 Hz", sigma, 100.0, RESONANCES),
    )
    print(
        f"{'':24}{'bound':>8}{'floor':>8}{'scatter':>9}{'worst':>8}{'pull':>16}{'none':>7}"
        "   pm/sqrt(Hz)"
    )
    record, floors = {}, []
    for k, (name, per_frame, rate_hz, swings) in enumerate(kinds):
        n = int(HALF_HOUR_S * rate_hz)
        psd = per_frame**2 * 2 / rate_hz
        found, relative = pulls(
            options.n,
            lambda rng, n=n, r=rate_hz, s=per_frame, w=swings: instrument_series(
                rng, n, r, s, resonances=w
            ),
            psd, seed=options.seed + k, with_error=True,
        )  # fmt: skip
        limit_pm, none = 1e3 * math.sqrt(psd), int(np.isnan(found).sum())
        found, relative = found[np.isfinite(found)], relative[np.isfinite(relative)]
        floors.append(limit_pm * (1 + relative.mean()))
        record[name] = {
            "bound_pm_rthz": limit_pm, "floor_pm_rthz": floors[-1],
            "scatter": float(relative.std()), "worst": float(np.abs(relative).max()),
            "pull_mean": float(found.mean()), "pull_std": float(found.std()), "none": none,
        }  # fmt: skip
        print(
            f"{name:24}{limit_pm:8.2f}{floors[-1]:8.2f}{100 * relative.std():8.2f}%"
            f"{100 * np.abs(relative).max():7.2f}%{found.mean():8.2f} ± {found.std():.2f}"
            f"{none:7}"
        )
    print(
        f"half light / full: {floors[1] / floors[0]:.4f} (bound {dim / sigma:.4f}; shot noise "
        f"alone {quantum[1] / quantum[0]:.4f}, sqrt 2 = 1.4142)\n"
        f"100 Hz / 275 Hz: {floors[2] / floors[0]:.4f} (sqrt 2.75 = 1.6583)"
    )
    if options.json:
        record["environment"] = _study.environment()
        options.json.write_text(json.dumps(record, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
