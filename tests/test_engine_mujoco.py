"""A second engine: its links, its conservation laws, its effects; the model's motion and fit against its data."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest
import scipy.linalg
from numpy.testing import assert_allclose

from sms_adapters.system_file import load_system
from sms_online.description.bodies import FlexibleLink
from sms_online.description.schema import System
from sms_online.stream import Block
from sms_sim.sensors import GRADES
from sms_sim.simulate import sampled_blocks, simulate
from tests.engine_mujoco import (
    CELLS,
    IMPLICIT_STEP,
    STEP,
    EngineArm,
    EngineEffects,
    Motion,
    cantilever,
    mujoco_capture,
    with_noise,
)
from tests.exactly_known import exactly_known
from tests.sessions_of import session_of

SYSTEM = load_system("paper-planar-exact")
# Roots of the cantilever, Blevins, Formulas for Natural Frequency and Mode Shape (1979), table 8-1.
BETA_L = np.array([1.875104068711961, 4.694091132974175])
SEED = 13
LAST = slice(-1, None)


@pytest.fixture(scope="session")
def engine_capture() -> Block:
    """The paper's trajectory at full amplitude for 20 s, without noise or undeclared effects."""
    return mujoco_capture(SYSTEM, 20.0)


def link() -> FlexibleLink:
    """The first link, alone."""
    described = SYSTEM.links[0]
    assert isinstance(described, FlexibleLink)
    return described


def at_smaller_amplitude(factor: float) -> System:
    """The same arm along its trajectory times `factor`."""
    assert SYSTEM.trajectory is not None
    joints = tuple(
        tuple(harmonic.model_copy(update={"sine": factor * harmonic.sine}) for harmonic in series)
        for series in SYSTEM.trajectory.joints
    )
    return SYSTEM.model_copy(update={"trajectory": SYSTEM.trajectory.model_copy(update={"joints": joints})})


# A link


def test_a_clamped_loaded_link_bends_as_an_euler_bernoulli_beam() -> None:
    """Where the markers are, F s² (3 L - s)/6 EI, to rounding: Gauss sums are exact for polynomials of degree 3."""
    model = cantilever(link(), CELLS)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    L, EI, F = link().length, link().flexural_rigidity_z, 0.1
    jacobians = np.zeros((2, 3, model.nv))
    for k, J in enumerate(jacobians, start=1):
        marker = data.site(f"link.marker_{k}")
        mujoco.mj_jac(model, data, J, None, marker.xpos, int(model.site(f"link.marker_{k}").bodyid[0]))
    angles = jacobians[1, 1] * F / model.jnt_stiffness
    s = np.array([L / 2, L])
    assert_allclose(jacobians[:, 1] @ angles, F * s**2 * (3 * L - s) / (6 * EI), rtol=1e-12)


def test_a_moment_at_the_end_bends_a_link_to_a_circle() -> None:
    """Through one radian: the engine's rotations are finite, and their error falls fourfold or more."""
    errors = []
    for cells in (CELLS, 2 * CELLS):
        model = cantilever(link(), cells)
        data = mujoco.MjData(model)
        radius = link().length  # one radian
        data.qpos[:] = link().flexural_rigidity_z / radius / model.jnt_stiffness
        mujoco.mj_kinematics(model, data)
        circle = radius * np.array([np.sin(1.0), 1.0 - np.cos(1.0), 0.0])
        errors.append(float(np.linalg.norm(data.site("link.marker_2").xpos - circle)))
    assert errors[0] < 3e-4  # m
    assert errors[0] > 4.0 * errors[1]


