"""Effects of the sensor's response and read-out: variances, conserved charge, spectra."""

from __future__ import annotations

import numpy as np
import pytest

from rasnik import load_system, simulate
from rasnik.imaging.effects import Chain, Context, make_effects

SMALL = {"sensor.width_px": 96, "sensor.height_px": 64}
POSE = (41000.0, 30200.0, 0.01)


def small(**changes):
    return load_system("solidras", {**SMALL, **changes})


@pytest.fixture(scope="module")
def system():
    return small()


@pytest.fixture(scope="module")
def plain(system):
    return simulate(system, POSE, seed=1).expected(0)


def expected(system, effects, seed=1, **options):
    return simulate(system, POSE, seed=seed, effects=effects, **options).expected(0)


def chain(system, effects, seed=1, frames=1):
    return Chain(make_effects(effects), Context(system, seed, frames), True)


# --------------------------------------------------------------------------- response


def test_gain_spread_is_the_variance_of_each_pixel(system, plain):
    ratio = np.array([expected(system, {"gain_spread": 0.03}, seed=s) / plain for s in range(20)])
    assert abs(ratio.std() / 0.03 - 1) < 4 / np.sqrt(2 * ratio.size)
    assert abs(ratio.mean() - 1) < 4 * 0.03 / np.sqrt(ratio.size)
    pixel = ratio.std(axis=0)
    assert pixel.mean() == pytest.approx(0.03, rel=0.05)  # each pixel, over sensors


def test_pedestal_spread_does_not_depend_on_light(system, plain):
    extra = np.array(
        [expected(system, {"pedestal_spread": 1.5}, seed=s) - plain for s in range(20)]
    )
    for part in (plain < 40, plain > 240):
        values = extra[:, part]
        assert abs(values.std() / 1.5 - 1) < 4 / np.sqrt(2 * values.size)


def test_the_sensor_stays_the_same_from_frame_to_frame(system):
    simulation = simulate(
        system, [POSE, (7000, 8000)], n=2, seed=1, noise=False, effects={"pedestal_spread": 2.0}
    )
    bare = simulate(system, [POSE, (7000, 8000)], n=2, seed=1, noise=False)
    offset = simulation.frames - bare.frames
    np.testing.assert_allclose(offset, np.broadcast_to(offset[0], offset.shape), atol=1e-9)


def test_cross_talk_spreads_a_point_and_keeps_the_charge(system):
    point = np.zeros((9, 9))
    point[4, 4] = 100.0
    out = chain(system, {"cross_talk": 0.05}).respond(point)
    np.testing.assert_allclose(out[4, 3:6], [5, 80, 5])
    np.testing.assert_allclose(out[3:6, 4], [5, 80, 5])
    assert out.sum() == pytest.approx(100) and out[3, 3] == 0
    flat = chain(system, {"cross_talk": 0.05}).respond(np.full((9, 9), 7.0))
    np.testing.assert_allclose(flat, 7.0)


@pytest.mark.parametrize(("name", "level"), [("dead_pixels", 0.0), ("hot_pixels", 255.0)])
def test_share_of_bad_pixels(system, plain, name, level):
    image = expected(system, {name: 0.05})
    bad = image != plain
    assert (image[bad] == level).all()
    n = bad.size
    assert abs(bad.sum() - 0.05 * n) < 4 * np.sqrt(0.05 * 0.95 * n)


def test_flicker_is_one_over_f(system):
    tiny = small(**{"sensor.width_px": 32, "sensor.height_px": 32})
    flicker, n = chain(tiny, {"flicker": 0.01}, frames=512), 512
    gain = np.array([flicker.gain(k) for k in range(n)], dtype=np.float64).reshape(n, -1)
    # Hann-windowed periodogram at 1 frame per unit of time, mean over the pixels.
    window = np.hanning(n)[:, None]
    spectrum = np.abs(np.fft.rfft((gain - gain.mean(axis=0)) * window, axis=0)) ** 2
    psd = 2 * spectrum.mean(axis=1) / (window**2).sum()
    f = np.fft.rfftfreq(n)
    band = (f > 0.01) & (f < 0.2)
    slope, level = np.polyfit(np.log(f[band]), np.log(psd[band]), 1)
    assert slope == pytest.approx(-1, abs=0.1)
    middle = np.exp(level + slope * np.log(0.04))
    assert middle == pytest.approx(0.01**2 / np.log(10) / 0.04, rel=0.15)


def test_flicker_of_a_frame_is_the_same_however_it_is_asked_for(system):
    one, other = (chain(system, {"flicker": 0.01}, frames=50) for _ in range(2))
    forward = [one.gain(k).copy() for k in range(20)]
    for k in (13, 2, 19):
        np.testing.assert_array_equal(other.gain(k), forward[k])


# ------------------------------------------------------------------------------ noise


def photon_transfer(system, effects=None, frames=400):
    """(A, B) from the scatter of frames of a ramp of light, and their standard errors."""

    def ramp(u, v):
        return 30 + 190 * (v - v.min()) / np.ptp(v) + 0 * u

    simulation = simulate(
        system, POSE, n=frames, seed=4, effects=effects, quantise=False,
        light_map=ramp, dark_map=ramp,
    )  # fmt: skip
    level = simulation.expected(0)[:, 0]
    stack = simulation.frames
    variance = stack.var(axis=0, ddof=1).mean(axis=1)
    error = variance * np.sqrt(2 / ((frames - 1) * stack.shape[2]))
    design = np.stack([np.ones_like(level), level], axis=1) / error[:, None]
    covariance = np.linalg.inv(design.T @ design)
    return covariance @ design.T @ (variance / error), np.sqrt(np.diag(covariance))


