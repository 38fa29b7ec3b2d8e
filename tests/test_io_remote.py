"""Files behind URLs: what fsspec offers, in memory and in packed files."""

import io
import itertools
import os
import subprocess
import sys
import tarfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import fsspec
import h5py
import numpy as np
import pytest
from PIL import Image

from rasnik.io import remote
from rasnik.io.folders import entry_of, is_url, list_folder, unpacked
from rasnik.io.images import Frame, iter_frames
from rasnik.io.remote import local_copy

_NUMBER = itertools.count()


@pytest.fixture
def folder() -> Iterator[str]:
    """URL of an empty folder in memory."""
    url = f"memory://folder{next(_NUMBER)}"
    yield url
    fsspec.filesystem("memory").store.clear()


def png(value: int = 7) -> bytes:
    sink = io.BytesIO()
    Image.fromarray(np.full((10, 12), value, dtype=np.uint8)).save(sink, format="PNG")
    return sink.getvalue()


def put(url: str, data: bytes) -> str:
    with fsspec.open(url, "wb") as file:
        file.write(data)
    return url


def read(url: str) -> Frame:
    (frame,) = iter_frames([url])
    return frame


def test_an_image_behind_a_url(folder: str) -> None:
    frame = read(put(f"{folder}/a.png", png(9)))
    assert frame.error is None and frame.image is not None
    assert frame.image.max() == 9 and frame.file == f"{folder}/a.png"


def test_stacks_behind_urls(folder: str) -> None:
    data = np.arange(1, 4, dtype=np.uint8)[:, None, None] * np.ones((3, 10, 12), np.uint8)
    sink = io.BytesIO()
    with h5py.File(sink, "w") as file:
        file["a"], file["b"] = data, data + 1
    put(f"{folder}/x.h5", sink.getvalue())
    frames = list(iter_frames([f"{folder}/x.h5:/b"], start=1))
    assert [int(f.image.max()) for f in frames if f.image is not None] == [3, 4]

    import zarr

    store = zarr.create_array(f"{folder}/y.zarr", shape=data.shape, chunks=(2, 10, 12), dtype="u1")
    store[:] = data
    frames = list(iter_frames([f"{folder}/y.zarr"]))
    assert [int(f.image.max()) for f in frames if f.image is not None] == [1, 2, 3]


def test_folders_are_listed_in_natural_order(folder: str) -> None:
    for name in ("10.png", "2.png", "sub/1.png"):
        put(f"{folder}/{name}", png())
    entries = list_folder(folder)
    assert [(e.name, e.is_folder) for e in entries] == [
        ("2.png", False), ("10.png", False), ("sub", True)
    ]  # fmt: skip
    assert entries[0].url == f"{folder}/2.png" and entries[0].stat()[0] == len(png())
    assert [e.url for e in list_folder(entries[2].url)] == [f"{folder}/sub/1.png"]


def test_a_tar_file_is_a_folder(tmp_path: Path) -> None:
    packed = tmp_path / "a.tar.gz"
    with tarfile.open(packed, "w:gz") as file:
        about = tarfile.TarInfo("A/1.png")
        about.size = len(png())
        file.addfile(about, io.BytesIO(png(5)))
    url = unpacked(str(packed))
    assert url == f"tar://::{packed}"
    assert entry_of(url).is_folder
    (one,) = list_folder(url)
    (image,) = list_folder(one.url)
    assert image.url == f"tar://A/1.png::{packed}"
    assert read(image.url).error is None


def test_packed_files_are_not_all_kept_open(tmp_path: Path) -> None:
    import zipfile

    for k in range(30):
        with zipfile.ZipFile(tmp_path / f"{k}.zip", "w") as file:
            file.writestr("1.png", png())
    for _ in range(2):
        for k in range(30):
            assert read(f"zip://1.png::{tmp_path / f'{k}.zip'}").error is None
    opened = [os.readlink(f"/proc/self/fd/{n}") for n in os.listdir("/proc/self/fd")
              if os.path.lexists(f"/proc/self/fd/{n}")]  # fmt: skip
    assert sum(str(tmp_path) in name for name in opened) <= 8


def test_the_copy_is_removed(folder: str) -> None:
    put(f"{folder}/a.png", png())
    with local_copy(f"{folder}/a.png") as copy:
        assert copy.name == "a.png" and copy.read_bytes() == png()
    assert not copy.parent.exists()


