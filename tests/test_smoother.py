"""Sessions of a link whose slopes are not measured: accuracy, error bars, gaps, wrong models, the same bits."""

from __future__ import annotations

import json
import math
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from scipy.signal import lfilter

from sms_adapters.capture import CaptureWriter
from sms_adapters.checkpoint import read_checkpoint, write_checkpoint
from sms_adapters.system_file import load_system
from sms_online.checkpoint import Checkpoint
from sms_online.cramer_rao import STEP, MotionRecord, cramer_rao_bound, session_bound
from sms_online.description.channels import channels
from sms_online.description.parse import describe
from sms_online.description.schema import Effect, Sensor, System
from sms_online.errors import InputError
from sms_online.linearised import Motion
from sms_online.pipeline.estimator import Estimator
from sms_online.pipeline.snapshot import statistics_of
from sms_online.row_types import NOISE_WHITENED
from sms_online.sensor_set import sensor_set
from sms_online.smoother.statistics import LARGEST_TORQUE_NOISE
from sms_online.stream import Array, Block
from sms_online.trackers.interface import Prior
from sms_online.verdict.judged import JudgedEvaluation
from sms_sim.plant import Plant
from sms_sim.sensors import Sensors
from sms_sim.simulate import Simulation, exact_states, sampled_blocks, simulate
from sms_tools.cli import main
from tests.evaluated import elsewhere, results_document, standard_deviation
from tests.one_link import TEXT, one_link
from tests.sessions_of import session_of

SEEDS = 6
MISSING = ("link_1.marker_1.theta_z", "link_1.marker_2.theta_z")


@pytest.fixture(scope="module")
def simulation() -> Simulation:
    return simulate(one_link("linear"))


def recorded(simulation: Simulation, seed: int) -> Block:
    """A whole session in one block."""
    blocks = list(sampled_blocks(simulation, None, seed))
    t, values = (np.concatenate([getattr(block, name) for block in blocks]) for name in ("t", "values"))
    return Block(t, blocks[0].channels, values)


def session(system: System, block: Block) -> Estimator:
    return session_of(system, [block])


def truth_of(estimator: Estimator) -> Array:
    return estimator.base.values(estimator.model.nominal)


def normalised(estimator: Estimator) -> Array:
    return (estimator.estimate().pi - truth_of(estimator)) / standard_deviation(estimator)


@pytest.fixture(scope="module")
def first(simulation: Simulation) -> Estimator:
    return session(one_link("linear"), recorded(simulation, 0))


@pytest.mark.long
def test_errors_agree_with_error_bars_and_these_with_the_bound(simulation: Simulation, first: Estimator) -> None:
    assert first.sensing.missing == MISSING
    sessions = [first, *(session(one_link("linear"), recorded(simulation, seed)) for seed in range(1, SEEDS))]
    assert all(estimator.by_smoother for estimator in sessions)
    z = np.array([normalised(estimator) for estimator in sessions])
    # The root mean square of six normal deviates lies in these bounds in 99.8 %.
    rms = np.sqrt(np.mean(z**2, axis=0))
    assert np.all((rms > 0.25) & (rms < 1.95))
    plant, system = simulation.plant, simulation.plant.system
    exact = exact_states(simulation, np.linspace(0.0, simulation.duration, round(simulation.duration / STEP) + 1))
    chosen = Sensors(system, plant.channels, None, seed=0)
    sensors = sensor_set(plant.model, chosen.channels, chosen.noise, chosen.rate)
    bound = cramer_rao_bound(plant.dynamics, first.base, [Motion(exact.t, exact.x, exact.v)], sensors)
    for estimator in sessions:
        # The bound's step of 10 ms costs it some percent.
        np.testing.assert_allclose(standard_deviation(estimator), bound, rtol=0.06)
    assert np.all(bound < 2e-3 * truth_of(first))


def test_results_say_what_gave_the_numbers(first: Estimator) -> None:
    document = results_document(first, 1.0, [])
    assert document["method"] == "smoother"
    assert any(", ".join(MISSING) in warning for warning in document["warnings"])
    assert all(p["identifiable"] for p in document["parameters"])
    assert_array_equal(session_bound(first, MotionRecord(500.0)), first.estimate().std)
    # A view's process says the same.
    assert elsewhere(statistics_of(first))["parameters"] == document["parameters"]


