"""Finding the images of an archive, and reading them with their times."""

import math
import os
import pickle
import zipfile
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import tifffile
import zarr
from PIL import Image

from rasnik.archive.layout import Layout
from rasnik.archive.sources import Item, LeftOut, find_items, frames_of

SHAPE = (40, 48)
WHEN_S = 1_704_067_200.0  # 2024-01-01


def picture(value: int = 1) -> np.ndarray[Any, Any]:
    return np.full(SHAPE, value, dtype=np.uint8)


def write(path: Path, value: int = 1) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(picture(value)).save(path)
    os.utime(path, (WHEN_S, WHEN_S))
    return path


@pytest.fixture
def archive(tmp_path: Path) -> Path:
    root = tmp_path / "archive"
    for instrument in ("EML2", "EML10"):
        for day in ("2024-01-02", "2024-01-10"):
            for k in (1, 2, 10):
                write(root / instrument / day / f"{k}.png", k)
    return root


def names(items: Iterator[Item], root: Path) -> list[str]:
    return [str(Path(item.url).relative_to(root)) for item in items]


# ------------------------------------------------------------------------ finding


def test_folders_in_natural_order_and_the_instrument_below_the_source(archive: Path) -> None:
    items = list(find_items([archive]))
    expected = [
        f"{instrument}/{day}/{k}.png"
        for instrument in ("EML2", "EML10")
        for day in ("2024-01-02", "2024-01-10")
        for k in (1, 2, 10)
    ]
    assert names(iter(items), archive) == expected
    assert [item.instrument for item in items] == ["EML2"] * 6 + ["EML10"] * 6
    first = items[0]
    assert first.size == Path(first.url).stat().st_size
    assert first.modified_s == WHEN_S and math.isnan(first.time_s)
    assert pickle.loads(pickle.dumps(first)).url == first.url


