"""history.parquet: what each tracker has estimated over time, beside results.json."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from sms_adapters.files import writing
from sms_online.history import History

NAME = "history.parquet"


def write_history(path: Path, histories: Sequence[History]) -> Path:
    """Write the courses of a session's trackers as one table, the judged one's rows first.

    Columns: `tracker`, then those of `History.columns`; null where there is no value. The unit of a parameter is in the
    metadata of its column. InputError where the file cannot be written.
    """
    units = dict(zip(histories[0].parameters, histories[0].units, strict=True))
    tables = []
    for history in histories:
        columns = history.columns()
        schema = pa.schema(
            [
                pa.field("tracker", pa.string()),
                *(pa.field(name, pa.float64(), metadata={"unit": units.get(name, "")}) for name in columns),
            ]
        )
        arrays = [pa.array([history.tracker] * history.t.size, pa.string())]
        arrays += [pa.array(column, pa.float64(), from_pandas=True) for column in columns.values()]
        tables.append(pa.table(arrays, schema=schema))
    with writing(path) as part:
        pq.write_table(pa.concat_tables(tables), part)
    return path
