"""Simulations that several tests share; each is made once a run."""

from __future__ import annotations

import os

import numpy as np
import pytest

from sms_adapters.system_file import load_system
from sms_online.description.schema import System
from sms_online.stream import Block
from sms_sim.simulate import Simulation, exact_states
from tests import simulations


def pytest_configure() -> None:
    """One thread of BLAS for each worker, which has a core of its own."""
    for library in ("OMP", "OPENBLAS"):
        os.environ.setdefault(f"{library}_NUM_THREADS", "1")


@pytest.fixture(scope="session", autouse=True)
def _share_motions(tmp_path_factory: pytest.TempPathFactory, worker_id: str) -> None:
    """The workers of a run integrate a motion once."""
    if worker_id != "master":
        simulations.folder = tmp_path_factory.getbasetemp().parent


@pytest.fixture(scope="session")
def planar_session() -> Simulation:
    """The paper's example (Table III) along (46) for 10 s, as in the paper."""
    return simulations.planar()


def noise_free_block(simulation: Simulation, system: System) -> Block:
    """Every position and the motor-shaft torques of a simulation at the system's sample rate, exact."""
    samples = round(simulation.duration * system.sample_rate)
    exact = exact_states(simulation, np.arange(samples + 1) / system.sample_rate)
    layout = simulation.plant.model.layout
    ratios = np.array([joint.gear_ratio for joint in system.joints])
    torques = tuple(f"tau_{i}" for i in range(1, len(system.joints) + 1))
    channels = layout.position_names + torques
    return Block(exact.t, channels, np.concatenate((exact.x, exact.torque / ratios), axis=1))


@pytest.fixture(scope="session")
def planar_block(planar_session: Simulation) -> Block:
    """The planar session as noise-free samples at 1 kHz."""
    return noise_free_block(planar_session, load_system("paper-planar"))
