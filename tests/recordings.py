"""Rerun recordings read back."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from rerun.chunk import RrdReader

from sms_online.stream import Array


def columns(recording: Path, entity: str) -> list[dict[str, Any]]:
    """Rows of an entity in order of time, with what never changes as the first."""
    rows = []
    for chunk in RrdReader(str(recording)).stream():
        if chunk.entity_path == entity:
            rows += chunk.to_record_batch().to_pylist()
    return sorted(rows, key=lambda row: row.get("time").total_seconds() if row.get("time") is not None else -1.0)


def scalars(recording: Path, entity: str) -> tuple[Array, Array]:
    """Times (B,), s, and values (B, n) of an entity's numbers."""
    rows = [row for row in columns(recording, entity) if row.get("Scalars:scalars") is not None]
    return np.array([row["time"].total_seconds() for row in rows]), np.array([row["Scalars:scalars"] for row in rows])
