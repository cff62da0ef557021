"""Arrays of HDF5 and MATLAB files as columns of a table: by path, sliced along the axis that the stamps have."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sms_adapters.extras import installed
from sms_adapters.importers import load_matlab
from sms_adapters.log_tables import ROWS, Chunk, WholeTable, missing
from sms_adapters.raw import one_line
from sms_online.errors import InputError

# The path of an array, and the column that is meant of an array of several.
_COLUMN = re.compile(r"(?P<path>.*?)(\[(?P<column>\d+)\])?")
_MATLAB = ".mat"

Find = Callable[[str], Any]


class _Field:
    """One field of a compound dataset, as an array."""

    def __init__(self, table: Any, field: str) -> None:
        self._table, self._field = table, field
        self.shape, self.ndim, self.dtype = table.shape, table.ndim, table.dtype[field]

    def __getitem__(self, rows: slice) -> Any:
        return self._table[rows][self._field]


class ArrayTable(WholeTable):
    """Arrays of an HDF5 file, which a .mat of version 7.3 is too, or of an older .mat: a `Table`.

    Limitation: an older .mat is read variable by variable, each as a whole.
    """

    def chunks(self, stamp: str, columns: Sequence[str]) -> Iterator[Chunk]:
        """See `Table`."""
        h5py = installed("h5py", str(self._path))
        if not h5py.is_hdf5(self._path):
            if self._path.suffix != _MATLAB:
                raise InputError(str(self._path), "", "no HDF5 data", "a file in HDF5")
            yield from self._slices(self._in_matlab((stamp, *columns)), stamp, columns)
            return
        try:
            with h5py.File(self._path, "r") as file:
                yield from self._slices(self._in_hdf5(h5py, file), stamp, columns)
        except OSError as error:
            raise InputError(str(self._path), "", one_line(error), "an HDF5 file without damage") from None

    def _in_hdf5(self, h5py: Any, file: Any) -> Find:
        """Datasets by path, and the fields of compound ones."""

        def find(name: str) -> Any:
            # A struct of MATLAB is a group here.
            path = name.replace(".", "/") if self._path.suffix == _MATLAB else name
            if isinstance(file.get(path), h5py.Dataset):
                return file[path]
            whole, _, field = path.rpartition("/")
            table = file.get(whole) if whole else None
            if isinstance(table, h5py.Dataset) and field in (table.dtype.names or ()):
                return _Field(table, field)
            names: list[str] = []
            file.visititems(lambda each, item: names.append(each) if isinstance(item, h5py.Dataset) else None)
            raise missing(self._path, name, names)

        return find

    def _in_matlab(self, columns: Sequence[str]) -> Find:
        """Variables, and fields of structs, by path."""
        parts = [re.split(r"[./]", _split(name)[0]) for name in columns]
        data = load_matlab(self._path, [path[0] for path in parts])

        def find(name: str) -> Any:
            value: Any = data
            for part in re.split(r"[./]", name):
                if not (isinstance(value, dict) and part in value):
                    names = [each for each in value if not each.startswith("__")] if isinstance(value, dict) else []
                    raise missing(self._path, name, names)
                value = value[part]
            return np.asarray(value)

        return find

    def _slices(self, find: Find, stamp: str, columns: Sequence[str]) -> Iterator[Chunk]:
        """Rows of the arrays, ROWS at a time."""
        stamps = find(stamp)
        if stamps.dtype.kind not in "iuf" or sum(size > 1 for size in stamps.shape) > 1:
            found = f"{stamps.dtype} of shape {stamps.shape}"
            raise InputError(str(self._path), f"column {stamp}", found, "instants, one after the other")
        count = int(np.prod(stamps.shape))
        arrays = [self._column(find, name, count) for name in columns]
        axis, size = _axis(stamps.shape, count), self._path.stat().st_size
        for start in range(0, count, ROWS):
            rows = slice(start, min(start + ROWS, count))
            values = [_rows(array, rows).astype(np.float64) for array in arrays]
            yield _rows((stamps, axis, 0), rows), np.column_stack(values)
            if self._on_bytes is not None:
                self._on_bytes(size * rows.stop // count)

    def _column(self, find: Find, name: str, count: int) -> tuple[Any, int, int]:
        """Array, axis of its samples, and place along the other; InputError where it does not fit the stamps."""
        path, place = _split(name)
        array = find(path)
        axis = _axis(array.shape, count)
        others = [size for k, size in enumerate(array.shape) if k != axis]
        if array.dtype.kind not in "iufb" or array.ndim > 2 or axis < 0:
            found = f"{array.dtype} of shape {array.shape}"
            raise InputError(str(self._path), f"column {name}", found, f"{count} numbers, as many as there are stamps")
        if (others or [1])[0] <= (place or 0) or (place is None and (others or [1])[0] > 1):
            expected = f'one of its {(others or [1])[0]} columns, such as "{path}[0]"'
            raise InputError(str(self._path), f"column {name}", f"an array of shape {array.shape}", expected)
        return array, axis, place or 0


def _split(name: str) -> tuple[str, int | None]:
    """Path of an array and the column meant."""
    match = _COLUMN.fullmatch(name)
    assert match is not None  # whatever the text
    return match["path"], None if match["column"] is None else int(match["column"])


def _axis(shape: tuple[int, ...], count: int) -> int:
    """The first axis of so many samples, -1 where there is none."""
    return next((k for k, size in enumerate(shape) if size == count), -1)


def _rows(array: tuple[Any, int, int], rows: slice) -> NDArray[Any]:
    values, axis, place = array
    if len(values.shape) == 1:
        return np.asarray(values[rows])
    return np.asarray(values[rows, place] if axis == 0 else values[place, rows])
