"""All bodies from all readings: closed forms, exact inversion, errors, what is unmeasured, what is
wrong.
"""

from typing import Any

import numpy as np
import pytest
from scipy import stats

from rasnik.geometry.adjustment import adjust, capability
from rasnik.geometry.installation import Installation, load_installation
from rasnik.geometry.network import Network
from rasnik.geometry.observations import Readings, parse_readings
from rasnik.geometry.outliers import FALSE_ALARM, snoop
from rasnik.geometry.rigid import DOFS
from rasnik.geometry.solution import Adjustment
from test_geometry_installation import random_network

SIGMAS = {"sigma_x_um": 1.0, "sigma_y_um": 1.0, "sigma_scale": 1e-4, "sigma_theta_rad": 1e-4}


def network_of(*bodies: dict[str, Any], rasniks: list[dict[str, Any]], **more: Any) -> Network:
    text = {"name": "bench", "defaults": SIGMAS, "bodies": list(bodies), "rasniks": rasniks}
    return Network(Installation.model_validate(text | more))


def body(name: str, z: float, **more: Any) -> dict[str, Any]:
    return {"name": name, "position_mm": [0.0, 0.0, z]} | more


def rasnik(name: str, *bodies: str, x: float = 0.0, y: float = 0.0, **more: Any) -> dict[str, Any]:
    """Along z at (x, y): mask, lens and sensor in the origins of their bodies, shifted."""
    elements = zip(("mask", "lens", "sensor"), bodies, strict=True)
    return {"name": name} | {k: {"body": b, "position_mm": [x, y, 0]} for k, b in elements} | more


def readings(values: Any) -> Readings:
    return Readings(np.array(values), np.full(np.shape(values), np.nan))


def camera(**more: Any) -> Network:
    """A mask on a body, seen by a lens 400 mm away and a sensor 100 mm behind it."""
    line = [
        rasnik("cam", "mask", "lens", "sensor")
        | {"lens": {"body": "table", "position_mm": [0, 0, 400]}}
        | {"sensor": {"body": "table", "position_mm": [0, 0, 500]}}
    ]
    return network_of(body("mask", 0.0, **more), body("table", 0.0, fixed=True), rasniks=line)


def words(found: Adjustment) -> list[str]:
    return [one.words for one in found.unmeasured]


# -------------------------------------------------------------------- closed form


def test_camera_tells_where_its_mask_is() -> None:
    network = camera(held=["rx", "ry"])
    x, y, z, turn = 120.0, -50.0, 300.0, 2e-3
    scale = 100 / (400 - z / 1e3)
    c, s = np.cos(turn), np.sin(turn)  # the axis of the table, in the mask's own axes
    found = adjust(network, readings([[-c * x - s * y, s * x - c * y, scale, 0]]))
    turned = network.values(np.array([[x, y, z, 0, 0, turn], np.zeros(6)]))[0]
    np.testing.assert_allclose(turned[:3], [-c * x - s * y, s * x - c * y, scale], rtol=1e-9)
    found = adjust(network, readings([turned]))
    np.testing.assert_allclose(found.motions[0], [x, y, z, 0, 0, turn], rtol=1e-9)
    assert abs(turned[3]) == pytest.approx(turn)
    # x, y by one sigma; z by dS = S / 400 mm dz; the turn by theta
    sigma_z = 1e-4 / (0.25 / 400e3)
    np.testing.assert_allclose(
        capability(network).sigmas[0], [1, 1, sigma_z, 0, 0, 1e-4], rtol=1e-6
    )
    assert found.ndf == 0 and np.isnan(found.probability)
    assert all(one.redundancy == 0 and np.isinf(one.detectable) for one in found.checks)


def test_lens_between_mask_and_sensor() -> None:
    rows = [rasnik("line", "a", "b", "c", measures=["x", "y"])]
    held = ["z", "rx", "ry", "rz"]
    network = network_of(
        body("a", 0, fixed=True), body("b", 200, held=held), body("c", 1000, fixed=True),
        rasniks=rows,
    )  # fmt: skip
    found = adjust(network, readings([[30.0, -40.0, np.nan, np.nan]]))
    # S = 4: the mask point moves by 1 + 1/S of the lens
    np.testing.assert_allclose(found.motions[1, :2], [24, -32], rtol=1e-12)
    np.testing.assert_allclose(found.sigmas[1, :2], [0.8, 0.8], rtol=1e-12)
    assert found.complete and found.consistent


