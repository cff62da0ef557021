"""Measured forces and moments of the surroundings: known to the balances, the simulator and the bound."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rosbags.rosbag2 import StoragePlugin

import sms_online as sms
from sms_online.description.parse import parse_system, shipped_text
from sms_online.effects.build import build_model
from sms_online.model.base_parameters import random_states
from sms_online.model.model import Model
from sms_online.pipeline.estimator import Estimator
from sms_online.state import collect, encode
from sms_sim.capture import Simulated
from sms_sim.simulate import Simulation, exact_states
from tests.axis import AXIS, MOTION
from tests.bags import path_of, write_ros2
from tests.refused import assert_refused
from tests.saved import resumed

PUSHED = """
[[wrench]]
where = "link_2"
applied = { f_y = [{ frequency = 3.0, sine = 8.0 }], m_z = [{ frequency = 5.0, cosine = 2.0 }] }
"""
ON_BASE = '[[wrench]]\nwhere = "base"\ncomponents = ["f_x"]\napplied = { f_x = [{ frequency = 2.0, sine = 6.0 }] }\n'
ON_AXIS = '[[wrench]]\nwhere = "link_1"\ncomponents = ["m_z"]\n'
SECONDS = 4.0


def planar(further: str = PUSHED) -> sms.System:
    return parse_system(shipped_text("paper-planar") + further, "rig.toml")


@pytest.fixture(scope="module")
def moved() -> tuple[Simulated, Simulation]:
    """The planar example, pushed at its tip and at its base. Seed 1."""
    session = Simulated.of(planar(PUSHED + ON_BASE), duration=SECONDS, grade="B", seed=1)
    return session, session.solve()


def end_pose(model: Model, x: np.ndarray, link: int) -> tuple[np.ndarray, np.ndarray]:
    """Origin (B, 3) and rotation (B, 3, 3) of a link's end (from 1); of S and the base for 0."""
    if link == 0:
        return model.layout.base_pose(x)
    configuration = model.chain.configure(x)
    frame = configuration.end(link - 1, configuration.frames[2 * link])
    return frame.origin, frame.rotation


@pytest.mark.parametrize("name", ["paper-planar", "paper-planar-exact", "spatial-two-link"])
@pytest.mark.parametrize("link", [0, 1, 2])
def test_a_wrench_works_along_the_motion_of_its_body(name: str, link: int) -> None:
    where = f"link_{link}" if link else "base"
    model = build_model(parse_system(f'{shipped_text(name)}\n[[wrench]]\nwhere = "{where}"\n', "rig.toml"))
    x, v = random_states(model, 4, np.random.default_rng(2))
    step = 1e-6
    (before, turned_before), (after, turned_after) = (
        end_pose(model, x + sign * step * model.position_rate(x, v), link) for sign in (-1.0, 1.0)
    )
    _, turned = end_pose(model, x, link)
    velocity = np.einsum("bji,bj->bi", turned, (after - before) / (2.0 * step))
    spin = np.einsum("bji,bjk->bik", turned, (turned_after - turned_before) / (2.0 * step))
    twist = np.concatenate((velocity, np.stack((spin[:, 2, 1], spin[:, 0, 2], spin[:, 1, 0]), axis=1)), axis=1)
    measured = [0, 1, 5] if model.layout.planar else list(range(6))
    assert model.wrenches is not None
    rates = np.einsum("bvc,bv->bc", model.wrenches.by_component(x), v)
    np.testing.assert_allclose(rates, twist[:, measured], atol=1e-7)


@pytest.mark.slow
def test_the_momentum_changes_by_what_pushes(moved: tuple[Simulated, Simulation]) -> None:
    simulation = moved[1]
    assert abs(simulation.drift.energy) < 1e-9
    exact = exact_states(simulation, np.linspace(0.0, SECONDS, 4001))
    plant = simulation.plant
    momentum = plant.dynamics.base_momentum(
        exact.x[[0, -1]], exact.v[[0, -1]], plant.model.inputs(exact.torque[[0, -1]])
    )
    forces = np.zeros((len(exact.t), 3, 2))
    forces[:, :2, 0], forces[:, 0, 1] = exact.torque[:, 2:4], exact.torque[:, 5]
    inertial = sum(
        np.einsum("bij,bj->bi", end_pose(plant.model, exact.x, link)[1], forces[..., k])
        for k, link in enumerate((2, 0))
    )
    impulse = np.trapezoid(inertial[:, :2], exact.t, axis=0)
    assert np.abs(impulse).max() > 1.0
    np.testing.assert_allclose(np.diff(momentum[:, :2], axis=0)[0], impulse, atol=1e-4)


