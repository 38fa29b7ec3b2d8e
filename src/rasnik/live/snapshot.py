"""One frame and its pose as two files that any program reads."""

from __future__ import annotations

import json
import math
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from rasnik.instrument import System
from rasnik.recording.disk import new_name
from rasnik.recording.sample import Sample

__all__ = ["save_snapshot"]


def save_snapshot(folder: Path, channel: str, system: System, sample: Sample) -> Path:
    """Write a frame as PNG, or TIFF where it has more than 8 bits, and its pose as JSON.

    Returns
    -------
    Path
        Of the image; the other file differs in its suffix.
    """
    folder.mkdir(parents=True, exist_ok=True)
    frame = sample.frame
    suffix = ".png" if frame.image.dtype.itemsize == 1 else ".tif"
    path = new_name(folder, channel, frame.host_time_s, suffix)
    if suffix == ".png":
        from PIL import Image

        Image.fromarray(frame.image).save(path)
    else:
        import tifffile

        tifffile.imwrite(path, frame.image, photometric="minisblack", metadata=None)
    about = {
        "channel": channel,
        "system": system.name,
        "image": path.name,
        "number": sample.number,
        "camera_number": frame.number,
        "time_utc": datetime.fromtimestamp(frame.host_time_s, UTC).isoformat(),
        "host_time_s": frame.host_time_s,
        "device_time_s": frame.device_time_s,
        "exposure_us": frame.exposure_us,
        "gain_db": frame.gain_db,
        **sample.pose.as_dict(),
    }
    text = json.dumps({name: _plain(value) for name, value in about.items()}, indent=1)
    path.with_suffix(".json").write_text(text + "\n", encoding="utf-8")
    return path


def _plain(value: Any) -> Any:
    return None if isinstance(value, float) and not math.isfinite(value) else value