def test_two_rasniks_are_averaged_and_checked() -> None:
    held = ["y", "z", "rx", "ry", "rz"]
    rows = [
        rasnik("one", "a", "b", "c", measures=["x"], sigma_x_um=1.0),
        rasnik("two", "a", "b", "c", measures=["x"], sigma_x_um=2.0),
    ]
    network = network_of(
        body("a", 0, fixed=True), body("b", 500, held=held), body("c", 1000, fixed=True),
        rasniks=rows,
    )  # fmt: skip
    nothing = [np.nan] * 3
    found = adjust(network, readings([[10.0, *nothing], [14.0, *nothing]]))
    mean, weight = (10 + 14 / 4) / 1.25, 1.25
    assert found.motions[1, 0] == pytest.approx(mean / 2)
    assert found.sigmas[1, 0] == pytest.approx(np.sqrt(1 / weight) / 2)
    assert found.chi2 == pytest.approx(16 / 5) and found.ndf == 1
    assert found.probability == pytest.approx(stats.chi2.sf(3.2, 1))
    assert [one.redundancy for one in found.checks] == pytest.approx([0.2, 0.8])
    assert [one.w for one in found.checks] == pytest.approx([-np.sqrt(3.2), np.sqrt(3.2)])
    assert [one.residual for one in found.checks] == pytest.approx([10 - mean, 14 - mean])
    limit = stats.norm.isf(FALSE_ALARM / 4) + stats.norm.ppf(0.8)
    assert found.checks[1].detectable == pytest.approx(2 * limit / np.sqrt(0.8))


def test_prior_is_one_more_reading() -> None:
    network = camera(held=["rx", "ry"], prior={"x_um": 2.0, "z_um": 1e-3})
    found = adjust(network, readings([[-10.0, 0, 0.25, 0]]))
    assert found.motions[0, 0] == pytest.approx(10 * 4 / 5)
    assert found.sigmas[0, 0] == pytest.approx(np.sqrt(4 / 5))
    assert found.chi2 == pytest.approx(100 / 5) and found.ndf == 2
    assert found.state(0, 0) == "measured" and found.state(0, 2) == "prior"
    assert not found.consistent
    assert [one.label for one in found.checks][-2:] == [
        "x of the prior of mask", "z of the prior of mask",
    ]  # fmt: skip


def test_reference_makes_origins_of_masks_irrelevant() -> None:
    network = camera(held=["rx", "ry"])
    before = readings([[4000.0, 5000.0, 0.2503, 3.0]])
    after = readings([[3990.0, 5005.0, 0.2503, 3.0]])
    found = adjust(network, after, before)
    np.testing.assert_allclose(found.motions[0, :2], [10, -5], rtol=1e-9)
    np.testing.assert_allclose(found.sigmas[0, :2], np.sqrt(2), rtol=1e-3)


def test_a_reference_that_contradicts_the_description_is_named() -> None:
    network = camera(held=["rx", "ry"])  # S = 0.25, theta_z = 0
    turned = [0.0, 0.0, 0.25, 1.5]
    (problem,) = adjust(network, readings([[9.0, 0, 0.25, 1.5]]), readings([turned])).problems
    assert problem.startswith("reference: cam has theta_rad = 1.5, but as described it is 0; say")
    found = adjust(network, readings([[9.0, 0, 0.5, 0.05]]), readings([[0, 0, 0.5, 0.05]]))
    (problem,) = found.problems
    assert "reference: cam has scale = 0.5, but as described it is 0.25; check" in problem
    assert not found.complete
    # half a turn is the same image, small angles and a scale of the lens's middle are mounting
    fine = readings([[0, 0, 0.26, np.pi - 0.05]])
    assert not adjust(network, fine, fine).problems
    # without a reference the fit compares what is measured, and only that
    text = network.installation.model_dump(exclude_none=True)
    text["rasniks"][0]["measures"] = ["x", "y"]
    found = adjust(Network(Installation.model_validate(text)), readings([turned]))
    assert [one.split(";")[0] for one in found.problems] == [
        "cam has theta_rad = 1.5, but as described it is 0"
    ]


# ---------------------------------------------------------------------- inversion


