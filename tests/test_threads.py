"""The same samples give the same bits, however many threads BLAS may use."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import scipy.linalg  # noqa: F401  # with its BLAS
from axis_effects import BARE, axis_block, nothing
from threadpoolctl import threadpool_info, threadpool_limits

from sms_online.diagnosis import online_search
from sms_online.diagnosis.online import Immediate, OnlineDiagnosis
from sms_online.pipeline.estimator import Estimator
from sms_online.threads import one_blas_thread

MORE = 2
# A session pushed whole or sample by sample, with the diagnosis beside it; prints its numbers.
SCRIPT = """
import json, sys
from one_link import one_link
from sms_online.pipeline.estimator import Estimator
from sms_online.results import results_document
from sms_sim.simulate import sampled_blocks, simulate

system = one_link("linear")
blocks = list(sampled_blocks(simulate(system, 1.5, position_tolerance=1e-8), None, 0))
estimator = Estimator(system, blocks[0].channels, "test")
for block in blocks:
    for piece in block.pieces(int(sys.argv[1])):
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
        monkeypatch.setattr(online._searcher, "submit", lambda number, request: bool(requests.append(request)))
        step = estimator.on_block
        assert step is not None

        def on_block() -> None:
            seen.append(threads())
            step()

        estimator.on_block = on_block
        for piece in block.pieces(7):
            estimator.push(piece)
            assert threads() == {MORE}
        estimator.finish()
        assert len(seen) > 10
        assert np.unique(list(map(len, seen))) == [1]
        # As the worker process of a live session has it, without an estimator.
        online_search.search(requests[0])
    assert set.union(*seen) == {1}
    assert searched == [{1}]


def run(size: int, limit: str | None) -> str:
    """What the session's numbers are in a process of its own; limit: on threads, by the environment."""
    environment = {key: value for key, value in os.environ.items() if not key.endswith("_NUM_THREADS")}
    environment |= {} if limit is None else {"OPENBLAS_NUM_THREADS": limit}
    environment["PYTHONPATH"] = os.pathsep.join([str(Path(__file__).parent), *sys.path])
    command = [sys.executable, "-c", SCRIPT, str(size)]
    return subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout


def test_samples_one_by_one_give_the_bits_of_the_whole_with_any_threads() -> None:
    """1.5 s of a link that needs the smoother, simulated anew in each process."""
    assert run(1, None) == run(1, str(MORE)) == run(10_000, "1")
