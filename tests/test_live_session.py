"""The live loop with made-up devices on a clock that runs ten times as fast: what it records, replays and survives."""

from __future__ import annotations

import json
import os
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest

from sms_adapters.checkpoint import read_checkpoint
from sms_adapters.clock_lanes import merger
from sms_adapters.clock_merge import PATIENCE
from sms_adapters.raw import LostDevice, Raw, SerialChunk
from sms_adapters.recorder import Recorder
from sms_adapters.recording import split
from sms_adapters.session_log import SessionHeader, from_microseconds
from sms_adapters.sources import open_source
from sms_online.description.schema import System
from sms_online.description.sources import Device
from sms_online.pipeline.estimator import Estimator
from sms_online.session import Session
from sms_online.verdict.evidence import Evidence
from sms_online.verdict.judge import judge
from sms_tools.cli import main
from sms_tools.interruption import Interruption
from sms_tools.live import feed as feed_module
from sms_tools.live import testbed
from sms_tools.live.feed import Feed, Interpreter, SessionClock
from sms_tools.live.latency import Latencies
from sms_tools.live.loop import LiveSession
from sms_tools.live.status import Leading, News, StatusWriter, line, screen
from tests.axis import DAMPING, INERTIA
from tests.bus_streams import AxisBus, axis_testbed
from tests.evaluated import results_document, standard_deviation
from tests.sessions_of import session_of

SPEED = 10.0


class FastClock(SessionClock):
    """A session's clock that runs SPEED times as fast as the machine's, from `start` on."""

    def __init__(self) -> None:
        super().__init__()
        self.start()

    def start(self) -> None:
        """Begin at zero: what it takes to build a session is none of its time."""
        self._begin = time.monotonic()

    def __call__(self) -> float:
        return from_microseconds(round(SPEED * (time.monotonic() - self._begin) * 1e6))


class Played:
    """A `Reader` that delivers raw items when they are due, `repeat` times over, and may be unplugged for a while."""

    def __init__(self, name: str, items: Sequence[Raw], clock: SessionClock, repeat: int = 1) -> None:
        self.name = name
        self.opened = 0
        self.unplugged: tuple[float, float] | None = None
        self._items = list(items)
        self._clock = clock
        self._repeat = repeat

    def open(self) -> None:
        self._check()
        self.opened += 1

    def _check(self) -> None:
        if self.unplugged is not None and self.unplugged[0] < self._clock() < self.unplugged[1]:
            raise LostDevice(self.name, "unplugged")

    def read(self, timeout: float) -> list[Raw]:
        time.sleep(0.001)
        self._check()
        due, self._items = split(self._items, self._clock())
        return [self._now(item) for item in due for _ in range(self._repeat)]

    def _now(self, item: Raw) -> Raw:
        """The item as it arrives: not before it was due."""
        if isinstance(item, SerialChunk):
            return SerialChunk(max(item.arrival, 0.0), item.data)
        return item

    def close(self) -> None:
        pass


class Bench:
    """A live session of the axis, with its parts."""

    def __init__(self, folder: Path, system: System, seconds: float = 20.0, repeat: int = 1, **options: Any) -> None:
        self.system, self.folder, self.directory = system, folder, folder / "run"
        bus = AxisBus(seconds=seconds, drift=(2e-5, -3e-5), offset=0.3)
        self.clock = FastClock()
        header = SessionHeader(self.clock.epoch, {"drive": "can", "encoder": "serial"}, 0.0, {})
        self.recorder = Recorder(self.directory, header)
        self.readers = [
            Played("drive", [bus.drive()], self.clock, repeat),
            Played("encoder", bus.encoder(system), self.clock, repeat),
        ]
        self.feeds = [Feed(reader, self.recorder) for reader in self.readers]
        self.merger = merger(system, folder)
        session = Session(system, self.merger.channels, source="live")
        self.estimator = session.estimator
        self.session = LiveSession(
            self.clock, self.feeds, self.merger, session, 0.0, self.directory, self.recorder, **options
        )

    def run(self, seconds: float, after: Callable[[], None] = lambda: None) -> dict[str, Any]:
        """The document of a session of so many seconds."""
        self.clock.start()
        with Interruption() as interruption:
            for block in self.session.blocks(interruption, seconds):
                self.estimator.push(block)
                after()
        self.estimator.finish()
        self.session.close()
        return results_document(self.estimator, 0.0, [*self.merger.warnings, *self.session.warnings])

    def replayed(self) -> dict[str, Any]:
        """The document of the recording."""
        source = open_source(self.directory, self.system, directory=self.folder)
        estimator = session_of(self.system, source)
        return results_document(estimator, 0.0, source.warnings)