def test_random_configurations_are_inverted(rng: np.random.Generator) -> None:
    for _ in range(5):
        free = random_network(rng, bodies=4, rasniks=9)
        text = free.installation.model_dump()
        text["bodies"][0]["fixed"] = True
        network = Network(Installation.model_validate(text))
        motions = np.hstack([rng.normal(size=(4, 3)) * 1000, rng.normal(size=(4, 3)) * 1e-3])
        motions[0] = 0
        found = adjust(network, readings(network.values(motions)))
        assert found.complete and found.converged
        np.testing.assert_allclose(found.motions[:, :3], motions[:, :3], atol=1e-9 * 1000)
        np.testing.assert_allclose(found.motions[:, 3:], motions[:, 3:], atol=1e-9 * 1e-3)
        assert found.chi2 < 1e-9


def test_large_turns_are_inverted(rng: np.random.Generator) -> None:
    network = camera(rotation_rad=[0.2, -0.1, 0.7])
    assert words(capability(network))  # one image: tilts are not told from shifts
    text = network.installation.model_dump()
    text["bodies"][0]["held"] = ["rx", "ry"]
    network = Network(Installation.model_validate(text))
    motions = np.zeros((2, 6))
    motions[0] = [3000, -2000, 5000, 0, 0, 0.4]
    found = adjust(network, readings(network.values(motions)))
    np.testing.assert_allclose(found.motions[0], motions[0], rtol=1e-9)


# ------------------------------------------------------------------------- errors


def test_errors_by_monte_carlo(rng: np.random.Generator) -> None:
    network = Network(load_installation("atlas-tower-linked"))
    sigmas = np.array([network.installation.value_sigmas(r) for r in network.installation.rasniks])
    motions = np.zeros((3, 6))
    motions[1:] = rng.normal(size=(2, 6)) * [1000, 1000, 1000, 1e-3, 1e-3, 1e-3]
    exact = network.values(motions)
    n = 40
    results = [
        adjust(network, readings(exact + sigmas * rng.normal(size=exact.shape))) for _ in range(n)
    ]
    errors = np.array([(one.motions - motions)[1:].ravel() for one in results])
    stated = results[0].covariance[6:, 6:]
    # e' C^-1 e of each trial has a chi2 distribution of 12
    squares = np.sum(errors @ np.linalg.inv(stated) * errors, axis=1)
    assert stats.kstest(squares, stats.chi2(12).cdf).pvalue > 1e-3
    pulls = errors / np.sqrt(np.diag(stated))
    assert np.abs(pulls.mean(axis=0)).max() < 4 / np.sqrt(n)
    assert np.abs(pulls.std(axis=0) - 1).max() < 4 / np.sqrt(2 * n)
    assert stats.kstest([one.probability for one in results], "uniform").pvalue > 1e-3
    sagitta = np.array([one.sagittas[1].value_um for one in results])
    still = np.zeros_like(motions)
    points = [np.array(p) for p in network.installation.sagittas[1].points_mm]
    moved = [
        network.place(motions, b, p) - network.place(still, b, p) for b, p in enumerate(points)
    ]
    truth = 1e3 * (moved[1] - (moved[0] + moved[2]) / 2)[:2]
    pulls = (sagitta - truth) / results[0].sagittas[1].sigma_um
    assert np.abs(pulls.mean(axis=0)).max() < 4 / np.sqrt(n)
    assert np.abs(pulls.std(axis=0) - 1).max() < 4 / np.sqrt(2 * n)
    alarms = sum(bool(one.outliers) for one in results)
    assert alarms <= stats.binom.isf(1e-4, n, FALSE_ALARM)


# --------------------------------------------------------------------- unmeasured


def test_tower_measures_its_sagitta_and_names_its_shears(rng: np.random.Generator) -> None:
    network = Network(load_installation("atlas-tower"))
    found = capability(network)
    assert words(found) == [
        "middle and outer: shear, along x in proportion to their distance in z",
        "middle and outer: shear, along y in proportion to their distance in z",
        "middle and outer: stretch, along z in proportion to their distance in z",
    ]
    shear = found.unmeasured[0].motion
    assert shear["outer.x_um"] == pytest.approx(2 * shear["middle.x_um"])
    assert found.ndf == 48 - 12 + 3
    motions = np.zeros((3, 6))
    motions[1, 0], motions[2, 0], motions[2, 5] = 700.0, 1000.0, 1e-3  # sagitta 200 um
    found = adjust(network, readings(network.values(motions)))
    assert np.isnan(found.motions[1:, :3]).all() and np.isnan(found.sigmas[1:, :3]).all()
    assert np.isnan(found.covariance[6:9, 6:]).all()
    assert np.isfinite(found.covariance[9:12, 9:12]).all()
    np.testing.assert_allclose(found.sagittas[0].value_um, [200, 0], atol=0.2)
    assert found.motions[2, 5] == pytest.approx(1e-3, rel=1e-3)
    assert found.consistent and not found.complete


