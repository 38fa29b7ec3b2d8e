"""The page in a browser, over a real station with a simulated camera."""

import os
import socket
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest

pytest.importorskip("uvicorn", reason="the page's packages are not installed")
pytest.importorskip("websockets", reason="the page's packages are not installed")
playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")

from rasnik.live.service import Station  # noqa: E402
from rasnik.live.station import (  # noqa: E402
    Alarms,
    CameraConfig,
    ChannelConfig,
    Server,
    StationConfig,
)
from rasnik.recording.options import Recording  # noqa: E402
from rasnik.web.process import page_of  # noqa: E402

CHROMIUM = Path("/usr/bin/chromium")
if not CHROMIUM.exists():
    pytest.skip(f"there is no {CHROMIUM}", allow_module_level=True)

TOKEN = "a-token-of-more-than-16-letters"
WAIT_MS = 15_000


def until(page: Any, expression: str) -> None:
    """Wait until an expression holds; the page's policy does not let it wait by itself."""
    end = time.monotonic() + WAIT_MS / 1000
    while not page.evaluate(expression):
        assert time.monotonic() < end, expression
        page.wait_for_timeout(50)


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with playwright.sync_playwright() as started:
        made = started.chromium.launch(executable_path=str(CHROMIUM), args=["--no-sandbox"])
        yield made
        made.close()


@pytest.fixture(scope="module")
def station(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Station]:
    """Two channels at few frames a second; the second is beyond its limits."""
    camera = CameraConfig(frame_rate_hz=50)
    recording = Recording(enabled=False, keep_free_mib=0)
    config = StationConfig(
        name="bench",
        folder=tmp_path_factory.mktemp("station"),
        channel=[
            ChannelConfig(name="top", camera=camera, recording=recording),
            ChannelConfig(
                name="side",
                camera=CameraConfig(frame_rate_hz=10),
                recording=recording,
                alarms=Alarms(frame_rate_hz=(500.0, 1000.0)),
            ),
        ],
    )
    with Station(config) as made:
        yield made


@pytest.fixture(scope="module")
def url(station: Station) -> Iterator[str]:
    with page_of(station, Server(port=0)) as server:
        yield server.url


@pytest.fixture
def page(browser: Any, url: str) -> Iterator[Any]:
    """The page of the first channel; whatever it asks for or complains of is kept."""
    made = browser.new_page(viewport={"width": 1400, "height": 1000})
    made.asked, made.complaints = [], []
    made.on("request", lambda request: made.asked.append(request.url))
    made.on("websocket", lambda line: made.asked.append(line.url))
    made.on("pageerror", lambda error: made.complaints.append(str(error)))
    made.on("console", lambda line: made.complaints.append(line.text))
    made.goto(url + "#top")
    until(made, "window.rasnik?.updates.curves > 3 && rasnik.updates.image > 3")
    yield made
    made.close()


def picture_of(page: Any, selector: str) -> str:
    return str(page.evaluate(f"document.querySelector({selector!r}).toDataURL()"))


def test_the_page_loads_and_asks_nobody_else(page: Any, url: str) -> None:
    assert page.title().endswith("rasnik")
    assert page.locator("#station").inner_text() == "bench"
    assert page.locator("nav .name").all_inner_texts() == ["top", "side"]
    page.get_by_role("button", name="S", exact=True).click()
    own = urlsplit(url).netloc
    asked = {urlsplit(address).netloc for address in page.asked if address[:5] != "blob:"}
    assert asked == {own}
    assert any(address.endswith("/ws") for address in page.asked)
    assert page.complaints == []


def test_curves_and_image_move(page: Any) -> None:
    curve, image = '.plot[data-key="x_nm"] canvas', "#image"
    before = picture_of(page, curve), picture_of(page, image)
    done = page.evaluate("({...rasnik.updates})")
    page.wait_for_timeout(1500)
    assert picture_of(page, curve) != before[0]
    assert picture_of(page, image) != before[1]
    after = page.evaluate("({...rasnik.updates})")
    assert after["curves"] > done["curves"] + 3 and after["image"] > done["image"] + 3


def test_readouts_are_those_of_the_channel(page: Any, station: Station) -> None:
    page.get_by_role("button", name="Clear zero").click()
    until(
        page,
        "document.querySelector('.readout[data-key=y_nm] small').textContent.includes('origin')",
    )
    text = page.locator('.readout[data-key="y_nm"] output').inner_text()
    shown_nm = float("".join(c for c in text.replace("−", "-") if c in "-.0123456789"))
    status = station.channels["top"].status()
    motion_nm = 1e3 * 2 * station.channels["top"].config.camera.motion_um
    assert shown_nm == pytest.approx(1e3 * status.y_um, abs=motion_nm)
    page.get_by_role("button", name="Zero here").click()
    page.get_by_text("from the zero").first.wait_for(timeout=WAIT_MS)
    text = page.locator('.readout[data-key="y_nm"] output').inner_text()
    zeroed_nm = float("".join(c for c in text.replace("−", "-") if c in "-.0123456789"))
    assert abs(zeroed_nm) < motion_nm
    page.get_by_role("button", name="Clear zero").click()


