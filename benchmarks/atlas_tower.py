"""A tower of three chambers and twelve Rasniks: are injected motions found within their errors?

1. Chambers of both shipped towers are moved at random (1 mm, 1 mrad each), readings are computed
   with the exact geometry and noise of the stated size, and solved. For every degree of freedom
   that is measured, and for the sagittas: mean and rms of (found - true) / sigma, the 12 (or 6)
   together by the chi2 of their covariance, and whether probabilities of chi2 are even.
2. One value is made wrong by k times what the installation states as detectable: how often it is
   named, how often together with others that it cannot be told from, how often another one is
   named alone, and how often nothing is said at all.
3. Readings from images: every Rasnik is an atlas-ccd whose image is simulated (tilts and all) and
   analysed; the errors that come with the readings are all there are.

    python benchmarks/atlas_tower.py --trials 300 --epochs 12 --seed 1
"""

from __future__ import annotations

import argparse

import _study

_study.one_thread()

import numpy as np  # noqa: E402
from scipy import stats  # noqa: E402

from rasnik import analyse, load_system  # noqa: E402
from rasnik.geometry.adjustment import adjust, capability  # noqa: E402
from rasnik.geometry.installation import VALUES, Installation, load_installation  # noqa: E402
from rasnik.geometry.network import Network  # noqa: E402
from rasnik.geometry.observations import Readings, parse_readings  # noqa: E402
from rasnik.geometry.rigid import DOFS  # noqa: E402
from rasnik.geometry.solution import Adjustment  # noqa: E402

TOWERS = ("atlas-tower", "atlas-tower-linked")
SHIFT_UM, TURN_RAD = 1000.0, 1e-3
POINT_UM = 20_000.0  # of the mask, on the nominal lines: a mask of 20 mm x 40 mm has room around it


def random_motions(rng: np.random.Generator) -> np.ndarray:
    motions = np.zeros((3, 6))
    motions[1:, :3] = rng.normal(size=(2, 3)) * SHIFT_UM
    motions[1:, 3:] = rng.normal(size=(2, 3)) * TURN_RAD
    return motions


def sigmas_of(network: Network) -> np.ndarray:
    return np.array([network.installation.value_sigmas(r) for r in network.installation.rasniks])


def true_sagittas(network: Network, motions: np.ndarray) -> np.ndarray:
    """Along x and y of each sagitta, um: the towers stand along z, chambers at equal distances."""
    found = []
    for sagitta in network.installation.sagittas:
        moved = [
            network.place(motions, b, np.array(p)) - network.place(0 * motions, b, np.array(p))
            for b, p in enumerate(sagitta.points_mm)
        ]
        found.append(1e3 * (moved[1] - (moved[0] + moved[2]) / 2)[:2])
    return np.concatenate(found)


# ------------------------------------------------------------------------ motions


class Pulls:
    """Errors over standard deviations, of many trials."""

    def __init__(self) -> None:
        self.rows: list[np.ndarray] = []
        self.sigmas: list[np.ndarray] = []
        self.squares: list[float] = []
        self.probabilities: list[float] = []
        self.alarms = 0
        self.names: list[str] = []

    def add(self, network: Network, found: Adjustment, motions: np.ndarray) -> None:
        known = found.measured.ravel()
        errors = (found.motions - motions).ravel()[known]
        covariance = found.covariance[np.ix_(known, known)]
        self.squares.append(
            stats.chi2.sf(errors @ np.linalg.solve(covariance, errors), known.sum())
        )
        sagittas = np.concatenate([one.value_um for one in found.sagittas])
        sigma = np.concatenate(
            [np.sqrt(np.diag(covariance)), *(one.sigma_um for one in found.sagittas)]
        )
        self.rows.append(np.append(errors, sagittas - true_sagittas(network, motions)) / sigma)
        self.sigmas.append(sigma)
        self.probabilities.append(found.probability)
        self.alarms += bool(found.outliers)
        labels = [f"{b} {dof}" for b in network.bodies for dof in DOFS]
        self.names = [label for label, is_known in zip(labels, known, strict=True) if is_known]
        self.names += [f"sagitta {o.name} {a}_um" for o in found.sagittas for a in o.axes]

    def report(self) -> bool:
        """Print the table; whether all of it is as it should be."""
        pulls, n = np.array(self.rows), len(self.rows)
        mean, rms = pulls.mean(axis=0), np.sqrt((pulls**2).mean(axis=0))
        mean_error, rms_error = 1 / np.sqrt(n), 1 / np.sqrt(2 * n)
        print(f"{'':>22} {'sigma':>10} {'pull mean':>10} {'pull rms':>9}")
        typical = np.median(self.sigmas, axis=0)
        for name, sigma, one, other in zip(self.names, typical, mean, rms, strict=True):
            print(f"{name:>22} {sigma:>10.3g} {one:>10.3f} {other:>9.3f}")
        print(
            f"{'expected':>22} {'':>10} {f'0 ± {mean_error:.3f}':>10} {f'1 ± {rms_error:.3f}':>9}"
        )
        together = stats.kstest(self.squares, "uniform").pvalue
        even = stats.kstest(self.probabilities, "uniform").pvalue
        print(f"all motions with their covariance: evenness {together:.3f} (Kolmogorov-Smirnov)")
        print(f"probabilities of chi2: evenness {even:.3f}")
        print(f"a reading named although all are right: {self.alarms} of {n} (stated: at most 1 %)")
        limit = stats.norm.isf(1e-3 / (2 * len(mean)))  # one in a thousand over the whole table
        worst = max(np.abs(mean).max() / mean_error, np.abs(rms - 1).max() / rms_error)
        print(f"largest deviation {worst:.1f} standard deviations, allowed {limit:.1f}\n")
        return worst < limit and together > 1e-3 and even > 1e-3


