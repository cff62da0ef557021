"""Results of a campaign: what is missing is done, what fails is said and done again, whatever stopped a run before."""

from __future__ import annotations

import json
import sys
from argparse import Namespace
from collections import Counter
from pathlib import Path

import pytest

from sms_tools.archive.runner import KILLED
from tests.archive_tasks import square
from tests.campaigns.results import Record, Task, campaign, complete, read, summed

COUNT = 6


@pytest.fixture
def args(tmp_path: Path) -> Namespace:
    return Namespace(results=tmp_path / "results.jsonl", workers=2, scheduler=None)


def tasks(args: Namespace, **deaths: str) -> list[Task]:
    """Squares of 0, 1, …; deaths: of some, by `task_<number>`."""
    log = args.results.with_name("log")
    return [({"case": "square", "seed": k}, (log, k, deaths.get(f"task_{k}", "never"))) for k in range(COUNT)]


def begun(args: Namespace) -> Counter[int]:
    """How often each task was begun."""
    return Counter(map(int, args.results.with_name("log").read_text().split()))


def squares(records: list[Record]) -> dict[int, int]:
    return {record["seed"]: record["square"] for record in records if "error" not in record}


EXPECTED = {k: k**2 for k in range(COUNT)}


def summary(records: list[Record]) -> str:
    return f"{len(records)} squares"


def test_a_record_has_the_names_of_its_task(args: Namespace) -> None:
    complete(args, square, tasks(args))
    assert sorted(read(args.results), key=lambda record: int(record["seed"])) == [
        {"case": "square", "seed": k, "square": k**2} for k in range(COUNT)
    ]


def test_a_campaign_does_nothing_twice(args: Namespace) -> None:
    complete(args, square, tasks(args)[:4])
    complete(args, square, tasks(args))
    complete(args, square, tasks(args))
    assert set(begun(args).values()) == {1}
    assert squares(read(args.results)) == EXPECTED


def test_another_case_of_the_same_seed_is_another_task(args: Namespace) -> None:
    complete(args, square, tasks(args))
    complete(args, square, [({**names, "case": "again"}, arguments) for names, arguments in tasks(args)])
    assert set(begun(args).values()) == {2}


def test_a_failed_task_says_why_and_is_done_again(args: Namespace, capsys: pytest.CaptureFixture[str]) -> None:
    complete(args, square, tasks(args, task_2="error", task_3="always"))
    failed = {record["seed"]: record["error"] for record in read(args.results) if "error" in record}
    assert failed == {2: "ZeroDivisionError: of its own", 3: KILLED}
    assert "square/2: ZeroDivisionError: of its own" in capsys.readouterr().out
    said = summed(summary)(args)
    assert said is not None
    assert said.splitlines() == [
        "4 squares",
        *sorted(f"FAILED square/{seed}: {error}" for seed, error in failed.items()),
    ]
    before = begun(args)
    complete(args, square, tasks(args))
    assert begun(args) - before == {2: 1, 3: 1}
    assert squares(read(args.results)) == EXPECTED
    assert summed(summary)(args) == "6 squares"


def test_a_record_cut_by_a_power_failure_is_done_again(args: Namespace) -> None:
    complete(args, square, tasks(args))
    whole = args.results.read_text()
    args.results.write_text(whole[:-9])
    complete(args, square, tasks(args))
    assert sum(begun(args).values()) == COUNT + 1
    assert squares(read(args.results)) == EXPECTED
    assert [json.loads(line) for line in args.results.read_text().splitlines()] == read(args.results)


def test_the_workers_are_chosen_on_the_command_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    seen: list[Namespace] = []
    monkeypatch.chdir(tmp_path)
    for options in (["--workers", "3"], ["--scheduler", "nowhere:80"], []):
        monkeypatch.setattr(sys, "argv", ["campaign", "run", "results.jsonl", *options])
        campaign(None, {"run": seen.append})
    assert [(args.workers, args.scheduler) for args in seen] == [(3, None), (None, "nowhere:80"), (None, None)]
    assert seen[0].results == tmp_path / "results.jsonl"
    campaign(None, {"run": seen.append}, alone=True)
    assert seen[-1].workers == 1
    monkeypatch.setattr(sys, "argv", ["campaign", "run", "results.jsonl", "--workers", "3"])
    with pytest.raises(SystemExit):
        campaign(None, {"run": seen.append}, alone=True)
    assert "--workers" in capsys.readouterr().err
