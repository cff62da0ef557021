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

# Rows that are handed on at once.
ROWS = 16384
# Names that a message lists.
SHOWN = 8
PARQUET_ENDINGS = (".parquet", ".pq")
ARRAY_ENDINGS = (".h5", ".hdf5", ".mat")

# Stamps (B,) as the file has them, whole numbers or not, and values (B, C), NaN where there is none.
Chunk = tuple[NDArray[Any], Array]


class Table(Protocol):
    """A file of columns."""

    def chunks(self, stamp: str, columns: Sequence[str]) -> Iterator[Chunk]:
        """Stamps and values of the columns from the beginning; InputError for no such column, or no table."""


def open_table(path: Path, on_bytes: Callable[[int], None] | None = None) -> Table:
    """The table in a file, by the ending of its name; InputError where there is no such file."""
    # Each format costs an import that the others need not pay.
    if not path.is_file():
        raise InputError(str(path), "", "no such file", "a readable file")
    if path.suffix in PARQUET_ENDINGS:
        return ParquetTable(path)
    if path.suffix in ARRAY_ENDINGS:
        from sms_adapters.log_arrays import ArrayTable

        return ArrayTable(path)
    from sms_adapters.log_csv import CsvTable

    return CsvTable(path, on_bytes)


def missing(path: Path, name: str, names: Sequence[str]) -> InputError:
    """The error of a column that a file does not have."""
    near = nearest(name, names)
    listed = ", ".join([*names[:SHOWN], "…"] if len(names) > SHOWN else names) or "none"
    return InputError(str(path), "", f"no column {name!r}", f"one of its columns: {listed}{hint(near)}")


class ParquetTable:
    """A Parquet file, a batch of rows at a time: a `Table`."""

    def __init__(self, path: Path) -> None:
        self._path = path

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
            for batch in file.iter_batches(ROWS, columns=wanted, use_threads=False):
                values = [self._numbers(batch, name, pa.float64()) for name in columns]
                yield self._instants(batch, stamp), np.column_stack(values)

    def _instants(self, batch: pa.RecordBatch, stamp: str) -> NDArray[Any]:
        kind = batch.schema.field(stamp).type
        if pa.types.is_timestamp(kind):
            instants: NDArray[Any] = self._numbers(batch, stamp, pa.timestamp("ns")).astype("datetime64[ns]")
            return instants
        return self._numbers(batch, stamp, pa.int64() if pa.types.is_integer(kind) else pa.float64())

    def _numbers(self, batch: pa.RecordBatch, name: str, kind: pa.DataType) -> NDArray[Any]:
        try:
            numbers: NDArray[Any] = batch.column(name).cast(kind).to_numpy(zero_copy_only=False)
        except pa.ArrowException:
            found = f"values of type {batch.schema.field(name).type}"
            raise InputError(str(self._path), f"column {name}", found, "numbers") from None
        return numbers
