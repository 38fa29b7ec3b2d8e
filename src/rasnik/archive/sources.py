"""Images of an archive: finding them, and reading their frames with the time of each.

A source is a folder, a file, a zip or tar file, or a URL that fsspec knows (``s3://``,
``zip://``, ``memory://``). Folders are searched to any depth while the items are handed out, so
that work on the first begins before the last is found.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePosixPath

from rasnik.archive.layout import Layout
from rasnik.io.folders import ZARR_MARKS, Entry, entry_of, is_url, list_folder, unpacked
from rasnik.io.formats import IMAGE_SUFFIXES, STACK_SUFFIXES, VIDEO_SUFFIXES
from rasnik.io.images import Frame, Source, iter_frames, split_dataset

__all__ = ["Item", "LeftOut", "find_items", "frames_of"]

_SUFFIXES = (*IMAGE_SUFFIXES, *STACK_SUFFIXES, *VIDEO_SUFFIXES)
_NAMED = 20
_TWICE = "found elsewhere"


@dataclass(frozen=True)
class Item:
    """One file, or one stack stored as a folder, with images of one instrument.

    Attributes
    ----------
    url : str
        Path on this machine, or URL.
    dataset : str or None
        Of an HDF5 file or Zarr store, where one was named.
    instrument : str
    size : int
        Bytes; of a Zarr store those of its images before compression. 0 if not known.
    modified_s : float
        When it was last changed, since 1970 UTC; NaN if not known.
    time_s : float
        The time in its name, since 1970 UTC; NaN if there is none.
    """

    url: str
    dataset: str | None
    instrument: str
    size: int
    modified_s: float
    time_s: float = math.nan

    @property
    def name(self) -> str:
        """As a user writes it, and as `Frame.file` has it."""
        return f"{self.url}:{self.dataset}" if self.dataset else self.url


@dataclass
class LeftOut:
    """What a search does not hand out: counted by reason, the first few of each by name.

    Attributes
    ----------
    counts : dict of str to int
        Reasons: ``hidden``, ``not an image``, ``outside the pattern``, ``found elsewhere`` (by
        another source, or what a link leads to).
    names : dict of str to list of str
    faults : list of str
        Sentences on sources, folders and files that cannot be read.
    """

    counts: dict[str, int] = field(default_factory=dict)
    names: dict[str, list[str]] = field(default_factory=dict)
    faults: list[str] = field(default_factory=list)

    def add(self, reason: str, name: str) -> None:
        """Count one."""
        self.counts[reason] = self.counts.get(reason, 0) + 1
        listed = self.names.setdefault(reason, [])
        if len(listed) < _NAMED:
            listed.append(name)


# ------------------------------------------------------------------------ finding


def find_items(
    sources: Iterable[str | os.PathLike[str]],
    pattern: str | None = None,
    left_out: LeftOut | None = None,
) -> Iterator[Item]:
    """Search sources for files with images.

    Parameters
    ----------
    sources : iterable of path-like
        Folders, files (``file.h5:/dataset``, ``store.zarr:/dataset``), zip and tar files, URLs.
    pattern : str, optional
        Where the instrument, and perhaps the time, stands in the path below a source; see
        `rasnik.archive.layout`. By default the instrument is the folder just below the source,
        and for what lies directly in the source, its folder.
    left_out : LeftOut, optional
        Filled while the search goes on.

    Yields
    ------
    Item
        In natural order of the paths within each source: ``2.png`` before ``10.png``.

    Raises
    ------
    ValueError
        If the pattern cannot be understood.
    """
    layout = None if pattern is None else Layout.parse(pattern)
    search = _Search(layout, LeftOut() if left_out is None else left_out)
    return search.all_items([os.fspath(source) for source in sources])


@dataclass(frozen=True)
class _Search:
    layout: Layout | None
    left_out: LeftOut
    searched: set[str] = field(default_factory=set)
    """Real paths of sources, and of what links lead to; nothing must be found twice."""

    def all_items(self, sources: list[str]) -> Iterator[Item]:
        """Items of all sources."""
        for source in sources:
            place = source if is_url(source) else os.path.realpath(source)
            if self._is_searched(place):
                self.left_out.add(_TWICE, source)
            else:
                self.searched.add(place)
                yield from self._items(source)

    def _is_searched(self, place: str) -> bool:
        """Whether a file or folder lies in what is searched anyway."""
        above = [place] if is_url(place) else [place, *map(str, Path(place).parents)]
        return any(one in self.searched for one in above)

    def _items(self, source: str) -> Iterator[Item]:
        url, dataset = split_dataset(source)
        try:
            root = entry_of(unpacked(url))
            is_file = not root.is_folder or dataset is not None or _is_zarr(list_folder(root.url))
        except (OSError, ImportError) as error:
            self._fault(url, error)
            return
        if is_file:
            yield from self._named(root, dataset)
        else:
            yield from self._folder(root, (), root.name)

    def _folder(self, folder: Entry, parts: tuple[str, ...], source: str) -> Iterator[Item]:
        """Items of a folder and those below."""
        try:
            entries = list_folder(folder.url)
        except OSError as error:
            self._fault(folder.url, error)
            return
        if parts and _is_zarr(entries):
            yield from self._item(folder, parts, source)
            return
        real = folder.url if is_url(folder.url) else os.path.realpath(folder.url)
        for entry in entries:
            if entry.name.startswith("."):
                self.left_out.add("hidden", entry.url)
            elif self._is_known(entry, real):
                self.left_out.add(_TWICE, entry.url)
            elif entry.is_folder:
                yield from self._folder(entry, (*parts, entry.name), source)
            else:
                yield from self._item(entry, (*parts, entry.name), source)

    def _is_known(self, entry: Entry, folder: str) -> bool:
        """Whether what lies in a (real) folder is found elsewhere; a new link is noted."""
        if not entry.is_link:
            return f"{folder}/{entry.name}" in self.searched
        place = os.path.realpath(entry.url)
        known = self._is_searched(place)
        if not known:
            self.searched.add(place)
        return known

    def _named(self, entry: Entry, dataset: str | None) -> Iterator[Item]:
        """The item of a file that is a source by itself; its folder takes the source's place."""
        path = entry.url.partition("::")[0].partition("://")[2] or os.path.abspath(entry.url)
        parts = PurePosixPath(path.replace(os.sep, "/")).parts
        depth = 1 if self.layout is None else self.layout.text.count("/") + 1
        for item in self._item(entry, parts[-depth:], parts[-2] if len(parts) > 1 else entry.name):
            yield replace(item, dataset=dataset)

    def _item(self, entry: Entry, parts: tuple[str, ...], source: str) -> Iterator[Item]:
        """The item of a file or Zarr store, or none."""
        if not entry.is_folder and not entry.name.lower().endswith(_SUFFIXES):
            self.left_out.add("not an image", entry.url)
            return
        instrument, time_s = parts[0] if len(parts) > 1 else source, math.nan
        if self.layout is not None:
            found = self.layout.match("/".join(parts))
            if found is None:
                self.left_out.add("outside the pattern", entry.url)
                return
            instrument, time_s = found
        try:
            size, modified_s = entry.stat() if not entry.is_folder else _zarr_size(entry)
        except OSError as error:
            self._fault(entry.url, error)
            return
        yield Item(entry.url, None, instrument, size, modified_s, time_s)

    def _fault(self, name: str, error: Exception) -> None:
        text = str(error) if isinstance(error, ImportError) else _reason(error)
        self.left_out.faults.append(f"{name}: {text.rstrip('.')}.")


