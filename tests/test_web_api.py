"""What the page's server answers: numbers in their units, rows, history, pictures, actions."""

import asyncio
import io
import json
import re
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("uvicorn", reason="the page's packages are not installed")
pytest.importorskip("websockets", reason="the page's packages are not installed")
httpx = pytest.importorskip("httpx", reason="the page is asked with httpx")

from PIL import Image  # noqa: E402
from websockets.asyncio.client import connect  # noqa: E402

from _web_station import SIGMAS, fake_station  # noqa: E402
from rasnik.analysis.pose import Pose  # noqa: E402
from rasnik.imaging.projection import Projection  # noqa: E402
from rasnik.live.recent import RECENT_ROW  # noqa: E402
from rasnik.live.station import Server  # noqa: E402
from rasnik.live.status import ChannelStatus  # noqa: E402
from rasnik.web.openapi import document  # noqa: E402
from rasnik.web.packets import pack, unpack  # noqa: E402
from rasnik.web.picture import lattice  # noqa: E402
from rasnik.web.quantities import QUANTITIES  # noqa: E402
from rasnik.web.rows import last_rows, torn  # noqa: E402
from rasnik.web.server import PageServer  # noqa: E402
from rasnik.web.spectra import live_spectrum  # noqa: E402

WRITE = {"X-Rasnik": "1"}


@pytest.fixture(scope="module")
def station(tmp_path_factory: pytest.TempPathFactory) -> Any:
    made = fake_station(tmp_path_factory.mktemp("station"))
    for channel in made.channels.values():
        for k in range(400):
            channel.frame(1_790_000_000 + k / channel.rate_hz)
    return made


@pytest.fixture(scope="module")
def url(station: Any) -> Iterator[str]:
    with PageServer(station, Server(port=0)) as server:
        yield server.url


@pytest.fixture
def client(url: str) -> Iterator[Any]:
    with httpx.Client(base_url=url, headers=WRITE) as made:
        yield made


# ------------------------------------------------------------------------ what is asked


def test_station_channels_and_health(client: Any) -> None:
    assert client.get("/api/station").json()["channels"] == ["top", "side"]
    assert [c["name"] for c in client.get("/api/channels").json()] == ["top", "side"]
    assert client.get("/health").json() == {
        "ok": True,
        "channels": {"top": "running", "side": "running"},
    }


def test_a_channel_in_nanometres_from_its_zero(client: Any, station: Any) -> None:
    status = station.channels["top"].status()
    found = client.get("/api/channels/top").json()
    assert found["relative"]["x_nm"] == pytest.approx(1e3 * status.x_um, rel=1e-12)
    assert found["relative"]["sigma_y_nm"] == pytest.approx(2.0)
    assert found["latency_median_ms"] is None  # not known
    assert client.post("/api/channels/top/zero").json()["zero_um"] == [status.x_um, status.y_um]
    after = client.get("/api/channels/top").json()["relative"]
    assert [after[q.key] for q in QUANTITIES] == pytest.approx([0, 0, 0, 0], abs=1e-9)
    client.post("/api/channels/top/clear-zero")
    assert client.get("/api/channels/top").json()["relative"]["x_nm"] > 3e6


def test_rows_since(client: Any, station: Any) -> None:
    found = client.get("/api/channels/top/rows?since=390").json()
    rows, following = station.channels["top"].recent.since(390)
    assert found["next"] == following == 400
    assert set(found["rows"]) == set(RECENT_ROW.names)
    assert found["rows"]["x_um"] == rows["x_um"].tolist()
    assert client.get("/api/channels/top/rows?since=400").json()["rows"]["x_um"] == []


def test_many_rows_come_in_parts(client: Any, station: Any, monkeypatch: Any) -> None:
    monkeypatch.setattr("rasnik.web.api.MOST_ROWS", 150)
    got: list[int] = []
    after = 0
    for _ in range(3):
        found = client.get(f"/api/channels/top/rows?since={after}").json()
        after = found["next"]
        got += found["rows"]["frame"]
    assert got == list(range(400))


def test_history_keeps_gaps_and_leaves_out_what_is_merely_empty(client: Any) -> None:
    found = client.get("/api/channels/side/history?start=100&end=200&points=100").json()
    mean = np.array(found["x_nm_mean"], dtype=float)
    assert np.isnan(mean).sum() == 1  # one break in the line for the ten bins of the hole
    assert mean[0] == pytest.approx(4e6) and mean[-1] == pytest.approx(4e6 - 1000)
    kept = np.isfinite(mean)
    width = np.array(found["x_nm_max"], float)[kept] - np.array(found["x_nm_min"], float)[kept]
    assert width == pytest.approx(2.0)
    assert len(found["time_s"]) == len(mean) == 91


