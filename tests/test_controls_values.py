"""The table of published values: complete, of use to all three systems, and documented."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import pytest

from rasnik.controls.values import VALUES, Severity, Value, frame_time_s, judge, statuses
from rasnik.live.station import Alarms, ChannelConfig, StationConfig
from rasnik.live.status import ChannelStatus

#: The name is in all names, and the driver's counters differ from camera to camera.
PUBLISHED = sorted({f.name for f in fields(ChannelStatus)} - {"name", "driver_counters"})
PAGE = Path(__file__).resolve().parents[1] / "docs" / "control-systems.md"

#: A channel that runs, all of whose values differ from those of any other.
STATUS = ChannelStatus(
    "one", state="running", message="warm", camera="simulated", locked=True, time_s=1.7e9 + 0.25,
    x_um=4012.345678901234, y_um=5000.1, scale=1.0012, theta_rad=0.002, sigma_x_um=3e-4,
    sigma_y_um=4e-4, sigma_scale=1e-7, sigma_theta_rad=2e-7, chi2_ndf=1.01,
    flags=("frame_lost", "time_gap"), frames=2**40, tracked=90, lost_in_transfer=7,
    lost_by_time=2, dropped=1, reconnects=3, frame_rate_hz=275.0, latency_median_ms=2.5,
    latency_p99_ms=4.5, exposure_us=900.0, gain_db=3.0, saturated_fraction=0.01,
    light_level=200.0, dark_level=20.0, zero_um=(4012.3, 5000.0), zero_scale=1.001,
    zero_theta_rad=0.001, alarms=("x_um",), recording=True, recorded=91,
    recording_file="data/one.h5", recording_message="slow disk",
)  # fmt: skip


@dataclass
class FakeChannel:
    config: ChannelConfig
    tell: Callable[[], ChannelStatus]

    def status(self) -> ChannelStatus:
        return self.tell()


@dataclass
class FakeStation:
    """What the control systems need of a station."""

    config: StationConfig = field(default_factory=StationConfig)
    channels: dict[str, FakeChannel] = field(default_factory=dict)

    def add(self, status: ChannelStatus, alarms: Alarms | None = None) -> None:
        config = ChannelConfig(name=status.name, alarms=alarms or Alarms())
        self.channels[status.name] = FakeChannel(config, lambda: status)

    def add_broken(self, name: str) -> None:
        def fail() -> ChannelStatus:
            raise OSError("no such thing")

        self.channels[name] = FakeChannel(ChannelConfig(name=name), fail)


def value(name: str) -> Value:
    return next(value for value in VALUES if value.name == name)


def test_names_are_unique_and_usable_everywhere() -> None:
    for names in ([v.name for v in VALUES], [v.pv for v in VALUES]):
        assert len(set(names)) == len(names)
    for v in VALUES:
        assert v.name.isidentifier() and v.name == v.name.lower(), v.name
        assert v.pv.isalnum() and v.pv == v.pv.upper(), v.pv
        assert 0 < len(v.description) <= 40, v.name
        assert not v.judged_by or value(v.judged_by).limits(Alarms()) is None


@pytest.mark.parametrize("changed", PUBLISHED)
def test_all_that_a_status_tells_is_published(changed: str) -> None:
    other: Any = getattr(STATUS, changed)
    if isinstance(other, bool):
        other = not other
    elif isinstance(other, str):
        other = "lost"
    elif isinstance(other, tuple):
        other = () if changed != "zero_um" else (1.0, 2.0)
    else:
        other = other + 1
    after = replace(STATUS, **{changed: other})
    assert any(v.read(STATUS) != v.read(after) for v in VALUES)


def test_values_from_zero() -> None:
    assert value("x_rel_nm").read(STATUS) == pytest.approx(45.678901234, abs=1e-8)
    assert value("y_rel_nm").read(STATUS) == pytest.approx(100.0, abs=1e-8)
    assert value("scale_rel_ppm").read(STATUS) == pytest.approx(0.0002 / 1.001 * 1e6)
    assert value("theta_rel_mrad").read(STATUS) == pytest.approx(1.0)
    assert value("saturated_percent").read(STATUS) == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("alarms", "bad"),
    [
        (Alarms(x_um=(-0.04, 0.04)), {"x_um", "x_rel_nm"}),
        (Alarms(x_um=(-0.05, 0.05)), set()),
        (Alarms(y_um=(-0.2, 0.09)), {"y_um", "y_rel_nm"}),
        (Alarms(scale=(1.0, 1.001)), {"scale", "scale_rel_ppm"}),
        (Alarms(theta_mrad=(1.5, 1.9)), {"theta_rad", "theta_rel_mrad"}),
        (Alarms(chi2_ndf=(0.5, 1.0)), {"chi2_ndf"}),
        (Alarms(frame_rate_hz=(300.0, 400.0)), {"frame_rate_hz"}),
    ],
)
def test_beyond_limits_is_major(alarms: Alarms, bad: set[str]) -> None:
    assert {
        v.name for v in VALUES if v.kind == "float" and judge(v, STATUS, alarms) == Severity.MAJOR
    } == bad


@pytest.mark.parametrize("change", [{"locked": False}, {"state": "lost"}, {"state": "ended"}])
def test_what_is_not_of_now_is_invalid(change: dict[str, Any]) -> None:
    status = replace(STATUS, **change)
    for v in VALUES:
        expected = Severity.INVALID if v.measured else Severity.OK
        if v.kind == "float":
            assert judge(v, status, Alarms(x_um=(0.0, 0.1))) == expected, v.name
    assert judge(value("locked"), replace(STATUS, locked=False), Alarms()) == Severity.MAJOR


def test_what_is_not_known_is_invalid() -> None:
    status = replace(STATUS, gain_db=math.nan)
    assert judge(value("gain_db"), status, Alarms()) == Severity.INVALID
    assert judge(value("exposure_us"), status, Alarms()) == Severity.OK


def test_states_and_alarms_are_judged() -> None:
    for state, severity in (("running", 0), ("starting", 1), ("lost", 2), ("failed", 2)):
        assert judge(value("state"), replace(STATUS, state=state), Alarms()) == severity
    for name in ("alarm", "alarms"):
        assert judge(value(name), STATUS, Alarms()) == Severity.MAJOR
        assert judge(value(name), replace(STATUS, alarms=()), Alarms()) == Severity.OK


def test_a_channel_that_fails_does_not_hide_the_others() -> None:
    station = FakeStation()
    station.add_broken("bad")
    station.add(STATUS)
    found = statuses(station)
    assert found["one"] is STATUS
    assert found["bad"].state == "failed" and "no such thing" in found["bad"].message


def test_time_is_of_the_frame_if_it_is_of_a_clock() -> None:
    assert frame_time_s(STATUS) == STATUS.time_s
    for no_clock in (math.nan, 12.5):
        assert frame_time_s(replace(STATUS, time_s=no_clock)) > 1.7e9


@pytest.mark.skipif(not PAGE.exists(), reason="the page is not beside the tests")
def test_the_page_lists_them_all() -> None:
    rows = [f"| `{v.name}` | `{v.pv}` | {v.unit} | {v.kind} | {v.description} |" for v in VALUES]
    lines = PAGE.read_text(encoding="utf-8").splitlines()
    assert [line for line in lines if line.startswith("| `") and line.count("|") == 6] == rows
