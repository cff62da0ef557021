"""Internal states of effects along a motion, against closed forms."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from numpy.testing import assert_allclose

from sms_adapters.system_file import load_system
from sms_online.effects.build import build_model
from sms_online.effects.catalogue import parse_effect
from sms_online.pipeline.internal_states import InternalStates

RATE = 250.0


def test_a_liquid_keeps_its_frequency_for_minutes() -> None:
    """In a base that moves off at 1 m/s: p - r_S = -sin(ω t) / ω on either axis, in pieces too."""
    system = load_system("paper-planar")
    effect = parse_effect("slosh@base:mass=1,stiffness=324", system)
    model = build_model(system.model_copy(update={"effects": (effect,)}))
    t = np.arange(round(120.0 * RATE)) / RATE
    x, v = np.zeros((t.size, model.layout.n_x)), np.zeros((t.size, model.layout.n_v))
    x[:, :2], v[:, :2] = t[:, None], 1.0
    z = InternalStates(model, RATE).push(x, v)
    assert_allclose(z[:, :2] - x[:, :2], np.stack([-np.sin(18.0 * t) / 18.0] * 2, axis=1), atol=1e-4 / 18.0)
    again = InternalStates(model, RATE)
    # The first ones of a single sample, as between two gaps.
    edges = [0, 1, 2, 3, *range(701, t.size, 701), t.size]
    pieces = [again.push(x[a:b], v[a:b]) for a, b in pairwise(edges)]
    assert_allclose(np.concatenate(pieces), z, rtol=0.0, atol=1e-12 * np.abs(z).max())


@pytest.mark.parametrize("width", [1e-4, 1e-3, 1e-2, 0.3])
def test_a_presliding_friction_follows_its_way_alone(width: float) -> None:
    """z = w sign(v) (1 - exp(-way / w)) from rest, and from one end to the other after a reversal, at any speed."""
    system = load_system("paper-planar")
    effect = parse_effect(f"presliding_friction@joint_1:torque=1,width={width}", system)
    model = build_model(system.model_copy(update={"effects": (effect,)}))
    motor = model.layout.theta_m[0]
    rate = np.concatenate((np.full(200, 0.7), [0.0], np.full(200, -0.7)))
    x, v = np.zeros((rate.size, model.layout.n_x)), np.zeros((rate.size, model.layout.n_v))
    v[:, motor] = rate
    z = InternalStates(model, RATE).push(x, v)[:, 0]
    way = np.append(np.arange(200), 199.5) * 0.7 / RATE
    there = width * (1.0 - np.exp(-way / width))
    back = -width + (width + there[-1]) * np.exp(-(np.arange(200) + 0.5) * 0.7 / RATE / width)
    expected = np.concatenate((there, back))
    assert_allclose(z, expected, atol=0.9 * width)
    # At the turn the rate of forgetting is at its mean over a sample, in which it changes as much as it can.
    steady = np.r_[:199, 206 : z.size]
    assert_allclose(z[steady], expected[steady], atol=5e-3 * width)