def test_a_clamped_link_vibrates_as_euler_and_bernoulli_say() -> None:
    exact = (BETA_L / link().length) ** 2 * np.sqrt(link().flexural_rigidity_z / link().mass_per_length)
    errors = []
    for cells in (CELLS // 2, CELLS, 2 * CELLS):
        model = cantilever(link(), cells)
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        H = np.zeros((model.nv, model.nv))
        mujoco.mj_fullM(model, data, H)
        frequencies = np.sqrt(scipy.linalg.eigh(np.diag(model.jnt_stiffness), H, eigvals_only=True)[:2])
        errors.append(np.abs(frequencies / exact - 1.0))
    assert (errors[0] > 16.0 * errors[1]).all()
    assert (errors[1] > 16.0 * errors[2]).all()
    assert (errors[1] < [1e-5, 1e-3]).all()


# What the engine conserves


def lost_energy(arm: EngineArm, motion: Motion) -> tuple[float, float]:
    """Motor work less what the joints' dampers took and what is stored at the end, and the latter, J."""
    shafts, links = arm.joint_dofs("rotor"), arm.joint_dofs("joint")
    gears = np.array([joint.gear_ratio for joint in SYSTEM.joints])
    b = np.array([joint.damping for joint in SYSTEM.joints])
    work = np.sum(0.5 * (motion.torque[1:] + motion.torque[:-1]) * np.diff(motion.qpos[:, shafts], axis=0))
    power = (motion.qvel[:, shafts] / gears - motion.qvel[:, links]) ** 2 @ b
    stored = arm.energy(motion.rows(LAST))[0]
    return float(work - np.trapezoid(power, motion.t) - stored), float(stored)


def test_energy_and_momentum_are_conserved_to_the_steps_order() -> None:
    energy, momentum = [], []
    for step in (STEP, 0.5 * STEP):
        arm = EngineArm(SYSTEM, CELLS, EngineEffects(), step)
        motion = arm.run(0.5, every=1)
        lost, stored = lost_energy(arm, motion)
        assert stored > 100.0  # J: the arm does move
        energy.append(abs(lost) / stored)
        exchanged = arm.model.body("base").mass[0] * np.abs(motion.qvel[:, :2]).max()
        momentum.append(np.abs(arm.momentum(motion.rows(slice(None, None, 50)))).max() / exchanged)
    assert energy[0] < 1e-6
    assert momentum[0] < 1e-9
    # Work and dissipation are sums by the trapezoidal rule; the motion itself is of order four.
    assert energy[1] < energy[0] / 4.0
    assert momentum[1] < momentum[0] / 16.0


def test_friction_takes_its_torque_times_the_way_turned() -> None:
    arm = EngineArm(SYSTEM, CELLS, EngineEffects(coulomb=(0.5, 0.2)), STEP)
    motion = arm.run(0.5, every=1)
    way = np.abs(np.diff(motion.qpos[:, arm.joint_dofs("rotor")], axis=0)).sum(axis=0) / 50.0
    lost, _ = lost_energy(arm, motion)
    # The engine lets a friction torque build up with the speed: a little is missing.
    assert lost == pytest.approx(0.5 * way[0] + 0.2 * way[1], rel=2e-3)


def tip_speed(arm: EngineArm, motion: Motion) -> float:
    """Of the last link's end at the last instant, m/s, from one-sided differences of its position."""
    positions = []
    data = mujoco.MjData(arm.model)
    for qpos in motion.qpos[-1:-4:-1]:
        data.qpos = qpos
        mujoco.mj_kinematics(arm.model, data)
        positions.append(data.site("link_2.marker_2").xpos.copy())
    return float(np.linalg.norm(np.array([1.5, -2.0, 0.5]) @ positions / (motion.t[-1] - motion.t[-2])))


def test_a_cubic_spring_and_a_tip_mass_conserve_energy() -> None:
    arm = EngineArm(SYSTEM, CELLS, EngineEffects(cubic=(3e3, 0.0), tip_mass=0.5), STEP)
    motion = arm.run(0.5, every=1)
    lost, stored = lost_energy(arm, motion)
    assert abs(lost) < 1e-6 * stored
    deflection = motion.qpos[-1, arm.joint_dofs("rotor")[0]] / 50.0 - motion.qpos[-1, arm.joint_dofs("joint")[0]]
    linear = EngineArm(SYSTEM, CELLS, EngineEffects(tip_mass=0.5), STEP).energy(motion.rows(LAST))[0]
    assert stored - linear == pytest.approx(3e3 / 4.0 * deflection**4, rel=1e-9)
    # The tip's speed by differences of where its marker is, good to 1e-6.
    plain = EngineArm(SYSTEM, CELLS, EngineEffects(), STEP)
    assert linear - plain.energy(motion.rows(LAST))[0] == pytest.approx(0.25 * tip_speed(arm, motion) ** 2, rel=1e-5)


def test_dampers_in_the_links_take_their_energy() -> None:
    eta = 1e-2
    arm = EngineArm(SYSTEM, CELLS, EngineEffects(link_damping=eta), 0.25 * IMPLICIT_STEP)
    motion = arm.run(0.2, every=1)
    lost, _ = lost_energy(arm, motion)
    taken = np.trapezoid(eta * motion.qvel**2 @ arm.model.jnt_stiffness, motion.t)
    # A single run is of first order.
    assert lost == pytest.approx(taken, rel=0.02)


def test_both_integrators_agree_without_dampers() -> None:
    plain, faint = (mujoco_capture(SYSTEM, 0.2, effects=EngineEffects(link_damping=eta)) for eta in (0.0, 1e-9))
    # The start's jolt leaves the links' fast modes at 1e-5 rad; their phases differ.
    assert_allclose(faint.values[:, 2:], plain.values[:, 2:], rtol=0, atol=5e-6)


def test_a_step_too_long_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)  # the engine writes its warnings to a file where it runs
    with pytest.raises(ArithmeticError, match="unstable with 12 cells"):
        mujoco_capture(SYSTEM, 0.05, step=2.5e-4)


