"""What tracking yields: one row of numbers for every frame, held as arrays."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rasnik.analysis.flags import FLAGS, Flag
from rasnik.analysis.pose import Pose

__all__ = ["POSE_COLUMNS", "TRACK_COLUMNS", "Track", "TrackColumn"]

_FATAL = sum(info.flag for info in FLAGS if info.fatal)


@dataclass(frozen=True)
class TrackColumn:
    """One column of a track: its type on disk, its unit and its meaning."""

    name: str
    dtype: str
    unit: str
    description: str


TRACK_COLUMNS: tuple[TrackColumn, ...] = (
    TrackColumn("frame", "i8", "", "number of the frame in its source, from 0"),
    TrackColumn(
        "time_s", "f8", "s", "time of the frame; NaN if neither times nor a rate are known"
    ),
    TrackColumn("x_um", "f8", "um", "mask x imaged on the sensor's centre"),
    TrackColumn("y_um", "f8", "um", "mask y imaged on the sensor's centre"),
    TrackColumn("scale", "f8", "", "image size / mask size"),
    TrackColumn("theta_rad", "f8", "rad", "rotation, anticlockwise as seen on the image"),
    TrackColumn("sigma_x_um", "f8", "um", "standard deviation of x_um"),
    TrackColumn("sigma_y_um", "f8", "um", "standard deviation of y_um"),
    TrackColumn("sigma_scale", "f8", "", "standard deviation of scale"),
    TrackColumn("sigma_theta_rad", "f8", "rad", "standard deviation of theta_rad"),
    TrackColumn("chi2_ndf", "f8", "", "chi-square per degree of freedom"),
    TrackColumn("blur_um", "f8", "um", "Gaussian sigma of the blur on the sensor"),
    TrackColumn("dark_level", "f8", "grey", "grey level of black at the centre"),
    TrackColumn("light_level", "f8", "grey", "grey level of white at the centre"),
    TrackColumn("flags", "u4", "", "conditions met, see the table of flags"),
)

_TYPES = {column.name: np.dtype(column.dtype) for column in TRACK_COLUMNS}
#: Those that are attributes of a pose.
POSE_COLUMNS = tuple(
    column.name for column in TRACK_COLUMNS if column.name not in ("frame", "time_s", "flags")
)


def _empty() -> NDArray[Any]:
    return np.empty(0)


@dataclass(frozen=True, eq=False)
class Track:
    """Poses of a sequence of frames; every array has one value for each frame.

    Frames without a position have NaN and flags that say why. Uncertainties are one
    standard deviation from pixel noise, as in `rasnik.Pose`.

    Attributes
    ----------
    frame : ndarray of int64
        Number of the frame in its source, from 0. Numbers that are left out are frames that
        never arrived.
    time_s : ndarray
        NaN where it is not known.
    x_um, y_um, scale, theta_rad : ndarray
    sigma_x_um, sigma_y_um, sigma_scale, sigma_theta_rad : ndarray
    chi2_ndf : ndarray
    blur_um, dark_level, light_level : ndarray
        Blur on the sensor (um) and grey levels of black and white at the centre.
    flags : ndarray of uint32
        Bits of `rasnik.Flag`.
    metadata : dict
        What is known of the track as a whole: software, system, source.
    """

    frame: NDArray[np.int64] = field(default_factory=_empty)
    time_s: NDArray[np.float64] = field(default_factory=_empty)
    x_um: NDArray[np.float64] = field(default_factory=_empty)
    y_um: NDArray[np.float64] = field(default_factory=_empty)
    scale: NDArray[np.float64] = field(default_factory=_empty)
    theta_rad: NDArray[np.float64] = field(default_factory=_empty)
    sigma_x_um: NDArray[np.float64] = field(default_factory=_empty)
    sigma_y_um: NDArray[np.float64] = field(default_factory=_empty)
    sigma_scale: NDArray[np.float64] = field(default_factory=_empty)
    sigma_theta_rad: NDArray[np.float64] = field(default_factory=_empty)
    chi2_ndf: NDArray[np.float64] = field(default_factory=_empty)
    blur_um: NDArray[np.float64] = field(default_factory=_empty)
    dark_level: NDArray[np.float64] = field(default_factory=_empty)
    light_level: NDArray[np.float64] = field(default_factory=_empty)
    flags: NDArray[np.uint32] = field(default_factory=_empty)
    metadata: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name, dtype in _TYPES.items():
            object.__setattr__(self, name, np.asarray(getattr(self, name), dtype=dtype))
        lengths = {name: len(getattr(self, name)) for name in _TYPES}
        if len(set(lengths.values())) > 1:
            raise ValueError(f"the arrays of a track must be of one length, not {lengths}")

    def __len__(self) -> int:
        return len(self.frame)

    def __getitem__(self, index: slice | NDArray[Any]) -> Track:
        """The rows of a slice, a boolean array, or an array of indices."""
        if isinstance(index, int | np.integer):
            raise TypeError("a track is indexed with slices and arrays; use track[i : i + 1]")
        columns: dict[str, Any] = {name: getattr(self, name)[index] for name in _TYPES}
        return Track(**columns, metadata=self.metadata)

    @property
    def ok(self) -> NDArray[np.bool_]:
        """Where there is a position, shape (n,)."""
        ok: NDArray[np.bool_] = np.isfinite(self.x_um) & (self.flags & np.uint32(_FATAL) == 0)
        return ok

    @property
    def frame_rate_hz(self) -> float:
        """Median rate between frames with successive numbers; NaN without times."""
        step = np.diff(self.time_s)[np.diff(self.frame) == 1]
        step = step[step > 0]
        return float(1 / np.median(step)) if len(step) else float("nan")

    def count(self, flag: Flag) -> int:
        """Number of frames that carry a flag."""
        return int(np.count_nonzero(self.flags & np.uint32(flag)))

    def as_dict(self) -> dict[str, NDArray[Any]]:
        """The arrays by name, in the order of `TRACK_COLUMNS`."""
        return {name: getattr(self, name) for name in _TYPES}

    @classmethod
    def from_poses(
        cls,
        poses: Iterable[Pose],
        frame: Iterable[int] | None = None,
        time_s: Iterable[float] | None = None,
    ) -> Track:
        """Gather single poses; frames are numbered from 0 by default, times unknown."""
        poses = list(poses)
        rows: dict[str, Any] = {
            name: np.array([getattr(pose, name) for pose in poses], dtype=float)
            for name in POSE_COLUMNS
        }
        return cls(
            frame=np.array(list(frame) if frame is not None else range(len(poses)), dtype=np.int64),
            time_s=np.array(list(time_s) if time_s is not None else [np.nan] * len(poses)),
            flags=np.array([int(pose.flags) for pose in poses], dtype=np.uint32),
            **rows,
        )

    @classmethod
    def concatenate(cls, tracks: Iterable[Track]) -> Track:
        """One track after the other; the metadata is that of the first."""
        tracks = list(tracks)
        if not tracks:
            return cls()
        columns: dict[str, Any] = {
            name: np.concatenate([getattr(t, name) for t in tracks]) for name in _TYPES
        }
        return cls(**columns, metadata=tracks[0].metadata)


assert {f.name for f in fields(Track)} == {*_TYPES, "metadata"}