def test_recording_starts_and_stops_and_is_looked_back_into(page: Any, station: Station) -> None:
    channel = station.channels["top"]
    assert not channel.status().recording
    page.get_by_role("button", name="Start recording").click()
    page.get_by_role("button", name="Stop recording").wait_for(timeout=WAIT_MS)
    assert channel.status().recording
    page.wait_for_timeout(2500)
    plot = page.locator('.plot[data-key="x_nm"] .u-over')
    box = plot.bounding_box()
    page.mouse.move(box["x"] + 0.95 * box["width"], box["y"] + 40)
    page.mouse.down()
    page.mouse.move(box["x"] + 0.99 * box["width"], box["y"] + 40, steps=4)
    with page.expect_response("**/history?**", timeout=WAIT_MS) as answered:
        page.mouse.up()
    found = answered.value.json()
    assert len(found["time_s"]) > 10
    assert "From the record" in page.locator("#range").inner_text()
    page.get_by_role("button", name="Back").click()
    page.get_by_role("button", name="Stop recording").click()
    page.get_by_role("button", name="Start recording").wait_for(timeout=WAIT_MS)
    status = channel.status()
    assert not status.recording and status.recorded > 50
    assert page.complaints == []


def test_a_snapshot_and_the_exposure(page: Any, station: Station) -> None:
    page.get_by_role("button", name="Save snapshot").click()
    page.get_by_text("Saved as").wait_for(timeout=WAIT_MS)
    saved = Path(page.locator("#notice").inner_text().removeprefix("Saved as ").strip())
    assert saved.stat().st_size > 10_000
    page.locator("#exposure").fill("1500")
    page.get_by_role("button", name="Set").click()
    page.get_by_text("Exposure set to 1500").wait_for(timeout=WAIT_MS)
    end = time.monotonic() + WAIT_MS / 1000
    while station.channels["top"].status().exposure_us != pytest.approx(1500, rel=0.01):
        assert time.monotonic() < end, "frames with the new exposure do not come"
        page.wait_for_timeout(100)


def test_an_alarm_shows_in_words_and_colour(page: Any) -> None:
    alarm = page.locator("#alarms")
    alarm.wait_for(timeout=WAIT_MS)
    assert "side:" in alarm.inner_text()
    assert alarm.get_attribute("role") == "alert"
    red, green, blue = page.evaluate(
        "getComputedStyle(document.querySelector('#alarms')).color.match(/\\d+/g).map(Number)"
    )[:3]
    assert red > 1.5 * max(green, blue)
    card = page.locator("nav button", has_text="side")
    assert card.locator(".state").inner_text() == "alarm"
    assert page.title().startswith("⚠")


@pytest.mark.parametrize("width", [390, 1400])
def test_nothing_hangs_over_the_edge(browser: Any, url: str, width: int) -> None:
    page = browser.new_page(viewport={"width": width, "height": 844})
    page.goto(url)
    until(page, "window.rasnik?.updates.curves > 1")
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    page.close()


def own_address() -> str:
    """An address of this machine that is not loopback."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(("192.0.2.1", 9))  # nothing is sent
            address = str(probe.getsockname()[0])
        except OSError:
            address = "127.0.0.1"
    if address.startswith("127."):
        pytest.skip("this machine has no address but loopback")
    return address


def test_from_another_address_the_token_is_needed(
    browser: Any, station: Station, tmp_path: Path
) -> None:
    address = own_address()
    file = tmp_path / "token"
    file.touch(mode=0o600)
    file.write_text(TOKEN)
    os.chmod(file, 0o600)
    with page_of(station, Server(host=address, port=0, token_file=file)) as server:
        assert address in server.url
        context = browser.new_context()
        page = context.new_page()
        lines: list[Any] = []
        page.on("websocket", lambda line: lines.append(line.url))
        page.goto(server.url)
        assert page.url.endswith("/login") and not lines
        assert context.request.get(server.url + "api/channels").status == 401
        page.get_by_label("Token").fill("not the right one at all")
        page.get_by_role("button", name="Enter").click()
        page.get_by_text("This is not the token.").wait_for(timeout=WAIT_MS)
        page.get_by_label("Token").fill(TOKEN)
        page.get_by_role("button", name="Enter").click()
        until(page, "window.rasnik?.updates.curves > 1")
        assert lines
        context.close()


def test_times_are_those_of_the_station(page: Any) -> None:
    """A telephone whose clock is an hour late looks at the last 10 minutes all the same."""
    page.evaluate("(() => { const now = Date.now; Date.now = () => now() - 3_600_000; })()")
    page.wait_for_timeout(600)  # the station tells its time four times a second
    asked: list[str] = []
    page.on("request", lambda request: asked.append(request.url))
    page.get_by_role("button", name="10 min").click()
    until(page, "document.getElementById('range').textContent.startsWith('From the record')")
    end = time.monotonic() + WAIT_MS / 1000
    while not [one for one in asked if "/history?" in one]:
        assert time.monotonic() < end
        page.wait_for_timeout(50)
    query = urlsplit(next(one for one in asked if "/history?" in one)).query
    end_s = float(dict(part.split("=") for part in query.split("&"))["end"])
    assert abs(end_s - time.time()) < 60


def test_a_finger_looks_closer(browser: Any, url: str) -> None:
    context = browser.new_context(viewport={"width": 390, "height": 844}, has_touch=True)
    page = context.new_page()
    page.goto(url + "#top")
    until(page, "window.rasnik?.updates.curves > 5")
    over = page.locator(".plot .u-over").first
    over.scroll_into_view_if_needed()
    box = over.bounding_box()
    y = box["y"] + box["height"] / 2
    line = context.new_cdp_session(page)

    def touch(kind: str, *places: float) -> None:
        points = [{"x": box["x"] + x * box["width"], "y": y} for x in places]
        line.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})

    touch("touchStart", 0.3)
    for step in range(1, 11):
        touch("touchMove", 0.3 + 0.04 * step)
    touch("touchEnd")
    until(page, "document.getElementById('range').textContent.startsWith('From the record')")
    assert page.get_by_role("button", name="Back").is_visible()
    context.close()