def test_image_exact_and_small(client: Any, station: Any) -> None:
    image = station.channels["top"].latest().frame.image
    exact = client.get("/api/channels/top/image")
    assert exact.headers["content-type"] == "image/png"
    assert np.array_equal(np.asarray(Image.open(io.BytesIO(exact.content))), image)
    small = client.get("/api/channels/top/image?format=jpeg&width=200")
    assert Image.open(io.BytesIO(small.content)).size == (180, 135)


def test_metrics(client: Any) -> None:
    pytest.importorskip("prometheus_client", reason="prometheus_client is not installed")
    text = client.get("/metrics").text
    assert re.search(r'^rasnik_\w+\{.*channel="top".*\} ', text, re.MULTILINE)


# ------------------------------------------------------------------------- what is done


def test_actions(client: Any, station: Any) -> None:
    channel = station.channels["side"]
    assert client.post("/api/channels/side/start-recording").json()["recording"] is True
    assert client.post("/api/channels/side/stop-recording").json()["recording"] is False
    answer = client.post("/api/channels/side/exposure", json={"exposure_us": 750})
    assert answer.json()["exposure_us"] == 750
    client.post("/api/channels/side/keep-exposure", json={"on": True})
    assert channel.actions[-1] == ("keep_exposure", True)
    saved = client.post("/api/channels/side/snapshot").json()["file"]
    assert Path(saved).read_bytes() == b"a picture"


@pytest.mark.parametrize(
    ("path", "body", "status", "sentence"),
    [
        ("nobody/zero", {}, 404, "There is no channel of this name."),
        ("side/exposure", {"exposure_us": 20_000}, 409, "must lie from 1 to 10000"),
        ("side/exposure", {}, 400, "exposure_us is missing"),
        ("side/exposure", {"exposure_us": "nan"}, 400, "must be of the kind number"),
        ("side/exposure", {"exposure_us": -1}, 400, "must be at least 0.1"),
        ("side/exposure", {"exposure_us": True}, 400, "must be of the kind number"),
        ("side/keep-exposure", {"on": "yes"}, 400, "must be of the kind boolean"),
        ("side/zero", {"x": 1}, 400, "no parameter 'x'"),
        ("side/zero", [1], 400, "must be a JSON object"),
        ("side/dance", {}, 404, "nothing at this address"),
    ],
)
def test_refusals_are_sentences(
    client: Any, path: str, body: Any, status: int, sentence: str
) -> None:
    answer = client.post(f"/api/channels/{path}", json=body)
    assert answer.status_code == status
    assert sentence in answer.json()["error"]


def test_history_of_no_time_is_refused(client: Any) -> None:
    answer = client.get("/api/channels/top/history?start=5&end=5")
    assert answer.status_code == 400 and "start must be before end" in answer.json()["error"]


# ---------------------------------------------------------------------- the description


def references(node: Any) -> Iterator[str]:
    if isinstance(node, dict):
        yield from ([node["$ref"]] if "$ref" in node else [])
        for item in node.values():
            yield from references(item)
    elif isinstance(node, list):
        for item in node:
            yield from references(item)


def fits(value: Any, schema: dict[str, Any], schemas: dict[str, Any]) -> bool:
    """Whether a JSON value is as a schema of ours says; the part of JSON Schema that it uses."""
    if "$ref" in schema:
        return fits(value, schemas[schema["$ref"].rsplit("/")[-1]], schemas)
    kinds = schema["type"] if isinstance(schema["type"], list) else [schema["type"]]
    types: dict[str, Any] = {
        "string": str, "boolean": bool, "integer": int, "number": (int, float),
        "null": type(None), "object": dict, "array": list,
    }  # fmt: skip
    if not any(
        isinstance(value, types[kind]) and (kind == "boolean") == isinstance(value, bool)
        for kind in kinds
    ):
        return False
    if isinstance(value, list):
        return all(fits(item, schema["items"], schemas) for item in value)
    if isinstance(value, dict):
        known = schema.get("properties", {})
        return set(schema.get("required", [])) <= set(value) and all(
            fits(value[name], known[name], schemas) for name in value if name in known
        )
    return "enum" not in schema or value in schema["enum"]


def test_the_description_is_whole(client: Any) -> None:
    found = client.get("/api/openapi.json").json()
    assert found == json.loads(json.dumps(document()))
    assert found["openapi"].startswith("3.1.")
    operations = [one for path in found["paths"].values() for one in path.values()]
    names = [one["operationId"] for one in operations]
    assert len(set(names)) == len(names)
    for path, item in found["paths"].items():
        for one in item.values():
            told = {p["name"] for p in one.get("parameters", []) if p["in"] == "path"}
            assert told == set(re.findall(r"{(\w+)}", path))
            assert {"200", "default"} <= set(one["responses"])
    for reference in references(found):
        assert reference.rsplit("/", 1)[0] == "#/components/schemas"
        assert reference.rsplit("/", 1)[1] in found["components"]["schemas"]


