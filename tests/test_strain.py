"""A strip's strain in place of the angle behind it: how it is read, what its noise does, and that it may be late."""

from __future__ import annotations

import numpy as np
import pytest

from sms_adapters.system_file import load_system
from sms_online.description.channels import channels
from sms_online.effects.build import build_model
from sms_online.effects.catalogue import candidates
from sms_online.errors import InputError
from sms_online.model.model import Model
from sms_online.model.readings import Readings
from sms_online.pipeline.sensing import Sensing

STRAIN = ("link_1.strain_angle", "link_2.strain_angle")
DRIVES = ("tau_1", "tau_2", "theta_m_1", "theta_m_2")


@pytest.fixture(scope="module")
def strips() -> Model:
    return build_model(load_system("quanser-2dsfl"))


def test_the_link_is_beyond_the_hub_by_the_strain(strips: Model) -> None:
    by_strain, by_angle = Sensing(strips, (*DRIVES, *STRAIN), "test"), Sensing(strips, (*DRIVES, "q_1", "q_2"), "test")
    assert set(STRAIN) <= set(channels(strips.system)) & set(by_strain.channels)
    x = np.random.default_rng(3).normal(size=(5, 4))
    layout = strips.layout
    q, theta_m = x[:, list(layout.q)], x[:, list(layout.theta_m)]
    read = {"theta_m_1": theta_m[:, 0], "theta_m_2": theta_m[:, 1], "q_1": q[:, 0], "q_2": q[:, 1]}
    read |= {"tau_1": np.zeros(5), "tau_2": np.zeros(5)}
    read |= dict(zip(STRAIN, (q - theta_m).T, strict=True))
    for sensing in (by_strain, by_angle):
        values = np.stack([read[name] for name in sensing.channels], axis=1)
        np.testing.assert_allclose(sensing.coordinates(values), x, rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(Readings(strips, STRAIN)(x, np.zeros_like(x)), q - theta_m, rtol=0.0, atol=1e-15)


def test_an_error_of_the_hub_moves_the_link_too(strips: Model) -> None:
    sensing = Sensing(strips, (*DRIVES, *STRAIN), "test")
    positions = [sensing.channels[k] for k in sensing.position_columns]
    moved = sensing.displacements(np.zeros((1, 4)))[0]
    hub, strain = positions.index("theta_m_1"), positions.index("link_1.strain_angle")
    assert moved[:, hub].nonzero()[0].tolist() == sorted((strips.layout.q[0], strips.layout.theta_m[0]))
    assert moved[:, strain].nonzero()[0].tolist() == [strips.layout.q[0]]
    noise = sensing.coordinate_noise(np.array([3.0 if name.startswith("theta") else 4.0 for name in positions]))
    assert noise[[strips.layout.q[0], strips.layout.theta_m[0]]].tolist() == [5.0, 3.0]


def test_gauges_may_lag_alone_and_together(strips: Model) -> None:
    lags = {effect.where for effect in candidates(strips.system) if effect.name == "sensor_lag"}
    assert {*STRAIN, "link_*.strain_angle"} <= lags


def test_a_flexible_joint_needs_one_of_both(strips: Model) -> None:
    with pytest.raises(InputError, match=r"no channel 'q_1'; expected a column q_1 or link_1\.strain_angle"):
        Sensing(strips, DRIVES, "test")
