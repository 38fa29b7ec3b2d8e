"""Files behind URLs, through fsspec: listed, and copied here for the readers of image files.

A copy lies in the folder for temporary files while it is read, and no longer. What the network
refuses for a moment is tried again.
"""

from __future__ import annotations

import math
import os
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from functools import lru_cache
from pathlib import Path, PurePosixPath
from typing import Any, TypeVar

from rasnik.io.folders import ZARR_MARKS, Entry
from rasnik.io.formats import ImageFileError, Stack, open_stack

__all__ = ["list_remote", "local_copy", "open_remote", "remote_entry"]

#: Space to leave on the disk for temporary files.
KEEP_FREE_BYTES = 1 << 28

_TRIES = 4
_FIRST_PAUSE_S = 0.5

Result = TypeVar("Result")


def remote_entry(url: str) -> Entry:
    """A file or folder by URL; raises OSError with a sentence."""
    system, path = _connect(url)
    if path.rstrip("/") == "":  # the top of a zip file has no entry of its own
        return Entry(url, _name(url), True, False, lambda: (0, math.nan))
    info = _tried(url, lambda: system.info(path))
    return _entry(url, info)


def list_remote(url: str) -> list[Entry]:
    """What a folder behind a URL holds; raises OSError with a sentence."""
    system, path = _connect(url)
    return [
        _entry(_below(url, info["name"]), info)
        for info in _tried(url, lambda: system.ls(path, detail=True))
        if info["name"].strip("/") != path.strip("/")  # stores of objects list the folder itself
    ]


def _below(folder: str, name: str) -> str:
    """URL of what lies in a folder, from its name as the file system has it."""
    if "://" in name:
        return name
    first, chain, rest = folder.partition("::")
    last = name.rstrip("/").rpartition("/")[2]
    if "://" not in first:  # simplecache::s3://bucket/folder
        return f"{folder.rstrip('/')}/{last}"
    top = first if first.endswith("://") else f"{first.rstrip('/')}/"
    return f"{top}{last}{chain}{rest}"


@contextmanager
def local_copy(url: str) -> Iterator[Path]:
    """A temporary copy of a file, under its own name; it is deleted in the end.

    Raises
    ------
    OSError
        With a sentence: it is not there, may not be read, the network fails, or the disk for
        temporary files has no room for it.
    """
    system, path = _connect(url)
    size = _tried(url, lambda: system.info(path)).get("size")
    with tempfile.TemporaryDirectory(prefix="rasnik-") as folder:
        room = shutil.disk_usage(folder).free - KEEP_FREE_BYTES
        if size is not None and size > room:
            raise OSError(
                f"the file has {size >> 20} MiB, but the disk for temporary files has room for "
                f"{max(0, room) >> 20} MiB; make space, or set TMPDIR to a larger disk"
            )
        copy = Path(folder) / _name(url)
        _tried(url, lambda: system.get_file(path, str(copy)))
        if not copy.is_file():
            raise OSError("this is not a file; name image files, or a folder of them")
        if size is not None and copy.stat().st_size != size:
            raise OSError(f"only {copy.stat().st_size} of {size} bytes came; try again")
        yield copy


@contextmanager
def open_remote(url: str, dataset: str | None = None) -> Iterator[Stack]:
    """Open an image file or a Zarr store behind a URL; see `rasnik.io.formats.open_stack`.

    Raises
    ------
    ImageFileError
        If it cannot be reached or read.
    """
    try:
        entry = remote_entry(url)
        is_store = entry.is_folder and (
            url.rstrip("/").lower().endswith(".zarr")
            or any(inside.name in ZARR_MARKS for inside in list_remote(url))
        )
        if is_store:
            from rasnik.io.zarr_stack import open_zarr

            with open_zarr(url, dataset) as stack:
                yield stack
            return
        with local_copy(url) as copy, open_stack(copy, dataset) as stack:
            yield stack
    except (OSError, ImportError) as error:
        raise ImageFileError(str(error)) from error


