"""The worked design of a light path on the Moon: what its file and its page state follows."""

from __future__ import annotations

import math

import numpy as np
import pytest

from rasnik import Tracker, analyse, bound, load_system, simulate
from rasnik.instrument import SystemConfigError
from rasnik.performance.design import best_field

LUNAR = load_system("lunar")
SOLID = load_system("solidras")
RADIUS_M = 1737.4e3


def test_the_optics_follow_from_their_reasons():
    optics, geometry = LUNAR.optics, LUNAR.geometry
    a, b, d = geometry.mask_lens_mm, geometry.lens_sensor_mm, optics.diaphragm_mm
    assert a == 10e6  # 10 km
    assert 1 / a + 1 / b == pytest.approx(1 / optics.focal_length_mm, rel=1e-5)
    assert optics.scale == pytest.approx(b / a, rel=1e-4)
    # the blur of SolidRas by Br = 1.22 lambda / (D / b), as for the other systems
    cone = SOLID.optics.diaphragm_mm / SOLID.geometry.lens_sensor_mm
    assert optics.blur_um == pytest.approx(SOLID.optics.blur_um * cone / (d / b), rel=0.01)
    spot_mm = 1.22 * 448e-6 * a / d  # the paper's Br, on the mask
    assert spot_mm == pytest.approx(10.9, abs=0.05)
    assert 2 < LUNAR.mask.field_um / 1e3 / spot_mm < 3  # fields are resolved
    view_mm = np.array(LUNAR.shape) * LUNAR.pitch_um / optics.scale / 1e3
    mask_mm = 9 * LUNAR.mask.field_um / 1e3 * np.array([LUNAR.mask.rows, LUNAR.mask.columns])
    assert (view_mm < mask_mm).all() and (mask_mm < 2200).all()
    assert best_field(LUNAR).mask.field_um == pytest.approx(LUNAR.mask.field_um, rel=0.2)


def test_a_scale_that_contradicts_the_distances_is_refused():
    with pytest.raises(SystemConfigError, match="make a scale of 0.003009"):
        load_system("lunar", {"optics.scale": 0.01, "geometry.mask_lens_mm": 1e7})


def test_resolution_goes_with_baseline_over_diaphragm():
    """The same image in pixels, so the same angle in units of lambda / D; 2 L makes 2 sigma."""

    def sigma_nm(baseline_km: float, diaphragm_m: float) -> float:
        ratio = baseline_km / 10 * 0.5 / diaphragm_m
        changed = {
            "geometry.mask_lens_mm": 1e6 * baseline_km,
            "geometry.lens_sensor_mm": 1e6 * baseline_km * LUNAR.optics.scale,
            "optics.blur_um": LUNAR.optics.blur_um * ratio,
            "optics.diaphragm_mm": 1e3 * diaphragm_m,
            "mask.field_um": LUNAR.mask.field_um * ratio,
            "sensor.pixel_um": LUNAR.sensor.pixel_um * ratio,
        }
        return bound(load_system("lunar", changed)).sigma_nm

    here = sigma_nm(10, 0.5)
    assert sigma_nm(20, 0.5) == pytest.approx(2 * here, rel=1e-6)
    assert sigma_nm(20, 1.0) == pytest.approx(here, rel=1e-6)


def test_images_of_it_decode_at_the_bound(rng):
    """Positions all over what the view can reach, found at the stated error."""
    half = np.array(LUNAR.shape[::-1]) * LUNAR.pitch_um / LUNAR.optics.scale / 2
    x0, x1, y0, y1 = LUNAR.mask.bounds_um
    low, high = np.array([x0, y0]) + half, np.array([x1, y1]) - half
    poses = rng.uniform(low, high, (6, 2))
    pulls = []
    for frame, truth in simulate(LUNAR, [tuple(p) for p in poses], seed=3):
        found = analyse(frame, LUNAR)
        assert found.ok, found
        pulls.append((found.x_um - truth.x_um) / found.sigma_x_um)
        pulls.append((found.y_um - truth.y_um) / found.sigma_y_um)
        assert found.sigma_x_um == pytest.approx(0.32, rel=0.3)
    assert np.sum(np.square(pulls)) == pytest.approx(12, abs=4 * math.sqrt(24))


def test_a_frame_follows_the_next():
    start = np.mean(np.array(LUNAR.mask.bounds_um).reshape(2, 2), axis=1)
    frames = [
        f for f, _ in simulate(LUNAR, [tuple(start + [5.0 * k, 0]) for k in range(6)], seed=1)
    ]
    track = Tracker(LUNAR).run(frames)
    assert track.ok.all()
    assert np.abs(np.diff(track.x_um) - 5.0).max() < 5 * math.sqrt(2) * 0.33


@pytest.mark.parametrize(("baseline_km", "height_m"), [(10, 7.2), (20, 28.8), (50, 180.0)])
def test_the_moon_is_in_the_way(baseline_km, height_m):
    """Height of both ends over the ground between them, on a smooth sphere."""
    half = 500.0 * baseline_km
    assert math.hypot(RADIUS_M, half) - RADIUS_M == pytest.approx(height_m, rel=0.01)
