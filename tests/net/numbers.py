"""What a session gives, as numbers and names by their place in the documents, and how two such differ."""

from __future__ import annotations

import hashlib
import math
import platform
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import scipy
import scipy.linalg
from threadpoolctl import threadpool_info

from sms_adapters.checkpoint import read_checkpoint, write_checkpoint
from sms_online.checkpoint import Checkpoint
from sms_online.description.schema import Tolerances
from sms_online.diagnosis.diagnose import diagnose
from sms_online.diagnosis.document import diagnosis_document
from sms_online.diagnosis.online import OnlineDiagnosis
from sms_online.diagnosis.online_search import Immediate
from sms_online.pipeline.estimator import Estimator
from sms_online.pipeline.snapshot import statistics_of
from sms_online.priors import base_prior
from sms_online.result import result_of
from sms_online.stream import Block
from sms_online.verdict.judged import JudgedEvaluation
from tests.net.sessions import Session

# Number, name, or None where there is none, by its path in the documents.
Value = float | int | bool | str | None
Numbers = dict[str, Value]

# Keys of the documents that hold what was put in, sentences, or estimates once more.
LEFT_OUT = (
    "schema",
    "system",
    "trackers",
    "summary",
    "warnings",
    "throughput_samples_per_s",
    "unit",
    "symbol",
    "separated_by",
)
PIECE = 1024  # samples


def numbers(session: Session) -> Numbers:
    """Every number and name of a session's documents: run through, and saved at half and continued.

    Without tolerances, whose part is tested elsewhere: so they are what they were before there were any.
    """
    exact = session.system.model_copy(update={"tolerances": Tolerances.model_validate("none")})
    session = replace(session, system=exact)
    out: Numbers = {"samples": hashlib.sha256(session.block.values.tobytes()).hexdigest()}
    pieces = list(session.block.pieces(PIECE))
    half = len(pieces) // 2
    estimator, online = _begun(session)
    for piece in pieces[:half]:
        estimator.push(piece)
    continued, online_continued = _begun(session)
    with TemporaryDirectory() as folder:
        path = Path(folder) / "checkpoint.msgpack"
        write_checkpoint(path, Checkpoint.of(estimator))
        read_checkpoint(path).put_into(continued)
    out |= _results("whole", estimator, online, pieces[half:])
    out |= _results("continued", continued, online_continued, pieces[half:])
    if session.diagnosed:
        diagnosis = diagnose(session.system, [session.block], "net", lambda estimator: None)
        out |= leaves("diagnosis", diagnosis_document(diagnosis, [], None))
    return out


def _begun(session: Session) -> tuple[Estimator, OnlineDiagnosis]:
    estimator = Estimator(session.system, session.block.channels, "net")
    if session.prior:
        estimator.set_prior(base_prior(session.system, estimator.base, True))
    return estimator, OnlineDiagnosis(estimator, Immediate(), session.adopt)


def _results(name: str, estimator: Estimator, online: OnlineDiagnosis, pieces: list[Block]) -> Numbers:
    for piece in pieces:
        estimator.push(piece)
    estimator.finish()
    online.finish()
    evaluation = JudgedEvaluation(statistics_of(estimator), estimator.estimate(), online.discrepancies)
    return leaves(name, result_of(evaluation, episodes=online.document()).document())


def leaves(path: str, value: Any) -> Numbers:
    """Numbers and names below a path; what a list holds is known by its name where it has one, else by its place."""
    if isinstance(value, dict):
        children = [(f"{path}.{key}", child) for key, child in value.items() if key not in LEFT_OUT]
    elif isinstance(value, list):
        children = [(f"{path}[{_label(child, k)}]", child) for k, child in enumerate(value)]
    elif isinstance(value, str) and " " in value:
        return {}  # a sentence
    else:
        return {path: value.item() if isinstance(value, np.generic) else value}
    return {where: leaf for at, child in children for where, leaf in leaves(at, child).items()}


def _label(child: Any, k: int) -> str:
    if not isinstance(child, dict) or "name" not in child:
        return str(k)
    return f"{child['name']}@{child['where']}" if "where" in child else str(child["name"])


def differences(recorded: Numbers, now: Numbers, tolerance: float) -> Iterator[str]:
    """A line for each place where two differ by more than a relative tolerance, 0: by any bit."""
    for path in recorded.keys() | now.keys():
        if path not in now or path not in recorded:
            yield f"{path}: only {'recorded' if path in recorded else 'found now'}"
            continue
        before, after = recorded[path], now[path]
        if not _is_number(before) or not _is_number(after):
            if before != after or type(before) is not type(after):
                yield f"{path}: {before!r} recorded, {after!r} now"
            continue
        if before == after or (math.isnan(before) and math.isnan(after)):
            continue
        relative = abs(after - before) / max(abs(before), abs(after))
        if not relative <= tolerance:
            yield f"{path}: {before!r} recorded, {after!r} now, {relative:.1e} relative"


def _is_number(value: Value) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def environment() -> dict[str, str]:
    """What the last bits depend on beside the code: libraries, the processor, and the kernels chosen for it.

    Sizes of caches, which follow from the model, decide how products of matrices are split.
    """
    described = Path("/proc/cpuinfo")
    model = re.search(r"model name\s*: (.*)", described.read_text()) if described.is_file() else None
    blas = sorted(
        f"{each['internal_api']} {each['version']} {each.get('architecture', '')}"
        for each in threadpool_info()
        if each["user_api"] == "blas"
    )
    return {
        "numpy": np.__version__,
        "scipy": scipy.__version__,
        "blas": ", ".join(blas),
        "machine": platform.machine(),
        "processor": model[1] if model else platform.processor(),
        "simd": " ".join(np.show_config(mode="dicts")["SIMD Extensions"]["found"]),
        "libc": " ".join(platform.libc_ver()),
    }
