"""Frames in Zarr stores, read as those of HDF5 files are."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zarr
from numpy.typing import NDArray

from rasnik.io.formats import ImageFileError, open_stack
from rasnik.io.images import expand_paths, iter_frames
from rasnik.io.zarr_stack import zarr_bytes

SHAPE = (20, 30)


def stack_of(count: int, dtype: str = "u1") -> NDArray[Any]:
    levels = 1 + np.arange(count * SHAPE[0] * SHAPE[1]) % 200
    return levels.reshape(count, *SHAPE).astype(dtype)


def store(path: Path, data: NDArray[Any], chunks: tuple[int, ...], version: int = 3) -> Path:
    array = zarr.create_array(
        str(path), shape=data.shape, chunks=chunks, dtype=data.dtype, zarr_format=version
    )
    array[:] = data
    return path


def images(path: Path | str) -> list[NDArray[Any]]:
    frames = list(iter_frames([path]))
    assert all(frame.error is None for frame in frames)
    return [frame.image for frame in frames if frame.image is not None]


@pytest.mark.parametrize("version", [2, 3])
@pytest.mark.parametrize("dtype", ["u1", "u2", "f4"])
def test_stacks_of_both_versions(tmp_path: Path, version: int, dtype: str) -> None:
    data = stack_of(7, dtype)
    path = store(tmp_path / "frames.zarr", data, (3, *SHAPE), version)
    found = images(path)
    np.testing.assert_array_equal(np.stack(found), data)
    assert found[0].dtype == np.dtype(dtype)
    assert zarr_bytes(str(path)) == data.nbytes


def test_a_single_image_and_chunks_smaller_than_it(tmp_path: Path) -> None:
    data = stack_of(1)[0]
    path = store(tmp_path / "one", data, (7, 11))
    assert [source.name for source in expand_paths([path])] == [str(path)]
    np.testing.assert_array_equal(images(path)[0], data)


def test_frames_in_any_order_decode_each_chunk_once_in_a_row(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    data = stack_of(9)
    path = store(tmp_path / "frames.zarr", data, (4, *SHAPE))
    read = []
    get = zarr.Array.__getitem__

    def watched(self: Any, key: Any) -> Any:
        read.append(key)
        return get(self, key)

    monkeypatch.setattr(zarr.Array, "__getitem__", watched)
    with open_stack(path) as stack:
        assert stack.count == 9
        for k in (0, 1, 2, 3, 4, 8, 0):
            np.testing.assert_array_equal(stack.read(k)[0], data[k])
    assert len(read) == 4


def test_chunks_of_many_frames_are_read_in_pieces(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("rasnik.io.zarr_stack._MOST_BYTES", 2 * SHAPE[0] * SHAPE[1])
    data = stack_of(9)
    np.testing.assert_array_equal(
        np.stack(images(store(tmp_path / "frames.zarr", data, (9, *SHAPE)))), data
    )


def test_groups_with_times_and_a_named_array(tmp_path: Path) -> None:
    group = zarr.open_group(str(tmp_path / "run.zarr"), mode="w")
    camera = group.create_group("camera")
    camera.create_array("frames", shape=(3, *SHAPE), dtype="u1")[:] = stack_of(3)
    camera.create_array("time_s", shape=(3,), dtype="f8")[:] = [1e9, 1e9 + 1, np.nan]
    frames = list(iter_frames([tmp_path / "run.zarr"]))
    assert [frame.time_source for frame in frames] == ["metadata", "metadata", ""]
    assert frames[1].time_s == 1e9 + 1
    group.create_array("dark", shape=(2, *SHAPE), dtype="u1")[:] = stack_of(2)
    (frame,) = iter_frames([tmp_path / "run.zarr"])
    assert "several arrays that can be images (/camera/frames, /dark)" in str(frame.error)
    assert len(images(f"{tmp_path / 'run.zarr'}:/dark")) == 2
    (frame,) = iter_frames([f"{tmp_path / 'run.zarr'}:/bright"])
    assert "there is no array /bright in the Zarr store" in str(frame.error)


def test_a_missing_chunk_is_an_error_and_not_a_black_image(tmp_path: Path) -> None:
    path = store(tmp_path / "frames.zarr", stack_of(6), (2, *SHAPE))
    (path / "c" / "1" / "0" / "0").unlink()
    frames = list(iter_frames([path]))
    assert [frame.image is None for frame in frames] == [False, False, True, True, False, False]
    assert "a chunk of the Zarr store is missing" in str(frames[2].error)


def test_a_part_of_an_image_that_may_be_missing_is_noted(tmp_path: Path) -> None:
    path = store(tmp_path / "frames.zarr", stack_of(2), (1, 10, 10))
    (path / "c" / "1" / "0" / "2").unlink()
    whole, part = iter_frames([path])
    assert whole.notes == ()
    assert part.notes == ("1 of 6 chunks are 0 throughout, or missing",)


def test_a_damaged_chunk_costs_its_frames(tmp_path: Path) -> None:
    path = store(tmp_path / "frames.zarr", stack_of(6), (2, *SHAPE))
    chunk = path / "c" / "1" / "0" / "0"
    chunk.write_bytes(chunk.read_bytes()[:10])
    frames = list(iter_frames([path]))
    assert [frame.image is None for frame in frames] == [False, False, True, True, False, False]


def test_a_damaged_store_is_a_sentence(tmp_path: Path) -> None:
    path = store(tmp_path / "frames.zarr", stack_of(2), (2, *SHAPE))
    (path / "zarr.json").write_text("{")
    (frame,) = iter_frames([path])
    assert "the Zarr store cannot be opened" in str(frame.error)
    (tmp_path / "empty.zarr").mkdir()
    with (
        pytest.raises(ImageFileError, match="cannot be opened"),
        open_stack(tmp_path / "empty.zarr"),
    ):
        pass
    zarr.open_group(str(tmp_path / "none.zarr"), mode="w")
    (frame,) = iter_frames([tmp_path / "none.zarr"])
    assert "holds no image stack" in str(frame.error)
    assert zarr_bytes(str(path)) == 0
