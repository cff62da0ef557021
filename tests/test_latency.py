"""A source that is later than its system file says: found, named and sized, whichever it is."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from sms_adapters.system_file import load_system
from sms_online.description.parse import parse_system
from sms_online.description.schema import Sensor, System
from sms_online.effects.build import build_model
from sms_online.errors import InputError
from sms_online.pipeline.conditioning import Conditioning
from sms_online.pipeline.estimator import Estimator
from sms_online.pipeline.latency import Latencies, LatencyColumns, SourceGroup, source_groups
from sms_online.pipeline.sensing import Sensing
from sms_online.pipeline.synchronise import GridSamples
from sms_online.stream import Block
from sms_sim.simulate import exact_states
from tests.axis import AXIS
from tests.bus_streams import AxisBus, axis_testbed, merged
from tests.campaigns.sessions import disguised, noisy_session, true_parameters
from tests.conftest import noise_free_block
from tests.evaluated import judged, results_document, standard_deviation
from tests.saved import resumed
from tests.sessions_of import session_of
from tests.simulations import planar


def session(folder: Path, drive: float, encoder: float) -> tuple[System, list[Block]]:
    """20 s of the axis with its devices later than stated, s; seed 2."""
    system = axis_testbed(folder)
    bus = AxisBus(seed=2, drift=(2e-5, -3e-5), offset=0.3)
    bus.drive_arrival = bus.drive_arrival + drive
    bus.encoder_arrival = bus.encoder_arrival + encoder
    return system, merged(system, folder, bus.drive(), bus.encoder(system))[1]


@pytest.mark.long
@pytest.mark.parametrize(
    ("drive", "encoder", "source", "effect"),
    [
        (0.0, 0.002, "encoder", "sensor_lag@q_1"),
        (0.0, 0.0005, "encoder", "sensor_lag@q_1"),
        (0.001, 0.0, "drive", "torque_delay@joint_1"),
    ],
)
def test_a_latency_that_is_not_stated_is_reported(
    tmp_path: Path, drive: float, encoder: float, source: str, effect: str
) -> None:
    estimator = session_of(*session(tmp_path, drive, encoder))
    assert estimator.momentum is not None
    found = estimator.momentum.latencies.found
    assert found is not None
    assert (found.source, found.effects) == (source, (effect,))
    assert found.size == pytest.approx(drive + encoder, abs=4.0 * found.std)
    assert found.std < 1e-4
    (warning,) = (w for w in results_document(estimator)["warnings"] if "stated latency" in w)
    assert warning.startswith(f"{source}: ")
    assert warning.endswith(f"later than its stated latency ({effect})")


@pytest.mark.slow
@pytest.mark.parametrize("late", [0.0, 0.003])
def test_a_common_latency_is_not_reported(tmp_path: Path, late: float) -> None:
    estimator = session_of(*session(tmp_path, late, late))
    assert estimator.momentum is not None
    assert estimator.momentum.latencies.found is None


@pytest.mark.long
def test_what_is_known_of_latencies_is_saved_with_the_session(tmp_path: Path) -> None:
    system, blocks = session(tmp_path, 0.001, 0.0)
    half = len(blocks) // 2
    whole = Estimator(system, blocks[0].channels, "made up")
    for block in blocks[:half]:
        whole.push(block)
    continued = resumed(Estimator(system, blocks[0].channels, "made up"), whole)
    for estimator in (whole, continued):
        for block in blocks[half:]:
            estimator.push(block)
        estimator.finish()
        assert estimator.momentum is not None
    assert whole.momentum is not None
    assert continued.momentum is not None
    assert whole.momentum.latencies.found == continued.momentum.latencies.found


def test_one_source_has_nobody_to_be_late_against(tmp_path: Path) -> None:
    system = axis_testbed(tmp_path)
    alone = system.model_copy(update={"sources": system.sources[:1]})
    assert source_groups(Sensing(build_model(alone), ("force_1", "q_1"), "test")) == ()


def test_the_column_of_a_source_is_its_sensors_together() -> None:
    """With the torque's source as all the others turned round; random numbers, seed 4."""
    random = np.random.default_rng(4)
    groups = (SourceGroup("drive", (), (1,), ()), SourceGroup("a", (0, 2), (), ()), SourceGroup("b", (1,), (), ()))
    late = random.standard_normal((3, 3))
    columns = LatencyColumns(groups).of(late)
    expected = [late[:, [0, 2]].sum(axis=1), late[:, 1]]
    np.testing.assert_allclose(columns[:, 1:].T, expected, rtol=1e-12)
    np.testing.assert_allclose(columns[:, 0], -columns[:, 1] - columns[:, 2], rtol=1e-12)


