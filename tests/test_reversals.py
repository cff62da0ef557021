"""A light axis that its friction turns back several times a second: data of a plain integration in time."""

from __future__ import annotations

import numpy as np
import pytest

import sms_online as sms
from sms_online.description.parse import parse_system
from sms_online.stream import Array

RATE, SECONDS, STEPS = 500.0, 40.0, 20
TRUE = {
    "link_1.inertia": 0.0022,
    "viscous_friction@joint_1.damping": 0.01,
    "coulomb_friction@joint_1.torque": 0.05,
}
# Of the encoder and of the torque, 1σ.
ANGLE, TORQUE = 4e-5, 0.003
DESCRIBED = """
name = "light axis"
motion = "planar"
sample_rate = 500.0
[joint_1]
transmission = "rigid"
[link_1]
kind = "rigid"
inertia = { zz = 0.002 }
[[effect]]
name = "viscous_friction"
where = "joint_1"
[[effect]]
name = "coulomb_friction"
where = "joint_1"
"""


def moved(seed: int) -> tuple[Array, Array, Array]:
    """Instants, torque and angle (B,) of the axis under eight sines of torque; where they are too weak it rests."""
    inertia, damping, coulomb = TRUE.values()
    random = np.random.default_rng(seed)
    frequencies = np.array([0.9, 1.7, 2.3, 3.1, 4.3, 5.3, 6.7, 7.9])
    t = np.arange(round(SECONDS * RATE * STEPS)) / (RATE * STEPS)
    phases = random.uniform(0.0, 2.0 * np.pi, frequencies.size)
    torque = 0.06 * np.sum(np.sin(2.0 * np.pi * frequencies * t[:, None] + phases), axis=1)
    step, rate, angle = 1.0 / (RATE * STEPS), 0.0, 0.0
    angles = []
    for each in torque.tolist():
        angles.append(angle)
        drive = each - damping * rate
        sign = np.sign(rate) or (np.sign(drive) if abs(drive) > coulomb else 0.0)
        after = rate + step * (drive - sign * coulomb) / inertia if sign else 0.0
        # Friction stops, it does not drive back.
        rate = after if after * rate >= 0.0 else 0.0
        angle += step * rate
    kept = slice(None, None, STEPS)
    return t[kept], torque[kept], np.array(angles)[kept]


@pytest.mark.long
def test_an_inertia_is_free_of_the_friction_that_turns_it_back() -> None:
    """Four sessions: errors are within their bars all together, none is four bars off, and the bars are small."""
    z = []
    for seed in range(4):
        t, torque, angle = moved(seed)
        random = np.random.default_rng(100 + seed)
        noisy = {
            "force_1": torque + TORQUE * random.standard_normal(t.size),
            "q_1": angle + ANGLE * random.standard_normal(t.size),
        }
        system = parse_system(DESCRIBED, "light.toml")
        result = sms.estimate(system, sms.Capture.from_arrays(t, noisy))
        found = [result.parameters[name] for name in TRUE]
        z += [(each.value - value) / each.std for each, value in zip(found, TRUE.values(), strict=True)]
        assert all(each.std < 0.02 * each.value for each in found[::2])
    assert np.sqrt(np.mean(np.square(z))) < 1.5
    assert np.max(np.abs(z)) < 4.0