def test_single_degrees_of_freedom_are_named() -> None:
    rows = [
        rasnik(f"r{k}", "a", "b", "c", x=x, y=y, measures=["x", "y"])
        for k, (x, y) in enumerate(((-100, 0), (100, 0), (0, 100)))
    ]
    network = network_of(
        body("a", 0, fixed=True), body("b", 500), body("c", 1000, fixed=True), rasniks=rows
    )
    found = capability(network)
    # parallel lines do not see a lens plate move along them, nor tilt
    assert words(found) == [f"b: {w}" for w in (
        "translation along z", "rotation about x", "rotation about y",
    )]  # fmt: skip
    assert list(found.measured[1]) == [True, True, False, False, False, True]


def test_the_whole_installation_and_a_body_that_nothing_measures() -> None:
    text = load_installation("atlas-tower").model_dump(exclude_none=True)
    text["bodies"][0]["fixed"] = False
    found = capability(Network(Installation.model_validate(text)))
    shapes = ["shear, along x", "shear, along y", "stretch, along z"]
    assert words(found) == [
        "the whole installation: all six degrees of freedom",
        *(f"inner and outer: {shape} in proportion to their distance in z" for shape in shapes),
    ]
    assert not found.measured.any()
    assert found.ndf == 48 - (18 - 9)
    assert found.sagittas[0].measured.all()  # for all that
    assert found.sagittas[0].sigma_um == pytest.approx(
        capability(Network(load_installation("atlas-tower"))).sagittas[0].sigma_um, rel=1e-6
    )

    text["bodies"].append(body("spare", 0.0))
    found = capability(Network(Installation.model_validate(text)))
    assert words(found)[:2] == [
        "spare: all six degrees of freedom",
        "inner, middle and outer together: all six degrees of freedom",
    ]
    assert len(words(found)) == 5


def test_combinations_are_named_with_their_proportion() -> None:
    network = camera(held=["z", "rx", "rz"])  # a turn about y shifts the far side of the mask
    text = network.installation.model_dump()
    text["rasniks"][0]["mask"]["position_mm"] = [0.0, 0.0, 20.0]
    text["rasniks"][0]["measures"] = ["x", "y"]
    found = capability(Network(Installation.model_validate(text)))
    (one,) = found.unmeasured
    assert one.kind == "combination"
    assert set(one.motion) == {"mask.x_um", "mask.ry_rad"}
    # the crossing stays where it is: the mask turns about it (20 mm from its origin)
    assert one.motion["mask.x_um"] == pytest.approx(-20e3 * one.motion["mask.ry_rad"])
    assert "mm along x" in one.words and "mrad about y" in one.words
    assert list(found.measured[0]) == [False, True, False, False, False, False]
    assert found.free[0].tolist() == [True, True, False, False, True, False]


@pytest.mark.parametrize("kept", [["A1"], ["A1", "B1"], ["B2"], ["A1", "A4", "C1"]])
def test_no_reading_changes_with_a_motion_that_is_called_unmeasured(kept: list[str]) -> None:
    """Also where shifts of mm go with turns of less than a mrad."""
    text = load_installation("atlas-tower").model_dump(exclude_none=True)
    text["rasniks"] = [one for one in text["rasniks"] if one["name"] in kept]
    network = Network(Installation.model_validate(text))
    sigmas = np.array([network.installation.value_sigmas(r) for r in network.installation.rasniks])
    slopes = network.jacobian(np.zeros((3, 6))) / sigmas[..., None, None]
    for one in capability(network).unmeasured:
        motion = np.zeros((3, 6))
        for label, value in one.motion.items():
            name, dof = label.split(".")
            motion[network.bodies.index(name), DOFS.index(dof)] = value
        ranges = np.repeat([1e3 * text["range_mm"], text["range_rad"]], 3)
        motion /= np.abs(motion / ranges).max()
        seen = np.einsum("kvbd,bd->kv", slopes, motion)
        assert np.abs(seen).max() < 1e-6, one.words