def test_photon_transfer_recovers_a_and_b(system):
    found, error = photon_transfer(system)
    assert (error < [0.02, 2e-4]).all()
    assert (abs(found - [0.26, 0.011]) < 4 * error).all()


@pytest.mark.parametrize(
    ("effects", "law"),
    [
        ({"shot_noise": 0.0}, (0.26, 0.0)),
        ({"electronic_noise": 0.0}, (0.0, 0.011)),
        ({"shot_noise": 0.05, "electronic_noise": 1.0}, (1.0, 0.05)),
        ({"shot_noise": False}, (0.26, 0.0)),
    ],
)
def test_noise_is_switched_and_set_by_name(system, effects, law):
    found, error = photon_transfer(system, effects, frames=100)
    assert (abs(found - law) < 4.5 * error + 1e-9).all()


def test_noise_of_a_superpixel():
    found, error = photon_transfer(small(**{"sensor.binning": 2}), {"electronic_noise": 0.4})
    assert (abs(found - [0.1, 0.011 / 4]) < 4 * error).all()


def test_half_the_light_is_noisier_by_the_root_of_two(system):
    # In the shot-noise limit: relative fluctuation of the signal.
    relative = []
    for light in (240.0, 120.0):
        simulation = simulate(
            system, POSE, n=200, seed=4, quantise=False,
            effects={"electronic_noise": 0.0}, light_map=light, dark_map=light,
        )  # fmt: skip
        relative.append(simulation.frames.std(axis=0).mean() / light)
    assert relative[1] / relative[0] == pytest.approx(np.sqrt(2), rel=0.005)


def test_a_system_of_unknown_noise_takes_the_noise_it_is_given():
    vague = small(**{"sensor.noise_a": None, "sensor.noise_b": None})
    with pytest.raises(ValueError, match="noise of system solidras is not known"):
        simulate(vague, POSE)
    frame, _ = simulate(vague, POSE, seed=1, effects={"electronic_noise": 4.0})[0]
    rest = frame - simulate(vague, POSE, seed=1, noise=False).expected(0)
    assert rest[frame < 250].std() == pytest.approx(np.sqrt(4 + 1 / 12), rel=0.05)


# --------------------------------------------------------------------------- read-out


def test_blooming_spills_along_the_column(system):
    levels = np.full((7, 3), 100.0)
    levels[3, 1] = 255.0 + 400.0
    out = chain(system, "blooming").read_out(levels.copy())
    # 200 to either side: 155 fill the next well, 45 the one after.
    np.testing.assert_array_equal(out[:, 1], [100, 145, 255, 255, 255, 145, 100])
    np.testing.assert_array_equal(out[:, [0, 2]], 100)
    half = chain(system, {"blooming": 0.5}).read_out(levels.copy())
    np.testing.assert_array_equal(half[:, 1], [100, 100, 200, 255, 200, 100, 100])


def test_blooming_keeps_the_charge_until_the_end_of_the_column(system):
    rng = np.random.default_rng(1)
    levels = rng.uniform(150, 300, (60, 40))
    blooming = make_effects({"blooming": {"share": 1.0, "full_grey": 260.0}})[0]
    out = blooming.read_out(levels.copy(), Context(system, 1))
    assert out.max() <= 260 + 1e-9
    np.testing.assert_allclose(out[:, 5:8].sum(), levels[:, 5:8].sum(), rtol=2e-3)
    np.testing.assert_allclose(
        out[::-1], blooming.read_out(levels[::-1].copy(), Context(system, 1))
    )
    edge = np.array([[300.0], [0.0], [0.0]])
    np.testing.assert_allclose(
        blooming.read_out(edge.copy(), Context(system, 1))[:, 0], [260, 20, 0]
    )


def test_rounding_and_saturation_are_switched_by_name(system):
    def frame(effects):
        return simulate(system, POSE, seed=1, effects=effects)[0][0]

    usual = frame(None)
    smooth = frame({"rounding": 0})
    assert usual.dtype == np.uint8 and smooth.dtype == np.float64
    assert smooth.max() == 255.0  # still limited
    residue = np.abs(smooth - usual)
    assert 0.45 < residue.max() <= 0.5 + 1e-4
    open_top = frame({"saturation": 0})
    assert open_top.max() > 255 and (open_top == np.rint(open_top)).all()
    np.testing.assert_array_equal(np.clip(open_top, 0, 255), usual)
    coarse = frame({"rounding": 4})
    assert coarse.dtype == np.uint8 and (coarse % 4 == 0).mean() > 0.9
    low = frame({"saturation": 200})
    np.testing.assert_array_equal(low, np.minimum(usual, 200))


def test_rounding_adds_a_twelfth_of_its_step_squared(system):
    levels = np.random.default_rng(3).uniform(20, 200, (64, 96))
    for step in (1.0, 4.0):
        out = chain(system, {"rounding": step}).read_out(levels.copy())
        variance = ((out - levels) ** 2).mean()
        assert variance == pytest.approx(step**2 / 12, rel=0.05)
