"""What is recorded of a channel, and which frames are kept."""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

__all__ = ["RawFrames", "Recording"]


class _Part(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class RawFrames(_Part):
    """Which frames are kept, beside their poses."""

    before_s: float = Field(default=1.0, ge=0, le=60, description="kept before an event")
    after_s: float = Field(default=1.0, ge=0, le=600, description="and after it")
    on: list[Literal["lock_lost", "glitch", "alarm"]] = ["lock_lost"]
    glitch_sigmas: float = Field(default=8.0, ge=3, description="a jump of so many sigma")
    every_s: float | None = Field(default=None, gt=0, description="one frame on schedule")
    most_per_hour: int = Field(default=20, ge=1, description="events whose frames are kept")


class Recording(_Part):
    """How a channel is recorded."""

    enabled: bool = True
    flush_s: float = Field(default=1.0, ge=0, le=10)
    rotate_hours: float = Field(default=1.0, gt=0, le=24 * 7)
    rotate_mib: float = Field(default=1024, ge=1)
    keep_free_mib: float = Field(
        default=500, ge=0, description="recording pauses when the disk has less space left"
    )
    raw: RawFrames = RawFrames()
