"""Rigid systems against Pinocchio: mass matrix, forces, energies and regressors to 1e-9."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from sms_online.description.bodies import Inertia, RigidBody, RigidLink
from sms_online.description.schema import System
from sms_online.effects.build import build_model
from sms_online.model.layout import Layout
from sms_online.model.model import Model
from sms_online.model.so3 import RotationVector
from sms_online.stream import Array
from tests.model_systems import random_states, rigid_chain

pin: Any = pytest.importorskip("pinocchio", reason="Pinocchio (pip package `pin`) is the yardstick of the rigid case")

RELATIVE = 1e-9
# Our order of the ten inertial parameters out of Pinocchio's m, mc, I_xx, I_xy, I_yy, I_xz, I_yz, I_zz.
OUR_ORDER = [4, 6, 9, 5, 7, 8, 1, 2, 3, 0]

CHAINS = {
    "free, 3 joints": rigid_chain(3, free=True),
    "free, 5 joints, third prismatic": rigid_chain(5, free=True, prismatic=3),
    "free, 7 joints": rigid_chain(7, free=True),
    "fixed, 4 joints": rigid_chain(4, free=False),
    "fixed, 6 joints, first prismatic": rigid_chain(6, free=False, prismatic=1),
}
all_chains = pytest.mark.parametrize("system", CHAINS.values(), ids=CHAINS.keys())


def _tensor(inertia: Inertia) -> Array:
    i = inertia
    return np.array([[i.xx, i.xy, i.xz], [i.xy, i.yy, i.yz], [i.xz, i.yz, i.zz]])


def _body(body: RigidBody) -> Any:
    return pin.Inertia(body.mass, np.array(body.center_of_mass), _tensor(body.inertia))


class Yardstick:
    """A rigid system in Pinocchio: a free-flyer at S, or the world, then for every link its rotor's joint and its own.

    Pinocchio's speeds are the base's in body axes, q̇ of joints and n q̇ of rotors: `speed_map` takes ours to them.
    """

    def __init__(self, system: System) -> None:
        self.system = system
        self.model = pin.Model()
        self.model.gravity.linear = np.array(system.gravity)
        parent, here = 0, pin.SE3.Identity()
        if system.spacecraft is not None:
            parent = self.model.addJoint(0, pin.JointModelFreeFlyer(), here, "base")
            here = pin.SE3(np.eye(3), -np.array(system.spacecraft.tracked_point))  # joint 1 seen from S
            self.model.appendBodyToJoint(parent, _body(system.spacecraft), here)
        self.geared: list[tuple[int, float]] = []  # joint from 0, n
        for i, (joint, motor, link) in enumerate(zip(system.joints, system.motors, system.links, strict=True)):
            assert isinstance(link, RigidLink)
            axis = np.array(joint.axis)
            mount = here * pin.SE3(RotationVector(np.array(joint.mount_rotation)).matrix, np.zeros(3))
            if motor is not None:
                stator = pin.Inertia(motor.mass, np.zeros(3), _tensor(motor.stator_inertia))
                self.model.appendBodyToJoint(parent, stator, mount)
                # Before the link's own joint: Pinocchio's mass matrix wants every subtree numbered in one run.
                spin = self.model.addJoint(parent, pin.JointModelRevoluteUnaligned(axis), mount, f"rotor_{i + 1}")
                rotor = pin.Inertia(0.0, np.zeros(3), motor.rotor_inertia * np.outer(axis, axis))
                self.model.appendBodyToJoint(spin, rotor, pin.SE3.Identity())
                self.geared.append((i, joint.gear_ratio))
            kind = pin.JointModelPrismaticUnaligned if joint.kind == "prismatic" else pin.JointModelRevoluteUnaligned
            parent = self.model.addJoint(parent, kind(axis), mount, f"joint_{i + 1}")
            self.model.appendBodyToJoint(parent, _body(link), pin.SE3.Identity())
            here = pin.SE3(np.eye(3), np.array(link.tip))
        if system.payload is not None:
            self.model.appendBodyToJoint(parent, _body(system.payload), here)
        self.data = self.model.createData()
        self.parameters = np.concatenate([body.toDynamicParameters() for body in self.model.inertias[1:]])

    def speed_map(self, layout: Layout, x: Array) -> Array:
        """X (nv, n_v) of v_pin = X v at one position."""
        n = layout.n_base_speeds
        X = np.zeros((self.model.nv, layout.n_v))
        if layout.free:
            X[:3, :3] = X[3:6, 3:6] = layout.base_pose(x[None])[1][0].T
        for joint, i, ratio in self._moved():
            X[joint.idx_v, n + i] = ratio
        return X

    def positions(self, layout: Layout, x: Array) -> Array:
        """q of Pinocchio: S, quaternion, angles of joints and rotors."""
        q = np.zeros(self.model.nq)
        n = layout.n_base_positions
        q[:n] = x[:n]
        for joint, i, ratio in self._moved():
            q[joint.idx_q] = ratio * x[n + i]
        return q

    def _moved(self) -> list[tuple[Any, int, float]]:
        """Pinocchio's joints with the joint of ours (from 0) that moves them, and how many times as far."""
        named = [(f"joint_{i + 1}", i, 1.0) for i in range(len(self.system.joints))]
        named += [(f"rotor_{i + 1}", i, ratio) for i, ratio in self.geared]
        return [(self.model.joints[self.model.getJointId(name)], i, ratio) for name, i, ratio in named]

    def acceleration(self, layout: Layout, X: Array, v: Array, a: Array) -> Array:
        """v̇_pin of ours: body axes turn with the base, so their velocity changes by -ω × v besides."""
        a_pin = X @ a
        if layout.free:
            v_pin = X @ v
            a_pin[:3] -= np.cross(v_pin[3:6], v_pin[:3])
        return np.asarray(a_pin)


