"""Safe reading of HDF5 files.

Only datasets inside the file itself are read: links to other files, external storage and virtual datasets are rejected.
Attributes are read as bytes or text and never unpickled.

Check of the heaps of an HDF5 file, which hold texts of variable length. The HDF5 library (2.0) never returns if an
object of a damaged heap has no size. So every heap is checked before the library reads a text.

Source: HDF5 file format specification, section III.E, global heap.
"""

from __future__ import annotations

import mmap
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

import numpy as np

from jaxfit.foundation.errors import InputError
from jaxfit.foundation.extras import require_extra
from jaxfit.foundation.limits import HDF5_BYTES, HDF5_ENTRIES, HDF5_TEXT_BYTES, HDF5_TEXTS
from jaxfit.foundation.reading import check_readable

if TYPE_CHECKING:
    import h5py

HDF5_SIGNATURE = b"\x89HDF\r\n\x1a\n"
"""First bytes of an HDF5 file."""
_FILTERS = {1: "gzip", 2: "shuffle", 3: "fletcher32", 32000: "lzf"}
"""Filters that h5py itself decodes; other filters would load a plugin."""
_COMPRESSION = 2000
"""Largest ratio of an array and its compressed size."""
_REMEDY = "the file may be damaged: copy or write it again"


@contextmanager
def open_hdf5(path: str | Path) -> Iterator[Hdf5Group]:
    """Open an HDF5 file for reading, as a context manager that yields the root of the file.

    Raises:
        InputError: the file cannot be read, is not an HDF5 file, or h5py is not installed.
    """
    path = check_readable(path, "an HDF5 file")
    require_extra("formats", str(path), "h5py")
    import h5py

    check_heaps(path)
    with _errors(path, "the file"):
        file = h5py.File(path, "r", locking=False)
    try:
        yield Hdf5Group(path, "", file)
    finally:
        file.close()