# Against the simulator


# Largest difference of engine and simulator over amplitude, by channel, m or rad: the jolt at the start excites modes
# of the links beyond those that two markers carry. The base and the motors hardly feel them.
DIFFERENCES = {"r_S": 5e-6, "theta_0": 5e-6, "theta_m": 5e-6, "q": 5e-5, "link": 1.5e-4}


@pytest.mark.parametrize("amplitude", [0.01, pytest.param(1.0, marks=pytest.mark.slow)])
def test_engine_and_simulator_move_alike(amplitude: float) -> None:
    """From rest, whatever the amplitude: `exact` links are exact. Smaller cells bring every channel closer."""
    system = at_smaller_amplitude(amplitude)
    blocks = list(sampled_blocks(simulate(system, 0.4)))
    ours = np.concatenate([block.values for block in blocks])
    differences = []
    for cells in (CELLS // 2, CELLS):
        engine = mujoco_capture(system, 0.4, cells)
        columns = [blocks[0].channels.index(channel) for channel in engine.channels]
        largest = np.abs(engine.values - ours[:, columns]).max(axis=0) / amplitude
        differences.append(dict(zip(engine.channels, largest.tolist(), strict=True)))
    coarse, fine = differences
    for channel, difference in fine.items():
        if not channel.startswith("tau"):
            assert difference < next(bound for name, bound in DIFFERENCES.items() if channel.startswith(name)), channel
            assert difference < coarse[channel], channel
    for channel in ("r_S_x", "r_S_y", "theta_0"):
        assert fine[channel] < coarse[channel] / 4.0


def test_noise_of_a_grade_comes_on_top() -> None:
    block = mujoco_capture(SYSTEM, 0.1)
    noisy = with_noise(block, SYSTEM, "B", SEED)
    assert noisy.channels == block.channels
    added = noisy.values - block.values
    expected = [GRADES["B"].torque / 50.0] * 2 + [GRADES["B"].marker] * 2 + [GRADES["B"].encoder] * 5
    expected += [GRADES["B"].marker] * 8
    # 101 samples: the spread is known to 7 %.
    assert_allclose(added.std(axis=0), expected, rtol=0.3)


# The fit


@pytest.mark.long
def test_the_estimator_finds_the_engines_parameters(engine_capture: Block) -> None:
    estimator = session_of(exactly_known(SYSTEM), [engine_capture])
    assert estimator.by_momentum
    base, truth = estimator.base, estimator.base.values(estimator.model.nominal)
    estimate = estimator.estimate().pi
    error = {p.name: abs(e / t - 1.0) for p, e, t in zip(base.parameters, estimate, truth, strict=True)}
    # 0.0075 kg m² at the end of a link of 18 kg m²: the segments alone change more than that.
    del error["motor_2.stator_inertia"]
    # The first that fits. What is left is owed to the engine's segments: with twice as many it falls fivefold or more.
    bounds = {"motor_2.mass": 1e-2, "spacecraft": 1e-3, "motor": 5e-4, "joint": 5e-4, "mass": 1e-3, "flexural": 3e-3}
    for name, value in error.items():
        assert value < next(bound for part, bound in bounds.items() if part in name), name
