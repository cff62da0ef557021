"""A recorded session and what lies beside it: truth of a simulation, checkpoint and searches of a live session."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np

from sms_adapters.capture import CaptureReader
from sms_adapters.mcap_capture import capture_writer
from sms_adapters.part import Part
from sms_adapters.recording import resumed_from
from sms_adapters.searches import searcher_of
from sms_adapters.session_log import SESSION, read_header
from sms_adapters.sources import open_source
from sms_adapters.truth import read_truth, write_truth
from sms_online.capture import Capture
from sms_online.description.given import Given, given_system
from sms_online.errors import InputError
from sms_online.recorded import Recorded
from sms_online.stream import Source


def recorded_at(path: Path, source: Source, whole: bool = True) -> Recorded:
    """The recorded session of a source that `open_source` opened at a path; whole: it is all that was recorded."""
    return Recorded(
        source,
        str(path),
        truth_beside(path),
        resumed_from(path),
        partial(searcher_of, path) if whole else lambda adopt: None,
        read_header(path)[0].trackers if path.is_dir() and (path / SESSION).is_file() else (),
    )


def truth_beside(path: Path) -> dict[str, object] | None:
    """The truth of a simulated capture or recording, None where there is none."""
    return read_truth(path / SESSION if path.is_dir() else path)


def read_capture(
    path: str | Path,
    system: Given | None = None,
    start: float | None = None,
    stop: float | None = None,
) -> Capture:
    """Read a capture (.csv), a CAN log, a table, a bag or a live session's recording into memory.

    system: described, or its name or file; all but a capture need it, and a log finds its DBC beside the system's file
    where that is given. start, stop: s after the first sample. InputError where it cannot be read, line and place
    named.
    """
    if not isinstance(path, str | Path):
        found = f"an object of type {type(path).__name__}"
        raise InputError("path", "", found, "the path of a recording first, and then the system")
    path = Path(path)
    if system is not None:
        system, folder = given_system(system)
        return captured(recorded_at(path, open_source(path, system, start, stop, None, folder)))
    if not path.name.removesuffix(".gz").endswith(".csv"):
        raise InputError(str(path), "", "no system", "the system, to know which signals are which channels")
    return captured(Recorded(Part(CaptureReader(path), str(path), start, stop), str(path), truth_beside(path)))


def captured(recorded: Recorded) -> Capture:
    """A recorded session in memory; InputError where it cannot be read or holds no sample."""
    blocks = list(recorded.source)
    if not blocks:
        raise InputError(recorded.name, "", "no samples", "a capture with samples in the time asked for")
    t, values = (np.concatenate([getattr(block, part) for block in blocks]) for part in ("t", "values"))
    source = recorded.source
    return Capture(t, tuple(source.channels), values, recorded.name, tuple(source.warnings), recorded.truth)


def write_capture(capture: Capture, path: str | Path) -> Path:
    """Write a capture as .csv, to the same bits, or .mcap for Foxglove; the truth of a simulation goes beside it.

    InputError where it fails.
    """
    path = Path(path)
    with capture_writer(path, capture.channels) as writer:
        for block in capture:
            writer.write(block)
    if capture.truth is not None:
        further = {key: value for key, value in capture.truth.items() if key not in ("schema", "parameters")}
        write_truth(path, dict(capture.truth["parameters"]), further)
    return path
