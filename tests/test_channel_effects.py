"""Effects on channels: what they do to samples, and corrections that give the samples back."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.integrate import solve_ivp

from sms_online.description.parse import parse_system, shipped_text
from sms_online.description.schema import System
from sms_online.diagnosis.constants import corrected
from sms_online.diagnosis.record import Segment
from sms_online.effects.catalogue import channel_effects
from sms_online.effects.channel import EncoderEccentricity
from sms_online.effects.delay import ActuatorDelay, SensorLag, TorqueDelay
from sms_online.errors import InputError
from sms_online.pipeline.conditioning import Conditioning
from sms_online.pipeline.estimator import Estimator
from sms_online.pipeline.synchronise import GridSamples
from sms_online.stream import Array
from sms_sim.plant import Plant
from sms_sim.simulate import Simulation, sampled_blocks
from tests.declared import declaring, sampled
from tests.saved import resumed
from tests.sessions_of import session_of
from tests.simulations import planar


@pytest.fixture(scope="module")
def clean_motion() -> Simulation:
    """Two and a half seconds without effects."""
    return planar(2.5)


def distorted(clean: Simulation, *texts: str) -> Simulation:
    """The same motion, seen by sensors with effects on channels."""
    return replace(clean, plant=Plant(declaring(*texts)))


def test_channel_effects_distort_their_own_channels_alone(clean_motion: Simulation) -> None:
    clean = sampled(clean_motion)[1]
    texts = ("encoder_offset@q_*:offset=0.01", "encoder_eccentricity@theta_m_2:amplitude=0.02,phase=0.5",
             "sensor_lag@link_1.marker_*:corner=30", "torque_delay@joint_1:time=0.004")  # fmt: skip
    read = sampled(distorted(clean_motion, *texts))[1]
    assert_allclose(read["q_1"], clean["q_1"] + 0.01, atol=1e-15)
    assert_allclose(read["theta_m_2"], clean["theta_m_2"] + 0.02 * np.sin(clean["theta_m_2"] + 0.5), atol=1e-15)
    assert_allclose(read["tau_1"][4:], clean["tau_1"][:-4], atol=1e-12)
    touched = {"q_1", "q_2", "theta_m_2", "tau_1"} | {c for c in clean if c.startswith("link_1")}
    for channel in clean:
        assert np.allclose(read[channel], clean[channel], rtol=0, atol=1e-9) == (channel not in touched), channel


def test_a_lag_is_the_low_pass_of_its_differential_equation(clean_motion: Simulation) -> None:
    """Against SciPy's integrator on the simulation's own exact motion."""
    simulation = distorted(clean_motion, "sensor_lag@theta_m_1:corner=20")
    plant = simulation.plant
    t, read = sampled(simulation)
    omega, column = 2 * np.pi * 20, plant.channels.index("theta_m_1")

    def rate(time: float, y: Array) -> list[float]:
        state = simulation.solution(np.array([time]))
        x = plant.channel_values(np.zeros((1, 2)), plant.split(state)[0])[0, column]
        return [y[1], omega**2 * (x - y[0]) - np.sqrt(2.0) * omega * y[1]]

    solution = solve_ivp(rate, (0.0, 0.3), [0.0, 0.0], t_eval=t[:301], rtol=1e-9, atol=1e-12, max_step=1e-3)
    assert_allclose(read["theta_m_1"][:301], solution.y[0], rtol=0, atol=1e-7)
    assert np.abs(solution.y[0]).max() > 0.01


def test_a_correction_gives_back_what_was_distorted() -> None:
    t = np.arange(4000) / 1000.0
    angle = 1.3 * np.sin(2 * np.pi * 0.5 * t)
    eccentric = EncoderEccentricity("q_1", {"amplitude": 0.05, "phase": 0.4})
    assert_allclose(eccentric.correct(eccentric.distort(angle, 1000.0), 1000.0), angle, rtol=0, atol=1e-14)
    lag = SensorLag("q_1", {"corner": 30.0})
    late = lag.distort(angle, 1000.0)
    assert np.abs(late - angle).max() > 0.02
    # Straight lines between samples of a millisecond are off by ω² h² / 12, 8e-7 of the amplitude.
    M = lag.kernel(1000.0).size // 2
    assert_allclose(lag.correct(late, 1000.0)[300:-M], angle[300:-M], rtol=0, atol=2e-6)


def test_a_late_torque_is_given_back() -> None:
    """A cubic through samples of a millisecond is off by 3/128 (ω h)⁴ of 3 Hz, straight lines by (ω h)² / 8."""
    t, delay = np.arange(4000) / 1000.0, TorqueDelay("joint_1", {"time": 0.0123})
    assert delay.acts_on("tau_1")
    assert not delay.acts_on("tau_2")
    assert not delay.acts_on("theta_m_1")
    omega = 2 * np.pi * 3.0
    late = np.sin(omega * (t - 0.0123))
    M = delay.kernel(1000.0).size // 2
    assert_allclose(delay.correct(late, 1000.0)[M:-M], np.sin(omega * t)[M:-M], rtol=0, atol=3 / 128 * 0.0189**4)
    assert_allclose(delay.distort(np.sin(omega * t), 1000.0)[20:], late[20:], rtol=0, atol=5e-5)


def test_a_torque_that_acts_late_is_moved_to_when_it_acts() -> None:
    t, dead = np.arange(4000) / 1000.0, ActuatorDelay("joint_*", {"time": 0.0123})
    assert dead.acts_on("tau_2")
    assert dead.latency == -0.0123
    omega = 2 * np.pi * 3.0
    read = np.sin(omega * (t + 0.0123))
    M = dead.kernel(1000.0).size // 2
    assert_allclose(dead.correct(read, 1000.0)[M:-M], np.sin(omega * t)[M:-M], rtol=0, atol=3 / 128 * 0.0189**4)
    assert_allclose(dead.distort(np.sin(omega * t), 1000.0)[:-20], read[:-20], rtol=0, atol=5e-5)


def test_conditioning_is_independent_of_blocks_and_restarts() -> None:
    effects = "sensor_lag@q_1:corner=40", "encoder_offset@q_1:offset=0.1", "encoder_offset@q_2:offset=0.2"
    system = declaring(*effects, "torque_delay@joint_1:time=0.003")
    values = np.random.default_rng(8).normal(size=(400, 3))
    index = np.arange(400, dtype=np.int64) + 7
    channels = ("q_1", "q_2", "tau_1")
    (whole,) = Conditioning(system, channels).push(GridSamples(index, values, 0))
    stage = Conditioning(system, channels)
    pieces = []
    for part in np.split(np.arange(400), [3, 50, 51, 130]):
        pieces += stage.push(GridSamples(index[part], values[part], 0))
        stage = resumed(Conditioning(system, channels), stage)
    assert np.array_equal(np.concatenate([piece.values for piece in pieces]), whole.values)
    assert np.array_equal(np.concatenate([piece.index for piece in pieces]), whole.index)
    # All channels are passed on for the same instants, and a gap begins anew.
    assert_allclose(whole.values[:, 1], values[stage.margin : -stage.margin, 1] - 0.2)
    assert_allclose(whole.values[:, 2], values[stage.margin + 3 : 3 - stage.margin, 2], atol=1e-12)
    assert stage.push(GridSamples(index[: stage.margin] + 500, values[: stage.margin], 1)) == []


@pytest.mark.slow
def test_corrections_give_the_estimate_of_a_clean_session(clean_motion: Simulation) -> None:
    """An offset and a lag of encoder 1: declared, the stiffness of joint 1 comes out within 0.1 %.

    Undeclared, tolerances of zero and clock take a part of them, and the lag leaves more than 0.5 %.
    """
    texts = ("encoder_offset@q_1:offset=0.002", "sensor_lag@q_1:corner=60")
    blocks = list(sampled_blocks(distorted(clean_motion, *texts), "0"))

    def stiffness(system: System) -> float:
        estimator = session_of(system, blocks)
        names = [p.name for p in estimator.base.parameters]
        return float(estimator.estimate().pi[names.index("joint_1.stiffness")])

    assert stiffness(declaring(*texts)) == pytest.approx(1000.0, rel=1e-3)
    assert abs(stiffness(declaring()) / 1000.0 - 1.0) > 0.005


def test_a_stated_delay_of_a_torque_is_taken_off(clean_motion: Simulation) -> None:
    """15 ms of joint 2 at grade A: declared, its rows leave no more than noise, undeclared ten times as much."""
    text = "torque_delay@joint_2:time=0.015"
    blocks = list(sampled_blocks(distorted(clean_motion, text), "A", seed=2))

    def left(system: System) -> float:
        estimator = session_of(system, blocks)
        assert estimator.momentum is not None
        whitened = estimator.momentum.fit.plain.whitened(
            [estimator.model.layout.theta_m[1]], estimator.estimate().joint
        )
        assert whitened is not None
        return whitened

    assert left(declaring(text)) < 1.2
    assert left(declaring()) > 10.0


def test_effects_on_one_channel_come_off_one_after_the_other() -> None:
    system = declaring("torque_delay@joint_*:time=0.01", "torque_delay@joint_1:time=0.005")
    values = np.random.default_rng(8).normal(size=(400, 1))
    stage = Conditioning(system, ("tau_1",))
    (out,) = stage.push(GridSamples(np.arange(400), values, 0))
    assert_allclose(out.values, values[15 + out.index], atol=1e-12)
    segment = Segment(np.arange(400), values)
    assert_allclose(corrected(system, ("tau_1",), segment).values[out.index], out.values, atol=1e-12)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("torque_delay@joint_1:time=-0.001", "0 to 1 s"),
        ("torque_delay@joint_1:time=20", "0 to 1 s"),
        # Nothing would come off, and nobody would look for it.
        ("torque_delay@joint_1", "without coefficients; expected time"),
        ("encoder_offset@q_1", "without coefficients; expected offset"),
    ],
)
def test_constants_of_a_channel_have_to_be_stated(text: str, words: str) -> None:
    with pytest.raises(InputError, match=words):
        channel_effects(declaring(text))


def planar_with(name: str, where: str, coefficients: str) -> str:
    """The file of the planar example, with an effect declared."""
    effect = f"name = '{name}'\nwhere = '{where}'\ncoefficients = {{ {coefficients} }}\n"
    return f"{shipped_text('paper-planar')}\n[[effect]]\n{effect}"


def test_a_file_declares_an_effect_on_a_group_of_channels() -> None:
    text = planar_with("sensor_lag", "link_1.marker_*", "corner = 25.0")
    (lag,) = channel_effects(parse_system(text, "file"))
    assert lag.coefficients == {"corner": 25.0}
    assert lag.acts_on("link_1.marker_2.u_y")
    assert not lag.acts_on("link_2.marker_2.u_y")
    with pytest.raises(InputError, match="a channel or a pattern of channels"):
        parse_system(text.replace("link_1.marker_*", "link_3.*"), "file")


def test_a_file_declares_one_delay_of_all_drives() -> None:
    """What a diagnosis that finds it writes."""
    text = planar_with("torque_delay", "joint_*", "time = 0.01")
    assert [effect.where for effect in parse_system(text, "file").effects] == ["joint_*"]
    assert channel_effects(parse_system(text, "file"))
    with pytest.raises(InputError, match="expected one of joint_1, joint_2"):
        Estimator(parse_system(text.replace("torque_delay", "coulomb_friction"), "file"), ("tau_1",), "test")


def test_undeclared_effects_leave_no_stage_in_the_way() -> None:
    stage = Conditioning(declaring(), ("q_1",))
    values = np.arange(5.0)[:, None]
    (out,) = stage.push(GridSamples(np.arange(5), values, 0))
    assert stage.margin == 0
    assert np.array_equal(out.values, values)
    assert channel_effects(declaring()) == ()
