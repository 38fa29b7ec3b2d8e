"""Six degrees of freedom of a proof mass: closed forms, round trips, scatter, what is not seen."""

from __future__ import annotations

import math

import numpy as np
import pytest

from rasnik import Track
from rasnik.geometry.installation import Installation
from rasnik.geometry.rigid import DOFS
from rasnik.seismic.six_dof import SixDof, ground_in_six
from rasnik.seismic.suspension import Suspension

START_S, RATE_HZ = 1_790_000_000.0, 20.0
SIGMA_UM = 1e-3
#: Masks 50 mm from the middle of the mass; lens and sensor 60 and 120 mm from each.
ARM, LENS, SENSOR = 50.0, 60.0, 120.0
TRIAD = {
    "A": ((0, ARM, 0), (1, 0, 0)),
    "B": ((0, 0, ARM), (0, 1, 0)),
    "C": ((ARM, 0, 0), (0, 0, 1)),
}
PARALLEL = {
    "A": ((ARM, 0, 0), (0, 0, 1)),
    "B": ((-ARM / 2, ARM, 0), (0, 0, 1)),
    "C": ((-ARM / 2, -ARM, 0), (0, 0, 1)),
}


def sensor(rasniks, mass=None, **defaults) -> Installation:
    """Masks on the mass, cameras on the frame, each looking along an axis (place, axis)."""
    listed = []
    for name, (place, axis) in rasniks.items():
        at = [
            (np.array(place) + d * np.array(axis)).astype(float).tolist() for d in (0, LENS, SENSOR)
        ]
        listed.append(
            {
                "name": name,
                "mask": {"body": "mass", "position_mm": at[0]},
                "lens": {"body": "frame", "position_mm": at[1]},
                "sensor": {"body": "frame", "position_mm": at[2]},
            }
        )
    return Installation.model_validate(
        {
            "name": "sensor",
            "defaults": {"sigma_x_um": SIGMA_UM, "sigma_y_um": SIGMA_UM, **defaults},
            "bodies": [
                {"name": "frame", "position_mm": [0.0, 0.0, 0.0], "fixed": True},
                {"name": "mass", "position_mm": [0.0, 0.0, 0.0], **(mass or {})},
            ],
            "rasniks": listed,
        }
    )


def tracks_of(six: SixDof, values) -> dict[str, Track]:
    n = len(values)
    rest = {
        name: np.full(n, 1.0)
        for name in ("chi2_ndf", "blur_um", "dark_level", "light_level", "sigma_x_um",
                     "sigma_y_um", "sigma_scale", "sigma_theta_rad")
    }  # fmt: skip
    return {
        name: Track(
            np.arange(n), START_S + np.arange(n) / RATE_HZ, *values[:, k].T,
            flags=np.zeros(n), **rest,
        )
        for k, name in enumerate(six.network.rasniks)
    }  # fmt: skip


# ------------------------------------------------------------------------ what is measured


def test_three_orthogonal_axes_measure_everything():
    six = SixDof(sensor(TRIAD))
    assert six.measured.all() and not six.unmeasured
    assert 1 <= six.condition < 5
    # Each translation is read by the two Rasniks across it. By symmetry all are equally good.
    translations = [six.sigma[name] for name in DOFS[:3]]
    turns = [six.sigma[name] for name in DOFS[3:]]
    assert np.ptp(translations) < 1e-9 * translations[0] and np.ptp(turns) < 1e-9 * turns[0]


def test_errors_of_the_triad_in_closed_form():
    """Each Rasnik reads t + r x p across its axis: six readings, six unknowns."""
    six = SixDof(sensor(TRIAD))
    rows = []
    for place, axis in TRIAD.values():
        p = 1e3 * np.array(place, float)
        turn = np.array([[0, p[2], -p[1]], [-p[2], 0, p[0]], [p[1], -p[0], 0]])  # r x p
        moved = np.hstack([np.eye(3), turn])
        rows.append(moved[[k for k in range(3) if not axis[k]]])
    matrix = np.vstack(rows)
    expected = SIGMA_UM**2 * np.linalg.inv(matrix.T @ matrix)
    np.testing.assert_allclose(six.covariance, expected, rtol=1e-6, atol=1e-12 * expected.max())


def test_parallel_axes_name_what_they_do_not_see():
    six = SixDof(sensor(PARALLEL))
    assert six.measured.tolist() == [True, True, False, False, False, True]
    words = " | ".join(six.unmeasured)
    for motion in ("translation along z", "rotation about x", "rotation about y"):
        assert motion in words, words
    assert six.condition == math.inf
    motions, _ = six.solve(six.readings([[1.0, 2.0, 0.0, 0.0, 0.0, 1e-5]]))
    np.testing.assert_allclose(motions[0, [0, 1, 5]], [1.0, 2.0, 1e-5], rtol=1e-4)
    assert np.isnan(motions[0, 2:5]).all()


