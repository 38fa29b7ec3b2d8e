"""The page in a process of its own: what it is told, what it does, what becomes of it."""

import os
import pickle
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from multiprocessing import Pipe
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("uvicorn", reason="the page's packages are not installed")
pytest.importorskip("websockets", reason="the page's packages are not installed")
httpx = pytest.importorskip("httpx", reason="the page is asked with httpx")
if os.name != "posix":
    pytest.skip("sockets are handed to a process", allow_module_level=True)

from _web_station import FakeChannel, fake_station  # noqa: E402
from rasnik.analysis.pose import Pose  # noqa: E402
from rasnik.cameras.camera import CameraFrame, SettingRefusedError  # noqa: E402
from rasnik.io import read_track  # noqa: E402
from rasnik.live.recent import Recent  # noqa: E402
from rasnik.live.service import Station  # noqa: E402
from rasnik.live.station import CameraConfig, ChannelConfig, Server, StationConfig  # noqa: E402
from rasnik.recording.sample import Sample  # noqa: E402
from rasnik.web import process  # noqa: E402
from rasnik.web.line import Answers, Line, StationGoneError  # noqa: E402
from rasnik.web.process import PageProcess  # noqa: E402
from rasnik.web.remote import ChannelPlan, Plan, RemoteStation  # noqa: E402
from rasnik.web.server import PageError  # noqa: E402

WRITE = {"X-Rasnik": "1"}
LONGEST_S = 30.0


def until(happened: Callable[[], Any], what: str) -> None:
    end = time.monotonic() + LONGEST_S
    while not happened():
        assert time.monotonic() < end, what
        time.sleep(0.05)


def answers(url: str) -> bool:
    try:
        return bool(httpx.get(url + "health", timeout=LONGEST_S).json()["ok"])
    except httpx.TransportError:
        return False


def is_there(pid: int) -> bool:
    """Whether a process runs; one that has ended and was not asked how does not."""
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return False
    return state != "Z"


# ------------------------------------------------------------------------ the line


def line_to(station: Any) -> Line:
    here, there = Pipe()
    threading.Thread(target=Answers(station).serve, args=(here,), daemon=True).start()
    return Line(there)


def remote_of(station: Any) -> RemoteStation:
    """The same in this process, over the same lines."""
    channels = {
        name: ChannelPlan(channel.config, channel.system, channel.recorder.folder)
        for name, channel in station.channels.items()
    }
    plan = Plan(station.config, channels, None)
    assert pickle.loads(pickle.dumps(plan)).config == station.config
    return RemoteStation(plan, line_to(station), line_to(station))


@pytest.fixture
def station(tmp_path: Path) -> Any:
    made = fake_station(tmp_path, ("top", "side"))
    for channel in made.channels.values():
        for k in range(300):
            channel.frame(1_790_000_000 + k / channel.rate_hz)
    return made


def test_rows_follow(station: Any) -> None:
    channel, remote = station.channels["top"], remote_of(station).channels["top"]
    assert remote.recent.count == 300
    assert remote.recent.since(0)[0].tobytes() == channel.recent.since(0)[0].tobytes()
    channel.frame(1_790_000_010.0)
    until(lambda: remote.recent.count == 301, "the new row comes")
    assert remote.recent.since(290)[0].tobytes() == channel.recent.since(290)[0].tobytes()
    assert remote.recent.since(301)[1] == 301


@pytest.mark.parametrize("missed", [3, 70, 64, 1000])
def test_a_ring_that_follows_another_is_the_same(missed: int, rng: np.random.Generator) -> None:
    """However many rows were missed, and wherever the ends of the rings are."""
    first, second = Recent(rows=64), Recent(rows=64)
    frame = CameraFrame(np.zeros((2, 2), np.uint8), 1, 0.0, 0.0)
    at = 0
    for count in (40, missed, 17):
        for _ in range(count):
            first.add(Sample(frame, first.count, Pose()), rng.normal(), 0.0)
        while True:
            rows, at = first.since(at, 16)
            second.extend(rows, at)
            if len(rows) < 16:
                break
        assert first.since(0)[0].tobytes() == second.since(0)[0].tobytes()
        assert first.count == second.count == at