def test_a_weighed_part_sharpens_what_hangs_on_it(simulation: Simulation, first: Estimator) -> None:
    # All parameters of a bolted-down arm share the scale of its torques: who knows one of them knows it.
    k = [p.name for p in first.base.parameters].index("link_1.mass_per_length")
    value, std = np.full((2, first.base.n), np.nan)
    value[k], std[k] = 3.0, 3e-4
    block = recorded(simulation, 0)
    sharpened = Estimator(one_link("linear"), block.channels, "simulation")
    sharpened.set_prior(Prior(value, std))
    sharpened.push(block)
    sharpened.finish()
    assert sharpened.by_smoother
    assert np.all(standard_deviation(sharpened)[1:] < 0.5 * standard_deviation(first)[1:])
    assert np.all(np.abs(normalised(sharpened)) < 4.0)
    assert session_bound(sharpened, MotionRecord(500.0)) is None


def test_nominal_values_play_no_part(simulation: Simulation, first: Estimator) -> None:
    description = json.dumps(describe(one_link("linear")))
    for true, other in (
        ('"stiffness": 400.0', '"stiffness": 9.0'),
        ('"mass_per_length": 3.0', '"mass_per_length": 8.0'),
    ):
        assert true in description
        description = description.replace(true, other)
    disguised = System.model_validate(json.loads(description))
    assert_array_equal(session(disguised, recorded(simulation, 0)).estimate().pi, first.estimate().pi)


def test_the_same_samples_give_the_same_bits_however_they_come(
    simulation: Simulation, first: Estimator, tmp_path: Path
) -> None:
    block = recorded(simulation, 0)
    cuts = [0, 1, 300, 301, 999, 1400, block.t.size]

    def pieces(cuts: list[int]) -> list[Block]:
        return [Block(block.t[a:b], block.channels, block.values[a:b]) for a, b in pairwise(cuts)]

    whole, stopped, resumed = (Estimator(one_link("linear"), block.channels, "simulation") for _ in range(3))
    for piece in pieces(cuts):
        whole.push(piece)
    whole.finish()
    for piece in pieces(cuts[:4]):
        stopped.push(piece)
    write_checkpoint(tmp_path / "half.msgpack", Checkpoint.of(stopped))
    read_checkpoint(tmp_path / "half.msgpack").put_into(resumed)
    for piece in pieces(cuts[3:]):
        resumed.push(piece)
    resumed.finish()
    for estimator in (whole, resumed):
        assert_array_equal(estimator.estimate().pi, first.estimate().pi)
        assert_array_equal(standard_deviation(estimator), standard_deviation(first))


def test_only_a_gap_of_the_torque_begins_a_new_span(simulation: Simulation) -> None:
    block = recorded(simulation, 1)
    kept = (block.t < 2.0) | (block.t > 2.3)
    parted = session(one_link("linear"), Block(block.t[kept], block.channels, block.values[kept]))
    values = block.values.copy()
    hole = (block.t > 1.0) & (block.t < 2.0)
    values[np.ix_(hole, [k for k, name in enumerate(block.channels) if "marker" in name or name == "q_1"])] = np.nan
    holed = session(one_link("linear"), Block(block.t, block.channels, values))
    for estimator, spans in ((parted, 2), (holed, 1)):
        assert estimator.smoother is not None
        assert estimator.smoother.known.spans == spans
        assert np.all(np.abs(normalised(estimator)) < 4.0)


@pytest.mark.long
def test_friction_that_the_model_lacks_widens_the_error_bars() -> None:
    friction = '\n[[effect]]\nname = "coulomb_friction"\nwhere = "joint_1"\ncoefficients = { torque = 0.5 }\n'
    block = recorded(simulate(one_link("linear", friction)), 2)
    lacking, holding = session(one_link("linear"), block), session(one_link("linear", friction), block)
    assert lacking.smoother is not None
    assert holding.smoother is not None
    assert lacking.by_smoother
    assert lacking.smoother.known.beyond > NOISE_WHITENED
    assert holding.smoother.known.beyond == 1.0
    assert JudgedEvaluation(statistics_of(lacking), lacking.estimate()).trust.grave
    assert any(
        "do not agree with the equations" in warning for warning in results_document(lacking, 1.0, [])["warnings"]
    )
    std, wider = standard_deviation(holding)[:-1], standard_deviation(lacking)
    assert np.all(wider > 1.5 * std)
    # Friction is no white force: damping, which is nearest to it, bends to replace it.
    assert np.all(np.abs(lacking.estimate().pi / truth_of(lacking) - 1.0) < 0.01)
    assert np.all(np.abs(normalised(holding)) < 4.0)