def test_scale_shows_what_parallel_axes_miss():
    """With the scale as a seventh to ninth reading distance and tilt are seen, if less well."""
    six = SixDof(sensor(PARALLEL, sigma_scale=1e-6))
    assert six.measured.all() and np.isfinite(six.condition)
    # S = b / a falls by 1 / a for each um along the light: z is known to sigma a / sqrt(3)
    assert six.sigma["z_um"] == pytest.approx(1e-6 * LENS * 1e3 / math.sqrt(3), rel=1e-6)
    assert six.sigma["z_um"] > 10 * six.sigma["x_um"]


def test_held_and_own_errors():
    six = SixDof(sensor(PARALLEL, {"held": ["z", "rx", "ry"]}))
    assert six.measured.all() and six.sigma["z_um"] == 0
    double = SixDof(sensor(TRIAD), {n: [2 * SIGMA_UM] * 2 + [math.inf] * 2 for n in TRIAD})
    # errors of the installation and of the reading add in quadrature
    assert double.sigma["x_um"] == pytest.approx(math.sqrt(5) * SixDof(sensor(TRIAD)).sigma["x_um"])


def test_sensors_that_cannot_be():
    with pytest.raises(ValueError, match="one body that moves; here it is 0"):
        SixDof(sensor(TRIAD, {"fixed": True}))
    with pytest.raises(ValueError, match="without a prior"):
        SixDof(sensor(TRIAD, {"prior": {"x_um": 1.0}}))
    with pytest.raises(ValueError, match="no Rasnik 'Z'; there are A, B, C"):
        SixDof(sensor(TRIAD), {"Z": [1, 1, 1, 1]})
    six = SixDof(sensor(TRIAD))
    with pytest.raises(ValueError, match=r"shape \(n, 3, 4\), not \(5, 4\)"):
        six.solve(np.zeros((5, 4)))
    with pytest.raises(ValueError, match="no track of B, C"):
        six.motion({"A": Track()})


# ------------------------------------------------------------------------ solutions


def test_random_motions_come_back(rng):
    six = SixDof(sensor(TRIAD))
    motions = rng.normal(size=(30, 6)) * [50, 50, 50, 1e-3, 1e-3, 1e-3]
    values = six.readings(motions)
    exact, chi2 = six.solve(values, exact=True)
    np.testing.assert_allclose(exact[:, :3], motions[:, :3], atol=1e-5)
    np.testing.assert_allclose(exact[:, 3:], motions[:, 3:], atol=1e-9)
    assert np.isnan(chi2).all()  # six readings, six motions: nothing is left over
    linear, _ = six.solve(values)
    error = np.abs(linear - motions)[:, :3].max()
    assert 1e-3 < error < 1.0  # of the order of 150 um * 1 mrad
    small, _ = six.solve(six.readings(1e-3 * motions))
    assert np.abs(small - 1e-3 * motions)[:, :3].max() < 2e-6 * error  # falls as the square


def test_covariance_by_monte_carlo(rng):
    """Scale and rotation too: 12 readings, 6 motions, chi2 of 6 degrees of freedom."""
    six = SixDof(sensor(TRIAD, sigma_scale=1e-6, sigma_theta_rad=1e-6))
    truth = np.array([3.0, -2.0, 1.0, 2e-5, -1e-5, 3e-5])
    noise = rng.normal(size=(4000, 3, 4)) * [SIGMA_UM, SIGMA_UM, 1e-6, 1e-6]
    values = six.readings(truth[None]) + noise
    for exact, frames in ((False, 4000), (True, 400)):
        motions, chi2 = six.solve(values[:frames], exact=exact)
        spread = np.array(list(six.sigma.values()))
        size = np.outer(spread, spread)
        tolerance = 5 / math.sqrt(frames)
        np.testing.assert_allclose(np.cov(motions.T) / size, six.covariance / size, atol=tolerance)
        assert chi2.mean() == pytest.approx(6, abs=6 * tolerance)
        if exact:  # the linear solution is off by 3 um * 5e-5
            assert (np.abs(motions.mean(axis=0) - truth) < tolerance * spread).all()


def test_missing_readings_have_no_motion():
    six = SixDof(sensor(TRIAD))
    values = six.readings(np.zeros((3, 6)))
    values[1, 2, 0] = np.nan
    for exact in (False, True):
        motions, _ = six.solve(values, exact=exact)
        assert np.isnan(motions).all(axis=1).tolist() == [False, True, False]
    values[1, 2, 0], values[1, 2, 2] = 0.0, np.nan  # a scale that is not used
    assert np.isfinite(six.solve(values)[0]).all()


