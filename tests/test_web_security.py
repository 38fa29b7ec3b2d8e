"""Hostile input to the page's server: refused with a sentence, and nothing stops."""

import base64
import http.client
import os
import socket
import struct
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest

pytest.importorskip("uvicorn", reason="the page's packages are not installed")
pytest.importorskip("websockets", reason="the page's packages are not installed")
httpx = pytest.importorskip("httpx", reason="the page is asked with httpx")

from websockets.exceptions import ConnectionClosed, InvalidStatus  # noqa: E402
from websockets.sync.client import connect  # noqa: E402

from _web_station import fake_station  # noqa: E402
from rasnik.live.station import Server  # noqa: E402
from rasnik.web import connections  # noqa: E402
from rasnik.web.guard import LARGEST_BODY  # noqa: E402
from rasnik.web.process import page_of  # noqa: E402
from rasnik.web.server import PageError, PageServer, read_token  # noqa: E402

TOKEN = "0123456789abcdef-top-secret"
WRITE = {"X-Rasnik": "1"}


@pytest.fixture(scope="module")
def station(tmp_path_factory: pytest.TempPathFactory) -> Any:
    made = fake_station(tmp_path_factory.mktemp("station"), ("top",))
    for _ in range(50):
        made.channels["top"].frame()
    return made


@pytest.fixture(scope="module")
def open_url(station: Any) -> Iterator[str]:
    """Without a token, for this machine."""
    with page_of(station, Server(port=0)) as server:
        yield server.url
        # whatever the tests did, it goes on
        assert httpx.get(server.url + "health").json()["ok"] is True