def test_frames_and_poses_arrive_whole_and_once(station: Any, monkeypatch: Any) -> None:
    channel, remote = station.channels["top"], remote_of(station).channels["top"]
    first, known = remote.latest(), channel.latest()
    assert first.number == known.number and first.frame.host_time_s == known.frame.host_time_s
    assert np.array_equal(first.frame.image, known.frame.image)
    assert np.array_equal(first.pose.covariance, known.pose.covariance)
    assert first.pose.projection.to_mask(1.0, 2.0) == known.pose.projection.to_mask(1.0, 2.0)
    time.sleep(0.03)
    assert remote.latest() is first  # nothing is sent twice
    channel.frame()
    until(lambda: remote.latest().number == 300, "the new frame comes")


def test_no_frame_yet(tmp_path: Path) -> None:
    assert remote_of(fake_station(tmp_path, ("one",))).channels["one"].latest() is None


def test_a_status_is_not_asked_for_more_often_than_shown(station: Any, monkeypatch: Any) -> None:
    asked = []
    status = FakeChannel.status
    monkeypatch.setattr(FakeChannel, "status", lambda self: asked.append(1) or status(self))
    remote = remote_of(station)
    start = time.monotonic()
    for _ in range(200):
        for channel in remote.channels.values():
            assert channel.status().frames == 300
    assert len(asked) <= 2 * (1 + (time.monotonic() - start) / 0.1)


def test_what_was_changed_is_seen_at_once(station: Any) -> None:
    remote = remote_of(station).channels["side"]
    for recording in (True, False, True):
        (remote.start_recording if recording else remote.stop_recording)()
        assert remote.status().recording is recording
    remote.set_exposure(750.0)
    assert remote.status().exposure_us == 750.0
    remote.zero()
    assert remote.status().zero_um[0] == pytest.approx(4000, abs=1)
    remote.clear_zero()
    assert remote.status().zero_um == (0.0, 0.0)
    remote.keep_exposure(True)
    assert station.channels["side"].actions == [("keep_exposure", True)]
    assert remote.snapshot().read_bytes() == b"a picture"


def test_the_newest_rows_are_read_by_who_writes_them(station: Any) -> None:
    remote = remote_of(station).channels["top"]
    now = time.time()
    assert remote.history(now - 5, now, 8)["count"].sum() == 8  # the fake one knows no files
    assert remote.history(now - 15, now - 10, 8)["count"].sum() == 0  # which are read here
    assert remote.history(now - 3600, now, 8)["count"].sum() == 0


class _OddError(ValueError):
    """Cannot be made again from what it keeps."""

    def __init__(self, one: str, two: str) -> None:
        super().__init__(f"{one} {two}")


@pytest.mark.parametrize(
    ("error", "kind"),
    [
        (SettingRefusedError("The camera cannot."), SettingRefusedError),
        (ValueError("No position."), ValueError),
        (OSError(28, "No space left on device"), OSError),
        (_OddError("No", "way."), ValueError),
    ],
)
def test_errors_come_back_as_themselves(
    station: Any, monkeypatch: Any, error: Exception, kind: type[Exception]
) -> None:
    def fail() -> None:
        raise error

    monkeypatch.setattr(station.channels["top"], "zero", fail)
    with pytest.raises(kind) as raised:
        remote_of(station).channels["top"].zero()
    assert str(raised.value) == str(error)


@pytest.mark.parametrize("question", ["stop", "__class__", "_track", "recorder"])
def test_nothing_else_can_be_asked(station: Any, question: str) -> None:
    line = line_to(station)
    with pytest.raises(RuntimeError, match="its log says why"):
        line.ask(question, "top")
    assert line.ask("rows", "top", 300)[1] == 300  # the line goes on


def test_a_slow_action_holds_nothing_up(station: Any, monkeypatch: Any) -> None:
    going_on = threading.Event()
    monkeypatch.setattr(station.channels["top"], "stop_recording", going_on.wait)
    remote = remote_of(station).channels["top"]
    waiting = threading.Thread(target=remote.stop_recording)
    waiting.start()
    assert remote.recent.count == 300 and remote.status().frames == 300
    assert waiting.is_alive()
    going_on.set()
    waiting.join(LONGEST_S)
    assert not waiting.is_alive()


