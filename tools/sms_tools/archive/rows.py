"""Rows of finished tasks in a file, a line of JSON each: whatever stops a run costs no row that was finished."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

from sms_adapters.files import WRITABLE, reading
from sms_online.errors import InputError
from sms_online.tables import json_text

Row = dict[str, Any]


class RowFile:
    """A file of rows that is only ever appended to; one process at a time writes it."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def read(self) -> list[Row]:
        """Finished rows, none where there is no file; what a stopped run left of its last line is taken out of it."""
        if not self.path.exists():
            return []
        with reading(self.path, "lines that an earlier run wrote"):
            content = self.path.read_bytes()
            whole = content[: content.rfind(b"\n") + 1]
            if whole != content:
                os.truncate(self.path, len(whole))
        try:
            return [json.loads(line) for line in whole.splitlines()]
        except ValueError as error:
            found = f"a line that is not JSON ({error})"
            raise InputError(str(self.path), "", found, "lines that an earlier run wrote") from None

    def append(self, row: Row) -> None:
        """Add a row, which is on the disk when this returns; InputError where it cannot be written."""
        with reading(self.path, WRITABLE):
            self.path.parent.mkdir(parents=True, exist_ok=True)
            with self.path.open("a", encoding="utf-8") as file:
                file.write(json.dumps(json.loads(json_text(row)), ensure_ascii=False) + "\n")
                file.flush()
                os.fsync(file.fileno())