def test_answers_are_as_described(client: Any) -> None:
    found = client.get("/api/openapi.json").json()
    schemas = found["components"]["schemas"]
    query = {"history": "?start=100&end=200"}
    checked = 0
    for path, item in found["paths"].items():
        if "get" not in item:
            continue
        content = item["get"]["responses"]["200"]["content"]
        answer = client.get(path.format(name="top") + query.get(path.rsplit("/")[-1], ""))
        assert answer.status_code == 200, path
        if "application/json" in content:
            schema = content["application/json"]["schema"]
            assert fits(answer.json(), schema, schemas), path
            assert not fits({"error": 1}, schema, schemas)
            checked += 1
    assert checked >= 6


# ------------------------------------------------------------------------ the websocket


def heard(
    url: str,
    wishes: dict[str, Any],
    seconds: float,
    seen: bool = True,
    kinds: set[str] | None = None,
) -> list[Any]:
    """What a client is told in so many seconds, or until all kinds of messages have come."""

    async def listen() -> list[Any]:
        got = []
        async with connect(url.replace("http", "ws") + "ws", max_size=None) as socket:
            await socket.send(json.dumps(wishes))
            end = time.monotonic() + seconds
            while (left := end - time.monotonic()) > 0:
                try:
                    message = await asyncio.wait_for(socket.recv(), left)
                except TimeoutError:
                    break
                assert isinstance(message, bytes)
                header, arrays = unpack(message)
                got.append((header, arrays))
                if header["kind"] == "image" and seen:
                    await socket.send('{"seen": true}')
                if kinds is not None and kinds <= {header["kind"] for header, _ in got}:
                    break
        return got

    return asyncio.run(listen())


def test_the_first_messages_show_everything(url: str, station: Any) -> None:
    wanted = {"status", "rows", "image", "spectrum"}
    got = heard(url, {"channel": "side", "rows_s": 2, "spectrum_s": 4}, 10.0, kinds=wanted)
    kinds = {header["kind"]: (header, arrays) for header, arrays in reversed(got)}
    assert set(kinds) == wanted
    header, rows = kinds["rows"]
    assert header["first"] and header["next"] == 400
    assert rows["time_s"][-1] - rows["time_s"][0] == pytest.approx(2, abs=0.02)
    recent = station.channels["side"].recent.last(2)
    assert rows["x_nm"] == pytest.approx(1e3 * recent["x_um"], rel=1e-12)
    assert rows["scale_ppm"] == pytest.approx(1e6 * (recent["scale"] - 1), abs=1e-6)
    header, image = kinds["image"]
    assert Image.open(io.BytesIO(image["jpeg"].tobytes())).size == (720, 540)
    assert image["counts"].sum() == pytest.approx(1)
    header, spectrum = kinds["spectrum"]
    assert header["bounds"]["y_nm"] == pytest.approx(2.0 * np.sqrt(2 / 100), rel=0.01)


def test_rows_come_once_and_in_order(tmp_path: Path) -> None:
    station = fake_station(tmp_path, ("one",))
    channel = station.channels["one"]
    channel.start()
    try:
        with PageServer(station, Server(port=0)) as server:
            got = heard(server.url, {"channel": "one", "image_hz": 20, "rows_hz": 25}, 2.0)
    finally:
        channel.stop()
    rows = [arrays["time_s"] for header, arrays in got if header["kind"] == "rows"]
    times = np.concatenate(rows)
    assert (np.diff(times) > 0).all()
    whole = channel.recent.last(60)["host_time_s"]
    first = np.searchsorted(whole, times[0])
    assert np.array_equal(whole[first : first + len(times)], times)
    pictures = [header["number"] for header, _ in got if header["kind"] == "image"]
    assert len(pictures) >= 15 and (np.diff(pictures) > 0).all()


def test_a_client_that_confirms_nothing_gets_two_pictures(tmp_path: Path) -> None:
    station = fake_station(tmp_path, ("one",))
    channel = station.channels["one"]
    channel.start()
    try:
        with PageServer(station, Server(port=0)) as server:
            got = heard(server.url, {"channel": "one", "image_hz": 30}, 3.0, seen=False)
    finally:
        channel.stop()
    kinds = [header["kind"] for header, _ in got]
    assert kinds.count("image") == 2
    assert kinds.count("rows") > 10  # which go on


def test_messages_survive_packing(rng: np.random.Generator) -> None:
    arrays: dict[str, Any] = {
        "a": rng.normal(size=3), "b": rng.normal(size=5).astype(np.float32), "c": b"seven!!",
    }  # fmt: skip
    header, found = unpack(pack({"kind": "x", "text": "µ"}, arrays))
    assert header["text"] == "µ"
    assert np.array_equal(found["a"], arrays["a"]) and np.array_equal(found["b"], arrays["b"])
    assert found["c"].tobytes() == b"seven!!"


