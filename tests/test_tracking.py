"""Tracking: the linear estimator against the image model, and what the tracker makes of frames."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from rasnik import Flag, Pose, Projection, System, Track, Tracker, analyse, load_system
from rasnik.analysis.frame import prepare_frame
from rasnik.analysis.parameters import POSE_SIZE, Model, State
from rasnik.imaging.appearance import Appearance, Camera
from rasnik.imaging.model import expected_image
from rasnik.tracking import kernels, linearisation
from rasnik.tracking.linearisation import Linearisation, Settings, linearise_in_parts
from rasnik.tracking.motion import Motion

Image = NDArray[Any]

POSE = (4000.3, 5000.2, 1.0, 0.002)


@pytest.fixture(scope="module")
def small() -> System:
    return load_system("solidras", {"sensor.width_px": 360, "sensor.height_px": 270})


def camera_of(system: System) -> Camera:
    return Camera(system.shape, system.pitch_um)


def appearance(light: float = 1.0, blur_um: float = 4.5) -> Appearance:
    return Appearance(
        light * np.array([25.0, 1.0, -1.0, 0.5, 0, 0]),
        light * np.array([235.0, 5.0, 3.0, -6.0, 2.0, -4.0]),
        blur_um,
    )


def projection(change: tuple[float, ...] = (0, 0, 0, 0), orientation: int = 1) -> Projection:
    x, y, scale, theta = POSE
    return Projection.from_pose(
        x + change[0], y + change[1], scale * np.exp(change[2]), theta + change[3], orientation
    )


def expected(system: System, change: tuple[float, ...] = (0, 0, 0, 0), **look: float) -> Image:
    return expected_image(system.mask, projection(change), appearance(**look), camera_of(system))


def with_noise(image: Image, rng: np.random.Generator, dtype: str = "uint8") -> Image:
    noise = np.sqrt(0.26 + 0.011 * image) * rng.standard_normal(image.shape)
    return np.clip(np.rint(image + noise), 0, 255).astype(dtype)


@pytest.fixture(scope="module")
def frames(small: System) -> Callable[..., list[Image]]:
    """Noisy frames of the mask moved along x by the given distances."""

    def make(*shifts_um: float, seed: int = 1, **look: float) -> list[Image]:
        rng = np.random.default_rng(seed)
        return [with_noise(expected(small, (d, 0, 0, 0), **look), rng) for d in shifts_um]

    return make


# --------------------------------------------------------------------- linearisation


def linearise(
    system: System, model: Model = "similarity", valid: Image | None = None
) -> Linearisation:
    noise = (0.26 + 1 / 12, 0.011)
    valid = np.ones(system.shape, dtype=np.uint8) if valid is None else valid
    settings = Settings(system.mask, camera_of(system), noise, model, True, valid)
    return linearisation.linearise(settings, State(projection(), appearance()))


def read(linear: Linearisation, image: Image) -> tuple[Image, Image]:
    step, statistics = np.zeros(linear.n_steps), np.zeros(kernels.N_STATISTICS)
    linear.estimate(np.ascontiguousarray(image), step, statistics)
    return step, statistics


@pytest.mark.parametrize("model", POSE_SIZE)
@pytest.mark.parametrize(
    ("change", "tolerance_um"),
    [
        ((0.1, 0, 0, 0), 1e-5),
        ((-0.07, 0.07, 0, 0), 1e-5),
        ((0.5, 0.5, 0, 0), 1.5e-4),
        ((0.02, 0.02, 1e-5, -2e-5), 3e-5),  # derivatives leave out that pixels turn
    ],
)
def test_the_step_to_a_displaced_image(
    small: System, model: Model, change: tuple[float, ...], tolerance_um: float
) -> None:
    """The cubic term is removed: uncorrected, 0.5 um along both axes would be off by 1 nm."""
    step, statistics = read(linearise(small, model), expected(small, change))
    assert np.abs(step[:2] - change[:2]).max() < tolerance_um
    reach = np.hypot(*camera_of(small).half_size_um)
    assert np.abs(step[2:4] - change[2:]).max() * reach < 3 * tolerance_um
    assert abs(statistics[kernels.CHI2]) < 1e-3 * max(statistics[kernels.POSE_ENERGY], 1)
    assert statistics[kernels.SURPRISE] < 0.1


def test_light_blur_and_position_do_not_mix(small: System) -> None:
    image = expected(small, (0.2, -0.1, 0, 0), light=0.9, blur_um=4.52)
    step, statistics = read(linearise(small), image)
    assert np.abs(step[:2] - (0.2, -0.1)).max() < 3e-5
    assert statistics[kernels.CONTRAST] == pytest.approx(0.9, abs=1e-4)
    assert step[16] == pytest.approx(4.52**2 - 4.5**2, rel=0.03)
    assert statistics[kernels.EXPECTED] < 0.97 * image.size  # less light, less noise


def test_uncertainty_is_that_of_many_frames(small: System) -> None:
    linear, image = linearise(small), expected(small)
    rng = np.random.default_rng(5)
    rows = [read(linear, with_noise(image, rng)) for _ in range(400)]
    steps = np.array([step for step, _ in rows])
    sigma = np.sqrt(np.diag(linear.covariance))
    assert np.std(steps[:, :18], axis=0) / sigma == pytest.approx(np.ones(18), abs=0.13)
    pulls = steps[:, :18].mean(axis=0) / sigma * np.sqrt(len(steps))
    assert np.abs(pulls).max() < 4
    chi2 = np.array([statistics[kernels.CHI2] for _, statistics in rows])
    assert chi2.mean() == pytest.approx(linear.ndf, rel=4 * np.sqrt(2 / linear.ndf / 400) + 1e-3)
    surprise = np.array([statistics[kernels.SURPRISE] for _, statistics in rows])
    assert surprise.mean() == pytest.approx(4, abs=4 * np.sqrt(8 / 400))


def test_what_a_similarity_cannot_describe_is_a_surprise(small: System) -> None:
    sheared = projection().matrix @ np.array([[1 + 1e-5, 0, 0], [0, 1 - 1e-5, 0], [0, 0, 1]])
    image = expected_image(small.mask, Projection(sheared), appearance(), camera_of(small))
    assert read(linearise(small), image)[1][kernels.SURPRISE] > 20
    assert read(linearise(small, "affine"), image)[1][kernels.SURPRISE] < 0.1


def test_built_in_parts_it_is_the_same(small: System) -> None:
    whole = linearise(small)
    *pauses, parts = linearise_in_parts(whole.settings, whole.state, 7)
    assert pauses == [None] * len(pauses) and len(pauses) > len(whole.scales) // 7
    assert parts is not None
    for name in ("level", "weights", "scales", "matrix", "counts", "covariance"):
        np.testing.assert_array_equal(getattr(parts, name), getattr(whole, name))


def test_pixels_that_are_not_valid_are_not_used(small: System) -> None:
    valid = np.ones(small.shape, dtype=np.uint8)
    valid[40:90, 100:200] = 0
    image = expected(small, (0.05, 0, 0, 0))
    clean = read(linearise(small, valid=valid), image)
    image[40:90, 100:200] = 7.0
    np.testing.assert_array_equal(read(linearise(small, valid=valid), image)[0], clean[0])
    assert clean[0][0] == pytest.approx(0.05, abs=1e-5)


# --------------------------------------------------------------------- motion


def test_motion_is_extrapolated_as_a_parabola() -> None:
    motion = Motion()
    assert motion.predict(1.0) is None

    def path(t: float) -> Image:
        return np.array([1 + 2 * t - 0.3 * t * t, t, 0.0, 1e-4 * t * t])

    for t in (3.0, 4.0, 6.0):
        motion.add(t, path(t))
    np.testing.assert_allclose(motion.predict(7.5), path(7.5), rtol=1e-12, atol=1e-12)
    assert motion.predict(100.0) is None, "long ago says nothing about now"


# --------------------------------------------------------------------- tracker


def test_frames_are_tracked_as_well_as_fitted(
    small: System, frames: Callable[..., list[Image]]
) -> None:
    shifts = 0.03 * np.arange(24)
    images = frames(*shifts)
    tracker = Tracker(small)
    track = tracker.run(images)
    assert track.ok.all()
    assert track.flags[0] & Flag.COLD_START and not track.flags[1:].any()
    assert 3 <= tracker.references <= 20
    fits = Track.from_poses(analyse(image, small) for image in images)
    for name in ("x_um", "y_um", "scale", "theta_rad", "blur_um", "light_level", "dark_level"):
        difference = getattr(track, name) - getattr(fits, name)
        scatter = np.std(getattr(fits, name) - (shifts if name == "x_um" else 0))
        coarse = name.endswith("level")  # tiles tell less of uneven light than of the pose
        assert np.abs(difference).max() < (0.4 if coarse else 0.2) * scatter, name
    for name in ("sigma_x_um", "sigma_y_um", "sigma_scale", "sigma_theta_rad", "chi2_ndf"):
        np.testing.assert_allclose(getattr(track, name), getattr(fits, name), rtol=0.02)


def test_a_stream_is_tracked_like_a_sequence(
    small: System, frames: Callable[..., list[Image]]
) -> None:
    shifts = 0.006 * np.arange(120)
    images = frames(*shifts)
    tracker = Tracker(small)
    poses = [tracker.update(image, k / 275) for k, image in enumerate(images)]
    assert tracker.references >= 2, "made while the stream went on"
    assert not any(pose.flags for pose in poses[1:])
    track = Tracker(small).run(images)
    streamed = Track.from_poses(poses)
    assert np.std(streamed.x_um - track.x_um) < 0.05 * track.sigma_x_um[0]
    last = poses[-1]
    assert last.projection is not None and last.projection.x_um == pytest.approx(last.x_um)
    assert last.code_lines_read > 0 and last.orientation == 1


@pytest.mark.parametrize("dtype", ["uint8", "uint16", "int32", "float32", "float64"])
def test_types_of_frames(small: System, frames: Callable[..., list[Image]], dtype: str) -> None:
    images = frames(0.0, 0.01, 0.02)
    track = Tracker(small).run([image.astype(dtype) for image in images])
    np.testing.assert_allclose(track.x_um, Tracker(small).run(images).x_um, atol=1e-5)


def test_frames_of_any_layout(small: System, frames: Callable[..., list[Image]]) -> None:
    images = frames(0.0, 0.01, 0.02)
    turned = [np.asfortranarray(image) for image in images]
    mirrored = [image[:, ::-1].copy()[:, ::-1] for image in images]
    plain = Tracker(small).run(images)
    np.testing.assert_array_equal(Tracker(small).run(turned).x_um, plain.x_um)
    np.testing.assert_array_equal(Tracker(small).run(mirrored).x_um, plain.x_um)
    np.testing.assert_array_equal(Tracker(small).run(np.stack(images)).x_um, plain.x_um)


def test_threads_change_nothing(small: System, frames: Callable[..., list[Image]]) -> None:
    images = frames(*(0.005 * np.arange(30)))
    one, two = (Tracker(small, threads=n).run(images) for n in (1, 2))
    np.testing.assert_array_equal(one.x_um, two.x_um)
    with pytest.raises(ValueError, match="threads"):
        Tracker(small, threads=0)


@pytest.mark.parametrize("jump", [0.3, 3.0, 17.0, 85.0, 170.0, 765.0, -1530.0, 2345.6])
def test_jumps_are_followed_and_flagged(
    small: System, frames: Callable[..., list[Image]], jump: float
) -> None:
    track = Tracker(small).run(frames(0, 0, jump, jump, 0))
    assert track.ok.all()
    error = track.x_um - POSE[0] - [0, 0, jump, jump, 0]
    assert (np.abs(error) < 5 * track.sigma_x_um).all()
    assert bool(track.flags[2] & Flag.MOVED) == (jump != 0.3)
    assert not track.flags[3] & (Flag.MOVED | Flag.REFITTED | Flag.COLD_START)


def test_frames_without_a_position(small: System, frames: Callable[..., list[Image]]) -> None:
    good = frames(0, 0, 0, 0, 0, 0)
    dark = np.full_like(good[0], 3)
    images = [*good[:2], dark, None, good[0][:100], good[3], good[4]]
    track = Tracker(small).run(images)
    assert track.ok.tolist() == [True, True, False, False, False, True, True]
    assert np.isnan(track.x_um[2:5]).all() and np.isnan(track.sigma_x_um[2:5]).all()
    assert track.flags[2] & Flag.BLANK
    assert (track.flags[3:5] == Flag.NO_IMAGE).all()
    assert not track.flags[5:].any(), "the reference was kept"


def test_light_that_changes(small: System, frames: Callable[..., list[Image]]) -> None:
    bright, dim = frames(0, 0), frames(0, 0, light=0.5, seed=2)
    slow = [frames(0, light=1 - 0.01 * k, seed=k)[0] for k in range(1, 20)]
    track = Tracker(small).run([*bright, *dim, *bright, *slow])
    assert track.ok.all() and (np.abs(track.x_um - POSE[0]) < 5 * track.sigma_x_um).all()
    assert [bool(flags & Flag.LIGHT_CHANGED) for flags in track.flags[:5]] == [
        False, False, True, False, True,
    ]  # fmt: skip
    assert not track.flags[6:].any(), "slow changes are followed"
    slow_light = slow[10], track.sigma_x_um[6 + 10]
    for image, sigma in [(dim[1], track.sigma_x_um[3]), slow_light]:
        assert sigma == pytest.approx(analyse(image, small).sigma_x_um, rel=0.01)


def test_something_in_the_way(small: System, frames: Callable[..., list[Image]]) -> None:
    images = frames(*[0.0] * 12)
    for image in images[2:9]:
        image[60:140, 100:180] //= 4
    track = Tracker(small).run(images)
    assert track.ok.all() and (np.abs(track.x_um - POSE[0]) < 5 * track.sigma_x_um).all()
    obstructed = (track.flags & Flag.OBSTRUCTED) > 0
    assert obstructed[2:5].all() and not obstructed[:2].any()
    assert not track.flags[7:9].any(), "what stays is left out from then on"
    assert track.sigma_x_um[8] > 1.02 * track.sigma_x_um[1]


def test_half_of_a_frame_is_older(small: System, frames: Callable[..., list[Image]]) -> None:
    """A torn frame explains itself with no rigid mask: 30 nm between its halves suffice."""
    old, new = frames(0, 0, 0), frames(0.03, 0.03, 0.03, seed=2)
    torn = np.vstack([new[0][:135], old[0][135:]])
    track = Tracker(small).run([*old, torn, *new])
    assert track.flags[3] & Flag.OBSTRUCTED
    assert not track.flags[5:].any()


def test_more_freedom_than_needed_is_given_up(
    small: System, frames: Callable[..., list[Image]]
) -> None:
    """Frames whose halves differ call for an affine map; those after them do not."""
    old, new = frames(*[0.0] * 6), frames(*[0.06] * 120, seed=2)
    torn = [np.vstack([a[:135], b[135:]]) for a, b in zip(new, old, strict=False)]
    track = Tracker(small).run([*old[:2], *torn, *new])
    affine = (track.flags & Flag.AFFINE) > 0
    assert affine[2:8].any() and not affine[-20:].any()
    assert (np.abs(track.x_um[-20:] - POSE[0] - 0.06) < 5 * track.sigma_x_um[-20:]).all()


def test_numbers_and_times(small: System, frames: Callable[..., list[Image]]) -> None:
    images = frames(*[0.0] * 8)
    number = [0, 1, 2, 5, 6, 7, 8, 9]
    time_s = np.array([0, 1, 2, 5, 6, 6, 7.0, 8]) / 275
    track = Tracker(small).run(images, time_s, number)
    assert ((track.flags & Flag.FRAMES_LOST) > 0).tolist() == [k == 3 for k in range(8)]
    assert ((track.flags & Flag.TIME_IRREGULAR) > 0).tolist() == [k == 5 for k in range(8)]
    np.testing.assert_array_equal(track.frame, number)
    np.testing.assert_array_equal(track.time_s, time_s)
    nominal = Tracker(small).run(images, numbers=number)
    np.testing.assert_allclose(nominal.time_s, np.array(number) / 275)
    with pytest.raises(ValueError, match="fewer times"):
        Tracker(small).run(images, times=[0.0])


def test_fast_motion_is_followed_by_prediction(
    small: System, frames: Callable[..., list[Image]]
) -> None:
    t = np.arange(24)
    shifts = 40 * np.sin(2 * np.pi * t / 60)  # 4 um a frame at most
    track = Tracker(small).run(frames(*shifts))
    error = track.x_um - POSE[0] - shifts
    assert track.ok.all() and (np.abs(error) < 5 * track.sigma_x_um).all()
    assert track.count(Flag.COLD_START) == 1


def test_without_a_system_the_noise_is_measured(frames: Callable[..., list[Image]]) -> None:
    images = frames(*(0.01 * np.arange(6)))
    track = Tracker(field_um=85.0, pixel_um=6.9).run(images)
    assert track.ok.all() and (track.flags & Flag.NOISE_ESTIMATED).all()
    assert np.abs(track.x_um - POSE[0] - 0.01 * np.arange(6)).max() < 5 * track.sigma_x_um[0]
    assert np.isnan(track.time_s).all()


def test_bounds_are_kept(small: System, frames: Callable[..., list[Image]]) -> None:
    images = frames(*[0.0] * 4)
    for k, image in enumerate(images):
        image[:, 300:] = 40 * k
    track = Tracker(small, bounds=(0, 0, 299, 269)).run(images)
    assert track.ok.all() and not track.flags[1:].any()


@pytest.mark.parametrize("orientation", [1, 2, 3, 4])
def test_orientations_and_polarity(small: System, orientation: int) -> None:
    mask = small.mask.model_copy(update={"polarity": "negative"})
    rng = np.random.default_rng(3)
    thetas = 0.002 + 5e-6 * np.arange(5)
    images = [
        with_noise(
            expected_image(
                mask,
                Projection.from_pose(*POSE[:3], theta, orientation),
                appearance(),
                camera_of(small),
            ),
            rng,
        )
        for theta in thetas
    ]
    track = Tracker(small, orientation=orientation).run(images)
    assert track.ok.all() and not track.flags[1:].any()
    assert (np.abs(track.theta_rad - thetas) < 5 * track.sigma_theta_rad).all()


def test_tracking_goes_on_from_a_prior(small: System, frames: Callable[..., list[Image]]) -> None:
    first, second = frames(0.0, 0.01)
    prior = analyse(first, small)
    pose = Tracker(small, prior=prior).update(second)
    assert pose.ok and pose.flags == Flag.REFITTED


def test_pieces_are_the_whole(small: System, frames: Callable[..., list[Image]]) -> None:
    images = frames(*(0.01 * np.arange(10)))
    done: list[int] = []
    whole = Tracker(small).run(iter(images), progress=done.append)
    pieces = list(Tracker(small).blocks(iter(images), size=4))
    assert [len(piece) for piece in pieces] == [4, 4, 2] and sum(done) == 10
    joined = Track.concatenate(pieces)
    np.testing.assert_allclose(joined.x_um, whole.x_um, atol=2e-5)
    assert len(Track.concatenate([])) == 0 and len(Tracker(small).run([])) == 0


def test_a_track_is_sliced_by_rows(small: System) -> None:
    track = Track.from_poses([Pose(ok=True, x_um=1.0), Pose(flags=Flag.BLANK)])
    assert track.ok.tolist() == [True, False] and len(track[track.ok]) == 1
    with pytest.raises(TypeError, match="slices"):
        track[0]  # type: ignore[index]
    with pytest.raises(ValueError, match="one length"):
        Track(frame=np.arange(3))


def test_a_frame_prepared_twice_is_the_same(
    small: System, frames: Callable[..., list[Image]]
) -> None:
    frame, _ = prepare_frame(frames(0.0)[0], small.mask, small.pitch_um, small, None)
    assert frame.noise == pytest.approx((small.noise_law[0] + 1 / 12, small.noise_law[1]))
