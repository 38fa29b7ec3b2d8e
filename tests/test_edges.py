"""Edge profiles, blur, transfer and focus against what the images were made with."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scipy.stats
from PIL import Image
from typer.testing import CliRunner

from rasnik import Pose, Track, analyse, load_system, simulate
from rasnik.characterisation.edge_contours import KINDS, ModelEdge, edge_pixels
from rasnik.characterisation.edge_fit import fit_curves, fit_shapes, make_equations
from rasnik.characterisation.edge_mean import mean_edges
from rasnik.characterisation.edges import Edges, edges
from rasnik.characterisation.focus import focus, focus_of_track
from rasnik.cli import app
from rasnik.imaging.appearance import Appearance, Camera
from rasnik.imaging.deviations import Deviations
from rasnik.imaging.effects.optics import image_aperture
from rasnik.imaging.model import expected_image
from rasnik.imaging.montecarlo import exact_image
from rasnik.imaging.noise import ReadOut
from rasnik.imaging.projection import Projection, sensor_grid_um
from rasnik.imaging.transfer import AiryTransfer
from rasnik.instrument import System
from real_edges import analysed

SIZE = {"sensor.width_px": 256, "sensor.height_px": 192}
SYSTEM = load_system("solidras", SIZE)
SETTINGS = [a for key, value in SIZE.items() for a in ("--set", f"{key}={value}")]
PROJECTION = Projection.from_pose(4012.3, 5034.5, 1.0, 0.011, 4)
BLUR_UM, PIXEL_UM = SYSTEM.optics.blur_um, SYSTEM.pitch_um


def measured(image: np.ndarray, system: System = SYSTEM) -> Edges:
    pose = analyse(image, system)
    assert pose.ok, pose.error
    return edges(image, pose, system)


def noisy(expected: np.ndarray, rng: np.random.Generator, system: System = SYSTEM) -> np.ndarray:
    return ReadOut(expected.astype(float), system).frame(rng)


@pytest.fixture(scope="module")
def gaussian() -> Edges:
    """Edges of the exact image, without noise."""
    return measured(exact_image(SYSTEM, PROJECTION))


# ------------------------------------------------------------------------ what went in comes out


def test_gaussian_blur_and_its_transfer_come_out(gaussian: Edges) -> None:
    # the image model is good to 1e-4 of the step, which is 1e-4 of the blur
    assert gaussian.blur_um.value == pytest.approx(BLUR_UM, rel=3e-4)
    assert abs(gaussian.kurtosis.value) < 2e-3
    assert abs(gaussian.edge_shift_um.value) < 1e-3
    for one in gaussian.transfer:
        f = one.frequency_per_um
        theta = 0.011
        pixel = np.sinc(f * PIXEL_UM * np.cos(theta)) * np.sinc(f * PIXEL_UM * np.sin(theta))
        optics = np.exp(-2 * (np.pi * BLUR_UM * f) ** 2)
        np.testing.assert_allclose(one.pixel, pixel, atol=1e-9)  # the angle is fitted
        strong = optics * pixel > 0.05
        assert f[strong].max() * PIXEL_UM > 0.5  # beyond Nyquist
        np.testing.assert_allclose(one.total[strong], (optics * pixel)[strong], rtol=0.01)
        np.testing.assert_allclose(one.optical[strong], optics[strong], rtol=0.01)
    assert gaussian.levelled == pytest.approx(1, abs=1e-3)


def test_profile_is_the_folded_gaussian_at_every_distance(gaussian: Edges) -> None:
    true = ModelEdge(BLUR_UM, 0.0, 0.0, (PIXEL_UM * np.cos(0.011), PIXEL_UM * np.sin(0.011)), 85.0)
    for one in gaussian.profiles:
        np.testing.assert_allclose(one.value, true(one.distance_um), atol=3e-4)
        seen = np.isfinite(one.binned)
        assert seen.all()
        np.testing.assert_allclose(one.binned, true(one.distance_um), atol=5e-4)
        # the line spread of a Gaussian folded with the pixel, which hardly turned is one box
        low, high = (one.distance_um + d * PIXEL_UM / 2 for d in (-1, 1))
        step = scipy.stats.norm.cdf(high / BLUR_UM) - scipy.stats.norm.cdf(low / BLUR_UM)
        np.testing.assert_allclose(one.line, step / PIXEL_UM, atol=2e-3 / PIXEL_UM)
        assert (one.line_sigma > 0).any()


@pytest.mark.parametrize("noise_known", [True, False], ids=["noise known", "noise measured"])
def test_stated_errors_are_the_scatter(noise_known: bool, rng: np.random.Generator) -> None:
    trials = 16
    # at 252 of 255 the noise of white would be cut off, which moves edges by a part of their error
    darker = load_system(SYSTEM, {"sensor.light_level": 220.0})
    system = darker
    if not noise_known:
        system = load_system(darker, {"sensor.noise_a": None, "sensor.noise_b": None})
    pulls, curve_pulls = [], []
    for _ in range(trials):
        x, y = rng.uniform(0, 85, 2)
        theta = rng.uniform(-0.02, 0.02)
        projection = Projection.from_pose(4000 + x, 5000 + y, 1.0, theta, 4)
        image = noisy(exact_image(darker, projection), rng, darker)
        pose = analyse(image, system)
        equations = make_equations(edge_pixels(image, pose, system))
        shapes, curves = fit_shapes(equations), fit_curves(equations)
        sigma = np.sqrt(np.diag(shapes.covariance)).reshape(4, 3)
        # the means of all kinds, of which the fitted position is independent
        weights = np.zeros((3, 12))
        for k in range(3):
            weights[k, k::3] = 0.25
        error = weights @ (shapes.parameters - [0.0, BLUR_UM, 0.0]).ravel()
        pulls.append(error / np.sqrt(np.diag(weights @ shapes.covariance @ weights.T)))
        assert (sigma > 0).all()
        widths = (PIXEL_UM * np.cos(theta), PIXEL_UM * abs(np.sin(theta)))
        true = ModelEdge(BLUR_UM, 0.0, 0.0, widths, 85.0)
        distance = np.linspace(-2, 2, 5) * PIXEL_UM
        for kind in range(4):
            basis, part = equations.basis(kind, distance), equations.part(kind)
            value = equations.pixels.edges[kind // 2](distance) + basis @ curves.coefficients[part]
            variance = np.diag(basis @ curves.covariance[part, part] @ basis.T)
            curve_pulls.append((value - true(distance)) / np.sqrt(variance))
    # the scatter of the scatter is 1 / sqrt(2 * 16) = 0.18, that of the mean 0.25
    rms = np.sqrt(np.mean(np.square(pulls), axis=0))
    assert (rms > 0.55).all(), rms
    assert (rms < 1.5).all(), rms
    assert (np.abs(np.mean(pulls, axis=0)) < 0.75).all()
    # 320 values, of which those of an image hang together
    assert 0.8 < np.sqrt(np.mean(np.square(curve_pulls))) < 1.2


@pytest.mark.parametrize(
    ("changes", "name", "value", "tolerance"),
    [
        ({"edge_shift_um": 0.3}, "edge_shift_um", 0.3, 0.003),
        ({"kurtosis": 0.8}, "kurtosis", 0.8, 0.02),
        ({"kurtosis": -0.5}, "kurtosis", -0.5, 0.02),
        ({"blur_um": 9.0}, "blur_um", 9.0, 0.005),
    ],
)
def test_each_number_is_recovered(
    changes: dict[str, float], name: str, value: float, tolerance: float
) -> None:
    look = Appearance.uniform(25.0, 252.0, 5.0).with_(**changes)
    image = expected_image(SYSTEM.mask, PROJECTION, look, Camera(SYSTEM.shape, PIXEL_UM))
    found = measured(image)
    assert found.numbers[name].value == pytest.approx(value, abs=tolerance)
    for one in (found.lateral_x_um, found.lateral_y_um):
        assert abs(one.value) < 2e-3


def test_black_and_white_are_told_apart_in_both_directions() -> None:
    """A contour set too early by the position moves the two steps of contrast oppositely."""
    image = exact_image(SYSTEM, PROJECTION)
    pose = analyse(image, SYSTEM)
    assert pose.projection is not None
    matrix = pose.projection.matrix.copy()
    matrix[0, 2] -= 0.2  # the contours, seen from there, lie 0.2 um towards +x
    found = edges(image, replace(pose, projection=Projection(matrix)), SYSTEM)
    assert found.lateral_x_um.value == pytest.approx(-0.2, abs=0.01)
    assert abs(found.lateral_y_um.value) < 0.01
    assert abs(found.edge_shift_um.value) < 0.01


def test_astigmatism_shows_as_two_blurs() -> None:
    """A mask that moves along x during the exposure: the blur across x alone grows."""
    moved = [
        exact_image(SYSTEM, Projection.from_pose(4012.3 + d, 5034.5, 1.0, 0.0, 4))
        for d in np.linspace(-4, 4, 9)
    ]
    found = measured(np.mean(moved, axis=0))
    spread = np.var(np.linspace(-4, 4, 9))
    assert found.blur_x_um.value == pytest.approx(np.hypot(BLUR_UM, np.sqrt(spread)), rel=0.005)
    assert found.blur_y_um.value == pytest.approx(BLUR_UM, rel=0.005)


def test_diffraction_limited_profile() -> None:
    """The profile of an ideal lens, which no Gaussian describes, against its integral."""
    system = load_system(SYSTEM, {"mask.field_um": 400.0, "mask.code_bits": 2})
    ideal = AiryTransfer(0.448, image_aperture(system))
    projection = Projection.from_pose(3000.0, 3000.0, 1.0, 0.013, 4)
    image = exact_image(system, projection, transfer=ideal)
    look = Appearance.uniform(25.0, 252.0, BLUR_UM)
    pose = Pose(ok=True, projection=projection, appearance=look, scale=1.0, polarity="positive")
    found = edges(image, pose, system)
    frequency = np.linspace(0, ideal.cutoff_per_um, 4001)[1:]
    response = ideal(frequency, np.zeros_like(frequency))
    response = response * np.sinc(frequency * PIXEL_UM * np.cos(0.013)) / frequency
    for one in found.profiles:
        waves = np.sin(2 * np.pi * np.outer(one.distance_um, frequency))
        true = 0.5 + waves @ response * (frequency[1] - frequency[0]) / np.pi
        # the levels are those at the ends, where the wings still hold some light
        inner = slice(len(true) // 10, -(len(true) // 10))
        basis = np.stack([np.ones_like(true), true], axis=1)[inner]
        fit = np.linalg.lstsq(basis, one.value[inner], rcond=None)[0]
        assert fit[1] == pytest.approx(1.0, abs=0.06)
        np.testing.assert_allclose(one.value[inner], basis @ fit, atol=4e-3)
        assert np.abs(one.model - true).max() > 0.02
    assert found.transfer[0].diffraction is not None


# ------------------------------------------------------------------------ focus


def test_defocus_is_found_from_the_blur(rng: np.random.Generator) -> None:
    image = simulate(SYSTEM, PROJECTION, seed=2, effects={"defocus": 150.0}).frames[0]
    found = focus(*measured(image).blur_um, SYSTEM)
    assert found.defocus_um == pytest.approx(150.0, abs=4 * found.sigma_um)
    assert found.sigma_um < 2.0
    assert found.defocus_um < found.within_um
    assert found.aperture == image_aperture(SYSTEM)
    assert found.depth_um == pytest.approx(0.448 / found.aperture**2)


def test_in_focus_a_limit_is_stated(rng: np.random.Generator) -> None:
    sigma = 0.01
    blurs = rng.normal(BLUR_UM, sigma, 400)
    limits = [focus(blur, sigma, SYSTEM) for blur in blurs]
    assert all(one.within_um > 0 for one in limits)
    # further off than the limit by one in twenty of images that are that far out of focus
    aperture = image_aperture(SYSTEM)
    far = np.hypot(BLUR_UM, 60.0 * aperture / 2)
    missed = [focus(b, sigma, SYSTEM).within_um < 60.0 for b in rng.normal(far, sigma, 4000)]
    assert np.mean(missed) == pytest.approx(0.05, abs=0.015)


def test_tilt_of_the_focus_is_found() -> None:
    system = load_system("solidras", {"sensor.width_px": 480, "sensor.height_px": 360})
    u, v = sensor_grid_um(system.shape, PIXEL_UM)
    defocus = 60.0 + 0.05 * u - 0.03 * v[:, None]
    blur = np.hypot(BLUR_UM, defocus * image_aperture(system) / 2)
    image = exact_image(system, PROJECTION, deviations=Deviations(blur_ratio=blur / BLUR_UM))
    found = measured(image, system)
    assert found.blur_map.chi2_even > 3 * found.blur_map.chi2_ndf
    middle = np.nanmean(found.blur_map.blur_um[:, :1]) - np.nanmean(found.blur_map.blur_um[:, -1:])
    assert middle < 0
    plane, sigma = found.blur_map.tilt(system)
    np.testing.assert_allclose(plane, [60.0, 0.05, -0.03], rtol=0.1)
    assert (sigma > 0).all()


def test_focus_needs_an_aperture() -> None:
    blind = load_system(SYSTEM, {"optics.diaphragm_mm": None})
    with pytest.raises(ValueError, match="aperture"):
        focus(5.0, 0.1, blind)
    with pytest.raises(ValueError, match="aperture"):
        focus_of_track(Track.from_poses([Pose()]), blind)


def test_focus_of_a_track() -> None:
    aperture = image_aperture(SYSTEM)
    z = np.array([0.0, 50.0, 100.0])
    poses = [Pose(ok=True, x_um=0.0, blur_um=float(np.hypot(BLUR_UM, d * aperture / 2))) for d in z]
    size, per_blur = focus_of_track(Track.from_poses([*poses, Pose()]), SYSTEM)
    np.testing.assert_allclose(size[:3], z, atol=1e-5)
    assert np.isnan(size[3])
    step = 1e-6
    moved = 2 / aperture * np.sqrt((poses[2].blur_um + step) ** 2 - BLUR_UM**2)
    assert per_blur[2] == pytest.approx((moved - 100.0) / step, rel=1e-3)


# ------------------------------------------------------------------------ what remains


def _share(found: Edges, name: str) -> float:
    """By how much a cause lowers chi-square per degree of freedom."""
    values = [one.chi2_ndf for one in found.causes]
    position = [one.name for one in found.causes].index(name)
    return values[position - 1] - values[position]


CAUSES = ("free edge profiles", "light in patches", "displaced contours", "unequal fields", "rows")


@pytest.mark.parametrize("cause", [None, *CAUSES])
def test_the_cause_of_a_misfit_is_named(cause: str | None, rng: np.random.Generator) -> None:
    look = Appearance.uniform(25.0, 252.0, 5.0)
    if cause == "displaced contours":
        from rasnik.imaging.deviations import EdgeErrors

        image = exact_image(SYSTEM, PROJECTION, deviations=Deviations(edges=EdgeErrors(0.15, 3)))
    else:
        image = expected_image(SYSTEM.mask, PROJECTION, look, Camera(SYSTEM.shape, PIXEL_UM))
    image = image.astype(float)
    row, column = np.indices(image.shape)
    if cause == "free edge profiles":
        wide = look.with_(blur_um=15.0)
        other = expected_image(SYSTEM.mask, PROJECTION, wide, Camera(SYSTEM.shape, PIXEL_UM))
        image = 0.9 * image + 0.1 * other
    elif cause == "light in patches":
        image *= 1 + 0.02 * np.sin(row / 12) * np.cos(column / 14)
    elif cause == "unequal fields":
        u, v = sensor_grid_um(image.shape, PIXEL_UM)
        x, y = PROJECTION.to_mask(u[None, :], v[:, None])
        i, j = (np.floor(a / 85).astype(int) for a in (x, y))
        image += 1.5 * np.sin(12.9898 * i + 78.233 * j * (1 + 0.31 * i))
    elif cause == "rows":
        image[::2] += 1.5
    found = measured(noisy(image, rng))
    shares = {name: _share(found, name) for name in CAUSES}
    if cause is None:
        # 14000 pixels or so: chi-square is known to 0.012
        assert found.causes[0].chi2_ndf == pytest.approx(1, abs=0.05)
        assert max(map(abs, shares.values())) < 0.05
    else:
        assert shares[cause] > 0.15
        assert max(shares, key=lambda name: shares[name]) == cause, shares


# ------------------------------------------------------------------------ several images


def test_mean_of_images(rng: np.random.Generator) -> None:
    expected = exact_image(SYSTEM, PROJECTION)
    several = [measured(noisy(expected, rng)) for _ in range(4)]
    mean = mean_edges(several)
    assert mean.images == 4
    assert mean.blur_um.value == pytest.approx(np.mean([one.blur_um.value for one in several]))
    assert mean.blur_um.sigma == pytest.approx(several[0].blur_um.sigma / 2, rel=0.05)
    assert mean.blur_um.value == pytest.approx(BLUR_UM, abs=4 * mean.blur_um.sigma)
    assert [one.name for one in mean.profiles] == list(KINDS)
    middle = len(mean.profiles[0].distance_um) // 2
    assert mean.profiles[0].distance_um[middle] == 0
    assert mean.profiles[0].sigma[middle] < 0.7 * several[0].profiles[0].sigma[middle]
    assert mean_edges(several[:1]) is several[0]
    with pytest.raises(ValueError, match="no images"):
        mean_edges([])
    with pytest.raises(ValueError, match="different pixels"):
        mean_edges([several[0], replace(several[1], pixel_um=5.0)])


def test_faults_are_named() -> None:
    with pytest.raises(ValueError, match="fitted image"):
        edges(np.zeros(SYSTEM.shape, np.uint8), Pose(), SYSTEM)


# ------------------------------------------------------------------------ real images


def _real(shared, name: str) -> tuple[np.ndarray, Pose, System, tuple[int, int, int, int]]:  # type: ignore[no-untyped-def]
    reference = json.loads(shared("real/reference.json").read_text())
    row = next(entry for entry in reference if entry["file"] == name)
    return analysed(shared("real"), row)


@pytest.mark.parametrize(
    ("name", "least_gain"),
    [
        ("benchmark.gif", 0.01),
        ("rotated.gif", 0.05),
        ("slanted.png", 0.3),
        ("contact.gif", 4.0),
    ],
)
def test_real_images(name: str, least_gain: float, shared) -> None:  # type: ignore[no-untyped-def]
    image, pose, system, bounds = _real(shared, f"Rasnik_{name}")
    found = edges(image, pose, system, bounds)
    assert not found.noise_known
    chi2 = [one.chi2_ndf for one in found.causes]
    assert chi2[0] - chi2[1] > least_gain
    assert chi2[-1] < 1.0
    for one in found.profiles:
        middle = np.abs(one.distance_um) < 0.25 * PIXEL_UM
        assert 0.2 < one.value[middle].mean() < 0.8
        # but at their ends, where the curves are held by the model
        inner = slice(len(one.value) // 10, -(len(one.value) // 10))
        pull = (one.value - one.binned) / np.hypot(one.sigma, one.binned_sigma)
        assert (np.abs(pull[inner]) < 6).all()
    if name == "contact.gif":  # the fringes of a contact print beside its contours
        assert max(one.value.max() for one in found.profiles) > 1.1
        assert found.edge_shift_um.value > 4.0


# ------------------------------------------------------------------------ the command


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("edges")
    for k, frame in enumerate(simulate(SYSTEM, PROJECTION, n=2, seed=4).frames):
        Image.fromarray(frame).save(path / f"frame{k}.png")
    return path


def test_command_prints_and_writes(folder: Path, tmp_path: Path) -> None:
    plot, figures = tmp_path / "edges.png", tmp_path / "edges.json"
    arguments = ["edges", str(folder), "--system", "solidras", *SETTINGS]
    result = CliRunner().invoke(app, [*arguments, "-o", str(plot), "-o", str(figures)])
    assert result.exit_code == 0, result.stderr
    assert "2 images, 2 used" in result.stdout
    assert "distance from focus" in result.stdout
    assert plot.stat().st_size > 10_000
    document = json.loads(figures.read_text())
    assert document["blur_um"] == pytest.approx(BLUR_UM, abs=5 * document["sigma_blur_um"])
    assert document["focus"]["within_um"] > 0
    assert [one["name"] for one in document["profiles"]] == list(KINDS)
    assert document["transfer"]["x"]["diffraction"][0] == pytest.approx(1.0)


def test_command_without_a_system(folder: Path) -> None:
    sizes = ["--field-um", "85", "--pixel-um", "6.9", "--json"]
    result = CliRunner().invoke(app, ["edges", str(folder / "frame0.png"), *sizes])
    assert result.exit_code == 0, result.stderr
    document = json.loads(result.stdout)
    assert document["focus"] is None
    assert not document["noise_known"]
    assert document["blur_um"] == pytest.approx(BLUR_UM, abs=5 * document["sigma_blur_um"])


def test_command_on_a_track(tmp_path: Path) -> None:
    from rasnik.io import write_track

    blur = np.linspace(4.6, 5.4, 50)
    poses = [
        Pose(ok=True, x_um=1.0, y_um=2.0, scale=1.0, theta_rad=0.0, blur_um=float(b)) for b in blur
    ]
    track = Track.from_poses(poses, time_s=np.arange(50) / 10)
    path, plot = tmp_path / "track.h5", tmp_path / "blur.svg"
    write_track(track, path)
    arguments = ["edges", str(path), "--system", "solidras", "-o", str(plot), "--json"]
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 0, result.stderr
    document = json.loads(result.stdout)
    assert document["blur_um"] == pytest.approx(5.0)
    assert document["defocus_um"] > 0
    assert plot.exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["none.png", "--system", "solidras"], "no such file"),
        (["none.png"], "give --system, or --field-um and --pixel-um"),
        (["none.png", "--system", "solidras", "-o", "edges.txt"], "must end in"),
    ],
)
def test_command_refuses(arguments: list[str], message: str) -> None:
    result = CliRunner().invoke(app, ["edges", *arguments])
    assert result.exit_code == 2
    assert message in result.stderr
