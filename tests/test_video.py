"""Video files: the grey levels that were stored come out, and what altered them is told."""

from __future__ import annotations

import struct
import sys
from pathlib import Path

import numpy as np
import pytest

from rasnik.io.images import Frame, count_frames, expand_paths, iter_frames

HEIGHT, WIDTH = 54, 71  # odd: rows are padded in the decoder


def levels(bits: int, frames: int = 7) -> np.ndarray:
    dtype = np.uint8 if bits == 8 else np.uint16
    return np.random.default_rng(bits).integers(0, 2**bits, (frames, HEIGHT, WIDTH), dtype=dtype)


def write_video(path: Path, images: np.ndarray, codec: str, pixels: str, **options: str) -> Path:
    """Encode frames; those of YUV formats get the images as luma and no colour."""
    av = pytest.importorskip("av", reason="PyAV is missing: pip install 'rasnik[video]'")
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=50)
        stream.height, stream.width = images.shape[1:]
        stream.pix_fmt, stream.options = pixels, options
        for image in images:
            for packet in stream.encode(av_frame(av, image, pixels)):
                container.mux(packet)
        for packet in stream.encode():
            container.mux(packet)
    return path


def av_frame(av, image: np.ndarray, pixels: str):
    frame = av.VideoFrame(image.shape[1], image.shape[0], pixels)
    for number, plane in enumerate(frame.planes):
        grey = 128 if image.dtype == np.uint8 else 512
        filled = np.full((plane.height, plane.line_size // image.itemsize), grey, image.dtype)
        if number == 0:
            filled[:, : image.shape[1]] = image
        plane.update(filled.tobytes())
    return frame


def read(path: Path, start: int = 0) -> list[Frame]:
    frames = list(iter_frames([path], start))
    assert all(frame.error is None for frame in frames), [frame.error for frame in frames]
    return frames


# ------------------------------------------------------------------------ exact grey levels


@pytest.mark.parametrize(
    ("name", "codec", "pixels", "bits"),
    [
        ("v.mkv", "ffv1", "gray", 8),
        ("v.avi", "ffv1", "gray", 8),
        ("v.mkv", "ffv1", "gray10le", 10),
        ("v.mkv", "ffv1", "gray12le", 12),
        ("v.avi", "ffv1", "gray16le", 16),
        ("v.mkv", "rawvideo", "gray", 8),
        ("v.avi", "rawvideo", "gray", 8),
        ("v.mov", "rawvideo", "gray", 8),  # comes back with a palette
        ("v.nut", "rawvideo", "gray12le", 12),
        ("v.nut", "rawvideo", "gray16be", 16),
        ("v.avi", "png", "gray", 8),
    ],
)
def test_lossless_grey_comes_back_bit_by_bit(tmp_path, name, codec, pixels, bits):
    images = levels(bits)
    stored = images.byteswap() if pixels.endswith("be") else images
    frames = read(write_video(tmp_path / name, stored, codec, pixels))
    assert [frame.frame for frame in frames] == list(range(len(images)))
    for frame, image in zip(frames, images, strict=True):
        assert frame.image.dtype == image.dtype
        np.testing.assert_array_equal(frame.image, image)
        assert frame.notes == ()


@pytest.mark.parametrize(
    ("codec", "pixels", "bits", "words"),
    [
        ("ffv1", "yuv420p", 8, "16 to 235"),
        ("ffv1", "yuv422p10le", 10, "64 to 940"),
        ("ffv1", "yuv444p16le", 16, "4096 to 60160"),
    ],
)
def test_luma_is_taken_as_stored(tmp_path, codec, pixels, bits, words):
    images = levels(bits)[:, :, :70]
    for frame, image in zip(
        read(write_video(tmp_path / "v.mkv", images, codec, pixels)), images, strict=True
    ):
        np.testing.assert_array_equal(frame.image, image)
        (note,) = frame.notes
        assert f"luma of {pixels} as stored" in note
        assert words in note


@pytest.mark.parametrize(("pixels", "first"), [("yuyv422", 0), ("uyvy422", 1)])
def test_luma_between_colours(tmp_path, pixels, first):
    packed = np.full((3, HEIGHT, 2 * 70), 128, dtype=np.uint8)
    packed[:, :, first::2] = levels(8, 3)[:, :, :70]
    av = pytest.importorskip("av", reason="PyAV is missing: pip install 'rasnik[video]'")
    with av.open(str(tmp_path / "v.nut"), "w") as container:
        stream = container.add_stream("rawvideo", rate=50)
        stream.width, stream.height, stream.pix_fmt = 70, HEIGHT, pixels
        for image in packed:
            frame = av.VideoFrame(70, HEIGHT, pixels)
            rows = np.zeros((HEIGHT, frame.planes[0].line_size), dtype=np.uint8)
            rows[:, :140] = image
            frame.planes[0].update(rows.tobytes())
            for packet in stream.encode(frame):
                container.mux(packet)
    for frame, image in zip(read(tmp_path / "v.nut"), packed, strict=True):
        np.testing.assert_array_equal(frame.image, image[:, first::2])


def test_lossy_codecs_are_told(tmp_path):
    smooth = np.broadcast_to(np.linspace(40, 200, 72), (4, HEIGHT, 72)).astype(np.uint8)
    jpeg = read(write_video(tmp_path / "j.avi", smooth, "mjpeg", "yuvj420p"))
    assert jpeg[0].notes[0] == "mjpeg compression has altered the grey levels"
    assert "range" not in jpeg[0].notes[1]  # JPEG uses all levels
    assert np.abs(jpeg[0].image.astype(float) - smooth[0]).max() < 5
    film = read(write_video(tmp_path / "f.mp4", smooth, "libx264", "yuv420p", qp="0"))
    assert film[0].notes[0] == "h264 compression may have altered the grey levels"
    np.testing.assert_array_equal(film[2].image, smooth[2])  # qp 0 is lossless


def test_rows_stored_from_the_bottom_up(tmp_path):
    """AVI with a palette of greys, as camera programs write it: not to be mirrored."""
    images = levels(8, 3)
    path = tmp_path / "dib.avi"
    path.write_bytes(palette_avi(images))
    for frame, image in zip(read(path), images, strict=True):
        np.testing.assert_array_equal(frame.image, image)


def palette_avi(images: np.ndarray) -> bytes:
    """The bytes of an uncompressed AVI: 8 bits, grey palette, last row first."""

    def chunk(tag: bytes, data: bytes) -> bytes:
        return tag + struct.pack("<I", len(data)) + data + b"\0" * (len(data) % 2)

    count, height, width = images.shape
    row = -(-width // 4) * 4
    padded = np.zeros((count, height, row), dtype=np.uint8)
    padded[:, :, :width] = images[:, ::-1]
    size = row * height
    main = struct.pack("<14I", 20000, 0, 0, 0x10, count, 0, 1, size, width, height, 0, 0, 0, 0)
    head = b"vidsDIB " + struct.pack("<10I", 0, 0, 0, 1, 50, 0, count, size, 0, 0)
    head += struct.pack("<4h", 0, 0, width, height)
    bitmap = struct.pack("<IiiHHIIiiII", 40, width, height, 1, 8, 0, size, 0, 0, 256, 256)
    bitmap += b"".join(bytes((k, k, k, 0)) for k in range(256))
    stream = b"strl" + chunk(b"strh", head) + chunk(b"strf", bitmap)
    headers = b"hdrl" + chunk(b"avih", main) + chunk(b"LIST", stream)
    pictures = b"movi" + b"".join(chunk(b"00db", image.tobytes()) for image in padded)
    return chunk(b"RIFF", b"AVI " + chunk(b"LIST", headers) + chunk(b"LIST", pictures))


# ------------------------------------------------------------------------ counting, skipping


@pytest.mark.parametrize(
    ("name", "codec", "pixels", "options"),
    [
        ("v.mkv", "ffv1", "gray", {}),  # a key frame every 12 frames
        ("v.avi", "rawvideo", "gray", {}),
        ("v.mp4", "libx264", "yuv420p", {"qp": "0", "bf": "2", "g": "10"}),  # reordered frames
    ],
)
def test_frames_are_left_out_as_if_they_had_been_read(tmp_path, name, codec, pixels, options):
    images = levels(8, 30)[:, :, :70]
    path = write_video(tmp_path / name, images, codec, pixels, **options)
    assert count_frames(expand_paths([path])[0]) == 30
    for start in (0, 1, 11, 12, 13, 24, 29, 30):
        frames = read(path, start)
        assert [frame.frame for frame in frames] == list(range(start, 30))
        for frame in frames:
            np.testing.assert_array_equal(frame.image, images[frame.frame])


def test_frames_are_left_out_across_files(tmp_path):
    images = levels(8, 5)
    first = write_video(tmp_path / "a.mkv", images, "ffv1", "gray")
    np.save(tmp_path / "b.npy", images[:3])
    last = write_video(tmp_path / "c.avi", images, "ffv1", "gray")
    everything = list(iter_frames([first, tmp_path / "missing.png", tmp_path / "b.npy", last]))
    assert len(everything) == 5 + 1 + 3 + 5
    for start in range(15):
        rest = list(iter_frames([first, tmp_path / "missing.png", tmp_path / "b.npy", last], start))
        assert [(f.file, f.frame) for f in rest] == [(f.file, f.frame) for f in everything[start:]]


def test_folders_of_videos(tmp_path):
    write_video(tmp_path / "v10.mkv", levels(8), "ffv1", "gray")
    write_video(tmp_path / "v9.mkv", levels(8), "ffv1", "gray")
    assert [s.path.name for s in expand_paths([tmp_path])] == ["v9.mkv", "v10.mkv"]
    (tmp_path / "still.pgm").write_bytes(b"P5 1 1 255\n0")
    assert [s.path.name for s in expand_paths([tmp_path])] == ["still.pgm"]


def test_the_name_need_not_tell_what_it_is(tmp_path):
    path = write_video(tmp_path / "v.mkv", levels(8), "ffv1", "gray").rename(tmp_path / "camera")
    assert len(read(path)) == 7


# ------------------------------------------------------------------------ what is damaged


@pytest.mark.parametrize("name", ["v.avi", "v.mkv"])
def test_truncated_videos_give_what_they_hold_and_say_so(tmp_path, name):
    images = levels(8, 20)
    path = write_video(tmp_path / name, images, "ffv1", "gray", g="1")
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])
    frames = list(iter_frames([path]))
    good = [frame for frame in frames if frame.image is not None]
    assert 5 <= len(good) < 12
    for frame in good:
        np.testing.assert_array_equal(frame.image, images[frame.frame])
    assert "truncated" in frames[-1].error or "cut off" in frames[-1].error
    assert all(Path(f.file).name == name for f in frames)


def test_a_damaged_frame_leaves_the_others(tmp_path):
    path = write_video(tmp_path / "v.avi", levels(8, 24), "mjpeg", "yuvj420p")
    whole = read(path)
    data = bytearray(path.read_bytes())
    scans = [k for k in range(len(data)) if data[k : k + 2] == b"\xff\xda"]
    middle = slice(scans[12] + 100, scans[12] + 400)
    data[middle] = bytes(byte ^ 0x5A for byte in data[middle])
    path.write_bytes(data)
    frames = list(iter_frames([path]))
    assert [frame.image is None for frame in frames] == [k == 12 for k in range(24)]
    assert "v.avi[12]: the frame cannot be decoded" in frames[12].error
    for frame, before in zip(frames[13:], whole[13:], strict=True):
        np.testing.assert_array_equal(frame.image, before.image)


def test_what_is_no_video_is_refused_with_a_reason(tmp_path):
    (tmp_path / "v.mp4").write_bytes(b"\0\0\0\x18ftypmp42" + bytes(100))
    (tmp_path / "w.mkv").write_bytes(b"nothing of the kind")
    pytest.importorskip("av", reason="PyAV is missing: pip install 'rasnik[video]'")
    for name in ("v.mp4", "w.mkv"):
        (frame,) = iter_frames([tmp_path / name])
        assert frame.image is None
        assert name in frame.error
        assert "cannot be opened" in frame.error


def test_without_pyav_the_extra_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "av", None)
    (tmp_path / "v.mp4").write_bytes(b"\0\0\0\x18ftypmp42" + bytes(100))
    (frame,) = iter_frames([tmp_path / "v.mp4"])
    assert frame.error.endswith('install it with: pip install "rasnik[video]".')
