"""Mistakes of units, signs and wiring: named in words, undone, and never seen where there is none.

A session of the planar example of 6 s, noise of grade B (seed 4), nominal values up to 20 % off (seed 1).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import numpy as np
import pytest

from sms_adapters.system_file import load_system
from sms_online.description.parse import parse_system
from sms_online.description.schema import Effect, System
from sms_online.description.sources import LogSignal, TableSource
from sms_online.diagnosis.diagnose import diagnose
from sms_online.diagnosis.document import diagnosis_document
from sms_online.diagnosis.mistakes import Corrected, find_mistakes, wrong_clock
from sms_online.diagnosis.record import SampleRecord, Segment
from sms_online.diagnosis.sample_mistakes import mistake_hypotheses, shown, without_gaps
from sms_online.pipeline.estimator import Estimator
from sms_online.stream import Array, Block
from sms_sim.simulate import Simulation, sampled_blocks, simulate
from sms_tools.adopted_system import adopted_text
from tests import simulations
from tests.campaigns.mistakes import described
from tests.campaigns.sessions import disguised

DURATION = 6.0
Change = Callable[[dict[str, Array]], None]


@cache
def stated() -> System:
    return described(load_system("paper-planar"), np.random.default_rng(1))


@cache
def session(seed: int) -> Block:
    return noisy(simulations.planar(DURATION), seed)


def noisy(exact: Simulation, seed: int) -> Block:
    blocks = list(sampled_blocks(exact, "B", seed=seed))
    t, values = (np.concatenate([getattr(block, part) for block in blocks]) for part in ("t", "values"))
    return Block(t, blocks[0].channels, values)


def wrong(change: Change, seed: int = 4) -> Block:
    return changed(session(seed), change)


def changed(block: Block, change: Change) -> Block:
    values = {c: column.copy() for c, column in zip(block.channels, block.values.T, strict=True)}
    change(values)
    return Block(block.t, block.channels, np.stack(list(values.values()), axis=1))


def found(change: Change, system: System | None = None) -> Corrected:
    return found_in(wrong(change), system or stated())


def found_in(block: Block, system: System) -> Corrected:
    estimator, record = Estimator(system, block.channels, "test"), SampleRecord(system.sample_rate)
    estimator.observers.append(record)
    estimator.push(block)
    estimator.finish()
    return find_mistakes(estimator, record.segments())


def times(factor: float, *names: str) -> Change:
    def change(values: dict[str, Array]) -> None:
        for name in names:
            values[name] *= factor

    return change


def swap(one: str, other: str) -> Change:
    def change(values: dict[str, Array]) -> None:
        values[one], values[other] = values[other], values[one]

    return change


def swap_joints(*kinds: str) -> Change:
    def change(values: dict[str, Array]) -> None:
        for kind in kinds:
            swap(f"{kind}_1", f"{kind}_2")(values)

    return change


def test_a_session_without_a_mistake_has_none() -> None:
    assert found(lambda values: None).mistakes == ()


@pytest.mark.parametrize(
    ("change", "key", "words"),
    [
        pytest.param(times(-1.0, "tau_2"), "torque_sign@tau_2", "is inverted", marks=pytest.mark.slow),
        pytest.param(
            times(50.0, "tau_1", "tau_2"),
            "joint_torque@tau_1, tau_2",
            "everything is 50 × its description",
            marks=pytest.mark.slow,
        ),
        pytest.param(times(180.0 / np.pi, "q_2"), "degrees@q_2", "q_2 is in degrees", marks=pytest.mark.long),
        pytest.param(times(1e3, "r_S_x", "r_S_y"), "millimetres@r_S_*", "in mm in place of m", marks=pytest.mark.long),
        pytest.param(times(2.0, "q_2"), "counts@q_2", "reads twice the angle", marks=pytest.mark.long),
        pytest.param(times(50.0, "theta_m_1"), "motor_angle@theta_m_1", "before the gear", marks=pytest.mark.long),
        pytest.param(swap("tau_1", "tau_2"), "swapped@tau_1, tau_2", "are swapped", marks=pytest.mark.long),
        pytest.param(
            swap_joints("q", "theta_m"),
            "swapped@q_1, theta_m_1, q_2, theta_m_2",
            "the encoders of",
            marks=pytest.mark.long,
        ),
        pytest.param(
            swap_joints("tau", "q", "theta_m"), "swapped@joint_1, joint_2", "all channels of", marks=pytest.mark.slow
        ),
    ],
)
def test_a_mistake_is_named_and_nothing_else(change: Change, key: str, words: str) -> None:
    corrected = found(change)
    assert [mistake.key for mistake in corrected.mistakes] == [key]
    assert words in corrected.mistakes[0].sentence
    assert corrected.mistakes[0].step
    block = wrong(change)
    np.testing.assert_allclose(corrected.samples(block.channels, block.values), session(4).values, rtol=1e-9)


def test_an_encoder_before_the_gear_may_be_a_joints_only_one() -> None:
    """Or one that its source has taken through the gear though it is behind it."""
    text = """
    name = "axis"
    [joint_1]
    axis = [0.0, 0.0, 1.0]
    gear_ratio = 80.0
    transmission = "rigid"
    [motor_1]
    rotor_inertia = 3e-5
    [link_1]
    kind = "rigid"
    inertia = { xx = 0.5, yy = 0.5, zz = 0.5 }
    [[source]]
    kind = "table"
    name = "log"
    stamp = "t"
    [source.signals]
    "angle" = { channel = "q_1", unit = "deg" GEAR }
    "torque" = { channel = "tau_1" }
    """
    for stated, factor, words in (("", 1.0 / 80.0, "before the gear"), (", gear = 80", 80.0, "gear ratio 80 twice")):
        system = parse_system(text.replace(" GEAR", stated), "axis")
        (gear,) = (each for each in mistake_hypotheses(system, ("q_1", "tau_1")) if each.name == "motor_angle")
        assert words in gear.sentence
        np.testing.assert_allclose(gear.apply(("q_1", "tau_1"), np.ones((1, 2))), [[factor, 1.0]])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("factor", "keys"), [pytest.param(1e3, ["torque_unit@tau_1, tau_2"], marks=pytest.mark.long), (1.0, [])]
)
def test_the_unit_of_torques_shows_beside_friction(factor: float, keys: list[str]) -> None:
    """Undescribed friction of five times the torques: it explains most of them in any unit."""

    def change(values: dict[str, Array]) -> None:
        for i in (1, 2):
            torque, angle = values[f"tau_{i}"], values[f"theta_m_{i}"]
            friction = 5.0 * np.sqrt(np.mean(torque**2)) * np.sign(np.gradient(angle))
            values[f"tau_{i}"] = factor * (torque + friction)

    assert [mistake.key for mistake in found(change).mistakes] == keys


@pytest.mark.slow
def test_a_wrong_gear_is_corrected_in_the_system() -> None:
    """The rotor's inertia acts with the square of the ratio and with the ratio itself: no factor of the torque does."""
    joints = list(stated().joints)
    joints[1] = joints[1].model_copy(update={"gear_ratio": 100.0})
    corrected = found(lambda values: None, stated().model_copy(update={"joints": tuple(joints)}))
    assert [mistake.key for mistake in corrected.mistakes] == ["gear_ratio@joint_2"]
    ratio = corrected.system.joints[1].gear_ratio
    assert ratio == pytest.approx(50.0, rel=0.01)
    text = adopted_text("paper-planar", stated(), corrected.system, {})
    assert f"gear_ratio = {ratio:.4g} # found; the file said 50" in text