def test_what_is_unmeasured_does_not_depend_on_the_size(rng: np.random.Generator) -> None:
    big = load_installation("atlas-tower").model_dump(exclude_none=True)
    small = load_installation("atlas-tower").model_dump(exclude_none=True)
    factor = 1e-3
    for b in small["bodies"]:
        b["position_mm"] = [factor * v for v in b["position_mm"]]
    for r in small["rasniks"]:
        for kind in ("mask", "sensor"):
            r[kind]["position_mm"] = [factor * v for v in r[kind]["position_mm"]]
    small["range_mm"] *= factor
    for text, sigma in ((big, 1.0), (small, factor)):
        text["defaults"] = SIGMAS | {"sigma_x_um": sigma, "sigma_y_um": sigma}
    found = [capability(Network(Installation.model_validate(text))) for text in (big, small)]
    assert words(found[0]) == words(found[1])
    np.testing.assert_allclose(found[0].sigmas[1:, 3:], found[1].sigmas[1:, 3:], rtol=1e-6)


def test_a_missing_reading_makes_more_unmeasured() -> None:
    network = Network(load_installation("atlas-tower-linked"))
    values = network.nominal.copy()
    values[8:] = np.nan  # the cameras
    assert len(words(adjust(network, readings(values)))) == 3
    assert not words(adjust(network, readings(network.nominal)))


def test_unmeasured_motions_are_part_of_the_errors_of_others() -> None:
    """A Rasnik that hardly sees a motion of the range is no measurement of it."""
    weak = camera(held=["x", "y", "rx", "ry", "rz"])
    sigma = 1e-4 / (0.25 / 400e3)
    assert sigma == pytest.approx(160)
    text = weak.installation.model_dump()
    text["range_mm"] = 0.2  # 1.25 sigma
    assert capability(Network(Installation.model_validate(text))).complete
    text["range_mm"] = 0.1  # 0.6 sigma
    found = capability(Network(Installation.model_validate(text)))
    assert words(found) == ["mask: translation along z"]
    assert np.isnan(found.sigmas[0, 2])


def test_nothing_to_solve_is_still_checked() -> None:
    network = camera(fixed=True)
    found = adjust(network, readings([[3.0, 4.0, 0.25, 0.0]]))
    assert found.chi2 == pytest.approx(25) and found.ndf == 4
    assert found.complete and not found.consistent


# ------------------------------------------------------------------------ outliers


@pytest.fixture(scope="module")
def tower() -> Network:
    return Network(load_installation("atlas-tower-linked"))


def noisy(network: Network, rng: np.random.Generator) -> np.ndarray:
    sigmas = np.array([network.installation.value_sigmas(r) for r in network.installation.rasniks])
    return network.nominal + sigmas * rng.normal(size=sigmas.shape)


def test_wrong_values_are_named_one_at_a_time(tower: Network, rng: np.random.Generator) -> None:
    values = noisy(tower, rng)
    values[1, 0] += 30.0
    values[6, 2] += 1e-3
    found = adjust(tower, readings(values))
    assert [(one.rasnik, one.value) for one in found.outliers] == [("C3", "scale"), ("A2", "x")]
    assert not any(one.left_out for one in found.outliers)
    assert not found.consistent and found.probability < 1e-3
    for one, error in zip(found.outliers, (1e-3, 30), strict=True):
        assert abs(one.error - error) < 4 * one.sigma
        assert not one.alternatives
    cleaned = adjust(tower, readings(values), reject=True)
    assert all(one.left_out for one in cleaned.outliers)
    assert cleaned.probability > 1e-3 and cleaned.ndf == found.ndf - 2
    assert [one.label for one in cleaned.checks if not one.used] == ["x of A2", "scale of C3"]
    without = values.copy()
    without[1, 0] = without[6, 2] = np.nan
    np.testing.assert_allclose(
        cleaned.motions, adjust(tower, readings(without)).motions, rtol=1e-6, atol=1e-9
    )


