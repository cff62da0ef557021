"""A plain rig: 17-bit encoders, a gyro, markers without slopes; what it records, and how near the bound it comes."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose

from sms_sim.simulate import exact_states, sampled_blocks, simulate
from tests.plain_rig import bound_of, plain_rig
from tests.sessions_of import session_of

SEED = 0


def test_a_simulation_records_each_rate_at_its_own_instants() -> None:
    simulation = simulate(plain_rig(), 0.1)
    (block,) = sampled_blocks(simulation, None, SEED)
    assert "gyro_0_z" in block.channels
    assert not any(name.endswith("theta_z") or name.startswith(("v_S", "omega_0")) for name in block.channels)
    gyro = block.values[:, block.channels.index("gyro_0_z")]
    omega = exact_states(simulation, block.t).v[:, simulation.plant.model.layout.speed_names.index("omega_0_z")]
    # Five standard deviations of its noise, 1e-4 rad/s.
    assert_allclose(gyro, omega, rtol=0.0, atol=5e-4)
    marker = block.values[:, block.channels.index("link_1.marker_1.u_y")]
    assert np.count_nonzero(np.isfinite(marker)) == 25  # 240 Hz over 0.1 s, both ends included


@pytest.mark.long
def test_parameters_of_a_plain_rig_are_within_ten_bounds() -> None:
    simulation = simulate(plain_rig())
    estimator = session_of(plain_rig(), sampled_blocks(simulation, None, SEED))
    assert estimator.by_smoother
    error = np.abs(estimator.estimate().pi - estimator.base.values(estimator.model.nominal))
    assert np.all(error <= 10.0 * bound_of(simulation))