def test_a_station_that_is_gone_is_no_trouble_with_the_disk() -> None:
    here, there = Pipe()
    here.close()
    with pytest.raises(StationGoneError):
        Line(there).ask("statuses")
    assert not issubclass(StationGoneError, OSError | ValueError)


# ------------------------------------------------------------------------ the process


@pytest.fixture(scope="module")
def real(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Station]:
    """A station that records a simulated camera."""
    channel = ChannelConfig(name="one", camera=CameraConfig(frame_rate_hz=50))
    config = StationConfig(folder=tmp_path_factory.mktemp("station"), channel=[channel])
    with Station(config) as made:
        until(lambda: made.channels["one"].status().locked, "the mask is found")
        yield made


@pytest.fixture(scope="module")
def page(real: Station) -> Iterator[PageProcess]:
    with PageProcess(real, Server(port=0)) as made:
        yield made


def test_it_serves_what_the_station_measures(real: Station, page: PageProcess) -> None:
    assert page.pid not in (None, os.getpid())
    found = httpx.get(page.url + "api/channels/one").json()
    assert found["state"] == "running" and found["locked"]
    assert found["keep_exposure"] is False
    rows = httpx.get(page.url + "api/channels/one/rows?since=0").json()
    known, _ = real.channels["one"].recent.since(0)
    assert rows["rows"]["x_um"][:20] == known["x_um"][:20].tolist()
    assert httpx.get(page.url + "api/channels/one/image").content.startswith(b"\x89PNG")
    assert "rasnik" in httpx.get(page.url).text


def test_it_reads_the_record_while_that_is_written(real: Station, page: PageProcess) -> None:
    channel = real.channels["one"]
    until(lambda: channel.status().recorded > 100, "rows are recorded")
    file = Path(channel.status().recording_file)
    time_s = read_track(file).time_s
    start, end = time_s[20], time_s[80]
    query = f"history?start={start}&end={end}&points=40"
    found = httpx.get(page.url + f"api/channels/one/{query}").json()
    here = channel.history(start, end, 40)
    kept = np.isfinite(here["x_um_mean"])
    there = np.array(found["x_nm_mean"], dtype=float)
    assert kept.sum() > 10 and len(there) >= kept.sum()
    assert there[np.isfinite(there)] == pytest.approx(1e3 * here["x_um_mean"][kept], rel=1e-12)


def test_actions_reach_the_station(real: Station, page: PageProcess) -> None:
    channel = real.channels["one"]
    with httpx.Client(base_url=page.url, headers=WRITE, timeout=LONGEST_S) as client:
        saved = client.post("/api/channels/one/snapshot").json()["file"]
        assert Path(saved).stat().st_size > 1000
        answer = client.post("/api/channels/one/exposure", json={"exposure_us": 9e6})
        assert answer.status_code == 409 and "exposure" in answer.json()["error"]
        assert client.post("/api/channels/one/stop-recording").json()["recording"] is False
        assert not channel.status().recording
        assert client.post("/api/channels/one/start-recording").json()["recording"] is True
        assert client.post("/api/channels/one/zero").json()["zero_um"] != [0.0, 0.0]
        client.post("/api/channels/one/clear-zero")
        assert channel.status().zero_um == (0.0, 0.0)


def test_other_programs_go_before_it(page: PageProcess) -> None:
    assert page.pid is not None
    assert os.getpriority(os.PRIO_PROCESS, page.pid) >= 5
    if sys.platform == "linux":
        assert os.sched_getscheduler(page.pid) == os.SCHED_OTHER


def test_it_is_started_again_at_its_address(
    real: Station, page: PageProcess, caplog: pytest.LogCaptureFixture
) -> None:
    before, tracked = page.pid, real.channels["one"].status().tracked
    assert before is not None
    os.kill(before, signal.SIGKILL)
    until(lambda: page.pid not in (None, before), "another one is begun")
    assert answers(page.url)
    assert "The page has ended (signal 9) and is started again" in caplog.text
    until(lambda: page.message == "", "all is well")
    assert real.channels["one"].status().tracked > tracked


