"""Searches beside a live session, their repetition in its replay, and what people get to see of them."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from rerun.chunk import RrdReader

from sms_adapters.capture import CaptureWriter
from sms_adapters.searches import NAME, Repeated, searcher_of
from sms_adapters.sources import open_source
from sms_adapters.system_file import load_system
from sms_online.diagnosis.online import OnlineDiagnosis
from sms_online.diagnosis.online_search import Immediate, search
from sms_online.diagnosis.searcher import Outcome, Request, Searcher
from sms_online.errors import InputError
from sms_online.pipeline.blocks import blocks
from sms_online.pipeline.estimator import Estimator
from sms_online.stream import Array
from sms_tools.cli import main
from sms_tools.live.searches import SearchProcess
from tests import bus_streams
from tests.axis import AXIS
from tests.axis_effects import COGGING, SYSTEM, axis_block, cogging
from tests.bus_streams import axis_testbed
from tests.evaluated import results_document
from tests.test_live_session import Bench, patience

BEGIN = 8.0  # s
# Waiting for another process, s: rather a failure than a suite that hangs.
WAIT = 120.0

__all__ = ["patience"]  # the fixture of live sessions on a fast clock


class Late(Immediate):
    """Answers that are used some blocks after they were asked for, and noted as a live session notes them."""

    def __init__(self, directory: Path, late: int) -> None:
        super().__init__()
        self._late, self._asked, self._path = late, 0, directory / NAME
        self._path.write_text(json.dumps({"adopt": True}) + "\n")

    def submit(self, number: int, request: Request) -> bool:
        """One at a time."""
        self._asked = 0
        return self._done is None and super().submit(number, request)

    def outcome(self, block: int) -> tuple[int, Outcome | None] | None:
        """After so many blocks."""
        self._asked += 1
        if self._done is None or self._asked < self._late:
            return None
        with self._path.open("a") as file:
            file.write(json.dumps({"search": self._done[0], "block": block}) + "\n")
        return super().outcome(block)


@pytest.mark.realtime
def test_a_live_session_and_its_replay_give_the_same_document(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With --adopt; how far it comes depends on the machine, for answers take time and the clock runs fast."""
    plain = bus_streams.motion

    def motion(t: Array) -> tuple[Array, Array]:
        torque, q = plain(t)
        return torque + np.where(t > BEGIN, cogging(q, q), 0.0), q

    monkeypatch.setattr(bus_streams, "motion", motion)
    bench = Bench(tmp_path, axis_testbed(tmp_path))
    online = OnlineDiagnosis(bench.estimator, Late(bench.directory, 3), adopt=True)
    live = bench.run(21.0)
    assert online.episodes

    source = open_source(bench.directory, bench.system, directory=tmp_path)
    estimator = Estimator(bench.system, source.channels, "replay")
    again = OnlineDiagnosis(estimator, searcher_of(bench.directory, adopt=True), adopt=True)
    for block in source:
        estimator.push(block)
    estimator.finish()
    assert json.dumps(again.document()) == json.dumps(online.document())
    assert json.dumps(results_document(estimator, 0.0, source.warnings)) == json.dumps(live)


@pytest.mark.long
def test_late_answers_are_as_late_in_the_repetition(tmp_path: Path) -> None:
    """Not so at once, as without notes of the session: then the effect is adopted earlier."""
    block = axis_block(cogging, BEGIN, seconds=14.0)
    documents = []
    # The notes are there when the second session begins.
    searchers: list[Callable[[], Searcher]] = [
        lambda: Late(tmp_path, 4), lambda: searcher_of(tmp_path, adopt=True), Immediate,
    ]  # fmt: skip
    for searcher, size in zip(searchers, (64, 1000, 64), strict=True):
        estimator = Estimator(SYSTEM, block.channels, "session")
        online = OnlineDiagnosis(estimator, searcher(), adopt=True)
        for piece in block.pieces(size):
            estimator.push(piece)
        estimator.finish()
        assert online.episodes[0].adopted is not None
        documents.append(json.dumps([online.document(), results_document(estimator, 0.0, [])]))
    assert documents[0] == documents[1] != documents[2]


@pytest.mark.long
def test_what_falls_due_during_a_search_is_searched_after_it(tmp_path: Path) -> None:
    """An answer that takes two seconds skips one search that is due; the next one does not wait for another to be."""
    block = axis_block(cogging, BEGIN, seconds=14.0)
    estimator = Estimator(SYSTEM, block.channels, "session")
    newest: list[float] = []

    class Slow(Late):
        def submit(self, number: int, request: Request) -> bool:
            newest.append(float(request.segments[-1].index[-1]) / SYSTEM.sample_rate)
            return super().submit(number, request)

    blocks_a_second = 1.0 / blocks(SYSTEM, 1.0 / SYSTEM.sample_rate)[1]
    online = OnlineDiagnosis(estimator, Slow(tmp_path, round(2.0 * blocks_a_second)), adopt=False)
    estimator.push(block)
    estimator.finish()
    assert online.episodes[0].verdict == "named"
    assert newest[1] - newest[0] == pytest.approx(2.0, abs=1.5 / blocks_a_second)


@cache
def asked() -> Request:
    """What a session with an effect asks for first."""
    requests: list[Request] = []

    class Asked(Immediate):
        def submit(self, number: int, request: Request) -> bool:
            requests.append(request)
            return False

    block = axis_block(cogging, BEGIN, seconds=11.0)
    estimator = Estimator(SYSTEM, block.channels, "asked")
    OnlineDiagnosis(estimator, Asked(), adopt=False)
    estimator.push(block)
    return requests[0]


