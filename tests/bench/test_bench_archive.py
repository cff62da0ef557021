"""An archive of 200 short sessions: two workers against one, a worker killed in the middle, a resumed run.

pytest tests/bench/test_bench_archive.py --override-ini addopts= -s

Four minutes of two quiet cores. On a busy host wall times say little; there compare the processor time of the rows,
which the workers spend, with what two of them had: their sum over the wall time is how many cores worked at once.
"""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from time import perf_counter

import pytest

import sms_online as sms
from sms_online.description.schema import System
from sms_tools.archive.captures import ROWS, archive
from sms_tools.archive.rows import RowFile
from tests.archive_tasks import BEGUN, identify_and_die
from tests.axis import AXIS, MOTION

SESSIONS, SECONDS = 200, 3.0
# How many of the rows are there when the run is resumed, the next one cut by a power failure.
DONE = 120


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The system file and its captures, one of twenty with friction."""
    folder = tmp_path_factory.mktemp("rig")
    (folder / "rig.toml").write_text((AXIS + MOTION).replace("duration = 6.0", f"duration = {SECONDS}"))
    (folder / "days").mkdir()
    for seed in range(SESSIONS):
        effects = ["coulomb_friction@joint_1:torque=0.5"] if seed % 20 == 1 else []
        capture = sms.simulate(folder / "rig.toml", grade="B", seed=seed, effects=effects)
        sms.write_capture(capture, folder / "days" / f"{seed:03}.csv")
    return folder


@pytest.fixture(scope="module")
def system(rig: Path) -> System:
    return sms.load_system(rig / "rig.toml")


def timed(rig: Path, system: System, out: Path, workers: int) -> tuple[float, float]:
    """Wall time of all captures, and the processor time of their rows, s."""
    began = perf_counter()
    rows = archive(rig / "days", system, None, out, workers=workers)
    wall = perf_counter() - began
    assert [row["error"] for row in rows] == [None] * SESSIONS
    return wall, sum(row["seconds"] for row in rows)


def test_two_workers_against_one(rig: Path, system: System) -> None:
    one, alone = timed(rig, system, rig / "one", 1)
    two, both = timed(rig, system, rig / "two", 2)
    print(
        f"\n{SESSIONS} sessions: one worker {one:.1f} s ({alone:.1f} s of processor time, {alone / one:.2f} cores), "
        f"two workers {two:.1f} s ({both:.1f} s, {both / two:.2f} cores): {one / two:.2f} times as fast"
    )


def test_a_killed_worker_and_a_resumed_run(rig: Path, system: System, monkeypatch: pytest.MonkeyPatch) -> None:
    """A run that was stopped after DONE rows is resumed, and one of its workers is killed in the middle."""
    out = rig / "two"
    lines = (out / ROWS).read_text().splitlines(keepends=True)
    assert len(lines) == SESSIONS
    (out / ROWS).write_text("".join(lines[:DONE]) + lines[DONE][:-20])
    before = {row["capture"] for row in RowFile(out / ROWS).read()}
    monkeypatch.setattr("sms_tools.archive.captures.identify", identify_and_die)
    rows = archive(rig / "days", system, None, out, workers=2)
    begun = Counter((out / BEGUN).read_text().split())
    written = Counter(row["capture"] for row in RowFile(out / ROWS).read())
    assert [row["error"] for row in rows] == [None] * SESSIONS
    assert len(written) == SESSIONS
    assert set(written.values()) == {1}
    assert not before & set(begun)
    # Only what two workers did when one of them was killed is begun again.
    again = sum(begun.values()) - (SESSIONS - DONE)
    print(f"\nresumed after {DONE} rows: {sum(begun.values())} begun, {again} of them again behind the killed worker")
    assert 1 <= again <= 2