@pytest.mark.long
@pytest.mark.parametrize(
    ("true", "said"),
    [
        ((0.0, 0.0, 0.0), (0.0, -9.81, 0.0)),
        ((0.0, -9.81, 0.0), (0.0, 0.0, 0.0)),
        ((0.0, -9.81, 0.0), (0.0, 9.81, 0.0)),
    ],
)
def test_gravity_along_another_axis_is_named(true: tuple[float, ...], said: tuple[float, ...]) -> None:
    """None where the description has some, the reverse, and the planar example upside down."""
    system = load_system("paper-planar").model_copy(update={"gravity": true, "spacecraft": None})
    block = noisy(simulate(system, DURATION, position_tolerance=1e-8), 4)
    wrongly = described(system, np.random.default_rng(1)).model_copy(update={"gravity": said})
    corrected = found_in(block, wrongly)
    assert [mistake.key for mistake in corrected.mistakes] == ["gravity@base"]
    assert corrected.system.gravity == true
    text = adopted_text("paper-planar", wrongly, corrected.system, {})
    assert f"gravity = [{', '.join(f'{g:g}' for g in true)}] # m/s², found; the file said [" in text


@pytest.mark.slow
def test_a_wrong_torque_constant_is_no_wrong_gear() -> None:
    corrected = found(times(1.6, "tau_2"))
    assert [mistake.key for mistake in corrected.mistakes] == ["gear_ratio@joint_2"]
    assert corrected.mistakes[0].sentence.startswith("tau_2 is 1.6 × what the other rows give")
    assert corrected.system == stated()
    block = wrong(times(1.6, "tau_2"))
    undone = corrected.samples(block.channels, block.values)
    np.testing.assert_allclose(undone, session(4).values, rtol=0.01)


