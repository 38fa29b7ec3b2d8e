"""Resolution, linearity and honesty of both methods on exactly known SolidRas images.

Images come from the exact generator, which shares no formula with the fit. Three tables:
error without noise (linearity), rms error and pulls of noisy images at random poses, both
against the stated sigma, for the likelihood fit and for the Fourier method.

    python benchmarks/accuracy.py -n 500
"""

from __future__ import annotations

import argparse

import _study

_study.one_thread()

import numpy as np  # noqa: E402

from rasnik import analyse, load_system  # noqa: E402
from rasnik.imaging.montecarlo import exact_image  # noqa: E402
from rasnik.imaging.noise import add_noise  # noqa: E402
from rasnik.imaging.projection import Projection  # noqa: E402

SYSTEM = load_system("solidras")
METHODS = ("likelihood", "fourier")


def _errors(image: np.ndarray, pose: tuple[float, ...]) -> dict[str, np.ndarray]:
    """Errors of x, y, S, theta_z and their stated sigmas, per method, shape (2, 4)."""
    results = {}
    for method in METHODS:
        found = analyse(image, SYSTEM, method=method, orientation=int(pose[4]))
        values = (found.x_um, found.y_um, found.scale, found.theta_rad)
        sigmas = (found.sigma_x_um, found.sigma_y_um, found.sigma_scale, found.sigma_theta_rad)
        truth = (pose[0], pose[1], pose[2], pose[3])
        results[method] = np.array([np.subtract(values, truth), sigmas])
    return results


def noise_free(pose: tuple[float, ...]) -> dict[str, np.ndarray]:
    return _errors(exact_image(SYSTEM, Projection.from_pose(*pose[:4], int(pose[4]))), pose)


def noisy(job: tuple[tuple[float, ...], int]) -> dict[str, np.ndarray]:
    pose, seed = job
    expected = exact_image(SYSTEM, Projection.from_pose(*pose[:4], int(pose[4])))
    return _errors(add_noise(expected, SYSTEM, np.random.default_rng(seed)), pose)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("-n", type=int, default=40, help="noisy images")
    parser.add_argument("--positions", type=int, default=10, help="noise-free positions per angle")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    print(_study.environment())
    rng = np.random.default_rng(options.seed)

    print("\nWithout noise: largest and rms error of x and y, nm")
    print(f"{'theta_z, mrad':>14} " + "".join(f"{m:>24}" for m in METHODS))
    for theta in (0.0, 0.002, 0.02):
        poses = [(*rng.uniform(1e4, 1.8e5, 2), 1.0, theta, 4) for _ in range(options.positions)]
        results = _study.trials(noise_free, poses, options.jobs)
        row = f"{theta * 1e3:>14.0f} "
        for method in METHODS:
            error = np.array([r[method][0, :2] for r in results]) * 1e3
            row += f"{np.abs(error).max():>14.4f}{np.sqrt((error**2).mean()):>10.4f}"
        print(row)

    jobs = []
    for k in range(options.n):
        pose = (*rng.uniform(1e4, 1.8e5, 2), 1.0, rng.uniform(-0.05, 0.05), 4)
        jobs.append((pose, options.seed * 1_000_000 + k))
    results = _study.trials(noisy, jobs, options.jobs)
    print(f"\nWith noise, {options.n} images at random poses, 8 bits")
    units = (("x, nm", 1e3), ("y, nm", 1e3), ("S, 1e-6", 1e6), ("theta_z, urad", 1e6))
    for method in METHODS:
        values = np.array([r[method] for r in results])
        lost = np.isnan(values[:, 0, 0])
        values = values[~lost]
        pulls = values[:, 0] / values[:, 1]
        print(f"\n{method}: {lost.sum()} without result")
        print(
            f"{'':>14}{'rms error':>12}{'rms sigma':>12}{'ratio':>8}"
            f"{'pull std':>10}{'max pull':>10}"
        )
        for k, (name, unit) in enumerate(units):
            rms = np.sqrt((values[:, 0, k] ** 2).mean()) * unit
            sigma = np.sqrt((values[:, 1, k] ** 2).mean()) * unit
            print(
                f"{name:>14}{rms:>12.4f}{sigma:>12.4f}{rms / sigma:>8.3f}"
                f"{pulls[:, k].std():>10.3f}{np.abs(pulls[:, k]).max():>10.2f}"
            )


if __name__ == "__main__":
    main()