@pytest.fixture(scope="module")
def closed_url(station: Any, tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """With a token."""
    with page_of(
        station, Server(port=0, token_file=token_file(tmp_path_factory.mktemp("token")))
    ) as server:
        yield server.url


def token_file(folder: Path, text: str = TOKEN + "\n", mode: int = 0o600) -> Path:
    path = folder / "token"
    path.write_text(text)
    path.chmod(mode)
    return path


def ws(url: str) -> str:
    return url.replace("http", "ws") + "ws"


def raw(url: str, request: bytes, wait_s: float = 5.0) -> bytes:
    """The answer to bytes that no client would send."""
    parts = urlsplit(url)
    with socket.create_connection((parts.hostname, parts.port), timeout=wait_s) as line:
        line.sendall(request)
        answer = b""
        try:
            while more := line.recv(65536):
                answer += more
        except (TimeoutError, ConnectionResetError):
            pass  # what came before counts
        return answer


# --------------------------------------------------------------------- who may listen


@pytest.mark.parametrize("host", ["0.0.0.0", "::", "192.0.2.1", "example.org", ""])
def test_other_addresses_need_a_token(station: Any, host: str) -> None:
    with pytest.raises(PageError, match="open to everybody.*token_file"):
        page_of(station, Server(host=host))


@pytest.mark.parametrize(
    ("text", "mode", "sentence"),
    [
        ("short", 0o600, "one word of 16 letters"),
        ("two words that are long enough", 0o600, "one word of 16 letters"),
        (TOKEN, 0o640, "Others can read the token file.*chmod 600"),
        (TOKEN, 0o604, "Others can read the token file"),
        ("", 0o600, "one word of 16 letters"),
    ],
)
def test_token_files_that_are_not_safe(tmp_path: Path, text: str, mode: int, sentence: str) -> None:
    if os.name != "posix":
        pytest.skip("file modes are those of POSIX")
    with pytest.raises(PageError, match=sentence):
        read_token(token_file(tmp_path, text, mode))


def test_a_missing_token_file(station: Any, tmp_path: Path) -> None:
    with pytest.raises(PageError, match="cannot be read"):
        page_of(station, Server(host="0.0.0.0", token_file=tmp_path / "none"))


def test_a_port_that_is_taken(station: Any, open_url: str) -> None:
    port = urlsplit(open_url).port
    with pytest.raises(PageError, match=f"cannot listen on 127.0.0.1, port {port}.*--port"):
        page_of(station, Server(port=port or 0)).start()


# ------------------------------------------------------------------------- the token


READS = ["/", "/api/channels", "/api/channels/top/image", "/api/openapi.json", "/static/main.js",
         "/metrics", "/health", "/nothing"]  # fmt: skip


@pytest.mark.parametrize("path", READS)
@pytest.mark.parametrize(
    "headers",
    [
        {},
        {"Authorization": "Bearer wrong"},
        {"Authorization": "Bearer"},
        {"Authorization": f"Basic {TOKEN}"},
        {"Authorization": "Bearer \xff\xfe"},
        {"Cookie": f"rasnik={TOKEN}"},
        {"Cookie": "rasnik=; rasnik=0; other=1"},
    ],
)
def test_nothing_is_told_without_the_token(
    closed_url: str, path: str, headers: dict[str, str]
) -> None:
    encoded = {name: value.encode("latin-1") for name, value in headers.items()}
    answer = httpx.get(closed_url.rstrip("/") + path, headers=encoded)
    assert answer.status_code == 401
    assert "token is missing or wrong" in answer.json()["error"]


def test_the_token_opens(closed_url: str) -> None:
    bearer = {"Authorization": f"Bearer {TOKEN}"}
    for path in READS[:-2]:
        assert httpx.get(closed_url.rstrip("/") + path, headers=bearer).status_code == 200
    done = httpx.post(closed_url + "api/channels/top/start-recording", headers=bearer)
    assert done.json()["recording"] is True
    with connect(ws(closed_url), additional_headers=bearer) as client:
        assert client.recv(5)


def test_no_change_without_the_token(closed_url: str, station: Any) -> None:
    before = station.channels["top"].recording
    for action in ("start-recording", "stop-recording", "zero", "snapshot"):
        answer = httpx.post(f"{closed_url}api/channels/top/{action}", headers=WRITE)
        assert answer.status_code == 401
    assert station.channels["top"].recording is before


def test_login_gives_a_cookie_that_is_not_the_token(closed_url: str) -> None:
    with httpx.Client(base_url=closed_url) as client:
        page = client.get("/", headers={"Accept": "text/html"})
        assert page.status_code == 303 and page.headers["location"] == "/login"
        assert "password" in client.get("/login").text
        wrong = client.post("/login", data={"token": "wrong"})
        assert wrong.status_code == 401 and "not the token" in wrong.text
        right = client.post("/login", data={"token": TOKEN})
        cookie = right.headers["set-cookie"]
        assert right.status_code == 303
        assert TOKEN not in cookie
        assert "HttpOnly" in cookie and "SameSite=strict" in cookie
        assert client.get("/api/channels").status_code == 200
        assert client.post("/api/channels/top/zero").status_code == 403  # no own header
        assert client.post("/api/channels/top/zero", headers=WRITE).status_code == 200
        value = {"Cookie": cookie.partition(";")[0]}
        with connect(ws(closed_url), additional_headers=value) as socket_:
            assert socket_.recv(5)


def test_the_websocket_needs_the_token(closed_url: str) -> None:
    for headers in ({}, {"Authorization": "Bearer wrong"}):
        with pytest.raises(InvalidStatus) as refused:
            connect(ws(closed_url), additional_headers=headers)
        assert refused.value.response.status_code == 403


# ------------------------------------------------------------------------ other pages


@pytest.mark.parametrize("host", ["evil.example", "evil.example:80", "127.0.0.1.evil.example", ""])
def test_other_names_of_this_machine_are_not_answered(open_url: str, host: str) -> None:
    """DNS rebinding: a name of somebody else that leads here."""
    for path in ("/", "/api/channels", "/static/main.js"):
        answer = httpx.get(open_url.rstrip("/") + path, headers={"Host": host})
        assert answer.status_code == 403


@pytest.mark.parametrize(
    "headers",
    [
        {},  # a form of another page
        {"Origin": "http://evil.example", **WRITE},
        {"Origin": "null", **WRITE},
        {"Origin": "http://127.0.0.1:1", **WRITE},  # another server on this machine
        {"Sec-Fetch-Site": "cross-site", **WRITE},
        {"Sec-Fetch-Site": "same-site", **WRITE},
    ],
)
def test_other_pages_change_nothing(open_url: str, station: Any, headers: dict[str, str]) -> None:
    station.channels["top"].recording = False
    answer = httpx.post(f"{open_url}api/channels/top/start-recording", headers=headers)
    assert answer.status_code == 403
    assert station.channels["top"].recording is False


def test_our_own_page_changes_things(open_url: str, station: Any) -> None:
    headers = {"Origin": open_url.rstrip("/"), "Sec-Fetch-Site": "same-origin", **WRITE}
    answer = httpx.post(f"{open_url}api/channels/top/start-recording", headers=headers)
    assert answer.status_code == 200 and station.channels["top"].recording is True


@pytest.mark.parametrize("origin", ["http://evil.example", "null", "http://127.0.0.1:1", "x"])
def test_the_websocket_checks_the_origin(open_url: str, origin: str) -> None:
    with pytest.raises(InvalidStatus) as refused:
        connect(ws(open_url), additional_headers={"Origin": origin})
    assert refused.value.response.status_code == 403
    with connect(ws(open_url), additional_headers={"Origin": open_url.rstrip("/")}) as client:
        assert client.recv(5)


def test_no_other_origin_is_ever_allowed(open_url: str) -> None:
    answer = httpx.options(
        f"{open_url}api/channels/top/zero",
        headers={"Origin": "http://evil.example", "Access-Control-Request-Method": "POST"},
    )
    assert not [name for name in answer.headers if name.startswith("access-control")]


def test_every_answer_carries_the_policy(open_url: str) -> None:
    for path in ("", "api/channels", "nothing", "static/style.css"):
        headers = httpx.get(open_url + path).headers
        policy = headers["content-security-policy"]
        assert policy.startswith("default-src 'none'; script-src 'self';")
        assert "unsafe" not in policy
        assert headers["x-content-type-options"] == "nosniff"
        assert headers["x-frame-options"] == "DENY"
        assert "server" not in headers


# -------------------------------------------------------------------- bodies and paths


def test_a_huge_body_is_refused(open_url: str) -> None:
    url = f"{open_url}api/channels/top/exposure"
    told = httpx.post(url, headers=WRITE, content=b"x" * (LARGEST_BODY + 1))
    assert told.status_code == 413

    def pieces() -> Iterator[bytes]:
        for _ in range(100):
            yield b"x" * 1000

    try:
        assert httpx.post(url, headers=WRITE, content=pieces()).status_code == 413
    except httpx.WriteError:
        pass  # the line was closed while it was still sent


def test_a_body_that_is_announced_huge_or_never_comes(open_url: str) -> None:
    head = b"POST /api/channels/top/zero HTTP/1.1\r\nHost: 127.0.0.1\r\nX-Rasnik: 1\r\n"
    answer = raw(open_url, head + b"Content-Length: 99999999999\r\n\r\n", 1)
    assert answer.startswith(b"HTTP/1.1 413")
    for length in (b"-5", b"abc", b"1e3"):
        answer = raw(open_url, head + b"Content-Length: " + length + b"\r\n\r\n", 1)
        assert answer.startswith(b"HTTP/1.1 400")


@pytest.mark.parametrize("body", [b"{", b"\xff\xfe", b"[" * 10_000, b'{"a": NaN, "a": 1}', b'"x"'])
def test_bodies_that_are_not_json(open_url: str, body: bytes) -> None:
    answer = httpx.post(f"{open_url}api/channels/top/zero", headers=WRITE, content=body)
    assert answer.status_code == 400
    assert "Traceback" not in answer.text and answer.json()["error"]


@pytest.mark.parametrize(
    "path",
    [
        "/static/../app.py", "/static/..%2fapp.py", "/static/%2e%2e/app.py",
        "/static/%252e%252e/app.py", "/static//etc/passwd", "/static/..%5capp.py",
        "/static/%00", "/../../etc/passwd", "//etc/passwd", "/static/uplot/../../app.py",
        "/api/channels/..%2f..%2fetc", "/api/channels/%2e%2e/image", "/static/....//app.py",
    ],
)  # fmt: skip
def test_paths_that_lead_elsewhere(open_url: str, path: str) -> None:
    parts = urlsplit(open_url)
    line = http.client.HTTPConnection(str(parts.hostname), parts.port, timeout=5)
    line.request("GET", path)  # as it stands: httpx would tidy it up
    answer = line.getresponse()
    text = answer.read()
    line.close()
    assert answer.status in (400, 404)
    assert b"Starlette" not in text and b"root:" not in text


def test_requests_that_are_not_http(open_url: str) -> None:
    for request in (
        b"\x00\x01\x02\x03\r\n\r\n",
        b"GET / HTTP/9.9\r\n\r\n",
        b"GET /" + b"a" * 100_000 + b" HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n",
        b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nX: " + b"y" * 200_000 + b"\r\n\r\n",
        b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: 1\r\nContent-Length: 2\r\n\r\n",
    ):
        answer = raw(open_url, request, 1)
        assert not answer or answer.startswith((b"HTTP/1.1 400", b"HTTP/1.1 4"))
    assert httpx.get(open_url + "health").status_code == 200


def test_failures_inside_are_not_told(
    open_url: str, station: Any, monkeypatch: pytest.MonkeyPatch, caplog: Any
) -> None:
    def broken() -> None:
        raise RuntimeError("a secret of the inside")

    monkeypatch.setattr(station.channels["top"], "zero", broken)
    answer = httpx.post(f"{open_url}api/channels/top/zero", headers=WRITE)
    assert answer.status_code == 500
    assert "secret" not in answer.text and "log" in answer.json()["error"]
    assert "a secret of the inside" in caplog.text


# ------------------------------------------------------------------------ websocket frames


@pytest.mark.parametrize(
    "message",
    [
        "not json", "[]", "1", "{", "[" * 5000, '{"channel": "nobody"}', '{"channel": 5}',
        '{"image_hz": 1e9}', '{"image_hz": -1}', '{"image_hz": "5"}', '{"image_hz": NaN}',
        '{"image_hz": Infinity}', '{"image_hz": true}', '{"rows_s": [1]}', '{"else": 1}',
        b"\x00\x01",
    ],
)  # fmt: skip
def test_wrong_messages_end_the_websocket(open_url: str, message: str | bytes) -> None:
    with connect(ws(open_url), max_size=None) as client:
        client.send(message)
        with pytest.raises(ConnectionClosed) as closed:
            for _ in range(200):
                client.recv(5)
        assert closed.value.rcvd is not None and closed.value.rcvd.code == 1008
        assert closed.value.rcvd.reason


def test_a_message_that_is_too_long(open_url: str) -> None:
    with connect(ws(open_url), max_size=None) as client:
        client.send("x" * 100_000)
        with pytest.raises(ConnectionClosed) as closed:
            for _ in range(200):
                client.recv(5)
        assert closed.value.rcvd is not None and closed.value.rcvd.code == 1009


FRAMES = {
    "not masked": b"\x81\x02hi",
    "reserved bits": b"\xf1\x80\0\0\0\0",
    "unknown kind": b"\x83\x80\0\0\0\0",
    "long control": b"\x89\xfe\x01\x00" + b"\0" * 4 + b"x" * 256,
    "not utf-8": b"\x81\x82\0\0\0\0\xff\xfe",
    "continues nothing": b"\x80\x80\0\0\0\0",
    "announced huge": b"\x81\xff" + struct.pack(">Q", 2**62) + b"\0" * 4,
    "negative length": b"\x81\xff" + b"\xff" * 8 + b"\0" * 4,
    "close with nonsense": b"\x88\x83\0\0\0\0\x00\x01\x02",
    "rubbish": bytes(range(256)) * 8,
}


@pytest.mark.parametrize("name", FRAMES)
def test_malformed_frames_end_the_websocket(open_url: str, name: str) -> None:
    parts = urlsplit(open_url)
    key = base64.b64encode(b"0123456789abcdef").decode()
    with socket.create_connection((parts.hostname, parts.port), timeout=5) as line:
        line.sendall(
            f"GET /ws HTTP/1.1\r\nHost: {parts.netloc}\r\nUpgrade: websocket\r\n"
            f"Connection: Upgrade\r\nSec-WebSocket-Key: {key}\r\n"
            "Sec-WebSocket-Version: 13\r\n\r\n".encode()
        )
        assert line.recv(65536).startswith(b"HTTP/1.1 101")
        line.sendall(FRAMES[name])
        line.shutdown(socket.SHUT_WR)
        end = time.monotonic() + 5
        try:
            while line.recv(65536):
                assert time.monotonic() < end, "the line stays open"
        except ConnectionResetError:
            pass
    assert httpx.get(open_url + "health").json()["ok"] is True


def test_a_client_that_never_reads_costs_no_memory(tmp_path: Path) -> None:
    """Its line fills up, and nothing more is made for it; others go on."""
    station = fake_station(tmp_path, ("one",))
    channel = station.channels["one"]
    channel.start()
    key = base64.b64encode(b"0123456789abcdef").decode()
    try:
        with page_of(station, Server(port=0)) as server:
            parts = urlsplit(server.url)
            line = socket.socket()
            line.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
            line.connect((parts.hostname, parts.port))
            line.sendall(
                f"GET /ws HTTP/1.1\r\nHost: {parts.netloc}\r\nUpgrade: websocket\r\n"
                f"Connection: Upgrade\r\nSec-WebSocket-Key: {key}\r\n"
                "Sec-WebSocket-Version: 13\r\n\r\n".encode()
            )
            wish = b'{"channel":"one"}'
            line.sendall(bytes([0x81, 0x80 | len(wish), 0, 0, 0, 0]) + wish)
            with connect(ws(server.url), max_size=None) as client:
                client.send('{"channel": "one", "rows_hz": 25}')
                end, got = time.monotonic() + 1.5, 0
                while time.monotonic() < end:
                    client.recv(5)
                    got += 1
            assert got > 20
            start = time.monotonic()
            line.close()
        assert time.monotonic() - start < 8
    finally:
        channel.stop()


# ------------------------------------------------------------- what was tried later


def test_an_origin_that_is_no_address_is_another_origin(open_url: str) -> None:
    headers = {"Origin": "http://[", **WRITE}
    assert httpx.post(f"{open_url}api/channels/top/zero", headers=headers).status_code == 403
    with pytest.raises(InvalidStatus) as refused:
        connect(ws(open_url), additional_headers={"Origin": "http://["})
    assert refused.value.response.status_code == 403


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere 127.0.0.2 is no address")
def test_every_address_of_this_machine_alone_is_answered(station: Any) -> None:
    with page_of(station, Server(host="127.0.0.2", port=0)) as server:
        assert httpx.get(f"{server.url}health").json()["ok"] is True
        answer = httpx.get(f"{server.url}health", headers={"Host": "evil.example"})
        assert answer.status_code == 403


def test_two_stations_of_one_machine_keep_their_viewers(station: Any, tmp_path: Path) -> None:
    """A browser sends the cookies of all ports, and keeps one of each name."""
    names = set()
    with httpx.Client() as client:
        for k in range(2):
            folder = tmp_path / str(k)
            folder.mkdir()
            file = token_file(folder, f"{TOKEN}-{k}\n")
            with page_of(station, Server(port=0, token_file=file)) as server:
                client.post(server.url + "login", data={"token": f"{TOKEN}-{k}"})
                assert client.get(server.url + "api/channels").status_code == 200
            names = set(client.cookies)
    assert len(names) == 2


def test_who_asks_nothing_is_let_go(station: Any, monkeypatch: Any) -> None:
    """Else 200 silent connections would be all that there are."""
    monkeypatch.setattr(connections, "PATIENCE_S", 0.2)
    with PageServer(station, Server(port=0)) as server:
        parts = urlsplit(server.url)
        lines = [socket.create_connection((parts.hostname, parts.port)) for _ in range(210)]
        lines[0].sendall(b"GET /health HTTP/1.1\r\nHost: loc")  # never goes on
        lines[1].sendall(b"GET /health HTTP/1.1\r\nHost: localhost\r\n\r\nGET /he")
        with connect(ws(server.url)) as client:
            for line in lines:
                line.settimeout(10)
                while line.recv(65536):
                    pass
                line.close()
            assert httpx.get(server.url + "health").status_code == 200
            client.send('{"channel": "top"}')  # a websocket stays
            for _ in range(3):
                assert client.recv(5)
