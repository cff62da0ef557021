"""A UR10e that picks up a payload in the middle of a run, from Pinocchio's inverse dynamics: no code of the model's.

Its friction falls with speed and grows with load, and its torques have coloured noise; a description has neither.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.signal import lfilter

from sms_adapters.urdf import import_urdf
from sms_online.capture import Capture
from sms_online.description.parse import parse_system
from sms_online.description.schema import Effect, System
from sms_online.stream import Array

pin: Any = pytest.importorskip("pinocchio", reason="Pinocchio (pip package `pin`) is the engine of the arm's motion")
pytest.importorskip("yourdfpy", reason="URDFs are read by yourdfpy (the extra `urdf`)")

URDF = Path(__file__).parent / "urdf" / "ur10e.urdf"
RATE = 250.0  # Hz
# Of the joints' Coulomb friction, N m, and damping, N m s/rad, as identified on arms of this size.
COULOMB = np.array([7.0, 7.0, 4.0, 1.5, 1.2, 1.0])
DAMPING = np.array([14.0, 14.0, 8.0, 3.0, 2.5, 2.0])
# What a description lacks: the share of Coulomb friction that is more at standstill, the rate that it falls by, rad/s,
# and friction a unit of transmitted torque.
STRIBECK, FALLS_BY, BY_LOAD = 0.3, 0.15, 0.03
STANDSTILL = 1e-3  # rad/s, within which friction reverses
# Noise of a torque: of its rms without payload, with this memory, s.
NOISE, MEMORY = 0.03, 0.05
ENCODER = 2e-5  # rad
MIDDLE = np.array([0.0, -1.2, 1.4, -0.8, 0.7, 0.0])  # rad
FREQUENCIES = np.array([0.1, 0.17, 0.29, 0.43, 0.61])  # Hz


def described() -> System:
    """The arm of the URDF, with Coulomb and viscous friction whose coefficients nobody knows."""
    system = parse_system(import_urdf(URDF), URDF.name)
    friction = tuple(
        Effect(name=name, where=f"joint_{i}")
        for i in range(1, len(system.joints) + 1)
        for name in ("coulomb_friction", "viscous_friction")
    )
    return system.model_copy(update={"effects": friction, "sample_rate": RATE})


def carrying(duration: float, seed: int, mass: float, picked_up: float, lacking: float = 1.0) -> Capture:
    """Samples of a run with a ball of 5 cm, of a mass in kg, at the flange's centre from an instant, s, on.

    lacking: of the friction that a description lacks, 1 as it is. The seed draws a trajectory of five sines an axis.
    """
    rng = np.random.default_rng(seed)
    empty, loaded = pin.buildModelFromUrdf(str(URDF)), pin.buildModelFromUrdf(str(URDF))
    flange = loaded.frames[loaded.getFrameId("tool0")]
    loaded.appendBodyToJoint(loaded.njoints - 1, pin.Inertia.FromSphere(mass, 0.05), flange.placement)
    t = np.arange(round(duration * RATE)) / RATE
    omega = 2.0 * np.pi * FREQUENCIES
    n = empty.nv
    a, b = rng.uniform(-0.5, 0.5, size=(2, n, omega.size)) / (0.5 + omega)
    s, c = np.sin(np.outer(t, omega)), np.cos(np.outer(t, omega))
    q, v = MIDDLE + s @ a.T + c @ b.T, (c * omega) @ a.T - (s * omega) @ b.T
    acceleration = -(s * omega**2) @ a.T - (c * omega**2) @ b.T

    def rigid(model: Any) -> Array:
        data = model.createData()
        return np.array([pin.rnea(model, data, *state) for state in zip(q, v, acceleration, strict=True)])

    light = rigid(empty)
    tau = np.where(t[:, None] < picked_up, light, rigid(loaded))
    falls = lacking * STRIBECK * np.exp(-((v / FALLS_BY) ** 2))
    dry = COULOMB * (1.0 + falls) + lacking * BY_LOAD * np.abs(tau)
    tau = tau + dry * np.tanh(v / STANDSTILL) + DAMPING * v
    size = np.sqrt(np.mean((light + COULOMB * np.sign(v) + DAMPING * v) ** 2, axis=0))
    memory = np.exp(-1.0 / (MEMORY * RATE))
    noise = lfilter([np.sqrt(1.0 - memory**2)], [1.0, -memory], rng.normal(size=tau.shape), axis=0)
    tau = tau + NOISE * size * noise
    q = q + ENCODER * rng.normal(size=q.shape)
    values = {f"force_{i + 1}": tau[:, i] for i in range(n)} | {f"q_{i + 1}": q[:, i] for i in range(n)}
    return Capture.from_arrays(t, values)