def tower(name: str) -> Network:
    """A shipped tower in which bodies are believed to move as far as they do here."""
    believed = {"range_mm": SHIFT_UM / 1e3, "range_rad": TURN_RAD}
    return Network(load_installation(name).model_copy(update=believed))


def motions_study(name: str, trials: int, seed: int) -> bool:
    network = tower(name)
    sigmas, pulls = sigmas_of(network), Pulls()
    found = capability(network)
    print(f"== {name}: {trials} trials, motions of 1 mm and 1 mrad")
    for one in found.unmeasured:
        print(f"unmeasured: {one.words}")
    for k in range(trials):
        rng = np.random.default_rng([seed, 1, k])
        motions = random_motions(rng)
        values = network.values(motions) + sigmas * rng.normal(size=sigmas.shape)
        pulls.add(network, adjust(network, Readings(values, 0 * values + np.nan)), motions)
    return pulls.report()


# ------------------------------------------------------------------ wrong readings


def wrong_study(name: str, sizes: list[float], trials: int, seed: int) -> bool:
    network = tower(name)
    sigmas, design = sigmas_of(network), capability(network).checks
    print(f"== {name}: one wrong value, {trials} trials each")
    heads = ("named", "one of several", "another alone", "only chi2", "silent")
    print(f"{'error / detectable':>20}" + "".join(f"{head:>16}" for head in heads))
    silent = 0
    for size in sizes:
        counts = dict.fromkeys(heads, 0)
        for k in range(trials):
            rng = np.random.default_rng([seed, 2, k])
            motions = random_motions(rng)
            values = network.values(motions) + sigmas * rng.normal(size=sigmas.shape)
            check = design[rng.integers(len(design))]
            place = network.rasniks.index(check.rasnik), VALUES.index(check.value)
            values[place] += rng.choice([-1, 1]) * size * check.detectable
            found = adjust(network, Readings(values, 0 * values + np.nan))
            counts[_verdict(found, check.label)] += 1
        shares = "".join(f"{100 * counts[head] / trials:>14.1f} %" for head in heads)
        print(f"{size:>20g}{shares}", flush=True)
        silent += counts["silent"] if size >= 3 else 0
    print(f"silent from 3 times the detectable error on: {silent}\n")
    return silent == 0


def _verdict(found: Adjustment, label: str) -> str:
    for one in found.outliers:
        if f"{one.value} of {one.rasnik}" == label:
            return "one of several" if one.alternatives else "named"
        if label in one.alternatives:
            return "one of several"
    if found.outliers:
        return "another alone"
    return "silent" if found.consistent else "only chi2"


# ------------------------------------------------------------------------- images


def image_study(epochs: int, seed: int) -> bool:
    """The tower with readings from simulated images."""
    text = tower("atlas-tower").installation.model_dump(exclude_none=True)
    text["defaults"] = {"system": "atlas-ccd"}
    for rasnik in text["rasniks"]:
        rasnik["mask"]["point_um"] = [POINT_UM, POINT_UM]
    network = Network(Installation.model_validate(text))
    system, pulls = load_system("atlas-ccd"), Pulls()
    flags: dict[str, int] = {}
    print(f"== atlas-tower from images: {epochs} epochs of 12 images")
    for epoch in range(epochs):
        rng = np.random.default_rng([seed, 3, epoch])
        motions = random_motions(rng)
        maps = [network.projection(motions, k) for k in range(len(network.rasniks))]
        rows = []
        for k, image in enumerate(_study.frame_pool(system, maps, seed=seed * 1000 + epoch)):
            pose = analyse(image, system)
            for flag in pose.flags.names:
                flags[flag] = flags.get(flag, 0) + 1
            names = ("x_um", "y_um", "scale", "theta_rad")
            row = {name: getattr(pose, name) for name in names}
            row |= {f"sigma_{name}": getattr(pose, f"sigma_{name}") for name in names}
            rows.append(row | {"name": network.rasniks[k], "ok": pose.ok} | {
                "orientation": pose.orientation, "flags": pose.flags.names
            })  # fmt: skip
        found = adjust(network, parse_readings(network, rows))
        for problem in found.problems:
            print(f"epoch {epoch}: {problem}")
        for one in found.outliers:
            print(f"epoch {epoch}: {one}")
        pulls.add(network, found, motions)
    told = ", ".join(f"{count} {name}" for name, count in sorted(flags.items()))
    print(f"flags of {12 * epochs} images: {told or 'none'}")
    return pulls.report()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--trials", type=int, default=300)
    parser.add_argument("--epochs", type=int, default=12, help="of twelve images; 0 for none")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", choices=["motions", "wrong", "images"])
    parser.add_argument(
        "--sizes", type=float, nargs="+", default=[1.0, 1.5, 3.0, 10.0],
        help="errors of wrong values, in detectable ones",
    )  # fmt: skip
    parser.add_argument("--tower", choices=TOWERS, help="default both")
    options = parser.parse_args()
    towers = [options.tower] if options.tower else TOWERS
    print(_study.environment(), f"seed {options.seed}\n", sep="\n")
    good = {}
    if options.only in (None, "motions"):
        for name in towers:
            good[f"{name}: motions"] = motions_study(name, options.trials, options.seed)
    if options.only in (None, "wrong"):
        for name in towers:
            good[f"{name}: wrong values"] = wrong_study(
                name, options.sizes, options.trials, options.seed
            )
    if options.only in (None, "images") and options.epochs:
        good["atlas-tower: images"] = image_study(options.epochs, options.seed)
    for name, is_good in good.items():
        print(f"{name:>32}: {'holds' if is_good else 'DOES NOT HOLD'}")


if __name__ == "__main__":
    main()
