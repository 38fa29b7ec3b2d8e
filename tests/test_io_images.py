"""Reading frames: every format gives the grey levels that were stored; bad files say why."""

from __future__ import annotations

import json
import os
from pathlib import Path

import h5py
import numpy as np
import pytest
import tifffile
from PIL import Image

from rasnik.io.images import Frame, count_frames, expand_paths, iter_frames
from rasnik.io.lwdaq import lwdaq_bounds

HEIGHT, WIDTH = 24, 30
GREY = np.random.default_rng(7).integers(0, 256, (HEIGHT, WIDTH), dtype=np.uint8)
DEEP = np.random.default_rng(8).integers(0, 4096, (HEIGHT, WIDTH), dtype=np.uint16)
STACK = np.stack([GREY, GREY[::-1], GREY[:, ::-1]])


def only_frame(path: Path | str) -> Frame:
    frames = list(iter_frames([path]))
    assert len(frames) == 1
    return frames[0]


def image_of(path: Path | str) -> np.ndarray:
    frame = only_frame(path)
    assert frame.error is None
    assert frame.image is not None
    return frame.image


def error_of(path: Path | str) -> str:
    """The one error sentence, which must name the file and end like a sentence."""
    frame = only_frame(path)
    assert frame.image is None
    assert frame.error is not None
    assert Path(str(path)).name in frame.error
    assert frame.error.endswith(".")
    assert "\n" not in frame.error
    return frame.error


def write_pgm(path: Path, image: np.ndarray, maximum: int, plain: bool = False) -> None:
    head = (
        f"P{2 if plain else 5}\n# made for a test\n{image.shape[1]} {image.shape[0]}\n{maximum}\n"
    )
    if plain:
        body = "\n".join(" ".join(map(str, row)) for row in image).encode()
    else:
        body = image.astype("u1" if maximum < 256 else ">u2").tobytes()
    path.write_bytes(head.encode() + body)


# ------------------------------------------------------------------------ formats


@pytest.mark.parametrize("name", ["a.png", "a.gif", "a.bmp", "a.pgm", "a.tif", "a.npy"])
def test_8_bit_formats_give_the_stored_levels(tmp_path, name):
    path = tmp_path / name
    np.save(path, GREY) if path.suffix == ".npy" else Image.fromarray(GREY).save(path)
    image = image_of(path)
    assert image.dtype == np.uint8
    np.testing.assert_array_equal(image, GREY)
    assert only_frame(path).notes == ()


@pytest.mark.parametrize("name", ["a.png", "a.tif", "a.npy", "a.pgm", "b.tif"])
def test_12_bit_levels_in_16_bits_are_not_stretched(tmp_path, name):
    path = tmp_path / name
    if name == "a.png":
        Image.fromarray(DEEP).save(path)
    elif name == "a.npy":
        np.save(path, DEEP)
    elif name == "a.pgm":
        write_pgm(path, DEEP, 4095)
    else:
        tifffile.imwrite(path, DEEP, byteorder=">" if name == "b.tif" else "<")
    image = image_of(path)
    assert image.dtype == np.uint16
    assert image.dtype.isnative
    np.testing.assert_array_equal(image, DEEP)


@pytest.mark.parametrize("suffix", [".npy", ".tif"])
def test_float_images(tmp_path, suffix):
    path = tmp_path / f"a{suffix}"
    image = (GREY / 7).astype(np.float32)
    np.save(path, image) if suffix == ".npy" else tifffile.imwrite(path, image)
    np.testing.assert_array_equal(image_of(path), image)


def test_plain_pgm_and_several_images_in_one_pgm(tmp_path):
    write_pgm(tmp_path / "plain.pgm", GREY, 255, plain=True)
    np.testing.assert_array_equal(image_of(tmp_path / "plain.pgm"), GREY)
    write_pgm(tmp_path / "one.pgm", GREY, 255)
    one = (tmp_path / "one.pgm").read_bytes()
    (tmp_path / "two.pgm").write_bytes(one + one)
    frames = list(iter_frames([tmp_path / "two.pgm"]))
    assert [frame.frame for frame in frames] == [0, 1]
    np.testing.assert_array_equal(frames[1].image, GREY)


