"""Images of the paper's instruments, and positions from many of them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import NDArray

from rasnik.analysis.analyse import analyse
from rasnik.analysis.pose import Pose
from rasnik.imaging.noise import ReadOut
from rasnik.instrument import System, load_system
from rasnik.performance.coupling import coupled
from rasnik.tracking.track import Track
from rasnik.tracking.tracker import Tracker

__all__ = [
    "POSITION_UM",
    "by_fourier",
    "by_likelihood",
    "errors_nm",
    "noisy",
    "show_image",
    "solidras",
    "stream",
]

#: Where the paper simulates SolidRas.
POSITION_UM = (4000.0, 5000.0)


def solidras(*, light: float = 1.0, **sensor: Any) -> System:
    """SolidRas with this part of its light, and with values of its sensor replaced."""
    system = coupled(load_system("solidras"), {"sensor.light_factor": light})
    return load_system(system, {f"sensor.{name}": value for name, value in sensor.items()})


def stream(effort_seed: int, *key: int) -> np.random.Generator:
    """Random numbers of one purpose, the same in every run of this seed."""
    return np.random.Generator(np.random.SFC64(np.random.SeedSequence([effort_seed, *key])))


def noisy(
    expected: NDArray[np.float64], system: System, count: int, rng: np.random.Generator
) -> Iterator[NDArray[Any]]:
    """Frames of a still scene, noise and rounding as the system has them."""
    readout = ReadOut(expected, system)
    for _ in range(count):
        yield readout.frame(rng)


def by_likelihood(frames: Iterable[NDArray[Any]], system: System) -> Track:
    """The track of frames, all of which show the mask."""
    track = Tracker(system, orientation=4, model="similarity").run(frames)
    if not track.ok.all():
        raise RuntimeError(f"{int((~track.ok).sum())} of {len(track)} frames have no position")
    return track


def by_fourier(frames: Iterable[NDArray[Any]], system: System) -> Track:
    """The same by the phases of the spectrum, frame by frame."""
    poses = [analyse(frame, system, orientation=4, method="fourier") for frame in frames]
    return _all_found(poses)


def _all_found(poses: list[Pose]) -> Track:
    for pose in poses:
        if not pose.ok:
            raise RuntimeError(f"a frame has no position: {pose.error}")
    return Track.from_poses(poses)


def errors_nm(track: Track, x_um: Any, y_um: Any) -> NDArray[np.float64]:
    """Position minus truth in nm, shape (n, 2)."""
    return 1e3 * np.stack([track.x_um - x_um, track.y_um - y_um], axis=1)


def show_image(axes: Axes, image: NDArray[Any], title: str = "", full_scale: float = 255) -> None:
    """An image in grey, as the sensor hands it out: row 0 at the top."""
    axes.imshow(image, cmap="gray", vmin=0, vmax=full_scale, interpolation="nearest")
    axes.set_title(title)
    axes.set_xlabel("column, pixels")
    axes.set_ylabel("row, pixels")