# ------------------------------------------------------------------------ tracks


def test_motion_of_tracks_about_their_mean():
    six = SixDof(sensor(TRIAD))
    t_s = np.arange(400) / RATE_HZ
    swing = np.sin(2 * np.pi * t_s)[:, None] * [0.1, 0.0, 0.2, 1e-6, 0.0, 0.0]
    values = six.readings(swing) + [1234.5, 99.0, 0.0, 0.0]  # masks with some other origin
    found = six.motion(tracks_of(six, values))
    for name, column in zip(DOFS, swing.T, strict=True):
        series = found.series[name]
        factor = 1e3 if name.endswith("_um") else 1.0
        np.testing.assert_allclose(series.values, factor * column, atol=factor * 2e-6)
        assert series.unit == ("nm" if factor == 1e3 else "rad")
        assert series.start_s == START_S and series.rate_hz == RATE_HZ
    with pytest.raises(ValueError, match="x of A and x of B: the rates differ"):
        tracks = tracks_of(six, values)
        slow = tracks_of(six, values)["B"]
        six.motion({**tracks, "B": Track(**{**slow.as_dict(), "time_s": START_S + 2 * t_s})})


def test_ground_in_six():
    """A frame that moves and turns sinusoidally: r / x_g in closed form, each with its own f0."""
    six = SixDof(sensor(TRIAD))
    t_s, f_hz = np.arange(1200) / RATE_HZ, 1.0
    masses = {
        "x_um": Suspension(frequency_hz=0.5, q=3.0),
        "ry_rad": Suspension(frequency_hz=2.0, q=10.0),
    }
    motions, grounds = np.zeros((len(t_s), 6)), {}
    for name, amplitude in (("x_um", 0.05), ("ry_rad", 1e-6)):
        s, w0 = 2j * np.pi * f_hz, 2 * np.pi * masses[name].frequency_hz
        response = -(s**2) / (s**2 + s * w0 / masses[name].q + w0**2)
        motions[:, DOFS.index(name)] = amplitude * np.real(response * np.exp(s * t_s))
        grounds[name] = amplitude * np.real(np.exp(s * t_s))
    found = ground_in_six(
        six.motion(tracks_of(six, six.readings(motions))), masses, "displacement", band_hz=(0.5, 5)
    )
    inside = slice(300, -300)
    np.testing.assert_allclose(
        found["x_um"].values[inside], 1e3 * grounds["x_um"][inside], atol=1e3 * 0.05 * 2e-3
    )
    np.testing.assert_allclose(
        found["ry_rad"].values[inside], grounds["ry_rad"][inside], atol=1e-6 * 2e-3
    )
    assert (found["x_um"].unit, found["ry_rad"].unit) == ("nm", "rad")
    exposed = motions * np.sinc(f_hz * 0.04)  # the mean of a sine over 40 ms
    undone = ground_in_six(
        six.motion(tracks_of(six, six.readings(exposed))), masses, "displacement", band_hz=(0.5, 5),
        exposure_s=0.04,
    )  # fmt: skip
    for name, one in undone.items():
        size = np.nanmax(found[name].values)
        np.testing.assert_allclose(one.values[inside], found[name].values[inside], atol=1e-4 * size)
    flat = SixDof(sensor(PARALLEL))
    still = flat.motion(tracks_of(flat, flat.readings(motions)))
    with pytest.raises(ValueError, match="ry of mass is not measured"):
        ground_in_six(still, {"ry_rad": masses["ry_rad"]}, band_hz=(0.2, 5))
    with pytest.raises(ValueError, match="'x' is not one of x_um"):
        ground_in_six(still, {"x": masses["x_um"]}, band_hz=(0.2, 5))


def test_errors_of_the_ground_in_six_by_monte_carlo(rng):
    six = SixDof(sensor(TRIAD))
    noise = rng.normal(size=(6000, 3, 4)) * [SIGMA_UM, SIGMA_UM, 0, 0]
    motion = six.motion(tracks_of(six, six.readings(np.zeros((1, 6))) + noise))
    mass = Suspension(frequency_hz=0.5, q=3.0)
    found = ground_in_six(motion, dict.fromkeys(DOFS, mass), "acceleration", band_hz=(1.0, 8.0))
    for one in found.values():
        # Some 4 Hz of independent values: most of the noise lies at the upper end.
        tolerance = 4 / math.sqrt(2 * 2 * 4.0 * one.valid / RATE_HZ)
        assert np.nanstd(one.values) / one.sigma == pytest.approx(1, abs=tolerance)
    resampled = six.motion(tracks_of(six, six.readings(np.zeros((600, 6)))), resample_hz=7.0)
    assert np.isnan(list(resampled.sigma.values())).all()