def test_the_search_is_lazy(archive: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    listed = []
    scandir = os.scandir

    def watched(path: str) -> Any:
        listed.append(Path(path).name)
        return scandir(path)

    monkeypatch.setattr(os, "scandir", watched)
    items = find_items([archive])
    assert listed == []
    next(items)
    assert "EML10" not in listed


def test_hidden_and_other_files_are_counted_and_named(archive: Path) -> None:
    (archive / "EML2" / "notes.txt").write_text("x")
    (archive / "EML2" / ".hidden.png").write_text("x")
    (archive / ".trash").mkdir()
    left_out = LeftOut()
    assert len(list(find_items([archive], None, left_out))) == 12
    assert left_out.counts == {"hidden": 2, "not an image": 1}
    assert left_out.names["not an image"] == [str(archive / "EML2" / "notes.txt")]


def test_faults_of_sources_are_sentences_and_the_rest_is_found(archive: Path) -> None:
    left_out = LeftOut()
    sources = [archive / "nothing", archive, "foo://x"]
    assert len(list(find_items(sources, None, left_out))) == 12
    text = "\n".join(left_out.faults)
    assert f"{archive / 'nothing'}: there is no such file or folder" in text
    assert "foo://x: the URL is of no kind known here" in text


def test_no_image_is_found_twice(tmp_path: Path, archive: Path) -> None:
    (archive / "EML2" / "back").symlink_to(archive)
    (archive / "EML2" / "latest").symlink_to("2024-01-10")
    (archive / "EML2" / "latest.png").symlink_to("2024-01-10/10.png")
    (archive / "up").symlink_to(tmp_path)
    left_out = LeftOut()
    write(tmp_path / "other" / "1.png")
    file = archive / "EML10" / "2024-01-10" / "1.png"
    sources = [file, archive / "EML10", archive, f"{archive}/../archive/EML2", tmp_path]
    urls = [item.url for item in find_items(sources, None, left_out)]
    assert len(urls) == 13 and len({os.path.realpath(url) for url in urls}) == 13
    assert urls[0] == str(file)
    assert os.path.realpath(urls[-1]) == str(tmp_path / "other" / "1.png")
    assert not left_out.faults and set(left_out.counts) == {"found elsewhere"}


def test_links_to_other_folders_are_followed_once(tmp_path: Path, archive: Path) -> None:
    source = tmp_path / "source"
    source.mkdir()
    (source / "a").symlink_to(archive / "EML2")
    (source / "b").symlink_to(archive / "EML2")
    left_out = LeftOut()
    items = list(find_items([source], None, left_out))
    assert {item.instrument for item in items} == {"a"} and len(items) == 6
    assert left_out.counts == {"found elsewhere": 1}


def test_a_link_in_a_circle_costs_itself_only(archive: Path) -> None:
    (archive / "EML2" / "2024-01-02" / "circle.png").symlink_to("circle.png")
    left_out = LeftOut()
    assert len(list(find_items([archive], left_out=left_out))) == 12
    assert left_out.counts == {"found elsewhere": 1}
    assert not left_out.faults


def test_sources_with_similar_names_are_two(tmp_path: Path) -> None:
    write(tmp_path / "run1" / "1.png")
    write(tmp_path / "run10" / "1.png")
    assert len(list(find_items([tmp_path / "run1", tmp_path / "run10"]))) == 2


def test_files_and_folders_of_images_as_sources(archive: Path) -> None:
    folder = archive / "EML2" / "2024-01-02"
    assert {item.instrument for item in find_items([folder])} == {"2024-01-02"}
    (one,) = find_items([folder / "1.png"])
    assert one.instrument == "2024-01-02"
    (one,) = find_items([folder / "1.png"], "{instrument}/{day}/*")
    assert one.instrument == "EML2"


def test_stacks_are_one_item_each(tmp_path: Path) -> None:
    root = tmp_path / "archive" / "EML1"
    root.mkdir(parents=True)
    with h5py.File(root / "a.h5", "w") as file:
        file["images"] = np.zeros((3, *SHAPE), np.uint8)
    store = zarr.create_array(
        str(root / "b.zarr"), shape=(5, *SHAPE), chunks=(2, *SHAPE), dtype="u1"
    )
    store[:] = 1 + np.arange(5, dtype=np.uint8)[:, None, None]
    tifffile.imwrite(root / "c.tif", np.ones((2, *SHAPE), np.uint8), photometric="minisblack")
    left_out = LeftOut()
    items = list(find_items([root.parent], None, left_out))
    assert [Path(item.url).name for item in items] == ["a.h5", "b.zarr", "c.tif"]
    assert items[1].size == 5 * SHAPE[0] * SHAPE[1]
    assert not left_out.counts
    assert [len(list(frames_of(item))) for item in items] == [3, 5, 2]
    (named,) = find_items([f"{root / 'a.h5'}:/images"])
    assert (named.dataset, named.instrument) == ("/images", "EML1")
    assert next(frames_of(named)).file == f"{root / 'a.h5'}:/images"


# ------------------------------------------------------------------------ patterns


@pytest.mark.parametrize(
    ("pattern", "path", "instrument", "when"),
    [
        ("{instrument}/{day}/*", "EML1/monday/1.png", "EML1", None),
        ("{day:%Y-%m-%d}/{instrument}_*.png", "2024-03-01/EML1_7.png", "EML1", (2024, 3, 1)),
        (
            "**/{instrument}-{time:%Y%m%dT%H%M%S}.tif",
            "a/b/EML-1-20240301T101112.tif",
            "EML-1",
            (2024, 3, 1, 10, 11, 12),
        ),
        (
            "{instrument}/{day:%Y%j}/{time:%H.%M.%S.%f}*",
            "E/2024061/10.11.12.5x.png",
            "E",
            (2024, 3, 1, 10, 11, 12, 500_000),
        ),
    ],
)
def test_patterns(pattern: str, path: str, instrument: str, when: tuple[int, ...] | None) -> None:
    found = Layout.parse(pattern).match(path)
    assert found is not None
    assert found[0] == instrument
    if when is None:
        assert math.isnan(found[1])
    else:
        year, month, day, *rest = when
        expected = datetime(year, month, day, *rest, tzinfo=UTC).timestamp()  # type: ignore[arg-type]
        assert found[1] == expected


def test_what_does_not_fit_the_pattern_is_counted(archive: Path) -> None:
    write(archive / "EML2" / "2024-02-30" / "1.png")  # no such day
    write(archive / "EML2" / "odd.png")
    left_out = LeftOut()
    items = list(find_items([archive], "{instrument}/{day:%Y-%m-%d}/*.png", left_out))
    assert len(items) == 12
    assert left_out.counts == {"outside the pattern": 2}
    assert items[0].time_s == datetime(2024, 1, 2, tzinfo=UTC).timestamp()


@pytest.mark.parametrize(
    ("pattern", "sentence"),
    [
        ("*/*.png", r"write \{instrument\}"),
        ("{instrument}/{instrument}", "twice"),
        ("{instrument}/{time:%H%M}", "without year and day"),
        ("{instrument}/{day:%Q}", "%Q is not read here"),
        ("{instrument/*", "brace without its other"),
    ],
)
def test_patterns_that_say_nothing_are_refused(pattern: str, sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        find_items(["."], pattern)


# ------------------------------------------------------------------------ times


def times(path: Path, **changed: float) -> list[tuple[float, str]]:
    (item,) = find_items([path])
    item = Item(**{**vars(item), **changed})
    return [(frame.time_s, frame.time_source) for frame in frames_of(item)]


def test_time_of_the_file_that_in_its_name_and_none(tmp_path: Path) -> None:
    path = write(tmp_path / "A" / "1.png")
    assert times(path) == [(WHEN_S, "modified")]
    assert times(path, time_s=5.0) == [(5.0, "name")]
    ((when, source),) = times(path, modified_s=math.nan)
    assert math.isnan(when) and source == ""


def test_times_of_tiff_pages(tmp_path: Path) -> None:
    path = tmp_path / "a.tif"
    with tifffile.TiffWriter(path) as writer:
        for second in (1, 2):
            writer.write(
                picture(), datetime=datetime(2024, 1, 1, 0, 0, second), photometric="minisblack",
                metadata=None,
            )  # fmt: skip
    assert times(path, time_s=5.0) == [(WHEN_S + 1, "metadata"), (WHEN_S + 2, "metadata")]


def test_times_of_recorded_frames_in_hdf5(tmp_path: Path) -> None:
    rows = np.zeros(2, dtype=[("frame", "i8"), ("host_time_s", "f8")])
    rows["host_time_s"] = (WHEN_S + 0.5, np.nan)
    for name, beside in (("poses", rows), ("time_s", np.array([WHEN_S + 0.5, 0.0]))):
        path = tmp_path / f"{name}.h5"
        with h5py.File(path, "w") as file:
            file["frames"] = np.ones((2, *SHAPE), np.uint8)
            file[name] = beside
        assert times(path, time_s=7.0) == [(WHEN_S + 0.5, "metadata"), (7.0, "name")]
    with h5py.File(path, "a") as file:  # seconds of the recording, not of the day
        file["time_s"][:] = (0.0, 0.5)
    assert times(path, time_s=7.0) == [(7.0, "name")] * 2


# ------------------------------------------------------------------------ reading


def test_frames_from_a_number_on(tmp_path: Path) -> None:
    path = tmp_path / "a.npy"
    np.save(path, np.arange(6, dtype=np.uint8)[:, None, None] + np.ones((6, *SHAPE), np.uint8))
    (item,) = find_items([path])
    assert [(f.frame, f.image.max()) for f in frames_of(item, 4) if f.image is not None] == [
        (4, 5),
        (5, 6),
    ]


def test_a_damaged_file_is_one_error_frame_with_its_time(tmp_path: Path) -> None:
    path = write(tmp_path / "A" / "1.png")
    path.write_bytes(path.read_bytes()[:60])
    os.utime(path, (WHEN_S, WHEN_S))
    (frame,) = frames_of(next(find_items([path])))
    assert frame.image is None and "truncated" in str(frame.error)
    assert (frame.time_s, frame.time_source) == (WHEN_S, "modified")


def test_a_file_that_vanished_is_one_error_frame(tmp_path: Path) -> None:
    path = write(tmp_path / "A" / "1.png")
    (item,) = find_items([path])
    path.unlink()
    (frame,) = frames_of(item)
    assert "no such file" in str(frame.error)


def test_a_zip_file_is_a_folder(tmp_path: Path, archive: Path) -> None:
    packed = tmp_path / "images.zip"
    with zipfile.ZipFile(packed, "w") as file:
        for path in sorted(archive.rglob("*.png")):
            file.write(path, path.relative_to(archive))
        file.writestr("EML2/2024-01-02/3.png", b"\x89PNG damaged")
        file.writestr("EML2/readme.txt", b"x")
    left_out = LeftOut()
    items = list(find_items([packed], None, left_out))
    assert [item.instrument for item in items] == ["EML2"] * 7 + ["EML10"] * 6
    assert items[2].url == f"zip://EML2/2024-01-02/3.png::{packed}"
    assert left_out.counts == {"not an image": 1}
    frames = [next(frames_of(item)) for item in items]
    assert [f.image is None for f in frames] == [k == 2 for k in range(13)]
    assert [int(f.image.max()) for f in frames if f.image is not None] == [1, 2, 10] * 4
    assert "truncated" in str(frames[2].error)
