"""`archive`: every capture of a folder a row, whatever becomes of captures, workers and the run itself."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path

import pyarrow.parquet as pq
import pytest

import sms_online as sms
from sms_tools.archive.captures import ROWS, TABLE, archive, captures_under
from sms_tools.archive.rows import Row, RowFile
from sms_tools.archive.runner import KILLED, finished
from sms_tools.cli import main
from tests.archive_tasks import square
from tests.axis import AXIS, MOTION

SESSIONS = 4


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a system file, and captures in `days`, one of them with friction, one that is no capture."""
    folder = tmp_path_factory.mktemp("rig")
    (folder / "rig.toml").write_text(AXIS + MOTION)
    system = sms.load_system(folder / "rig.toml")
    for seed in range(SESSIONS):
        day = folder / "days" / f"{seed % 2}"
        day.mkdir(parents=True, exist_ok=True)
        effects = ["coulomb_friction@joint_1:torque=0.5"] if seed == 1 else []
        capture = sms.simulate(system, grade="B", seed=seed, effects=effects)
        sms.write_capture(capture, day / f"{seed}.csv")
    (folder / "days" / "notes.csv").write_text("who,what\nme,nothing\n")
    return folder


NAMES = ["0/0.csv", "0/2.csv", "1/1.csv", "1/3.csv", "notes.csv"]


@pytest.fixture(scope="module")
def table(rig: Path) -> Path:
    assert main(["archive", str(rig / "days"), "--system", str(rig / "rig.toml"), "--out", str(rig / "out")]) == 0
    return rig / "out" / TABLE


@pytest.mark.long
def test_every_capture_has_a_row(table: Path) -> None:
    rows = pq.read_table(table).to_pylist()
    assert [row["capture"] for row in rows] == NAMES
    assert [row["verdict"] for row in rows] == ["clean", "clean", "named", "clean", None]
    assert rows[2]["effects"] == ["coulomb_friction@joint_1"]
    for row in rows[:4]:
        assert abs(row["link_1.inertia"] - 0.3) < 0.1
        assert row["error"] is None


@pytest.mark.long
def test_a_capture_that_fails_is_a_row_that_says_why(table: Path) -> None:
    row = pq.read_table(table).to_pylist()[4]
    assert "notes.csv" in row["error"]
    assert row["link_1.inertia"] is None


@pytest.mark.long
def test_results_lie_beside_and_can_be_compared(rig: Path, table: Path) -> None:
    results = [rig / "out" / name for name in NAMES if name.startswith("0/")]
    assert sms.compare(results).changed == ()
    assert (rig / "out" / "1/1.csv" / "diagnosis.json").is_file()