def test_gif_palette_is_applied(tmp_path):
    """Indices into a palette in any order are not grey levels."""
    order = np.random.default_rng(1).permutation(256).astype(np.uint8)
    index_of = np.argsort(order).astype(np.uint8)
    picture = Image.fromarray(index_of[GREY])
    picture = Image.frombytes("P", picture.size, picture.tobytes())
    picture.putpalette(np.repeat(order, 3).tobytes())
    picture.save(tmp_path / "a.gif", optimize=False)
    with Image.open(tmp_path / "a.gif") as stored:
        assert not np.array_equal(np.asarray(stored), GREY)
    np.testing.assert_array_equal(image_of(tmp_path / "a.gif"), GREY)


def test_palette_tiff(tmp_path):
    order = np.random.default_rng(1).permutation(256).astype(np.uint16)
    index_of = np.argsort(order).astype(np.uint8)
    tifffile.imwrite(
        tmp_path / "a.tif",
        index_of[GREY],
        photometric="palette",
        colormap=np.broadcast_to(order * 257, (3, 256)),
    )
    np.testing.assert_array_equal(image_of(tmp_path / "a.tif"), GREY)


def test_tiff_with_white_as_zero_is_inverted_and_says_so(tmp_path):
    tifffile.imwrite(tmp_path / "a.tif", 255 - GREY, photometric="miniswhite")
    np.testing.assert_array_equal(image_of(tmp_path / "a.tif"), GREY)
    assert "inverted" in only_frame(tmp_path / "a.tif").notes[0]


@pytest.mark.parametrize("name", ["a.png", "a.tif", "a.npy", "a.ppm"])
def test_colour_becomes_luminance_and_says_so(tmp_path, name):
    colours = np.random.default_rng(2).integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)
    path = tmp_path / name
    np.save(path, colours) if name == "a.npy" else Image.fromarray(colours).save(path)
    frame = only_frame(path)
    red, green, blue = np.moveaxis(colours.astype(float), -1, 0)
    expected = 0.299 * red + 0.587 * green + 0.114 * blue
    np.testing.assert_allclose(frame.image, expected, atol=1e-4)
    assert frame.notes == ("colour converted to grey (Rec. 601 luminance)",)


def test_grey_stored_as_colour_is_exact(tmp_path):
    Image.fromarray(np.repeat(GREY[..., None], 3, axis=2)).save(tmp_path / "a.png")
    frame = only_frame(tmp_path / "a.png")
    assert frame.image.dtype == np.uint8
    np.testing.assert_array_equal(frame.image, GREY)
    assert frame.notes == ()


def test_transparency_is_ignored_and_said(tmp_path):
    alpha = np.full_like(GREY, 255)
    alpha[0, 0] = 0
    Image.merge("LA", [Image.fromarray(GREY), Image.fromarray(alpha)]).save(tmp_path / "a.png")
    frame = only_frame(tmp_path / "a.png")
    np.testing.assert_array_equal(frame.image, GREY)
    assert frame.notes == ("transparency ignored",)


def test_format_is_found_from_the_content(tmp_path):
    Image.fromarray(GREY).save(tmp_path / "a.png")
    (tmp_path / "a.png").rename(tmp_path / "a.tif")
    np.testing.assert_array_equal(image_of(tmp_path / "a.tif"), GREY)


# ------------------------------------------------------------------------ stacks


