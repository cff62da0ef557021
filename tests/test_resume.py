"""A resumed live session goes on in the turn in which its encoder was."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from sms_adapters.checkpoint import write_checkpoint
from sms_adapters.clock_lanes import merger
from sms_adapters.clock_merge import Merger
from sms_adapters.recorder import Recorder
from sms_adapters.recording import tick_time
from sms_adapters.session_log import CHECKPOINT as RESUMED_FROM
from sms_adapters.session_log import SessionHeader
from sms_adapters.sources import open_source
from sms_online.checkpoint import SOURCE, Checkpoint
from sms_online.description.schema import System
from sms_online.pipeline.estimator import Estimator
from sms_online.stream import Array, Block
from sms_tools.live.loop import CHECKPOINT
from sms_tools.live.testbed import open_testbed
from tests.bus_streams import SOURCES, AxisBus, axis_testbed, ticks

TURN = 6.283185307179586
TURNING = 3.0  # rad/s on average: eight seconds are nearly four turns
SECONDS, SAVED_AT = 8.0, 4.0
EPOCH = 1_700_000_000_000_000
WRAPPING = SOURCES.replace('channel = "q_1" }', f'channel = "q_1", wrap = {TURN} }}')


class Bench:
    """A testbed whose axis turns on, and a checkpoint of its first half."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.system: System = axis_testbed(folder, WRAPPING)
        self.bus = AxisBus(seconds=SECONDS)
        self.angle = self.bus.angle + TURNING * np.arange(self.bus.angle.size) / 200.0
        self.bus.angle = np.mod(self.angle, TURN)
        self.items = ticks(self.bus.drive(), self.bus.encoder(self.system))
        self.half = round(SAVED_AT / tick_time(1))
        first = merger(self.system, folder)
        self.pushed(first, 1, self.half)
        estimator = Estimator(self.system, first.channels, "bench")
        saved = Checkpoint.of(estimator, None, first)
        self.earlier = folder / "earlier"
        Recorder(self.earlier, self.header(), {}).close(SAVED_AT)
        write_checkpoint(self.earlier / CHECKPOINT, saved)
        self.checkpoint = Checkpoint.from_bytes(saved.to_bytes(), "bench")

    def header(self) -> SessionHeader:
        return SessionHeader(EPOCH, {"drive": "can", "encoder": "serial"}, 0.0, {})

    def pushed(self, ours: Merger, begin: int, end: int) -> list[Block]:
        """Blocks of the ticks from one number to the next."""
        found = [ours.advance(tick_time(k), self.items[k - 1]) for k in range(begin, end)]
        return [block for block in found if block is not None]

    def off_by(self, blocks: list[Block]) -> Array:
        """Angles less those that the axis had at the end, rad: its noise, and what it moves by in a sample."""
        column = blocks[0].channels.index("q_1")
        angles = np.concatenate([block.values[:, column] for block in blocks])
        angles = angles[np.isfinite(angles)]
        return np.asarray(angles - self.angle[-angles.size :])


@pytest.fixture
def bench(tmp_path: Path) -> Bench:
    return Bench(tmp_path)


def test_an_encoder_keeps_its_turn_with_a_checkpoint(bench: Bench) -> None:
    fresh, resumed = (merger(bench.system, bench.folder) for _ in range(2))
    bench.checkpoint.put_beside(SOURCE, resumed)
    off = []
    for ours in (fresh, resumed):
        blocks = bench.pushed(ours, bench.half, len(bench.items) + 1)
        last = ours.finish()
        off.append(bench.off_by(blocks if last is None else [*blocks, last]))
    assert np.abs(off[1]).max() < 1e-9
    turns = off[0] / TURN
    assert np.abs(turns).min() > 0.5
    np.testing.assert_allclose(turns, np.rint(turns), atol=1e-9)


def test_a_resumed_recording_is_read_in_the_same_turn(bench: Bench) -> None:
    run = bench.folder / "run"
    recorder = Recorder(run, bench.header(), {})
    for k in range(bench.half, len(bench.items) + 1):
        for name, items in zip(("drive", "encoder"), bench.items[k - 1], strict=True):
            recorder.put(name, items, dropped=False)
    recorder.close(SECONDS + 1.0)
    write_checkpoint(run / RESUMED_FROM, bench.checkpoint)
    blocks = list(open_source(run, bench.system, directory=bench.folder))
    assert np.abs(bench.off_by(blocks)).max() < 1e-9


def test_a_live_session_resumes_with_the_turns_of_its_source(bench: Bench) -> None:
    file = bench.folder / "axis.toml"
    _, _, ours = open_testbed(str(file), bench.system, bench.folder, bench.folder / "run", bench.earlier)
    assert ours.state.turns["q_1"].turns >= 1.0
