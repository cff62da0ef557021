"""The same samples give the same bits, however many threads BLAS may use."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import scipy.linalg  # noqa: F401  # with its BLAS
from threadpoolctl import threadpool_info, threadpool_limits

from sms_adapters.system_file import load_system
from sms_online.diagnosis import online_search
from sms_online.diagnosis.online import OnlineDiagnosis
from sms_online.diagnosis.online_search import Immediate
from sms_online.pipeline.estimator import Estimator
from sms_online.pipeline.observer import Observer
from sms_online.threads import one_blas_thread
from sms_sim.simulate import sampled_blocks, simulate
from tests.axis_effects import BARE, axis_block, nothing

MORE = 2
# A session of the seven-joint arm, whose matrices are large enough to be split; pushed whole or sample by sample.
SCRIPT = """
import json, sys
import numpy as np
from sms_adapters.system_file import load_system
from sms_online.pipeline.estimator import Estimator
from sms_online.pipeline.observer import Observer
from tests.evaluated import results_document
from sms_online.stream import Block

with np.load(sys.argv[1]) as saved:
    block = Block(saved["t"], tuple(saved["channels"].tolist()), saved["values"])
estimator = Estimator(load_system("seven-joint"), block.channels, "test")
for piece in block.pieces(int(sys.argv[2])):
    estimator.push(piece)
estimator.finish()
print(json.dumps(results_document(estimator, 0.0, [])))
"""


def threads() -> set[int]:
    """How many threads NumPy's and SciPy's BLAS may use."""
    return {each["num_threads"] for each in threadpool_info() if each["user_api"] == "blas"}


def test_the_limit_ends_with_the_last_computation() -> None:
    with threadpool_limits(MORE, user_api="blas"):
        with one_blas_thread():
            with one_blas_thread():
                assert threads() == {1}
            assert threads() == {1}
        assert threads() == {MORE}
        with pytest.raises(ArithmeticError), one_blas_thread():
            raise ArithmeticError
        assert threads() == {MORE}


@pytest.mark.long
def test_blocks_and_searches_are_worked_off_by_one_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[set[int]] = []
    searched: list[set[int]] = []
    plain = online_search._search

    def watched(request: online_search.Request) -> online_search.Outcome | None:
        searched.append(threads())
        return plain(request)

    monkeypatch.setattr(online_search, "_search", watched)
    block = axis_block(nothing, seconds=9.0)
    with threadpool_limits(MORE, user_api="blas"):
        estimator = Estimator(BARE, block.channels, "test")
        requests: list[online_search.Request] = []
        online = OnlineDiagnosis(estimator, Immediate(), adopt=False)
        monkeypatch.setattr(online.searcher, "submit", lambda number, request: bool(requests.append(request)))

        class Watcher(Observer):
            def block_through(self) -> None:
                seen.append(threads())

        estimator.observers.append(Watcher())
        for piece in block.pieces(7):
            estimator.push(piece)
            assert threads() == {MORE}
        estimator.finish()
        assert len(seen) > 10
        # As the worker process of a live session has it, without an estimator.
        online_search.search(requests[0])
    assert set.union(*seen) == {1}
    assert searched == [{1}]


def run(capture: Path, size: int, limit: str | None) -> str:
    """What the session's numbers are in a process of its own; limit: on threads, by the environment."""
    environment = {key: value for key, value in os.environ.items() if not key.endswith("_NUM_THREADS")}
    environment |= {} if limit is None else {"OPENBLAS_NUM_THREADS": limit}
    environment["PYTHONPATH"] = os.pathsep.join(sys.path)
    command = [sys.executable, "-c", SCRIPT, str(capture), str(size)]
    return subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout


@pytest.mark.long
def test_samples_one_by_one_give_the_bits_of_the_whole(tmp_path: Path) -> None:
    """Two seconds at grade B (seed 1). Unlimited, two threads give other bits than one."""
    system, capture = load_system("seven-joint"), tmp_path / "capture.npz"
    blocks = list(sampled_blocks(simulate(system, 2.0, position_tolerance=1e-8), "B", 1))
    t, values = (np.concatenate([getattr(block, part) for block in blocks]) for part in ("t", "values"))
    np.savez(capture, t=t, values=values, channels=np.array(blocks[0].channels))
    whole = run(capture, t.size, "1")
    assert run(capture, 1, None) == whole
    assert run(capture, t.size, str(MORE)) == whole
