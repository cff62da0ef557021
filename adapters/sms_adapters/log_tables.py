"""Tables as files have them: arrays of columns in chunks of bounded size, whatever the format."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from sms_adapters.raw import one_line
from sms_online.description.explain import hint, nearest
from sms_online.errors import InputError
from sms_online.stream import Array

# A whole stamp that is missing, as NumPy has it: the number behind NaT.
NO_STAMP = int(np.iinfo(np.int64).min)
# Rows that are handed on at once.
ROWS = 16384
# Names that a message lists.
SHOWN = 8
PARQUET_ENDINGS = (".parquet", ".pq")
ARRAY_ENDINGS = (".h5", ".hdf5", ".mat")

# Stamps (B,) as the file has them, whole numbers or not, and values (B, C). What is missing is NaN, of dates NaT, and
# of whole stamps NO_STAMP.
Chunk = tuple[NDArray[Any], Array]


class Table(Protocol):
    """A file of columns."""

    @property
    def warnings(self) -> Sequence[str]:
        """What of the file was left out so far."""

    def chunks(self, stamp: str, columns: Sequence[str]) -> Iterator[Chunk]:
        """Stamps and values of the columns from the beginning; InputError for no such column, or no table."""


def missing(path: Path, name: str, names: Sequence[str]) -> InputError:
    """The error of a column that a file does not have."""
    near = nearest(name, names)
    listed = ", ".join([*names[:SHOWN], "…"] if len(names) > SHOWN else names) or "none"
    return InputError(str(path), "", f"no column {name!r}", f"one of its columns: {listed}{hint(near)}")


def stamps_of(column: pa.Array | pa.ChunkedArray) -> NDArray[Any]:
    """Stamps (B,) in a column of whole numbers, floats or instants; see `Chunk`."""
    whole = column.fill_null(NO_STAMP) if pa.types.is_integer(column.type) else column
    stamps: NDArray[Any] = whole.to_numpy(zero_copy_only=False)
    return stamps


class WholeTable:
    """A file of columns of which nothing is left out. on_bytes: called with the bytes consumed so far."""

    warnings = ()

    def __init__(self, path: Path, on_bytes: Callable[[int], None] | None) -> None:
        self._path = path
        self._on_bytes = on_bytes


class ParquetTable(WholeTable):
    """A Parquet file, a batch of rows at a time: a `Table`."""

    def chunks(self, stamp: str, columns: Sequence[str]) -> Iterator[Chunk]:
        """See `Table`."""
        import pyarrow.parquet

        try:
            file = pyarrow.parquet.ParquetFile(self._path, pre_buffer=False, buffer_size=1 << 20)
        except (OSError, pa.ArrowException) as error:
            raise InputError(str(self._path), "", one_line(error), "a Parquet file") from None
        with file:
            names = file.schema_arrow.names
            for name in (stamp, *columns):
                if name not in names:
                    raise missing(self._path, name, names)
            wanted = list(dict.fromkeys((stamp, *columns)))
            done, size = 0, self._path.stat().st_size
            for batch in self._batches(file, wanted):
                values = [self._cast(batch, name, pa.float64()).to_numpy(zero_copy_only=False) for name in columns]
                yield stamps_of(self._instants(batch, stamp)), np.column_stack(values)
                done += batch.num_rows
                if self._on_bytes is not None:
                    self._on_bytes(size * done // file.metadata.num_rows)

    def _batches(self, file: Any, names: Sequence[str]) -> Iterator[pa.RecordBatch]:
        try:
            yield from file.iter_batches(ROWS, columns=names, use_threads=False)
        except (OSError, pa.ArrowException) as error:
            raise InputError(str(self._path), "", one_line(error), "a Parquet file without damage") from None

    def _instants(self, batch: pa.RecordBatch, stamp: str) -> pa.Array:
        kind = batch.schema.field(stamp).type
        if pa.types.is_timestamp(kind):
            return self._cast(batch, stamp, pa.timestamp("ns"))
        return self._cast(batch, stamp, pa.int64() if pa.types.is_integer(kind) else pa.float64())

    def _cast(self, batch: pa.RecordBatch, name: str, kind: pa.DataType) -> pa.Array:
        try:
            return batch.column(name).cast(kind)
        except pa.ArrowException:
            found = f"values of type {batch.schema.field(name).type}"
            raise InputError(str(self._path), f"column {name}", found, "numbers") from None
