"""What lies in a folder, on this machine or behind a URL, without opening anything."""

from __future__ import annotations

import os
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

__all__ = [
    "ZARR_MARKS",
    "Entry",
    "entry_of",
    "is_url",
    "is_zarr_folder",
    "list_folder",
    "natural_key",
    "unpacked",
]

#: A folder with one of these files is a Zarr store.
ZARR_MARKS = ("zarr.json", ".zarray", ".zgroup")

_URL = re.compile(r"[A-Za-z][A-Za-z0-9+.-]+(?:::|://)")
_PACKED = {".zip": "zip", ".tar": "tar", ".tgz": "tar", ".tar.gz": "tar"}


@dataclass(frozen=True, slots=True)
class Entry:
    """A file or a folder.

    Attributes
    ----------
    url : str
        Path on this machine, or URL.
    name : str
        The last part of it.
    is_folder : bool
    is_link : bool
        A symbolic link.
    stat : callable
        ``stat()`` gives the size in bytes and the time of the last change (s since 1970 UTC;
        NaN if not known); the disk is asked when it is called.
    """

    url: str
    name: str
    is_folder: bool
    is_link: bool
    stat: Callable[[], tuple[int, float]]


def natural_key(name: str) -> str:
    """Sort key with numbers by value: frame2 before frame10."""

    def with_length(digits: re.Match[str]) -> str:
        number = str(int(digits[0]))
        return f"\1{len(number):03d}{number}"

    return re.sub(r"\d+", with_length, name.lower())


def is_zarr_folder(path: Path) -> bool:
    """Whether a folder of this machine is a Zarr store."""
    return any((path / mark).is_file() for mark in ZARR_MARKS)


def is_url(name: str) -> bool:
    """Whether a source is not a path on this machine."""
    return _URL.match(name) is not None


def unpacked(name: str) -> str:
    """The URL of what a zip or tar file holds; other names stay as they are."""
    for suffix, protocol in _PACKED.items():
        if name.lower().endswith(suffix):
            return f"{protocol}://::{name if is_url(name) else os.path.abspath(name)}"
    return name


def entry_of(url: str) -> Entry:
    """A file or folder by name.

    Raises
    ------
    OSError
        If it is not there or cannot be reached; the text is a sentence for a URL.
    """
    if is_url(url):
        from rasnik.io.remote import remote_entry

        return remote_entry(url)
    status = os.stat(url)
    name = os.path.basename(os.path.abspath(url))
    return Entry(url, name, os.path.isdir(url), False, lambda: (status.st_size, status.st_mtime))


def list_folder(url: str) -> list[Entry]:
    """What a folder holds, in natural order.

    Raises
    ------
    OSError
        If it cannot be read.
    """
    if is_url(url):
        from rasnik.io.remote import list_remote

        entries = list_remote(url)
    else:
        with os.scandir(url) as listing:
            entries = [_local(entry) for entry in listing]
    return sorted(entries, key=lambda entry: natural_key(entry.name))


def _local(entry: os.DirEntry[str]) -> Entry:
    def stat() -> tuple[int, float]:
        status = entry.stat()
        return status.st_size, status.st_mtime

    try:
        is_folder = entry.is_dir()
    except OSError:  # a link in a circle; `stat` says so
        is_folder = False
    return Entry(entry.path, entry.name, is_folder, entry.is_symlink(), stat)