def _close(found: Array, expected: Array) -> None:
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=RELATIVE * np.abs(expected).max())


DRIVEN = {
    **CHAINS,
    "free, 5 joints, motors": rigid_chain(5, free=True, motors=True),
    "fixed, 3 joints, second prismatic, motors": rigid_chain(3, free=False, prismatic=2, motors=True),
}


@pytest.mark.parametrize("system", DRIVEN.values(), ids=DRIVEN.keys())
def test_dynamics_are_pinocchios(system: System) -> None:
    """M, nonlinear effects, inverse dynamics, kinetic energy and potential of gravity; rotors as bodies at n q̇."""
    model, yardstick = build_model(system), Yardstick(system)
    layout = model.layout
    x, v = random_states(layout, 5, seed=20)
    a = np.random.default_rng(21).normal(size=v.shape)
    dynamics = model.dynamics(model.nominal)
    H, C = dynamics.mass_and_bias(x, v)
    E, U = dynamics.energy(x, v), dynamics.energy(x, 0.0 * v)
    for b in range(len(x)):
        X, q = yardstick.speed_map(layout, x[b]), yardstick.positions(layout, x[b])
        v_pin = X @ v[b]
        a_pin = yardstick.acceleration(layout, X, v[b], a[b])
        M = pin.crba(yardstick.model, yardstick.data, q)
        M = np.triu(M) + np.triu(M, 1).T
        _close(H[b], X.T @ M @ X)
        bias = yardstick.acceleration(layout, X, v[b], 0.0 * a[b])
        effects = pin.nonLinearEffects(yardstick.model, yardstick.data, q, v_pin)
        _close(C[b], X.T @ (effects + M @ bias))
        _close(H[b] @ a[b] + C[b], X.T @ pin.rnea(yardstick.model, yardstick.data, q, v_pin, a_pin))
        _close(E[b] - U[b], pin.computeKineticEnergy(yardstick.model, yardstick.data, q, v_pin))
        _close(U[b], pin.computePotentialEnergy(yardstick.model, yardstick.data, q))


@all_chains
def test_energy_columns_are_pinocchios_energy_regressors(system: System) -> None:
    """Contracted with the parameters; and for the links, whose frames and signs agree, column by column."""
    model, yardstick = build_model(system), Yardstick(system)
    layout = model.layout
    x, v = random_states(layout, 5, seed=22)
    Y = model.energy_columns(x, v)
    for b in range(len(x)):
        X, q = yardstick.speed_map(layout, x[b]), yardstick.positions(layout, x[b])
        kinetic = pin.computeKineticEnergyRegressor(yardstick.model, yardstick.data, q, X @ v[b])
        row = kinetic + pin.computePotentialEnergyRegressor(yardstick.model, yardstick.data, q)
        _close(Y[b] @ model.nominal, row @ yardstick.parameters)
        _close(Y[b, link_columns(model)], pinocchio_link_columns(row[None], layout)[0])


@all_chains
def test_momentum_columns_are_pinocchios_joint_torque_regressor(system: System) -> None:
    """Column by column: H v̇ + C of one unit of each of a link's parameters."""
    model, yardstick = build_model(system), Yardstick(system)
    layout = model.layout
    x, v = random_states(layout, 1, seed=23)
    a = np.random.default_rng(24).normal(size=v.shape)
    X, q = yardstick.speed_map(layout, x[0]), yardstick.positions(layout, x[0])
    a_pin = yardstick.acceleration(layout, X, v[0], a[0])
    torque = X.T @ pin.computeJointTorqueRegressor(yardstick.model, yardstick.data, q, X @ v[0], a_pin)
    columns = link_columns(model)
    ours = np.zeros((layout.n_v, len(columns)))
    for k, index in enumerate(columns):
        H, C = model.dynamics(np.eye(model.n_pi)[index]).mass_and_bias(x, v)
        ours[:, k] = H[0] @ a[0] + C[0]
    _close(ours, pinocchio_link_columns(torque, layout))
    H, C = model.dynamics(model.nominal).mass_and_bias(x, v)
    _close(H[0] @ a[0] + C[0], torque @ yardstick.parameters)


def link_columns(model: Model) -> list[int]:
    """Indices of the ten parameters of each link in turn."""
    return [k for k, p in enumerate(model.parameters) if p.owner.startswith("link_")]


def pinocchio_link_columns(regressor: Array, layout: Layout) -> Array:
    """The links' columns of a Pinocchio regressor (·, 10 bodies) in our order."""
    bodies = regressor.reshape(regressor.shape[0], -1, 10)[:, 1 if layout.free else 0 :]
    return np.asarray(bodies[:, :, OUR_ORDER].reshape(regressor.shape[0], -1))
