"""Finding the mask from nothing: how often, how often wrongly, and where the limits lie.

Random SolidRas-like images: rotation over the full circle, four orientations, both
polarities, scale 0.5..2, blur to a third of a field, contrast down to 20 grey levels, light
varying by a factor of 2, dust over 5 % of the area. A position counts as wrong if it is off by
more than 10 sigma and by more than 1 % of a field.

    python benchmarks/cold_start.py -n 2000 -o cold-start.png
    python benchmarks/cold_start.py -n 1000 --beyond -o beyond.png
"""

from __future__ import annotations

import argparse

import _study

_study.one_thread()

import numpy as np  # noqa: E402
from matplotlib.figure import Figure  # noqa: E402

from rasnik import analyse, load_system  # noqa: E402
from rasnik.imaging.levels import LevelMap  # noqa: E402
from rasnik.imaging.montecarlo import exact_image  # noqa: E402
from rasnik.imaging.noise import add_noise  # noqa: E402
from rasnik.imaging.projection import Projection  # noqa: E402

SOLIDRAS = load_system("solidras")


def trial(job: tuple[int, bool]) -> dict[str, float | str]:
    """One random image: its conditions, and what became of it."""
    seed, beyond = job
    rng = np.random.default_rng(seed)
    scale = float(
        np.exp(rng.uniform(np.log(0.2), np.log(8)) if beyond else rng.uniform(-0.69, 0.69))
    )
    pixels_per_field = scale * 85 / 6.9
    blur_fields = rng.uniform(0.02, 0.6 if beyond else 1 / 3)
    # the pixel itself allows no less than 0.3 pixel
    blur_um = max(blur_fields * 85 * scale, 0.3 * 6.9)
    contrast = float(np.exp(rng.uniform(np.log(5 if beyond else 20), np.log(220))))
    dark = rng.uniform(5, 245 - contrast)
    polarity = str(rng.choice(["positive", "negative"]))
    system = load_system(
        SOLIDRAS,
        {
            "optics.scale": scale,
            "optics.blur_um": blur_um,
            "sensor.dark_level": dark,
            "sensor.light_level": dark + contrast,
            "mask.polarity": polarity,
        },
    )
    x, y = rng.uniform(3e4, 1.6e5, 2)
    theta, orientation = rng.uniform(-np.pi, np.pi), int(rng.integers(1, 5))
    truth = Projection.from_pose(x, y, scale, theta, orientation)
    light, dark_map = _light(rng, dark, contrast)
    image = exact_image(system, truth, light_map=light, dark_map=dark_map)
    _add_dust(image, rng, 0.05)
    frame = add_noise(image, system, rng)
    fixed = bool(rng.random() < 0.5)
    pose = analyse(frame, SOLIDRAS, orientation=orientation if fixed else None)
    wrong = False
    error = np.nan
    if pose.ok and pose.projection is not None:
        # without a fixed orientation a quarter turn may exchange x and y
        exchanged = pose.projection.mirrored != truth.mirrored
        expected = (y, x) if exchanged else (x, y)
        error = float(np.hypot(pose.x_um - expected[0], pose.y_um - expected[1]))
        sigma = float(np.hypot(pose.sigma_x_um, pose.sigma_y_um))
        wrong = error > max(10 * sigma, 0.85) or (fixed and exchanged)
    outcome = (
        "wrong" if wrong else "ok" if pose.ok else "ambiguous" if pose.candidates else "failed"
    )
    return {
        "seed": seed,
        "outcome": outcome,
        "flags": ",".join(pose.flags.names),
        "pixels_per_field": pixels_per_field,
        "blur_fields": blur_um / (85 * scale),
        "contrast": contrast,
        "error_um": error,
        "pull": error / float(np.hypot(pose.sigma_x_um, pose.sigma_y_um)),
        "lines": pose.code_lines_in_view,
    }