def test_it_is_not_started_again_for_ever(station: Any, monkeypatch: Any) -> None:
    monkeypatch.setattr(process, "_FIRST_WAIT_S", 0.01)
    monkeypatch.setattr(process, "_MOST_STARTS", 3)
    began: list[int] = []
    child = process._Child

    def brief(*arguments: Any) -> Any:
        made = child(*arguments)
        began.append(made.process.pid)
        if len(began) > 1:
            made.process.kill()
        return made

    monkeypatch.setattr(process, "_Child", brief)
    with PageProcess(station, Server(port=0)) as page:
        os.kill(began[0], signal.SIGKILL)
        until(lambda: "stays off" in page.message, "it gives up")
        assert len(began) == 3
        with pytest.raises(httpx.TransportError):
            httpx.get(page.url)


def test_it_ends_with_its_connections(station: Any) -> None:
    def threads() -> int:
        return sum(thread.name.startswith("page") for thread in threading.enumerate())

    before = threads()
    page = PageProcess(station, Server(port=0))
    page.start()
    pid = page.pid
    assert pid is not None and answers(page.url)
    assert threads() > before
    start = time.monotonic()
    page.stop()
    page.stop()  # harmless
    assert time.monotonic() - start < 8
    assert not is_there(pid)
    until(lambda: threads() == before, "threads end")


def test_a_service_that_ends_both_at_once_says_nothing(
    station: Any, caplog: pytest.LogCaptureFixture
) -> None:
    """systemd sends its signal to all processes."""
    with PageProcess(station, Server(port=0)) as page:
        pid = page.pid
        assert pid is not None
        os.kill(pid, signal.SIGTERM)
        os.kill(pid, signal.SIGINT)  # of a terminal
        until(lambda: not is_there(pid), "the page ends")
    assert page.message == caplog.text == ""


def test_what_is_missing_is_said(station: Any, tmp_path: Path, monkeypatch: Any) -> None:
    """The sentence of the process is that of a page in this one."""
    (tmp_path / "uvicorn.py").write_text("raise ModuleNotFoundError('gone', name='uvicorn')")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(PageError, match=r"needs uvicorn; install it with: pip install 'rasnik"):
        PageProcess(station, Server(port=0)).start()


def test_a_start_that_fails_is_said(station: Any, monkeypatch: Any) -> None:
    monkeypatch.setattr(sys, "executable", "/bin/false")
    with pytest.raises(PageError, match="ended at its start .exit status 1."):
        PageProcess(station, Server(port=0)).start()
    monkeypatch.setattr(sys, "executable", "/no/such/python")
    with pytest.raises(PageError, match="cannot be started"):
        PageProcess(station, Server(port=0)).start()


STATION = """
import sys, time
from pathlib import Path
sys.path.insert(0, {tests!r})
from _web_station import fake_station
from rasnik.live.station import Server
from rasnik.web.process import PageProcess
page = PageProcess(fake_station(Path({folder!r}), ("one",)), Server(port=0))
page.start()
print(page.pid, page.url, flush=True)
time.sleep(600)
"""


def test_a_station_that_is_killed_takes_its_page_along(tmp_path: Path) -> None:
    code = STATION.format(tests=str(Path(__file__).parent), folder=str(tmp_path))
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True) as made:
        assert made.stdout is not None
        try:
            pid, url = made.stdout.readline().split()
            assert answers(url) and is_there(int(pid))
        finally:
            made.kill()
        until(lambda: not is_there(int(pid)), "the page ends")


def test_a_page_without_answers_is_begun_anew(
    station: Any, monkeypatch: Any, caplog: pytest.LogCaptureFixture
) -> None:
    """Its process would answer all that is asked with an error, for ever."""
    monkeypatch.setattr(process, "_END_S", 0.5)
    monkeypatch.setattr(process, "_FIRST_WAIT_S", 0.01)
    unsendable = threading.Lock()
    with PageProcess(station, Server(port=0)) as page:
        before = page.pid
        monkeypatch.setattr(Answers, "_answer", lambda *_: (True, unsendable))
        httpx.get(page.url + "health")
        until(lambda: page.pid not in (None, before), "another one is begun")
        monkeypatch.undo()
        until(lambda: page.message == "", "all is well")
        assert httpx.get(page.url + "health").json()["ok"] is True
    assert "The page has ended" in caplog.text