def test_a_copy_for_which_there_is_no_room_is_refused(
    folder: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(remote, "KEEP_FREE_BYTES", 1 << 62)
    assert "has room for 0 MiB; make space, or set TMPDIR" in str(
        read(put(f"{folder}/a.png", png())).error
    )


# ------------------------------------------------------------------------ errors


@pytest.mark.parametrize(
    ("url", "sentence"),
    [
        ("memory://nothing.png", "there is nothing at this URL; check it"),
        ("foo://a.png", "the URL is of no kind known here"),
        ("zip://a.png::/nothing.zip", "there is nothing at this URL"),
    ],
)
def test_errors_are_sentences_with_the_url(url: str, sentence: str) -> None:
    error = str(read(url).error)
    assert error.startswith(f"{url}: ") and sentence in error


def test_a_damaged_packed_file(tmp_path: Path) -> None:
    (tmp_path / "a.zip").write_bytes(b"PK nothing")
    assert "cannot be read" in str(read(f"zip://a.png::{tmp_path / 'a.zip'}").error)


def test_a_damaged_image_behind_a_url(folder: str) -> None:
    error = str(read(put(f"{folder}/a.png", png()[:50])).error)
    assert "truncated" in error and error.startswith(folder)


class Failing:
    """A file system that fails some times, then works."""

    def __init__(self, errors: list[Exception]) -> None:
        self.errors = errors
        self.asked = 0

    def info(self, path: str) -> dict[str, Any]:
        self.asked += 1
        if self.errors:
            raise self.errors.pop(0)
        return {"name": path, "size": len(png()), "type": "file"}

    def get_file(self, path: str, target: str) -> None:
        Path(target).write_bytes(png())


class StatusError(Exception):
    def __init__(self, status: int) -> None:
        super().__init__(f"status {status}")
        self.status = status


@pytest.fixture
def pauses(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    found: list[float] = []
    monkeypatch.setattr(remote.time, "sleep", found.append)
    return found


def connect(monkeypatch: pytest.MonkeyPatch, errors: list[Exception]) -> Failing:
    system = Failing(errors)
    monkeypatch.setattr(remote, "_connect", lambda url: (system, "a.png"))
    return system


@pytest.mark.parametrize("error", [TimeoutError(), ConnectionResetError(), StatusError(503)])
def test_what_fails_for_a_moment_is_tried_again(
    monkeypatch: pytest.MonkeyPatch, pauses: list[float], error: Exception
) -> None:
    connect(monkeypatch, [error, error])
    assert read("s3://bucket/a.png").error is None
    assert pauses == [0.5, 1.0]


@pytest.mark.parametrize(
    ("error", "asked", "sentence"),
    [
        (TimeoutError("slow"), 4, "the network or the server fails (slow); tried 4 times"),
        (PermissionError("AccessDenied"), 1, "access is refused (AccessDenied); check the cred"),
        (StatusError(403), 1, "access is refused"),
        (StatusError(404), 1, "there is nothing at this URL"),
        (RuntimeError("odd"), 1, "it cannot be read (odd)"),
    ],
)
def test_what_fails_for_good_is_said(
    monkeypatch: pytest.MonkeyPatch,
    pauses: list[float],
    error: Exception,
    asked: int,
    sentence: str,
) -> None:
    system = connect(monkeypatch, [error] * 9)
    assert sentence in str(read("s3://bucket/a.png").error)
    assert system.asked == asked


def test_a_copy_that_is_cut_off_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    system = connect(monkeypatch, [])
    monkeypatch.setattr(system, "get_file", lambda _, target: Path(target).write_bytes(png()[:9]))
    assert f"only 9 of {len(png())} bytes came" in str(read("s3://bucket/a.png").error)


# ------------------------------------------------------------------------ local files


def test_local_paths_need_no_fsspec(tmp_path: Path) -> None:
    (tmp_path / "a.png").write_bytes(png())
    code = (
        "import sys; from rasnik.archive.sources import find_items, frames_of\n"
        f"frames = [f for i in find_items([{str(tmp_path)!r}]) for f in frames_of(i)]\n"
        "assert frames[0].image is not None and 'fsspec' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_what_is_a_url() -> None:
    assert is_url("s3://bucket/x.png") and is_url("zip://a.png::/b.zip")
    assert is_url("simplecache::s3://bucket/x")
    for path in ("a.h5:/frames", "C:\\x.png", "/a/b.png", "x.png", "a:b.png"):
        assert not is_url(path)