def write_stack(path: Path, kind: str) -> None:
    pages = [Image.fromarray(page) for page in STACK]
    match kind:
        case "npy":
            np.save(path, STACK)
        case "h5":
            with h5py.File(path, "w") as file:
                file["entry/data"] = STACK
                file["entry/time"] = np.arange(3.0)
        case "gif":
            pages[0].save(path, save_all=True, append_images=pages[1:], optimize=False)
        case "tif":
            tifffile.imwrite(path, STACK, photometric="minisblack")
        case "lzw":
            pages[0].save(path, save_all=True, append_images=pages[1:], compression="tiff_lzw")
        case "zlib":
            tifffile.imwrite(path, STACK, photometric="minisblack", compression="zlib")
        case "imagej":
            tifffile.imwrite(path, STACK.astype(np.uint16), imagej=True, byteorder=">")
        case "big":
            tifffile.imwrite(path, STACK, photometric="minisblack", bigtiff=True)


STACKS = {
    "npy": "a.npy",
    "h5": "a.h5",
    "gif": "a.gif",
    "tif": "a.tif",
    "lzw": "a.tif",
    "zlib": "a.tif",
    "imagej": "a.tif",
    "big": "a.tif",
}


@pytest.mark.parametrize(("kind", "name"), STACKS.items())
def test_stacks_give_every_frame(tmp_path, kind, name):
    path = tmp_path / name
    write_stack(path, kind)
    frames = list(iter_frames([path]))
    assert [frame.frame for frame in frames] == [0, 1, 2]
    assert [frame.error for frame in frames] == [None] * 3
    for frame, page in zip(frames, STACK, strict=True):
        np.testing.assert_array_equal(frame.image, page)
    assert count_frames(expand_paths([path])[0]) == 3


def test_hdf5_dataset_is_chosen_by_name(tmp_path):
    path = tmp_path / "a.h5"
    with h5py.File(path, "w") as file:
        file["one"], file["group/two"] = STACK, STACK[::-1]
    reason = error_of(path)
    assert "/one" in reason
    assert "/group/two" in reason
    frames = list(iter_frames([f"{path}:/group/two"]))
    np.testing.assert_array_equal(frames[0].image, STACK[2])
    assert frames[0].file == f"{path}:/group/two"
    assert "no dataset /three" in error_of(f"{path}:/three")