# ------------------------------------------------------------------ pictures and spectra


def test_the_lattice_lies_on_the_edges_of_the_fields(station: Any) -> None:
    """Along each line the image changes between black and white; half a field off it does not."""
    sample = station.channels["top"].latest()
    system = station.channels["top"].system
    x, y, scale, theta = 4000.0, 5000.0, 1.0, 0.002  # of the image
    pose = Pose(ok=True, projection=Projection.from_pose(x, y, scale, theta, 4))
    lines, code = lattice(pose, system, sample.frame.image.shape)
    field_px = system.pixels_per_field
    image = sample.frame.image.astype(float)
    steep = [line for line in lines if abs(line[2] - line[0]) < abs(line[3] - line[1])]
    height, width = image.shape

    def change(offset: float) -> float:
        """Mean step of grey levels across the lines, moved sideways."""
        steps = []
        for c0, r0, c1, r1 in steep:
            rows = np.arange(5, height - 5)
            columns = c0 + (rows + 0.5 - r0) / (r1 - r0) * (c1 - c0) + offset
            inside = (columns > 5) & (columns < width - 5)
            if not inside.any():
                continue
            at = np.floor(columns[inside]).astype(int)
            steps.append(np.abs(image[rows[inside], at + 2] - image[rows[inside], at - 3]).mean())
        return float(np.mean(steps))

    assert change(0) > 2 * change(field_px / 2)
    assert change(0) > change(1.5) and change(0) > change(-1.5)
    assert len(code) > 20 and code.shape[1] == 8


def test_no_lattice_without_a_position(station: Any) -> None:
    lines, code = lattice(Pose(), station.channels["top"].system, (540, 720))
    assert len(lines) == len(code) == 0


def test_white_noise_lies_at_the_bound(rng: np.random.Generator) -> None:
    rows = np.zeros(8192, RECENT_ROW)
    rows["frame"] = np.arange(len(rows))
    rows["received_s"] = 1e9 + rows["frame"] / 200
    for quantity, sigma in zip(QUANTITIES, SIGMAS, strict=True):
        rows[quantity.column] = 3 + sigma * rng.normal(size=len(rows))
        rows[quantity.sigma] = sigma
    arrays, bounds = live_spectrum(rows)
    assert bounds["x_nm"] == pytest.approx(1.0 * np.sqrt(2 / 200), rel=1e-3)
    for quantity in QUANTITIES:
        level = np.sqrt(np.mean(arrays[quantity.key][1:-1] ** 2))
        # 12 windows half overlapping: of the 4000 values of the series the mean is known to 2 %
        assert level == pytest.approx(bounds[quantity.key], rel=0.06)
    assert arrays["frequency_hz"][-1] == pytest.approx(100, rel=1e-3)


def test_too_few_rows_have_no_spectrum() -> None:
    with pytest.raises(ValueError, match="too few frames"):
        live_spectrum(np.zeros(5, RECENT_ROW))


def test_last_rows_are_those_of_the_ring(station: Any) -> None:
    recent = station.channels["top"].recent
    for seconds in (0.5, 3.0, 100.0):
        rows, following = last_rows(recent, seconds)
        assert np.array_equal(rows["frame"], recent.last(seconds)["frame"])
        assert following == recent.count


def test_no_line_is_drawn_across_missing_frames() -> None:
    rows = np.zeros(4, RECENT_ROW)
    rows["frame"], rows["host_time_s"], rows["x_um"] = (
        [7, 8, 12, 13],
        [1, 2, 6, 7],
        [10, 11, 12, 13],
    )
    found = torn(rows, None)
    np.testing.assert_array_equal(found["x_um"], [10, 11, np.nan, 12, 13])
    np.testing.assert_array_equal(found["host_time_s"], [1, 2, 6, 6, 7])
    np.testing.assert_array_equal(torn(rows, 5)["x_um"], [np.nan, 10, 11, np.nan, 12, 13])
    np.testing.assert_array_equal(torn(rows[:2], 6)["x_um"], [10, 11])
    assert len(torn(rows[:0], 6)) == len(torn(rows[:0], None)) == 0


def test_every_field_of_a_status_is_answered(client: Any) -> None:
    assert set(ChannelStatus.__dataclass_fields__) < set(client.get("/api/channels/top").json())


def test_frames_are_kept_when_asked_for(client: Any, station: Any) -> None:
    assert client.post("/api/channels/side/keep-frames").json()["name"] == "side"
    assert station.channels["side"].actions[-1] == ("keep_frames", True)
