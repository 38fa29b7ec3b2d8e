"""What the generator itself does to the position: bias of the fit on its noise-free images.

Noise-free SolidRas images of both paths, `exact` and `paper`, are moved in steps over one pixel
along x and analysed by the likelihood fit (similarity). Per path and rotation: mean,
peak-to-peak and rms about the mean of (fitted x - true x).

    python benchmarks/generator_bias.py --steps 14

Likewise the linearity error that an effect causes, here over two fields:

    python benchmarks/generator_bias.py --path exact --effect distortion=1e-3 --range-um 170
"""

from __future__ import annotations

import argparse

import _study

_study.one_thread()

import numpy as np  # noqa: E402

from rasnik import analyse, load_system, simulate  # noqa: E402
from rasnik.imaging.paper import paper_image  # noqa: E402

START_UM = (40000.0, 30000.0)


def errors_nm(
    path: str,
    theta_rad: float,
    steps: int,
    points: int,
    settings: list[str],
    effects: list[str],
    range_um: float | None,
) -> np.ndarray:
    """Error of x and y at each step, shape (steps, 2)."""
    system = load_system("solidras", settings)
    length_um = range_um or system.pitch_um / system.optics.scale
    moved = length_um * np.arange(steps) / steps
    poses = [(START_UM[0] + step, START_UM[1], theta_rad, system.optics.scale, 4) for step in moved]
    simulation = simulate(system, poses, seed=1, noise=False, path=path, effects=effects)
    errors = []
    for k, pose in enumerate(poses):
        if path == "paper":
            chain = simulation.chain
            shown = chain.projection(simulation.truth[k].projection, k)
            image = paper_image(system, shown, points=points, deviations=chain.deviations)
            image = chain.respond(image)
        else:
            image = simulation.expected(k)
        found = analyse(image, system, model="similarity", orientation=4)
        errors.append([(found.x_um - pose[0]) * 1e3, (found.y_um - pose[1]) * 1e3])
    return np.array(errors)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=14, help="positions over one pixel")
    parser.add_argument("--points", type=int, nargs="+", default=[10], help="paper: per pixel side")
    parser.add_argument("--set", action="append", default=[], metavar="K=V", help="of the system")
    parser.add_argument("--effect", action="append", default=[], metavar="NAME=VALUE")
    parser.add_argument("--range-um", type=float, help="length of the motion; default one pixel")
    parser.add_argument("--path", choices=["exact", "paper"], help="default both")
    options = parser.parse_args()
    print(_study.environment())
    print(f"\nfitted - true, nm, moved along x in {options.steps} steps")
    header = f"{'path':>12} {'theta, mrad':>12} {'x mean':>9} {'x p-p':>9} {'x rms':>9}"
    print(f"{header} {'y mean':>9} {'y p-p':>9}")
    for path, points in [("exact", 0), *(("paper", n) for n in options.points)]:
        if options.path not in (None, path):
            continue
        for theta in (0.0, 0.002, 0.02):
            x, y = errors_nm(
                path, theta, options.steps, points, options.set, options.effect, options.range_um
            ).T
            name = f"{path} {points}" if points else path
            print(
                f"{name:>12} {theta * 1e3:>12.0f} {x.mean():>9.3f} {np.ptp(x):>9.3f} "
                f"{x.std():>9.3f} {y.mean():>9.3f} {np.ptp(y):>9.3f}",
                flush=True,
            )


if __name__ == "__main__":
    main()