class Hdf5Group:
    """A folder inside an HDF5 file. Methods raise InputError, which names the file and the entry."""

    def __init__(self, source: Path, path: str, group: h5py.Group):
        self.source, self.path, self._group = source, path, group

    def fail(self, name: str, problem: str, remedy: str = _REMEDY) -> NoReturn:
        """Raise InputError about an entry of this folder."""
        raise InputError(self.source, f"{self._label(name)} {problem}", remedy)

    def _label(self, name: str) -> str:
        return f"{self.path}/{name}" if self.path else name

    def names(self) -> list[str]:
        """Return the names of the entries."""
        with _errors(self.source, self.path or "the file"):
            if len(self._group) > HDF5_ENTRIES:
                self.fail("", f"has {len(self._group):,} entries, more than {HDF5_ENTRIES:,}")
            return list(self._group)

    def __contains__(self, name: str) -> bool:
        with _errors(self.source, self._label(name)):
            return name in self._group

    def is_group(self, name: str) -> bool:
        """Return whether an entry is a folder of this file."""
        import h5py

        return name in self and isinstance(self._entry(name), h5py.Group)

    def group(self, name: str) -> Hdf5Group:
        """Return a folder inside this folder."""
        import h5py

        entry = self._entry(name)
        if not isinstance(entry, h5py.Group):
            self.fail(name, "is not a folder of the HDF5 file")
        return Hdf5Group(self.source, self._label(name), entry)

    def _entry(self, name: str) -> Any:
        import h5py

        with _errors(self.source, self._label(name)):
            if name not in self._group:
                self.fail(name, "is missing", "write the file again, or check that the program wrote the whole file")
            if not isinstance(self._group.get(name, getlink=True), h5py.HardLink):
                self.fail(name, "is a link to elsewhere", "write a file that holds its own data")
            return self._group[name]

    def _dataset(self, name: str) -> h5py.Dataset:
        """Return a dataset whose sizes and filters are checked."""
        import h5py

        entry = self._entry(name)
        if not isinstance(entry, h5py.Dataset):
            self.fail(name, "is not an array")
        with _errors(self.source, self._label(name)):
            if entry.shape is None:
                self.fail(name, "is empty")
            if entry.is_virtual or entry.external:
                self.fail(name, "is stored outside the file", "write a file that holds its own data")
            size = int(np.prod([*entry.shape], dtype=object)) * entry.dtype.itemsize
            chunk = int(np.prod([*(entry.chunks or ())], dtype=object)) * entry.dtype.itemsize
            if max(size, chunk) > HDF5_BYTES:
                self.fail(name, f"needs {max(size, chunk):,} bytes, more than {HDF5_BYTES:,}", "split the file")
            properties = entry.id.get_create_plist()
            # gzip compresses zeros to a thousandth; other arrays are no larger than the file
            largest = self.source.stat().st_size * (_COMPRESSION if properties.get_nfilters() else 1)
            if size > largest:
                self.fail(
                    name, f"needs {size:,} bytes, more than its file of {self.source.stat().st_size:,} bytes holds"
                )
            for i in range(properties.get_nfilters()):
                number = properties.get_filter(i)[0]
                if number not in _FILTERS:
                    self.fail(name, f"is compressed with filter {number}", "write the file again with gzip (zlib)")
        return entry

    def array(self, name: str, kinds: str, ndim: int | None = None) -> np.ndarray:
        """Return an array.

        Args:
            name: the entry.
            kinds: the accepted kinds of NumPy's types, such as `iuf`.
            ndim: number of axes; None for any.
        """
        entry = self._dataset(name)
        with _errors(self.source, self._label(name)):
            if entry.dtype.kind not in kinds or entry.dtype.hasobject:
                self.fail(name, f"holds {entry.dtype.name}, not the expected type")
            if ndim is not None and entry.ndim != ndim:
                self.fail(name, f"has {entry.ndim} axes, not {ndim}")
            return np.asarray(entry[()])

    def columns(self, name: str, kinds: dict[str, str], ndim: int | None = 1) -> dict[str, np.ndarray]:
        """Return columns of a table, as a dict of arrays with one row for every row of the table.

        Args:
            name: the entry.
            kinds: name of a column → accepted kinds of NumPy's types. Other columns are not returned.
            ndim: number of axes of every column, with the axis of the rows; None for any.
        """
        entry = self._dataset(name)
        with _errors(self.source, self._label(name)):
            fields = entry.dtype.fields
            if fields is None or entry.ndim != 1:
                self.fail(name, "is not a table")
            for column, accepted in kinds.items():
                if column not in fields:
                    self.fail(name, f"lacks the column {column}", "write the file again")
                field = fields[column][0]
                wrong_axes = ndim is not None and 1 + field.ndim != ndim
                if field.base.kind not in accepted or field.hasobject or wrong_axes:
                    self.fail(name, f"holds another type than expected in the column {column}")
            rows = entry[()]
        return {column: rows[column] for column in kinds}

    def column_types(self, name: str) -> dict[str, np.dtype]:
        """Return the columns of a table with their types."""
        entry = self._dataset(name)
        with _errors(self.source, self._label(name)):
            if entry.dtype.fields is None or entry.ndim != 1:
                self.fail(name, "is not a table")
            return {column: field[0] for column, field in entry.dtype.fields.items()}

    def texts(self, name: str) -> list[str]:
        """Return the texts of an array with one axis, or the single text of an array without axes."""
        import h5py

        entry = self._dataset(name)
        with _errors(self.source, self._label(name)):
            if entry.ndim > 1 or not (entry.dtype.kind == "S" or h5py.check_string_dtype(entry.dtype)):
                if entry.size == 0:
                    return []
                self.fail(name, "does not hold text")
            if (entry.size or 0) > HDF5_TEXTS:
                self.fail(name, f"holds {entry.size:,} texts, more than {HDF5_TEXTS:,}", "split the file")
            values = entry[()]
        texts = [self._text(name, value) for value in np.atleast_1d(np.asarray(values, object))]
        if sum(map(len, texts)) > HDF5_TEXT_BYTES:
            self.fail(name, "holds too much text", "split the file")
        return texts

    def _text(self, name: str, value: Any) -> str:
        try:
            return value.decode("utf-8") if isinstance(value, bytes) else str(value)
        except UnicodeDecodeError:
            self.fail(name, "holds text that is not UTF-8")

    def attribute(self, name: str, entry: str = "") -> bytes | float | None:
        """Return an attribute as bytes or as a number, or None if it does not exist.

        Args:
            name: name of the attribute.
            entry: the entry that has the attribute; empty for this folder.
        """
        import h5py

        owner = self._entry(entry) if entry else self._group
        label = f"attribute {name}"
        with _errors(self.source, self._label(label)):
            if name not in owner.attrs:
                return None
            stored = h5py.h5a.open(owner.id, name.encode())
            if stored.get_storage_size() > HDF5_TEXT_BYTES:
                self.fail(label, f"has more than {HDF5_TEXT_BYTES:,} bytes", "split the file")
            value = owner.attrs[name]
        if isinstance(value, str | bytes):
            return value.encode("utf-8", "surrogateescape") if isinstance(value, str) else bytes(value)
        if isinstance(value, np.number | np.bool_):
            return float(np.real(value))
        if isinstance(value, h5py.Empty):
            return b""
        self.fail(label, "is neither text nor a number")


@contextmanager
def _errors(source: Path, label: str) -> Iterator[None]:
    """Convert the errors by which h5py reports damage in the body to an InputError."""
    try:
        yield
    except InputError:
        raise
    except (OSError, RuntimeError, KeyError, ValueError, TypeError, OverflowError, SystemError) as error:
        reason = str(error.args[0]) if error.args else type(error).__name__
        raise InputError(source, f"{label} cannot be read: {reason}", _REMEDY) from error


_SIGNATURE = b"GCOL\x01\x00\x00\x00"
_OBJECT = struct.Struct("<HHIQ")  # index, references, reserved, size


def check_heaps(path: Path) -> None:
    """Raise InputError if a heap of an HDF5 file is damaged.

    Args:
        path: a file that is not empty.
    """
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
        at = content.find(_SIGNATURE)
        while at >= 0:
            if not _is_valid(content, at):
                remedy = "copy or write the file again"
                raise InputError(path, f"is damaged: its heap of texts at byte {at:,} is not valid", remedy)
            at = content.find(_SIGNATURE, at + 1)


def _is_valid(content: mmap.mmap, at: int) -> bool:
    header = content[at + 8 : at + 16]
    size = int.from_bytes(header, "little")
    if len(header) < 8 or size < 16 or at + size > len(content):
        return False
    place = 16
    while place + _OBJECT.size <= size:
        index, _, _, length = _OBJECT.unpack_from(content, at + place)
        # index 0 is the free space, whose size includes its header
        needed = length if index == 0 else _OBJECT.size + (length + 7) // 8 * 8
        if needed < _OBJECT.size or place + needed > size:
            return False
        place += needed
    return True