@pytest.mark.slow
def test_a_search_in_another_process_says_what_it_says_here(tmp_path: Path) -> None:
    searches = SearchProcess(tmp_path, adopt=True)
    assert searches.submit(3, asked())
    assert not searches.submit(4, asked())  # one at a time
    end, done = time.monotonic() + WAIT, None
    while done is None and time.monotonic() < end:
        done = searches.outcome(17)
        time.sleep(0.01)
    searches.close()
    assert done is not None
    assert done[0] == 3
    here = search(asked())
    assert done[1] is not None
    assert here is not None
    assert (done[1].verdict, done[1].scores, done[1].left) == (here.verdict, here.scores, here.left)
    assert done[1].beta.tobytes() == here.beta.tobytes()
    noted = [json.loads(line) for line in (tmp_path / NAME).read_text().splitlines()]
    assert noted == [{"adopt": True}, {"begun": 3}, {"search": 3, "block": 17}]


def test_a_search_process_that_dies_is_not_waited_for(tmp_path: Path) -> None:
    searches = SearchProcess(tmp_path, adopt=False)
    searches._process.kill()
    searches._process.wait()
    searches.submit(1, asked())
    end = time.monotonic() + WAIT
    while searches.problem is None and time.monotonic() < end:
        time.sleep(0.01)
    assert searches.problem is not None
    assert searches.problem.startswith("no more searches for effects")
    assert searches.outcome(5) == (1, None)
    assert not searches.submit(2, asked())
    searches.close()
    # The replay does not make it, and goes on when the session did.
    repeated = searcher_of(tmp_path, adopt=False)
    assert repeated.submit(1, asked())
    assert repeated.outcome(4) is None
    assert repeated.outcome(5) == (1, None)
    assert not repeated.submit(2, asked())


def test_a_search_overtaken_by_the_sessions_end_never_answers(tmp_path: Path) -> None:
    searches = SearchProcess(tmp_path, adopt=False)
    assert searches.submit(1, asked())
    searches.close()
    assert searches.problem is None
    repeated = searcher_of(tmp_path, adopt=False)
    assert repeated.submit(1, asked())
    assert repeated.outcome(1000) is None


def test_searches_are_repeated_only_under_the_same_conditions(tmp_path: Path) -> None:
    assert searcher_of(tmp_path, adopt=True) is None
    (tmp_path / NAME).write_text('{"adopt": true}\n{"search": 1, "block": 9}\n{"search": 2, "bl')
    assert isinstance(searcher_of(tmp_path, adopt=True), Repeated)
    assert searcher_of(tmp_path, adopt=False) is None
    (tmp_path / NAME).write_text('{"adopt": true}\n{"search": "first"}\n')
    with pytest.raises(InputError, match=NAME):
        searcher_of(tmp_path, adopt=True)


@pytest.fixture(scope="module")
def replayed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The directory of a replay with --adopt and a recording of the view."""
    folder = tmp_path_factory.mktemp("adopted")
    (folder / "axis.toml").write_text(AXIS)
    block = axis_block(cogging, BEGIN)
    with CaptureWriter(folder / "run.csv", block.channels) as writer:
        writer.write(block)
    arguments = ["replay", str(folder / "run.csv"), "--system", str(folder / "axis.toml"), "--out", str(folder)]
    assert main([*arguments, "--adopt", "--rerun", "save"]) == 0
    return folder


@pytest.mark.slow
def test_results_hold_verdict_and_evidence_of_what_was_adopted(replayed: Path) -> None:
    results = json.loads((replayed / "results.json").read_text())
    (episode,) = results["diagnosis"]
    assert (episode["verdict"], episode["effects"][0]["name"]) == ("named", "cogging")
    assert episode["noticed"] < episode["named"] < episode["adopted"]
    assert len(episode["evidence"]) == 2
    found = {p["name"]: p["estimate"] for p in results["parameters"]}
    amplitude = np.hypot(found["cogging@joint_1.cosine"], found["cogging@joint_1.sine"])
    assert amplitude == pytest.approx(COGGING, rel=0.02)


@pytest.mark.slow
def test_the_adopted_system_file_describes_the_effect(replayed: Path) -> None:
    described, adopted = (load_system(str(replayed / name)) for name in ("axis.toml", "adopted.toml"))
    (fresh,) = (effect for effect in adopted.effects if effect not in described.effects)
    assert (fresh.name, fresh.where, fresh.coefficients["order"]) == ("cogging", "joint_1", 6.0)


@pytest.mark.slow
def test_the_page_shows_the_verdict_and_how_the_evidence_grew(replayed: Path) -> None:
    page = (replayed / "report.html").read_text()
    assert "<h2>Diagnosis</h2>" in page
    assert "the model lacks cogging@joint_1" in page
    assert "Evidence for candidates" in page


@pytest.mark.slow
def test_the_view_plots_the_evidence_and_logs_the_verdict(replayed: Path) -> None:
    scores: dict[str, list[float]] = {}
    lines: list[str] = []
    for chunk in RrdReader(str(replayed / "session.rrd")).stream():
        for row in chunk.to_record_batch().to_pylist():
            if chunk.entity_path.startswith("/evidence/") and row.get("Scalars:scalars"):
                scores.setdefault(chunk.entity_path, []).extend(row["Scalars:scalars"])
            lines += row.get("TextLog:text") or []
    (cogs,) = (values for path, values in scores.items() if "cogging" in path)
    gains = [search["candidates"]["cogging@joint_1"] for search in _evidence(replayed)]
    assert cogs == pytest.approx(np.log10(gains).tolist())
    assert any("the model lacks cogging@joint_1" in text and "added to the model" in text for text in lines)


def _evidence(folder: Path) -> list[dict[str, dict[str, float]]]:
    evidence: list[dict[str, dict[str, float]]] = json.loads((folder / "results.json").read_text())["diagnosis"][0][
        "evidence"
    ]
    return evidence