def _light(rng: np.random.Generator, dark: float, contrast: float) -> tuple[LevelMap, LevelMap]:
    """Light that falls to half across the image, in a random direction, with some curvature."""
    angle, bend = rng.uniform(0, 2 * np.pi), rng.uniform(-0.1, 0.1)

    def share(u: np.ndarray, v: np.ndarray) -> np.ndarray:
        along = (u * np.cos(angle) + v * np.sin(angle)) / 3000.0
        fall: np.ndarray = 0.75 + 0.25 * np.clip(along, -1, 1) + bend * (along**2 - 0.3)
        return np.clip(fall, 0.45, 1.0)

    return (lambda u, v: (dark + contrast) * share(u, v)), (lambda u, v: dark * share(u, v))


def _add_dust(image: np.ndarray, rng: np.random.Generator, area: float) -> None:
    """Round specks of 2..15 pixels radius that take 30..90 % of the light, soft at the edge."""
    height, width = image.shape
    covered, target = 0.0, area * image.size
    while covered < target:
        row, column = rng.uniform(0, height), rng.uniform(0, width)
        radius, depth = float(np.exp(rng.uniform(np.log(2), np.log(15)))), rng.uniform(0.3, 0.9)
        r0, r1 = int(max(row - radius - 4, 0)), int(min(row + radius + 5, height))
        c0, c1 = int(max(column - radius - 4, 0)), int(min(column + radius + 5, width))
        rows, columns = np.mgrid[r0:r1, c0:c1]
        distance = np.hypot(rows - row, columns - column)
        image[r0:r1, c0:c1] *= 1 - depth / (1 + np.exp((distance - radius) / 0.7))
        covered += np.pi * radius**2


def _report(results: list[dict[str, float | str]]) -> None:
    outcomes = np.array([r["outcome"] for r in results])
    for name in ("ok", "ambiguous", "failed", "wrong"):
        count = int((outcomes == name).sum())
        print(f"{name:>10}: {count:6d}  {100 * count / len(results):6.2f} %")
    pulls = np.array([r["pull"] for r in results if r["outcome"] == "ok"])
    print(
        f"error / sigma of the good ones: median {np.median(pulls):.2f}, "
        f"99 % {np.quantile(pulls, 0.99):.2f}, largest {pulls.max():.2f}"
    )
    for r in results:
        if r["outcome"] != "ok":
            print(
                f"  {r['outcome']:>9} seed {r['seed']}: {r['pixels_per_field']:.1f} px/field, "
                f"blur {r['blur_fields']:.2f} fields, contrast {r['contrast']:.0f}, "
                f"{r['lines']} code lines, {r['flags']}, error {r['error_um']:.3f} um"
            )


def _plot(results: list[dict[str, float | str]], path: str) -> None:
    figure = Figure(figsize=(11, 4.6), layout="constrained")
    axes = figure.subplots(1, 2)
    colours = {"ok": "#9bbfdd", "ambiguous": "#e0a030", "failed": "#c23b22", "wrong": "black"}
    for ax, key, label in (
        (axes[0], "pixels_per_field", "pixels per field"),
        (axes[1], "contrast", "contrast, grey levels"),
    ):
        for outcome, colour in colours.items():
            chosen = [r for r in results if r["outcome"] == outcome]
            ax.scatter(
                [r[key] for r in chosen],
                [r["blur_fields"] for r in chosen],
                s=6 if outcome == "ok" else 28,
                color=colour,
                label=f"{outcome} ({len(chosen)})",
                zorder=1 if outcome == "ok" else 2,
            )
        ax.set(xlabel=label, ylabel="blur sigma, fields", xscale="log")
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4)
    figure.suptitle("Finding the mask from nothing: outcome by blur, pixels per field and contrast")
    figure.savefig(path, dpi=110)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("-n", type=int, default=60)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--seed", type=int, default=0, help="first seed")
    parser.add_argument("--beyond", action="store_true", help="go beyond the usual conditions")
    parser.add_argument("-o", "--output", help="write a map of the outcomes (PNG)")
    options = parser.parse_args()
    print(_study.environment())
    jobs = [(options.seed + k, options.beyond) for k in range(options.n)]
    results = _study.trials(trial, jobs, options.jobs)
    _report(results)
    if options.output:
        _plot(results, options.output)


if __name__ == "__main__":
    main()