@pytest.mark.long
def test_a_passive_joint_has_no_torque_to_mistake() -> None:
    """6 s of the planar example with a second joint that nothing drives, grade B (seed 4)."""
    system = load_system("paper-planar")
    joints = list(system.joints)
    joints[1] = joints[1].model_copy(update={"passive": True, "gear_ratio": 1.0})
    system = system.model_copy(update={"joints": tuple(joints)})
    block = noisy(simulate(system, DURATION, position_tolerance=1e-8), 4)
    (mistake,) = found_in(changed(block, times(-1.0, "tau_1")), system).mistakes
    assert mistake.key == "torque_sign@tau_1"
    assert not mistake.or_else


def test_a_sliding_axis_is_a_length_and_a_wrench_is_neither_length_nor_angle() -> None:
    joints = list(stated().joints)
    joints[1] = joints[1].model_copy(update={"kind": "prismatic"})
    system = stated().model_copy(update={"joints": tuple(joints)})
    channels = ("force_2", "q_1", "q_2", "theta_m_1", "theta_m_2", "wrench_1.f_x", "wrench_1.m_z")
    keys = {(each.name, each.where) for each in mistake_hypotheses(system, channels)}
    assert {where for name, where in keys if name == "millimetres"} == {"q_2", "theta_m_2", "all lengths"}
    assert {where for name, where in keys if name == "degrees"} == {"q_1", "theta_m_1", "all angles"}
    assert not any("wrench" in where for name, where in keys if name != "swapped")
    resting = np.ones((5000, len(channels)))
    resting[:, 1] = np.linspace(0.0, 1.0, 5000)
    resting[:2500, 5] = np.random.default_rng(6).standard_normal(2500)
    assert list(shown(channels, [Segment(np.arange(5000), resting)])) == []


def test_a_log_may_hold_radians_where_degrees_are_stated() -> None:
    signals = {"Q1": LogSignal(channel="q_1", unit="deg"), "Q2": LogSignal(channel="q_2", unit="mrad")}
    log = TableSource(kind="table", name="drives", signals=signals)
    system = stated().model_copy(update={"sources": (log,)})
    (found,) = (each for each in mistake_hypotheses(system, ("q_1", "q_2")) if each.name == "converted")
    assert found.where == "q_1"
    assert found.sentence == "q_1 is in rad, where the system file states deg"
    np.testing.assert_allclose(found.apply(("q_1", "q_2"), np.deg2rad(np.eye(2)))[:, 0], [1.0, 0.0])


@pytest.mark.long
def test_a_diagnosis_goes_on_with_the_mistake_undone() -> None:
    diagnosis = diagnose(stated(), [wrong(times(-1.0, "tau_2"))], "test", lambda estimator: None)
    document = diagnosis_document(diagnosis)
    assert document["verdict"] == "named"
    assert document["summary"].startswith("The sign of tau_2 is inverted.")
    assert document["effects"] == []
    assert document["judgement"]["grave"]
    assert document["judgement"]["next_step"] == "invert the sign of tau_2"
    assert max(rows["whitened"] for rows in document["after"]["fit"].values()) < 1.4


@pytest.mark.long
def test_a_link_that_stiffens_has_no_wrong_gear() -> None:
    """Described as straight, it leaves something of every torque; another gear would leave it to one of them."""
    system = load_system("paper-planar")
    stiff = Effect(name="geometric_stiffening", where="link_2")
    exact = simulate(system.model_copy(update={"effects": (stiff,)}), 12.0, position_tolerance=1e-8)
    blocks = list(sampled_blocks(exact, "B", seed=3))
    estimator, record = Estimator(disguised(system), blocks[0].channels, "test"), SampleRecord(system.sample_rate)
    estimator.observers.append(record)
    for block in blocks:
        estimator.push(block)
    estimator.finish()
    assert find_mistakes(estimator, record.segments()).mistakes == ()