@pytest.mark.long
def test_resume_does_only_what_is_new_or_changed(rig: Path, table: Path, tmp_path: Path) -> None:
    days, out = tmp_path / "days", tmp_path / "out"
    shutil.copytree(rig / "days", days)
    shutil.copytree(rig / "out", out)
    system = sms.load_system(rig / "rig.toml")
    done: list[str] = []

    def note(row: Row, *_: int) -> None:
        done.append(row["capture"])

    archive(days, system, None, out, workers=1, progress=note)
    assert done == []
    text = (days / "0/2.csv").read_text()
    (days / "0/2.csv").write_text(text[: len(text) * 3 // 4])
    shutil.copy(days / "1/1.csv", days / "1/7.csv")
    rows = archive(days, system, None, out, workers=1, progress=note)
    assert sorted(done) == ["0/2.csv", "1/7.csv"]
    assert [row["capture"] for row in rows] == sorted([*NAMES, "1/7.csv"])
    assert pq.read_table(out / TABLE).num_rows == 6


def test_a_line_cut_by_a_power_failure_is_one_row_to_do_again(tmp_path: Path) -> None:
    file = RowFile(tmp_path / ROWS)
    for k in range(3):
        file.append({"capture": k})
    text = file.path.read_text()
    file.path.write_text(text[:-5])
    assert file.read() == [{"capture": 0}, {"capture": 1}]
    file.append({"capture": 2})
    assert len(file.read()) == 3


def test_a_line_cut_within_a_letter_is_one_row_to_do_again(tmp_path: Path) -> None:
    file = RowFile(tmp_path / ROWS)
    # Letters of two bytes, and ones that other splitters take for ends of lines.
    texts = ["3 µm off", "one line\x85 and\u2028 the same"]
    for text in [*texts, "± µ"]:
        file.append({"summary": text})
    file.path.write_bytes(file.path.read_bytes()[: -len('µ"}\n'.encode()) + 1])
    assert [row["summary"] for row in file.read()] == texts
    assert file.path.read_bytes().endswith(b"\n")


def test_captures_are_what_replay_reads(tmp_path: Path) -> None:
    wanted = ["a/run.csv", "a/run.log.gz", "b.mcap", "c.parquet", "d.mat", "rosbag", "session"]
    others = ["e.txt", "a/run.csv.truth.json", "f.blf.gz"]
    inside = ["rosbag/metadata.yaml", "rosbag/part_0.mcap", "session/session.toml", "session/bus.log"]
    written = [f"out/{ROWS}", f"out/{TABLE}", "out/a/run.csv/results.json"]
    for name in [*(name for name in wanted if "." in name), *others, *inside, *written]:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    assert [str(path.relative_to(tmp_path)) for path in captures_under(tmp_path)] == wanted


def test_a_folder_without_captures_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for folder, expected in ((tmp_path, "no capture"), (tmp_path / "absent", "no folder")):
        assert main(["archive", str(folder), "--system", "paper-planar", "--out", str(tmp_path / "out")]) == 2
        assert expected in capsys.readouterr().err
    with pytest.raises(sms.InputError):
        captures_under(tmp_path)


def tasks(log: Path, **deaths: str) -> dict[str, tuple[object, ...]]:
    return {str(k): (log, k, deaths.get(f"task_{k}", "never")) for k in range(12)}


def test_a_killed_worker_costs_no_row(tmp_path: Path) -> None:
    log = tmp_path / "log"
    rows = list(finished(square, tasks(log, task_4="once", task_9="once"), workers=2))
    assert sorted((int(key), row["square"]) for key, row in rows) == [(k, k**2) for k in range(12)]
    begun = Counter(map(int, log.read_text().split()))
    # Only what ran when a worker died was begun again: two workers, two deaths.
    assert sum(begun.values()) <= 12 + 4


def test_what_kills_every_worker_fails_alone(tmp_path: Path) -> None:
    rows = dict(finished(square, tasks(tmp_path / "log", task_4="always"), workers=2))
    assert rows.pop("4") == {"error": KILLED}
    assert all(row == {"square": int(key) ** 2} for key, row in rows.items())
    assert len(rows) == 11


RUN = """
import sys
from pathlib import Path
from sms_tools.archive.runner import finished
from tests.archive_tasks import linger
if __name__ == "__main__":
    list(finished(linger, {str(k): (Path(sys.argv[1]), 60.0) for k in range(4)}, workers=2))
"""


def alive(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    return True


def until(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 30.0
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.05)


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGTERM, pytest.param(signal.SIGKILL, marks=pytest.mark.long)])
def test_a_stopped_run_takes_its_workers_with_it(tmp_path: Path, number: int) -> None:
    log = tmp_path / "log"
    log.touch()
    (tmp_path / "run.py").write_text(RUN)
    paths = os.pathsep.join([os.getcwd(), *filter(None, sys.path)])
    command = [sys.executable, str(tmp_path / "run.py"), str(log)]
    with subprocess.Popen(command, env={**os.environ, "PYTHONPATH": paths}, stderr=subprocess.DEVNULL) as run:
        until(lambda: len(log.read_text().split()) == 2)
        run.send_signal(number)
    workers = [int(process) for process in log.read_text().split()]
    until(lambda: not any(alive(process) for process in workers))


def test_what_a_task_raises_is_its_row(tmp_path: Path) -> None:
    rows = dict(finished(square, tasks(tmp_path / "log", task_1="error", task_2="input"), workers=1))
    assert rows["1"] == {"error": "ZeroDivisionError: of its own"}
    assert rows["2"] == {"error": "run.csv, line 3: no number; expected a number"}


@pytest.fixture(scope="module")
def scheduler(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """Address of a scheduler with two workers, each a process of its own."""
    folder = tmp_path_factory.mktemp("cluster")
    file = folder / "scheduler.json"
    paths = os.pathsep.join(filter(None, sys.path))
    common = {"cwd": folder, "env": {**os.environ, "PYTHONPATH": paths}, "stderr": subprocess.DEVNULL}
    begin = [sys.executable, "-m"]
    quiet = ["--no-dashboard"]
    options = ["--host", "127.0.0.1", "--port", "0", "--scheduler-file", str(file), *quiet]
    running = [subprocess.Popen([*begin, "distributed.cli.dask_scheduler", *options], **common)]  # type: ignore[call-overload]
    options = ["--scheduler-file", str(file), "--nthreads", "1", *quiet]
    running += [
        subprocess.Popen([*begin, "distributed.cli.dask_worker", *options], **common)  # type: ignore[call-overload]
        for _ in range(2)
    ]
    try:
        deadline = time.monotonic() + 60.0
        while not file.exists() and time.monotonic() < deadline:
            time.sleep(0.1)
        yield str(json.loads(file.read_text())["address"])
    finally:
        # Workers say good-bye to their scheduler, so it goes last.
        for process in reversed(running):
            process.terminate()
            process.wait(timeout=30.0)


@pytest.mark.long
def test_a_cluster_makes_the_same_table(rig: Path, table: Path, scheduler: str, tmp_path: Path) -> None:
    arguments = ["archive", str(rig / "days"), "--system", str(rig / "rig.toml")]
    assert main([*arguments, "--out", str(tmp_path), "--scheduler", scheduler]) == 0
    ours, theirs = (pq.read_table(path).drop_columns(["seconds"]) for path in (table, tmp_path / TABLE))
    assert theirs.equals(ours)


@pytest.mark.long
def test_a_killed_worker_of_a_cluster_costs_no_row(scheduler: str, tmp_path: Path) -> None:
    rows = dict(finished(square, tasks(tmp_path / "log", task_4="once"), scheduler=scheduler))
    assert {key: row["square"] for key, row in rows.items()} == {str(k): k**2 for k in range(12)}


@pytest.mark.long
def test_a_scheduler_that_is_not_there(
    rig: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sms_tools.archive.runner.PATIENCE", 0.5)
    arguments = ["archive", str(rig / "days"), "--system", str(rig / "rig.toml"), "--out", str(tmp_path)]
    assert main([*arguments, "--scheduler", "nowhere:80"]) == 2
    assert "--scheduler, nowhere:80: " in capsys.readouterr().err
