"""A push at the arm that ends is no change of it: reported as such, its rows left out, the parameters as before."""

from __future__ import annotations

import numpy as np
import pytest

from sms_adapters.system_file import load_system
from sms_online.stream import Block
from sms_sim.simulate import Simulation
from tests.campaigns.sessions import true_parameters
from tests.changed_session import changed_session, noisy
from tests.evaluated import judged
from tests.sessions_of import session_of

PLANAR = load_system("paper-planar")
PUSHED, END = 10.0, 14.0  # s


def pushed(simulation: Simulation, torque: float, duration: float, at: float = PUSHED) -> Block:
    """Samples at grade B with a torque, N m, at joint 2 that acts for a duration, s, and is not measured."""
    block = noisy(PLANAR, changed_session(simulation, PLANAR, 0.5 * PUSHED, END), "B", 1)
    phase = np.clip((block.t - at) / duration, 0.0, 1.0)
    shaft = torque / PLANAR.joints[1].gear_ratio * np.sin(np.pi * phase) ** 2
    block.values[:, block.channels.index("tau_2")] -= shaft
    return block


@pytest.mark.slow
@pytest.mark.parametrize(("torque", "duration"), [(5.0, 0.3), (40.0, 0.3), (20.0, 1.0)])
def test_a_push_is_a_transient(planar_session: Simulation, torque: float, duration: float) -> None:
    estimator = session_of(PLANAR, [pushed(planar_session, torque, duration)])
    (event,) = estimator.events
    assert (event.kind, event.parameters, event.sizes) == ("transient", (), ())
    assert abs(event.time - PUSHED) < 0.5
    estimate = estimator.estimate()
    assert estimate.pi.size == true_parameters(PLANAR).size
    assert (np.abs(estimate.pi - true_parameters(PLANAR)) < 4.0 * estimate.std).all()
    assert not judged(estimator).grave


@pytest.mark.slow
def test_a_push_at_the_end_is_undecided(planar_session: Simulation) -> None:
    estimator = session_of(PLANAR, [pushed(planar_session, 40.0, 0.3, at=END - 0.8)])
    assert [event.kind for event in estimator.events] == ["undecided"]