def test_hdf5_without_images(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["time"] = np.arange(5.0)
    assert "no image stack" in error_of(tmp_path / "a.h5")


# ------------------------------------------------------------------------ finding files


def test_folder_is_sorted_by_number_and_holds_only_images(tmp_path):
    for name in ("f10.png", "f9.png", "F2.PNG"):
        Image.fromarray(GREY).save(tmp_path / name)
    (tmp_path / "notes.txt").write_text("not an image")
    (tmp_path / "sub.png").mkdir()
    names = [Path(frame.file).name for frame in iter_frames([tmp_path])]
    assert names == ["F2.PNG", "f9.png", "f10.png"]


def test_patterns_are_expanded(tmp_path):
    for name in ("a10.png", "a9.png", "b.png"):
        Image.fromarray(GREY).save(tmp_path / name)
    names = [Path(frame.file).name for frame in iter_frames([f"{tmp_path}/a*.png"])]
    assert names == ["a9.png", "a10.png"]
    assert "no file matches" in error_of(f"{tmp_path}/c*.png")


def test_a_name_with_brackets_that_exists_is_no_pattern(tmp_path):
    path = tmp_path / "run[1].png"
    Image.fromarray(GREY).save(path)
    np.testing.assert_array_equal(image_of(path), GREY)


def test_folder_without_images(tmp_path):
    (tmp_path / "notes.txt").write_text("not an image")
    assert "no images" in error_of(tmp_path)


# ------------------------------------------------------------------------ bad files


def test_missing_file(tmp_path):
    assert "no such file" in error_of(tmp_path / "nothing.png")


def test_empty_file(tmp_path):
    (tmp_path / "a.png").touch()
    assert "empty" in error_of(tmp_path / "a.png")


def test_text_in_an_image_file(tmp_path):
    (tmp_path / "a.png").write_text("this is not an image")
    assert "not that of a .png image" in error_of(tmp_path / "a.png")


def test_unsupported_suffix(tmp_path):
    (tmp_path / "a.txt").write_text("this is not an image")
    reason = error_of(tmp_path / "a.txt")
    assert ".txt is not an image format" in reason
    assert "png" in reason


@pytest.mark.skipif(os.name != "posix" or os.geteuid() == 0, reason="root reads everything")
def test_file_without_permission(tmp_path):
    Image.fromarray(GREY).save(tmp_path / "a.png")
    (tmp_path / "a.png").chmod(0)
    assert "permission denied" in error_of(tmp_path / "a.png")


@pytest.mark.parametrize(
    ("array", "words"),
    [
        (np.zeros(5), "1 dimensions"),
        (np.zeros((2, 2, 5, 6)), "4 dimensions"),
        (np.zeros((0, 5)), "is empty"),
        (np.zeros((5, 6), dtype=complex), "complex128"),
        (np.array(["text"]), "U4"),
        (np.array([{}], dtype=object), "integers or floats"),
        (np.full((5, 6), np.nan), "every pixel is NaN"),
    ],
)
def test_arrays_that_are_no_images(tmp_path, array, words):
    np.save(tmp_path / "a.npy", array, allow_pickle=True)
    assert words in error_of(tmp_path / "a.npy")


def test_sizes_that_would_fill_the_memory_are_refused_unread(tmp_path):
    """A few bytes ask for 3.6 GB; what a bit that flipped in a header does."""
    side = 60_000
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.create_dataset("frames", (1, side, side), "u1", chunks=(1, 100, 100))
    with open(tmp_path / "a.npy", "wb") as file:
        shape = {"descr": "|u1", "fortran_order": False, "shape": (side, side)}
        np.lib.format.write_array_header_1_0(file, shape)
        file.truncate(file.tell() + side * side)  # a hole, not on the disk
    small = np.full((256, 256), 7, np.uint8)
    tifffile.imwrite(tmp_path / "a.tif", small, compression="zlib", metadata=None)
    with tifffile.TiffFile(tmp_path / "a.tif", mode="r+") as tif:
        for name in ("ImageWidth", "ImageLength"):
            tif.pages[0].tags[name].overwrite(side)
    for name in ("a.h5", "a.npy", "a.tif"):
        assert "60000 x 60000 pixels, more than the 256 million" in error_of(tmp_path / name)


def test_a_few_nan_pixels_are_noted(tmp_path):
    image = GREY.astype(np.float32)
    image[3, 4] = np.nan
    np.save(tmp_path / "a.npy", image)
    frame = only_frame(tmp_path / "a.npy")
    assert frame.notes == ("1 of 720 pixels are NaN or infinite",)
    np.testing.assert_array_equal(frame.image, image)


def test_one_bad_frame_leaves_the_others_of_the_stack(tmp_path):
    stack = STACK.astype(np.float32)
    stack[1] = np.nan
    np.save(tmp_path / "a.npy", stack)
    frames = list(iter_frames([tmp_path / "a.npy"]))
    assert [frame.error is None for frame in frames] == [True, False, True]


def test_one_bad_file_leaves_the_others(tmp_path):
    Image.fromarray(GREY).save(tmp_path / "a.png")
    (tmp_path / "b.png").touch()
    Image.fromarray(GREY).save(tmp_path / "c.png")
    frames = list(iter_frames([tmp_path, tmp_path / "missing.png"]))
    assert [frame.error is None for frame in frames] == [True, False, True, False]


SINGLE = ["png", "gif", "bmp", "jpg", "tif", "pgm", "npy", "h5"]


@pytest.mark.filterwarnings("ignore:Corrupt EXIF")
@pytest.mark.parametrize("kind", [*SINGLE, *(k for k in STACKS if k not in SINGLE)])
def test_truncated_files_are_never_taken_for_whole_ones(tmp_path, kind, caplog):
    """At any length: an error, and every frame given is as it was, none of them half empty."""
    name = STACKS.get(kind, f"a.{kind}")
    path, cut = tmp_path / name, tmp_path / f"cut{Path(name).suffix}"
    if kind in STACKS:
        write_stack(path, kind)
    else:
        Image.fromarray(GREY).save(path)
    whole = [frame.image for frame in iter_frames([path])]
    data = path.read_bytes()
    # Some writers pad the end of the file; what is cut there is not missed.
    lengths = {*np.linspace(1, len(data) - 20, 40).astype(int)}
    for length in sorted(lengths):
        cut.write_bytes(data[:length])
        frames = list(iter_frames([cut]))
        assert frames[-1].error is not None, length
        for frame in frames:
            if frame.image is not None:
                np.testing.assert_array_equal(frame.image, whole[frame.frame])


def test_whole_pages_of_a_truncated_tiff_come_out(tmp_path):
    write_stack(tmp_path / "a.tif", "zlib")
    data = (tmp_path / "a.tif").read_bytes()
    (tmp_path / "a.tif").write_bytes(data[: len(data) - 100])
    frames = list(iter_frames([tmp_path / "a.tif"]))
    assert [frame.error is None for frame in frames] == [True, True, False]
    assert "truncated" in frames[2].error


# ------------------------------------------------------------------------ LWDAQ


def with_header(*numbers: int) -> np.ndarray:
    """An image with last row, last column, top, left, bottom, right in row 0."""
    image = GREY.copy()
    image[0, :12] = np.array(numbers, dtype=">u2").view(np.uint8)
    return image


def test_lwdaq_header_gives_bounds_and_is_no_picture(tmp_path):
    np.save(tmp_path / "a.npy", with_header(HEIGHT - 1, WIDTH - 1, 2, 5, 20, 28))
    frame = only_frame(tmp_path / "a.npy")
    assert frame.bounds_px == (5, 2, 28, 20)
    assert frame.header_rows == 1
    assert "LWDAQ header in row 0: bounds 5,2,28,20" in frame.notes


def test_lwdaq_header_without_bounds_leaves_out_row_0():
    image = with_header(HEIGHT - 1, WIDTH - 1, 0, 0, 0, 0)
    assert lwdaq_bounds(image) == (0, 1, WIDTH - 1, HEIGHT - 1)


@pytest.mark.parametrize(
    "numbers", [(HEIGHT, WIDTH - 1, 2, 5, 20, 28), (WIDTH - 1, HEIGHT - 1, 2, 5, 20, 28)]
)
def test_other_numbers_in_row_0_are_no_header(numbers):
    assert lwdaq_bounds(with_header(*numbers)) is None


def test_plain_images_have_no_header():
    assert lwdaq_bounds(GREY) is None
    assert lwdaq_bounds(np.zeros((2, 12), dtype=np.uint8)) is None
    assert lwdaq_bounds(DEEP) is None


def test_given_bounds_leave_out_the_header():
    frame = Frame("a", image=GREY, bounds_px=(5, 2, 28, 20), header_rows=1)
    assert frame.clip_bounds(None) == (5, 2, 28, 20)
    assert frame.clip_bounds((0, 0, 29, 23)) == (0, 1, 29, 23)
    with pytest.raises(ValueError, match="last column is 29 and last row 23"):
        frame.clip_bounds((0, 0, 30, 23))


def test_real_images_have_the_bounds_of_their_headers(shared):
    for entry in json.loads(shared("real/reference.json").read_text()):
        frame = only_frame(shared("real") / entry["file"])
        assert frame.image.dtype == np.uint8
        assert frame.image.shape == (entry["height"], entry["width"])
        assert list(frame.bounds_px) == entry["bounds_left_top_right_bottom"]