@pytest.mark.slow
def test_a_pushed_arm_is_estimated_within_its_bars(moved: tuple[Simulated, Simulation]) -> None:
    session, simulation = moved
    capture = session.capture(simulation)
    result = sms.estimate(session.system, capture)
    errors = [(p.value - p.true) / p.std for p in result.parameters.values() if p.determined and p.true is not None]
    assert len(errors) == 16
    assert np.abs(errors).max() < 4.0
    assert result.trust.level == "trust"
    # The same without what was measured of the push: the model lacks something.
    there = [name for name in capture.channels if not name.startswith("wrench_")]
    columns = [capture.channels.index(name) for name in there]
    alone = replace(capture, channels=tuple(there), values=capture.values[:, columns])
    assert sms.estimate(planar(""), alone).trust.level != "trust"


@pytest.mark.slow
def test_energies_alone_know_the_push(moved: tuple[Simulated, Simulation]) -> None:
    session, simulation = moved
    system = session.system.model_copy(update={"balance": "energy"})
    exact = Simulated(session.described, grade="0").capture(simulation)
    stiffness = sms.estimate(system, exact).parameters["joint_1.stiffness"].value
    assert stiffness == pytest.approx(1000.0, rel=1e-3)


@pytest.mark.long
@pytest.mark.parametrize("plugin", [StoragePlugin.SQLITE3, StoragePlugin.MCAP])
def test_a_bag_with_wrenches_gives_the_same_estimate(tmp_path: Path, plugin: StoragePlugin) -> None:
    capture = sms.simulate(planar(), duration=3.0, grade="B", seed=4)
    signals = "".join(f'"{path_of(name, capture.channels)}" = "{name}"\n' for name in capture.channels)
    bagged = planar(f'{PUSHED}[[source]]\nkind = "bag"\nname = "rig"\n[source.signals]\n{signals}')
    both = [
        sms.estimate(planar(), sms.write_capture(capture, tmp_path / "run.csv")),
        sms.estimate(bagged, write_ros2(capture, tmp_path / "bag", plugin)),
    ]
    values, stds = (
        [[getattr(p, part) for p in each.parameters.values()] for each in both] for part in ("value", "std")
    )
    assert len(values[0]) == 16
    np.testing.assert_array_equal(*values)
    np.testing.assert_array_equal(*stds)


@pytest.mark.slow
def test_a_session_goes_on_from_its_state(moved: tuple[Simulated, Simulation]) -> None:
    session, simulation = moved
    blocks = list(session.blocks(simulation))
    whole = Estimator(session.system, session.channels, "whole")
    for block in blocks[:2]:
        whole.push(block)
    second = resumed(Estimator(session.system, session.channels, "whole"), whole)
    for estimator in (whole, second):
        for block in blocks[2:]:
            estimator.push(block)
    assert encode(collect(second)) == encode(collect(whole))


@pytest.mark.slow
def test_noise_of_a_wrench_raises_the_bound() -> None:
    moment = ON_AXIS + "applied = { m_z = [{ frequency = 3.0, sine = 2.0 }] }\n"
    noise = '[[sensor]]\nchannels = ["q_*"]\nnoise = 1e-4\n[[sensor]]\nchannels = ["force_*"]\nnoise = 0.1\n'

    def least(std: float) -> float:
        measured = f'[[sensor]]\nchannels = ["wrench_*"]\nnoise = {std}\n'
        system = parse_system(AXIS + MOTION + moment + noise + measured, "axis.toml")
        return sms.bound(system).parameters["link_1.inertia"].std

    # Torque and moment act alike, so that their variances add.
    assert least(0.1) == pytest.approx(np.sqrt(2.0) * least(1e-6), rel=0.02)


@pytest.mark.parametrize(
    ("text", "place", "found", "expected"),
    [
        ('where = "link_7"', "wrench 1.where", "'link_7'", "'link_1'"),
        ('where = "base"', "wrench 1.where", "'base'", "'link_1'"),
        ('where = "link_1"\ncomponents = ["f_z"]', "wrench 1.components", "'f_z'", "'m_z'"),
        ('where = "link_1"\ncomponents = ["f_x", "f_x"]', "wrench 1.components", "twice", "once"),
        ('where = "link_1"\ncomponents = ["f_x"]\napplied = { m_z = [] }', "wrench 1.applied", "'m_z'", "'f_x'"),
        ('where = "link_1"\nforce = 3.0', "wrench 1.force", "unknown key 'force'", "'components'"),
    ],
)
def test_a_wrench_that_cannot_be_is_refused(text: str, place: str, found: str, expected: str) -> None:
    assert_refused(f"{AXIS}[[wrench]]\n{text}\n", "axis.toml", place, found, expected)


def test_a_described_wrench_has_to_be_measured() -> None:
    system = parse_system(AXIS + ON_AXIS, "axis.toml")
    with pytest.raises(sms.InputError, match=r"no channel 'wrench_1.m_z'"):
        sms.Session(system, ("force_1", "q_1"))


def test_the_smoother_takes_no_wrench() -> None:
    system = parse_system(AXIS + ON_AXIS, "axis.toml").model_copy(update={"balance": "smoother"})
    with pytest.raises(sms.InputError, match="the smoother does not use"):
        sms.Session(system, ("force_1", "q_1", "wrench_1.m_z"))
