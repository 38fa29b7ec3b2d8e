"""The bound against the scatter of the fit, for SolidRas as the paper simulates it.

Images of one pose come from the exact generator, which shares no formula with the fit or the
bound; noise, rounding and saturation are those of the sensor. Whole and binned images, at full
and at half light, beside what the paper's analysis of simulated images reaches.

    python benchmarks/bound_check.py -n 300
"""

from __future__ import annotations

import argparse
import math

import _study

_study.one_thread()

import numpy as np  # noqa: E402

from rasnik import analyse, load_system  # noqa: E402
from rasnik.imaging.montecarlo import exact_image  # noqa: E402
from rasnik.imaging.noise import ReadOut  # noqa: E402
from rasnik.performance.bound import bound  # noqa: E402
from rasnik.performance.coupling import coupled  # noqa: E402

POSE = (4000.0, 5000.0, 0.0)  # the paper's first position
CASES = (
    ("whole images", 1, 1.0, 3.0),
    ("superpixels of 2 x 2", 2, 1.0, 3.3),
    ("whole images, half light", 1, 0.5, 4.8),
    ("superpixels, half light", 2, 0.5, 5.0),
)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("-n", type=int, default=300, help="images for each case")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    print(_study.environment())
    print(f"\n{options.n} images for each case at {POSE}, 8 bits; nm per image, x and y together")
    print(f"{'':28}{'bound':>8}{'scatter':>9}{'ratio':>8}{'theta ratio':>13}{'paper':>8}")
    for label, binning, light, paper in CASES:
        system = coupled(load_system("solidras"), {"sensor.light_factor": light})
        system = load_system(system, {"sensor.binning": binning})
        least = bound(system, POSE, rounding=True)
        readout = ReadOut(exact_image(system, least.poses[0]), system)
        found, prior = [], None
        for k in range(options.n):
            image = readout.frame(np.random.default_rng([options.seed, k]))
            pose = analyse(image, system, model="similarity", prior=prior)
            prior = prior or pose
            found.append([pose.x_um, pose.y_um, pose.theta_rad])
        spread = np.std(found, axis=0, ddof=1)
        scatter = 1e3 * math.hypot(spread[0], spread[1]) / math.sqrt(2)
        turn = spread[2] / least.sigma_theta_rad
        print(
            f"{label:28}{least.sigma_nm:8.3f}{scatter:9.3f}{scatter / least.sigma_nm:8.3f}"
            f"{turn:13.3f}{paper:8.1f}"
        )
    chance = 100 / math.sqrt(4 * options.n)
    print(f"(by chance the ratio varies by {chance:.1f} %, that of theta by {chance * 1.41:.1f} %)")


if __name__ == "__main__":
    main()