def test_readings_that_cannot_be_told_apart() -> None:
    held = ["y", "z", "rx", "ry", "rz"]
    rows = [rasnik(name, "a", "b", "c", measures=["x"]) for name in ("one", "two")]
    network = network_of(
        body("a", 0, fixed=True), body("b", 500, held=held), body("c", 1000, fixed=True),
        rasniks=rows,
    )  # fmt: skip
    nothing = [np.nan] * 3
    found = adjust(network, readings([[0.0, *nothing], [50.0, *nothing]]), reject=True)
    (one,) = found.outliers
    other = {"one": "x of two", "two": "x of one"}[one.rasnik]
    assert one.alternatives == (other,) and not one.left_out
    assert found.motions[1, 0] == pytest.approx(12.5)


def test_unchecked_values_are_never_named() -> None:
    network = camera(held=["rx", "ry"])
    found = adjust(network, readings([[5000.0, 0, 0.25, 0]]))
    assert not found.outliers and found.ndf == 0
    assert all(np.isnan(one.w) for one in found.checks)


def test_rate_of_detection(rng: np.random.Generator) -> None:
    """Errors of the detectable size are named in 80 % of all cases, right ones seldom."""
    design = rng.normal(size=(12, 4))
    span = np.linalg.qr(design)[0]
    tested = np.ones(12, dtype=bool)
    size = snoop(span, np.zeros(12), tested).detectable[5]
    n = 1000
    named = alarms = 0
    for _ in range(n):
        noise = rng.normal(size=12)
        for error in (0.0, size):
            data = noise + error * (np.arange(12) == 5)
            found = snoop(span, data - span @ (span.T @ data), tested)
            alarms += error == 0 and found.worst is not None
            named += error > 0 and abs(found.w[5]) > found.limit
    assert abs(named / n - 0.8) < 4 * np.sqrt(0.16 / n)
    # the chances of several values add up to no more than stated
    assert alarms / n < FALSE_ALARM + 4 * np.sqrt(FALSE_ALARM / n)
    assert alarms / n > FALSE_ALARM / 3


# ------------------------------------------------------------------------ refusals


def test_readings_without_error_are_named() -> None:
    line = [rasnik("r", "a", "b", "c")]
    text = {"name": "bench", "rasniks": line}
    text["bodies"] = [body("a", 0, fixed=True), body("b", 500), body("c", 1000, fixed=True)]
    network = Network(Installation.model_validate(text))
    with pytest.raises(ValueError, match="bench states no error of any reading"):
        capability(network)
    with pytest.raises(ValueError, match="no reading that can be used: not used, as the error"):
        adjust(network, readings([[1.0, 2, 1, 0]]))
    row = {"name": "r", "x_um": 1.0, "sigma_x_um": 0.5, "y_um": 2.0}
    found = adjust(network, parse_readings(network, [row]))
    assert found.problems == ("not used, as the error is not known: y of r",)
    assert len(found.checks) == 1


def test_a_reading_that_no_place_explains() -> None:
    """From 400 mm the mask would have to come within 0.1 um of the lens; on the way lies more."""
    network = camera(held=["x", "y", "rx", "ry", "rz"])
    found = adjust(network, readings([[0.0, 0.0, 1e6, 0.0]]))
    assert not found.converged and not found.consistent


def test_motions_beyond_belief() -> None:
    """Absolute readings of a mask whose origin nobody described."""
    network = camera(held=["rx", "ry"])
    found = adjust(network, readings([[80e3, 0.0, 0.25, 0.0]]))
    (problem,) = found.problems
    assert "mask would have moved by -80 mm along x, but is believed to stay within 10" in problem
    assert not found.complete
    assert not adjust(network, readings([[20e3, 0.0, 0.25, 0.0]])).problems


def test_as_dict_is_plain(tower: Network, rng: np.random.Generator) -> None:
    import json

    values = noisy(tower, rng)
    values[0, 0] += 100
    document = json.loads(json.dumps(adjust(tower, readings(values)).as_dict(), allow_nan=False))
    assert document["bodies"]["inner"]["x_um"] == {"value": 0.0, "sigma": 0.0, "state": "held"}
    assert document["outliers"][0]["rasnik"] == "A1"
    assert len(document["covariance"]) == 18
    json.dumps(capability(Network(load_installation("atlas-tower"))).as_dict(), allow_nan=False)