def one(column: Array) -> list[Segment]:
    return [Segment(np.arange(column.size), column[:, None])]


def test_stamps_in_milliseconds_are_seen() -> None:
    t = np.arange(1000) / 1000.0
    assert wrong_clock(stated(), t) is None
    mistake = wrong_clock(stated(), 1e3 * t)
    assert mistake is not None
    assert mistake.sentence == "t is in ms in place of s"


def test_a_wrapped_encoder_is_unwrapped() -> None:
    angle = 4.0 * np.sin(np.linspace(0.0, 20.0, 5000))
    (found,) = shown(["q_1"], one(np.mod(angle, 2.0 * np.pi)))
    assert found.name == "wrapped"
    values = found.apply(("q_1",), np.mod(angle, 2.0 * np.pi)[:, None])[:, 0]
    np.testing.assert_allclose(values - values[0], angle - angle[0], atol=1e-9)


def test_whole_turns_are_those_of_the_other_encoder() -> None:
    """A reading that wraps at other than a whole turn would else be off by some of its turns."""
    rng = np.random.default_rng(5)
    motor = 1.5 + np.sin(np.linspace(0.0, 20.0, 5000))
    link, names = motor + 1e-4 * rng.standard_normal(motor.size), ("q_1", "theta_m_1")
    wrapped = np.stack((np.mod(link, 1.2), motor), axis=1)
    (found,) = shown(names, [Segment(np.arange(motor.size), wrapped)])
    assert (found.name, found.where) == ("wrapped", "q_1")
    assert np.abs(found.apply(names, wrapped)[:, 0] - link).max() < 3e-4


@pytest.mark.long
@pytest.mark.parametrize("channel", ["q_2", "theta_m_2"])
@pytest.mark.parametrize("seed", [0, 4])
def test_the_zero_of_one_encoder_is_not_the_others(channel: str, seed: int) -> None:
    """To first order they differ by their signs alone, and the wrong one by calibration that turns the axis."""

    def turned(values: dict[str, Array]) -> None:
        values[channel] += 0.02

    system = load_system("paper-planar")
    search = diagnose(system, [wrong(turned, seed)], "test", lambda estimator: None)
    (finding,) = search.findings
    assert finding.candidate.key == f"encoder_offset@{channel}"
    assert not finding.ambiguous
    assert not search.calibration


def test_a_stuck_encoder_is_left_out_and_one_at_rest_is_not() -> None:
    rng = np.random.default_rng(3)
    t = np.linspace(0.0, 20.0, 5000)
    stuck = np.sin(t) + 1e-5 * rng.standard_normal(t.size)
    stuck[2500:3500] = stuck[2500]
    (found,) = shown(["q_1"], one(stuck))
    assert found.name == "stuck"
    assert not found.certain  # no other encoder says that the joint moves
    (segment,) = one(found.apply(("q_1",), stuck[:, None])[:, 0])
    assert [part.index.size for part in without_gaps(segment)] == [2501, 1500]
    # Slows down, is at rest, to the last bit of its encoder, and starts again.
    resting = np.round(np.where(t < 5.0 * np.pi / 2.0, np.sin(t), 1.0) / 1e-4) * 1e-4
    assert list(shown(["q_1"], one(resting))) == []


def test_an_arm_that_stops_is_not_stuck() -> None:
    """Brakes hold both encoders of the joint to the last digit."""
    rng = np.random.default_rng(3)
    t, names = np.linspace(0.0, 20.0, 5000), ("q_1", "theta_m_1")
    moving = np.sin(t)[:, None] + 1e-5 * rng.standard_normal((t.size, 2))
    for held, found in (([0], ["q_1"]), ([0, 1], [])):
        values = moving.copy()
        values[4000:, held] = values[4000, held]
        stuck = list(shown(names, [Segment(np.arange(t.size), values)]))
        assert [each.where for each in stuck] == found
        assert all(each.certain for each in stuck)


def test_a_held_command_is_joined_where_it_changes() -> None:
    t = np.arange(4000) / 1000.0
    held = np.repeat(np.sin(3.0 * t)[::20], 20)
    (found,) = shown(["tau_1"], one(held))
    assert found.name == "held_command"
    joined = found.apply(("tau_1",), held[:, None])[:, 0]
    assert np.abs(joined - np.sin(3.0 * t))[:-20].max() < 1e-3
    # A capture that was held out may have other channels.
    np.testing.assert_array_equal(found.apply(("q_1",), held[:, None])[:, 0], held)