def test_latencies_are_estimated_from_white_rows() -> None:
    """Least squares on rows of unit noise: size and error bar; seed 6."""
    random = np.random.default_rng(6)
    groups = (SourceGroup("drive", (), (1,), ()), SourceGroup("encoder", (0,), (), ("q_1",)))
    latencies = Latencies(groups, 2)
    for _ in range(100):
        Y, late = random.standard_normal((3, 2)), 1e4 * random.standard_normal((3, 1))
        b = Y @ [2.0, -1.0] + 1e-3 * late[:, 0] + random.standard_normal(3)
        latencies.add(np.column_stack((Y, b)), np.column_stack((-late, late)))
    found = latencies.found
    assert found is not None
    assert found.source == "encoder"
    assert found.std == pytest.approx(1e-4 / np.sqrt(300), rel=0.15)
    assert found.size == pytest.approx(1e-3, abs=4.0 * found.std)


@pytest.mark.parametrize("latency", [0.003, 0.0105])
def test_the_stated_latency_of_a_sensor_is_taken_off(latency: float) -> None:
    """Whole samples and half ones; what a motion of 1 Hz does between samples is a cubic to 1e-9 of it."""
    axis = parse_system(AXIS, "axis.toml")
    sensors = (Sensor(channels=("q_*",), latency=latency),)
    system = axis.model_copy(update={"sensors": sensors, "sample_rate": 1000.0})
    t = np.arange(2000) / 1000.0
    late = np.column_stack((np.sin(2.0 * np.pi * t), np.sin(2.0 * np.pi * (t - latency))))
    stage = Conditioning(system, ("force_1", "q_1"))
    (piece,) = stage.push(GridSamples(np.arange(2000), late, 0))
    np.testing.assert_allclose(piece.values[:, 1], piece.values[:, 0], atol=1e-9)


def test_a_held_command_acts_half_a_sample_after_its_stamp() -> None:
    """A mean over the sample is the value in its middle, to 2e-6 of a motion of 1 Hz at 1 kHz."""
    axis = parse_system(AXIS, "axis.toml")
    sensors = (Sensor(channels=("force_1",), hold=True),)
    system = axis.model_copy(update={"sensors": sensors, "sample_rate": 1000.0})
    t = np.arange(2000) / 1000.0
    command = np.column_stack((np.sin(2.0 * np.pi * (t + 5e-4)), np.sin(2.0 * np.pi * t)))
    stage = Conditioning(system, ("force_1", "q_1"))
    (piece,) = stage.push(GridSamples(np.arange(2000), command, 0))
    np.testing.assert_allclose(piece.values[:, 0], piece.values[:, 1], atol=1e-9)


def test_a_hold_is_of_torques_alone() -> None:
    text = AXIS + '[[sensor]]\nchannels = ["q_1"]\nhold = true\n'
    with pytest.raises(InputError, match=r"sensor 1\.hold: true for 'q_1'; expected hold of torques"):
        parse_system(text, "axis.toml")


@pytest.mark.long
@pytest.mark.parametrize("stated", [False, True])
def test_torques_that_are_held_are_noticed(stated: bool) -> None:
    """The planar example, grade B; every torque is the command of half a sample earlier. Seed 0."""
    system = load_system("paper-planar")
    simulation, t = planar(10.0), np.arange(0.0, 9.99, 1e-3)
    exact, later = (exact_states(simulation, instants) for instants in (t, t + 5e-4))
    block = noise_free_block(simulation, system)
    values = block.values[: t.size].copy()
    torques = [k for k, name in enumerate(block.channels) if name.startswith("tau_")]
    values[:, torques] *= later.torque / exact.torque
    block = noisy_session(system, Block(t, block.channels, values), "B", 0)
    others = tuple(sensor for sensor in system.sensors if "tau_*" not in sensor.channels)
    held = Sensor(channels=("tau_*",), hold=True)
    system = disguised(system, np.random.default_rng(0))
    system = system.model_copy(update={"sensors": (*others, held)}) if stated else system
    estimator = session_of(system, [block])
    trust = judged(estimator)
    noticed = [ground.then for ground in trust.grounds if "held over the sample" in ground.text]
    assert noticed == ([] if stated else ["state hold = true under [[sensor]] of the torques"])
    assert trust.level == ("trust" if stated else "doubt")
    off = (estimator.estimate().pi - true_parameters(load_system("paper-planar"))) / standard_deviation(estimator)
    assert np.max(np.abs(off)) < 4.0
