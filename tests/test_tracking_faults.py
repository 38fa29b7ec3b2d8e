"""Tracking through whatever can happen to a stream; a short run of two benchmarks.

`benchmarks/tracking_faults.py` and `benchmarks/tracking_memory.py` are the long ones.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from _fault_stream import KINDS, ORIENTATION, SYSTEM, FaultStream, Truth, View
from rasnik import Flag, Pose, Projection, Track, Tracker, load_system
from rasnik.imaging.montecarlo import exact_image
from rasnik.io import read_track
from tracking_faults import Report, follow
from tracking_memory import ALLOWED_MB, growth_mb, measure

SMALL = load_system(SYSTEM, {"sensor.width_px": 300, "sensor.height_px": 240})
POSE = np.array([20_000.0, 30_000.0, 1.0, 0.002])
SIGMA = np.array([4e-4, 4e-4, 2e-7, 2e-7])


# ------------------------------------------------------------------------ the frames


def normalised_residual(stream: FaultStream, k: int, rows: slice, pose: np.ndarray) -> float:
    """Mean square of the residuals of a part of a frame, over the variance of the sensor."""
    frame = stream.frame(k)
    assert frame is not None and stream.system.noise_law is not None
    light = stream._light[k]
    expected = light * exact_image(stream.system, Projection.from_pose(*pose, ORIENTATION))
    a, b = stream.system.noise_law
    residual = (frame - expected) ** 2 / (a + b * expected + 1 / 12)
    return float(residual[rows].mean())


@pytest.mark.parametrize("kind", ["jump", "turn", "scale", "sweep", "half the light", "dropped"])
def test_frames_show_the_pose_that_is_called_true(kind: str) -> None:
    """Against the exact generator at that very pose; 72,000 pixels scatter by 0.5 % (6 sigma)."""
    stream = FaultStream(60, 3, every=12, kinds=[kind], exact=0.0, system=SMALL)
    event = stream.events[1]
    for k in (event.start - 1, event.start + event.length - 1, len(stream) - 1):
        truth = stream.truth(k)
        assert truth.view is View.FULL
        assert normalised_residual(stream, k, slice(None), truth.poses[0]) == pytest.approx(
            1, abs=0.03
        )


@pytest.mark.parametrize("kind", ["torn by a jump", "torn by whole fields", "torn by vibration"])
def test_parts_of_torn_frames_show_their_poses(kind: str) -> None:
    stream = FaultStream(120, 1, every=12, kinds=[kind], exact=0.0, system=SMALL)
    for event in stream.events:
        truth = stream.truth(event.start)
        assert truth.view is View.PIECES and len(truth.poses) == 2
        ends = (slice(0, 1), slice(-1, None))
        for rows, pose in zip(ends, truth.poses, strict=True):
            # 300 pixels scatter by 8 %
            assert normalised_residual(stream, event.start, rows, pose) == pytest.approx(
                1, abs=0.35
            )


def test_pieces_of_rolled_frames_show_their_poses() -> None:
    stream = FaultStream(60, 1, every=12, kinds=["rolled"], exact=0.0, system=SMALL)
    event = stream.events[0]
    frame = stream.frame(event.start)
    truth = stream.truth(event.start)
    row, column = stream._roll(event)
    assert row or column
    shown = 0.0
    for pose in truth.poses:
        expected = exact_image(SMALL, Projection.from_pose(*pose, ORIENTATION))
        expected *= stream._light[event.start]
        shown += np.mean(np.abs(frame - expected) < 6 * np.sqrt(0.35 + 0.011 * expected))
    # every pixel belongs to one piece, and some agree by chance with the others
    assert shown > 1.0


def test_the_stream_is_the_same_in_any_order() -> None:
    stream = FaultStream(200, 5, every=10, exact=0.0, system=SMALL)
    again = FaultStream(200, 5, every=10, exact=0.0, system=SMALL)
    for k in (150, 20, 151, 21):
        one, other = stream.frame(k), again.frame(k)
        assert (one is None and other is None) or np.array_equal(one, other)
    assert not np.array_equal(FaultStream(200, 6, every=10).poses, stream.poses)


# ------------------------------------------------------------------------ the judge


def one_row(error_sigma: float, flags: Flag = Flag.NONE, ok: bool = True) -> Track:
    value = POSE + error_sigma * SIGMA if ok else np.full(4, np.nan)
    names = ("x_um", "y_um", "scale", "theta_rad")
    columns = {name: [value[i]] for i, name in enumerate(names)}
    columns |= {f"sigma_{name}": [SIGMA[i]] for i, name in enumerate(names)}
    pose = Track.from_poses([Pose(flags=flags)])
    return replace(pose, **columns)


def judged(track: Track, truth: Truth) -> Report:
    report = Report(height_um=3700.0, field_um=85.0)
    report.add(0, track, [truth])
    return report


QUIET = Truth("quiet", View.FULL, POSE[None])


@pytest.mark.parametrize(
    ("track", "outcome"),
    [
        (one_row(4.0), "right"),
        (one_row(4.0, Flag.OBSTRUCTED), "right"),
        (one_row(20.0), "unflagged"),
        (one_row(1e6), "unflagged"),
        (one_row(20.0, Flag.FRAMES_LOST | Flag.COLD_START), "informed"),
        (one_row(20.0, Flag.REFITTED | Flag.MOVED), "treated"),
        (one_row(20.0, Flag.REFITTED | Flag.OBSTRUCTED), "warned"),
        (one_row(0.0, Flag.NO_MASK, ok=False), "none"),
    ],
)
def test_results_are_judged(track: Track, outcome: str) -> None:
    report = judged(track, QUIET)
    assert report.total(outcome) == 1
    assert report.passed == (outcome == "right")
    # where something is in the way, a warning will do
    hidden = judged(track, replace(QUIET, kind="hand", view=View.PART))
    assert hidden.passed == (outcome not in ("unflagged", "informed"))


def test_any_position_is_wrong_where_nothing_is_seen() -> None:
    nothing = Truth("dark", View.NOTHING, np.empty((0, 4)))
    assert judged(one_row(0.0), nothing).total("unflagged") == 1
    assert judged(one_row(0.0, Flag.BLANK, ok=False), nothing).passed


def test_between_the_pieces_is_right_only_for_a_smear() -> None:
    # a code that neither piece has is wrong, whatever the chessboard says
    for apart_um, outcome in ((0.05, "right"), (0.5, "unflagged"), (2 * 85.0, "unflagged")):
        poses = np.stack([POSE, POSE])
        poses[0, 0] -= apart_um / 2
        poses[1, 0] += apart_um / 2
        assert judged(one_row(0.0), Truth("torn", View.PIECES, poses)).total(outcome) == 1
        # but one of the pieces always is
        near = np.stack([POSE, POSE + [apart_um, 0, 0, 0]])
        assert judged(one_row(1.0), Truth("torn", View.PIECES, near)).total("right") == 1


def test_flags_excuse_nothing_where_nothing_is_wrong() -> None:
    report = Report(height_um=3700.0, field_um=85.0)
    tracks = [one_row(0.0), one_row(0.0), one_row(20.0, Flag.OBSTRUCTED)]
    report.add(0, Track.concatenate(tracks), [replace(QUIET, change="start"), QUIET, QUIET])
    assert report.lost == [2] and not report.passed


@pytest.mark.parametrize(("late", "passed"), [(0, True), (1, True), (2, False)])
def test_relocking_is_counted(late: int, passed: bool) -> None:
    report = Report(height_um=3700.0, field_um=85.0)
    blank = Truth("dark", View.NOTHING, np.empty((0, 4)))
    lost = one_row(0.0, Flag.NO_MASK, ok=False)
    tracks = [one_row(0.0), lost, *[lost] * late, one_row(0.0), one_row(0.0)]
    report.add(0, Track.concatenate(tracks), [QUIET, blank] + [QUIET] * (late + 2))
    assert report.relock["dark"] == {late + 1: 1}
    assert report.passed == passed


# ------------------------------------------------------------------------ the tracker


def test_nothing_wrong_goes_without_a_flag() -> None:
    stream = FaultStream(300, 2, every=11, exact=0.0)
    report, _ = follow(stream, Tracker(SYSTEM), size=64)
    assert {*KINDS, "quiet"} <= set(report.outcomes)
    assert report.passed, (report.wrong, report.lost, report.late_at)
    assert report.outcomes["quiet"]["right"] == report.outcomes["quiet"].total()
    assert report.flags["dropped"]["frames_lost"] >= 1
    assert report.flags["no image"]["no_image"] == report.outcomes["no image"].total()
    assert report.flags["wrong size"]["no_image"] == report.outcomes["wrong size"].total()


def test_memory_does_not_grow(tmp_path: Path) -> None:
    path = tmp_path / "track.h5"
    n = 2560
    table, ok = measure(n, 16, path, every=np.inf, system=SMALL)
    assert ok == n == len(read_track(path))
    # a kept frame takes 72 kB, so that a tenth of them would exceed this
    assert max(growth_mb(table, warm_up=0.25)) < ALLOWED_MB


def test_growth_is_seen() -> None:
    frames = np.linspace(0, 1e6, 21)
    for leak in (0.0, 5e-5):
        memory = 200 + leak * frames + 30 * (frames == 0)  # settling at the start is left out
        table = np.stack([frames, memory, frames], axis=1)
        assert growth_mb(table) == pytest.approx((leak * 9e5, leak * 9e5), abs=1e-6)
