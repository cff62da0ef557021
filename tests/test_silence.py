"""Devices that say nothing, come back, or were not listened to: the true cause is named."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import sms_online as sms
from sms_adapters.raw import SerialChunk
from sms_online.checkpoint import Checkpoint
from sms_online.description.parse import parse_system
from sms_online.description.schema import System
from sms_online.pipeline.estimator import Estimator
from sms_online.stream import Block
from tests.axis import AXIS, axis_block
from tests.bus_streams import AxisBus, axis_testbed, merged
from tests.test_live_session import Bench


@pytest.fixture
def system(tmp_path: Path) -> System:
    return axis_testbed(tmp_path)


@pytest.mark.parametrize("silent", ["drive", "encoder"])
def test_a_source_that_sends_nothing_is_named(tmp_path: Path, system: System, silent: str) -> None:
    bus = AxisBus(seconds=8.0)
    drive, encoder = bus.drive(), bus.encoder(system)
    ours, blocks = merged(system, tmp_path, *((drive[:0], encoder) if silent == "drive" else (drive, [])))
    assert f"{silent}: nothing was received" in ours.warnings
    assert silent in ours.silent(8.0)
    session = sms.Session(system, ours.channels)
    for block in blocks:
        session.update(block)
    session.finish()
    trust = session.result.trust
    assert (trust.level, trust.sentence) == ("not yet", f"Not yet: nothing was received of {silent}")
    assert "power, cable and address" in trust.next_step


def test_a_session_without_any_sample_names_all_sources(system: System) -> None:
    session = sms.Session(system, ("force_1", "q_1"))
    assert "nothing was received of drive, encoder" in session.result.trust.sentence


def test_a_session_that_begins_names_nobody(system: System) -> None:
    session = sms.Session(system, ("force_1", "q_1"))
    session.update(np.array([0.0]), np.array([[0.1, 0.2]]))
    assert "nothing was received" not in session.result.trust.sentence


def test_an_empty_column_is_named() -> None:
    block = axis_block(coulomb=0.0)
    values = np.column_stack((block.values[:, 0], np.full(block.t.size, np.nan)))
    result = sms.estimate(parse_system(AXIS, "axis.toml"), sms.Capture(block.t, block.channels, values))
    assert result.trust.sentence == "Not yet: nothing was received of q_1"


def test_what_comes_late_after_a_silence_is_no_slow_machine(tmp_path: Path, system: System) -> None:
    bus = AxisBus(seconds=20.0)
    # Away for two seconds; what the device has kept comes when it is back.
    kept = [
        SerialChunk(max(each.arrival, 10.0), each.data) if each.arrival > 8.0 else each for each in bus.encoder(system)
    ]
    ours, _ = merged(system, tmp_path, bus.drive(), kept)
    said = [warning for warning in ours.warnings if warning.startswith("encoder")]
    assert any("samples skipped, they came late after it had been silent" in warning for warning in said), said
    assert not any("too slow" in warning for warning in said)


def test_a_host_that_is_late_loses_nothing(tmp_path: Path, system: System) -> None:
    bus = AxisBus(seconds=16.0)
    for arrival in (bus.drive_arrival, bus.encoder_arrival):
        arrival[(arrival > 6.0) & (arrival < 6.8)] = 6.8  # a stall of all
        arrival[arrival > 10.0] += 0.2 * np.minimum(arrival[arrival > 10.0] - 10.0, 4.0)  # slower and slower
    ours, blocks = merged(system, tmp_path, bus.drive(), bus.encoder(system))
    assert ours.late == ours.missed == [0, 0]
    for column in range(2):
        assert sum(np.count_nonzero(~np.isnan(block.values[:, column])) for block in blocks) == bus.angle.size


def test_a_source_that_lags_is_not_waited_for_for_ever(tmp_path: Path, system: System) -> None:
    bus = AxisBus(seconds=10.0)
    bus.encoder_arrival[bus.encoder_arrival > 6.0] += 0.6
    ours, _ = merged(system, tmp_path, bus.drive(), bus.encoder(system))
    assert ours.late[0] == 0
    assert ours.late[1] > 0


def test_late_estimates_after_an_absence_have_its_cause(tmp_path: Path, system: System) -> None:
    bench = Bench(tmp_path, system)
    for newest in (0.0, 3.9):
        bench.session.latencies.add(4.0, newest)
    late = [trouble for trouble in bench.session.troubles if "late" in trouble]
    assert late == ["estimates come 4.0 s late after drive, encoder had reconnected"]


@pytest.mark.slow
@pytest.mark.parametrize(("pause", "lost"), [(100.0, 0), (0.5, 100)])
def test_a_pause_before_a_resumption_is_no_loss(pause: float, lost: int) -> None:
    system, block = parse_system(AXIS, "axis.toml"), axis_block(coulomb=0.0)
    first, second = Estimator(system, block.channels, "first"), Estimator(system, block.channels, "second")
    first.push(Block(block.t[:1200], block.channels, block.values[:1200]))
    Checkpoint.of(first).put_into(second)
    later = Block(block.t[1200:] + pause, block.channels, block.values[1200:])
    for estimator in (first, second):
        estimator.push(later)
        estimator.finish()
    assert first.counters.lost_samples == 200 * pause
    assert second.counters.lost_samples == lost
    assert second.counters.gaps == 1
    np.testing.assert_array_equal(first.estimate().pi, second.estimate().pi)


@pytest.mark.parametrize("stops", ["q_1", "both"])
def test_a_source_that_falls_silent_at_once_is_named(tmp_path: Path, system: System, stops: str) -> None:
    block = axis_block(coulomb=0.0)
    values = block.values.copy()
    values[50:, block.channels.index("q_1")] = np.nan
    session = sms.Session(system, block.channels)
    if stops == "q_1":
        session.update(block.t, values)
        trust = session.evaluation().trust
        assert trust.sentence == "Not yet: nothing has come of encoder since 0.2 s"
        assert "power, cable and address" in trust.next_step
    else:
        session.update(block.t[:50], block.values[:50])
        trust = session.evaluation(["encoder: silent", "drive: silent"]).trust
        assert trust.sentence == "Not yet: encoder: silent"
        assert trust.reasons[1:3] == ("drive: silent", "no parameter is determined by the motion of 0.245 s")
        assert "the device" in trust.next_step


@pytest.mark.parametrize(("pause", "lost"), [(True, 0), (False, 999)])
def test_a_pause_between_two_recordings_is_no_loss(pause: bool, lost: int) -> None:
    block = axis_block(coulomb=0.0)
    session = sms.Session(parse_system(AXIS, "axis.toml"), block.channels)
    session.update(block)
    if pause:
        session.pause()
    session.update(sms.Block(block.t + block.t[-1] + 5.0, block.channels, block.values))
    session.finish()
    assert session.result.lost_samples == lost
    assert ("samples are lost" in session.result.trust.sentence) is not pause