def _connect(url: str) -> tuple[Any, str]:
    """(file system, path in it) of a URL; raises OSError or ImportError with a sentence."""
    try:
        import fsspec
    except ImportError:
        raise ImportError(
            f'{url}: URLs need fsspec; install it with: pip install "rasnik[archive]"'
        ) from None
    try:
        first, _, packed = url.partition("::")
        protocol, _, inside = first.partition("://")
        if protocol in ("zip", "tar"):
            return _tried(url, lambda: _unpacking(protocol, packed)), inside.strip("/")
        system, path = _tried(url, lambda: fsspec.core.url_to_fs(url))
    except ImportError as error:
        raise ImportError(f"{url.partition(':')[0]}:// needs another package: {error}") from None
    except ValueError as error:
        raise OSError(f"the URL is of no kind known here ({error}); check its beginning") from None
    return system, path


@lru_cache(maxsize=8)
def _unpacking(protocol: str, packed: str) -> Any:
    """The file system inside a packed file; its list of files is read once, and it stays open.

    fsspec would keep all of them open for ever.
    """
    import fsspec

    return fsspec.filesystem(protocol, fo=packed, skip_instance_cache=True)


def _tried(url: str, action: Callable[[], Result]) -> Result:
    """The result of an action on the network, which may fail a few times."""
    pause_s = _FIRST_PAUSE_S
    for _ in range(_TRIES - 1):
        try:
            return action()
        except Exception as error:  # every file system has kinds of its own
            if not _transient(error):
                raise _as_sentence(error) from error
        time.sleep(pause_s)
        pause_s *= 2
    try:
        return action()
    except Exception as error:
        raise _as_sentence(error) from error


def _transient(error: Exception) -> bool:
    """Whether the same may work a moment later."""
    if isinstance(error, FileNotFoundError | PermissionError | IsADirectoryError):
        return False
    if isinstance(error, TimeoutError | ConnectionError):
        return True
    status = getattr(error, "status", None)
    return isinstance(status, int) and (status == 429 or status >= 500)


def _as_sentence(error: Exception) -> Exception:
    """What an exception of a file system means to the user."""
    text = " ".join(str(error).split()) or type(error).__name__
    status = getattr(error, "status", None)
    if isinstance(error, FileNotFoundError | KeyError) or status == 404:
        return FileNotFoundError("there is nothing at this URL; check it")
    denied = ("AccessDenied", "Forbidden", "credentials", "Unauthorized")
    if isinstance(error, PermissionError) or status in (401, 403) or any(d in text for d in denied):
        return PermissionError(f"access is refused ({text}); check the credentials")
    if _transient(error):
        return OSError(f"the network or the server fails ({text}); tried {_TRIES} times")
    if isinstance(error, ImportError | ValueError):
        return error
    return OSError(f"it cannot be read ({text})")


def _entry(url: str, info: dict[str, Any]) -> Entry:
    values = int(info.get("size") or 0), _modified_s(info)
    return Entry(url, _name(url), info.get("type") == "directory", False, lambda: values)


def _modified_s(info: dict[str, Any]) -> float:
    """Time of the last change, as various file systems state it."""
    for key in ("mtime", "LastModified", "last_modified", "modified", "created", "date_time"):
        value = info.get(key)
        if isinstance(value, int | float):
            return float(value)
        if isinstance(value, tuple) and len(value) == 6:  # zip files
            return datetime(*value, tzinfo=UTC).timestamp()
        if isinstance(value, datetime):
            return (value if value.tzinfo else value.replace(tzinfo=UTC)).timestamp()
    return math.nan


def _name(url: str) -> str:
    """The last part of the path; that of the packed file at its top."""
    first, _, rest = url.partition("::")
    path = first.partition("://")[2].partition("?")[0].rstrip("/")
    return PurePosixPath(path).name or (_name(rest) if "://" in rest else os.path.basename(rest))