@pytest.fixture
def system(tmp_path: Path) -> System:
    return axis_testbed(tmp_path)


def test_readers_leave_the_interpreter_to_a_loop_that_computes(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    done: list[str] = []
    interpreter = Interpreter()

    def fetch() -> None:
        interpreter.await_free()
        done.append("fetched")

    monkeypatch.setattr(feed_module, "COMPUTING", 60.0)
    with interpreter:
        thread = threading.Thread(target=fetch)
        thread.start()
        time.sleep(0.05)
        done.append("computed")
    thread.join()
    assert done == ["computed", "fetched"]
    monkeypatch.setattr(feed_module, "COMPUTING", 0.01)
    with interpreter:
        fetch()


@pytest.mark.realtime
def test_a_live_session_and_its_replay_give_the_same_document(tmp_path: Path, system: System) -> None:
    bench = Bench(tmp_path, system)
    live = bench.run(21.0)
    assert live["samples"] > 7000  # of 8000; a loaded machine plays the last ones too late
    for p, true in zip(live["parameters"], (INERTIA, DAMPING), strict=True):
        assert abs(p["estimate"] - true) < 4.0 * p["std"]
        assert p["identifiable"]
    assert json.dumps(bench.replayed()) == json.dumps(live)


@pytest.mark.realtime
def test_an_unplugged_device_is_named_and_opened_again(tmp_path: Path, system: System) -> None:
    bench = Bench(tmp_path, system)
    bench.readers[1].unplugged = (8.0, 10.0)
    live = bench.run(21.0)
    assert bench.readers[1].opened == 2
    assert "encoder: lost 1 times and opened again; last reason: unplugged" in live["warnings"]
    for p, true in zip(live["parameters"], (INERTIA, DAMPING), strict=True):
        assert abs(p["estimate"] - true) < 4.0 * p["std"]
    assert json.dumps(bench.replayed()) == json.dumps(live)


@pytest.mark.realtime
def test_ten_times_the_rate_drops_counts_and_replays_the_rest(
    tmp_path: Path, system: System, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(feed_module, "MOST_WAITING", 200)
    bench = Bench(tmp_path, system, seconds=10.0, repeat=10)
    waiting: list[int] = []

    def slow() -> None:
        time.sleep(0.02)  # ten ticks
        waiting.append(max(feed._waiting for feed in bench.feeds))

    live = bench.run(11.0, slow)
    assert max(waiting) <= 200
    dropped = sum(feed.dropped for feed in bench.feeds)
    assert dropped > 1000
    assert (
        f"drive: {bench.feeds[0].dropped} items recorded but not used, the estimator was too slow" in live["warnings"]
    )
    lines = sum(len((bench.directory / name).read_text().splitlines()) for name in ("drive.log", "encoder.serial"))
    assert lines == sum(feed.received for feed in bench.feeds)
    assert json.dumps(bench.replayed()) == json.dumps(live)


@pytest.mark.realtime
def test_a_display_that_never_reads_blocks_nobody(tmp_path: Path, system: System) -> None:
    reader, writer = os.pipe()
    os.set_blocking(writer, False)
    try:
        while True:
            os.write(writer, b"x" * 4096)
    except BlockingIOError:
        os.set_blocking(writer, True)
    status = StatusWriter(writer)
    bench = Bench(tmp_path, system, status=status)
    live = bench.run(21.0)
    began = time.monotonic()
    status.close()
    assert time.monotonic() - began < 2.0
    assert live["samples"] > 7000  # of 8000; a loaded machine plays the last ones too late
    os.close(reader)  # which ends the write that waits


@pytest.mark.slow
def test_health_holds_the_latency_and_the_clocks(tmp_path: Path, system: System) -> None:
    bench = Bench(tmp_path, system)
    bench.run(21.0)
    health = bench.session.health
    assert 0.0 < health["latency"]["median"] <= health["latency"]["p99"]
    assert health["clocks"].keys() == {"drive", "encoder"}


@pytest.mark.realtime
def test_a_checkpoint_of_a_running_session_gives_the_same_bits(
    tmp_path: Path, system: System, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sms_tools.live.loop.CHECKPOINT_INTERVAL", 3.0)
    bench = Bench(tmp_path, system)
    states: list[tuple[bytes, int]] = []

    def look() -> None:
        path = bench.directory / "checkpoint.msgpack"
        if path.is_file() and bench.estimator.samples > 3000 and not states:
            states.append((path.read_bytes(), bench.estimator.samples))

    bench.run(21.0, look)
    (tmp_path / "killed.msgpack").write_bytes(states[0][0])
    resumed = Estimator(system, bench.merger.channels, "resumed")
    read_checkpoint(tmp_path / "killed.msgpack").put_into(resumed)
    assert 0 < resumed.samples <= states[0][1]
    skip = resumed.samples
    for block in open_source(bench.directory, system, directory=tmp_path):
        rows = slice(min(skip, block.t.size), None)
        skip -= min(skip, block.t.size)
        resumed.push(type(block)(block.t[rows], block.channels, block.values[rows]))
    resumed.finish()
    assert resumed.estimate().pi.tobytes() == bench.estimator.estimate().pi.tobytes()
    assert standard_deviation(resumed).tobytes() == standard_deviation(bench.estimator).tobytes()


@pytest.mark.realtime
def test_two_trackers_resumed_live_replay_to_the_same_bits(
    tmp_path: Path, system: System, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The second session goes on from the first one's checkpoint, and its recording is replayed from there."""

    def played(source: Device, clock: FastClock, *_: object) -> Played:
        bus = AxisBus(seconds=10.0)
        clock.start()
        return Played(source.name, [bus.drive()] if source.name == "drive" else bus.encoder(system), clock)

    monkeypatch.setattr(testbed, "SessionClock", FastClock)
    monkeypatch.setattr(testbed, "make_reader", played)
    choices = ["--tracker", "kalman:drift=learned", "--tracker", "rls:forgetting=exponential,memory=3"]
    first, second, again = (tmp_path / name for name in ("first", "second", "again"))
    for verb in (
        ["live", "--duration", "11", *choices, "--out", str(first)],
        ["live", "--duration", "11", *choices, "--resume", str(first), "--out", str(second)],
        ["replay", str(second), "--out", str(again)],
    ):
        assert main([*verb, "--system", str(tmp_path / "axis.toml")]) == 0
    earlier, live, replayed = (
        json.loads((folder / "results.json").read_text(encoding="utf-8")) for folder in (first, second, again)
    )
    assert [tracker["name"] for tracker in live["trackers"]] == ["kalman learned", "rls exponential 3 s"]
    assert live["samples"] > earlier["samples"] + 1500
    for tracker, before in zip(live["trackers"], earlier["trackers"], strict=True):
        assert tracker["parameters"] != before["parameters"]
    assert live["trackers"][0]["memory_s"] > 1.5 * earlier["trackers"][0]["memory_s"]
    assert json.dumps(replayed["trackers"]) == json.dumps(live["trackers"])
    assert json.dumps(replayed["parameters"]) == json.dumps(live["parameters"])


def test_no_arrival_precedes_a_processed_tick() -> None:
    chunk = SerialChunk(0.5, b"a")
    feed = Feed(Played("encoder", [], FastClock()), None)
    assert feed.drain(1.0) == []
    feed._take([chunk])
    assert feed.drain(1.0) == []
    assert feed.drain(1.02) == [SerialChunk(1.0, b"a")]


def test_a_loop_that_is_behind_waits_for_its_readers(monkeypatch: pytest.MonkeyPatch) -> None:
    """It goes on when a read has come back, and at once where the device is not there."""

    class Counted(Played):
        reads = 0

        def read(self, timeout: float) -> list[Raw]:
            time.sleep(0.01)
            self.reads += 1
            return []

    monkeypatch.setattr(feed_module, "FETCHING", 60.0)
    reader = Counted("drive", [], FastClock())
    feed = Feed(reader, None)
    feed.await_fetched(0.0)
    feed.start()
    feed.tried.wait()
    before = reader.reads
    feed.await_fetched(0.0)
    assert reader.reads > before
    feed.stop()
    feed.await_fetched(0.0)


def test_a_reader_that_never_returns_is_not_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    released = threading.Event()

    class Stuck(Played):
        def read(self, timeout: float) -> list[Raw]:
            released.wait()
            return []

    monkeypatch.setattr(feed_module, "FETCHING", 0.01)
    feed = Feed(Stuck("drive", [], FastClock()), None)
    feed.start()
    feed.tried.wait()
    feed.await_fetched(0.0)
    # Nor a second time.
    monkeypatch.setattr(feed_module, "FETCHING", 60.0)
    feed.await_fetched(0.0)
    released.set()
    feed.stop()


@pytest.mark.realtime
def test_a_driver_that_raises_anything_is_a_lost_device() -> None:
    class Broken(Played):
        def read(self, timeout: float) -> list[Raw]:
            raise ZeroDivisionError("in a driver")

    feed = Feed(Broken("drive", [], FastClock()), None)
    feed.start()
    end = time.monotonic() + 5.0
    while feed.losses < 2 and time.monotonic() < end:
        time.sleep(0.01)
    feed.stop()
    assert feed.losses >= 2
    assert feed.last_loss == "ZeroDivisionError: in a driver"


def test_latency_counts_each_sample_once_and_forgets_the_start() -> None:
    latencies = Latencies()
    assert latencies.quantile(0.99) is None
    # A slow start, then a row every 20 ms that is 0.1 s old.
    for k in range(2000):
        now = 0.02 * k
        latencies.add(now, now - (0.1 if now > 5.0 else 1.5))
    assert latencies.quantile(0.5) == pytest.approx(0.11, abs=2e-3)
    assert latencies.quantile(0.99) == pytest.approx(0.12, abs=2e-3)


def test_the_status_line_says_what_matters() -> None:
    leading = [Leading("link_1.inertia", "kg m²", 0.3, 0.01)]
    gone = "drive: gone (unplugged), tried again"
    doubt = judge(Evidence(determined=(1, 2), troubles=(gone,)))
    news = News(12.0, 1234.0, 0.12, 3, 0.02, (1, 2), leading, [gone], doubt)
    said = line(news)
    for part in ("12.0 s", "1,234 samples/s", "p99 120 ms", "lost 3", "residual 2 %", "1 of 2 determined",
                 f"Doubt: {gone}", "link_1.inertia 0.3 ± 0.02 kg m²"):  # fmt: skip
        assert part in said
    *_, verdict, step = screen(news, 80).splitlines()
    assert f"Doubt: {gone}" in verdict
    assert "next: mend the device" in step


@pytest.fixture(autouse=True)
def patience(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """As much of it on the fast clock as on a real one; and readers get their turn soon, as in the program."""
    monkeypatch.setattr("sms_adapters.clock_merge.PATIENCE", SPEED * PATIENCE)
    before = sys.getswitchinterval()
    sys.setswitchinterval(1e-3)
    yield
    sys.setswitchinterval(before)