def test_inexplicable_samples_leave_the_first_fit_and_a_warning(simulation: Simulation) -> None:
    block = recorded(simulation, 3)
    values = block.values.copy()
    values[:, block.channels.index("tau_1")] *= -1.0
    estimator = session(one_link("linear"), Block(block.t, block.channels, values))
    assert not estimator.by_smoother
    document = results_document(estimator, 1.0, [])
    assert document["method"] == "energy"
    assert any("the smoother left out 0 … 3 s" in warning for warning in document["warnings"])
    assert any("bend quasi-statically" in warning for warning in document["warnings"])


@pytest.mark.long
@pytest.mark.parametrize("noise", [0.015, 0.05, 0.1])
def test_coloured_noise_of_a_torque_is_allowed_for(simulation: Simulation, noise: float) -> None:
    """Correlated over 50 samples, 2, 7 and 14 % of the torque: it does not show from sample to sample. Seed 0.

    In 3 s that leaves parameters to a tenth, and they are not trusted.
    """
    block, rng = recorded(simulation, 2), np.random.default_rng(0)
    coloured = lfilter([noise * np.sqrt(1.0 - 0.98**2)], [1.0, -0.98], rng.standard_normal(block.t.size))
    values = block.values.copy()
    values[:, block.channels.index("tau_1")] += coloured
    estimator = session(one_link("linear"), Block(block.t, block.channels, values))
    assert estimator.smoother is not None
    known = estimator.smoother.known
    assert not known.failures
    assert known.level == 0.0
    assert known.torque_noise > LARGEST_TORQUE_NOISE
    assert np.all(np.abs(estimator.estimate().pi / truth_of(estimator) - 1.0) < 0.1)
    assert JudgedEvaluation(statistics_of(estimator), estimator.estimate()).trust.grave


@pytest.mark.long
def test_exact_links_and_one_marker_alone_are_enough() -> None:
    block = recorded(simulate(one_link("exact")), 4)
    alone = [k for k, name in enumerate(block.channels) if "marker_1" not in name]
    tip = Block(block.t, tuple(block.channels[k] for k in alone), block.values[:, alone])
    estimator = session(one_link("exact"), tip)
    assert estimator.by_smoother
    assert np.all(np.abs(normalised(estimator)) < 4.0)


@pytest.mark.slow
def test_full_measurements_are_smoothed_only_on_request(simulation: Simulation) -> None:
    sensors = (*simulation.plant.system.sensors, Sensor(channels=("link_1.marker_*.theta_z",), noise=1e-4))
    system = simulation.plant.system.model_copy(update={"sensors": sensors})
    block = recorded(Simulation(Plant(system), simulation.solution), 5)
    assert session(system, block).smoother is None
    assert session(system.model_copy(update={"balance": "energy"}), block).smoother is None
    smoothed = session(system.model_copy(update={"balance": "smoother"}), block)
    assert smoothed.by_smoother
    assert not smoothed.sensing.missing
    assert np.all(np.abs(normalised(smoothed)) < 4.0)


def test_declared_effects_on_channels_exclude_the_smoother() -> None:
    """It reads channels as they come: the momentum balance estimates then, and without all coordinates nothing does."""
    offset = Effect(name="encoder_offset", where="theta_m_1", coefficients={"offset": 0.01})
    system = load_system("paper-planar").model_copy(update={"balance": "smoother", "effects": (offset,)})
    names = tuple(channels(system))
    estimator = Estimator(system, names, "test")
    assert estimator.smoother is None
    assert any("effects on channels" in warning for warning in results_document(estimator, 0.0, [])["warnings"])
    fewer = tuple(name for name in names if name != "link_1.marker_1.theta_z")
    with pytest.raises(InputError, match=r"encoder_offset@theta_m_1, and no link_1\.marker_1\.theta_z"):
        Estimator(system, fewer, "test")


@pytest.mark.slow
def test_replay_of_a_capture_without_slopes(
    simulation: Simulation, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("bench.toml").write_text(TEXT.replace("KINEMATICS", "linear"), encoding="utf-8")
    block = recorded(simulation, 0)
    with CaptureWriter(Path("run.csv"), block.channels) as writer:
        writer.write(block)
    assert main(["replay", "run.csv", "--system", "bench.toml", "--out", "done", "--bound"]) == 0
    found = json.loads(Path("done/results.json").read_text(encoding="utf-8"))
    assert found["method"] == "smoother"
    for p in found["parameters"]:
        assert math.isclose(p["bound"], p["std"])
    assert "method: smoother" in capsys.readouterr().out