def _reason(error: Exception) -> str:
    if isinstance(error, OSError) and error.errno is None:
        return str(error)  # a sentence already
    if isinstance(error, FileNotFoundError):
        return "there is no such file or folder; check the name"
    if isinstance(error, PermissionError):
        return "permission denied; change the permissions"
    return getattr(error, "strerror", None) or str(error)


def _is_zarr(entries: list[Entry]) -> bool:
    """Whether a folder with this content is a Zarr store."""
    return any(entry.name in ZARR_MARKS for entry in entries)


def _zarr_size(store: Entry) -> tuple[int, float]:
    from rasnik.io.zarr_stack import zarr_bytes

    return zarr_bytes(store.url), store.stat()[1]


# ------------------------------------------------------------------------ reading


def frames_of(item: Item, start: int = 0) -> Iterator[Frame]:
    """Frames of an item, each with its time as far as it is known.

    The time is, in this order: that stored with the frame ("metadata"), that in the name
    ("name"), that of the last change of the file ("modified"), which all frames of a file
    share. Unknown: NaN, and no `time_source`.

    Parameters
    ----------
    item : Item
    start : int
        Frames to leave out at the beginning.

    Yields
    ------
    Frame
        One with an error, and without image, for what cannot be read.
    """
    url = item.url if is_url(item.url) else None
    source = Source(item.name, Path(item.url), item.dataset, url=url)
    for frame in iter_frames([source], start):
        if math.isfinite(frame.time_s):
            yield frame
        elif math.isfinite(item.time_s):
            yield replace(frame, time_s=item.time_s, time_source="name")
        elif math.isfinite(item.modified_s):
            yield replace(frame, time_s=item.modified_s, time_source="modified")
        else:
            yield frame
